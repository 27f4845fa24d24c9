"""Checks for hands of several joints: order of joints, mode byte, and for a Dex3-1 sensors and
time-out protection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.figures import Figure, judged, with_object
from dexkit.conformance.checks.force import squeezes
from dexkit.conformance.checks.grip import torque_scales
from dexkit.conformance.checks.motion import (
    half_way,
    least_half_way,
    limited_by_speed,
    not_driven,
    slower,
    steps_of,
)
from dexkit.conformance.checks.safety import arrival, stays, stopped
from dexkit.conformance.hands import JointRoles, under_test
from dexkit.conformance.median import medians
from dexkit.conformance.motor_messages import MotorCodec
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import Floats, JointMode
from dexkit.models import ModeByte

_SLOTS = 12  # of a PressSensorState_


# ------------------------------------------------------------------------------------- topics


@check("DEX3-TOPIC-03")
def low_rate_topic(ctx: Context) -> Outcome:
    """The low-rate copy of the state."""
    dialect = ctx.recording.dialect
    topic = dialect.low_rate_topic.format(side=ctx.side)
    found = [
        c
        for c in ctx.recording.channels
        if c.topic == topic and c.type_name == dialect.state_type and c.message_count
    ]
    if not found:
        return ctx.failed("no topic", f"no process publishes {topic} with {dialect.state_type}")
    rate = found[0].message_count / max(ctx.recording.duration, 1e-9)
    text = f"{found[0].message_count} samples on {topic}, {rate:.1f} Hz"
    if rate < ctx.tolerance("min_rate_hz"):
        return ctx.failed(f"{rate:.1f} Hz", text, rate_hz=rate).because(
            "The period has another unit, or a state is copied only now and then."
        )
    if rate <= ctx.tolerance("max_rate_hz"):
        return ctx.passed(f"{rate:.0f} Hz", text, rate_hz=rate)
    return ctx.failed(f"{rate:.0f} Hz", text, rate_hz=rate).because(
        "Every state is copied to the slow topic, too."
    )


@check("DEX3-START-02")
def rest_pose(ctx: Context) -> Outcome:
    """Whether any q is not 0 before the first command."""
    first = float(ctx.commands.t[0]) if len(ctx.commands) else float("inf")
    q = ctx.states.q[ctx.states.t < first]
    q = q[np.isfinite(q).all(axis=1)]
    if not len(q):
        return ctx.skipped("no state before the first command")
    most = np.abs(q).max(axis=1)
    # zeros before the first measurement only delay the client's start
    if not most[-1]:
        return ctx.failed(
            "all zero",
            f"q is exactly 0 in every joint in {int((most == 0).sum())} of {len(q)} states before "
            "the first command, and in the last of them",
            ctx.at(ctx.states.topic, float(ctx.states.t[int(np.argmin(most))])),
        ).because(
            "The hand has not started (every number in its states is 0): is it powered?"
            if ctx.states.say_nothing
            else "Positions are never read from the device, or the hand rests with all joints at 0."
        )
    return ctx.passed("not zero", f"a joint is {most[-1]:.3f} {ctx.unit} from 0")


# ------------------------------------------------------------------------------------ sensors


def _packets(ctx: Context) -> NDArray[np.intp]:
    assert ctx.states.columns is not None
    count = ctx.states.columns.count("press_sensor_state")
    return count[count >= 0]


def _pressure(ctx: Context, packet: int, rows: slice = slice(None)) -> Floats:
    """A packet's pressures, shape (n, 12)."""
    assert ctx.states.columns is not None
    return ctx.states.columns[f"press_sensor_state[{packet}].pressure"][rows]


@check("DEX3-SENS-01")
def packets(ctx: Context) -> Outcome:
    """Number of sensor packets."""
    found = np.unique(_packets(ctx))
    most = ctx.tolerance("max_packets")
    seen = " or ".join(str(n) for n in found)
    if len(found) == 1 and found[0] <= most:
        return ctx.passed(seen, f"{seen} sensor packets in each state")
    outcome = ctx.failed(seen, f"{seen} sensor packets, from state to state")
    if len(found) == 1:
        return outcome.because("Each sensor element is published as a separate packet.")
    return outcome.because("A packet is published only when its sensor has a new value.")


