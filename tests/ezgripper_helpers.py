"""The EZGripper driver on emulated servos, over a pseudo-terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from dexkit.drivers.ezgripper import EZGripper, GripperSettings
from dexkit.drivers.ezgripper.control import ControlSettings
from dexkit.emulators.mx64 import EmulatedThread, emulated_ezgripper
from dexkit.errors import HandFault, HandTimeout
from dexkit.hand import HandCommand, HandState, Side
from dexkit.wire import mx64
from tests.patience import PATIENCE, StallFreeClock

ZERO = 1510
"""Where the emulated gripper's fingers are closed, by default."""
QUICK = ControlSettings(startup_speed=150.0)
LONG = PATIENCE
"""Seconds to wait for something that should take far less, on a busy machine."""

OPEN, HALF, CLOSE = (HandCommand.position(q) for q in (5.4, 2.7, 0.0))
LIMP = HandCommand.position(5.4, kp=0.0, kd=0.0)
BRAKE = HandCommand.brake(1)


@contextmanager
def emulated(**options: object) -> Iterator[EmulatedThread]:
    options.setdefault("clock", StallFreeClock())
    with emulated_ezgripper(**options) as gripper:  # type: ignore[arg-type]
        assert isinstance(gripper, EmulatedThread)
        yield gripper


def configured(tmp_path: Path, **changes: object) -> GripperSettings:
    base = GripperSettings(zero=ZERO, control=QUICK, config=tmp_path / "ezgripper.json")
    # the emulator shares the interpreter with the driver here: give it time
    return replace(base, **{"timeout": 1.0, **changes})  # type: ignore[arg-type]


@contextmanager
def gripper_on(path: str, configuration: GripperSettings) -> Iterator[EZGripper]:
    hand = EZGripper(path, Side.LEFT, configuration)
    hand.open()
    try:
        yield hand
    finally:
        hand.close()


def exchange(hand: EZGripper, command: HandCommand) -> HandState:
    """Exchange, again when this program was not let run: nothing was sent then."""
    while True:
        try:
            return hand.exchange(command)
        except HandTimeout as error:
            if "was paused" not in str(error):
                raise


def drive(
    hand: EZGripper,
    command: HandCommand,
    until: Callable[[HandState], bool],
    timeout: float = LONG,
) -> HandState:
    """Exchange until a condition holds; returns the state in which it does."""
    deadline = time.monotonic() + timeout
    while True:
        state = exchange(hand, command)
        if until(state):
            return state
        assert time.monotonic() < deadline, f"not reached: {state}, {hand.phase}"


def drive_for(hand: EZGripper, command: HandCommand, seconds: float) -> HandState:
    end = time.monotonic() + seconds
    return drive(hand, command, lambda state: time.monotonic() > end, seconds + LONG)


def at(q: float) -> Callable[[HandState], bool]:
    return lambda state: abs(float(state.q[0]) - q) < 0.06 and abs(float(state.dq[0])) < 0.05


def travel(gripper: EmulatedThread) -> int:
    """Ticks from closed, from inside the servo; below 0 where it presses into its stop."""
    ticks: int = (gripper.servo.get(mx64.PRESENT_POSITION) - ZERO + 500) % 4096 - 500
    return ticks


def fault_of(hand: EZGripper, command: HandCommand, timeout: float = LONG) -> HandFault:
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        try:
            exchange(hand, command)
        except HandFault as fault:
            return fault
    raise AssertionError("no fault was reported")


def until_recovered(hand: EZGripper, command: HandCommand, timeout: float = LONG) -> HandState:
    deadline = time.monotonic() + timeout
    while True:
        try:
            return exchange(hand, command)
        except HandFault:
            assert time.monotonic() < deadline, "did not recover"
            time.sleep(0.002)
