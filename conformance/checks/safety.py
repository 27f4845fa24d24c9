"""Check invalid commands, missing commands, several clients and load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dexkit.conformance.checks import (
    STROKE_S,
    Context,
    Outcome,
    causes,
    check,
    rate_measure,
)
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
            a, b = found[0]
            outcome = ctx.failed(
                "state stops",
                f"state stopped at {a:.3f} s, during {what}",
                ctx.at(topic, a, b),
            )
            return outcome.resting_on(*gap_measures(found, limit)).if_late(b - a - limit)
        measures.append(longest_gap(ctx, limit, begin - 0.05, end + 0.2))
        step = _recovery(ctx, phase)
        if step is None:
            return ctx.failed(
                "no state",
                f"no state after {what}, when a good command was sent",
                ctx.at(topic, end),
            )
        if step.error > ctx.tolerance("max_error_stroke", step.joint):
            return (
                ctx.failed(
                    "disobeys",
                    f"after {what}: {step}",
                    ctx.at(topic, step.begin, step.end),
                    error_rad=step.error,
                )
                .about(step.joint)
                .placed(step.error, ctx.tolerance("max_error_stroke", step.joint))
                .if_late(STROKE_S * step.error / step.stroke)
            )
    return Outcome(None).resting_on(*measures)


def moves(
    ctx: Context, what: str, joints: Sequence[int] | None = None, sags: Floats | None = None
) -> Outcome:
    """Fail if a joint moves during the phase; otherwise pass, with the motion.

    :param joints: those that must not move; None for all.
    :param sags: allowed motion of each joint by gravity, rad; None for none.
    """
    far: tuple[float, float, int] = (0.0, 0.0, 0)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        rows = ctx.states.between(begin, end)
        before = ctx.states.q[ctx.states.between(begin - 0.1, begin)]
        q = ctx.states.q[rows]
        if not len(before) or not len(q):
            continue
        with np.errstate(invalid="ignore"):
            deviation = np.abs(q - np.median(before, axis=0))
        for joint in range(len(ctx.joints)) if joints is None else joints:
            column = deviation[:, joint]
            if not np.isfinite(column).all():
                i = int(np.argmin(np.isfinite(column)))
                return ctx.failed(
                    "q not finite",
                    ctx.named(f"q became {q[i, joint]} during {what}", joint),
                    ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                ).about(joint)
            i = int(np.argmax(column))
            most = float(column[i])
            if sags is not None:
                most = max(0.0, most - float(sags[joint]))
            if most > ctx.tolerance("max_motion_stroke", joint):
                return (
                    ctx.failed(
                        f"{most:.2f} {ctx.unit}",
                        ctx.named(f"moved by {most:.2f} {ctx.unit} during {what}", joint),
                        ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                        motion_rad=most,
                    )
                    .about(joint)
                    .placed(most, ctx.tolerance("max_motion_stroke", joint))
                    .if_late(STROKE_S * most / ctx.joints[joint].stroke)
                )
            far = max(far, (most / ctx.joints[joint].stroke, most, joint))
    _, most, joint = far
    return ctx.passed(
        f"{most:.3f} {ctx.unit}",
        ctx.named(f"moved by {most:.3f} {ctx.unit} during {what}", joint),
        motion_rad=most,
    ).placed(most, ctx.tolerance("max_motion_stroke", joint))


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
    reached: list[str] = []
    values: dict[str, float] = {}
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
                return (
                    ctx.failed(
                        f"{q[i]:.2f} {ctx.unit}",
                        ctx.named(
                            f"q became {q[i]:.2f} {ctx.unit}; the stroke is {spec.q_min:g} to "
                            f"{spec.q_max:.2f} {ctx.unit}",
                            joint,
                        ),
                        ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                    )
                    .about(joint)
                    .because(causes.of_range(float(np.nanmax(q))))
                )
            wrong = _other_way(ctx, phase, joint)
            if wrong is not None:
                return wrong
            reached.append(f"{float(q.min()):.2f} .. {float(q.max()):.2f} {ctx.unit}")
            values = {"q_min": float(q.min()), "q_max": float(q.max())}
    outcome = unharmed(ctx, "commands far out of range")
    if outcome.met is False or outcome.reason:
        return outcome
    figure = reached[0] if len(ctx.joints) == 1 and reached else "within limits"
    return ctx.passed(
        figure,
        "q stayed within the stroke, then obeyed",
        **(values if len(ctx.joints) == 1 else {}),
    ).resting_on(*outcome.measures)


_TURNS_S = 0.25  # s for a moving hand to reverse, with its allowed delay


def _other_way(ctx: Context, phase: Phase, joint: int) -> Outcome | None:
    """The failure of a joint that moves away from the end beyond which its goal lies."""
    begin, end = ctx.span(phase)
    spec = ctx.joints[joint]
    rows = (ctx.commands.t >= begin) & (ctx.commands.t <= end)
    t, q = ctx.commands.t[rows], ctx.commands.q[rows, joint]
    far = (q > spec.q_max + 0.1 * spec.stroke) * 1 - (q < spec.q_min - 0.1 * spec.stroke) * 1
    t, far = t[far != 0], far[far != 0]
    if not len(far):
        return None
    turns = np.flatnonzero(np.diff(far, prepend=0))
    for a, b, way in zip(t[turns], [*t[turns[1:]], end], far[turns], strict=True):
        # before the first of them it was at rest
        since = a + _TURNS_S if a > t[0] else a
        turning = ctx.states.q[ctx.states.between(a - 0.05, since), joint] * way
        later = ctx.states.between(since, b)
        if not len(turning) or not len(ctx.states.t[later]):
            continue
        back = float(turning.min()) - ctx.states.q[later, joint] * way
        i = int(np.argmax(back))
        if back[i] > ctx.tolerance("max_back_stroke", joint):
            return (
                ctx.failed(
                    f"{back[i]:.2f} {ctx.unit}",
                    ctx.named(
                        f"commanded far {'above' if way > 0 else 'below'} its range it went the "
                        f"other way by {back[i]:.2f} {ctx.unit}",
                        joint,
                    ),
                    ctx.at(ctx.states.topic, float(ctx.states.t[later][i])),
                    back_rad=float(back[i]),
                )
                .about(joint)
                .placed(float(back[i]), ctx.tolerance("max_back_stroke", joint))
                .if_late(STROKE_S * float(back[i]) / spec.stroke)
            )
    return None


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
    states = ctx.states
    proofs: list[str] = []
    values: dict[str, float] = {}
    measures: list[Measure] = []
    for last, end in _silences(ctx):
        free = states.between(last, last + timeout)
        late = states.between(last + timeout + ctx.tolerance("grace_s"), end)
        q_free, q_late = states.q[free, 0], states.q[late, 0]
        before = states.tau[states.between(last - 0.2, last), 0]
        if len(q_late) < 5 or not len(q_free) or not len(before):
            continue
        moved = float(np.ptp(q_late))
        stop = stopped(
            *(states.t[states.between(last, end)], states.q[states.between(last, end), 0]),
            last,
            ctx.tolerance("max_motion_stroke"),
            timeout + ctx.tolerance("grace_s"),
        )
        if moved > ctx.tolerance("max_motion_stroke"):
            outcome = ctx.failed(
                f"{moved:.2f} {ctx.unit}",
                f"moved by {moved:.2f} {ctx.unit} more than {timeout:g} s after the last command",
                ctx.at(states.topic, last + timeout, end),
                motion_rad=moved,
            )
            return outcome.resting_on(stop)
        jump, allowed = _jump(ctx, last + timeout, q_late)
        if jump > allowed:
            outcome = ctx.failed(
                f"{jump:.2f} {ctx.unit}",
                f"moved by {jump:.2f} {ctx.unit} while it braked",
                ctx.at(states.topic, last + timeout, end),
                motion_rad=jump,
            ).placed(jump, allowed)
            return outcome.if_late(STROKE_S * (jump - allowed) / ctx.joints[0].stroke)
        # at its stop it stands still even without a brake
        stroke = ctx.joints[0].stroke
        at_stop = not 0.05 * stroke < float(np.median(q_late)) < 0.95 * stroke
        if float(np.ptp(q_free)) >= ctx.tolerance("min_travel_stroke") and not at_stop:
            proofs.append(f"was moving, then moved only {moved:.3f} {ctx.unit}")
            values["motion_rad"] = moved
            measures.append(stop)
        pressed = float(np.median(np.abs(before)))
        if pressed >= ctx.tolerance("min_tau_nm") and ctx.object_at is not None:
            still = _presses(ctx, last + timeout, end)
            usual = float(np.median(states.tau[states.between(last - 0.2, last), 0]))
            back = _opposes(ctx, last + timeout, end, usual)
            if back is not None:
                return ctx.failed(
                    f"{back[1]:.2f} N m",
                    f"pressed with {pressed:.2f} N m at the last command, and drove the other way "
                    f"with {back[1]:.2f} N m after the time-out",
                    ctx.at(states.topic, back[0], end),
                    tau_nm=back[1],
                ).pressed(back[1], ctx.tolerance("max_back_nm"))
            due = last + timeout + ctx.tolerance("grace_s")
            limits = (
                (_first_size(ctx, due), "begun_part", f"{due - last:.2f} s later"),
                (still, "max_tau_part", "after the time-out"),
            )
            for felt, part, when in limits:
                most = ctx.tolerance(part) * pressed
                if felt > most:
                    return ctx.failed(
                        f"{felt:.2f} N m",
                        f"pressed with {pressed:.2f} N m at the last command, and still with "
                        f"{felt:.2f} N m {when}",
                        ctx.at(states.topic, last + timeout, end),
                        tau_nm=felt,
                    ).pressed(felt, most)
            measures.append(
                Measure(still, ctx.tolerance("max_tau_part") * pressed, "N m", Quantity.TORQUE)
            )
            proofs.append(f"pressed with {pressed:.2f} N m, then with {still:.2f} N m")
            values["tau_nm"] = still
        driven = states.mode[states.between(last - 0.2, last), 0]
        if not proofs and (driven > 0).all() and (states.mode[late, 0] == 0).all():
            proofs.append(f"stood still, and reports the brake: mode {driven[-1]:.0f}, then 0")
    if not proofs:
        return ctx.skipped(
            "this hand neither moved (it does not follow velocity commands) nor pressed on an "
            "object when the commands stopped, and its mode does not show it: braking cannot be "
            "distinguished from holding"
        )
    figure = "stops" if "motion_rad" in values else "lets go" if values else "says so"
    return ctx.passed(figure, "; ".join(proofs), **values).resting_on(*measures)


def _presses(ctx: Context, since: float, end: float) -> float:
    """The largest abs(tau_est) in any piece of a braked stretch: torque must not return."""
    begin = min(since + ctx.tolerance("release_s"), end - 0.1)
    return max((size for _, size in _pieces(ctx, begin, end)), key=abs, default=0.0)


def _opposes(ctx: Context, since: float, end: float, before: float) -> tuple[float, float] | None:
    """Time and torque at which a hand that pressed drives in the opposite direction while
    braking.
    """
    for at, _ in _pieces(ctx, since, end):
        tau = ctx.states.tau[ctx.states.between(at, at + _PIECE_S), 0]
        back = -float(np.median(tau)) * (1 if before > 0 else -1)
        if back > ctx.tolerance("max_back_nm"):
            return at, back
    return None


_PIECE_S = 0.1


def _first_size(ctx: Context, begin: float) -> float:
    """The median abs(tau_est) of the piece that begins then, N m; 0 without states."""
    return max((size for _, size in _pieces(ctx, begin, begin + _PIECE_S)), default=0.0)


def _pieces(ctx: Context, begin: float, end: float) -> list[tuple[float, float]]:
    """(time, median abs(tau_est)) of the consecutive pieces of a stretch."""
    found = []
    for at in np.arange(begin, end - 0.99 * _PIECE_S, _PIECE_S):
        tau = ctx.states.tau[ctx.states.between(float(at), float(at) + _PIECE_S), 0]
        if len(tau) >= 3 and np.isfinite(tau).all():
            found.append((float(at), float(np.median(np.abs(tau)))))
    return found


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
            outcome = ctx.failed(
                f"{b - a:.2f} s",
                f"no state from {a:.3f} s to {b:.3f} s, in the pause that began at {begin:.3f} s",
                ctx.at(ctx.states.topic, a, b),
                max_gap_s=b - a,
            )
            outcome = survived(ctx, outcome, max(b - a for a, b in found))
            return outcome.resting_on(*gap_measures(found, limit)).if_late(b - a - limit)
        clock = ctx.states.clock
        inside = clock[(clock >= begin) & (clock <= end)]
        longest = max(longest, float(np.diff(inside).max()) if len(inside) > 1 else 0.0)
    return ctx.passed(
        f"{longest * 1e3:.1f} ms", f"longest gap {longest * 1e3:.1f} ms", max_gap_s=longest
    ).timed(longest, limit, span=(spans[0][0], spans[-1][1]))


@check("DEX1-WDOG-03", "DEX3-WDOG-03")
def resumes(ctx: Context) -> Outcome:
    """The step after a pause of commands."""
    limit = ctx.tolerance("max_reaction_s")
    slowest: tuple[float, Step] | None = None
    judged = [p for p in ctx.phases() if obeyed_before(ctx, p)]
    for step in (s for p in judged for s in steps_of(ctx, p)):
        if abs(step.size) >= ctx.tolerance("min_step_stroke", step.joint):
            begun = (step.q - step.start) / step.size >= ctx.tolerance("begun_part")
            after = float(step.t[np.argmax(begun)] if begun.any() else step.end) - step.begin
            if slowest is None or after > slowest[0]:
                slowest = after, step
    if slowest is not None and slowest[0] > limit:
        after, step = slowest
        return (
            ctx.failed(
                f"after {after:.2f} s",
                f"after a pause: {step}, but it began to move only after {after:.2f} s",
                ctx.at(ctx.states.topic, step.begin, step.begin + after),
                reaction_s=after,
            )
            .about(step.joint)
            .timed(after, limit)
            .if_late(after - limit)
        )
    for phase in judged:
        wrong = away_first(ctx, phase, "after a pause of commands")
        if wrong is not None:
            return wrong
    outcome = arrival(ctx, "after a pause of commands")
    if outcome.met and slowest is not None:
        span = slowest[1].begin, slowest[1].end
        return outcome.timed(slowest[0], limit, span=span)
    return outcome


def away_first(ctx: Context, phase: Phase, when: str) -> Outcome | None:
    """The failure of a hand that first moves or pulls away from the first goal after a pause."""
    for step in steps_of(ctx, phase):
        limit = ctx.tolerance("max_away_stroke", step.joint)
        if abs(step.size) < limit:
            continue
        way = 1 if step.size > 0 else -1
        # before it obeys; other requirements judge its motion near the goal
        near = np.flatnonzero((step.q - step.target) * way > -0.5 * abs(step.size))
        course = step.q[: int(near[0]) + 1] if len(near) else step.q
        away = float(np.max((step.start - course) * way))
        if away > limit:
            text = f"{when}, {step}, but it first went {away:.2f} {ctx.unit} the other way"
            place = ctx.at(ctx.states.topic, step.begin, step.end)
            outcome = ctx.failed(f"{away:.2f} {ctx.unit} away", text, place, away_rad=away)
            return outcome.about(step.joint).placed(away, limit)
    return None


_SOON_S = 0.25  # s after the end of a step within which a moving hand must arrive


def arrival(
    ctx: Context, when: str, phases: Sequence[Phase] | None = None, *, soon_s: float = 0.0
) -> Outcome:
    """Whether the steps of these phases reach their targets.

    :param phases: None for those that the requirement needs.
    :param soon_s: a joint that arrives in this time, at the speed that it has, counts as there.
    """
    judged = [p for p in (ctx.phases() if phases is None else phases) if obeyed_before(ctx, p)]
    if not judged:
        return ctx.skipped("the hand had stopped obeying before this stimulus")
    found = [s for p in judged for s in steps_of(ctx, p)]
    if not found:
        return ctx.failed("no state", f"no state of the {ctx.side} hand {when}")
    there = [s for s in found if not (soon_s and s.arrives_within(soon_s))]
    worst = max(there or found, key=lambda s: s.error / s.stroke)
    if not there:
        return ctx.passed("under way", f"{when}: {worst}, and is about to arrive")
    if worst.error <= ctx.tolerance("max_error_stroke", worst.joint):
        met = ctx.passed("obeys", f"{when}: {worst}", error_rad=worst.error)
        return met.placed(worst.error, ctx.tolerance("max_error_stroke", worst.joint))
    return disobeyed(ctx, when, worst)


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
def driven_away(ctx: Context) -> Outcome:
    """Motion away from q during commands with negative gains."""
    sag = sags(ctx)
    worst: tuple[float, float, int, float, float] | None = None
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before = ctx.states.q[ctx.states.between(begin - 0.1, begin)]
        q = ctx.states.q[ctx.states.between(begin, end)]
        given = (ctx.commands.t >= begin) & (ctx.commands.t <= end)
        given &= (ctx.commands.kp < 0).any(axis=1)
        if not len(before) or not len(q) or not given.any():
            continue
        start = np.median(before, axis=0)
        way = np.sign(np.median(ctx.commands.q[given], axis=0) - start)
        with np.errstate(invalid="ignore"):
            away = np.max((start - q) * way, axis=0) - (0.0 if sag is None else sag)
        for joint, spec in enumerate(ctx.joints):
            found = (float(away[joint]) / spec.stroke, float(away[joint]), joint, begin, end)
            if np.isfinite(found[0]) and (worst is None or found > worst):
                worst = found
    if worst is None:
        return ctx.skipped("no state during commands with negative gains")
    _, most, joint, begin, end = worst
    most = max(0.0, most)
    text = ctx.named(f"moved by {most:.2f} {ctx.unit} away from q with negative gains", joint)
    figure, limit = f"{most:.2f} {ctx.unit}", ctx.tolerance("max_motion_stroke", joint)
    if most <= limit:
        return ctx.passed(figure, text, motion_rad=most).placed(most, limit)
    place = ctx.at(ctx.states.topic, begin, end)
    outcome = ctx.failed(figure, text, place, motion_rad=most).about(joint)
    return outcome.placed(most, limit).if_late(STROKE_S * most / ctx.joints[joint].stroke)


_SAGS_AGAIN = 1.5  # factor on the sag of a limp joint, for other poses


def sags(ctx: Context) -> Floats | None:
    """Allowed sag of each limp joint, rad, measured with zero gains, whatever q was.

    None if the stimulus cannot tell sag from motion towards q.
    """
    moved = []
    for phase in ctx.phases("limp"):
        begin, end = ctx.span(phase)
        before = ctx.states.q[ctx.states.between(begin - 0.1, begin)]
        q = ctx.states.q[ctx.states.between(begin, end)]
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
def burst(ctx: Context) -> Outcome:
    """Distance from the last command's goal after a burst of hundreds of commands."""
    topic = ctx.states.topic
    wait = ctx.tolerance("settle_s")
    far: tuple[float, float, int] = (0.0, 0.0, 0)
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        silent = gaps(ctx, ctx.tolerance("max_gap_s"), begin - 0.05, end)
        if silent:
            a, b = silent[0]
            outcome = ctx.failed("state stops", f"no state from {a:.3f} s on", ctx.at(topic, a, b))
            outcome = outcome.resting_on(*gap_measures(silent, ctx.tolerance("max_gap_s")))
            return outcome.if_late(b - a - ctx.tolerance("max_gap_s"))
        before = ctx.states.q[ctx.states.between(begin - 0.15, begin)]
        sent = begin + (phase.observed.get("sent_s") or 0.0)
        q = ctx.states.q[ctx.states.between(sent + wait, end)]
        if not len(before) or not len(q):
            return ctx.skipped("no state around the burst")
        away = np.abs(q - np.median(before, axis=0)).max(axis=0)
        for joint, spec in enumerate(ctx.joints):
            far = max(far, (float(away[joint]) / spec.stroke, float(away[joint]), joint))
            if away[joint] > ctx.tolerance("max_motion_stroke", joint):
                return (
                    ctx.failed(
                        f"{away[joint]:.2f} {ctx.unit}",
                        ctx.named(
                            f"{wait:g} s after the last command of the burst it was still up to "
                            f"{away[joint]:.2f} {ctx.unit} away",
                            joint,
                        ),
                        ctx.at(topic, sent + wait, end),
                        motion_rad=float(away[joint]),
                    )
                    .about(joint)
                    .placed(float(away[joint]), ctx.tolerance("max_motion_stroke", joint))
                    .if_late(STROKE_S * float(away[joint]) / spec.stroke)
                )
    return ctx.passed(
        f"{far[1]:.3f} {ctx.unit}",
        ctx.named(f"within {far[1]:.3f} {ctx.unit} {wait:g} s after the burst", far[2]),
        motion_rad=far[1],
    ).placed(far[1], ctx.tolerance("max_motion_stroke", far[2]))


