"""Calibrate the EZGripper: the zero (closed position) and the speeds of opening and closing.

The zero is found by closing at reduced current until the fingers stop
(docs/sources/mx64-ezgripper.md#d4). The stop may be an object or a jam instead of closed fingers,
so it is accepted only if the gripper then opens by its whole stroke. An object is not detected if
the fingers can open wider than the stroke, so the gripper must be empty.

The speed is measured over the full stroke at full effort (docs/sources/mx64-ezgripper.md#d8-3), but
from timed positions between 10 % and 90 %, which excludes command latency and settling
(docs/sources/mx64-ezgripper.md#d10-6, docs/sources/mx64-ezgripper.md#d10-7).

No I/O of its own: it works on a :class:`Drive` and a clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from dexkit.drivers.ezgripper.contact import ContactDetector
from dexkit.drivers.ezgripper.control import without_profile
from dexkit.drivers.ezgripper.recovery import describe
from dexkit.drivers.ezgripper.register_block import Goal, Sample
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
    "DISTANCES",
    "CalibrationFailed",
    "DistanceResult",
    "Drive",
    "SpeedResult",
    "find_zero",
    "measure_current",
    "measure_distances",
    "measure_speed",
    "move",
]

EFFORT = 30.0
"""Percent, while closing to find the zero (docs/sources/mx64-ezgripper.md#d2,
docs/sources/mx64-ezgripper.md#d4)."""
SPEED = 60.0
"""Percent of stroke a second, while closing to find the zero."""
UNLIMITED = 600.0
"""Percent of stroke a second, faster than the motor can be
(docs/sources/mx64-ezgripper.md#d1)."""
_FULL_EFFORT = 100.0
"""Percent, while speeds are measured."""
_SETTLE, _AVERAGE = 0.5, 0.3
"""Seconds of holding until the current has settled, and in which it is averaged."""
_SEARCH_MARGIN = 1500
"""Ticks beyond one stroke after which the search ends without a stop: the gripper may start open
wider than its stroke."""
_LATE_ANSWER = 0.03
"""Seconds, more than an adapter's latency timer takes: when a later answer was measured is not
known well enough for a speed."""
_TRIES = 5
"""How often a run is made whose answers come late, as on a busy machine."""
_OPEN_TOLERANCE = 50
"""Ticks (2 %) short of the full stroke at which opening still counts as complete."""

Progress = Callable[[str], None]
Cancelled = Callable[[], bool]


class CalibrationFailed(HandError):
    """No zero or speed could be measured. The motor is left without current."""


class Drive(Protocol):
    """The servo operations that calibration uses."""

    def exchange(self, goal: Goal) -> Sample:
        """Write a goal and read a sample."""
        ...

    def sample(self) -> Sample:
        """Read a sample."""
        ...

    def engage(self, goal: Goal) -> None:
        """Switch the motor on with ``goal`` in its registers."""
        ...

    def rearm_watchdog(self) -> None:
        """Clear a tripped bus watchdog, so that the servo accepts goals; it holds its position."""
        ...


@dataclass(frozen=True)
class Track:
    """Samples of one motion, and whether the fingers stopped before the goal."""

    samples: tuple[Sample, ...]
    stopped: bool

    @property
    def end(self) -> Sample:
        """The last sample."""
        return self.samples[-1]


@dataclass(frozen=True)
class SpeedResult:
    """Average speeds, percent of stroke a second, and those of each run."""

    opening: float
    closing: float
    runs: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class DistanceResult:
    """Durations of moves over several distances in one direction.

    :param speed: of the moves, percent of stroke a second.
    :param overhead: seconds that each move takes besides its distance over the speed: answer,
        acceleration, and coming to rest.
    :param times: (percent of stroke, seconds) of each move.
    """

    speed: float
    overhead: float
    times: tuple[tuple[float, float], ...]


def _ignore_progress(text: str) -> None:
    pass


def _never_cancelled() -> bool:
    return False


def _check(sample: Sample) -> None:
    if sample.error & ~mx64.HardwareError.INPUT_VOLTAGE:
        raise CalibrationFailed(
            f"the servo reports {describe(sample.error)} during calibration",
            hint="let it cool down, free the fingers, and try again",
        )
    if not sample.torque:
        raise CalibrationFailed(
            "the servo switched its torque off during calibration",
            hint="does another program use the servo, or did its supply drop out? See to it, and "
            "try again",
        )
    if sample.watchdog == mx64.WATCHDOG_TRIPPED:
        # it stands where it was stopped, which must not be taken for an end of the stroke
        raise CalibrationFailed(
            "no instruction reached the servo for too long, and its bus watchdog stopped it",
            hint="this machine or the adapter paused; try again when it is less busy",
        )


def move(
    drive: Drive,
    position: int,
    *,
    effort: float,
    speed: float,
    timeout: float,
    cancelled: Cancelled = _never_cancelled,
) -> Track:
    """Move to an absolute position until it is reached or the fingers stop.

    :param position: ticks in the servo's present multi-turn count.
    :raises CalibrationFailed: neither happens within ``timeout`` seconds, the servo reports an
        error, or ``cancelled`` returns True. The motor then carries no current.
    """
    goal = Goal(position, current_of_effort(effort), profile_velocity(speed))
    first = drive.sample()
    limp = Goal(first.position, 0, goal.profile_velocity)
    detector = ContactDetector()
    samples: list[Sample] = []
    settled: float | None = None
    try:
        if not first.torque:
            drive.engage(without_profile(first.position, goal.current))
        else:
            drive.exchange(without_profile(first.position, goal.current))
        while True:
            sample = drive.exchange(goal)
            samples.append(sample)
            _check(sample)
            if cancelled():
                raise CalibrationFailed("interrupted")
            if detector.update(sample.time, sample.position, position, received=sample.received):
                return Track(tuple(samples), stopped=True)
            if abs(sample.position - position) > detector.outstanding:
                settled = None
            elif settled is None:
                settled = sample.received
            elif sample.time - settled >= detector.window:
                return Track(tuple(samples), stopped=False)
            if sample.time - samples[0].time > timeout:
                raise CalibrationFailed(
                    f"the fingers neither stopped nor reached the goal within {timeout:g} s",
                    hint="does the servo turn without moving the fingers, or do they creep? Check "
                    "tendons and supply, and try again",
                )
    except BaseException:
        # limp after any failure; if this write fails, too, the bus watchdog stops the motor
        try:
            if samples and samples[-1].watchdog == mx64.WATCHDOG_TRIPPED:
                drive.rearm_watchdog()  # until then it refuses goals
            drive.exchange(limp)
        except HandError:
            pass
        raise


def _timeout(ticks: float, speed: float) -> float:
    return 2.0 + 3.0 * ticks / (speed * TICKS_PER_PERCENT)


def find_zero(
    drive: Drive,
    *,
    stroke: int = STROKE,
    effort: float = EFFORT,
    progress: Progress = _ignore_progress,
    cancelled: Cancelled = _never_cancelled,
) -> int:
    """Close to the stop, open by a whole stroke; return the zero within one turn, ticks.

    The gripper must be empty. It is left open.

    :param stroke: ticks from closed to open, here and below.

    :raises CalibrationFailed: there is no stop, or the gripper does not open by its stroke.
    """
    start = drive.sample().position
    reach = stroke + _SEARCH_MARGIN
    progress(f"closing at {effort:g} % effort")
    closing = move(
        drive,
        start + mx64.EZGRIPPER_CLOSING * reach,
        effort=effort,
        speed=SPEED,
        timeout=_timeout(reach, SPEED),
        cancelled=cancelled,
    )
    if not closing.stopped:
        _stop_current(drive, closing.end)
        raise CalibrationFailed(
            f"the servo turned {reach} ticks closing and reached no stop",
            hint="are the tendons attached?",
        )
    zero = closing.end.position
    progress(f"stopped after {100 * abs(zero - start) / stroke:.0f} % of the stroke; opening")
    opening = move(
        drive,
        zero - mx64.EZGRIPPER_CLOSING * stroke,
        effort=effort,
        speed=SPEED,
        timeout=_timeout(stroke, SPEED),
        cancelled=cancelled,
    )
    travel = abs(opening.end.position - zero)
    if travel < stroke - _OPEN_TOLERANCE:
        _stop_current(drive, opening.end)
        raise CalibrationFailed(
            f"the gripper opens only {100 * travel / stroke:.0f} % of its stroke from where "
            "it stopped closing",
            hint="take out what it holds, free the fingers, and try again",
        )
    return zero % mx64.TICKS_PER_TURN


def _stop_current(drive: Drive, sample: Sample) -> None:
    drive.exchange(Goal(sample.position, 0, 1))


def measure_speed(
    drive: Drive,
    zero: int,
    *,
    stroke: int = STROKE,
    runs: int = 3,
    progress: Progress = _ignore_progress,
    cancelled: Cancelled = _never_cancelled,
) -> SpeedResult:
    """Run the full stroke ``runs`` times in each direction; return the average speeds.

    :param zero: ticks, in any turn.
    :raises CalibrationFailed: the fingers do not complete the stroke, or answers come late in
        every try of a run.
    """
    results: list[tuple[float, float]] = []
    _stroke(drive, zero, 0, effort=EFFORT, speed=SPEED, cancelled=cancelled)
    for run in range(runs):
        number = f"run {run + 1} of {runs}"
        for _ in range(_TRIES):
            opening = _measure_run(drive, zero, stroke, cancelled, stroke)
            closing = _measure_run(drive, zero, 0, cancelled, stroke)
            if opening is not None and closing is not None:
                break
            progress(f"{number}: answers came late, once more")
        else:
            raise CalibrationFailed(
                "too few samples to measure a speed",
                hint="set the adapter's latency timer to 1 ms (docs/ezgripper.md), and stop other "
                "programs on this machine",
            )
        results.append((opening, closing))
        progress(f"{number}: opens {opening:.0f} %/s, closes {closing:.0f} %/s")
    return SpeedResult(
        opening=sum(o for o, _ in results) / runs,
        closing=sum(c for _, c in results) / runs,
        runs=tuple(results),
    )


DISTANCES = (20.0, 40.0, 60.0, 80.0, 100.0)
"""Percent of stroke of the moves by which the overhead of a move is measured."""


def measure_distances(
    drive: Drive,
    zero: int,
    *,
    stroke: int = STROKE,
    progress: Progress = _ignore_progress,
    cancelled: Cancelled = _never_cancelled,
) -> tuple[DistanceResult, DistanceResult]:
    """Time moves over several distances; return the results for opening and for closing.

    The overhead is where the straight line through times over distances meets distance 0
    (docs/sources/mx64-ezgripper.md#d8-3). A move lasts from its command until the fingers
    are within a percent of the goal.

    :param zero: ticks, in any turn.
    :raises CalibrationFailed: the fingers do not complete a move.
    """
    opening: list[tuple[float, float]] = []
    closing: list[tuple[float, float]] = []
    _stroke(drive, zero, 0, effort=EFFORT, speed=SPEED, cancelled=cancelled)
    for percent in DISTANCES:
        goal = round(percent * stroke / 100)
        for target, found in ((goal, opening), (0, closing)):
            track = _stroke(
                drive, zero, target, effort=_FULL_EFFORT, speed=UNLIMITED, cancelled=cancelled
            )
            found.append((percent, _arrival(track, zero, target)))
        progress(
            f"{percent:g} %: opens in {opening[-1][1]:.3f} s, closes in {closing[-1][1]:.3f} s"
        )
    return _line(opening), _line(closing)


def _arrival(track: Track, zero: int, target: int) -> float:
    """Seconds from the first exchange of a move until it is within a percent of its goal."""
    begin = track.samples[0].time
    for sample in track.samples:
        if abs(relative_position(sample.position, zero) - target) <= TICKS_PER_PERCENT:
            return sample.time - begin
    return track.end.time - begin


def _line(times: Sequence[tuple[float, float]]) -> DistanceResult:
    """The line through (percent, seconds), by least squares."""
    n = len(times)
    mean_x, mean_y = (sum(column) / n for column in zip(*times, strict=True))
    spread = sum((x - mean_x) ** 2 for x, _ in times)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in times) / spread if spread else 0.0
    if slope <= 0:
        raise CalibrationFailed(
            "the time of a move does not grow with its distance",
            hint="give several distances; try again",
        )
    return DistanceResult(1.0 / slope, mean_y - slope * mean_x, tuple(times))


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
    if abs(track.end.position - base - target) > _OPEN_TOLERANCE:
        _stop_current(drive, track.end)
        raise CalibrationFailed(
            f"the fingers stopped at {(track.end.position - base) / TICKS_PER_PERCENT:.0f} % on "
            f"the way to {target / TICKS_PER_PERCENT:.0f} %",
            hint="free the fingers and try again",
        )
    return track


