"""``dexkit install-service``: systemd units and udev rules that serve hands from boot on."""

from __future__ import annotations

import grp
import os
import pwd
import shlex
import stat
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import click
import platformdirs

from dexkit.backends import Backend, backend
from dexkit.child_processes import code_line, command_line
from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    devices_by_side,
    devices_option,
    dialect_option,
    domain_option,
    dry_run_option,
    interface_option,
    side_option,
    wait_for_interface_option,
)
from dexkit.cli.settings import set_option
from dexkit.documents import write_file
from dexkit.errors import OutputError, UsageError
from dexkit.hand import Side
from dexkit.systemd_units import GROUPS, device_link, serial_rule, unit, unit_name

__all__ = ["command"]

_UNITS, _RULES = Path("/etc/systemd/system"), Path("/etc/udev/rules.d")
_ROOT = str(Path(__file__).resolve().parents[2])
_PATIENCE = 120.0  # seconds for a plug-in to be imported


@click.command(
    "install-service",
    cls=Command,
    exit_codes={
        0: "the files are written or printed",
    },
)
@click.argument("backend_name", metavar="BACKEND")
@side_option("Which hand; both writes one unit for each.", required=True)
@devices_option(
    "Serial port of the hand now; with --side both left=PATH and right=PATH. A udev rule "
    "gives it the name /dev/dexkit-SIDE."
)
@set_option("Setting of the backend, as of 'dexkit serve'.")
@dialect_option("As for 'dexkit serve'.")
@domain_option("DDS domain.", 0)
@interface_option("Network interface: name, address or prefix, e.g. 192.168.123.0/24.")
@wait_for_interface_option("How long a start waits for the interface.", 600.0)
@click.option(
    "--user",
    metavar="NAME",
    help="User that runs the service.  [default: the user who calls sudo; root only if named]",
)
@click.option("--no-udev", is_flag=True, help="Write no udev rules; use device paths as given.")
@click.option(
    "--directory",
    type=LocalPath(file_okay=False, exists=True),
    metavar="DIR",
    help="Write all files here.  [default: /etc/systemd/system and /etc/udev/rules.d]",
)
@dry_run_option("Print the files, write nothing.")
def command(
    backend_name: str,
    sides: tuple[Side, ...],
    devices: tuple[str, ...],
    settings: tuple[str, ...],
    dialect: str | None,
    domain: int,
    interface: str,
    wait_for_interface: float,
    user: str | None,
    no_udev: bool,
    directory: Path | None,
    dry_run: bool,
) -> int:
    """Write systemd units that serve BACKEND from boot on, one for each hand.

    A unit restarts its service when it ends or its state loop hangs, gives it real-time priority,
    and waits for network and device. Nothing is started; the commands for it are printed.
    docs/install-service.md describes the files.

    BACKEND may be package.module:Class: the unit then names the folder that it is loaded from. It
    is refused if the service's user cannot load it, or others could change it.
    """
    kind = backend(backend_name)
    paths = devices_by_side(devices, sides)
    who = _user(user)
    place = _place(backend_name, who)
    groups = _groups()
    files: dict[Path, str] = {}
    rules = ""
    for side in sides:
        words = [*place.start, "serve", backend_name, "--side", str(side)]
        if side in paths:
            if not no_udev:
                rules += serial_rule(side, Path(paths[side]))
            words += ["--device", paths[side] if no_udev else device_link(side)]
        if (stored := _settings_file(kind, settings, side)) is not None:
            words += ["--set", f"config={stored}"]
        for text in settings:
            if text.partition(".")[0] not in {str(other) for other in Side if other is not side}:
                words += ["--set", text]
        if dialect is not None:
            words += ["--dialect", dialect]
        words += ["--domain", str(domain), "--interface", interface]
        words += ["--wait-for-interface", f"{wait_for_interface:g}"]
        words += ["--wait-for-device"] if kind.needs or side in paths else []
        words += ["--quiet"]
        files[(directory or _UNITS) / unit_name(side)] = unit(
            side,
            words,
            user=who.pw_name,
            what=backend_name,
            groups=groups,
            folder=place.folder,
            python_path=place.python_path,
        )
    if kind.udev_rules is not None and not no_udev:
        rules += kind.udev_rules.load()()
    if rules:
        files[(directory or _RULES) / "71-dexkit.rules"] = rules
    for path in files:
        if path.exists() and not path.is_file():  # systemctl mask makes it a link to /dev/null
            raise OutputError(
                f"{path} is masked: it leads to {path.resolve()}",
                hint=f"sudo systemctl unmask {path.name}",
            )
    for path, text in files.items():
        if dry_run:
            click.echo(f"# {path}\n{text}")
            continue
        try:
            write_file(path, text)
        except OutputError as error:
            raise OutputError(
                str(error), hint=f"sudo {shlex.join(sys.argv)}, or --dry-run, or --directory DIR"
            ) from error
        click.echo(f"written: {path}")
    services = " ".join(unit_name(side) for side in sides)
    click.echo("nothing is started yet; next:")
    if rules:
        click.echo("  sudo udevadm control --reload && sudo udevadm trigger")
    click.echo(f"  sudo systemctl daemon-reload && sudo systemctl enable --now {services}")
    click.echo(f"see: systemctl status {services}; journalctl -u {unit_name(sides[0])}")
    return 0


