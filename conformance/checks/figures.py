"""Judge measured figures by a limit: a check says what it measured, and the worst figure decides.

A check of this kind yields a :class:`Figure` for each place at which it measured something, and
:func:`worst` makes an outcome of them: met if the figure that is farthest beyond its limit, or
nearest to it, is not beyond. What the figure is called says its unit (``overshoot_rad``, ``gap_s``,
``tau_nm``, ``rate_hz``; anything else is a part, in percent), and what its limit is called says its
direction (``max_overshoot_stroke``, ``min_part``)::

    @check()
    @worst("overshoot_rad", "max_overshoot_stroke", nothing="no step of that size")
    def overshoot(ctx: Context) -> Figures:
        for step in steps(ctx):
            beyond = float(np.max((step.q - step.target) * np.sign(step.size)))
            yield step.figure(max(beyond, 0.0), f"{beyond:.3f} {ctx.unit} beyond the target")

A check may yield an :class:`~dexkit.conformance.checks.Outcome` instead: it decides at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import TypeAlias, TypeVar

from dexkit.conformance.checks import STROKE_S, Context, Late, Outcome
from dexkit.conformance.kit.measurement_error import Measure, Quantity

__all__ = ["Figure", "Figures", "judged", "with_object", "worst"]


@dataclass(frozen=True)
class Figure:
    """Something that was measured at a place, to be compared with a limit.

    :param value: in the unit that its name in the outcome ends with.
    :param begin: of its place, seconds, as ``end``; None for a point in time, or for no place.
    :param joint: index of the joint that it is about; None for none in particular.
    :param text: what was observed there; the joint's name is put before it.
    :param met: the same where the limit is met, if other words are needed then.
    :param limit: if it has one of its own; else the requirement's tolerance, for that joint.
    :param at_least: whether its limit is the least, if that is not what the limit's name says.
    :param shown: the figure in short, if the unit's usual form does not do.
    :param late: the delay of a good hand that would cause the same, seconds; None for what the unit
        implies: by how much a time is too long, and how long a hand takes to move that far.
    :param measure: what is compared with the kit's error, if not the value itself.
    :param values: more numbers for the result.
    :param topic: of its place, if that is not the state's.
    """

    value: float
    begin: float | None = None
    end: float | None = None
    joint: int | None = None
    text: str = ""
    met: str = ""
    limit: float | None = None
    at_least: bool | None = None
    shown: str = ""
    late: float | Late | None = None
    measure: Measure | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    topic: str = ""


Figures: TypeAlias = Iterable[Figure | Outcome]
"""What a check measured; an outcome among them decides at once."""
ContextT = TypeVar("ContextT", bound=Context)
_Judge: TypeAlias = Callable[[ContextT], Outcome]


@dataclass(frozen=True)
class _Unit:
    """How a figure is written where its limit is met, and where not; and its kind of error."""

    met: str
    failed: str
    quantity: Quantity | None = None


_UNITS = {
    "rad_s": _Unit("{:.1f} rad/s", "{:.1f} rad/s"),
    "rad": _Unit("{:.3f} rad", "{:.2f} rad", Quantity.POSITION),
    "nm": _Unit("{:.2f} N m", "{:.2f} N m", Quantity.TORQUE),
    "s": _Unit("{:.2f} s", "{:.2f} s", Quantity.TIME),
    "hz": _Unit("{:.1f} Hz", "{:.1f} Hz"),
    "ratio": _Unit("x {:.1f}", "x {:.1f}"),
}
_PART = _Unit("{:.0%}", "{:.0%}")
_NAMES = {Quantity.POSITION: "rad", Quantity.TORQUE: "N m", Quantity.TIME: "s"}


def _unit_of(name: str) -> _Unit:
    """The unit that a figure's name ends with."""
    return next((u for end, u in _UNITS.items() if f"_{name}".endswith(f"_{end}")), _PART)


