"""Checks for robots; requirements shared with hands use the hands' checks."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexkit.conformance.checks import STROKE_S, Context, Outcome, check, timing
from dexkit.conformance.checks.figures import Figure, Figures, judged, worst
from dexkit.conformance.plots import Plot
from dexkit.conformance.robot import RobotRecording
from dexkit.conformance.stimuli.robot import STEP
from dexkit.conformance.stimulus_record import Phase
from dexkit.conformance.sums import mean, total
from dexkit.messages import Columns

__all__ = ["RobotContext"]

_SOME = 20  # states before a phase or at its end that are averaged
_END = 0.06  # s after a phase during which its last command may still act
_LATE = 1.0  # s by which a state may be late on a busy machine
_STICKS = struct.Struct("<4x5f")  # in wireless_remote, after head and keys


@dataclass(frozen=True)
class RobotContext(Context):
    """One requirement to be judged for the robot of a recording."""

    recording: RobotRecording

    @property
    def low(self) -> Columns:
        """All members of the states."""
        found = self.recording.low
        assert found is not None, "states are there: H1-TOPIC-01 has not failed"
        return found


def _at(ctx: RobotContext, row: int) -> float:
    return float(ctx.states.t[row])


def _wrong_rows(
    ctx: RobotContext, bad: ArrayLike, figure: str, what: str, joints: tuple[int, ...] = ()
) -> Outcome:
    """A failure in the samples where ``bad`` is true, about these joints."""
    rows = np.flatnonzero(bad)
    places = [ctx.at(ctx.states.topic, _at(ctx, int(i))) for i in rows[:5]]
    text = f"{what}, in {len(rows)} of {len(ctx.states)} states"
    return ctx.failed(figure, text, *places, wrong=len(rows)).about(*joints)


# ------------------------------------------------------------------------------------ discovery


@check("H1-TOPIC-03")
def one_publisher(ctx: RobotContext) -> Outcome:
    """Writers of the state topic."""
    writers = [
        e for e in ctx.recording.endpoints if (e.topic, e.kind) == (ctx.states.topic, "writer")
    ]
    if not writers:
        return ctx.skipped("the recording names no writer of the state topic")
    if len(writers) == 1:
        return ctx.passed("1", "one writer")
    return ctx.failed(str(len(writers)), f"{len(writers)} writers publish {ctx.states.topic}")


# ------------------------------------------------------------------------------------ integrity


@check("H1-CRC-01")
def state_crc(ctx: RobotContext) -> Outcome:
    """The CRC of every state."""
    intact = ctx.recording.intact
    if intact.all():
        return ctx.passed("right", f"{len(intact)} states")
    crc = ctx.low["crc"]
    outcome = _wrong_rows(ctx, ~intact, f"{int((~intact).sum())} wrong", "the CRC is wrong")
    return outcome.because("The field is never set.") if not np.any(crc > 0) else outcome


@check("H1-CLIENT-01")
def client_crc(ctx: RobotContext) -> Outcome:
    """The CRC of commands, except for those that the kit has damaged on purpose."""
    intact, t = ctx.recording.commands_intact, ctx.commands.t
    counts = np.ones(len(t), dtype=np.bool_)
    for phase in ctx.phases("wrong-crc"):
        begin, end = ctx.span(phase)
        counts &= (t < begin - 0.02) | (t > end + 0.02)
    wrong = np.flatnonzero(counts & ~intact)
    if not len(wrong):
        return ctx.passed("right", f"{int(counts.sum())} commands")
    return ctx.failed(
        f"{len(wrong)} wrong",
        f"{len(wrong)} of {int(counts.sum())} commands carry a wrong CRC",
        *(ctx.at(ctx.commands.topic, float(t[i])) for i in wrong[:5]),
    )


@check("H1-CLIENT-02")
def client_rate(ctx: RobotContext) -> Outcome:
    """The mean rate of commands."""
    steps = np.diff(ctx.commands.t)
    steady = steps[steps <= 0.1]
    if total(steady) < ctx.tolerance("min_observed_s"):
        return ctx.skipped("hardly any steady commands in the recording")
    rate = len(steady) / total(steady)
    text = f"{len(ctx.commands)} commands, {rate:.0f} Hz while they are sent"
    if rate >= ctx.tolerance("min_rate_hz"):
        return ctx.passed(f"{rate:.0f} Hz", text)
    return ctx.failed(f"{rate:.0f} Hz", text)


@check("H1-TICK-01")
def tick_goes_on(ctx: RobotContext) -> Outcome:
    """Increments of tick, and the longest time without a change."""
    tick, clock = ctx.low["tick"], ctx.states.clock
    if len(tick) < 2:
        return ctx.skipped("fewer than two states")
    steps = np.diff(tick)
    back = np.concatenate(([False], (steps < 0) & (steps > -(2.0**31))))  # it may wrap round
    if back.any():
        return _wrong_rows(ctx, back, "goes back", "tick goes back")
    changes = np.concatenate(([0], np.flatnonzero(steps) + 1, [len(tick)]))
    held = clock[changes[1:] - 1] - clock[changes[:-1]]  # a gap in the state is judged by RATE-03
    longest, i = float(held.max()), int(np.argmax(held))
    if longest <= ctx.tolerance("max_hold_s"):
        return ctx.passed(f"{longest * 1e3:.0f} ms", f"stood still for {longest:.3f} s at most")
    begin = float(ctx.states.t[changes[i]])
    return ctx.failed(
        f"{longest:.2f} s",
        f"tick stays {tick[changes[i]]:.0f} for {longest:.2f} s, in "
        f"{int(changes[i + 1] - changes[i])} states",
        ctx.at(ctx.states.topic, begin, begin + longest),
    ).if_late(longest - ctx.tolerance("max_hold_s"))


@check("H1-TICK-02")
def tick_rate(ctx: RobotContext) -> Outcome:
    """Rate of tick."""
    tick, clock = ctx.low["tick"], ctx.states.clock
    seconds = float(clock[-1] - clock[0]) if len(clock) else 0.0
    if seconds < ctx.tolerance("min_observed_s"):
        return ctx.skipped("less than a second of state in the recording")
    rate = float((tick[-1] - tick[0]) % 2.0**32) / seconds
    part = abs(rate / ctx.tolerance("rate_hz") - 1.0)
    text = f"tick counts {rate:.0f} a second"
    if part <= ctx.tolerance("tolerance_part"):
        return ctx.passed(f"{rate:.0f} Hz", text)
    return ctx.failed(f"{rate:.0f} Hz", text).if_late(part * seconds)


# --------------------------------------------------------------------------------------- fields


@check("H1-FIELD-03")
def within_limits(ctx: RobotContext) -> Outcome:
    """Positions against each joint's limits."""
    low = np.array([j.q_min for j in ctx.joints]) - ctx.tolerance("margin_rad")
    high = np.array([j.q_max for j in ctx.joints]) + ctx.tolerance("margin_rad")
    beyond = np.nan_to_num(np.maximum(low - ctx.states.q, ctx.states.q - high), nan=-1.0)
    if not (beyond > 0).any():
        return ctx.passed("within", f"all {len(ctx.joints)} joints are within their limits")
    row, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    spec = ctx.joints[int(joint)]
    q = float(ctx.states.q[row, joint])
    return _wrong_rows(
        ctx,
        (beyond > 0).any(axis=1),
        f"{q:.2f} rad",
        f"{spec.name}: q = {q:.3f} rad; its limits are {spec.q_min:g} and {spec.q_max:g}",
        (int(joint),),
    )


