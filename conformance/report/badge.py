"""Render a badge: the verdict in one line, as an SVG without external files."""

from __future__ import annotations

from dexkit.conformance.report.labels import model_title, nature, tally
from dexkit.conformance.results import Overall, RunResult
from dexkit.escaping import html as escape

__all__ = ["badge_text", "render_badge"]

_COLOURS = {Overall.PASS: "#14734a", Overall.FAIL: "#b3261e", Overall.INCONCLUSIVE: "#6b3fa0"}
_PARTIAL = "#7a5a00"
_NARROW, _WIDE = "fijlrtI.,:;'|/()1 ", "mwMW%@"


def badge_text(result: RunResult) -> tuple[str, str]:
    """The two parts of the badge: the subject and the verdict.

    Only judged requirements count as passed. The text shows whether the hand was real, and whether
    only a part of the requirements was selected.
    """
    found = tally(result)
    name = model_title(result).removesuffix(" gripper")
    if result.client_only:
        return f"{name} client", str(result.overall)
    if result.overall is Overall.INCONCLUSIVE:
        text = f"inconclusive, {found.passed} of {found.applicable} pass"
    elif result.overall is Overall.FAIL:
        text = f"fail, {found.failed} of {found.applicable} not met"
    else:
        text = f"{found.passed}/{found.applicable} pass"
        if result.partial:
            text += f" of {result.catalogue}, partial"
        rest = [
            (found.warned, "warn"),
            (found.not_judged + found.open, "not judged"),
        ]
        text += "".join(f", {n} {what}" for n, what in rest if n)
    real = nature(result)
    return f"{name} drop-in", (f"{text} ({real})" if real else text)


def _width(text: str) -> int:
    """Approximate width of ``text`` in Verdana 11, pixels; ``textLength`` enforces it."""
    return round(sum(4.2 if c in _NARROW else 9.6 if c in _WIDE else 6.9 for c in text))


def render_badge(result: RunResult) -> str:
    """Return the badge as SVG."""
    left, right = badge_text(result)
    a, b = _width(left) + 14, _width(right) + 14
    title = escape(f"{left}: {right}")
    passed_in_part = result.partial and result.overall is Overall.PASS
    colour = _PARTIAL if passed_in_part else _COLOURS[result.overall]

    def text(words: str, at: int, width: int) -> str:
        return f'<text x="{at}" y="14" textLength="{width}">{escape(words)}</text>'

    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{a + b}" height="20" role="img" '
        f'aria-label="{title}"><title>{title}</title>'
        f'<clipPath id="r"><rect width="{a + b}" height="20" rx="4"/></clipPath>'
        f'<g clip-path="url(#r)"><rect width="{a}" height="20" fill="#3b424c"/>'
        f'<rect x="{a}" width="{b}" height="20" fill="{colour}"/></g>'
        '<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">'
        f"{text(left, 7, a - 14)}{text(right, a + 7, b - 14)}</g></svg>\n"
    )
