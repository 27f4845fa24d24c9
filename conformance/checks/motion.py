"""Check steps: direction, arrival, settling, speed, overshoot, independence, zero gains."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dexkit.conformance.checks import STROKE_S, Context, Outcome, causes, check
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.hands import under_test
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.median import median
from dexkit.conformance.stimulus_record import Phase
from dexkit.conformance.sums import mean
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
_REST_S, _RESTS = 0.1, 0.01  # s before a step, and part of the range by which q may vary there
_NOISE_STATES, _MOST_NOISE = 5, 0.008
"""Fewest states that show the noise of q, and the part of the stroke that it may be."""
_GROWS = 0.25
"""Part of the growth of the error by which the way may grow where a soft start limits it."""
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


def limited_by_speed(ctx: Context, step: Step) -> bool:
    """Whether a joint's own top speed limits a step: it was not faster after much larger changes of
    its goal in the same run, with the same stiffness.

    Then the duration does not depend on gains. Without a larger change it is unknown: False.
    """
    fastest = max((peak_speed(one) for one in _larger(ctx, step)), default=None)
    return fastest is not None and fastest <= _FASTER * peak_speed(step)


def limited_by_start(ctx: Context, step: Step) -> bool:
    """Whether a joint's own soft start limits a step: after much larger changes of its goal from
    rest it mostly came hardly further in the time in which this step got half-way.

    Where gains limit the step, the way grows with the error.
    """
    half, grows = half_way(step), []
    if half is None:
        return False
    for one in _larger(ctx, step):
        before = ctx.q(one.begin - _REST_S, one.begin)[:, step.joint]
        if not float(np.ptp(before)) <= _RESTS * step.stroke:
            continue
        then = min(int(np.searchsorted(one.t, one.begin + half)), len(one.t) - 1)
        further = abs(float(one.q[then]) - one.start) / (0.5 * abs(step.size)) - 1.0
        grows.append(further / (abs(one.size / step.size) - 1.0))
    return bool(grows) and median(np.array(grows)) <= _GROWS


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


def _larger(ctx: Context, step: Step) -> Iterator[Step]:
    """Motions of a step's joint after much larger changes of its goal, with the same stiffness."""
    joint = step.joint
    changes = ctx.once(("changes of the goal", joint), lambda: _changes(ctx, joint))
    if not changes.motions:
        return
    stiff = changes.stiffness(step.begin + 0.5 * (step.end - step.begin))
    for kp, motion in changes.motions:
        if kp >= 0.99 * stiff and abs(motion.size) >= _LARGER * abs(step.size):
            yield motion


def half_way(step: Step) -> float | None:
    """Seconds from the command to half of a step; None if it was not reached."""
    part = (step.q - step.start) / step.size if step.size else np.zeros(0)
    if not len(part) or not (part >= 0.5).any():
        return None
    return float(step.t[int(np.argmax(part >= 0.5))]) - step.begin


def least_half_way(step: Step) -> float:
    """The same; if half of the step was not reached, a lower bound by the mean speed so far."""
    half = half_way(step)
    if half is not None:
        return half
    progress = (step.final - step.start) / step.size if step.size else 0.0
    return (step.end - step.begin) * max(1.0, 0.5 / max(progress, 1e-3))


def slower(ctx: Context, joint: int, took: float, quick: float, how: str) -> Figure:
    """How many times as long a softer step takes to half-way, with the seconds of both."""
    return Figure(
        took / quick,
        joint=joint,
        text=f"a step {how} takes {took / quick:.1f} times as long to half-way",
        measure=Measure(took, ctx.tolerance("min_ratio") * quick, larger_is_worse=False),
    )


def steps(ctx: Context) -> list[Step]:
    """The steps of this side's joints."""
    return [s for p in ctx.phases() for s in steps_of(ctx, p)]


