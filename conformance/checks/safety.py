"""Check invalid commands, missing commands, several clients and load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import STROKE_S, Context, Outcome, causes, check, rate_measure
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.checks.motion import Step, disobeyed, obeyed_before, steps_of
from dexkit.conformance.checks.timing import (
    gap_measures,
    gaps,
    least_rate,
    longest_gap,
    slow,
    survived,
    too_slow,
)
from dexkit.conformance.measurement_error import Measure, Quantity
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats


def _recovery(ctx: Context, phase: Phase) -> Step | None:
    """The step after a bad command, of the joint with the largest error."""
    for after in ctx.phases("recover"):
        names = after.params.get("after", "").split()
        if phase.name in names and after.begin_ns >= phase.end_ns:
            found = steps_of(ctx, after)
            return max(found, key=lambda s: s.error / s.stroke) if found else None
    return None


def unharmed(ctx: Context, what: str) -> Outcome:
    """Fail if state stops or the hand disobeys afterwards; else an outcome with ``met`` None."""
    topic = ctx.states.topic
    judged = [p for p in ctx.phases() if obeyed_before(ctx, p)]
    if not judged:
        return ctx.skipped(f"the hand had stopped obeying before {what}")
    measures: list[Measure] = []
    for phase in judged:
        begin, end = ctx.span(phase)
        limit = ctx.tolerance("max_gap_s")
        found = gaps(ctx, limit, begin - 0.05, end + 0.2)
        if found:
            text = f"state stopped at {found[0][0]:.3f} s, during {what}"
            return silent(ctx, found, limit, "state stops", text)
        measures.append(longest_gap(ctx, limit, begin - 0.05, end + 0.2))
        step = _recovery(ctx, phase)
        if step is None:
            text = f"no state after {what}, when a good command was sent"
            return ctx.failed("no state", text, ctx.at(topic, end))
        if step.error > ctx.tolerance("max_error_stroke", step.joint):
            return disobeyed(ctx, f"after {what}", step)
    return Outcome(None).resting_on(*measures)


def silent(
    ctx: Context, found: Sequence[tuple[float, float]], limit: float, figure: str, text: str
) -> Outcome:
    """The failure of a hand whose state stopped; its place is the first of these gaps.

    :param limit: of a gap, seconds.
    """
    a, b = found[0]
    outcome = ctx.failed(figure, text, ctx.at(ctx.states.topic, a, b), max_gap_s=b - a)
    return outcome.resting_on(*gap_measures(found, limit)).if_late(b - a - limit)


def moves(
    ctx: Context, what: str, joints: Sequence[int] | None = None, sags: Floats | None = None
) -> Outcome:
    """Fail if a joint moves during the phase; otherwise pass, with the motion.

    :param joints: those that must not move; None for all.
    :param sags: allowed motion of each joint by gravity, rad; None for none.
    """
    nothing = ctx.passed(f"0.000 {ctx.unit}", f"no state shows motion during {what}")
    figures = _motions(ctx, what, joints, sags)
    return judged(ctx, figures, "motion_rad", "max_motion_stroke", nothing=nothing)


def _motions(ctx: Context, what: str, joints: Sequence[int] | None, sags: Floats | None) -> Figures:
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        before, q = ctx.q(begin - 0.1, begin), ctx.states.q[rows]
        if not len(before) or not len(q):
            continue
        with np.errstate(invalid="ignore"):
            deviation = np.abs(q - np.median(before, axis=0))
        for joint in range(len(ctx.joints)) if joints is None else joints:
            column = deviation[:, joint]
            known = np.isfinite(column)
            i = int(np.argmax(column)) if known.all() else int(np.argmin(known))
            at = float(ctx.states.t[rows][i])
            if not known.all():
                text = ctx.named(f"q became {q[i, joint]} during {what}", joint)
                failed = ctx.failed("q not finite", text, ctx.at(ctx.states.topic, at))
                yield failed.about(joint)
            most = float(column[i])
            if sags is not None:
                most = max(0.0, most - float(sags[joint]))
            yield Figure(most, at, None, joint, f"moved by {most:.3f} {ctx.unit} during {what}")


def stays(
    ctx: Context, what: str, joints: Sequence[int] | None = None, sags: Floats | None = None
) -> Outcome:
    """Check that no joint :func:`moves`, then that the hand is :func:`unharmed`."""
    still = moves(ctx, what, joints, sags)
    if still.met is False:
        return still
    after = unharmed(ctx, what)
    if after.met is False or after.reason:
        return after
    met = replace(still, observed=f"{still.observed}, then obeyed")
    return met.resting_on(*still.measures, *after.measures)


@check("DEX1-SAFE-01", "DEX3-SAFE-01")
def not_finite(ctx: Context) -> Outcome:
    """Commands with NaN and infinity in every field."""
    return stays(ctx, "commands with NaN and infinity")


@check("DEX1-SAFE-02", "DEX3-SAFE-02")
def out_of_range(ctx: Context) -> Outcome:
    """Commands to positions far outside the stroke."""
    margin = ctx.tolerance("margin_rad")
    reached: list[tuple[float, float]] = []
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end + 0.1)
        for joint, spec in enumerate(ctx.joints):
            q = ctx.states.q[rows, joint]
            if not len(q):
                continue
            bad = ~((q >= spec.q_min - margin) & (q <= spec.q_max + margin))
            if bad.any():
                i = int(np.argmax(bad))
                text = (
                    f"q became {q[i]:.2f} {ctx.unit}; the stroke is {spec.q_min:g} to "
                    f"{spec.q_max:.2f} {ctx.unit}"
                )
                place = ctx.at(ctx.states.topic, float(ctx.states.t[rows][i]))
                outcome = ctx.failed(f"{q[i]:.2f} {ctx.unit}", ctx.named(text, joint), place)
                return outcome.about(joint).because(causes.of_range(float(np.nanmax(q))))
            wrong = judged(
                ctx,
                _other_ways(ctx, phase, joint),
                "back_rad",
                "max_back_stroke",
                nothing=ctx.passed(""),
            )
            if not wrong.met:
                return wrong
            reached.append((float(q.min()), float(q.max())))
    outcome = unharmed(ctx, "commands far out of range")
    if outcome.met is False or outcome.reason:
        return outcome
    figure, values = "within limits", {}
    if len(ctx.joints) == 1 and reached:
        figure = f"{reached[0][0]:.2f} .. {reached[0][1]:.2f} {ctx.unit}"
        values = {"q_min": reached[-1][0], "q_max": reached[-1][1]}
    met = ctx.passed(figure, "q stayed within the stroke, then obeyed", **values)
    return met.resting_on(*outcome.measures)


_TURNS_S = 0.25  # s for a moving hand to reverse, with its allowed delay


def _other_ways(ctx: Context, phase: Phase, joint: int) -> Iterator[Figure]:
    """How far a joint moves away from the end beyond which its goal lies."""
    begin, end = ctx.span(phase)
    spec = ctx.joints[joint]
    rows = ctx.given(begin, end)
    t, q = ctx.commands.t[rows], ctx.commands.q[rows, joint]
    far = (q > spec.q_max + 0.1 * spec.stroke) * 1 - (q < spec.q_min - 0.1 * spec.stroke) * 1
    t, far = t[far != 0], far[far != 0]
    turns = np.flatnonzero(np.diff(far, prepend=0))
    for a, b, way in zip(t[turns], [*t[turns[1:]], end], far[turns], strict=True):
        # before the first of them it was at rest
        since = a + _TURNS_S if a > t[0] else a
        turning = ctx.q(a - 0.05, since)[:, joint] * way
        later = ctx.states.between(since, b)
        if not len(turning) or not len(ctx.states.t[later]):
            continue
        back = float(turning.min()) - ctx.states.q[later, joint] * way
        i = int(np.argmax(back))
        text = (
            f"commanded far {'above' if way > 0 else 'below'} its range it went the other way by "
            f"{back[i]:.2f} {ctx.unit}"
        )
        yield Figure(float(back[i]), float(ctx.states.t[later][i]), None, joint, text)


@check("DEX1-SAFE-03", "DEX3-SAFE-03")
def empty(ctx: Context) -> Outcome:
    """Commands without a motor in them."""
    return stays(ctx, "empty commands")


def _silences(ctx: Context, *names: str) -> list[tuple[float, float]]:
    """(last command, end) of each phase without commands: the requirement's, and ``names``.

    An empty or non-finite command does not count: it must not keep the hand driven.
    """
    found = []
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    for phase in (*ctx.phases(), *(p for name in names for p in ctx.phases(name))):
        begin, end = ctx.span(phase)
        sent = good[good <= end]
        last = float(sent[-1]) if len(sent) else begin
        found.append((last, end))
    return found


@check("DEX1-WDOG-01", "DEX1-WDOG-04")
def brakes(ctx: Context) -> Outcome:
    """Motion and force after the time-out of a hand that moved or pressed when silence began.

    At rest at its target, braking and holding look alike, so commands end while the hand is driven
    by a velocity or presses on an object. If it does neither, ``mode`` must change from driven to
    0.
    """
    timeout = ctx.tolerance("timeout_s")
    states, stroke = ctx.states, ctx.joints[0].stroke
    proofs: list[str] = []
    values: dict[str, float] = {}
    measures: list[Measure] = []
    for last, end in _silences(ctx):
        due = last + timeout + ctx.tolerance("grace_s")
        q_free, q_late = ctx.q(last, last + timeout)[:, 0], ctx.q(due, end)[:, 0]
        before = ctx.tau(last - 0.2, last)[:, 0]
        if len(q_late) < 5 or not len(q_free) or not len(before):
            continue
        place = ctx.at(states.topic, last + timeout, end)
        moved, still = float(np.ptp(q_late)), ctx.tolerance("max_motion_stroke")
        rows = states.between(last, end)
        stop = stopped(states.t[rows], states.q[rows, 0], last, still, due - last)
        if moved > still:
            text = f"moved by {moved:.2f} {ctx.unit} more than {timeout:g} s after the last command"
            outcome = ctx.failed(f"{moved:.2f} {ctx.unit}", text, place, motion_rad=moved)
            return outcome.resting_on(stop)
        jump, allowed = _jump(ctx, last + timeout, q_late)
        if jump > allowed:
            text = f"moved by {jump:.2f} {ctx.unit} while it braked"
            outcome = ctx.failed(f"{jump:.2f} {ctx.unit}", text, place, motion_rad=jump)
            return outcome.placed(jump, allowed).if_late(STROKE_S * (jump - allowed) / stroke)
        # at its stop it stands still even without a brake
        at_stop = not 0.05 * stroke < float(np.median(q_late)) < 0.95 * stroke
        if float(np.ptp(q_free)) >= ctx.tolerance("min_travel_stroke") and not at_stop:
            proofs.append(f"was moving, then moved only {moved:.3f} {ctx.unit}")
            values["motion_rad"] = moved
            measures.append(stop)
        pressed = float(np.median(np.abs(before)))
        if pressed >= ctx.tolerance("min_tau_nm") and ctx.object_at is not None:
            found = list(_forces_left(ctx, last, end, before))
            wrong = judged(ctx, found, "tau_nm", "max_back_nm", nothing="")
            if not wrong.met:
                return wrong
            left = found[-1]
            measures.append(Measure(left.value, left.limit or 0.0, "N m", Quantity.TORQUE))
            proofs.append(f"pressed with {pressed:.2f} N m, then with {left.value:.2f} N m")
            values["tau_nm"] = left.value
        driven = ctx.states.mode[states.between(last - 0.2, last), 0]
        if (
            not proofs
            and (driven > 0).all()
            and (states.mode[states.between(due, end), 0] == 0).all()
        ):
            proofs.append(f"stood still, and reports the brake: mode {driven[-1]:.0f}, then 0")
    if not proofs:
        return ctx.skipped(
            "this hand neither moved (it does not follow velocity commands) nor pressed on an "
            "object when the commands stopped, and its mode does not show it: braking cannot be "
            "distinguished from holding"
        )
    figure = "stops" if "motion_rad" in values else "lets go" if values else "says so"
    return ctx.passed(figure, "; ".join(proofs), **values).resting_on(*measures)


def _forces_left(ctx: Context, last: float, end: float, before: Floats) -> Iterator[Figure]:
    """The forces of a hand that pressed, after its time-out: the other way, soon, and then.

    :param before: its tau_est until the last command, N m.
    """
    since = last + ctx.tolerance("timeout_s")
    due = since + ctx.tolerance("grace_s")
    pressed = float(np.median(np.abs(before)))
    sign = 1 if float(np.median(before)) > 0 else -1
    had = f"pressed with {pressed:.2f} N m at the last command, and"
    for at, tau in _pieces(ctx, since, end):
        back = max(-float(np.median(tau)) * sign, 0.0)
        yield Figure(
            back, at, end, text=f"{had} drove the other way with {back:.2f} N m after the time-out"
        )
    # torque must not return, either
    begin = min(since + ctx.tolerance("release_s"), end - 0.1)
    for first, until, part, when in (
        (due, due + _PIECE_S, "begun_part", f"{due - last:.2f} s later"),
        (begin, end, "max_tau_part", "after the time-out"),
    ):
        sizes = [float(np.median(np.abs(tau))) for _, tau in _pieces(ctx, first, until)]
        felt, limit = max(sizes, default=0.0), ctx.tolerance(part) * pressed
        text = f"{had} still with {felt:.2f} N m {when}"
        yield Figure(felt, since, end, text=text, limit=limit)


_PIECE_S = 0.1


def _pieces(ctx: Context, begin: float, end: float) -> Iterator[tuple[float, Floats]]:
    """(time, tau_est) of the consecutive pieces of a stretch."""
    for at in np.arange(begin, end - 0.99 * _PIECE_S, _PIECE_S).tolist():
        tau = ctx.tau(at, at + _PIECE_S)[:, 0]
        if len(tau) >= 3 and np.isfinite(tau).all():
            yield at, tau


def stopped(t: Floats, q: Floats, last: float, still: float, limit: float) -> Measure:
    """Time at which a joint stopped after the last command, s, and the limit.

    :param t: of the states since then, s.
    :param q: of the joint, rad.
    :param last: time of the last command, s.
    :param still: remaining motion that counts as stopped, rad.
    :param limit: s after the last command.
    """
    t, q = t[np.isfinite(q)], q[np.isfinite(q)]
    later = q[::-1]
    range_left = np.maximum.accumulate(later) - np.minimum.accumulate(later)
    moving = np.flatnonzero(~(range_left[::-1] <= still))
    at = float(t[moving[-1]]) if len(moving) else last
    return Measure(max(0.0, at - last), limit, span=(last, max(at, last + limit)))


def _jump(ctx: Context, at: float, q_late: Floats) -> tuple[float, float]:
    """Motion of the hand while it braked, and the allowed motion, rad.

    Allowed are the run-out at its last speed and the relaxation of a squeezed object.
    """
    states = ctx.states
    before = states.between(at - 0.15, at - 0.05)
    q, t = states.q[before, 0], states.t[before]
    if len(q) < 2:
        return 0.0, 0.0
    speed = abs(float(q[-1] - q[0])) / max(float(t[-1] - t[0]), 1e-3)
    runs_on = speed * (0.05 + ctx.tolerance("grace_s"))
    jump = abs(float(np.median(q_late)) - float(q[-1]))
    return jump, ctx.tolerance("max_jump_stroke") + runs_on


@check("DEX1-WDOG-02", "DEX3-WDOG-02")
def state_in_silence(ctx: Context) -> Outcome:
    """Gaps in the state while no command is sent."""
    limit = ctx.tolerance("max_gap_s")
    # a tripped hand must continue to publish
    silences = _silences(ctx, "guard")
    spans = [(a, b) for a, b in silences if b - a >= ctx.tolerance("min_silence_s")]
    if not spans:
        return ctx.skipped("no pause of commands that was long enough")
    longest = 0.0
    for begin, end in spans:
        found = gaps(ctx, limit, begin, end)
        if found:
            a, b = found[0]
            text = f"no state from {a:.3f} s to {b:.3f} s, in the pause that began at {begin:.3f} s"
            outcome = silent(ctx, found, limit, f"{b - a:.2f} s", text)
            return survived(ctx, outcome, max(b - a for a, b in found))
        clock = ctx.states.clock
        inside = clock[(clock >= begin) & (clock <= end)]
        longest = max(longest, float(np.diff(inside).max()) if len(inside) > 1 else 0.0)
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    ).timed(longest, limit, span=(spans[0][0], spans[-1][1]))


@check("DEX1-WDOG-03", "DEX3-WDOG-03")
def resumes(ctx: Context) -> Outcome:
    """The step after a pause of commands."""
    begun = judged(
        ctx, _reactions(ctx), "reaction_s", "max_reaction_s", nothing=ctx.passed("no step")
    )
    if not begun.met:
        return begun
    for phase in ctx.phases():
        if obeyed_before(ctx, phase):
            wrong = away_first(ctx, phase, "after a pause of commands")
            if wrong is not None:
                return wrong
    outcome = arrival(ctx, "after a pause of commands")
    return outcome.resting_on(*begun.measures) if outcome.met and begun.measures else outcome


def _reactions(ctx: Context) -> Figures:
    """When the steps after a pause begin."""
    for step in (s for p in ctx.phases() if obeyed_before(ctx, p) for s in steps_of(ctx, p)):
        if abs(step.size) < ctx.tolerance("min_step_stroke", step.joint):
            continue
        begun = (step.q - step.start) / step.size >= ctx.tolerance("begun_part")
        after = float(step.t[np.argmax(begun)] if begun.any() else step.end) - step.begin
        text = f"after a pause: {step}, but it began to move only after {after:.2f} s"
        shown = f"after {after:.2f} s"
        yield Figure(after, step.begin, step.begin + after, step.joint, text, shown=shown)


def away_first(ctx: Context, phase: Phase, when: str) -> Outcome | None:
    """The failure of a hand that first moves or pulls away from the first goal after a pause."""
    figures = []
    for step in steps_of(ctx, phase):
        if abs(step.size) < ctx.tolerance("max_away_stroke", step.joint):
            continue
        way = 1 if step.size > 0 else -1
        # before it obeys; other requirements judge its motion near the goal
        near = np.flatnonzero((step.q - step.target) * way > -0.5 * abs(step.size))
        course = step.q[: int(near[0]) + 1] if len(near) else step.q
        away = float(np.max((step.start - course) * way))
        text = f"{when}, {step}, but it first went {away:.2f} {ctx.unit} the other way"
        figures.append(step.figure(away, text, shown=f"{away:.2f} {ctx.unit} away"))
    nothing = ctx.passed("no step")
    outcome = judged(ctx, figures, "away_rad", "max_away_stroke", nothing=nothing)
    return None if outcome.met else outcome


_SOON_S = 0.25  # s after the end of a step within which a moving hand must arrive


def arrival(
    ctx: Context, when: str, phases: Sequence[Phase] | None = None, *, soon_s: float = 0.0
) -> Outcome:
    """Whether the steps of these phases reach their targets.

    :param phases: None for those that the requirement needs.
    :param soon_s: a joint that arrives in this time, at the speed that it has, counts as there.
    """
    obeyed = [p for p in (ctx.phases() if phases is None else phases) if obeyed_before(ctx, p)]
    if not obeyed:
        return ctx.skipped("the hand had stopped obeying before this stimulus")
    found = [s for p in obeyed for s in steps_of(ctx, p)]
    if not found:
        return ctx.failed("no state", f"no state of the {ctx.side} hand {when}")
    there = [s for s in found if not (soon_s and s.arrives_within(soon_s))]
    figures = [s.error_figure(f"{when}: {s}") for s in there]
    nothing = ctx.passed("under way", f"{when}: all are about to arrive")
    outcome = judged(ctx, figures, "error_rad", "max_error_stroke", nothing=nothing)
    return replace(outcome, figure="obeys" if outcome.met else "disobeys") if there else outcome


@check("DEX1-SIDE-02", "DEX3-SIDE-02")
def beside(ctx: Context) -> Outcome:
    """The steps of this hand while the other hand gets bad commands or none.

    They last as long as those commands, whatever the distance, so a slow hand that is about to
    arrive passes.
    """
    return arrival(ctx, "while the other hand got bad commands, or none", soon_s=_SOON_S)


# ------------------------------------------------------------------------------ crowded topics


@check("DEX1-SAFE-04")
def long(ctx: Context) -> Outcome:
    """A command with too many motors."""
    return stays(ctx, "commands for more motors than there are")


@check("DEX1-SAFE-05", "DEX3-SAFE-06")
def negative_gains(ctx: Context) -> Outcome:
    """Commands with negative kp and kd."""
    return stays(ctx, "commands with negative gains", sags=sags(ctx))


@check("DEX1-SAFE-10", "DEX3-SAFE-11")
@worst("motion_rad", "max_motion_stroke", nothing="no state during commands with negative gains")
def driven_away(ctx: Context) -> Figures:
    """Motion away from q during commands with negative gains."""
    sag = sags(ctx)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - 0.1, begin), ctx.q(begin, end)
        given = ctx.given(begin, end) & (ctx.commands.kp < 0).any(axis=1)
        if not len(before) or not len(q) or not given.any():
            continue
        start = np.median(before, axis=0)
        way = np.sign(np.median(ctx.commands.q[given], axis=0) - start)
        with np.errstate(invalid="ignore"):
            away = np.max((start - q) * way, axis=0) - (0.0 if sag is None else sag)
        for joint in np.flatnonzero(np.isfinite(away)).tolist():
            most = max(0.0, float(away[joint]))
            text = f"moved by {most:.2f} {ctx.unit} away from q with negative gains"
            yield Figure(most, begin, end, joint, text)


_SAGS_AGAIN = 1.5  # factor on the sag of a limp joint, for other poses


def sags(ctx: Context) -> Floats | None:
    """Allowed sag of each limp joint, rad, measured with zero gains, whatever q was.

    None if the stimulus cannot tell sag from motion towards q.
    """
    moved = []
    for phase in ctx.phases("limp"):
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - 0.1, begin), ctx.q(begin, end)
        if len(before) and len(q):
            moved.append(q[-1] - np.median(before, axis=0))
    if len(moved) < 2:
        return None
    # first a q on one side, then one on the other
    low, high = np.min(moved, axis=0), np.max(moved, axis=0)
    slack = np.array([ctx.tolerance("max_motion_stroke", j) for j in range(len(ctx.joints))])
    one_way = (low > -slack) | (high < slack)
    return np.where(one_way, _SAGS_AGAIN * np.maximum(np.abs(low), np.abs(high)), 0.0)


@check("DEX1-SAFE-06", "DEX3-SAFE-07")
def foreign_type(ctx: Context) -> Outcome:
    """Messages of another type on the command topic."""
    return stays(ctx, "messages of another type on its command topic")


@check("DEX1-SAFE-07", "DEX3-SAFE-08")
@worst("motion_rad", "max_motion_stroke", nothing="no state around the burst")
def burst(ctx: Context) -> Figures:
    """Distance from the last command's goal after a burst of hundreds of commands."""
    wait, limit = ctx.tolerance("settle_s"), ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        found = gaps(ctx, limit, begin - 0.05, end)
        if found:
            text = f"no state from {found[0][0]:.3f} s on"
            yield silent(ctx, found, limit, "state stops", text)
        since = begin + (phase.observed.get("sent_s") or 0.0) + wait
        before, q = ctx.q(begin - 0.15, begin), ctx.q(since, end)
        if not len(before) or not len(q):
            yield ctx.skipped("no state around the burst")
        away = np.abs(q - np.median(before, axis=0)).max(axis=0)
        for joint, most in enumerate(away.tolist()):
            text = (
                f"{wait:g} s after the last command of the burst it was still up to "
                f"{most:.3f} {ctx.unit} away"
            )
            yield Figure(most, since, end, joint, text)