def _measure_run(
    drive: Drive, zero: int, target: int, cancelled: Cancelled, stroke: int
) -> float | None:
    """Percent of stroke a second; None where the answers near 10 or 90 % came late."""
    # faster than the motor, so the profile does not limit the speed
    track = _stroke(drive, zero, target, effort=_FULL_EFFORT, speed=UNLIMITED, cancelled=cancelled)
    points = [
        (s.time, relative_position(s.position, zero))
        for s in track.samples
        if s.received - s.time < _LATE_ANSWER
    ]
    if target == 0:
        points = [(t, stroke - p) for t, p in points]
    low, high = 0.1 * stroke, 0.9 * stroke
    begin, end = (_crossing_time(points, level) for level in (low, high))
    if begin is None or end is None or end <= begin:
        return None
    return 100 * (high - low) / stroke / (end - begin)


def _crossing_time(points: list[tuple[float, int]], level: float) -> float | None:
    for (t0, p0), (t1, p1) in pairwise(points):
        if p0 < level <= p1:
            return t0 + (t1 - t0) * (level - p0) / (p1 - p0)
    return None


def measure_current(
    drive: Drive,
    zero: int,
    effort: float,
    holding: Callable[[float], bool],
    *,
    cancelled: Cancelled = _never_cancelled,
) -> float:
    """Close on the gauge between the fingers; return the mean motor current, units of 3.36 mA.

    :param holding: called in every cycle with the mean current, once it is known, while the user
        reads the gauge: True goes on holding, False ends. It must not block: the servo's bus
        watchdog stops the motor when exchanges cease.
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
        _stop_current(drive, track.end)
        raise CalibrationFailed(
            "the gripper closed without touching anything",
            hint="put the gauge between the fingers",
        )
    goal = Goal(base, current_of_effort(effort), profile_velocity(SPEED))
    started = track.end.time
    currents: list[int] = []
    while True:
        sample = drive.exchange(goal)
        _check(sample)
        if cancelled():
            _stop_current(drive, sample)
            raise CalibrationFailed("interrupted")
        held = sample.time - started
        if _SETTLE <= held < _SETTLE + _AVERAGE:
            currents.append(abs(sample.current))
        elif held >= _SETTLE + _AVERAGE:
            mean = sum(currents) / len(currents) if currents else abs(sample.current)
            if not holding(mean):
                return float(mean)