_NEARLY, _CLEAR_WAY = 0.9, 0.3
"""Part of its whole way after which the time of a step is taken, and the least part of the step
that it must be to be compared."""
_PLAIN = ("step", "joint", "recover", "resume", "company", "restart", "service-restart")
"""Steps with good commands only, which show that a hand obeys; each has its own requirement."""
_NEWEST = 3  # steps; in a single one the hand may have been at its target already
_DISOBEYS = 0.1  # of the stroke


def disobeyed(ctx: Context, when: str, step: Step) -> Outcome:
    """The failure of a hand that ends a step away from its target."""
    figure = replace(step.error_figure(f"{when}: {step}"), shown="disobeys")
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
    return all(f and all(s.error <= _DISOBEYS * s.stroke for s in f) for f in found)


@check("DEX1-MOVE-01", "DEX3-MOVE-01")
def direction(ctx: Context) -> Outcome:
    """Progress towards the target, as a part of the step."""
    found = [s for s in steps(ctx) if abs(s.size) >= 0.1 * s.stroke]
    figures = [
        s.figure(
            s.progress,
            f"{s}: {_how_it_missed(s)}",
            met=f"{len(found)} steps, all in the right direction",
        )
        for s in found
    ]
    nothing = ctx.failed(
        "no step",
        "no step could be made: there is no state during the steps, or q already was at every "
        "target",
    )
    outcome = judged(ctx, figures, "progress", "min_progress", nothing=nothing)
    return outcome.because(_cause(found)) if found else outcome


def _how_it_missed(step: Step) -> str:
    if float(np.ptp(step.q)) < 0.02 * step.stroke:
        return "it did not move"
    return "it did not reach its target" if step.progress > -0.05 else "that is the wrong direction"


@check("DEX1-MOVE-02", "DEX3-MOVE-02")
def arrives(ctx: Context) -> Outcome:
    """Distance from the target at the end of each step."""
    found = steps(ctx)
    nothing = ctx.failed("no state", f"no state of the {ctx.side} hand during the steps")
    figures = [s.error_figure(str(s)) for s in found]
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)
    return outcome.because(_cause(found)) if found else outcome


def _cause(found: Sequence[Step]) -> str:
    """The likely cause of steps that miss their targets, or an empty text."""
    still = all(float(np.ptp(s.q)) < 0.02 * s.stroke for s in found)
    scale = ""
    if len({s.joint for s in found}) == 1:
        ends = np.array([(s.target, s.final) for s in found])
        scale = causes.of_scale(ends[:, 0], ends[:, 1], found[0].stroke)
    if still and not scale:
        return (
            "Nothing moves at all: commands do not reach the motors, or these are not driven; or "
            "commands are taken in another unit, in which all of them mean the same end."
        )
    return scale


@check("DEX1-MOVE-03", "DEX3-MOVE-03")
@worst("ripple_rad", "max_ripple_stroke", nothing="too few states at the end of the steps")
def settles(ctx: Context) -> Figures:
    """Ripple of q at the end of each step."""
    for step in steps(ctx):
        begin = step.end - ctx.tolerance("window_s")
        tail = step.q[step.t >= begin]
        if len(tail) >= 5:
            ripple = float(np.ptp(tail))
            text = f"at the target {step.target:.2f} {ctx.unit} q still moves by {ripple:.3f} "
            text += f"{ctx.unit}, peak to peak"
            yield Figure(ripple, begin, step.end, step.joint, text)


@check("DEX1-MOVE-04", "DEX3-MOVE-04")
@worst("speed_rad_s", "min_speed_rad_s", nothing="no step of that size was finished")
def speed(ctx: Context) -> Figures:
    """Speed from 10 to 90 % of each large step."""
    for step in steps(ctx):
        shown = speed_of(step)
        if shown is not None and abs(step.size) >= ctx.tolerance("min_step_stroke", step.joint):
            way = 0.8 * abs(step.size)
            late = way / shown - way / ctx.tolerance("min_speed_rad_s")
            yield step.figure(
                shown, f"{shown:.2f} {ctx.unit}/s in the slowest large step", late=late
            )