@check("DEX1-SAFE-08", "DEX3-SAFE-09")
def two_writers(ctx: Context) -> Outcome:
    """Motion while two clients command two positions, and after one of them has ended."""
    margin = ctx.tolerance
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before = ctx.states.q[ctx.states.between(begin - 0.15, begin)]
        rows = ctx.states.between(begin, end)
        if not len(before):
            return ctx.skipped("no state before the second client")
        here = np.median(before, axis=0)
        for joint, there in phase.targets.get(ctx.side, {}).items():
            low, high = sorted((float(here[joint]), there))
            beyond = margin("max_beyond_stroke", joint)
            q = ctx.states.q[rows, joint]
            outside = ~((q >= low - beyond) & (q <= high + beyond))
            if outside.any():
                i = int(np.argmax(outside))
                return ctx.failed(
                    f"{q[i]:.2f} {ctx.unit}",
                    ctx.named(
                        f"commanded to {low:.2f} and {high:.2f} {ctx.unit} it went to "
                        f"{q[i]:.2f} {ctx.unit}",
                        joint,
                    ),
                    ctx.at(ctx.states.topic, float(ctx.states.t[rows][i])),
                ).about(joint)
    outcome = unharmed(ctx, "two clients at once")
    if outcome.met is False or outcome.reason:
        return outcome
    return ctx.passed(
        "between", "stayed between the two positions, and obeyed the remaining client"
    ).resting_on(*outcome.measures)


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
            outcome = ctx.failed(
                f"{b - a:.2f} s",
                f"{text}; no state from {a:.3f} to {b:.3f} s",
                ctx.at(ctx.states.topic, a, b),
                rate_hz=rate,
            )
            return outcome.resting_on(*gap_measures(found, limit)).if_late(b - a - limit)
        if slow(ctx, rate):
            outcome = ctx.failed(
                f"{rate:.1f} Hz", text, ctx.at(ctx.states.topic, begin, end), rate_hz=rate
            )
            outcome = outcome.rated(rate, least_rate(ctx), end - begin)
            return too_slow(ctx, outcome, rate, np.diff(inside))
    span = begin, end
    met = ctx.passed(f"{rate:.1f} Hz", text, rate_hz=rate)
    return met.resting_on(rate_measure(rate, least_rate(ctx), end - begin, span=span))


