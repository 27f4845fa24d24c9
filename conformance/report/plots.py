"""Plots as inline SVG, drawn from a recording's columns; colours come from the page's CSS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

import numpy as np

from dexkit.hand import Floats

__all__ = ["Band", "Line", "histogram", "nice_ticks", "thin", "time_plot"]

WIDTH = 960
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 26
_MAX_POINTS = 1400


@dataclass(frozen=True, eq=False)
class Line:
    """One curve.

    :param css: class that colours it.
    """

    label: str
    css: str
    x: Floats
    y: Floats


@dataclass(frozen=True)
class Band:
    """A stretch of time with a name."""

    label: str
    begin: float
    end: float
    css: str = "band"


def thin(x: Floats, y: Floats, points: int = _MAX_POINTS) -> tuple[Floats, Floats]:
    """Fewer points of the same look: each bin keeps its smallest and largest value, in order."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) <= points:
        return x, y
    edges = np.linspace(0, len(x), points // 2 + 1).astype(int)
    keep: list[int] = []
    for a, b in pairwise(edges.tolist()):
        if b > a:
            low, high = a + int(np.argmin(y[a:b])), a + int(np.argmax(y[a:b]))
            keep += sorted({low, high})
    return x[keep], y[keep]


def pieces(x: Floats, y: Floats) -> list[tuple[Floats, Floats]]:
    """The curve cut where samples are missing: a line across a gap would be invented."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) < 3:
        return [(x, y)] if len(x) else []
    steps = np.diff(x)
    cuts = np.flatnonzero(steps > max(0.05, 8 * float(np.median(steps)))) + 1
    return list(zip(np.split(x, cuts), np.split(y, cuts), strict=True))


def nice_ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round values from ``low`` to ``high``."""
    if not high > low:
        return [low]
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


@dataclass
class _Frame:
    """Axes of one plot."""

    height: int
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    parts: list[str] = field(default_factory=list)

    def x(self, value: float) -> float:
        low, high = self.x_range
        return LEFT + (value - low) / (high - low or 1.0) * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        low, high = self.y_range
        share = (value - low) / (high - low or 1.0)
        return self.height - BOTTOM - share * (self.height - TOP - BOTTOM)

    def axes(self, x_unit: str, y_unit: str) -> None:
        for tick in nice_ticks(*self.y_range, 5):
            at = self.y(tick)
            self.parts.append(
                f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
                f'<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{tick:g}'
                "</text>"
            )
        for tick in nice_ticks(*self.x_range, 10):
            at = self.x(tick)
            self.parts.append(
                f'<text class="tick" x="{at:.1f}" y="{self.height - 8}" text-anchor="middle">'
                f"{tick:g}</text>"
            )
        self.parts.append(
            f'<text class="unit" x="4" y="14">{escape(y_unit)}</text>'
            f'<text class="unit" x="{WIDTH - RIGHT}" y="{self.height - 8}" text-anchor="end">'
            f"{escape(x_unit)}</text>"
        )

    def svg(self, title: str) -> str:
        return (
            f'<svg viewBox="0 0 {WIDTH} {self.height}" role="img" aria-label="{escape(title)}">'
            f"<title>{escape(title)}</title>{''.join(self.parts)}</svg>"
        )


def time_plot(
    title: str,
    lines: Sequence[Line],
    *,
    unit: str,
    span: tuple[float, float],
    bands: Sequence[Band] = (),
    height: int = 220,
    include: Sequence[float] = (),
    limits: Sequence[tuple[float, str]] = (),
) -> str:
    """Curves over time.

    :param include: values that the vertical axis must reach.
    :param limits: (value, label) of horizontal lines.
    """
    curves = []
    values: list[float] = [*include, *(v for v, _ in limits)]
    for line in lines:
        inside = (line.x >= span[0]) & (line.x <= span[1])
        for piece in pieces(line.x[inside], line.y[inside]):
            share = len(piece[0]) / max(int(inside.sum()), 1)
            x, y = thin(*piece, points=max(20, round(_MAX_POINTS * share)))
            curves.append((line, x, y))
            values += [float(y.min()), float(y.max())]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    pad = 0.06 * (high - low) or 0.5
    frame = _Frame(height, span, (low - pad, high + pad))
    for band in bands:
        a, b = max(band.begin, span[0]), min(band.end, span[1])
        if b <= a:
            continue
        xa, xb = frame.x(a), frame.x(b)
        frame.parts.append(
            f'<rect class="{band.css}" x="{xa:.1f}" y="{TOP}" width="{max(xb - xa, 1):.1f}" '
            f'height="{height - TOP - BOTTOM}"><title>{escape(band.label)}, {a:.2f} to {b:.2f} s'
            "</title></rect>"
        )
    _band_labels(frame, bands, span)
    frame.axes("s", unit)
    for value, label in limits:
        at = frame.y(value)
        frame.parts.append(
            f'<line class="limit" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
            f'<text class="tick" x="{WIDTH - RIGHT - 4}" y="{at - 4:.1f}" text-anchor="end">'
            f"{escape(label)}</text>"
        )
    for line, x, y in curves:
        points = " ".join(
            f"{frame.x(float(a)):.1f},{frame.y(float(b)):.1f}" for a, b in zip(x, y, strict=True)
        )
        frame.parts.append(f'<polyline class="{line.css}" points="{points}"/>')
    return frame.svg(title)


def _band_labels(frame: _Frame, bands: Sequence[Band], span: tuple[float, float]) -> None:
    """Names above the bands, where there is room for them."""
    free_from = 0.0
    for band in sorted(bands, key=lambda b: b.begin):
        a, b = max(band.begin, span[0]), min(band.end, span[1])
        if b <= a:
            continue
        width = 6.3 * len(band.label)
        at = max(frame.x(a), free_from)
        if at > frame.x(b) or at + width > WIDTH - RIGHT:
            continue
        frame.parts.append(
            f'<text class="phase" x="{at:.1f}" y="{TOP - 6}">{escape(band.label)}</text>'
        )
        free_from = at + width + 6


def histogram(title: str, values: Floats, *, unit: str, limits: Sequence[tuple[float, str]]) -> str:
    """How often which value occurs, on a logarithmic count axis: the rare ones matter."""
    top = max([float(np.percentile(values, 99.9)), *(v for v, _ in limits)]) * 1.15
    counts, edges = np.histogram(np.minimum(values, top), bins=80, range=(0.0, top))
    high = math.log10(max(int(counts.max()), 10))
    frame = _Frame(180, (0.0, top), (0.0, high * 1.05))
    for power in range(math.ceil(high) + 1):
        if power <= high * 1.05:
            at = frame.y(power)
            frame.parts.append(
                f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
                f'<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">'
                f"{10**power:g}</text>"
            )
    for tick in nice_ticks(0.0, top, 10):
        frame.parts.append(
            f'<text class="tick" x="{frame.x(tick):.1f}" y="{frame.height - 8}" '
            f'text-anchor="middle">{tick:g}</text>'
        )
    for count, a, b in zip(counts, edges[:-1], edges[1:], strict=True):
        if count:
            y = frame.y(max(math.log10(int(count)), 0.04))
            frame.parts.append(
                f'<rect class="bar" x="{frame.x(float(a)) + 0.5:.1f}" y="{y:.1f}" '
                f'width="{frame.x(float(b)) - frame.x(float(a)) - 1:.1f}" '
                f'height="{frame.height - BOTTOM - y:.1f}"><title>{count} intervals of '
                f"{a:.1f} to {b:.1f} {escape(unit)}</title></rect>"
            )
    for value, label in limits:
        at = frame.x(value)
        frame.parts.append(
            f'<line class="limit" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" '
            f'y2="{frame.height - BOTTOM}"/>'
            f'<text class="tick" x="{at + 4:.1f}" y="{TOP + 10}">{escape(label)}</text>'
        )
    frame.parts.append(
        f'<text class="unit" x="4" y="14">count</text><text class="unit" x="{WIDTH - RIGHT}" '
        f'y="{frame.height - 8}" text-anchor="end">{escape(unit)}</text>'
    )
    return frame.svg(title)
