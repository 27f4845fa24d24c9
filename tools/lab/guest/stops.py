"""What stops a hand in a bring-up, and how fast: through the guest's terminal, kernel and libusb.

``dexkit bringup dex3-usb`` runs on a pseudo-terminal whose space bar is held by this program.
Times are the host's: from just after the last press, or just before a fault, until the emulated
motors are no longer driven and their joints stand (:meth:`tools.lab.devices.Record.stopped`).
"""

from __future__ import annotations

import os
import pty
import signal
import time
from collections.abc import Callable
from pathlib import Path

from tools.lab.guest.bench import Bench, Failed, wait_for
from tools.lab.guest.programs import Program

__all__ = ["run_stops"]

_RELEASES = 5
_PRESS = 0.03  # seconds between two characters of a held key
_UNDER_WAY = 0.02  # rad
_ASKED = "Which joint"  # behind a motion that went to its end
_WATCHED = 1.6  # seconds after a stop, more than the motors' own protection needs
_START = 60.0
_GAP = 0.15  # seconds without a press that are a release
_PROTECTION = 1.0  # seconds after which a motor stops by itself
_LATE = 0.1  # seconds that an emulated processor may be late


def run_stops(bench: Bench, unplug: Callable[[], None], plug: Callable[[], None]) -> None:
    """All cases.

    :param unplug: pulls the left hand's cable.
    :param plug: plugs it in again.
    """
    group = "stops"
    with _Session(bench) as held:
        bench.case(group, f"the space bar is released, {_RELEASES} times", held.releases)
        bench.case(group, "another key", held.another_key)
        bench.case(group, "Ctrl-C", held.interrupted)
    with _Session(bench) as held:
        bench.case(group, "the program is killed (SIGKILL)", held.killed)
    with _Session(bench) as held:
        bench.case(group, "the cable is pulled", lambda: held.unplugged(unplug))
    plug()


class _Session:
    """A bring-up of the left hand, and who sits at its terminal."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._keyboard, self._terminal = pty.openpty()
        self._answered = 0
        config = Path("/tmp/bringup.json")
        config.unlink(missing_ok=True)
        words = ("--side", "left", "--set", "usb=system", "--set", f"config={config}")
        patient = ("--set", "timeout=1", "--set", "send_timeout=1")
        self._program = Program(
            "bringup", "dex3-usb", *words, *patient, terminal=os.ttyname(self._terminal)
        )

    def __enter__(self) -> _Session:
        return self

    def __exit__(self, *exc: object) -> None:
        self._program.close(_START)
        print(self._program.text(), flush=True)
        os.close(self._keyboard)
        os.close(self._terminal)

    def _press(self) -> None:
        os.write(self._keyboard, b" ")

    def _moving(self) -> None:
        """Hold the space bar until a joint is under way."""
        wait_for(
            lambda: "hold SPACE" in self._program.text() or self._program.code is not None,
            "the bring-up asks for no key",
            _START,
        )
        ask = self._bench.ask
        start = ask(do="now", device="left")["q"]
        end = time.monotonic() + _START
        while True:
            if self._program.text().count(_ASKED) > self._answered:
                self._answered += 1
                os.write(self._keyboard, b"again\n")
            self._press()
            time.sleep(_PRESS)
            now = ask(do="now", device="left")["q"]
            if max(abs(q - was) for q, was in zip(now, start, strict=True)) > _UNDER_WAY:
                return
            if time.monotonic() > end or self._program.code is not None:
                raise Failed(f"nothing moves: {self._program.text()[-600:]}")

    def _stop(self, how: Callable[[], object]) -> tuple[float, float]:
        """Have the hand move, then stop it: seconds until it stands, and is driven no longer."""
        self._moving()
        self._press()
        at = self._bench.ask(do="now", device="left")["t"]
        how()
        time.sleep(_WATCHED)
        seen = self._bench.ask(do="stopped", device="left", t=at)
        if seen["released"] is None:
            raise Failed(f"a motor is driven {_WATCHED} s later")
        if seen["still"] > seen["released"] + _LATE:
            raise Failed(f"it moves for {seen['still']:.2f} s, driven for {seen['released']:.2f} s")
        return seen["still"], seen["released"]

    def releases(self) -> str:
        """Release the space bar some times: within the gap and a frame of 10 ms."""
        found = [self._stop(lambda: None) for _ in range(_RELEASES)]
        return _said(found)

    def another_key(self) -> str:
        """Press another key."""
        return _said([self._stop(lambda: os.write(self._keyboard, b"x"))])

    def interrupted(self) -> str:
        """Ctrl-C."""
        found = self._stop(lambda: os.write(self._keyboard, b"\x03"))
        return f"{_said([found])}; code {self._program.wait(_START)}"

    def killed(self) -> str:
        """SIGKILL: the motor's own protection."""
        found = self._stop(lambda: self._program.signal(signal.SIGKILL))
        return self._protected(found)

    def unplugged(self, unplug: Callable[[], None]) -> str:
        """No cable: the motor's own protection, and the error of the program."""
        found = self._stop(unplug)
        code = self._program.wait(_START)
        said = self._program.text().strip().splitlines()[-2:]
        return f"{self._protected(found)}; code {code}: {' '.join(said)}"

    def _protected(self, found: tuple[float, float]) -> str:
        if not found[1] > _GAP:
            raise Failed(f"released after {found[1]:.2f} s: the protection takes {_PROTECTION} s")
        return _said([found])


def _said(found: list[tuple[float, float]]) -> str:
    still, released = (sorted(values) for values in zip(*found, strict=True))

    def spread(values: list[float]) -> str:
        return "/".join(f"{value:.3f}" for value in values)

    return (
        f"no motor is driven after {spread(released)} s; the joint stands after {spread(still)} s"
    )
