"""Steps of a joint: its course, speed and end, and whether the hand obeyed before."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.checks.figures import Figure, judged
from dexkit.conformance.kit.median import median
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.hand import Floats


@dataclass(frozen=True)
class Step:
    """A step of one joint's target, and the course of q.

    :param stroke: of the joint, rad.
    :param start: q before it.
    :param final: q at its end (median of the last 0.2 s).
    :param unit: of q.
    """

    joint: int
    stroke: float
    begin: float
    end: float
    target: float
    start: float
    final: float
    t: Floats
    q: Floats
    unit: str

    @property
    def size(self) -> float:
        """Target minus start, rad."""
        return self.target - self.start

    @property
    def error(self) -> float:
        """Distance from the target at the end, rad."""
        return abs(self.final - self.target)

    @property
    def progress(self) -> float:
        """The part of the step that was made; negative in the wrong direction."""
        return (self.final - self.start) / self.size

    def figure(self, value: float, text: str, **more: Any) -> Figure:
        """A figure of this step, with other parameters of :class:`Figure`."""
        return Figure(value, self.begin, self.end, self.joint, text, **more)

    def error_figure(self, text: str) -> Figure:
        """Its distance from the target."""
        return self.figure(self.error, text)

    def arrives_within(self, seconds: float) -> bool:
        """Whether it still moves to its target at the end, fast enough to arrive within
        ``seconds``.
        """
        late = self.t >= self.end - 0.1
        if late.sum() < 2:
            return False
        t, q = self.t[late], self.q[late]
        speed = float(q[-1] - q[0]) / max(float(t[-1] - t[0]), 1e-3)
        left = self.target - float(q[-1])
        return left * speed >= 0.0 and abs(left) <= abs(speed) * seconds

    def __str__(self) -> str:
        return (
            f"commanded from {self.start:.2f} to {self.target:.2f} {self.unit}, q went to "
            f"{self.final:.2f}"
        )


def steps_of(ctx: Context, phase: Phase) -> tuple[Step, ...]:
    """A phase's targets as steps of this side's joints; joints without state are left out."""
    targets = phase.targets.get(ctx.side, {})
    what = ("steps", phase.begin_ns, phase.end_ns, *targets.items())
    return ctx.once(what, lambda: tuple(_steps_to(ctx, phase, targets)))


def _steps_to(ctx: Context, phase: Phase, targets: Mapping[int, float]) -> Iterator[Step]:
    """A phase's motions to these targets, by joint."""
    begin, end = ctx.span(phase)
    states = ctx.states
    rows, before = states.between(begin, end), states.between(begin - 0.1, begin)
    for joint, target in targets.items():
        t, q = states.t[rows], states.q[rows, joint]
        earlier = states.q[before, joint]
        earlier = earlier[np.isfinite(earlier)]
        good = np.isfinite(q)
        t, q = t[good], q[good]
        if not len(q):
            continue
        late = t >= end - 0.2
        yield Step(
            joint=joint,
            stroke=ctx.joints[joint].stroke,
            begin=begin,
            end=end,
            target=target,
            start=median(earlier) if len(earlier) else float(q[0]),
            final=median(q[late]) if late.any() else float(q[-1]),
            t=t,
            q=q,
            unit=ctx.unit,
        )


def speed_of(step: Step) -> float | None:
    """Mean speed from 10 to 90 % of a step, rad/s; None if 90 % was not reached."""
    part = (step.q - step.start) / step.size
    low, high = np.argmax(part >= 0.1), np.argmax(part >= 0.9)
    if part[high] < 0.9 or high <= low:
        return None
    return 0.8 * abs(step.size) / max(float(step.t[high] - step.t[low]), 1e-3)


_PEAK_S = 0.04
"""Window of a speed measurement, seconds: position noise of 0.1 % of a range gives 2.5 % of the
range per second."""


_LARGER, _FASTER = 1.5, 1.2
"""Factor of size, and of speed: a step larger by this factor is faster by it, unless the joint's
own top speed limits it."""


REST_S, _RESTS = 0.1, 0.01  # s before a step, and part of the range by which q may vary there


_NOISE_STATES, _MOST_NOISE = 5, 0.008
"""Fewest states that show the noise of q, and the part of the stroke that it may be."""


_CHANGE, _WATCHED_S = 0.05, 0.25
"""Smallest change of a goal, as a part of the range, and the seconds after it in which a joint is
fastest."""


_FREE = ("joint", "step", "stiff", "ends")
"""Phases with the client's gains that allow a joint's top speed."""