@check("H1-FIELD-04")
@worst("off_rad_s", "tolerance_rad_s", nothing="no joint moved")
def speed_of_q(ctx: RobotContext) -> Figures:
    """Compare dq with the change of q of each joint while it moves."""
    window = ctx.tolerance("window_s")
    for phase in ctx.phases():
        joint = _index(ctx, phase)
        rows = ctx.states.between(*ctx.span(phase))
        t, q, dq = ctx.states.clock[rows], ctx.states.q[rows, joint], ctx.states.dq[rows, joint]
        later = np.searchsorted(t, t + window)
        first = np.flatnonzero(later < len(t))
        if len(first) < 10:
            yield ctx.skipped("too few states while joints move")
        later = later[first]
        change = (q[later] - q[first]) / np.maximum(t[later] - t[first], 1e-6)
        sums = np.concatenate(([0.0], np.cumsum(dq)))
        reported = (sums[later] - sums[first]) / (later - first)
        off = mean(np.abs(change - reported))
        text = f"dq is off the change of q by {off:.2f} rad/s on average"
        yield Figure(off, joint=joint, text=text, shown=f"{off:.2f} rad/s")


@check("H1-FIELD-05")
def unused_still(ctx: RobotContext) -> Outcome:
    """q, dq and tau_est of the slots without a motor."""
    low, robot = ctx.low, ctx.recording.robot
    unused = [slot for slot in range(robot.slots) if slot not in robot.used]
    for member in ("q", "dq", "tau_est"):
        values = low[f"motor_state[].{member}"][:, unused]
        bad = (np.nan_to_num(values) != 0).any(axis=1)
        if bad.any():
            slot = unused[int(np.argmax(np.abs(values[np.argmax(bad)])))]
            path = f"motor_state[{slot}].{member}"
            what = f"{path} is {values[np.argmax(bad)].max():.3g}"
            outcome = _wrong_rows(ctx, bad, f"slot {slot}", what)
            return outcome.shown_by(Plot.of_member(path))
    return ctx.passed("0", f"slots {', '.join(map(str, unused))}")


