"""Draw plots for the report page: curves as SVG, text as HTML beside them.

The curves stretch with the page (``preserveAspectRatio="none"``) while labels keep their size, so
one plot is readable on a phone, on a desk and on paper without a script. Colours come from the
page's CSS. Points are whole numbers on a grid of :data:`GRID`, written relative to each other:
a plot is a few kilobytes for any length of recording.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dexkit.escaping import html as escape
from dexkit.hand import Floats

__all__ = [
    "Band",
    "Level",
    "Line",
    "Range",
    "chart",
    "histogram",
    "nice_ticks",
    "pieces",
    "thin",
]

GRID = (2000, 500)
"""Units across and down; finer than a page's pixels."""
MAX_POINTS = 900
"""Points of a plot, all its curves together."""
MAX_GAPS = 100
"""Gaps of a curve that are shown as such."""
_DESK, _PHONE = 680, 290
"""Pixels across a plot for which labels are placed: paper or desk, and phone."""
_LETTER = 6.6
"""Pixels of a letter of a label."""


@dataclass(frozen=True, eq=False)
class Line:
    """One curve.

    :param css: class that colours it.
    :param draw: ``line``; ``dots``, each sample by itself; ``stems``, each as a line from 0.
    """

    label: str
    css: str
    x: Floats
    y: Floats
    draw: str = "line"


@dataclass(frozen=True)
class Band:
    """A stretch along the horizontal axis with a name."""

    label: str
    begin: float
    end: float
    css: str = "band"


@dataclass(frozen=True)
class Level:
    """A limit: a line across the plot."""

    value: float
    label: str


@dataclass(frozen=True)
class Range:
    """A tolerance: a strip across the plot."""

    low: float
    high: float
    label: str


def thin(x: Floats, y: Floats, points: int = MAX_POINTS) -> tuple[Floats, Floats]:
    """Reduce the number of points: each bin keeps its smallest and largest value, in order."""
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
    """Split the curve where samples are missing, so that no line crosses a gap.

    Only the :data:`MAX_GAPS` widest gaps are used.
    """
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) < 3:
        return [(x, y)] if len(x) else []
    steps = np.diff(x)
    cuts = np.flatnonzero(steps > max(0.05, 8 * float(np.median(steps)))) + 1
    if len(cuts) > MAX_GAPS:
        cuts = np.sort(cuts[np.argsort(-steps[cuts - 1], kind="stable")[:MAX_GAPS]])
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