@check("DEX3-SENS-02")
def pressures(ctx: Context) -> Outcome:
    """Every pressure is a number that is not negative."""
    count = int(_packets(ctx).max(initial=0))
    if not count:
        return ctx.skipped("the states hold no sensor packets")
    assert ctx.states.columns is not None
    have = ctx.states.columns.count("press_sensor_state")
    for packet in range(count):
        low, high = ctx.states.columns.extremes(f"press_sensor_state[{packet}].pressure")
        if low >= 0 and high < np.inf:
            continue
        values = _pressure(ctx, packet)
        good = (np.isfinite(values) & (values >= 0)).all(axis=1) | (have <= packet)
        if not good.all():
            i = int(np.argmin(good))
            slot = int(np.argmin(np.isfinite(values[i]) & (values[i] >= 0)))
            return ctx.failed(
                f"{values[i, slot]}",
                f"pressure {values[i, slot]} in slot {slot} of packet {packet}",
                ctx.at(ctx.states.topic, float(ctx.states.t[i])),
            )
    return ctx.passed("all finite", f"{count} packets of {_SLOTS}")


@check("DEX3-SENS-03")
def no_value(ctx: Context) -> Outcome:
    """Nine packets; 33 elements, and the code for "no sensor here" elsewhere, always the same."""
    count = int(_packets(ctx).max(initial=0))
    if not count:
        return ctx.absent("the states hold no sensor packets")
    code = ctx.tolerance("no_value")
    if count != ctx.tolerance("packets"):
        return ctx.failed(f"{count} packets", f"{count} sensor packets in a state")
    marked = [_pressure(ctx, packet) == code for packet in range(count)]
    elements = count * _SLOTS - sum(int(m[0].sum()) for m in marked)
    changes = sum(int((m != m[0]).any()) for m in marked)
    if changes:
        return ctx.failed("changes", f"the slots without a value change in {changes} packets")
    text = f"{elements} of {count * _SLOTS} slots hold a value, the others {code:g}"
    if elements == ctx.tolerance("elements"):
        return ctx.passed(f"{elements} elements", text)
    outcome = ctx.failed(f"{elements} elements", text)
    if elements == count * _SLOTS:
        return outcome.because("No slot is marked: those without a sensor hold a number, too.")
    return outcome


def _odd(ctx: Context, quaternions: Floats) -> NDArray[np.bool_]:
    """Which quaternions are neither 0 nor of length 1."""
    norm = np.linalg.norm(quaternions, axis=1)
    return np.asarray((norm != 0.0) & ~(np.abs(norm - 1.0) <= ctx.tolerance("max_error")))


@check("DEX3-IMU-01")
def attitude(ctx: Context) -> Outcome:
    """Norm of the quaternion, which may also be all 0."""
    assert ctx.states.columns is not None
    columns = ctx.states.columns
    quaternion = columns.constant("imu_state.quaternion")
    if quaternion is None or _odd(ctx, quaternion).any():
        quaternion = columns["imu_state.quaternion"][columns.ok]
    norm = np.linalg.norm(quaternion, axis=1)
    bad = _odd(ctx, quaternion)
    if bad.any():
        i = int(np.argmax(bad))
        return ctx.failed(
            f"norm {norm[i]:.2f}",
            f"the quaternion's norm is {norm[i]:.3f} in {int(bad.sum())} states",
            ctx.at(ctx.states.topic, float(ctx.states.t[columns.ok][i])),
        )
    if not norm.any():
        return replace(ctx.passed("not filled", "the quaternion is 0: no IMU"), absent=True)
    return ctx.passed("norm 1", f"a norm of {norm.min():.3f} to {norm.max():.3f}")


# ---------------------------------------------------------------------------------- mode byte


def _roles(ctx: Context) -> JointRoles:
    """The joints that the stimulus uses."""
    roles = under_test(ctx.recording.model.name).roles
    assert roles is not None  # every hand of several joints has them
    return roles


def _modes(ctx: Context, rows: slice = slice(None)) -> NDArray[np.intp]:
    """Mode bytes of whole states, shape (n, 7)."""
    mode = ctx.states.mode[rows]
    return mode[np.isfinite(mode).all(axis=1)].astype(np.intp)


@check("DEX3-MODE-01", rests_on=("mode",))
def ids(ctx: Context) -> Outcome:
    """Bits 0 to 3 of each motor's mode byte."""
    states, due = ctx.states.mode, np.arange(len(ctx.joints))
    if len(states) and (states == states[0]).all() and (states[0].astype(int) & 15 == due).all():
        return ctx.passed("0 .. 6", f"{len(states)} states")  # all alike, as they mostly are
    mode = _modes(ctx)
    found = mode & 15
    wrong = (found != due).any(axis=1)
    if not wrong.any():
        return ctx.passed("0 .. 6", f"{len(mode)} states")
    row = found[int(np.argmax(wrong))]
    joint = int(np.argmax(row != due))
    cause = ""
    if not mode.any():
        cause = "mode is left 0."
    elif not found.any():
        cause = "mode holds the status without the id."
    elif sorted(row) == list(range(len(ctx.joints))):
        cause = "The motors are in another order than the message has."
    return (
        ctx.failed(
            f"id {row[joint]}",
            ctx.named(f"motor {joint} has id {row[joint]}, in {int(wrong.sum())} states", joint),
            ctx.at(ctx.states.topic, float(ctx.states.t[int(np.argmax(wrong))])),
        )
        .about(joint)
        .because(cause)
    )