def peak_speed(step: Step) -> float:
    """The largest speed of a step towards its target, rad/s, over 0.04 s; 0 without states."""
    later = np.searchsorted(step.t, step.t + _PEAK_S)
    rows = np.flatnonzero(later < len(step.t))
    if not len(rows):
        return 0.0
    then = later[rows]
    way = (step.q[then] - step.q[rows]) * np.sign(step.size)
    return max(float((way / (step.t[then] - step.t[rows])).max()), 0.0)


def _free_steps(ctx: Context) -> dict[int, list[tuple[Step, float]]]:
    """The steps of each joint that allow its top speed, and their peak speeds."""

    def work_out() -> dict[int, list[tuple[Step, float]]]:
        found: dict[int, list[tuple[Step, float]]] = {}
        for phase in (p for name in _FREE for p in ctx.recording.phases(name, ctx.side)):
            for step in steps_of(ctx, phase):
                found.setdefault(step.joint, []).append((step, peak_speed(step)))
        return found

    return ctx.once("free steps", work_out)


def own_speed(ctx: Context, joint: int, least_stroke: float) -> float | None:
    """Top speed of a joint that limits its large steps, in its slower direction, rad/s.

    None without such steps, or if the joint has been faster after larger ones. It is the speed for
    judging a hand that follows as fast as it can: no source gives a speed, and DEX3-MOVE-04 demands
    little.

    :param least_stroke: size of a large step as a part of the joint's range.
    """

    def work_out() -> float | None:
        ways: dict[bool, float] = {}
        steps = [
            s
            for s in _free_steps(ctx).get(joint, [])
            if abs(s[0].size) >= least_stroke * s[0].stroke
        ]
        for step, speed in steps:
            way = step.size > 0
            ways[way] = max(ways.get(way, 0.0), speed)
        smallest = min(steps, key=lambda s: abs(s[0].size), default=None)
        if smallest is None or not limited_by_speed(ctx, smallest[0]):
            return None
        return min(ways.values())

    return ctx.once(("own speed", joint, least_stroke), work_out)


def rest_error(ctx: Context, joint: int) -> float:
    """How far from its goals a joint comes to rest in plain steps, rad: by its friction.

    A tenth of the range at most.
    """

    def work_out() -> float:
        errors = [
            s.error
            for phase in (*ctx.phases("step"), *ctx.phases("joint"))
            for s in steps_of(ctx, phase)
            if s.joint == joint
        ]
        usual = median(np.array(errors)) if errors else 0.0
        return min(usual, DISOBEYS * ctx.joints[joint].stroke)

    return ctx.once(("rest error", joint), work_out)


def missed(ctx: Context, step: Step) -> float:
    """How much further from its target a step ends than the joint does by its friction, rad."""
    return max(0.0, step.error - rest_error(ctx, step.joint))


def limited_by_speed(ctx: Context, step: Step) -> bool:
    """Whether a joint's own top speed limits a step: it was not faster after much larger changes of
    its goal in the same run, with the same stiffness.

    Then the duration does not depend on gains. Without a larger change it is unknown: False.
    """
    fastest = max((peak_speed(one) for one in larger_motions(ctx, step)), default=None)
    return fastest is not None and fastest <= _FASTER * peak_speed(step)


@dataclass(frozen=True)
class _Changes:
    """The changes of one joint's goal: the motion after each, with the kp of its command.

    :param t: times of all commands to the joint, s, with their ``kp``.
    """

    t: Floats
    kp: Floats
    motions: tuple[tuple[float, Step], ...]

    def stiffness(self, at: float) -> float:
        """The kp of the newest command at a time."""
        return float(self.kp[max(int(np.searchsorted(self.t, at)) - 1, 0)])


def _changes(ctx: Context, joint: int) -> _Changes:
    given = ctx.commands
    good = np.isfinite(given.q).all(axis=1) & np.isfinite(given.kp).all(axis=1)
    t, kp = given.t[good], given.kp[good, joint]
    return _Changes(t, kp, tuple(_motions(ctx, joint, t, given.q[good, joint], kp)))


def _motions(
    ctx: Context, joint: int, t: Floats, q: Floats, kp: Floats
) -> Iterator[tuple[float, Step]]:
    """The motion after each change of a joint's goal in its commands, where it is watched for long
    enough and nothing holds it back.
    """
    states, spec = ctx.states, ctx.joints[joint]
    least = _CHANGE * spec.stroke
    goal = np.clip(q, spec.q_min, spec.q_max)
    changes = np.flatnonzero(np.abs(np.diff(goal, prepend=goal[:1])) > least)
    for i, begin in zip(changes, t[changes].tolist(), strict=True):
        later = np.flatnonzero(np.abs(goal[i:] - goal[i]) > least)
        end = min(float(t[i + later[0]]) if len(later) else float(t[-1]), begin + _WATCHED_S)
        before, rows = states.between(begin - _PEAK_S, begin), states.between(begin, end)
        if end - begin < _WATCHED_S / 2 or not len(states.t[before]) or len(states.t[rows]) < 2:
            continue
        after = states.q[rows, joint]
        motion = Step(
            joint=joint,
            stroke=spec.stroke,
            begin=begin,
            end=end,
            target=float(goal[i]),
            start=median(states.q[before, joint]),
            final=float(after[-1]),
            t=states.t[rows],
            q=after,
            unit=ctx.unit,
        )
        if abs(motion.final - motion.start) >= least:
            yield float(kp[i]), motion


