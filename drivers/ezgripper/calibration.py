"""Calibration: the zero (where the gripper is closed) and the speed of either direction.

The zero is found by closing at reduced current until the fingers stop
(docs/sources/mx64-ezgripper.md#d4). A servo alone cannot tell closed fingers from fingers on an
object, nor from fingers that are stuck, so the stop is believed only if the gripper then opens by
its whole stroke. Even so an object can deceive it where the fingers open wider than the stroke: the
gripper must be empty.

The speed is measured as in the note on predictive state over the full stroke at full effort, but
between 10 % and 90 % of it and from positions with their times, so that neither the command's way
nor the settling is counted (docs/sources/mx64-ezgripper.md#d10-6,
docs/sources/mx64-ezgripper.md#d10-7).

Pure logic over a :class:`Drive` and a clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from dexkit.drivers.ezgripper.block import Goal, Sample
from dexkit.drivers.ezgripper.contact import ContactDetector
from dexkit.drivers.ezgripper.control import at_once
from dexkit.drivers.ezgripper.recovery import describe
from dexkit.drivers.ezgripper.scaling import (
    STROKE,
    TICKS_PER_PERCENT,
    current_of_effort,
    profile_velocity,
    relative_position,
)
from dexkit.errors import HandError
from dexkit.wire import mx64

__all__ = [
    "CalibrationFailed",
    "Drive",
    "SpeedResult",
    "find_zero",
    "measure_current",
    "measure_speed",
    "move",
]

EFFORT = 30.0
"""Percent, while looking for the closed position (docs/sources/mx64-ezgripper.md#d2,
docs/sources/mx64-ezgripper.md#d4)."""
SPEED = 60.0
"""Percent of stroke a second, while looking for it."""
UNLIMITED = 600.0
"""Percent of stroke a second that no motor of this kind reaches
(docs/sources/mx64-ezgripper.md#d1)."""
_BEYOND = 1500
"""Ticks that are closed beyond one stroke before the search is given up: the gripper may
stand open wider than its stroke."""
_OPENED = 50
"""Ticks (2 %) short of the full stroke at which opening still counts as whole."""

Progress = Callable[[str], None]
Cancelled = Callable[[], bool]


class CalibrationFailed(HandError):
    """No trustworthy zero or speed was found. The motor is left without current."""


class Drive(Protocol):
    """What calibration needs of a servo."""

    def exchange(self, goal: Goal) -> Sample:
        """Write a goal, read a sample."""
        ...

    def sample(self) -> Sample:
        """Read a sample."""
        ...

    def engage(self, goal: Goal) -> None:
        """Switch the motor on with ``goal`` in its registers."""
        ...


@dataclass(frozen=True)
class Track:
    """A motion that was made: samples in order, and whether it was stopped short of its goal."""

    samples: tuple[Sample, ...]
    stopped: bool

    @property
    def end(self) -> Sample:
        """The last sample."""
        return self.samples[-1]


@dataclass(frozen=True)
class SpeedResult:
    """Average speeds, percent of stroke a second, and the single runs behind them."""

    opening: float
    closing: float
    runs: tuple[tuple[float, float], ...]


def _no_progress(text: str) -> None:
    pass


def _never() -> bool:
    return False


def _check(sample: Sample) -> None:
    if sample.error & ~mx64.HardwareError.INPUT_VOLTAGE:
        raise CalibrationFailed(
            f"the servo reports {describe(sample.error)} during calibration",
            hint="let it cool down, free the fingers, and try again",
        )
    if not sample.torque:
        raise CalibrationFailed("the servo's torque went off during calibration")


def move(
    drive: Drive,
    position: int,
    *,
    effort: float,
    speed: float,
    timeout: float,
    cancelled: Cancelled = _never,
) -> Track:
    """Move to an absolute position, until it is reached or the fingers stop.

    :param position: ticks in the servo's present count.
    :raises CalibrationFailed: neither happens within ``timeout`` seconds, the servo reports an
        error, or ``cancelled`` says so. The motor then carries no current.
    """
    goal = Goal(position, current_of_effort(effort), profile_velocity(speed))
    first = drive.sample()
    limp = Goal(first.position, 0, goal.profile_velocity)
    detector = ContactDetector()
    samples: list[Sample] = []
    settled: float | None = None
    try:
        if not first.torque:
            drive.engage(at_once(first.position, goal.current))
        else:
            drive.exchange(at_once(first.position, goal.current))
        while True:
            sample = drive.exchange(goal)
            _check(sample)
            samples.append(sample)
            if cancelled():
                raise CalibrationFailed("interrupted")
            if detector.update(sample.time, sample.position, position):
                return Track(tuple(samples), stopped=True)
            if abs(sample.position - position) > detector.outstanding:
                settled = None
            elif settled is None:
                settled = sample.time
            elif sample.time - settled >= detector.window:
                return Track(tuple(samples), stopped=False)
            if sample.time - samples[0].time > timeout:
                raise CalibrationFailed(
                    f"the fingers have been moving for {timeout:g} s without coming to a stop"
                )
    except BaseException:
        # limp, whatever happened; if even that cannot be said, the bus watchdog stops the motor
        try:
            drive.exchange(limp)
        except HandError:
            pass
        raise


def _timeout(ticks: float, speed: float) -> float:
    return 2.0 + 3.0 * ticks / (speed * TICKS_PER_PERCENT)


def find_zero(
    drive: Drive,
    *,
    effort: float = EFFORT,
    speed: float = SPEED,
    progress: Progress = _no_progress,
    cancelled: Cancelled = _never,
) -> int:
    """Close, find the stop, open by a whole stroke; returns the zero within the turn, ticks.

    The gripper must be empty. It is left open.

    :raises CalibrationFailed: there is no stop, or the gripper does not open by its stroke.
    """
    start = drive.sample().position
    reach = STROKE + _BEYOND
    progress(f"closing at {effort:g} % effort")
    closing = move(
        drive,
        start + mx64.EZGRIPPER_CLOSING * reach,
        effort=effort,
        speed=speed,
        timeout=_timeout(reach, speed),
        cancelled=cancelled,
    )
    if not closing.stopped:
        _release(drive, closing.end)
        raise CalibrationFailed(
            f"the servo turned {reach} ticks closing and met no stop",
            hint="are the tendons attached?",
        )
    zero = closing.end.position
    progress(f"stopped after {abs(zero - start) / TICKS_PER_PERCENT:.0f} % of the stroke; opening")
    opening = move(
        drive,
        zero - mx64.EZGRIPPER_CLOSING * STROKE,
        effort=effort,
        speed=speed,
        timeout=_timeout(STROKE, speed),
        cancelled=cancelled,
    )
    travel = abs(opening.end.position - zero)
    if travel < STROKE - _OPENED:
        _release(drive, opening.end)
        raise CalibrationFailed(
            f"the gripper opens only {travel / TICKS_PER_PERCENT:.0f} % of its stroke from where "
            "it stopped closing",
            hint="take out what it holds, free the fingers, and try again",
        )
    return zero % mx64.TICKS_PER_TURN


def _release(drive: Drive, sample: Sample) -> None:
    drive.exchange(Goal(sample.position, 0, 1))


def measure_speed(
    drive: Drive,
    zero: int,
    *,
    effort: float = 100.0,
    runs: int = 3,
    progress: Progress = _no_progress,
    cancelled: Cancelled = _never,
) -> SpeedResult:
    """Run the full stroke ``runs`` times each way; returns the average speeds.

    :param zero: in any turn.
    :raises CalibrationFailed: the fingers do not make the whole stroke.
    """
    results: list[tuple[float, float]] = []
    _stroke(drive, zero, 0, effort=EFFORT, speed=SPEED, cancelled=cancelled)
    for run in range(runs):
        opening = _timed(drive, zero, STROKE, effort, cancelled)
        closing = _timed(drive, zero, 0, effort, cancelled)
        results.append((opening, closing))
        progress(f"run {run + 1} of {runs}: opens {opening:.0f} %/s, closes {closing:.0f} %/s")
    return SpeedResult(
        opening=sum(o for o, _ in results) / runs,
        closing=sum(c for _, c in results) / runs,
        runs=tuple(results),
    )


def _stroke(
    drive: Drive, zero: int, target: int, *, effort: float, speed: float, cancelled: Cancelled
) -> Track:
    present = drive.sample().position
    base = present - relative_position(present, zero)
    track = move(
        drive,
        base + target,
        effort=effort,
        speed=speed,
        timeout=10.0,
        cancelled=cancelled,
    )
    if abs(track.end.position - base - target) > _OPENED:
        _release(drive, track.end)
        raise CalibrationFailed(
            f"the fingers stopped at {(track.end.position - base) / TICKS_PER_PERCENT:.0f} % on "
            f"the way to {target / TICKS_PER_PERCENT:.0f} %",
            hint="free the fingers and try again",
        )
    return track


def _timed(drive: Drive, zero: int, target: int, effort: float, cancelled: Cancelled) -> float:
    # beyond the motor: the profile does not limit
    track = _stroke(drive, zero, target, effort=effort, speed=UNLIMITED, cancelled=cancelled)
    points = [(s.time, relative_position(s.position, zero)) for s in track.samples]
    if target == 0:
        points = [(t, STROKE - p) for t, p in points]
    low, high = 0.1 * STROKE, 0.9 * STROKE
    elapsed = _crossing(points, high) - _crossing(points, low)
    if elapsed <= 0:
        raise CalibrationFailed("too few samples to measure a speed", hint="see the latency timer")
    return (high - low) / TICKS_PER_PERCENT / elapsed


def _crossing(points: list[tuple[float, int]], level: float) -> float:
    for (t0, p0), (t1, p1) in pairwise(points):
        if p0 < level <= p1:
            return t0 + (t1 - t0) * (level - p0) / (p1 - p0)
    raise CalibrationFailed(f"the stroke did not pass {level / TICKS_PER_PERCENT:.0f} %")


def measure_current(
    drive: Drive,
    zero: int,
    effort: float,
    holding: Callable[[float], bool],
    *,
    settle: float = 0.5,
    average: float = 0.3,
    cancelled: Cancelled = _never,
) -> float:
    """Squeeze what is between the fingers; returns the mean motor current, units.

    :param holding: called with the mean current as soon as it is known and from then on in
        every cycle, to hold on while somebody reads the gauge: True holds, False ends. It must
        not block: the servo's watchdog stops a grip that nobody looks after.
    :raises CalibrationFailed: there is nothing between the fingers.
    """
    present = drive.sample().position
    base = present - relative_position(present, zero)
    track = move(
        drive,
        base,
        effort=effort,
        speed=SPEED,
        timeout=_timeout(STROKE, SPEED),
        cancelled=cancelled,
    )
    if not track.stopped:
        _release(drive, track.end)
        raise CalibrationFailed(
            "the gripper closed without meeting anything",
            hint="put the gauge between the fingers",
        )
    goal = Goal(base, current_of_effort(effort), profile_velocity(SPEED))
    started = track.end.time
    currents: list[int] = []
    while True:
        sample = drive.exchange(goal)
        _check(sample)
        if cancelled():
            _release(drive, sample)
            raise CalibrationFailed("interrupted")
        held = sample.time - started
        if settle <= held < settle + average:
            currents.append(abs(sample.current))
        elif held >= settle + average:
            mean = sum(currents) / len(currents) if currents else abs(sample.current)
            if not holding(mean):
                return float(mean)
