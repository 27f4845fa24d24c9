"""The order of the tests: at rest, each joint a little, each joint thoroughly, touch.

A joint that does not move, moves the wrong way or moves another joint in a small slow test is not
driven any more: nothing faster happens before that test.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from dexkit.conformance.selftest.joint_motion import SETTLE, Bench, Series, Setup, Turns
from dexkit.hand import Floats, HandCommand, HandState, JointSpec
from dexkit.models import model

__all__ = ["ElementFound", "Found", "JointFound", "Procedure"]

_STILL = 1.0  # seconds at rest, for noise
_NUDGE = 0.08  # part of the stroke
_ALIVE = 0.35  # part of that by which a joint has moved
_STAYS = 0.05  # part of the stroke by which a joint that is told to stay may move
_RUN = (0.05, 0.95)  # parts of the range between which speeds are tried
_FIT = (0.35, 0.65)  # and between which they are measured
_FEWEST = 3  # samples between these
_LEVELS = (
    0.25,
    0.5,
    1.0,
)  # of the speed that is allowed: a faster run only after a good slower one
_KEPT = 0.8  # part of the speed asked for that a joint reaches
_OVERSHOT = 0.05  # part of the stroke beyond a goal
_GAP = 2.5  # periods between two samples at most, while a speed is measured
_PRESSED = 500.0  # Pa, or ...
_SIGMAS = 8.0  # ... times the noise, from rest: an element that is pressed
_TOUCH_PATIENCE = 60.0  # seconds without a new element


@dataclass(eq=False)
class JointFound:
    """Findings about a joint; NaN where it was not measured.

    :ivar figures: by name: ``range``, ``speed+``, ``speed-``.
    :ivar moves: names of the joints that move when it is commanded.
    :ivar notes: what a reader has to know about its figures.
    :ivar curves: by name.
    """

    name: str
    alive: bool = True
    sign: int = 1
    moves: tuple[str, ...] = ()
    nudged: bool = False
    figures: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    curves: dict[str, Series] = field(default_factory=dict)


@dataclass(eq=False)
class ElementFound:
    """Findings about a tactile element.

    :ivar rest: Pa while nothing was touched; ``noise`` its standard deviation; NaN: no value.
    :ivar peak: furthest from rest while it was pressed; NaN if it was not tested.
    """

    packet: int
    slot: int
    place: str
    rest: float = math.nan
    noise: float = math.nan
    peak: float = math.nan
    answered: bool | None = None


@dataclass(eq=False)
class Found:
    """Findings of a self-test so far.

    :ivar touched: the elements were tried.
    """

    joints: list[JointFound]
    elements: list[ElementFound] = field(default_factory=list)
    touched: bool = False
    asked_speed: Floats = field(default_factory=lambda: np.empty(0))


class Procedure:
    """The tests of a hand.

    :param joints: indices of those to be tested; None for all.
    :param speed: part of the full speed that is tried at most.
    :param touch: ask somebody to press the tactile elements.
    :ivar doing: what it does now; ``part`` how much of it all is done, 0 to 1.
    :ivar question: what somebody is to do, or empty; :meth:`skip` gives up on it.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        joints: Sequence[int] | None = None,
        speed: float = 0.25,
        touch: bool = False,
    ) -> None:
        self.setup, self.speed = setup, speed
        self.bench = Bench(setup)
        self.chosen = tuple(range(setup.spec.n_joints)) if joints is None else tuple(joints)
        self.profile = model(setup.spec.model)
        self.touch = touch and bool(self.profile.sensors)
        self.found = Found(
            [JointFound(joint.name) for joint in setup.spec.joints],
            asked_speed=speed * setup.full,
        )
        self.doing, self.part, self.question = "at rest", 0.0, ""
        self._skipped = False

    def skip(self) -> None:
        """Continue without the action that :attr:`question` requests."""
        self._skipped = True

    def run(self) -> Generator[HandCommand, HandState, None]:
        """Everything; yields commands and is sent states."""
        still = yield from self.bench.watch(_STILL)
        self._at_rest(still)
        everything = set(range(self.setup.spec.n_joints))
        for j in self.chosen:
            self._report_progress(f"{self._joint(j).name}: which joint moves, and which way", 0.0)
            # the others brake: one that turns the wrong way would run off while it is held
            self.bench.limp = everything - {j}
            yield from self._nudge(j)
        self.bench.limp = {j for j in everything if not self._usable(j)}
        yield from self._open()
        live = [j for j in self.chosen if self._usable(j)]
        for k, j in enumerate(live):
            yield from self._thoroughly(j, k, len(live))
        if self.touch:
            yield from self._feel()
        self._report_progress("at rest", 1.0)

    def _report_progress(self, doing: str, part: float) -> None:
        self.doing, self.part = doing, part

    def _usable(self, j: int) -> bool:
        """Whether a joint was tested and works."""
        return self.found.joints[j].nudged and self.found.joints[j].alive

    def _joint(self, j: int) -> JointSpec:
        return self.setup.spec.joints[j]

    def _open_q(self, j: int) -> float:
        """Waiting position of a joint: open, or mid-range if neither end is open."""
        spec = self._joint(j)
        return spec.straight if spec.closing else (spec.q_min + spec.q_max) / 2

    def _at(self, j: int, part: float) -> float:
        """The place in a joint's range, 0 lower to 1 upper end."""
        spec = self._joint(j)
        return spec.q_min + part * spec.stroke

    # -- at rest ---------------------------------------------------------------------------------

    def _at_rest(self, states: Sequence[HandState]) -> None:
        q = np.array([s.q for s in states])
        self.bench.noise[:] = q.std(axis=0)
        pressures = [s.pressure for s in states if s.pressure is not None]
        values = np.array(pressures) if pressures else None
        for packet, sensor in enumerate(self.profile.sensors):
            for slot in sensor.slots:
                element = ElementFound(packet, slot, sensor.place)
                if values is not None:
                    column = values[:, packet, slot]
                    element.rest, element.noise = float(column.mean()), float(column.std())
                self.found.elements.append(element)

    def _open(self) -> Turns[None]:
        """Open the hand slowly, finger by finger, so that no joint is in another's way."""
        self._report_progress("opening the hand", 0.0)
        for j in range(self.setup.spec.n_joints):
            if self._usable(j):
                yield from self.bench.move(j, self._open_q(j), float(self.bench.slow[j]))

    # -- which joint, which way ------------------------------------------------------------------

    def _nudge(self, j: int) -> Turns[None]:
        bench, joint, spec = self.bench, self.found.joints[j], self._joint(j)
        assert bench.state is not None
        q = float(bench.state.q[j])
        direction = 1 if spec.q_max - q > q - spec.q_min else -1
        way = _NUDGE * spec.stroke
        slow = float(bench.slow[j])
        begin = max(bench.mark - 1, 0)
        if not (yield from bench.stays(j, _STAYS * spec.stroke)):
            joint.nudged, joint.alive, joint.sign = True, False, -1
            return
        moved = yield from bench.move(j, q + direction * way, slow, settle=True)
        by = bench.moved(begin)
        joint.nudged = True
        shared = next((set(m) for m in self.profile.motors if j in m), {j})
        strokes = self.setup.stroke
        joint.moves = tuple(
            other.name
            for k, other in enumerate(self.setup.spec.joints)
            if abs(by[k]) > _ALIVE * min(way, _NUDGE * strokes[k]) and (k == j or k not in shared)
        )
        joint.alive = abs(by[j]) > _ALIVE * way
        joint.sign = -1 if moved.against or direction * by[j] < -_ALIVE * way else 1
        if not joint.alive or joint.sign < 0 or joint.moves != (joint.name,):
            joint.alive = False
            return
        yield from bench.move(j, q, slow)

    # -- one joint thoroughly --------------------------------------------------------------------

    def _thoroughly(self, j: int, k: int, of: int) -> Turns[None]:
        joint = self.found.joints[j]
        self.bench.forget()
        tests = (("its range", self._range), ("speed", self._speeds))
        for n, (title, test) in enumerate(tests):
            self._report_progress(f"{joint.name}: {title}", (k + n / len(tests)) / of)
            yield from test(j)
        yield from self.bench.move(j, self._open_q(j), float(self.bench.slow[j]))

    def _range(self, j: int) -> Turns[None]:
        bench, joint, spec = self.bench, self.found.joints[j], self._joint(j)
        slow = float(bench.slow[j])
        yield from bench.move(j, spec.q_min, slow, settle=True)
        begin = bench.mark
        yield from bench.move(j, spec.q_max, slow, settle=True)
        high = self._rest(j)
        yield from bench.move(j, spec.q_min, slow, settle=True)
        joint.curves["range"] = bench.series(j, begin)
        joint.figures["range"] = high - self._rest(j)

    def _rest(self, j: int) -> float:
        """Where a joint that has just come to rest is."""
        s = self.bench.series(j, -max(3, int(SETTLE / self.setup.period)))
        return float(np.median(s.q))

    def _speeds(self, j: int) -> Turns[None]:
        """Move back and forth, faster each time, while the joint follows and stops at its goal."""
        bench, joint = self.bench, self.found.joints[j]
        slow = float(bench.slow[j])
        reached = {"speed+": math.nan, "speed-": math.nan}
        going = set(reached)
        yield from bench.move(j, self._at(j, _RUN[0]), slow, settle=True)
        for level in _LEVELS:
            for name, column, begin, goal in (("speed+", 1, *_RUN), ("speed-", 0, *_RUN[::-1])):
                asked = level * float(self.found.asked_speed[j, column])
                if name not in going or (asked <= 2 * slow and level < _LEVELS[-1]):
                    continue
                found = yield from bench.undisturbed(partial(self._fast, j, begin, goal, asked))
                if found is None:
                    joint.notes.append(f"{name}: spoiled by pauses of this machine")
                reached[name], beyond = found or (math.nan, 0.0)
                if not (reached[name] >= _KEPT * asked and beyond <= _OVERSHOT):
                    going.discard(name)
                if beyond > _OVERSHOT:
                    joint.notes.append(
                        f"{name}: not tried faster: it went {beyond:.0%} of its stroke too far"
                    )
        joint.figures |= reached

    def _fast(
        self, j: int, begin: float, goal: float, speed: float
    ) -> Turns[tuple[float, float] | None]:
        """(speed that was reached, part of the stroke by which it went too far)."""
        bench, spec = self.bench, self._joint(j)
        assert bench.state is not None
        at = self._at(j, begin)
        if abs(float(bench.state.q[j]) - at) > 0.02 * spec.stroke:
            yield from bench.move(j, at, float(bench.slow[j]), settle=True)
        mark = bench.mark
        yield from bench.move(j, self._at(j, goal), speed, fast=True, settle=True)
        s = bench.series(j, mark)
        direction = 1 if goal > begin else -1
        self.found.joints[j].curves[f"speed{'+' if direction > 0 else '-'}"] = s
        low, high = (self._at(j, part) for part in _FIT)
        passed = direction * (s.q - (high if direction > 0 else low)) > 0
        left = float(s.t[int(np.argmax(passed))]) if passed.any() else math.inf
        if s.gap(end=left) > _GAP * self.setup.period:
            return None
        beyond = float((direction * (s.q - self._at(j, goal))).max()) / spec.stroke
        return _mean_speed(s, low, high), beyond

    # -- touch -----------------------------------------------------------------------------------

    def _feel(self) -> Turns[None]:
        """Wait for the operator to press each element; the hand is at rest."""
        self.found.touched = True
        for packet, sensor in enumerate(self.profile.sensors):
            elements = [e for e in self.found.elements if e.packet == packet]
            yield from self._feel_packet(packet, sensor.place, elements)
        self.question = ""

    def _feel_packet(self, packet: int, place: str, elements: list[ElementFound]) -> Turns[None]:
        bench = self.bench
        above = dict.fromkeys(range(len(elements)), 0)
        assert bench.state is not None
        last, self._skipped = bench.state.stamp, False
        for element in elements:
            element.answered, element.peak = False, math.nan
        while not self._skipped and bench.state.stamp - last < _TOUCH_PATIENCE:
            missing = [str(e.slot) for e in elements if not e.answered]
            if not missing:
                break
            self._report_progress(f"touch: {place}", 1.0)
            self.question = f"press each element of the {place} (missing: {', '.join(missing)})"
            (state,) = (yield from bench.watch(0.0))[-1:]
            if state.pressure is None:
                break
            for i, element in enumerate(elements):
                value = float(state.pressure[packet, element.slot])
                # of either sign: docs/sources/real-hands.md#touch-sign
                change = abs(value - element.rest)
                if not abs(element.peak - element.rest) >= change:
                    element.peak = value
                pressed = change > max(_PRESSED, _SIGMAS * element.noise)
                above[i] = above[i] + 1 if pressed else 0
                if above[i] >= 2 and not element.answered:
                    element.answered, last = True, state.stamp


def _mean_speed(s: Series, low: float, high: float) -> float:
    """Magnitude of the mean speed between two places; NaN with too few samples there."""
    inside = (s.q >= low) & (s.q <= high)
    t, q = s.t[inside], s.q[inside]
    if len(t) < _FEWEST or float(np.ptp(t)) <= 0:
        return math.nan
    return abs(float(np.polyfit(t - t[0], q, 1)[0]))
