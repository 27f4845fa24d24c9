"""``dexkit install-service``: systemd units and udev rules that serve hands from boot on."""

from __future__ import annotations

import os
import pwd
import shlex
import sys
from pathlib import Path

import click

from dexkit.backends import backend
from dexkit.cli.options import (
    LocalPath,
    devices_by_side,
    devices_option,
    dialect_option,
    domain_option,
    dry_run_option,
    interface_option,
    set_option,
    side_option,
    wait_for_interface_option,
)
from dexkit.documents import write_file
from dexkit.errors import OutputError, UsageError
from dexkit.hand import Side
from dexkit.systemd_units import device_link, serial_rule, unit, unit_name

__all__ = ["command"]

_UNITS, _RULES = Path("/etc/systemd/system"), Path("/etc/udev/rules.d")


@click.command("install-service")
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
    "--user", metavar="NAME", help="User that runs the service.  [default: the installing user]"
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
    """
    kind = backend(backend_name)
    paths = devices_by_side(devices, sides)
    name = user or os.environ.get("SUDO_USER") or pwd.getpwuid(os.geteuid()).pw_name
    try:
        pwd.getpwnam(name)
    except KeyError:
        raise UsageError(f"there is no user {name!r}", hint="--user NAME") from None
    files: dict[Path, str] = {}
    rules = ""
    for side in sides:
        words = [sys.executable, "-m", "dexkit", "serve", backend_name, "--side", str(side)]
        if side in paths:
            if not no_udev:
                rules += serial_rule(side, Path(paths[side]))
            words += ["--device", paths[side] if no_udev else device_link(side)]
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
            side, words, user=name, what=backend_name
        )
    if kind.udev_rules is not None and not no_udev:
        rules += kind.udev_rules.load()()
    if rules:
        files[(directory or _RULES) / "71-dexkit.rules"] = rules
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