@dataclass(frozen=True)
class _Axes:
    """Convert values to positions: per cent for labels, units of :data:`GRID` for curves."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def across(self, value: float) -> float:
        low, high = self.x_range
        return 100 * (value - low) / (high - low or 1.0)

    def up(self, value: float) -> float:
        low, high = self.y_range
        return 100 * (value - low) / (high - low or 1.0)

    def x(self, value: float) -> int:
        return round(self.across(value) / 100 * GRID[0])

    def y(self, value: float) -> int:
        return round((1 - self.up(value) / 100) * GRID[1])

    def path(self, x: Floats, y: Floats, draw: str) -> str:
        """The ``d`` of a path, in relative whole numbers."""
        places = [(self.x(float(a)), self.y(float(b))) for a, b in zip(x, y, strict=True)]
        if draw == "stems":
            return "".join(f"M{a},{self.y(0.0)}V{b}" for a, b in dict.fromkeys(places))
        if draw == "dots":
            # a line of no length with round ends: it stays round when the plot is stretched
            return "".join(f"M{a},{b}h0" for a, b in dict.fromkeys(places))
        out = [f"M{places[0][0]},{places[0][1]}l"]
        steps = [(c - a, d - b) for (a, b), (c, d) in pairwise(places)] or [(0, 0)]
        out.append(" ".join(f"{dx},{dy}" for dx, dy in steps if dx or dy) or "0,0")
        return "".join(out)

    def rect(self, css: str, a: float, b: float, low: float, high: float, title: str = "") -> str:
        x0, x1, y0, y1 = self.x(a), self.x(b), self.y(high), self.y(low)
        text = f"<title>{escape(title)}</title>" if title else ""
        return (
            f'<rect class="{css}" x="{x0}" y="{y0}" width="{max(x1 - x0, 3)}" '
            f'height="{max(y1 - y0, 3)}">{text}</rect>'
        )

    def grid(self, levels: Sequence[float]) -> str:
        marks = "".join(f"M0,{self.y(v)}h{GRID[0]}" for v in levels)
        return f'<path class="grid" d="{marks}"/>'


def _label(css: str, where: str, text: str) -> str:
    return f'<span class="{css}" style="{where}">{escape(text)}</span>'


def _x_ticks(axes: _Axes, ticks: Sequence[float], unit: str, desk: int = _DESK) -> list[str]:
    """Labels below; every other one, and what the unit covers on phones, is for wide pages only."""

    def is_free(at: float, text: str, width: float) -> bool:
        """Whether the unit, at the right end, leaves room for a label."""
        return at / 100 * width + _LETTER * (0.5 * len(text) + len(unit) + 1) <= width

    found = []
    for i, tick in enumerate(ticks):
        at = axes.across(tick)
        text = f"{tick:g}"
        if len(ticks) > 1 and (at > 93 or not is_free(at, text, desk)):
            continue
        wide = i % 2 or not is_free(at, text, _PHONE)
        found.append(_label("x wide" if wide else "x", f"left:{at:.2f}%", text))
    found.append(_label("x unit", "left:100%", unit))
    return found


def _y_ticks(axes: _Axes, ticks: Sequence[tuple[float, str]], unit: str) -> list[str]:
    found = [_label("y", f"bottom:{axes.up(v):.2f}%", text) for v, text in ticks]
    return [*found, _label("y unit", "bottom:100%", unit)]


def _band_labels(bands: Sequence[Band], axes: _Axes) -> list[str]:
    """Names above the bands, where they fit on wide pages and on phones."""

    def placed(width: float) -> dict[int, float]:
        chosen: dict[int, float] = {}
        free_from = 0.0
        for i, band in order:
            a, b = (axes.across(v) / 100 * width for v in (band.begin, band.end))
            label_width = _LETTER * len(band.label)
            at = max(a, free_from)
            if band.label and at <= max(b, a + 12) and at + label_width <= width:
                chosen[i] = 100 * at / width
                free_from = at + label_width + 5
        return chosen

    order = sorted(enumerate(bands), key=lambda item: (item[1].css == "band", item[1].begin))
    order = sorted(order, key=lambda item: item[1].begin)
    desk, phone = placed(_DESK), placed(_PHONE)
    return [
        _label("b" if i in phone else "b wide", f"left:{at:.2f}%", bands[i].label)
        for i, at in desk.items()
    ]


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    parts = [
        f'<span><i class="{css}"></i>{escape(label)}</span>'
        for label, css in dict.fromkeys(entries)
        if label
    ]
    return f"<figcaption>{''.join(parts)}</figcaption>" if parts else ""


def _figure(
    title: str, height: int, svg: str, labels: Sequence[str], legend: str, *, titled: bool
) -> str:
    text = escape(title)
    head = f'<div class="t" aria-hidden="true">{text}</div>' if titled else ""
    named = any(label.startswith('<span class="b') for label in labels)
    return (
        f'<figure class="plot">{head}<div class="chart{" named" if named else ""}" role="img" '
        f'aria-label="{text}" style="height:{height + 15 * named}px"><div class="area">'
        f'<svg viewBox="0 0 {GRID[0]} {GRID[1]}" preserveAspectRatio="none" '
        f'focusable="false"><title>{text}</title>{svg}</svg>'
        f"{''.join(labels)}</div></div>{legend}</figure>"
    )


def chart(
    title: str,
    lines: Sequence[Line],
    *,
    y_unit: str,
    span: tuple[float, float],
    x_unit: str = "s",
    bands: Sequence[Band] = (),
    levels: Sequence[Level] = (),
    ranges: Sequence[Range] = (),
    height: int = 210,
    width: int = _DESK,
    include: Sequence[float] = (),
    legend: bool = True,
    titled: bool = True,
) -> str:
    """Curves over time, or over ``x_unit``.

    :param title: its subject; screen readers read it.
    :param titled: whether the title is shown above it as well.
    :param span: of the horizontal axis.
    :param width: pixels across it on a wide page, for which labels are placed.
    :param include: values that the vertical axis must reach.
    """
    curves: list[tuple[Line, Floats, Floats]] = []
    values = [*include, *(v.value for v in levels)]
    values += [v for r in ranges for v in (r.low, r.high) if math.isfinite(v)]
    inside = [(line.x >= span[0]) & (line.x <= span[1]) for line in lines]
    total = max(sum(int(i.sum()) for i in inside), 1)
    for line, there in zip(lines, inside, strict=True):
        parts = [(line.x[there], line.y[there])] if line.draw != "line" else []
        for piece in parts or pieces(line.x[there], line.y[there]):
            share = len(piece[0]) / total
            x, y = thin(*piece, points=max(16, round(MAX_POINTS * share)))
            if len(x):
                curves.append((line, x, y))
                values += [float(y.min()), float(y.max())]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    pad = 0.06 * (high - low) or 0.5
    axes = _Axes(span, (low - pad, high + pad))
    shown = [
        Band(b.label, max(b.begin, span[0]), min(b.end, span[1]), b.css)
        for b in bands
        if min(b.end, span[1]) >= max(b.begin, span[0])
    ]
    svg = [
        axes.rect(b.css, b.begin, b.end, *axes.y_range, f"{b.label} {b.begin:.2f}-{b.end:.2f}")
        for b in shown
    ]
    for r in ranges:
        svg.append(
            axes.rect(
                "range", *span, max(r.low, axes.y_range[0]), min(r.high, axes.y_range[1]), r.label
            )
        )
    ticks = nice_ticks(*axes.y_range, max(3, height // 40))
    svg.append(axes.grid(ticks))
    for v in levels:
        svg.append(f'<path class="limit" d="M0,{axes.y(v.value)}h{GRID[0]}"/>')
    for line, x, y in curves:
        svg.append(f'<path class="{line.css} {line.draw}" d="{axes.path(x, y, line.draw)}"/>')
    labels = [
        *_band_labels(shown, axes),
        *_y_ticks(axes, [(t, f"{t:g}") for t in ticks], y_unit),
        *_x_ticks(axes, nice_ticks(*span, 8), x_unit, width),
    ]
    keys = [(line.label, line.css) for line in lines] if legend else []
    if any(b.css == "busy" for b in shown):
        keys.append(("the testing machine is short of processor time", "busy"))
    keys += [(r.label, "range") for r in ranges] + [(v.label, "limit") for v in levels]
    return _figure(title, height, "".join(svg), labels, _legend(keys), titled=titled)


def histogram(
    title: str,
    values: Floats,
    *,
    unit: str,
    levels: Sequence[Level] = (),
    height: int = 170,
    titled: bool = True,
) -> str:
    """Histogram of the values, with a logarithmic count axis that shows rare values."""
    top = max([float(np.percentile(values, 99.9)), *(v.value for v in levels)]) * 1.15 or 1.0
    counts, edges = np.histogram(np.minimum(values, top), bins=80, range=(0.0, top))
    high = math.log10(max(int(counts.max()), 10)) * 1.05
    axes = _Axes((0.0, top), (0.0, high))
    powers = [p for p in range(math.ceil(high) + 1) if p <= high]
    svg = [axes.grid(powers)]
    for count, a, b in zip(counts, edges[:-1], edges[1:], strict=True):
        if count:
            up = max(math.log10(int(count)), 0.04)
            gap = 0.1 * (b - a)
            text = f"{count} of {a:.2g} to {b:.2g} {unit}"
            svg.append(axes.rect("count", float(a + gap), float(b - gap), 0.0, up, text))
    for v in levels:
        svg.append(f'<path class="limit" d="M{axes.x(v.value)},0v{GRID[1]}"/>')
    labels = [
        *_y_ticks(axes, [(p, f"{10**p:g}") for p in powers], "count"),
        *_x_ticks(axes, nice_ticks(0.0, top, 8), unit),
    ]
    legend = _legend([(v.label, "limit") for v in levels])
    return _figure(title, height, "".join(svg), labels, legend, titled=titled)