_BYTES = (
    *("motor_state[].temperature", "imu_state.temperature", "temperature_ntc1"),
    *("temperature_ntc2", "bms_state.bq_ntc", "bms_state.mcu_ntc"),
)


@check("H1-TEMP-01")
def byte_temperatures(ctx: RobotContext) -> Outcome:
    """The largest of the temperatures that are one byte."""
    low, top = ctx.low, 0.0
    for member in _BYTES:
        values = np.nan_to_num(low[member]).reshape(len(low), -1).max(axis=1)
        bad = values > ctx.tolerance("max_c")
        if bad.any():
            figure = f"{values.max():.0f}"
            outcome = _wrong_rows(ctx, bad, figure, f"{member} is {figure}")
            return outcome.shown_by(Plot.of_member(member))
        top = max(top, float(values.max(initial=0.0)))
    return ctx.passed(f"{top:.0f}", f"at most {top:.0f} degrees")


@check("H1-TEMP-02")
def motor_temperatures(ctx: RobotContext) -> Outcome:
    """Temperatures of the used motors."""
    robot = ctx.recording.robot
    path = "temperature" if robot.motor_temperatures == 1 else "temperature[0]"
    values = ctx.low[f"motor_state[].{path}"][:, list(robot.used)]
    bad = ~((values >= ctx.tolerance("min_c")) & (values <= ctx.tolerance("max_c")))
    if not bad.any():
        return ctx.passed(f"{values.min():.0f} to {values.max():.0f}")
    row = int(np.argmax(bad.any(axis=1)))
    joint = int(np.argmax(bad[row]))
    what = f"{ctx.joints[joint].name}: {values[row, joint]:.0f} degrees"
    figure = f"{values[row, joint]:.0f}"
    outcome = _wrong_rows(ctx, bad.any(axis=1), figure, what, (joint,))
    return outcome.shown_by(Plot.of_member(f"motor_state[{robot.used[joint]}].{path}"))


@check("H1-IMU-01")
def unit_quaternion(ctx: RobotContext) -> Outcome:
    """Length of the quaternion."""
    length = np.linalg.norm(ctx.low["imu_state.quaternion"], axis=1)
    bad = ~(np.abs(length - 1.0) <= ctx.tolerance("tolerance"))
    if not bad.any():
        return ctx.passed(f"{mean(length):.3f}")
    first = float(length[np.argmax(bad)])
    return _wrong_rows(ctx, bad, f"{first:.3f}", f"its length is {first:.3f}")


