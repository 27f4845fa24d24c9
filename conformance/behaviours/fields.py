"""The members of a state: length, finite numbers, temperatures, voltages, faults, unused ones.

A vendor may leave each of them 0. Otherwise it must have its documented meaning: a client might
misread an uninitialised byte, a value in another unit or a counter in a reserved word.
"""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.combined import all_of
from dexkit.conformance.checks.members import (
    outside,
    span_text,
    values_of,
)
from dexkit.conformance.checks.robot import RobotContext, wrong_rows
from dexkit.conformance.kit.motor_messages import sequence_of
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.kit.provenance import MESSAGES


@check("DEX1-FIELD-01", "DEX3-FIELD-01", "H1-FIELD-01", rests_on=(MESSAGES,))
def complete(ctx: Context) -> Outcome:
    """Samples decode, and have all motors and finite numbers."""
    return all_of(_length(ctx), _finite(ctx))


def _length(ctx: Context) -> Outcome:
    """Samples decode and have one motor per hand."""
    states, wanted = ctx.states, ctx.recording.dialect.length
    wrong = np.flatnonzero(states.length != wanted)
    if not len(wrong):
        return ctx.passed(str(wanted), f"{len(states)} samples, each of length {wanted}")
    i = int(wrong[0])
    what = states.errors.get(i) or f"length {states.length[i]}"
    return ctx.failed(
        f"{len(wrong)} of {len(states)}",
        f"{len(wrong)} of {len(states)} samples are wrong; the first: {what}",
        *(ctx.at(states.topic, float(states.t[k])) for k in wrong[:5]),
        wrong=len(wrong),
    )


def _finite(ctx: Context) -> Outcome:
    """No NaN, no infinity."""
    states = ctx.states
    there = states.length >= ctx.recording.dialect.index[ctx.side] + len(ctx.joints)
    if not there.any():
        return ctx.skipped("no sample holds this hand's motor")
    columns = {"q": states.q, "dq": states.dq, "ddq": states.ddq, "tau_est": states.tau}
    good = {name: np.isfinite(column) for name, column in columns.items()}
    bad = {n: np.flatnonzero(there & ~g.all(axis=1)) for n, g in good.items() if not g.all()}
    bad = {name: rows for name, rows in bad.items() if len(rows)}
    if not bad:
        return ctx.passed("all finite", f"{int(there.sum())} samples")
    name, rows = next(iter(bad.items()))
    joint = int(np.argmin(np.isfinite(columns[name][rows[0]])))
    outcome = ctx.failed(
        f"{name} = {columns[name][rows[0], joint]}",
        "; ".join(
            ctx.named(f"{n} is not finite in {len(r)} samples", joint) for n, r in bad.items()
        ),
        *(ctx.at(states.topic, float(states.t[k])) for k in rows[:5]),
    ).about(joint)
    shown = (Plot.of_member(name),) if name != "q" else ()
    return outcome.shown_by(*shown, PlotKind.POSITION)


def _motors(ctx: Context, *names: str) -> list[str]:
    """Paths of this hand's motors' members."""
    sequence = sequence_of(ctx.recording.dialect.state_type)
    first = ctx.recording.dialect.index[ctx.side]
    return [f"{sequence}[{first + i}].{n}" for i in range(len(ctx.joints)) for n in names]


@check("DEX1-FIELD-05", rests_on=("mode",))
def mode(ctx: Context) -> Outcome:
    """A gripper's mode: 0, or 1 while it is driven."""
    found = np.unique(ctx.states.mode[np.isfinite(ctx.states.mode)])
    seen = " and ".join(f"{m:g}" for m in found)
    if set(found) <= {0.0, ctx.tolerance("driven")}:
        for phase in ctx.recording.phases("silence", ctx.side):
            _, end = ctx.span(phase)
            late = ctx.states.between(end - 0.3, end)
            if (ctx.states.mode[late, 0] == ctx.tolerance("driven")).any():
                return ctx.failed(
                    "driven in silence",
                    "mode shows a driven motor when no command is in force any more",
                    ctx.at(ctx.states.topic, end - 0.3, end),
                )
        return ctx.passed(seen, f"mode {seen}")
    wrong = next(m for m in found if m not in (0.0, ctx.tolerance("driven")))
    row = int(np.argmax(ctx.states.mode[:, 0] == wrong))
    return ctx.failed(
        f"{wrong:g}", f"mode {seen}", ctx.at(ctx.states.topic, float(ctx.states.t[row]))
    )


@check("DEX1-FIELD-08", "DEX3-FIELD-06", rests_on=("temperature",))
def temperature(ctx: Context) -> Outcome:
    """Motor temperatures in degrees Celsius."""
    paths = _motors(ctx, "temperature")
    wrong = outside(ctx, paths, ctx.tolerance("low"), ctx.tolerance("high"))
    wrong = wrong or outside(ctx, paths, -np.inf, ctx.tolerance("max_at_start"), at_start=True)
    figure = span_text(ctx, paths)
    if not wrong and figure == "0":
        return ctx.absent("temperature is not filled (0 throughout)")
    return wrong or ctx.passed(f"{figure} C", f"temperature {figure} C")


@check("DEX1-FIELD-11", "DEX3-FIELD-07", rests_on=("voltage",))
def voltages(ctx: Context) -> Outcome:
    """The supply, in volts and amperes."""
    volts = [*_motors(ctx, "vol"), "power_v", "system_v", "device_v"]
    wrong = outside(ctx, volts, ctx.tolerance("min_v"), ctx.tolerance("max_v"), or_zero=True)
    wrong = wrong or outside(ctx, ["power_a"], -ctx.tolerance("max_a"), ctx.tolerance("max_a"))
    figure = span_text(ctx, volts)
    if not wrong and figure == "0":
        return ctx.absent("no voltage is filled (0 throughout)")
    return wrong or ctx.passed(f"{figure} V", f"voltages {figure} V")


@check("DEX1-FIELD-12", "DEX3-FIELD-08", rests_on=("faults",))
def no_fault(ctx: Context) -> Outcome:
    """Fault words while a hand moves without contact and obeys its commands."""
    spans = [ctx.span(p) for p in ctx.phases()]
    paths = [*_motors(ctx, "motorstate"), "error"]
    assert ctx.states.columns is not None
    t = ctx.states.t[ctx.states.columns.ok]
    free = np.zeros(len(t), dtype=np.bool_)
    for begin, end in spans:
        free |= (t >= begin) & (t <= end)
    if not free.any():
        return ctx.skipped("no state while it moved")
    # the second word of error is vendor-specific
    for path in paths:
        values = values_of(ctx, path)[free][:, :1]
        if values.any():
            row = int(np.argmax(values.any(axis=1)))
            return ctx.failed(
                f"{int(values[row, 0]):#x}",
                f"{path} = {int(values[row, 0]):#x} in {int(values.any(axis=1).sum())} states of "
                "a hand that obeys its commands",
                ctx.at(ctx.states.topic, float(t[free][row])),
            ).shown_by(Plot.of_member(path), PlotKind.POSITION)
    return ctx.passed("0", f"no fault in {int(free.sum())} states")


@check("H1-FIELD-05")
def unused_slots(ctx: RobotContext) -> Outcome:
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
            outcome = wrong_rows(ctx, bad, f"slot {slot}", what)
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
            outcome = wrong_rows(ctx, bad, figure, f"{member} is {figure}")
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
    outcome = wrong_rows(ctx, bad.any(axis=1), figure, what, (joint,))
    return outcome.shown_by(Plot.of_member(f"motor_state[{robot.used[joint]}].{path}"))