def _settings_file(kind: Backend, settings: Sequence[str], side: Side) -> Path | None:
    """The file with the settings of single hands that the unit names; None if it is given.

    The service may run as another user, whose own file is another one. Behind sudo it is the file
    of the user who calls it: that is where a bring-up without sudo has written.
    """
    keys = {text.partition("=")[0] for text in settings}
    if kind.settings_file is None or keys & {"config", f"{side}.config"}:
        return None
    path = Path.cwd() / kind.settings_file.load()()
    caller = os.environ.get("SUDO_USER")
    if caller and path.parent == platformdirs.user_config_path("dexkit"):
        with suppress(KeyError):
            path = Path(pwd.getpwnam(caller).pw_dir, ".config", "dexkit", path.name)
    if not path.exists():
        click.echo(
            f"{path} is not there yet: bring-up or calibration of the hand writes it", err=True
        )
    return path


def _user(name: str | None) -> pwd.struct_passwd:
    """The user of the service: ``--user``, or the one who installs it.

    :raises UsageError: there is none, or it would be root without being asked for.
    """
    chosen = name or os.environ.get("SUDO_USER") or pwd.getpwuid(os.geteuid()).pw_name
    try:
        found = pwd.getpwnam(chosen)
    except KeyError:
        raise UsageError(f"there is no user {chosen!r}", hint="--user NAME") from None
    if found.pw_uid == 0 and name is None:
        raise UsageError(
            "the service would run as root, which it does not need",
            hint="--user NAME of an ordinary user (or --user root)",
        )
    return found


def _groups() -> list[str]:
    """The groups of serial ports and USB devices; systemd starts nothing with one that is not
    there.
    """
    found = []
    for name in GROUPS:
        try:
            grp.getgrnam(name)
        except KeyError:
            click.echo(
                f"there is no group {name}: give the service's user access to its device yourself",
                err=True,
            )
        else:
            found.append(name)
    return found


@dataclass(frozen=True)
class _Place:
    """Where a unit starts.

    :param folder: working folder, or None for systemd's.
    :param python_path: value of PYTHONPATH, or empty.
    """

    folder: Path | None = None
    python_path: str = ""

    @property
    def start(self) -> list[str]:
        """The beginning of the command line."""
        if self.folder is None:
            return [sys.executable, "-m", "dexkit"]
        return command_line()  # nothing that lies in the folder replaces a module of its name

    @property
    def searched(self) -> list[Path]:
        """The folders that modules are loaded from beside the interpreter's."""
        named = [Path(p) for p in self.python_path.split(os.pathsep) if p]
        return [*([self.folder] if self.folder else []), *named]


def _place(backend_name: str, user: pwd.struct_passwd) -> _Place:
    """The first place from which the service's user can load the backend.

    :raises UsageError: there is none, or others may change what is loaded there.
    """
    if ":" not in backend_name and user.pw_uid == os.geteuid():
        return _Place()  # as this process has loaded it
    here = Path.cwd()
    named = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    python_path = os.pathsep.join(str(here / p) for p in named)
    places = [_Place()]
    if ":" in backend_name:
        places.append(_Place(here))
        places += [_Place(here, python_path)] if python_path else []
    problem = ""
    for place in places:
        problem = _load_problem(backend_name, place, user)
        if not problem:
            for folder in place.searched:
                _check_writers(folder, user)
            return place
    raise UsageError(
        f"as the user {user.pw_name}, {sys.executable} cannot load {backend_name}: {problem}",
        hint="install it into this environment, or start this in the folder of its module; the "
        "service's user must be able to read both (--user NAME)",
    )


def _load_problem(backend_name: str, place: _Place, user: pwd.struct_passwd) -> str:
    """Why a process of the unit would not load the backend, or empty."""
    code = "from dexkit.backends import backend; backend(sys.argv[1])"
    environment = {
        "PATH": os.defpath,
        "HOME": user.pw_dir,
        "USER": user.pw_name,
        "LC_ALL": "C.UTF-8",
        "PYTHONDONTWRITEBYTECODE": "1",
        **({"PYTHONPATH": place.python_path} if place.python_path else {}),
    }
    identity = {}
    if os.geteuid() == 0 and user.pw_uid != 0:
        identity = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
    try:
        done = subprocess.run(
            code_line(code, backend_name, back=[_ROOT]),
            cwd=place.folder or "/",
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            timeout=_PATIENCE,
            **identity,  # type: ignore[call-overload]
        )
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return (lines or [f"exit code {done.returncode}"])[-1] if done.returncode else ""


def _check_writers(folder: Path, user: pwd.struct_passwd) -> None:
    """Refuse a folder in which others than the service's user and root may put code.

    :raises UsageError: they may.
    """
    status = folder.stat()
    if status.st_mode & stat.S_IWOTH or status.st_uid not in (0, user.pw_uid):
        raise UsageError(
            f"others than {user.pw_name} may change what the service would load from {folder}",
            hint="put the module into a folder of that user or of root, or install it",
        )