@check("H1-IMU-02")
def same_attitude(ctx: RobotContext) -> Outcome:
    """Compare rpy with the quaternion."""
    low = ctx.low
    w, x, y, z = low["imu_state.quaternion"].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    off = low["imu_state.rpy"] - np.stack([roll, pitch, yaw]).T
    off = np.abs((off + math.pi) % (2 * math.pi) - math.pi).max(axis=1)
    bad = ~(off <= ctx.tolerance("tolerance_rad"))
    if not bad.any():
        return ctx.passed(f"{off.max(initial=0.0):.3f} rad")
    first = float(off[np.argmax(bad)])
    what = f"rpy and quaternion (read as w, x, y, z) differ by {first:.2f} rad"
    return _wrong_rows(ctx, bad, f"{first:.2f} rad", what)


@check("H1-IMU-03")
def measured_gravity(ctx: RobotContext) -> Outcome:
    """Accelerometer and gyroscope before the first command."""
    begin, end = ctx.span(ctx.phases()[0])
    rows = ctx.states.between(begin, end)
    low = ctx.low
    force = np.linalg.norm(low["imu_state.accelerometer"][rows], axis=1)
    turning = np.linalg.norm(low["imu_state.gyroscope"][rows], axis=1)
    if not len(force):
        return ctx.skipped("no state before the first command")
    g, rate = mean(force), mean(turning)
    text = f"{g:.2f} m/s^2 and {rate:.3f} rad/s on average"
    good = ctx.tolerance("low") <= g <= ctx.tolerance("high")
    if good and rate <= ctx.tolerance("max_rad_s"):
        return ctx.passed(f"{g:.2f} m/s^2", text)
    return ctx.failed(f"{g:.2f} m/s^2", text, ctx.at(ctx.states.topic, begin, end))


@check("H1-HEAD-01")
def frame_head(ctx: RobotContext) -> Outcome:
    """The frame's first bytes."""
    low = ctx.low
    bad = (low["head"] != (0xFE, 0xEF)).any(axis=1) | (low["level_flag"] != 0xFF)
    if not bad.any():
        return ctx.passed("FE EF FF")
    row = int(np.argmax(bad))
    reported = " ".join(f"{int(v):02X}" for v in (*low["head"][row], low["level_flag"][row]))
    return _wrong_rows(ctx, bad, reported, f"head and level_flag are {reported}")


@check("H1-BMS-01")
def battery(ctx: RobotContext) -> Outcome:
    """Charge and voltages."""
    low = ctx.low
    soc, volts = low["bms_state.soc"], low["power_v"]
    cells = low["bms_state.cell_vol"].sum(axis=1) / 1e3
    bad = ~((soc >= 1) & (soc <= 100))
    bad |= ~((volts >= ctx.tolerance("min_v")) & (volts <= ctx.tolerance("max_v")))
    bad |= (cells > 0) & ~(np.abs(cells - volts) <= ctx.tolerance("max_part") * volts)
    row = int(np.argmax(bad))
    reported = f"{soc[row]:.0f} %, {volts[row]:.1f} V"
    if not bad.any():
        return ctx.passed(reported)
    return _wrong_rows(ctx, bad, reported, f"{reported}, cells of {cells[row]:.1f} V together")


@check("H1-FOOT-01")
def foot_forces(ctx: RobotContext) -> Outcome:
    """The smallest foot force."""
    force = ctx.low["foot_force"].min(axis=1)
    bad = force < ctx.tolerance("min_force")
    if not bad.any():
        return ctx.passed(f"{force.min(initial=0.0):.0f}")
    return _wrong_rows(ctx, bad, f"{force.min():.0f}", f"a foot force of {force.min():.0f}")


@check("H1-REMOTE-01")
def remote(ctx: RobotContext) -> Outcome:
    """The remote's sticks."""
    low = ctx.low
    same = low.constant("wireless_remote")  # constant in most recordings
    values = low["wireless_remote"] if same is None else same
    rows = np.ascontiguousarray(np.nan_to_num(values)).astype(np.uint8)
    kinds, which = np.unique(rows.view(f"V{rows.shape[1]}"), return_inverse=True)
    sticks = np.array([_STICKS.unpack_from(kind.tobytes()) for kind in kinds])
    bad = ~(np.abs(sticks) <= ctx.tolerance("max_stick")).all(axis=1)
    if not bad.any():
        return ctx.passed(f"{np.abs(sticks).max(initial=0.0):.2f}")
    worst = sticks[int(np.argmax(bad))]
    reported = ", ".join(f"{v:.3g}" for v in worst)
    wrong = np.broadcast_to(bad[which.reshape(-1)], len(low))
    return _wrong_rows(ctx, wrong, "out of range", f"sticks at {reported}")