@check("DEX3-MODE-02")
def status(ctx: Context) -> Outcome:
    """Bits 4 to 6 while driven and while locked."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        for a, b, wanted, when in (
            (begin - 0.1, begin - 0.01, JointMode.FOC, "driven"),
            (end - 0.2, end - 0.01, JointMode.BRAKE, "locked"),
        ):
            mode = _modes(ctx, ctx.states.between(a, b))
            if not len(mode):
                return ctx.skipped(f"no state while {when}")
            found = np.median(MotorCodec(ctx.recording.dialect).status(mode), axis=0)
            if (found != wanted).any():
                joint = int(np.argmax(found != wanted))
                return ctx.failed(
                    f"status {found[joint]:g}",
                    ctx.named(f"status {found[joint]:g} while {when}", joint),
                    ctx.at(ctx.states.topic, a, b),
                ).about(joint)
    return ctx.passed("1, then 0", "1 while driven, 0 while locked")


@check("DEX5-MODE-01", rests_on=("mode",))
def plain_mode(ctx: Context) -> Outcome:
    """Whether anything moves with mode 1."""
    obeyed, asked = 0, 0
    strokes = np.array([j.stroke for j in ctx.joints])
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        far = [abs(s.size) / s.stroke for s in steps_of(ctx, phase)]
        q = ctx.q(begin - 0.1, end)
        q = q[np.isfinite(q).all(axis=1)]
        if len(q) and far and max(far) >= 0.05:
            asked += 1
            # which joint moves is judged by DEX5-JOINT-01
            moved = float((np.ptp(q, axis=0) / strokes).max())
            obeyed += moved >= ctx.tolerance("min_progress") * max(far)
    if not asked:
        return ctx.failed("no step", "there is no state while the joints were moved")
    text = f"the hand moves in {obeyed} of {asked} steps with mode 1"
    if obeyed:
        return ctx.passed(f"{obeyed} of {asked}", text)
    places = [ctx.at(ctx.states.topic, *ctx.span(phase)) for phase in ctx.phases()[:1]]
    return ctx.failed("nothing moves", text, *places)


@check("DEX3-MODE-03")
def locked(ctx: Context) -> Outcome:
    """Motion towards q while the motors are locked."""
    return not_driven(ctx, "with status 0, which locks the motor")


@check("DEX3-MODE-04")
def wrong_id(ctx: Context) -> Outcome:
    """A command whose mode byte has another motor's id: that motor must not move."""
    first, other = _roles(ctx).crossed
    names = [ctx.joints[i].name for i in (first, other)]
    quiet = [j for j in range(len(ctx.joints)) if j != first]
    outcome = stays(ctx, f"a command to {names[0]} with the id of {names[1]} ({other})", quiet)
    return outcome.about(*outcome.joints, first)


# ------------------------------------------------------------------------------------- joints


@check("DEX3-JOINT-01")
def order(ctx: Context) -> Outcome:
    """Which joint moves when one joint is commanded."""
    found = 0
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        commanded = phase.targets.get(ctx.side, {})
        for step in steps_of(ctx, phase):
            rows = ctx.states.between(begin, end)
            before = ctx.q(begin - 0.1, begin)
            if not len(before) or abs(step.size) < 0.05 * step.stroke:
                continue
            moved = np.abs(ctx.states.q[rows] - np.median(before, axis=0)).max(axis=0)
            strokes = np.array([j.stroke for j in ctx.joints])
            others = [j for j in range(len(ctx.joints)) if j not in commanded]
            limit = ctx.tolerance("max_others_stroke", 0) / ctx.joints[0].stroke
            wrong = [j for j in others if not moved[j] <= limit * strokes[j]]
            own = float(moved[step.joint])
            name = ctx.joints[step.joint].name
            if own < ctx.tolerance("min_progress") * abs(step.size) or wrong:
                seen = ", ".join(
                    f"{ctx.joints[j].name} moved {moved[j]:.2f} {ctx.unit}" for j in wrong
                )
                outcome = ctx.failed(
                    ctx.joints[wrong[0]].name if wrong else "no motion",
                    f"{name} was commanded to go {abs(step.size):.2f} {ctx.unit} and moved "
                    f"{own:.2f} {ctx.unit}; " + (seen or "no joint moved"),
                    ctx.at(ctx.states.topic, begin, end),
                ).about(step.joint, *wrong)
                cause = _order_cause(ctx, step.joint, wrong, own < 0.1 * abs(step.size))
                return outcome.because(cause)
            found += 1
    if not found:
        return ctx.failed("no step", "there is no state while the joints were moved")
    return ctx.passed(f"{found} of {found}", f"{found} steps, each of the commanded joint")


