"""systemd units and udev rules: their text, systemd's own check, and their command line at work."""

from __future__ import annotations

import os
import pwd
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from dexkit import systemd_units
from dexkit.child_processes import command_line
from dexkit.cli import cli
from dexkit.errors import OutputError, UsageError
from dexkit.hand import Side
from dexkit.systemd_units import serial_rule, unit, usb_rules
from tests.dds_helpers import free_domain
from tests.each import each

ROOT = Path(__file__).parent.parent
_NOBODY = 65534


def _install(*words: str) -> str:
    done = CliRunner().invoke(cli, ["install-service", *words], standalone_mode=False)
    if done.exception is not None:
        raise done.exception
    return done.output


def _command(text: str) -> list[str]:
    """The command line of a unit, as systemd reads a plain one."""
    (line,) = [line for line in text.splitlines() if line.startswith("ExecStart=")]
    return shlex.split(line.removeprefix("ExecStart="))


def test_a_masked_unit_is_not_written_through(tmp_path: Path) -> None:
    (tmp_path / "dexkit-left.service").symlink_to(os.devnull)
    with pytest.raises(OutputError, match="is masked: it leads to /dev/null"):
        _install("sim-dex1", "--side", "both", "--user", "root", "--directory", str(tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ["dexkit-left.service"]


def test_one_unit_a_hand_is_written_and_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    words = ("sim-dex1", "--side", "both", "--interface", "192.168.123.0/24", "--user", "root")
    more = ("--set", "object=40", "--set", "left.start=10", "--directory", str(tmp_path))
    said = _install(*words, *more, "--dry-run")
    assert not list(tmp_path.iterdir())
    assert "# " + str(tmp_path / "dexkit-left.service") in said
    said = _install(*words, *more)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "dexkit-left.service",
        "dexkit-right.service",
    ]
    assert "systemctl enable --now dexkit-left.service dexkit-right.service" in said
    left, right = (_command((tmp_path / f"dexkit-{s}.service").read_text()) for s in Side)
    assert left[:7] == [sys.executable, "-m", "dexkit", "serve", "sim-dex1", "--side", "left"]
    assert "left.start=10" in left
    assert "left.start=10" not in right
    assert "object=40" in right
    assert left[left.index("--interface") + 1] == "192.168.123.0/24"
    assert "--wait-for-interface" in left


@each(
    ("backend", "variable"),
    [
        ("dex3-usb", "DEXKIT_DEX3_CONFIG"),
        ("ezgripper", "DEXKIT_EZGRIPPER_CONFIG"),
        ("dex1-serial", "DEXKIT_DEX1_CONFIG"),
    ],
)
def test_the_unit_names_the_settings_file(
    backend: str, variable: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The service's user may have another one, or none: the hand would be served by guesses."""
    words = (backend, "--side", "left", "--interface", "lo", "--user", "root", "--no-udev",
             "--device", "/dev/ttyUSB0", "--dry-run")  # fmt: skip
    monkeypatch.setenv(variable, str(tmp_path / "hands.json"))
    said = _install(*words)
    assert f"config={tmp_path / 'hands.json'}" in _command(said)
    assert "is not there yet" in said
    given = _command(_install(*words, "--set", "config=/etc/mine.json"))
    assert [w for w in given if w.startswith("config=")] == ["config=/etc/mine.json"]
    monkeypatch.delenv(variable)
    monkeypatch.setenv("SUDO_USER", "nobody")
    (config,) = [w for w in _command(_install(*words)) if w.startswith("config=")]
    assert Path(config.removeprefix("config=")).parent == Path(
        pwd.getpwnam("nobody").pw_dir, ".config", "dexkit"
    )


def test_packaged_units_equal_the_written_ones() -> None:
    for side in Side:
        device = systemd_units.device_link(side)
        command = (
            *("/opt/dexkit/bin/python", "-m", "dexkit", "serve", "ezgripper", "--side", str(side)),
            *("--device", device, "--domain", "0", "--interface", "192.168.123.0/24"),
            *("--wait-for-interface", "600", "--wait-for-device", "--quiet"),
        )
        expected = unit(side, command, user="unitree", what="ezgripper")
        path = ROOT / "packaging" / "systemd" / systemd_units.unit_name(side)
        assert path.read_text(encoding="utf-8") == expected


def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd-analyze is not installed")
    _install("sim-dex1", "--side", "both", "--user", "root", "--directory", str(tmp_path))
    units = sorted(tmp_path.glob("*.service"))
    done = subprocess.run([analyze, "verify", *units], capture_output=True, text=True, check=False)
    complaints = [line for line in done.stderr.splitlines() if "dexkit-" in line]
    assert not complaints, complaints


def test_words_are_quoted_as_systemd_reads_them() -> None:
    text = unit(Side.LEFT, ["a b", "50%", "$x", 'q"\\'], user="me", what="x")
    assert 'ExecStart="a b" 50%% "$$x" "q\\"\\\\"' in text
    text = unit(
        *(Side.LEFT, ["/opt/$5", ";", "$x"]),
        user="Jo.Doe",
        what="50%n",
        groups=(),
        folder=Path("/home/a b/50%"),
        python_path='/x "y:/z$%',
    )
    lines = text.splitlines()
    assert 'ExecStart="/opt/$5" ";" "$$x"' in lines
    assert "WorkingDirectory=/home/a b/50%%" in lines
    assert 'Environment="PYTHONPATH=/x \\"y:/z$%%"' in lines
    assert "User=Jo.Doe" in lines
    assert "Description=dexkit: left hand (50%%n)" in lines
    assert "SupplementaryGroups" not in text


@each(
    "given",
    [
        {"what": "x\nExecStartPre=/bin/evil"},
        {"python_path": "/a\n"},
        {"python_path": "/a\udc80"},
        {"folder": Path("/a\nb")},
        {"folder": Path("/a ")},
        {"folder": Path("/a\\")},
        {"folder": Path("a")},
        {"user": "root\nUser=x"},
        {"user": "0"},
    ],
)
def test_what_would_be_read_as_something_else_is_not_written(given: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        unit(Side.LEFT, ["/x"], **{"user": "me", "what": "x", **given})


@pytest.mark.skipif(os.geteuid() != 0, reason="is about root")
def test_root_has_to_be_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("sim-dex1", "--side", "left", "--dry-run")
    for caller in (None, "root"):
        if caller is None:
            monkeypatch.delenv("SUDO_USER", raising=False)
        else:
            monkeypatch.setenv("SUDO_USER", caller)
        with pytest.raises(UsageError, match="would run as root") as raised:
            _install(*words)
        assert "--user NAME" in raised.value.hint
        assert "User=root\n" in _install(*words, "--user", "root")
    monkeypatch.setenv("SUDO_USER", "nobody")
    monkeypatch.setattr("dexkit.cli.install_service._load_problem", lambda *given: "")
    assert "User=nobody\n" in _install(*words)


_PLUGIN = """\
from dexkit.emulators.sim_dex1 import SimHand as Hand
"""


def test_unit_of_a_plugin_path_names_the_folder_that_it_is_loaded_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    me = pwd.getpwuid(os.geteuid()).pw_name
    module = f"hand_{tmp_path.name.replace('-', '_')}"
    words = (f"{module}:Hand", "--side", "left", "--user", me, "--dry-run")
    folder = tmp_path / "a b%"
    folder.mkdir()
    (folder / f"{module}.py").write_text(_PLUGIN)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    text = _install(*words)
    assert f"WorkingDirectory={tmp_path}/a b%%\n" in text
    assert _command(text)[:2] == command_line()  # not -m: the folder would be in front
    assert "PYTHONPATH" not in text
    # as from another folder with PYTHONPATH
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "a b%")
    assert f'Environment="PYTHONPATH={tmp_path}/a b%%"\n' in _install(*words)
    # it is loaded here, and would not be by the unit
    monkeypatch.delenv("PYTHONPATH")
    with pytest.raises(UsageError, match=f"cannot load {module}:Hand: .*{module}"):
        _install(*words)
    # anyone may put code there
    folder.chmod(0o777)
    monkeypatch.chdir(folder)
    with pytest.raises(UsageError, match="others than"):
        _install(*words)


@each(
    ("words", "said"),
    [
        (("no-such-hand", "--side", "left"), "no-such-hand"),
        (("sim-dex1", "--side", "left", "--user", "no such user"), "there is no user"),
        (("ezgripper", "--side", "both", "--device", "/dev/ttyUSB0"), "names no side"),
        (
            ("ezgripper", "--side", "left", "--device", "/dev/null", "--user", "root"),
            "no serial adapter",
        ),
        (
            ("sim-dex1", "--side", "left", "--set", "a=\n", "--user", "root"),
            "cannot be written into a systemd unit",
        ),
    ],
)
def test_backends_that_cannot_be_a_service_are_refused(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(Exception, match=said) as raised:
        _install(*words, "--dry-run")
    assert not isinstance(raised.value, OutputError)


# -- udev


def _adapter(sys_folder: Path, serial: str) -> Path:
    """An FTDI adapter as it looks in /sys; returns its device file."""
    usb = sys_folder / "devices" / "usb1" / "1-4"
    port = usb / "1-4:1.0" / "ttyUSB0"
    port.mkdir(parents=True)
    for name, text in {"idVendor": "0403", "idProduct": "6014", "serial": serial}.items():
        if text:
            (usb / name).write_text(text + "\n")
    tty = sys_folder / "class" / "tty" / "ttyUSB0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(port)
    return Path("/dev/ttyUSB0")


def test_udev_rule_gives_an_adapter_a_stable_name(tmp_path: Path) -> None:
    rule = serial_rule(Side.LEFT, _adapter(tmp_path / "a", "FT9ABC"), tmp_path / "a")
    assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014", ATTRS{serial}=="FT9ABC"' in rule
    assert 'SYMLINK+="dexkit-left"' in rule
    assert 'ATTR{latency_timer}="1"' in rule
    ignored = next(line for line in rule.splitlines() if "ID_MM_PORT_IGNORE" in line)
    assert 'ATTRS{serial}=="FT9ABC"' in ignored
    for serial in ("", 'x", RUN+="/bin/sh'):  # none, or one that would be a rule of its own
        folder = tmp_path / f"b{len(serial)}"
        rule = serial_rule(Side.RIGHT, _adapter(folder, serial), folder)
        assert 'KERNELS=="1-4"' in rule
        assert "RUN" not in rule
        assert 'SYMLINK+="dexkit-right"' in rule
    assert 'ATTR{idProduct}=="1011"' in usb_rules()


# -- notifications


@contextmanager
def _systemd(tmp_path: Path) -> Iterator[socket.socket]:
    """A socket in the place of systemd's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(tmp_path / "notify"))
        (tmp_path / "notify").chmod(0o777)
        tmp_path.chmod(0o755)
        sock.settimeout(120)
        yield sock


def _waiting(sock: socket.socket) -> bytes:
    """What has come already, or nothing."""
    try:
        return sock.recv(1000)
    except BlockingIOError:
        return b""


def _unprivileged() -> list[str]:
    """How to run a command without privileges; it may read files, as where dexkit is installed."""
    if os.geteuid() != 0:
        return []
    setpriv = shutil.which("setpriv")
    if setpriv is None:
        pytest.skip("setpriv is not installed, and the tests are run by root")
    read = "+dac_read_search"
    words = [setpriv, f"--reuid={_NOBODY}", f"--regid={_NOBODY}", "--clear-groups"]
    words += [f"--inh-caps=-all,{read}", f"--ambient-caps=-all,{read}", "--no-new-privs"]
    if subprocess.run([*words, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this system lets nobody give privileges up (setpriv)")
    return words


def test_command_line_of_a_unit_runs_unprivileged_and_reports(tmp_path: Path) -> None:
    _install(
        *("sim-dex1", "--side", "left", "--user", "root", "--directory", str(tmp_path)),
        *("--domain", str(free_domain())),
    )
    command = [*_unprivileged(), *_command((tmp_path / "dexkit-left.service").read_text())]
    environment = {
        **os.environ,
        "NOTIFY_SOCKET": str(tmp_path / "notify"),
        "WATCHDOG_USEC": "300000",
        "HOME": "/",
    }
    with (
        _systemd(tmp_path) as sock,
        subprocess.Popen(
            command, env=environment, stdout=-1, stderr=-1, text=True, cwd=ROOT
        ) as process,
    ):
        try:
            # the loop runs before all topics are there
            while (first := sock.recv(1000)) == b"WATCHDOG=1":
                pass
            assert first.startswith(b"READY=1\nSTATUS=serving rt/dex1/left/state"), first
            for _ in range(3):
                assert sock.recv(1000) == b"WATCHDOG=1"
            if os.geteuid() == 0:
                status = Path(f"/proc/{process.pid}/status").read_text()
                assert f"Uid:\t{_NOBODY}" in status
            # a loop that stands still says nothing
            process.send_signal(signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
            sock.setblocking(False)
            while _waiting(sock):
                pass
            sock.settimeout(0.3)
            with pytest.raises(TimeoutError):
                sock.recv(1000)
            sock.settimeout(120)
            process.send_signal(signal.SIGCONT)
            assert sock.recv(1000) == b"WATCHDOG=1"
            process.terminate()
            while (last := sock.recv(1000)) == b"WATCHDOG=1":
                pass
            assert last == b"STOPPING=1"
            assert process.wait(60) == 0
        finally:
            if process.poll() is None:
                process.kill()