@check("DEX1-MOVE-05", "DEX3-MOVE-05")
@worst("overshoot_rad", "max_overshoot_stroke", nothing="no step of that size")
def overshoot(ctx: Context) -> Figures:
    """Overshoot of q beyond the target."""
    for step in steps(ctx):
        if abs(step.size) >= 0.1 * step.stroke:
            beyond = max(float(np.max((step.q - step.target) * np.sign(step.size))), 0.0)
            yield step.figure(
                beyond,
                f"{beyond:.3f} {ctx.unit} beyond the target {step.target:.2f} {ctx.unit}",
            )


@check("DEX1-MOVE-06", "DEX3-MOVE-06")
@worst("back_rad", "max_back_stroke", nothing="no step of that size")
def monotonous(ctx: Context) -> Figures:
    """Largest reversal of q on the way to the target."""
    for step in steps(ctx):
        if abs(step.size) < 0.1 * step.stroke:
            continue
        way = (step.q - step.start) * np.sign(step.size)
        there = np.flatnonzero(way >= 0.97 * abs(step.size))
        way = way[: int(there[0]) + 1] if len(there) else way
        back = np.maximum.accumulate(np.maximum(way, 0.0)) - way
        i = int(np.argmax(back))
        text = (
            f"on its way from {step.start:.2f} to {step.target:.2f} {ctx.unit} q went back by "
            f"{back[i]:.3f} {ctx.unit}"
        )
        yield Figure(float(back[i]), float(step.t[i]), step.end, step.joint, text)


@check("DEX1-MOVE-07", "DEX3-MOVE-07")
@worst("settle_s", "max_settle_s", nothing="no step of that size")
def settling(ctx: Context) -> Figures:
    """Time from the command until q stays near the target."""
    for step in steps(ctx):
        if abs(step.size) < 0.1 * step.stroke:
            continue
        away = np.abs(step.q - step.target) > ctx.tolerance("max_error_stroke", step.joint)
        last = np.flatnonzero(away)
        seconds = float(step.t[last[-1]]) - step.begin if len(last) else 0.0
        yield Figure(
            seconds,
            step.begin,
            step.begin + seconds,
            step.joint,
            f"{step}: after {seconds:.2f} s it was still away from its target",
            met=f"{seconds:.2f} s in the slowest step",
        )


@check("DEX1-MOVE-09", "DEX3-MOVE-08")
@worst("reaction_s", "max_reaction_s", nothing="no step of that size was finished")
def begins(ctx: Context) -> Figures:
    """Time from the command until the hand moves, for every step that arrives."""
    first = [p for name in _AFTER_A_PAUSE for p in ctx.phases(name)[:1]]
    for phase in (p for name in _PROMPT for p in ctx.phases(name)):
        limit = ctx.tolerance("max_first_s" if phase in first else "max_reaction_s")
        for step in steps_of(ctx, phase):
            way = (step.q - step.start) * np.sign(step.size) >= _BEGUN * step.stroke
            if (
                not _rests_before(ctx, step)
                or abs(step.size) < ctx.tolerance("min_step_stroke", step.joint)
                or step.error > _DISOBEYS * step.stroke
                or not way.any()
            ):
                continue  # other requirements judge whether it arrives
            after = float(step.t[np.argmax(way)]) - step.begin
            text = f"{step}, but it began to move only after {after:.2f} s"
            met = f"after {after:.2f} s in the step to {step.target:.2f} {ctx.unit}"
            end = step.begin + after
            yield Figure(after, step.begin, end, step.joint, text, met, limit)


def _rests_before(ctx: Context, step: Step) -> bool:
    """Whether a joint stands before a step; without states, too."""
    q = ctx.q(step.begin - 0.1, step.begin)[:, step.joint]
    return not len(q) or bool(np.ptp(q) < 0.01 * step.stroke)


_BEGUN = 0.02
"""Part of the stroke after which a hand counts as moving; a slow one takes 0.1 s for it."""
_AFTER_A_PAUSE = ("restart", "service-restart")
"""Steps of which the first follows directly after discovery."""
_PROMPT = (
    *("step", "joint", "ends", "center", "fingerprint", "recover", "old-stamps"),
    *("company", *_AFTER_A_PAUSE),
)
"""Steps that must begin at once; WDOG-03 judges those after a pause, SIDE-02 those during bad
commands to the other hand."""