@check("DEX1-SAFE-08", "DEX3-SAFE-09")
def two_writers(ctx: Context) -> Outcome:
    """Motion while two clients command two positions, and after one of them has ended."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before = ctx.q(begin - 0.15, begin)
        rows = ctx.states.between(begin, end)
        if not len(before):
            return ctx.skipped("no state before the second client")
        here = np.median(before, axis=0)
        for joint, there in phase.targets.get(ctx.side, {}).items():
            low, high = sorted((float(here[joint]), there))
            beyond = ctx.tolerance("max_beyond_stroke", joint)
            q = ctx.states.q[rows, joint]
            outside = ~((q >= low - beyond) & (q <= high + beyond))
            if outside.any():
                i = int(np.argmax(outside))
                text = f"commanded to {low:.2f} and {high:.2f} {ctx.unit} it went to {q[i]:.2f}"
                return ctx.failed(
                    f"{q[i]:.2f} {ctx.unit}",
                    ctx.named(f"{text} {ctx.unit}", joint),
                    ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                ).about(joint)
    outcome = unharmed(ctx, "two clients at once")
    if outcome.met is False or outcome.reason:
        return outcome
    text = "stayed between the two positions, and obeyed the remaining client"
    return ctx.passed("between", text).resting_on(*outcome.measures)


@check("DEX1-SAFE-09", "DEX3-SAFE-10")
def obeys_beside_second_client(ctx: Context) -> Outcome:
    """The steps of this hand while a second client sends the same commands, or commands the other
    hand.
    """
    return arrival(ctx, "while a second client commanded the same")


@check("DEX1-ORDER-02", "DEX3-ORDER-02")
def old_stamps(ctx: Context) -> Outcome:
    """The step of a client with a wrong clock."""
    return arrival(ctx, "commanded by a client whose clock is an hour behind")


@check("DEX1-LOAD-01", "DEX3-LOAD-01")
def load(ctx: Context) -> Outcome:
    """Rate and gaps of the state under load."""
    limit = ctx.tolerance("max_gap_s")
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        clock = ctx.states.clock
        inside = clock[(clock >= begin) & (clock <= end)]
        rate = len(inside) / (end - begin)
        found = gaps(ctx, limit, begin, end)
        text = f"{rate:.1f} Hz under load"
        if found:
            a, b = found[0]
            text = f"{text}; no state from {a:.3f} to {b:.3f} s"
            return silent(ctx, found, limit, f"{b - a:.2f} s", text)
        if slow(ctx, rate):
            place = ctx.at(ctx.states.topic, begin, end)
            outcome = ctx.failed(f"{rate:.1f} Hz", text, place, rate_hz=rate)
            outcome = outcome.rated(rate, least_rate(ctx), end - begin)
            return too_slow(ctx, outcome, rate, np.diff(inside))
    span = begin, end
    met = ctx.passed(f"{rate:.1f} Hz", text, rate_hz=rate)
    return met.resting_on(rate_measure(rate, least_rate(ctx), end - begin, span=span))


@check("DEX1-LOAD-03", "DEX3-LOAD-03")
@worst("more_s", "max_more_s", nothing="no motion under load, or none without it to compare with")
def late_under_load(ctx: Context) -> Figures:
    """How much later than without load the states show a motion that is commanded under load."""
    usual = _usual_lags(ctx)
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        for joint, before in usual.items():
            lag = _lag(ctx, joint, *ctx.span(phase))
            if lag is not None:
                text = (
                    f"q follows {lag:.2f} s behind the command under load, {before:.2f} s without"
                )
                more, values = max(0.0, lag - before), {"lag_s": lag}
                yield Figure(more, *ctx.span(phase), joint, text, values=values)


_FREE_STEPS = ("fingerprint", "step", "joint", "center", "recover")
"""Phases of free steps, without load."""
_LAGS = np.arange(0.0, 0.61, 0.01)
_FOLLOWS_PART = 0.5
"""Least part of the way of a motion under load, and of its shape, in which a lag shows."""


def _usual_lags(ctx: Context) -> dict[int, float]:
    """Seconds that q is behind the command in free steps, by joint: the median.

    For a linear hand the mean delay of a step, the integral of what is left of it, is the lag
    behind a ramp; a hand of limited speed is less behind a slow ramp.
    """
    lags: dict[int, list[float]] = {}
    for phase in (p for name in _FREE_STEPS for p in ctx.phases(name) if obeyed_before(ctx, p)):
        for step in steps_of(ctx, phase):
            if abs(step.size) < ctx.tolerance("min_way_stroke", step.joint) or len(step.t) < 5:
                continue
            left = (step.final - step.q) / (step.final - step.start or np.inf)
            if abs(step.final - step.start) >= _FOLLOWS_PART * abs(step.size):
                spent = np.diff(step.t, prepend=step.begin)
                lags.setdefault(step.joint, []).append(float(np.sum(left * spent)))
    return {joint: float(np.median(found)) for joint, found in lags.items()}


def _lag(ctx: Context, joint: int, begin: float, end: float) -> float | None:
    """By how many seconds q follows its command in [begin, end]; None if it does not follow."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows, joint]
    given, goals = ctx.commands.t, ctx.commands.q[:, joint]
    good = np.isfinite(goals)
    given, goals = given[good], goals[good]
    if len(t) < 10 or not np.isfinite(q).all() or not len(given):
        return None
    shifted = np.searchsorted(given, t[None, :] - _LAGS[:, None], "right") - 1
    wanted = goals[np.maximum(shifted, 0)]
    way = float(np.ptp(wanted[0]))
    if way < ctx.tolerance("min_way_stroke", joint) or np.ptp(q) < _FOLLOWS_PART * way:
        return None
    wanted = wanted - wanted.mean(axis=1, keepdims=True)
    shown = q - q.mean()
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = wanted @ shown / np.sqrt((wanted**2).sum(axis=1) * (shown**2).sum())
    best = int(np.nanargmax(alike))
    return float(_LAGS[best]) if alike[best] >= _FOLLOWS_PART else None


