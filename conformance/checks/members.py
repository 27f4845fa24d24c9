"""Members of a state: their values, and which of them are outside of limits."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.hand import Floats


def values_of(ctx: Context, path: str) -> Floats:
    """A member in every state that has it, shape (n, length)."""
    columns = ctx.states.columns
    assert columns is not None
    values = columns[path] if not columns.errors else columns[path][columns.ok]
    return values.reshape(len(values), -1)


def distinct_values(ctx: Context, path: str) -> Floats:
    """As :func:`values_of`, but a single row, shape (1, length), for a constant member."""
    assert ctx.states.columns is not None
    row = ctx.states.columns.constant(path)
    return values_of(ctx, path) if row is None else row.reshape(1, -1)


def _within(values: Floats, low: float, high: float, or_zero: bool) -> NDArray[np.bool_]:
    good = (values >= low) & (values <= high)
    return good | (values == 0) if or_zero else good


def _at(ctx: Context, row: int) -> float:
    assert ctx.states.columns is not None
    return float(ctx.states.t[ctx.states.columns.ok][row])


def outside(
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
        if _within(distinct_values(ctx, path), low, high, or_zero).all():
            continue
        values = values_of(ctx, path)
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


def span_text(ctx: Context, paths: Iterable[str]) -> str:
    """The range of the values, as text."""
    assert ctx.states.columns is not None
    low, high = np.inf, -np.inf
    for path in paths:
        least, most = ctx.states.columns.extremes(path)
        low, high = min(low, least), max(high, most)
    return f"{low:g}" if low == high else f"{low:g} .. {high:g}"