def larger_motions(ctx: Context, step: Step) -> Iterator[Step]:
    """Motions of a step's joint after much larger changes of its goal, with the same stiffness."""
    joint = step.joint
    changes = ctx.once(("changes of the goal", joint), lambda: _changes(ctx, joint))
    if not changes.motions:
        return
    stiff = changes.stiffness(step.begin + 0.5 * (step.end - step.begin))
    for kp, motion in changes.motions:
        if kp >= 0.99 * stiff and abs(motion.size) >= _LARGER * abs(step.size):
            yield motion


def steps(ctx: Context) -> list[Step]:
    """The steps of this side's joints."""
    return [s for p in ctx.phases() for s in steps_of(ctx, p)]


_PLAIN = ("step", "joint", "recover", "resume", "company", "restart", "service-restart")
"""Steps with good commands only, which show that a hand obeys; each has its own requirement."""


_NEWEST = 3  # steps; in a single one the hand may have been at its target already


DISOBEYS = 0.1  # of the stroke


def disobeyed(ctx: Context, when: str, step: Step) -> Outcome:
    """The failure of a hand that ends a step further from its target than it does by friction."""
    figure = step.figure(missed(ctx, step), f"{when}: {step}", shown="disobeys")
    return judged(ctx, [figure], "error_rad", "max_error_stroke", nothing="")


def obeyed_before(ctx: Context, phase: Phase) -> bool:
    """Whether the hand obeyed the newest plain steps before a phase.

    A fault there is judged there, not again in each later phase.
    """
    assert ctx.recording.stimulus is not None  # a phase is of one
    earlier = [
        p
        for p in ctx.recording.stimulus.phases
        if p.name in _PLAIN and ctx.side in p.targets and p.end_ns <= phase.begin_ns
    ]
    newest = sorted(earlier, key=lambda p: p.end_ns)[-_NEWEST:]
    found = [steps_of(ctx, p) for p in newest]
    return all(f and all(s.error <= DISOBEYS * s.stroke for s in f) for f in found)


def rests_before(ctx: Context, step: Step) -> bool:
    """Whether a joint stands before a step; without states, too."""
    q = ctx.q(step.begin - 0.1, step.begin)[:, step.joint]
    return not len(q) or bool(np.ptp(q) < 0.01 * step.stroke)


def not_driven(ctx: Context, how: str, limit: str = "max_motion_stroke") -> Outcome:
    """Motion of each joint towards a q that must have no effect.

    :param limit: the tolerance that limits it.
    """
    given = steps(ctx)
    if not given:
        return ctx.skipped("no state during this stimulus")
    # gravity pulls a joint the same way whatever q is, so q is commanded on both sides and both
    # must count
    ways: dict[int, dict[bool, Figure]] = {}
    for s in given:
        # joints already at q prove nothing
        if abs(s.size) <= 2 * ctx.tolerance(limit, s.joint):
            continue
        towards = max(float(np.max((s.q - s.start) * np.sign(s.size))), 0.0)
        text = f"moved {towards:.3f} {ctx.unit} towards q = {s.target:.2f} {how}, which was "
        text += f"{abs(s.size):.2f} {ctx.unit} away"
        found, up = ways.setdefault(s.joint, {}), s.size > 0
        if up not in found or towards > found[up].value:
            found[up] = s.figure(towards, text)
    return judged(
        ctx,
        [min(found.values(), key=lambda f: f.value) for found in ways.values()],
        "motion_rad",
        limit,
        nothing="the hand was already at the q that must have no effect",
    )


def noise_at_rest(ctx: Context, joint: int, phases: Sequence[Phase]) -> float:
    """The noise of q at rest, rad: half of its range in the quietest of the times before phases.

    No more than what a hand may have: what exceeds it counts as motion.
    """
    quiet = _MOST_NOISE * ctx.joints[joint].stroke
    for phase in phases:
        begin, _ = ctx.span(phase)
        q = ctx.q(begin - REST_S, begin)[:, joint]
        q = q[np.isfinite(q)]
        if len(q) >= _NOISE_STATES:
            quiet = min(quiet, 0.5 * float(np.ptp(q)))
    return quiet