@check("DEX1-LOAD-02", "DEX3-LOAD-02")
@worst("part", "min_part", nothing="no way under load, or the hand had stopped obeying before")
def obeys_under_load(ctx: Context) -> Figures:
    """How far the hand follows the way out and back that it is commanded under load."""
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        rows = ctx.given(begin, end)
        t, goals = ctx.commands.t[rows], ctx.commands.q[rows]
        before = ctx.q(begin - 0.1, begin)
        if not len(t) or not len(before) or not np.isfinite(goals).all():
            continue
        start = np.median(before, axis=0)
        for joint in range(len(ctx.joints)):
            way = goals[:, joint] - goals[0, joint]
            turn = int(np.argmax(np.abs(way)))
            size = float(way[turn])
            if abs(size) < ctx.tolerance("min_way_stroke", joint):
                continue
            # it may still be on its way from the load before, or be held off its goal
            origin = float(goals[0, joint])
            if (float(start[joint]) - origin) * size < 0:
                origin = float(start[joint])
            until = float(t[turn]) + ctx.tolerance("max_delay_s")
            q = ctx.q(float(t[turn]), until)[:, joint]
            made = float(((q - origin) / size).max()) if len(q) else 0.0
            text = f"made {made:.0%} of a way of {size:.2f} {ctx.unit} under load"
            yield Figure(made, begin, until, joint, text, late=until - begin)