@check("G1-MACH-01")
def reported_machine(ctx: RobotContext) -> Outcome:
    """The values of mode_machine."""
    kinds = np.unique(ctx.low["mode_machine"][ctx.low.ok])
    reported = ", ".join(f"{k:.0f}" for k in kinds)
    if len(kinds) == 1 and kinds[0] > 0:
        return ctx.passed(reported)
    return ctx.failed(reported, f"mode_machine is {reported}")


@check("H1-MODE-01", rests_on=("mode",))
def reported_mode(ctx: RobotContext) -> Outcome:
    """Mode bytes of held motors, and of a motor that was turned off."""
    robot = ctx.recording.robot
    for phase in (*ctx.phases("hold"), *ctx.phases()):
        begin, end = ctx.span(phase)
        modes = ctx.states.mode[ctx.states.between(begin + (end - begin) / 2, end)]
        if not len(modes):
            return ctx.skipped(f"no state during '{phase.name}'")
        wanted = np.array([robot.enable[slot] for slot in robot.used])
        if phase.name == "off":
            wanted[_index(ctx, phase)] = 0
        wrong = np.flatnonzero((modes != wanted).any(axis=0))
        if len(wrong):
            joint = int(wrong[0])
            name, reported = ctx.joints[joint].name, modes[-1, joint]
            return ctx.failed(
                f"{reported:.0f}",
                f"{name}: mode {reported:.0f} in the state, {wanted[joint]} in the command"
                + (f"; {len(wrong)} motors differ" if len(wrong) > 1 else ""),
                ctx.at(ctx.states.topic, begin, end),
            ).about(joint)
    return ctx.passed("reported")


# --------------------------------------------------------------------------------------- motion


def _index(ctx: RobotContext, phase: Phase) -> int:
    """The joint that a phase moves."""
    return ctx.recording.robot.used.index(int(phase.params["slot"]))


def _silent(ctx: RobotContext, phase: Phase) -> Outcome:
    """The outcome without a state in the phase: failed, or not judged if states come later."""
    begin, end = ctx.span(phase)
    if len(ctx.q(end, end + _LATE)):
        return ctx.skipped(f"no state in '{phase.name}', only later")
    place = ctx.at(ctx.states.topic, begin, end)
    return ctx.failed("no state", f"no state during '{phase.name}', nor after it", place)


@check("H1-MOVE-01", "H1-SAFE-04", "H1-LIFE-02")
@worst("error_rad", "max_error_rad", nothing="no step was made")
def follows(ctx: RobotContext) -> Figures:
    """Final position of each step of a joint."""
    for phase in (p for p in ctx.phases() if p.targets):
        begin, end = ctx.span(phase)
        q = ctx.q(begin, end)[-_SOME:]
        if not len(q):
            yield _silent(ctx, phase)
            return
        ((joint, goal),) = phase.targets[ctx.side].items()
        error = abs(mean(q[:, joint]) - goal)
        error = error if math.isfinite(error) else math.inf
        text, late = f"ends {error:.3f} rad from its target", STROKE_S * error / STEP
        yield Figure(error, begin, end, joint, text, late=late)