def _order_cause(ctx: Context, joint: int, wrong: Sequence[int], still: bool) -> str:
    """Explain motion of another joint than the commanded one; empty if no cause is known."""
    name = ctx.joints[joint].name
    if still and not wrong:
        return f"{name} is not driven: its commands are lost, it is locked, or it has no power."
    if still and len(wrong) == 1:
        other = ctx.joints[wrong[0]].name
        if {name.partition("_")[0], other.partition("_")[0]} == {"middle", "index"}:
            return f"{name} and {other} are swapped, as xr_teleoperate's enum has the right hand."
        return f"{name} and {other} are swapped."
    if wrong and not still:
        return "The joints are coupled, or a command for one is applied to others as well."
    return ""


_SMALL = 0.1  # of the range: a step after another soft one, which moved little


_TOO_SOFT = "Dry friction takes what so little stiffness gives; or the gain was rounded to 0."


@check("DEX3-GAIN-02")
def stiffness(ctx: Context) -> Outcome:
    """Time to half of a step with low gains, compared with the client's gains.

    In some steps other joints keep the client's gains: a joint that uses theirs is as quick as they
    are.

    A step at the joint's own top speed does not depend on gains, and is left out.
    """
    stiff = {s.joint: s for p in ctx.recording.phases("stiff", ctx.side) for s in steps_of(ctx, p)}
    stuck: Outcome | None = None
    nothing, figures = "no state during the steps", []
    soft = [(s, len(p.targets.get(ctx.side, {}))) for p in ctx.phases() for s in steps_of(ctx, p)]
    for step, joints in soft:
        reference = stiff.get(step.joint)
        if reference is None or abs(step.size) < _SMALL * step.stroke:
            continue
        # after another soft step gravity may still move the joint: only the first starts from rest
        if joints == len(ctx.joints) and step.progress < ctx.tolerance("min_progress"):
            text = f"with soft gains it goes {step.progress:.0%} of its way"
            place = ctx.at(ctx.states.topic, step.begin, step.end)
            outcome = ctx.failed(f"{step.progress:.0%}", ctx.named(text, step.joint), place)
            stuck = stuck or outcome.about(step.joint).tolerated().because(_TOO_SOFT)
            continue
        quick = half_way(reference)
        if quick is None:
            return ctx.skipped(ctx.named("the stiff step did not get half-way", step.joint))
        took, quick = least_half_way(step), max(quick, 1e-3)
        if took < ctx.tolerance("min_ratio") * quick and limited_by_speed(ctx, reference):
            nothing = "its own speed limits every joint's steps, whatever their gains are"
            continue
        figures.append(slower(ctx, step.joint, took, quick, "with soft gains"))
    outcome = judged(ctx, figures, "ratio", "min_ratio", nothing=nothing)
    return outcome if outcome.met is False or stuck is None else stuck


@check("DEX3-FORCE-01")
@with_object
def contact(ctx: Context) -> Outcome:
    """Closing torque of the joints that press on an object."""
    rows = squeezes(ctx)
    if rows is None:
        return ctx.skipped("no state while it squeezed")
    begin, end = rows
    tau = np.median(ctx.tau(begin, end), axis=0)
    closing = np.array([j.closing for j in ctx.joints])
    felt = tau * closing
    pressing = felt[closing != 0]
    weakest, strongest = float(pressing.min()), float(pressing.max())
    text = f"tau_est towards closing from {weakest:.2f} to {strongest:.2f} N m while squeezing"
    if strongest >= ctx.tolerance("min_tau_nm") and weakest > -ctx.tolerance("min_tau_nm"):
        return ctx.passed(f"{strongest:.2f} N m", text, tau_nm=strongest)
    outcome = ctx.failed(
        f"{strongest:.2f} N m", text, ctx.at(ctx.states.topic, begin, end), tau_nm=strongest
    )
    if not ctx.states.tau.any():
        return outcome.because("tau_est is not filled (0 throughout).")
    if weakest <= -ctx.tolerance("min_tau_nm"):
        return outcome.because("tau_est has the wrong sign, in some joints or on this side.")
    return outcome


