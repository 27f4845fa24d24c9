"""Strip charts of numbers that were on the wire."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
import viser.uplot

from dexkit.hand import Floats
from dexkit.view.curve_points import common_times, thin
from dexkit.watch import Collector

__all__ = ["Chart", "Curve"]

_POINTS = 400
_STROKES = ("#1c7ed6", "#f08c00", "#2f9e44", "#e03131", "#9c36b5", "#0c8599")


@dataclass(frozen=True)
class Curve:
    """One number.

    :param name: for the legend.
    """

    collector: Collector
    topic: str
    path: str
    name: str

    def points(self, begin: float, end: float) -> tuple[Floats, Floats]:
        """Its points in [begin, end], as many as a chart shows."""
        t, values = self.collector.curve(self.topic, self.path, begin, end)
        return thin(t, values, _POINTS)


class Chart:
    """A chart of some curves over the seconds before the moment that is shown."""

    def __init__(self, server: viser.ViserServer, title: str, curves: list[Curve]) -> None:
        self.curves = curves
        self.title = title
        empty = np.zeros(2)
        self._plot = server.gui.add_uplot(
            data=(np.array([-1.0, 0.0]), *(empty for _ in curves)),
            series=(
                viser.uplot.Series(label="s"),
                *(
                    viser.uplot.Series(
                        label=curve.name, stroke=_STROKES[i % len(_STROKES)], width=1.5
                    )
                    for i, curve in enumerate(curves)
                ),
            ),
            title=title,
            scales={"x": viser.uplot.Scale(time=False, auto=True)},
            legend=viser.uplot.Legend(show=True),
            height=150,
        )
        self._last: tuple[float, float, int] | None = None

    def update(self, at: float, window: float) -> None:
        """Show the window that ends at a moment."""
        found = [curve.points(at - window, at) for curve in self.curves]
        now = (at, window, sum(len(t) for t, _ in found))
        if now == self._last:
            return
        self._last = now
        times, values = common_times(found)
        if len(times) < 2:
            times, values = np.array([at - window, at]), [np.zeros(2) for _ in found]
        self._plot.data = (times, *values)

    def remove(self) -> None:
        """Take it off the page."""
        self._plot.remove()
