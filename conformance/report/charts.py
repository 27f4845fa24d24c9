"""Charts of pages. What a chart shows is data; ``templates/chart.html`` draws it.

The curves stretch with the page (``preserveAspectRatio="none"``) while labels keep their size, so
one plot is readable on a phone, on a desk and on paper without a script. Colours come from the
page's CSS. Points are whole numbers on a grid of :data:`GRID`, written relative to each other:
a plot is a few kilobytes for any length of recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from dexkit.conformance.report.pages import fill
from dexkit.hand import Floats

__all__ = ["Band", "Chart", "Level", "Line", "Range", "histogram", "nice_ticks", "pieces", "thin"]

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
    :param draw: ``line``; ``dots``, each sample by itself; ``stems``, each as a line from 0;
        ``bars``, each as wide as from one sample to the next.
    """

    label: str
    css: str
    x: Floats
    y: Floats
    draw: str = "line"

    def within(self, span: tuple[float, float]) -> Line:
        """The samples of a stretch of the horizontal axis."""
        inside = (self.x >= span[0]) & (self.x <= span[1])
        return Line(self.label, self.css, self.x[inside], self.y[inside], self.draw)


@dataclass(frozen=True)
class Band:
    """A stretch along the horizontal axis with a name."""

    label: str
    begin: float
    end: float
    css: str = "band"

    @property
    def title(self) -> str:
        """What is shown where the pointer is on it."""
        return f"{self.label} {self.begin:.2f}-{self.end:.2f}" if self.label else ""


@dataclass(frozen=True)
class Level:
    """A limit: a line across the plot, or an upright one."""

    value: float
    label: str
    upright: bool = False