@check("DEX5-FORCE-03")
@with_object
def units(ctx: Context) -> Outcome:
    """tau_est compared with the commanded stiffness times the position error."""
    span = squeezes(ctx)
    if span is None:
        return ctx.skipped("no state while it squeezed")
    rows, given = ctx.states.between(*span), ctx.commands
    commanded = (given.t >= span[0]) & (given.t <= span[1]) & np.isfinite(given.q).all(axis=1)
    if not commanded.any():
        return ctx.skipped("no command while it squeezed")
    here, tau = np.median(ctx.states.q[rows], axis=0), np.median(ctx.states.tau[rows], axis=0)
    due = np.median(given.kp[commanded], axis=0) * (np.median(given.q[commanded], axis=0) - here)
    ratios = {}
    for name, mine in (("thumb", True), ("fingers", False)):
        pressing = [
            float(tau[i] / due[i])
            for i, j in enumerate(ctx.joints)
            if j.closing and (j.finger == "thumb") is mine and abs(due[i]) > 1e-3
        ]
        if not pressing:
            return ctx.skipped(f"no joint of the {name} pressed on the object")
        ratios[name] = float(np.median(pressing))
    text = ", ".join(f"{name} {ratio:.3g} times kp (q - q_now)" for name, ratio in ratios.items())
    low, high = ctx.tolerance("min_ratio"), ctx.tolerance("max_ratio")
    if all(low <= ratio <= high for ratio in ratios.values()):
        return ctx.passed("N m, mN m", text)
    outcome = ctx.failed("other units", text, ctx.at(ctx.states.topic, *span))
    if low <= ratios["thumb"] <= high and low <= 1e3 * ratios["fingers"] <= high:
        return outcome.because("The fingers' torques are in N m, as the thumb's.")
    return outcome


# ---------------------------------------------------------------------------- when commands end


def _moved(ctx: Context, joints: Sequence[int], begin: float, end: float) -> Floats:
    """Motion of each joint from begin to end, as a part of its stroke."""
    q = ctx.q(begin, end)[:, list(joints)]
    if len(q) < 5:
        return np.full(len(joints), np.nan)
    return np.asarray(np.ptp(q, axis=0) / [ctx.joints[j].stroke for j in joints])


@dataclass(frozen=True)
class _Silence:
    """A phase without commands to this hand; times in seconds.

    :param last: the last command that was neither empty nor not finite.
    :param late: the time-out after that, with grace.
    :param driven: the phase in which joints were set in motion just before, if any were.
    :param guarded: whether each joint has time-out protection.
    """

    last: float
    late: float
    end: float
    driven: Phase | None
    guarded: NDArray[np.bool_]


def protected(ctx: Context, at: float) -> NDArray[np.bool_]:
    """Whether each joint has time-out protection by the last good command until ``at``."""
    commands = ctx.commands
    good = np.isfinite(commands.q).all(axis=1) & np.isfinite(commands.mode).all(axis=1)
    rows = np.flatnonzero(good & (commands.t <= at))
    if not len(rows) or ctx.recording.dialect.mode_byte is not ModeByte.RIS:
        return np.zeros(len(ctx.joints), dtype=np.bool_)
    return np.asarray(commands.mode[rows[-1]].astype(np.intp) >> 7 & 1, dtype=np.bool_)


def _silences(ctx: Context, *names: str) -> list[_Silence]:
    """The phases without commands."""
    good = ctx.commands.t[np.isfinite(ctx.commands.q).all(axis=1)]
    found = []
    for phase in (p for name in names for p in ctx.phases(name)):
        begin, end = ctx.span(phase)
        sent = good[good <= end]
        last = min(float(sent[-1]), begin + 0.05) if len(sent) else begin
        late = last + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        drives = [p for name in ("drive", "guard-drive") for p in ctx.phases(name)]
        just = [p for p in drives if 0 <= phase.begin_ns - p.end_ns < 1e8]
        guarded = protected(ctx, last)
        found.append(_Silence(last, late, end, just[0] if just else None, guarded))
    return found