@check("H1-MOVE-02")
@worst("motion_rad", "max_motion_rad", nothing="no joint was moved")
def independent(ctx: RobotContext) -> Figures:
    """Motion of other joints while one is commanded."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        q = ctx.q(begin, end)
        if not len(q):
            yield _silent(ctx, phase)
            return
        moved = np.nan_to_num(np.abs(q - q[0]).max(axis=0), nan=np.inf)
        mine = _index(ctx, phase)
        moved[mine] = 0.0
        joint = int(np.argmax(moved))
        text = f"moves by {moved[joint]:.3f} rad with {ctx.joints[mine].name}"
        yield Figure(float(moved[joint]), begin, end, joint, text)


@check("H1-CRC-02", "H1-MODE-02", "H1-GAIN-04")
@check("H1-SAFE-01", "H1-SAFE-02", "H1-SAFE-03", "G1-SAFE-05")
@worst("motion_rad", "max_motion_rad", nothing="no such command was sent")
def stays(ctx: RobotContext) -> Figures:
    """Motion of joints during commands that must have no effect."""
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        before, q = ctx.q(begin - _LATE, begin)[-_SOME:], ctx.q(begin, end + _END)
        if not len(before) or not len(q):
            yield _silent(ctx, phase)
            return
        moved = np.nan_to_num(np.abs(q - before.mean(axis=0)).max(axis=0), nan=np.inf)
        joint = int(np.argmax(moved))
        kind = f" ({phase.params['kind']})" if "kind" in phase.params else ""
        text = f"moves by {moved[joint]:.3f} rad{kind}"
        yield Figure(float(moved[joint]), begin, end, joint, text)


def _alone(ctx: RobotContext) -> tuple[Phase, float, float, int]:
    """The only phase of a requirement, its begin and end, and its joint."""
    (phase,) = ctx.phases()
    return phase, *ctx.span(phase), _index(ctx, phase)


def _within(
    value: float, low: float, high: float, begin: float, end: float, **more: Any
) -> Figures:
    """A figure with a least and a greatest value."""
    yield Figure(value, begin, end, limit=low, at_least=True, **more)
    yield Figure(value, begin, end, limit=high, at_least=False, **more)


@check("H1-GAIN-01")
@worst("way_rad", "tolerance_part", nothing="")
def stiffness(ctx: RobotContext) -> Figures:
    """Displacement of a joint with low kp under a torque."""
    phase, begin, end, joint = _alone(ctx)
    wanted = float(phase.params["way"])
    before = ctx.q(begin - _LATE, begin)[-_SOME:, joint]
    after = ctx.q(begin, end)[-_SOME:, joint]
    if not len(before) or not len(after):
        yield _silent(ctx, phase)
        return
    way = float(after.mean() - before.mean())
    text = f"it is displaced by {way:.3f} rad; tau / kp is {wanted:.3f} rad"
    low, high = (1 + sign * ctx.tolerance("tolerance_part") for sign in (-1, 1))
    shown = f"{way:.3f} rad"
    yield from _within(way / wanted, low, high, begin, end, joint=joint, text=text, shown=shown)


def _speed(ctx: RobotContext, phase: Phase, begin: float, end: float) -> float | None:
    """The mean speed of the phase's joint in [begin, end], rad/s."""
    rows = ctx.states.between(begin, end)
    t, q = ctx.states.clock[rows], ctx.states.q[rows, _index(ctx, phase)]
    return float((q[-1] - q[0]) / (t[-1] - t[0])) if len(t) > 1 and t[-1] > t[0] else None


@check("H1-GAIN-02")
@worst("speed_part", "high_part", nothing="")
def velocity(ctx: RobotContext) -> Figures:
    """The speed of a joint with a commanded velocity."""
    phase, begin, end, joint = _alone(ctx)
    wanted = float(phase.params["speed"])
    speed = _speed(ctx, phase, (begin + end) / 2, end)
    if speed is None:
        yield _silent(ctx, phase)
        return
    text, shown = f"{speed:.2f} rad/s, commanded {wanted:.2f} rad/s", f"{speed:.2f} rad/s"
    low, high = ctx.tolerance("low_part"), ctx.tolerance("high_part")
    yield from _within(speed / wanted, low, high, begin, end, joint=joint, text=text, shown=shown)


@check("H1-GAIN-03")
@worst("motion_rad", "min_motion_rad", nothing="")
def torque(ctx: RobotContext) -> Figures:
    """Motion of a joint under a torque."""
    phase, begin, end, joint = _alone(ctx)
    q = ctx.q(begin, end + 0.05)[:, joint]
    if not len(q):
        yield _silent(ctx, phase)
        return
    wanted = float(phase.params["torque"])
    sign = math.copysign(1.0, wanted)
    way = sign * (q - q[0])
    far = float(way[np.argmax(np.abs(way))])
    yield Figure(far, begin, end, joint, f"{wanted:.2f} N m turn it by {far * sign:.3f} rad")