@check("DEX1-MOVE-10")
@worst("part", "max_part", nothing="no command in a dead zone, or none to its end")
def dead_zones(ctx: Context) -> Figures:
    """Size of a dead zone between the gripper's reached position and its end."""
    reached = {s.target: s.final for p in ctx.phases("ends") for s in steps_of(ctx, p)}
    for step in steps(ctx):
        asked = ctx.commands.q[ctx.given(step.begin, step.end), step.joint]
        if not len(asked) or step.target not in reached:
            continue
        zone = abs(float(asked[-1]) - step.target)
        part = abs(step.final - reached[step.target]) / zone if zone > 0 else 0.0
        yield step.figure(
            part,
            f"commanded to {asked[-1]:g} rad, q ends at {step.final:.3f} rad: {part:.0%} of the "
            "zone short",
        )


@check("DEX1-MOVE-08")
def ends(ctx: Context) -> Outcome:
    """Distance from fully open and fully closed."""
    found = steps(ctx)
    text = "; ".join(
        f"commanded to {s.target:.2f} {ctx.unit}, q went to {s.final:.2f}" for s in found
    )
    nothing = ctx.failed("no state", f"no state of the {ctx.side} hand at its ends")
    figures = [s.error_figure(text) for s in found]
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)
    if not found:
        return outcome
    reached = max(s.final for s in found) / max(s.target for s in found)
    if abs(reached - 5.4 / (2 * np.pi)) < 0.02 or abs(reached - 2 * np.pi / 5.4) < 0.02:
        return outcome.because(
            "the stroke of another dialect is used: 5.4 rad in unitree_go, 2 pi in unitree_hg"
        )
    return outcome


@check("DEX1-SIDE-01", "DEX3-SIDE-01")
@worst(
    "motion_rad", "max_motion_stroke", nothing="no state of this hand while only the other moved"
)
def independent(ctx: Context) -> Figures:
    """Motion of this hand while only the other hand's target changes."""
    first = ctx.requirement.phase or ""
    names = (first, "company", *_AFTER_A_PAUSE)
    others = [(n, p) for n in names for p in ctx.recording.phases(n) if ctx.side not in p.sides]
    if not others:
        yield ctx.skipped("only one side was commanded")
    for name, phase in others:
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        t, positions = ctx.states.t[rows], ctx.states.q[rows]
        before = ctx.q(begin - 0.25, begin)
        if len(t) < 2 or not len(before):
            continue
        # the mean of each quarter of a second: a hand that oscillates about its target is
        # judged by MOVE-03
        bins = ((t - begin) / 0.25).astype(np.intp)
        counts = np.bincount(bins)
        given = ctx.commands.q[: int(np.searchsorted(ctx.commands.t, end))]
        for joint, spec in enumerate(ctx.joints):
            means = np.bincount(bins, positions[:, joint])[counts > 0] / counts[counts > 0]
            start = mean(before[:, joint])
            goals = given[np.isfinite(given[:, joint]), joint]
            goal = float(np.clip(goals[-1], spec.q_min, spec.q_max)) if len(goals) else start
            # the later steps are shorter: the end of its own one may still be ahead
            rest = 0.0 if name == first else ctx.tolerance("max_rest_stroke", joint)
            end_q = float(np.clip(goal, start - rest, start + rest))
            low, high = min(start, end_q), max(start, end_q)
            most = float(np.maximum(low - means, means - high).max(initial=0.0))
            text = (
                f"moved by {most:.3f} {ctx.unit} while only the {ctx.other} hand was commanded to "
                "move"
            )
            yield Figure(most, begin, end, joint, text)