def _stops(ctx: Context, joints: Sequence[int], *, guarded: bool) -> Outcome:
    """Fail if joints that move when commands end still move after the time-out, or if others leave
    their place.

    :param guarded: whether joints with time-out protection are judged, or those without.
    """
    driven = [s for s in _silences(ctx, "silence", "guard") if s.driven is not None]
    if not driven:
        return ctx.skipped("this hand held an object when the commands stopped")
    for silence in driven:
        if (stray := _strays(ctx, silence, guarded=guarded)) is not None:
            return stray
    outcomes = [
        _stops_in(ctx, mine, s)
        for s in driven
        if (mine := [j for j in joints if s.guarded[j] == guarded])
    ]
    if not outcomes:
        return ctx.skipped("no joint that moved when the commands stopped was to be judged")
    failed = [o for o in outcomes if o.met is False]
    passed = [o for o in outcomes if o.met]
    return (failed or passed or outcomes)[0]


_MEDIAN_S = 0.05  # s, of a place


def _strays(ctx: Context, silence: _Silence, *, guarded: bool) -> Outcome | None:
    """Failure of a joint that neither moved nor was on its way, and leaves its place; else None.

    The way to its last goal is no leaving: a slow joint may still arrive.
    """
    roles, last, end = _roles(ctx), silence.last, silence.end
    mine = [
        j
        for j in range(len(ctx.joints))
        if j not in roles.driven and j not in roles.slow and silence.guarded[j] == guarded
    ]
    before = ctx.q(last - _MEDIAN_S, last)[:, mine]
    rows = ctx.states.between(last, end)
    t, q = ctx.states.t[rows], ctx.states.q[rows][:, mine]
    sent = np.flatnonzero(np.isfinite(ctx.commands.q).all(axis=1) & (ctx.commands.t <= last))
    if not mine or not len(before) or len(q) < 5 or not len(sent):
        return None
    spec = [ctx.joints[j] for j in mine]
    limits = [j.q_min for j in spec], [j.q_max for j in spec]
    here, goal = np.median(before, axis=0), np.clip(ctx.commands.q[sent[-1], mine], *limits)
    low, high = np.minimum(here, goal), np.maximum(here, goal)
    limit = ctx.requirement.tolerance("max_motion_stroke")
    beyond = np.maximum(low - q, q - high) / [j.stroke for j in spec]
    ends = np.searchsorted(t, t + _MEDIAN_S)
    windows = np.column_stack((np.arange(len(t)), ends))[ends < len(t)]
    figures = []
    for i in np.flatnonzero((beyond > limit).any(axis=0)).tolist():
        away = np.nan_to_num(medians(beyond[:, i], windows))  # noise is no motion
        if len(away):
            at = int(np.argmax(away))
            rad = float(away[at]) * spec[i].stroke
            text = f"left its place by {rad:.2f} {ctx.unit} after the last command"
            figures.append(Figure(rad, float(t[at]), end, mine[i], text))
    nothing = ctx.passed("in its place")
    outcome = judged(ctx, figures, "motion_rad", "max_motion_stroke", nothing=nothing)
    return None if outcome.met else outcome


def _stops_in(ctx: Context, joints: Sequence[int], silence: _Silence) -> Outcome:
    last, late, end = silence.last, silence.late, silence.end
    before = _moved(ctx, joints, last, last + ctx.tolerance("timeout_s"))
    after = _moved(ctx, joints, late, end)
    if np.isnan(after).any() or np.isnan(before).any():
        return ctx.skipped("too few states in the silence")
    worst = int(np.argmax(after))
    joint = joints[worst]
    rad = float(after[worst]) * ctx.joints[joint].stroke
    rows = ctx.states.between(last, end)
    stop = stopped(
        *(ctx.states.t[rows], ctx.states.q[rows, joint]),
        last,
        ctx.tolerance("max_motion_stroke", joint),
        late - last,
    )
    if after[worst] > ctx.requirement.tolerance("max_motion_stroke"):
        outcome = ctx.failed(
            f"{rad:.2f} {ctx.unit}",
            ctx.named(
                f"moved by {rad:.2f} {ctx.unit} more than {ctx.tolerance('timeout_s'):g} s "
                "after the "
                "last command",
                joint,
            ),
            ctx.at(ctx.states.topic, late, end),
            motion_rad=rad,
        )
        return outcome.about(joint).resting_on(stop)
    if before.max() < ctx.requirement.tolerance("min_travel_stroke"):
        return ctx.skipped(
            "no joint that was set in motion still moved when the commands stopped: "
            "a braked joint cannot be distinguished from one at rest"
        )
    met = ctx.passed("stops", f"moving, then still ({rad:.3f} {ctx.unit})", motion_rad=rad)
    return met.resting_on(stop)


@check("DEX3-WDOG-01")
def nothing_left_moving(ctx: Context) -> Outcome:
    """Motion after the time-out of joints driven by a velocity or torque, without protection."""
    return _stops(ctx, _roles(ctx).driven, guarded=False)