@dataclass(frozen=True)
class Range:
    """A tolerance: a strip across the plot."""

    low: float
    high: float
    label: str


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over time, or over ``x_unit``. A template shows it as HTML.

    :param title: its subject; screen readers read it.
    :param span: of the horizontal axis.
    :param include: values that the vertical axis must reach.
    :param powers: whether the vertical axis is of powers of ten, from 1.
    :param width: pixels across it on a wide page, for which labels are placed.
    :param bare: show neither the title nor the names of the curves, which the page gives.
    """

    title: str
    lines: Sequence[Line]
    span: tuple[float, float]
    y_unit: str = ""
    x_unit: str = "s"
    bands: Sequence[Band] = ()
    levels: Sequence[Level] = ()
    ranges: Sequence[Range] = ()
    include: Sequence[float] = ()
    powers: bool = False
    height: int = 210
    width: int = _DESK
    bare: bool = False

    def __html__(self) -> str:
        inside = [line.within(self.span) for line in self.lines]
        total = max(sum(len(line.x) for line in inside), 1)
        curves = [piece for line in inside for piece in _drawn(line, total)]
        axes = _Axes(self.span, self._reach(curves))
        bands = [
            Band(b.label, max(b.begin, self.span[0]), min(b.end, self.span[1]), b.css)
            for b in self.bands
            if min(b.end, self.span[1]) >= max(b.begin, self.span[0])
        ]
        ticks = self._y_ticks(axes)
        rects = [axes.rect(b.css, b.begin, b.end, *axes.y_range, b.title) for b in bands]
        rects += [axes.rect("range", *self.span, r.low, r.high, r.label) for r in self.ranges]
        paths = [("grid", "".join(f"M0,{axes.y(v)}h{GRID[0]}" for v, _ in ticks))]
        paths += [(f"{line.css} {line.draw}", axes.path(line)) for line in curves]
        paths += [("limit", axes.level(v)) for v in self.levels]
        names = _band_labels(bands, axes)
        return fill(
            "chart.html",
            chart=self,
            grid=GRID,
            height=self.height + 15 * bool(names),
            rects=rects,
            paths=[(css, Markup(d)) for css, d in paths],
            names=names,
            labels=[
                *(("y", f"bottom:{axes.up(v):.2f}%", text) for v, text in ticks),
                ("y unit", "bottom:100%", self.y_unit),
                *_x_ticks(axes, nice_ticks(*self.span, 8), self.x_unit, self.width),
            ],
            keys=self._keys(bands),
        )

    def _reach(self, curves: Sequence[Line]) -> tuple[float, float]:
        """The ends of the vertical axis."""
        values = [*self.include, *(v.value for v in self.levels if not v.upright)]
        values += [v for r in self.ranges for v in (r.low, r.high)]
        values += [float(v) for line in curves for v in (line.y.min(), line.y.max())]
        low, high = (min(values), max(values)) if values else (0.0, 1.0)
        if self.powers:
            return 0.0, 1.05 * high
        pad = 0.06 * (high - low) or 0.5
        return low - pad, high + pad

    def _y_ticks(self, axes: _Axes) -> list[tuple[float, str]]:
        low, high = axes.y_range
        if self.powers:
            return [(p, f"{10**p:g}") for p in range(math.floor(high) + 1)]
        return [(v, f"{v:g}") for v in nice_ticks(low, high, max(3, self.height // 40))]

    def _keys(self, bands: Sequence[Band]) -> list[tuple[str, str]]:
        """(name, class) of what the legend explains."""
        keys = [] if self.bare else [(line.label, line.css) for line in self.lines]
        if any(b.css == "busy" for b in bands):
            keys.append(("the testing machine is short of processor time", "busy"))
        keys += [(r.label, "range") for r in self.ranges]
        keys += [(v.label, "limit") for v in self.levels]
        return [key for key in dict.fromkeys(keys) if key[0]]


def histogram(
    title: str, values: Floats, unit: str, levels: Sequence[Level] = (), *, bare: bool = False
) -> Chart:
    """How often which value occurs; the axis of powers shows rare ones."""
    top = max([float(np.percentile(values, 99.9)), *(v.value for v in levels)]) * 1.15 or 1.0
    counts, edges = np.histogram(np.minimum(values, top), bins=80, range=(0.0, top))
    # a bar for a single one is seen, too
    high = np.where(counts > 0, np.maximum(np.log10(np.maximum(counts, 1)), 0.04), 0.0)
    return Chart(
        title,
        [Line("", "count", edges[:-1], high, "bars")],
        span=(0.0, top),
        y_unit="count",
        x_unit=unit,
        levels=[Level(v.value, v.label, upright=True) for v in levels],
        include=(1.0,),
        powers=True,
        height=170,
        bare=bare,
    )


def _drawn(line: Line, total: int) -> Iterator[Line]:
    """What is drawn of a curve: without its gaps, and without more points than can be seen.

    :param total: points of all curves of the chart.
    """
    if line.draw == "bars":
        yield line
        return
    for x, y in pieces(line.x, line.y) if line.draw == "line" else [(line.x, line.y)]:
        x, y = thin(x, y, max(16, round(MAX_POINTS * len(x) / total)))
        if len(x):
            yield Line(line.label, line.css, x, y, line.draw)


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
class _Rect:
    css: str
    x: int
    y: int
    width: int
    height: int
    title: str


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

    def level(self, level: Level) -> str:
        """The ``d`` of a limit."""
        if level.upright:
            return f"M{self.x(level.value)},0v{GRID[1]}"
        return f"M0,{self.y(level.value)}h{GRID[0]}"

    def path(self, line: Line) -> str:
        """The ``d`` of a path, in whole numbers."""
        places = [(self.x(float(a)), self.y(float(b))) for a, b in zip(line.x, line.y, strict=True)]
        if line.draw == "bars":
            wide = round((places[1][0] - places[0][0]) * 0.8)
            zero = self.y(0.0)
            return "".join(f"M{a},{zero}V{b}h{wide}V{zero}" for a, b in places if b != zero)
        if line.draw == "stems":
            return "".join(f"M{a},{self.y(0.0)}V{b}" for a, b in dict.fromkeys(places))
        if line.draw == "dots":
            # a line of no length with round ends: it stays round when the plot is stretched
            return "".join(f"M{a},{b}h0" for a, b in dict.fromkeys(places))
        steps = [(c - a, d - b) for (a, b), (c, d) in pairwise(places)]
        moved = " ".join(f"{dx},{dy}" for dx, dy in steps if dx or dy)
        return f"M{places[0][0]},{places[0][1]}l{moved or '0,0'}"

    def rect(self, css: str, a: float, b: float, low: float, high: float, title: str) -> _Rect:
        x, y = self.x(a), self.y(high)
        return _Rect(css, x, y, max(self.x(b) - x, 3), max(self.y(low) - y, 3), title)


def _x_ticks(
    axes: _Axes, ticks: Sequence[float], unit: str, desk: int
) -> Iterator[tuple[str, str, str]]:
    """Labels below; every other one, and what the unit covers on phones, is for wide pages only."""

    def is_free(at: float, text: str, width: float) -> bool:
        """Whether the unit, at the right end, leaves room for a label."""
        return at / 100 * width + _LETTER * (0.5 * len(text) + len(unit) + 1) <= width

    for i, tick in enumerate(ticks):
        at, text = axes.across(tick), f"{tick:g}"
        if len(ticks) > 1 and (at > 93 or not is_free(at, text, desk)):
            continue
        wide = i % 2 or not is_free(at, text, _PHONE)
        yield "x wide" if wide else "x", f"left:{at:.2f}%", text
    yield "x unit", "left:100%", unit


def _band_labels(bands: Sequence[Band], axes: _Axes) -> list[tuple[str, str, str]]:
    """Names above the bands, where they fit on wide pages, and of those what fits on phones."""
    found = []
    free_desk = free_phone = 0.0  # pixels from which there is room
    for band in sorted(bands, key=lambda b: (b.begin, b.css == "band")):
        a, b = (axes.across(v) / 100 * _DESK for v in (band.begin, band.end))
        at, width = max(a, free_desk), _LETTER * len(band.label)
        if not band.label or at > max(b, a + 12) or at + width > _DESK:
            continue
        free_desk = at + width + 5
        on_phone = at / _DESK * _PHONE
        css = "b wide"
        if free_phone <= on_phone <= _PHONE - width:
            css, free_phone = "b", on_phone + width + 5
        found.append((css, f"left:{100 * at / _DESK:.2f}%", band.label))
    return found
