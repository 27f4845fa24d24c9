"""A joint between its limits, in one line of text."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["ASCII", "UNICODE", "Signs", "bar"]


@dataclass(frozen=True)
class Signs:
    """Characters of a bar; each has its own shape, so that it reads without colours.

    :param ends: of the stroke; ``line`` between them, ``zero`` at q = 0.
    :param ghost: the command; ``both`` where it is at the measured position.
    """

    ends: tuple[str, str]
    line: str
    zero: str
    measured: str
    ghost: str
    both: str


UNICODE = Signs(("├", "┤"), "─", "┼", "●", "○", "◉")
ASCII = Signs(("[", "]"), "-", "+", "#", "o", "@")


def bar(
    signs: Signs, width: int, low: float, high: float, q: float, target: float
) -> list[tuple[str, str]]:
    """Pieces of (text, what it is): ``line``, ``measured``, ``ghost``; together ``width`` long.

    A position beyond a limit is drawn over that end. NaN is not drawn.

    :param width: at least 3.
    """
    inner = width - 2
    cells = [(signs.line, "line")] * inner
    if low < 0 < high:
        cells[_cell(0.0, low, high, inner)] = (signs.zero, "line")
    line = [(signs.ends[0], "line"), *cells, (signs.ends[1], "line")]
    ghost = _place(target, low, high, width)
    measured = _place(q, low, high, width)
    if ghost is not None:
        line[ghost] = (signs.ghost, "ghost")
    if measured is not None:
        line[measured] = (signs.both if measured == ghost else signs.measured, "measured")
    pieces: list[tuple[str, str]] = []
    for text, kind in line:
        if pieces and pieces[-1][1] == kind:
            pieces[-1] = (pieces[-1][0] + text, kind)
        else:
            pieces.append((text, kind))
    return pieces


def _place(q: float, low: float, high: float, width: int) -> int | None:
    if not math.isfinite(q):
        return None
    if q < low:
        return 0
    return width - 1 if q > high else 1 + _cell(q, low, high, width - 2)


def _cell(q: float, low: float, high: float, cells: int) -> int:
    return min(int((q - low) / (high - low) * cells), cells - 1)