@check("DEX3-GUARD-01")
def brakes(ctx: Context) -> Outcome:
    """Motion after the time-out of protected joints, driven by velocity or to a position."""
    return _stops(ctx, (*_roles(ctx).driven, *_roles(ctx).slow), guarded=True)


@check("DEX3-GUARD-02")
def reports_trip(ctx: Context) -> Outcome:
    """Bit 7 of the state's mode byte of each joint before and after the time-out."""
    silences = _silences(ctx, "guard", "silence")
    for silence in silences:
        last, late, end = silence.last, silence.late, silence.end
        # protection is on for a while before: repeated commands must keep it from tripping
        begins = [ctx.span(p)[0] for n in ("squeeze", "guarded") for p in ctx.phases(n)]
        since = max((b for b in begins if last - 5.0 < b < last), default=last - 0.2)
        before = _modes(ctx, ctx.states.between(since, last + 0.5)) >> 7
        after = _modes(ctx, ctx.states.between(late, end)) >> 7
        if not len(before) or not len(after):
            return ctx.skipped("no state in the silence")
        if before.any():
            joint = int(np.argmax(before.any(axis=0)))
            return ctx.failed(
                "too early",
                ctx.named("bit 7 is set while commands arrive", joint),
                ctx.at(ctx.states.topic, since, last),
            ).about(joint)
        wrong = (after != silence.guarded).any(axis=0)
        if wrong.any():
            joint = int(np.argmax(wrong))
            seen = "not always set" if silence.guarded[joint] else "set without protection"
            return ctx.failed(
                "not set" if silence.guarded[joint] else "set",
                ctx.named(f"bit 7 is {seen} after the time-out", joint),
                ctx.at(ctx.states.topic, late, end),
            ).about(joint)
    if not any(s.end - s.late >= ctx.tolerance("stays_s") - 0.2 for s in silences):
        return ctx.skipped("no silence with protection was long enough")
    count = sum(int(s.guarded.sum()) for s in silences)
    return ctx.passed("set", f"bit 7 is set in {count} protected motors, and in no other")


@check("DEX3-GUARD-03")
def latches(ctx: Context) -> Outcome:
    """Motion by commands that do not clear the protection."""
    return not_driven(ctx, "while the time-out protection was tripped and not cleared")


@check("DEX3-GUARD-04")
def clears(ctx: Context) -> Outcome:
    """The step after the protection was cleared."""
    return arrival(ctx, "commanded without bit 7 after the protection had tripped")


@check("DEX3-HOLD-01")
def holds(ctx: Context) -> Outcome:
    """Grip force and motion to a position go on after commands end, without protection."""
    outcomes = [_holds_in(ctx, silence) for silence in _silences(ctx, "silence", "guard")]
    if not outcomes:
        return ctx.skipped("no pause of commands")
    failed = [o for o in outcomes if o.met is False]
    passed = [o for o in outcomes if o.met]
    return (failed or passed or outcomes)[0]


_AT_LAST = 1.0  # s at the end of a silence
_STOOD_S = 0.3  # s before the time-out in which a joint that goes on to its goal moves


def _holds_in(ctx: Context, silence: _Silence) -> Outcome:
    if ctx.object_at is not None and silence.driven is None:
        return _grips_on(ctx, silence)
    late, end = silence.late, silence.end
    target = silence.driven.targets.get(ctx.side) if silence.driven is not None else None
    slow = [j for j in _roles(ctx).slow if not silence.guarded[j]]
    if not target or not slow:
        return ctx.skipped("no joint was on its way when the commands stopped")
    # at the beginning and, in a long silence, also at its end
    least = ctx.requirement.tolerance("min_travel_stroke")
    spans = [(late, min(end, late + _AT_LAST), least)]
    judged = False
    if end - late > 2 * _AT_LAST:
        spans.append((end - _AT_LAST, end, 0.5 * least))  # it is closer to its goal by then
    for a, b, least in spans:
        rows = ctx.states.between(a, a + 0.05)
        if not len(ctx.states.q[rows]):
            return ctx.skipped("no state in the silence")
        here = np.median(ctx.states.q[rows], axis=0)
        moved = _moved(ctx, slow, a, b)
        for i, joint in enumerate(slow):
            left = abs(target[joint] - float(here[joint])) / ctx.joints[joint].stroke
            if left < 4 * least:
                if a == late:
                    return ctx.skipped("the hand had arrived before the time-out")
                continue
            if _stood(ctx, joint, silence):
                continue  # friction stopped it, and not the time-out
            judged = True
            if not moved[i] >= least * (b - a) / _AT_LAST:
                return ctx.failed(
                    "stops",
                    ctx.named(f"stopped on its way {a - silence.last:.1f} s after the last", joint)
                    + " command",
                    ctx.at(ctx.states.topic, a, b),
                ).about(joint)
    if not judged:
        return ctx.skipped("no joint moved any more when the time-out had passed")
    return ctx.passed("goes on", "went on to its position after the time-out")