@check("DEX1-LOAD-03", "DEX3-LOAD-03")
def late_under_load(ctx: Context) -> Outcome:
    """How much later than without load the states show a motion that is commanded under load."""
    worst: tuple[float, int, float, float, float, float] | None = None
    usual = _usual_lags(ctx)
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        for joint in usual:
            lag = _lag(ctx, joint, begin, end)
            if lag is None:
                continue
            found = (lag - usual[joint], joint, begin, end, lag, usual[joint])
            worst = found if worst is None or found > worst else worst
    if worst is None:
        return ctx.skipped("no motion under load, or none without it to compare with")
    more, joint, begin, end, lag, before = worst
    more = max(0.0, more)
    text = ctx.named(
        f"q follows {lag:.2f} s behind the command under load, {before:.2f} s without", joint
    )
    figure, limit = f"{more:.2f} s", ctx.tolerance("max_more_s")
    if more <= limit:
        return ctx.passed(figure, text, lag_s=lag).timed(more, limit, span=(begin, end))
    place = ctx.at(ctx.states.topic, begin, end)
    outcome = ctx.failed(figure, text, place, lag_s=lag).about(joint)
    return outcome.timed(more, limit).if_late(more - limit)


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
def obeys_under_load(ctx: Context) -> Outcome:
    """How far the hand follows the way out and back that it is commanded under load."""
    worst: tuple[float, int, float, float, float] | None = None
    for phase in (p for p in ctx.phases() if obeyed_before(ctx, p)):
        begin, end = ctx.span(phase)
        rows = (ctx.commands.t >= begin) & (ctx.commands.t <= end)
        t, goals = ctx.commands.t[rows], ctx.commands.q[rows]
        before = ctx.states.q[ctx.states.between(begin - 0.1, begin)]
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
            q = ctx.states.q[ctx.states.between(float(t[turn]), until), joint]
            made = float(((q - origin) / size).max()) if len(q) else 0.0
            found = (made, joint, begin, until, size)
            worst = found if worst is None or found < worst else worst
    if worst is None:
        return ctx.skipped("no way under load, or the hand had stopped obeying before")
    made, joint, begin, until, size = worst
    text = ctx.named(f"made {made:.0%} of a way of {size:.2f} {ctx.unit} under load", joint)
    limit = ctx.tolerance("min_part")
    if made >= limit:
        return ctx.passed(f"{made:.0%}", text, part=made)
    place = ctx.at(ctx.states.topic, begin, until)
    outcome = ctx.failed(f"{made:.0%}", text, place, part=made).about(joint)
    return outcome.if_late(until - begin)