@check("DEX3-SIDE-03")
@worst("part", "min_part", nothing="no step that can be compared with an earlier one")
def beside_grip(ctx: Context) -> Figures:
    """The way of each joint's step beside a grip, as a part of its way in the same time of the same
    step before. So a slow hand passes.
    """
    known = [s for n in ("joint", "step") for p in ctx.phases(n) for s in steps_of(ctx, p)]
    slack, limit = ctx.tolerance("slack_s"), ctx.tolerance("min_part")
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        found = steps_of(ctx, phase)
        if not found:
            when = "while the other hand pressed on an object"
            yield ctx.failed("no state", f"no state of the {ctx.side} hand {when}")
        for step in found:
            if abs(step.size) < ctx.tolerance("min_step_stroke", step.joint):
                continue
            for like in (s for s in known if s.joint == step.joint):
                if not 0.7 < step.size / (like.size or math.inf) < 1.4:
                    continue
                seconds, way = _most_of_way(like, step.end - step.begin - slack)
                if way < _CLEAR_WAY:
                    continue
                part = _way_within(step, seconds + slack) / way
                text = (
                    f"after {seconds + slack:.2f} s it had made {part:.0%} of the way that it made "
                    f"in {seconds:.2f} s without a grip of the other hand"
                )
                rad = way * abs(step.size)
                made = Measure(part * rad, limit * rad, "rad", Quantity.POSITION, False)
                yield step.figure(part, text, late=seconds * (limit - part), measure=made)


def _way_within(step: Step, seconds: float) -> float:
    """The largest part of a step that was made in its first seconds, at least 0."""
    q = step.q[step.t <= step.begin + seconds]
    return float(((q - step.start) / step.size).max(initial=0.0))


def _most_of_way(step: Step, longest: float) -> tuple[float, float]:
    """The seconds after which nearly all of a step's way was made, no more than the longest, and
    the part that was made then.
    """
    within = step.t <= step.begin + longest
    part = np.maximum((step.q[within] - step.start) / step.size, 0.0)
    if not len(part):
        return longest, 0.0
    way = float(part.max())
    return float(step.t[within][int(np.argmax(part >= _NEARLY * way))]) - step.begin, _NEARLY * way


@check("DEX1-SIDE-03")
@worst(
    "progress",
    "min_progress",
    nothing="no step to judge: only one side was commanded, the hand had stopped obeying before, "
    "or no state shows the end of a step",
)
def by_its_own(ctx: Context) -> Figures:
    """Steps of this hand while the other hand gets other values in the same members."""
    for step in (s for p in ctx.phases() if obeyed_before(ctx, p) for s in steps_of(ctx, p)):
        # the step is short: its last states, not the median of some; RATE-03 judges gaps
        last = step.q[step.t >= step.end - 0.03]
        large = abs(step.size) >= ctx.tolerance("min_step_stroke", step.joint)
        # it may still be under way, from where it was limp
        if not _rests_before(ctx, step) or not len(last) or not large:
            continue
        made = replace(step, final=median(last))
        if made.error > ctx.tolerance("max_error_stroke", step.joint):
            yield disobeyed(ctx, "while the other hand was commanded otherwise", made)
        late = STROKE_S * abs(step.size) / step.stroke
        yield made.figure(made.progress, f"while the other hand had zero gains: {made}", late=late)


@check("DEX1-GAIN-01", "DEX3-GAIN-01")
def zero_gains(ctx: Context) -> Outcome:
    """Motion towards q while all gains are zero."""
    return not_driven(ctx, "with kp = kd = 0")


def not_driven(ctx: Context, how: str) -> Outcome:
    """Motion of each joint towards a q that must have no effect."""
    given = steps(ctx)
    if not given:
        return ctx.skipped("no state during this stimulus")
    # gravity pulls a joint the same way whatever q is, so q is commanded on both sides and both
    # must count
    ways: dict[int, dict[bool, Figure]] = {}
    for s in given:
        # joints already at q prove nothing
        if abs(s.size) <= 2 * ctx.tolerance("max_motion_stroke", s.joint):
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
        "max_motion_stroke",
        nothing="the hand was already at the q that must have no effect",
    )