@check("H1-FORCE-01")
@worst("tau_part", "high_part", nothing="the joint was turned for too short a time")
def reported_torque(ctx: RobotContext) -> Figures:
    """tau_est while only tau is commanded."""
    phase, begin, end, joint = _alone(ctx)
    tau = ctx.tau(begin + 0.01, end)[:, joint]
    if len(tau) < 3:
        return
    wanted, reported = float(phase.params["torque"]), float(np.median(tau))
    text, shown = f"tau_est is {reported:.2f} N m, tau was {wanted:.2f} N m", f"{reported:.2f} N m"
    low, high = ctx.tolerance("low_part"), ctx.tolerance("high_part")
    part = reported / wanted
    yield from _within(part, low, high, begin, end, joint=joint, text=text, shown=shown)


# ------------------------------------------------------------------------------------- watchdog


@check("H1-WDOG-01")
@worst("speed_rad_s", "max_speed_rad_s", nothing="")
def damps(ctx: RobotContext) -> Figures:
    """Speed of a driven joint some time after the last command."""
    phase, begin, end, joint = _alone(ctx)
    after = begin + ctx.tolerance("max_s")
    speed = _speed(ctx, phase, after, end)
    if speed is None:
        yield _silent(ctx, phase)
        return
    text = f"{after - begin:.1f} s after the last command it turns at {speed:.2f} rad/s"
    yield Figure(abs(speed), after, end, joint, text, shown=f"{abs(speed):.2f} rad/s")


@check("H1-WDOG-02")
def state_in_silence(ctx: RobotContext) -> Outcome:
    """Gaps in the state while no command is sent."""
    limit, longest = ctx.tolerance("max_gap_s"), 0.0
    for phase in ctx.phases():
        begin, end = ctx.span(phase)
        found = timing.gaps(ctx, limit, begin, end)
        if found:
            a, b = found[0]
            text = f"no state from {a:.3f} s to {b:.3f} s, {a - begin:.2f} s after the last command"
            outcome = ctx.failed(f"{b - a:.2f} s", text, ctx.at(ctx.states.topic, a, b))
            return outcome.if_late(b - a - limit)
        clock = ctx.states.clock[(ctx.states.clock >= begin) & (ctx.states.clock <= end)]
        longest = max(longest, float(np.diff(clock).max(initial=0.0)))
    return ctx.passed(f"{longest * 1e3:.0f} ms", f"the longest gap is {longest * 1e3:.1f} ms")


@check("H1-WDOG-03")
def resumes(ctx: RobotContext) -> Outcome:
    """The jump when commands resume, and the step after it."""
    hold = next(p for p in ctx.phases() if not p.targets)
    begin, end = ctx.span(hold)
    q = ctx.q(begin - 0.02, end)
    if not len(q):
        return _silent(ctx, hold)
    moved = np.nan_to_num(np.abs(q - q[0]).max(axis=0), nan=np.inf)
    figures = [
        Figure(far, begin, end, joint, f"moves by {far:.3f} rad when commands arrive again")
        for joint, far in enumerate(moved.tolist())
    ]
    jump = judged(ctx, figures, "jump_rad", "max_jump_rad", nothing="")
    return follows(ctx) if jump.met else jump


@check("H1-WDOG-04")
@worst("speed_part", "min_part", nothing="")
def bridges(ctx: RobotContext) -> Figures:
    """The speed of a driven joint in a short pause."""
    phase, begin, end, joint = _alone(ctx)
    wanted = float(phase.params["speed"])
    speed = _speed(ctx, phase, begin, end)
    if speed is None:
        yield _silent(ctx, phase)
        return
    text = f"{speed:.2f} rad/s in a pause of {end - begin:.2f} s, commanded {wanted:.2f} rad/s"
    limit, shown = ctx.tolerance("low_part"), f"{speed:.2f} rad/s"
    yield Figure(speed / wanted, begin, end, joint, text, limit=limit, shown=shown)