def worst(
    name: str, limit: str, *, nothing: str
) -> Callable[[Callable[[ContextT], Figures]], _Judge[ContextT]]:
    """Make a check of a function that yields figures; see :func:`judged` for the parameters."""

    def of(measure: Callable[[ContextT], Figures]) -> _Judge[ContextT]:
        @wraps(measure)
        def check(ctx: ContextT) -> Outcome:
            return judged(ctx, measure(ctx), name, limit, nothing=nothing)

        return check

    return of


def with_object(check: _Judge[ContextT]) -> _Judge[ContextT]:
    """Skip a check of a hand that has nothing to squeeze."""

    @wraps(check)
    def skipping(ctx: ContextT) -> Outcome:
        if ctx.object_at is None:
            return ctx.skipped("this hand was not given an object to squeeze (--object)")
        return check(ctx)

    return skipping


def judged(
    ctx: Context, figures: Figures, name: str, limit: str, *, nothing: str | Outcome
) -> Outcome:
    """The outcome of the worst of some figures.

    :param name: of the value in the outcome, which ends with its unit.
    :param limit: name of the tolerance, whose ``max_`` or ``min_`` says in which direction it
        limits.
    :param nothing: why the requirement cannot be judged, where there is no figure; or the outcome.
    """
    found: list[Figure] = []
    for one in figures:
        if isinstance(one, Outcome):
            return one
        if one.limit is None:
            one = replace(one, limit=ctx.tolerance(limit, one.joint or 0))
        if one.at_least is None:
            one = replace(one, at_least=limit.startswith("min_"))
        found.append(one)
    if not found:
        return ctx.skipped(nothing) if isinstance(nothing, str) else nothing
    return _outcome(ctx, max(found, key=_beyond), name)


def _beyond(figure: Figure) -> float:
    """By how much a figure is beyond its limit, as a part of that; negative where it is met."""
    assert figure.limit is not None
    if math.isnan(figure.value):
        return math.inf
    beyond = figure.value - figure.limit
    return (-beyond if figure.at_least else beyond) / max(abs(figure.limit), 1e-9)


def _outcome(ctx: Context, figure: Figure, name: str) -> Outcome:
    value, limit, unit = float(figure.value), figure.limit, _unit_of(name)
    assert limit is not None
    at_least = bool(figure.at_least)
    met = value >= limit if at_least else value <= limit
    shown = figure.shown or (unit.met if met else unit.failed).format(value)
    shown = shown if figure.shown else shown.replace("rad", ctx.unit)
    text = (met and figure.met) or figure.text
    values = {name: value, **figure.values}
    if met:
        outcome = ctx.passed(shown, _named(ctx, figure, text), **values)
    else:
        topic = figure.topic or ctx.states.topic
        places = () if figure.begin is None else (ctx.at(topic, figure.begin, figure.end),)
        outcome = ctx.failed(shown, _named(ctx, figure, text), *places, **values)
        outcome = replace(outcome, late=_late(ctx, figure, unit))
        if figure.joint is not None:
            outcome = outcome.about(figure.joint)
    measure = figure.measure
    if measure is None and unit.quantity is not None:
        kind, span = unit.quantity, None
        if figure.begin is not None and figure.end is not None:
            span = figure.begin, figure.end
        measure = Measure(value, float(limit), _NAMES[kind], kind, not at_least, span=span)
    return outcome if measure is None else outcome.resting_on(measure)


def _named(ctx: Context, figure: Figure, text: str) -> str:
    return text if figure.joint is None else ctx.named(text, figure.joint)


def _late(ctx: Context, figure: Figure, unit: _Unit) -> Late | None:
    """The delay of a good hand that would cause this failure; see :class:`Late`."""
    if isinstance(figure.late, Late):
        return figure.late
    seconds = figure.late
    if seconds is None and unit.quantity is Quantity.TIME and figure.limit is not None:
        seconds = figure.value - figure.limit
    if seconds is None and unit.quantity is Quantity.POSITION and not figure.at_least:
        seconds = STROKE_S * abs(figure.value) / ctx.joints[figure.joint or 0].stroke
    return None if seconds is None else Late((max(0.0, float(seconds)),))