def _stood(ctx: Context, joint: int, silence: _Silence) -> bool:
    """Whether a joint had come to rest before the time-out could stop it."""
    until = silence.last + 0.8 * ctx.requirement.tolerance("timeout_s")
    least = ctx.requirement.tolerance("min_travel_stroke") * _STOOD_S / _AT_LAST
    return float(_moved(ctx, [joint], until - _STOOD_S, until)[0]) < least


def _grips_on(ctx: Context, silence: _Silence) -> Outcome:
    last, late, end = silence.last, silence.late, silence.end
    before = np.abs(ctx.tau(last - 0.2, last))
    spans = [(late, min(end, late + _AT_LAST)), (max(late, end - _AT_LAST), end)]
    later = [np.abs(ctx.tau(a, b)) for a, b in spans]
    if not len(before) or not all(map(len, later)):
        return ctx.skipped("no state in the silence")
    pressed = np.where(silence.guarded, 0.0, np.median(before, axis=0))
    pressing = np.flatnonzero(pressed >= ctx.tolerance("min_tau_nm"))
    if not len(pressing):
        return ctx.skipped("no joint without protection pressed when the commands stopped")
    still = np.min([np.median(tau, axis=0) for tau in later], axis=0)
    joint = int(pressing[np.argmin(still[pressing] / pressed[pressing])])
    text = ctx.named(
        f"pressed with {pressed[joint]:.2f} N m, and after the time-out with {still[joint]:.2f} "
        "N m",
        joint,
    )
    if still[joint] >= ctx.tolerance("min_tau_part") * pressed[joint]:
        return ctx.passed("grips on", text, tau_nm=float(still[joint]))
    place = ctx.at(ctx.states.topic, late, end)
    return ctx.failed("lets go", text, place, tau_nm=float(still[joint])).about(joint)


@check("DEX5-WDOG-04")
@with_object
def all_alike(ctx: Context) -> Outcome:
    """Which joints that pressed when the commands ended still press after the time-out."""
    least = ctx.tolerance("min_tau_nm")
    scales = torque_scales(ctx, least)
    squeezed = [p.end_ns for p in ctx.phases("squeeze")]
    judged = False
    for phase in ctx.phases():
        if not any(0 <= phase.begin_ns - end < 1e9 for end in squeezed):
            continue  # it pressed on nothing before
        begin, end = ctx.span(phase)
        sent = ctx.commands.t[ctx.commands.t <= begin + 0.05]
        last = float(sent[-1]) if len(sent) else begin
        late = last + ctx.tolerance("timeout_s") + ctx.tolerance("grace_s")
        before, after = (
            np.abs(ctx.tau(a, b)) / scales for a, b in ((last - 0.2, last), (late, end))
        )
        if len(before) < 3 or len(after) < 3:
            continue
        had, left = np.median(before, axis=0), np.median(after, axis=0)
        pressed = np.flatnonzero(had >= least).tolist()
        judged |= bool(pressed)
        part = {j: float(left[j] / had[j]) for j in pressed}
        on = [j for j in pressed if part[j] >= ctx.tolerance("min_part")]
        off = [j for j in pressed if part[j] <= ctx.tolerance("max_part")]
        if on and off:
            names = ctx.joints[on[0]].name, ctx.joints[off[0]].name
            text = (
                f"{late - last:.1f} s after the last command {len(on)} joints still press, "
                f"{names[0]} with {part[on[0]]:.0%} of its force, and {len(off)} do not, "
                f"{names[1]} with {part[off[0]]:.0%}"
            )
            place = ctx.at(ctx.states.topic, late, end)
            return ctx.failed(f"{len(on)} of {len(pressed)}", text, place).about(*on, *off)
    if not judged:
        return ctx.skipped("no joint pressed on the object when the commands ended")
    return ctx.passed("all alike", "all joints that pressed go on, or none does")


# ------------------------------------------------------------------------------------- safety


@check("DEX3-SAFE-04")
def short(ctx: Context) -> Outcome:
    """A command with one motor too few."""
    return stays(ctx, "commands with one motor too few")


@check("DEX3-SAFE-05")
def long(ctx: Context) -> Outcome:
    """A command with too many motors."""
    return stays(ctx, "commands for more motors than there are")
