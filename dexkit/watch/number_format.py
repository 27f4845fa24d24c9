"""Numbers of a picture as text."""

from __future__ import annotations

import math

from dexkit.hand import ROBOT
from dexkit.watch.collector import SubjectView

__all__ = ["number", "seconds", "subject_name"]


def seconds(value: float) -> str:
    """A time for people: ``3 ms``, ``1.2 s``, ``-``."""
    if not math.isfinite(value):
        return "-"
    if value < 0.0995:
        return f"{value * 1e3:.0f} ms"
    return f"{value:.1f} s" if value < 100 else f"{value:.0f} s"


def number(value: float, digits: int = 2) -> str:
    """A number for people; ``-`` where it is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def subject_name(view: SubjectView) -> str:
    """A hand or robot for people: ``left Dex3-1 hand``; ``r2 left ...`` under a prefix."""
    if view.subject == ROBOT:
        return view.model.title
    return f"{view.prefix} {view.subject} {view.model.title}".lstrip()
