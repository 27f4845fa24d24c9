"""Check rarely used members of a state: if they are filled, they must be plausible.

A vendor may leave each of them 0. Otherwise it must have its documented meaning: a client might
misread an uninitialised byte, a value in another unit or a counter in a reserved word.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.consistency import STAIRS, held_s
from dexkit.conformance.checks.timing import encoder_step
from dexkit.conformance.median import median
from dexkit.conformance.motor_messages import sequence_of
from dexkit.conformance.plots import Plot, PlotKind
from dexkit.conformance.sums import total
from dexkit.hand import Floats
from dexkit.messages import message_type

__all__: list[str] = []

_STEPS = 3.0
"""Smallest second difference of q, encoder steps, that shows an acceleration: rounding of three
positions makes up to two steps, with a standard deviation of 0.7."""


def _motors(ctx: Context, *names: str) -> list[str]:
    """Paths of this hand's motors' members."""
    sequence = sequence_of(ctx.recording.dialect.state_type)
    first = ctx.recording.dialect.index[ctx.side]
    return [f"{sequence}[{first + i}].{n}" for i in range(len(ctx.joints)) for n in names]


def _packets(ctx: Context, name: str) -> list[str]:
    assert ctx.states.columns is not None
    count = int(ctx.states.columns.count("press_sensor_state").max(initial=0))
    return [f"press_sensor_state[{i}].{name}" for i in range(count)]


def _values(ctx: Context, path: str) -> Floats:
    """A member in every state that has it, shape (n, length)."""
    columns = ctx.states.columns
    assert columns is not None
    values = columns[path] if not columns.errors else columns[path][columns.ok]
    return values.reshape(len(values), -1)


def _distinct(ctx: Context, path: str) -> Floats:
    """As :func:`_values`, but a single row, shape (1, length), for a constant member."""
    assert ctx.states.columns is not None
    row = ctx.states.columns.constant(path)
    return _values(ctx, path) if row is None else row.reshape(1, -1)


def _within(values: Floats, low: float, high: float, or_zero: bool) -> NDArray[np.bool_]:
    good = (values >= low) & (values <= high)
    return good | (values == 0) if or_zero else good


def _at(ctx: Context, row: int) -> float:
    assert ctx.states.columns is not None
    return float(ctx.states.t[ctx.states.columns.ok][row])


def _outside(
    ctx: Context,
    paths: Iterable[str],
    low: float,
    high: float,
    *,
    or_zero: bool = False,
    at_start: bool = False,
) -> Outcome | None:
    """Failed if a value is not within [low, high]; None if all are.

    :param at_start: only in states before the first command.
    """
    assert ctx.states.columns is not None
    first = ctx.commands.t[0] if at_start and len(ctx.commands) else np.inf
    late = ctx.states.t[ctx.states.columns.ok] >= first
    when = " before the first command" if at_start else ""
    for path in paths:
        least, most = ctx.states.columns.extremes(path)
        if low <= least and most <= high:
            continue
        if _within(_distinct(ctx, path), low, high, or_zero).all():
            continue
        values = _values(ctx, path)
        good = _within(values, low, high, or_zero) | late[:, np.newaxis]
        if good.all():
            continue
        row, place = (int(i) for i in np.argwhere(~good)[0])
        name = path if values.shape[1] == 1 else f"{path}[{place}]"
        value = values[row, place]
        return ctx.failed(
            f"{value:g}",
            f"{name} = {value:g} in {int((~good).any(axis=1).sum())} states{when}",
            ctx.at(ctx.states.topic, _at(ctx, row)),
        ).shown_by(Plot.of_member(name), PlotKind.POSITION)
    return None


def _span(ctx: Context, paths: Iterable[str]) -> str:
    """The range of the values, as text."""
    assert ctx.states.columns is not None
    low, high = np.inf, -np.inf
    for path in paths:
        least, most = ctx.states.columns.extremes(path)
        low, high = min(low, least), max(high, most)
    return f"{low:g}" if low == high else f"{low:g} .. {high:g}"


_MAX = float(np.finfo(np.float32).max)


def _finite(ctx: Context, paths: list[str]) -> Outcome:
    wrong = _outside(ctx, paths, -_MAX, _MAX)
    return wrong or ctx.passed("all finite", f"{len(paths)} members")


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


def _integral(t: Floats, x: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum((x[1:] + x[:-1]) / 2 * np.diff(t))))


@dataclass(frozen=True)
class _Bends:
    """Where a second difference over a window can be computed; the same for every joint.

    :param middle: rows of the samples, with ``before`` and ``behind`` a window away, and the
        seconds to these, ``a`` and ``b``.
    :param even: whether it can be computed there.
    """

    window: float
    middle: NDArray[np.intp]
    before: NDArray[np.intp]
    behind: NDArray[np.intp]
    a: Floats
    b: Floats
    even: NDArray[np.bool_]

    @classmethod
    def of(cls, t: Floats, window: float) -> _Bends:
        """Not at a gap, and not at samples with late timestamps. In such a short window a
        timestamp that is late by a tenth of the window has the effect of an acceleration.
        """
        middle = np.flatnonzero((t >= t[0] + window) & (t <= t[-1] - window))
        before = np.searchsorted(t, t[middle] - window)
        behind = np.searchsorted(t, t[middle] + window)
        a, b = t[middle] - t[before], t[behind] - t[middle]
        even = (np.abs(a - window) < 0.2 * window) & (np.abs(b - window) < 0.2 * window)
        steps, usual = np.diff(t), median(np.diff(t))
        uneven = (steps > usual + 0.1 * window) | (steps < 0.3 * usual)
        count = np.concatenate(([0], np.cumsum(uneven)))
        even &= count[behind] == count[before]
        return cls(window, middle, before, behind, a, b, even)

    def bend(self, x: Floats) -> Floats:
        """Second difference of x, per second squared; 0 where it cannot be computed."""
        middle = x[self.middle]
        with np.errstate(divide="ignore", invalid="ignore"):  # a gap has no even neighbours
            slope = (x[self.behind] - middle) / self.b - (middle - x[self.before]) / self.a
        return np.asarray(np.where(self.even, slope / self.window, 0.0))


_MEDIANS = 6.0
"""Medians of what q shows beyond which normal noise is once in 20,000 states."""


@check("DEX1-FIELD-06", "DEX3-FIELD-05", rests_on=("ddq",))
def acceleration(ctx: Context) -> Outcome:
    """Compare ddq with the second difference of q over a window."""
    states = ctx.states
    if not ((states.ddq != 0) & ~np.isnan(states.ddq)).any():
        return ctx.absent("ddq is not filled (0 throughout)")
    window = ctx.tolerance("window_s")
    worst = (1.0, 0)
    judged = False
    t = states.clock
    bends = ctx.once(("bends", window), lambda: _Bends.of(t, window))
    for joint in range(len(ctx.joints)):
        q = states.q[:, joint]
        if STAIRS * held_s(ctx, joint) > window:
            continue  # it changes faster than it is measured
        # integrated twice, so that it can be compared with q over the same window
        dq = _integral(t, states.ddq[:, joint])
        reported, seen = map(bends.bend, (_integral(t, dq), q))
        # the steps of a coarse encoder are not an acceleration
        rounding = _STEPS * encoder_step(ctx, joint) / window**2
        noise = _MEDIANS * median(np.abs(seen))  # most of the time no joint accelerates
        busy = np.abs(seen) > max(ctx.tolerance("min_ddq_rad_s2"), rounding, noise)
        if busy.sum() < 20:
            continue
        judged = True
        ratio = total(reported[busy] * seen[busy]) / total(seen[busy] ** 2)
        worst = max(worst, (ratio, joint), key=lambda w: abs(w[0] - 1.0))
    if not judged:
        return ctx.skipped("the hand hardly accelerates where its states arrive regularly")
    ratio, joint = worst
    text = ctx.named(f"ddq is {ratio:.2f} times what q shows", joint)
    if ctx.tolerance("min_ratio") <= ratio <= ctx.tolerance("max_ratio"):
        return ctx.passed(f"x {ratio:.2f}", text, ratio=ratio)
    # such late timestamps have the effect of the smallest acceleration judged here
    size = 0.1 * window
    outcome = ctx.failed(f"x {ratio:.2f}", text, ratio=ratio).about(joint).if_late(size, how="p99")
    return outcome.because("its sign is wrong") if ratio < 0 else outcome


@check("DEX1-FIELD-07", rests_on=("q_raw",))
def raw(ctx: Context) -> Outcome:
    """Raw values are numbers."""
    return _finite(ctx, _motors(ctx, "q_raw", "dq_raw", "ddq_raw"))


@check("DEX1-FIELD-08", "DEX3-FIELD-06", rests_on=("temperature",))
def temperature(ctx: Context) -> Outcome:
    """Motor temperatures in degrees Celsius."""
    paths = _motors(ctx, "temperature")
    wrong = _outside(ctx, paths, ctx.tolerance("low"), ctx.tolerance("high"))
    wrong = wrong or _outside(ctx, paths, -np.inf, ctx.tolerance("max_at_start"), at_start=True)
    figure = _span(ctx, paths)
    if not wrong and figure == "0":
        return ctx.absent("temperature is not filled (0 throughout)")
    return wrong or ctx.passed(f"{figure} C", f"temperature {figure} C")


@check("DEX1-FIELD-09", rests_on=("lost",))
def lost(ctx: Context) -> Outcome:
    """The count of lost messages."""
    path = _motors(ctx, "lost")
    figure = _span(ctx, path)
    return _outside(ctx, path, 0.0, ctx.tolerance("max_lost")) or ctx.passed(
        figure, f"lost {figure}"
    )


@check("DEX1-FIELD-10", "DEX3-FIELD-09", rests_on=("reserve",))
def reserved(ctx: Context) -> Outcome:
    """Number of different values of each reserved word."""
    paths = _motors(ctx, "reserve")
    members = {f.name for f in message_type(ctx.recording.dialect.state_type).layout.fields}
    if "press_sensor_state" in members:
        paths += _motors(ctx, "sensor")
        paths += [*_packets(ctx, "reserve"), "reserve"]
    most = (0, "")
    for path in paths:
        values = _distinct(ctx, path)
        for place in range(values.shape[1]):
            most = max(most, (len(np.unique(values[:, place])), f"{path}[{place}]"))
    count, path = most
    text = f"{path} takes {count} different {'value' if count == 1 else 'values'}"
    if count <= ctx.tolerance("max_values"):
        return ctx.passed(f"{count}", text)
    outcome = ctx.failed(f"{count} values", text)
    return outcome.shown_by(Plot.of_member(path), PlotKind.POSITION)


@check("DEX1-FIELD-11", "DEX3-FIELD-07", rests_on=("voltage",))
def voltages(ctx: Context) -> Outcome:
    """The supply, in volts and amperes."""
    volts = [*_motors(ctx, "vol"), "power_v", "system_v", "device_v"]
    wrong = _outside(ctx, volts, ctx.tolerance("min_v"), ctx.tolerance("max_v"), or_zero=True)
    wrong = wrong or _outside(ctx, ["power_a"], -ctx.tolerance("max_a"), ctx.tolerance("max_a"))
    figure = _span(ctx, volts)
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
        values = _values(ctx, path)[free][:, :1]
        if values.any():
            row = int(np.argmax(values.any(axis=1)))
            return ctx.failed(
                f"{int(values[row, 0]):#x}",
                f"{path} = {int(values[row, 0]):#x} in {int(values.any(axis=1).sum())} states of "
                "a hand that obeys its commands",
                ctx.at(ctx.states.topic, float(t[free][row])),
            ).shown_by(Plot.of_member(path), PlotKind.POSITION)
    return ctx.passed("0", f"no fault in {int(free.sum())} states")


_IMU = [f"imu_state.{name}" for name in ("quaternion", "gyroscope", "accelerometer", "rpy")]


@check("DEX1-FIELD-13")
def rest_of_the_hand(ctx: Context) -> Outcome:
    """Attitude and sensors, which a gripper does not have."""
    return _finite(ctx, [*_IMU, *_packets(ctx, "pressure"), *_packets(ctx, "temperature")])


@check("DEX3-IMU-02")
def attitude_numbers(ctx: Context) -> Outcome:
    """Values in the attitude; the sensors have separate requirements."""
    return _finite(ctx, _IMU)


@check("DEX3-SENS-05")
def sensor_temperature(ctx: Context) -> Outcome:
    """Sensor temperatures in degrees Celsius."""
    paths = _packets(ctx, "temperature")
    if not paths:
        return ctx.absent("the states hold no sensor packets")
    low, high = ctx.tolerance("low"), ctx.tolerance("high")
    # a slot without an element holds the code for that in its temperature, too
    wrong = None
    for path in paths:
        values = _distinct(ctx, path)
        good = ((values >= low) & (values <= high)) | (values == ctx.tolerance("no_value"))
        if not good.all():
            wrong = wrong or _outside(ctx, [path], low, high)
    figure = _span(ctx, paths)
    if not wrong and figure == "0":
        return ctx.absent("sensor temperatures are not filled (0 throughout)")
    return wrong or ctx.passed(f"{figure} C", f"sensor temperatures {figure}")


@check("DEX3-SENS-06")
def sensor_lost(ctx: Context) -> Outcome:
    """The sensor packets' counts of lost packets."""
    paths = _packets(ctx, "lost")
    if not paths:
        return ctx.absent("the states hold no sensor packets")
    figure = _span(ctx, paths)
    return _outside(ctx, paths, 0.0, ctx.tolerance("max_lost")) or ctx.passed(
        figure, f"lost {figure}"
    )


@check("DEX1-START-02")
def legacy_ready(ctx: Context) -> Outcome:
    """Whether any q is not 0 before the first command, on the legacy topic."""
    first = float(ctx.commands.t[0]) if len(ctx.commands) else np.inf
    before = [v.states.q[v.states.t < first] for v in ctx.recording.sides.values()]
    if not any(len(q) for q in before):
        return ctx.skipped("no state before the first command")
    most = max(float(np.nan_to_num(np.abs(q)).max()) for q in before if len(q))
    if most > 0:
        return ctx.passed(
            f"{most:.2f} {ctx.unit}", f"up to {most:.3f} {ctx.unit} before the first command"
        )
    return ctx.failed("all zero", "every q is exactly 0 before the first command")
