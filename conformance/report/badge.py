"""Render badges: the verdict of each grade in one line, as an SVG without external files."""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Overall, RunResult
from dexkit.conformance.report.labels import (
    catch_sentence,
    count_verdicts,
    device_kind,
    model_title,
)
from dexkit.conformance.report.pages import fill

__all__ = ["badge_text", "badges", "render_badge"]

_COLOURS = {Overall.PASS: "#14734a", Overall.FAIL: "#b3261e", Overall.INCONCLUSIVE: "#6b3fa0"}
_PARTIAL = "#7a5a00"
_NARROW, _WIDE = "fijlrtI.,:;'|/()1 ", "mwMW%@"
_GAP = 4  # pixels between two badges of one image


def badge_text(result: RunResult, kind: Kind = Kind.DROP_IN) -> tuple[str, str]:
    """The two parts of the badge of one grade: the subject and the verdict.

    Only judged requirements count as passed. The text shows whether the hand was real, and whether
    only a part of the requirements was selected.
    """
    name = model_title(result).removesuffix(" gripper")
    if result.client_only:
        return f"{name} client", str(result.overall)
    grade, found = result.grade(kind), count_verdicts(result, kind)
    if not grade.judged and kind is Kind.SAFETY:
        text = "not judged"
    elif grade.overall is Overall.INCONCLUSIVE:
        text = f"inconclusive, {found.passed} of {found.applicable} pass"
    elif grade.overall is Overall.FAIL:
        text = f"fail, {found.failed} of {found.applicable} not met"
    else:
        text = f"{found.passed}/{found.applicable} pass"
        if result.partial:
            text += f" of {result.catalogue}, partial"
        rest = [
            (found.warned, "warn"),
            (found.not_judged, "not applicable"),
            (found.open, "not judged"),
        ]
        text += "".join(f", {n} {what}" for n, what in rest if n)
    real = device_kind(result)
    return f"{name} {kind}", (f"{text} ({real})" if real else text)


def badges(result: RunResult) -> tuple[Kind, ...]:
    """The grades that an image shows."""
    return (Kind.DROP_IN,) if result.client_only else tuple(Kind)


def _width(text: str) -> int:
    """Approximate width of ``text`` in Verdana 11, pixels; ``textLength`` enforces it."""
    return round(sum(4.2 if c in _NARROW else 9.6 if c in _WIDE else 6.9 for c in text))


@dataclass(frozen=True)
class _Badge:
    """A badge in an image.

    :param x: its left edge, pixels, and ``split`` the width of its left part.
    """

    left: str
    right: str
    colour: str
    x: int
    split: int
    width: int


def render_badge(result: RunResult) -> str:
    """Return the badges as one SVG, side by side; its title also says what a run catches."""
    x, drawn = 0, []
    for grade in badges(result):
        left, right = badge_text(result, grade)
        split = _width(left) + 14
        drawn.append(
            _Badge(left, right, _colour(result, grade), x, split, split + _width(right) + 14)
        )
        x += drawn[-1].width + _GAP
    texts = [f"{badge.left}: {badge.right}" for badge in drawn]
    title = "; ".join([*texts, catch_sentence(result)])
    return fill("badge.svg", badges=drawn, title=title, width=x - _GAP)


def _colour(result: RunResult, kind: Kind) -> str:
    overall = result.grade(kind).overall
    return _PARTIAL if result.partial and overall is Overall.PASS else _COLOURS[overall]
