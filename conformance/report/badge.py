"""Render badges: the verdict of each grade in one line, as an SVG without external files."""

from __future__ import annotations

from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Overall, RunResult
from dexkit.conformance.report.labels import (
    catch_sentence,
    count_verdicts,
    device_kind,
    model_title,
)
from dexkit.escaping import html as escape

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


def render_badge(result: RunResult) -> str:
    """Return the badges as one SVG, side by side; its title also says what a run catches."""
    x, titles, drawn = 0, [], []
    for number, grade in enumerate(badges(result)):
        left, right = badge_text(result, grade)
        titles.append(f"{left}: {right}")
        width, content = _badge(left, right, _colour(result, grade), x, number)
        drawn.append(content)
        x += width + _GAP
    title = escape("; ".join([*titles, catch_sentence(result)]))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{x - _GAP}" height="20" role="img" '
        f'aria-label="{title}"><title>{title}</title>{"".join(drawn)}</svg>\n'
    )


def _colour(result: RunResult, kind: Kind) -> str:
    overall = result.grade(kind).overall
    return _PARTIAL if result.partial and overall is Overall.PASS else _COLOURS[overall]


def _badge(left: str, right: str, colour: str, x: int, number: int) -> tuple[int, str]:
    """Width and SVG elements of one badge at ``x``, pixels.

    :param number: makes the id of its clip path unique in the image.
    """
    a, b = _width(left) + 14, _width(right) + 14

    def text(words: str, at: int, width: int) -> str:
        return f'<text x="{at}" y="14" textLength="{width}">{escape(words)}</text>'

    return a + b, (
        f'<clipPath id="r{number}"><rect x="{x}" width="{a + b}" height="20" rx="4"/></clipPath>'
        f'<g clip-path="url(#r{number})"><rect x="{x}" width="{a}" height="20" fill="#3b424c"/>'
        f'<rect x="{x + a}" width="{b}" height="20" fill="{colour}"/></g>'
        '<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">'
        f"{text(left, x + 7, a - 14)}{text(right, x + a + 7, b - 14)}</g>"
    )
