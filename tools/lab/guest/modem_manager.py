"""Debian's ModemManager beside a servo bus: what it does to it, and what keeps it away."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.systemd_units import device_link, serial_rule
from tools.lab.guest.adapters import Adapters
from tools.lab.guest.bench import Bench, Failed, rule, run, wait_for
from tools.lab.guest.probe import ping

__all__ = ["PROCESS", "manager", "run_modem_manager"]

PROCESS = 'SUBSYSTEM=="tty", KERNEL=="ttyUSB*", ENV{ID_MM_DEVICE_PROCESS}="1"\n'
"""Has ModemManager probe a port that it would pass over: what its versions before 1.12 did with
every port that was not listed, and what a rule on a robot may ask for."""
_PROGRAM = "/usr/sbin/ModemManager"
_START = 60.0
_DECISION = r"\[filter\].*ttyUSB"
_WATCHED = 6.0  # seconds in which it probes, and in which dexkit uses the port
_BUS = """\
<!DOCTYPE busconfig PUBLIC "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig>
  <type>system</type>
  <listen>unix:path=/run/dbus/system_bus_socket</listen>
  <policy context="default">
    <allow user="*"/><allow own="*"/>
    <allow send_destination="*"/><allow receive_sender="*"/>
  </policy>
</busconfig>
"""


class _Manager:
    """Its log."""

    def __init__(self, log: Path) -> None:
        self.log = log

    def lines(self, pattern: str) -> list[str]:
        """The lines of its log that match, without their time."""
        text = self.log.read_text(errors="replace").splitlines()
        return [re.sub(r"^.*?<\w+> *\[[0-9.]+\] *", "", x) for x in text if re.search(pattern, x)]


@contextmanager
def manager() -> Iterator[_Manager]:
    """The system bus, and ModemManager with the options of Debian's unit."""
    Path("/run/dbus").mkdir(exist_ok=True)
    configuration, log = Path("/tmp/bus.conf"), Path("/tmp/modem-manager.log")
    configuration.write_text(_BUS)
    words = ["dbus-daemon", "--nofork", "--nopidfile", f"--config-file={configuration}"]
    with log.open("wb") as out, subprocess.Popen(words) as bus:
        try:
            socket = Path("/run/dbus/system_bus_socket")
            wait_for(socket.exists, "dbus-daemon", _START)
            with subprocess.Popen([_PROGRAM, "--debug"], stdout=out, stderr=out) as process:
                try:
                    seen = _Manager(log)
                    wait_for(
                        lambda: seen.lines("service name .* was acquired") or process.poll(),
                        "ModemManager",
                        _START,
                    )
                    if process.poll() is not None:
                        raise Failed(f"ModemManager ended: {log.read_text()[-600:]}")
                    yield seen
                finally:
                    process.terminate()
        finally:
            bus.terminate()
            print("\n".join(seen.lines("ttyUSB|rror|version")[-40:]), flush=True)
            socket.unlink(missing_ok=True)


def run_modem_manager(bench: Bench, adapters: Adapters) -> None:
    """Its cases, on the MX-64's adapter, which nobody serves."""
    group = "ModemManager"
    try:
        with manager() as seen:
            for name, do in (
                ("an FTDI adapter is plugged in", _passed_over),
                ("it is told to probe the adapter", _probed),
                ("the same with the rule of dexkit install-service", _kept_away),
            ):
                bench.case(group, name, lambda do=do: do(bench, adapters, seen))  # type: ignore[misc]
    except (Failed, OSError, subprocess.SubprocessError) as error:
        reason = str(error)

        def not_started() -> str:
            raise Failed(reason)

        bench.case(group, "Debian's package starts", not_started)


def _still(bench: Bench, start: float) -> tuple[int, str]:
    """Bytes that reached the servo bus since ``start``, and the first of them.

    :raises Failed: something moved.
    """
    after = bench.ask(do="since", device="mx64", t=start)
    moved = after["high"][0] - after["low"][0]
    if moved > 0.1 or after["setpoints"]:
        raise Failed(f"it moved by {moved:.2f} %, {after['setpoints']} set-points")
    return int(after["heard"]), str(after["first"])


def _passed_over(bench: Bench, adapters: Adapters, seen: _Manager) -> str:
    start = bench.ask(do="now", device="mx64")["t"]
    path = adapters.replug("mx64")
    wait_for(lambda: seen.lines(_DECISION), "it says nothing of the port")
    heard, first = _still(bench, start)
    if heard:
        raise Failed(f"{heard} bytes on the servo bus: {first}")
    version = (seen.lines("version") or [""])[0]
    return f"{version}: {seen.lines(_DECISION)[-1]}; no byte on the bus; {ping(path)}"


def _probed(bench: Bench, adapters: Adapters, seen: _Manager) -> str:
    start = bench.ask(do="now", device="mx64")["t"]
    with rule(PROCESS):
        path = adapters.replug("mx64")
        wait_for(lambda: _still(bench, start)[0], "it does not probe")
        _, first = _still(bench, start)
        answered, failures = 0, []
        began = time.monotonic()
        while time.monotonic() - began < _WATCHED:
            try:
                ping(path)
                answered += 1
            except DexkitError as error:
                failures.append(f"{type(error).__name__}: {error.message}")
                time.sleep(0.1)
        _still(bench, start)
        adapters.unplug("mx64")  # it gives up
    path = adapters.plug("mx64")
    after = ping(path)
    return (
        f"first bytes on the bus: {first}; nothing moved; while it probes {answered} pings are "
        f"answered and {len(failures)} fail{': ' + failures[0] if failures else ''}; "
        f"plugged in again without that rule: {after}"
    )


def _kept_away(bench: Bench, adapters: Adapters, seen: _Manager) -> str:
    text = serial_rule(Side.LEFT, Path(adapters.path("mx64")))
    start = bench.ask(do="now", device="mx64")["t"]
    for rules in (PROCESS + text, text):
        lines = len(seen.lines(_DECISION))
        with rule(rules):
            path = adapters.replug("mx64")
            run("udevadm", "settle")
            wait_for(
                lambda before=lines: len(seen.lines(_DECISION)) > before,  # type: ignore[misc]
                "it says nothing of the port",
            )
            if rules != text:
                time.sleep(_WATCHED)  # it begins to probe later
        heard, first = _still(bench, start)
        if heard:
            raise Failed(f"{heard} bytes on the servo bus: {first}")
        link = os.path.realpath(device_link(Side.LEFT))
        if link != path:
            raise Failed(f"{device_link(Side.LEFT)} is {link}, not {path}")
    skipped = (seen.lines("ttyUSB.*skipping") or ["it does not say why"])[0]
    return (
        f"no byte on the bus in {_WATCHED:.0f} s although it is told to probe: {skipped}; "
        f"not told: {seen.lines(_DECISION)[-1]}; {device_link(Side.LEFT)}: {ping(path)}"
    )