@check("DEX1-CMD-01", "DEX3-CMD-01")
def every_command(ctx: Context) -> Outcome:
    """Progress of the hand towards a goal that was commanded once."""
    judged, missed = 0, []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, after = ctx.q(begin - 0.03, begin), ctx.q(end - 0.03, end)
        if not len(before) or not len(after):
            continue
        start, final = np.median(before, axis=0), np.median(after, axis=0)
        judged += 1
        for joint, target in phase.targets.get(ctx.side, {}).items():
            size = target - float(start[joint])
            if abs(size) < ctx.tolerance("min_step_stroke", joint):
                continue
            progress = (float(final[joint]) - float(start[joint])) / size
            if progress < ctx.tolerance("min_progress"):
                missed.append((begin, end, joint, target, progress))
                break
    if not judged:
        return ctx.skipped("no state while single commands were sent")
    if not missed:
        return ctx.passed(f"{judged} of {judged}", f"{judged} single commands, all obeyed")
    begin, end, joint, target, progress = missed[0]
    outcome = ctx.failed(
        f"{judged - len(missed)} of {judged}",
        ctx.named(
            f"{len(missed)} of {judged} commands that were sent once were not obeyed; the first, "
            f"to {target:.2f} {ctx.unit}, made {progress:.0%} of its way in {end - begin:.2f} s",
            joint,
        ),
        *(ctx.at(ctx.states.topic, a, b) for a, b, *_ in missed),
        missed=len(missed),
    )
    # a network may lose a single sample: repeat the run
    return replace(outcome.about(joint).if_late(end - begin), retry=True)


def _driven(ctx: Context) -> list[tuple[int, int]]:
    """The joints that the stimulus drives by velocity, with direction: a gripper opens, fingers
    close.
    """
    roles = under_test(ctx.recording.model.name).roles
    if roles is None:
        return [(0, 1)]
    return [(i, 1 if ctx.joints[i].closing > 0 else -1) for i in roles.driven]


def _driven_ways(ctx: Context) -> Iterator[tuple[float, int, Phase]]:
    """Each motion under a commanded velocity without position gain, rad, with joint and phase;
    negative where the joint has moved the other way.
    """
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        given = ctx.commands.dq[ctx.given(begin, end)]
        for joint, way in _driven(ctx):
            if len(given) and not given[:, joint].any():
                continue  # driven by torque in this phase
            q = ctx.q(begin, end)[:, joint]
            if len(q) >= 2 and np.isfinite(q).all():
                yield (float(q[-1]) - float(q[0])) * way, joint, phase


@check("DEX1-GAIN-02", "DEX3-GAIN-03")
@worst("motion_rad", "min_motion_stroke", nothing="no state while a velocity was commanded")
def velocity_drives(ctx: Context) -> Figures:
    """Motion by a commanded velocity without a position gain."""
    for moved, joint, phase in _driven_ways(ctx):
        text = f"moved by {moved:.2f} {ctx.unit} while a velocity was commanded"
        yield Figure(moved, *ctx.span(phase), joint, text)


@check("DEX1-GAIN-06", "DEX3-GAIN-06")
@worst("motion_rad", "max_motion_stroke", nothing="no state while a velocity was commanded")
def velocity_way(ctx: Context) -> Figures:
    """Motion against a commanded velocity without a position gain."""
    for moved, joint, phase in _driven_ways(ctx):
        text = f"moved by {moved:.2f} {ctx.unit} with a commanded velocity"
        yield Figure(max(0.0, -moved), *ctx.span(phase), joint, text)


def noise_at_rest(ctx: Context, joint: int, phases: Sequence[Phase]) -> float:
    """The noise of q at rest, rad: half of its range in the quietest of the times before phases.

    No more than what a hand may have: what exceeds it counts as motion.
    """
    quiet = _MOST_NOISE * ctx.joints[joint].stroke
    for phase in phases:
        begin, _ = ctx.span(phase)
        q = ctx.q(begin - _REST_S, begin)[:, joint]
        q = q[np.isfinite(q)]
        if len(q) >= _NOISE_STATES:
            quiet = min(quiet, 0.5 * float(np.ptp(q)))
    return quiet
