"""A sheet to draw on: shapes in named styles, written as one self-contained SVG.

The styles follow the reader's light or dark mode. The sheet has a background of its own, so that
it can be read on whatever page it lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

__all__ = ["Box", "Point", "Sheet"]

Point = tuple[float, float]

# style -> (property, light, dark); text styles carry their size
_COLOURS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "sheet": (("fill", "#f6f8fa", "#161b22"), ("stroke", "#d0d7de", "#30363d")),
    "solid": (("fill", "#dfe5ec", "#2d3744"), ("stroke", "#9aa7b6", "#5b6a7d")),
    "flesh": (("fill", "#dfe5ec", "#2d3744"),),
    "bone": (("stroke", "#dfe5ec", "#2d3744"),),
    "edge": (("stroke", "#9aa7b6", "#5b6a7d"),),
    "ghost": (("stroke", "#9aa7b6", "#5b6a7d"),),
    "leader": (("stroke", "#b4bfcb", "#4a5768"),),
    "arrow": (("stroke", "#57606a", "#8b949e"),),
    "head": (("fill", "#57606a", "#8b949e"),),
    "ink": (("fill", "#1f2328", "#e6edf3"),),
    "muted": (("fill", "#57606a", "#9da7b3"),),
    "plus": (("fill", "#0b62c4", "#58a6ff"),),
    "minus": (("fill", "#b35900", "#f0a04b"),),
    "none": (("fill", "#6e7781", "#8b949e"),),
    "number": (("fill", "#ffffff", "#0d1117"),),
    "taxel": (("fill", "#1a7f37", "#3fb950"),),
    "badge": (("fill", "#f6f8fa", "#161b22"), ("stroke", "#1a7f37", "#3fb950")),
    "sensor": (("fill", "#1a7f37", "#56d364"),),
}
_STROKES = {
    "sheet": 1.0,
    "solid": 1.5,
    "ghost": 1.5,
    "leader": 1.0,
    "arrow": 2.0,
    "badge": 1.2,
}
_FONT = "system-ui, -apple-system, 'Segoe UI', Helvetica, Arial, sans-serif"
_WIDE = 0.56  # of the size, an average letter of a sans-serif font; bold ones are wider
_BOLD = 0.61


@dataclass(frozen=True)
class Box:
    """Where a text is, as far as can be told without its font.

    :param left, top, right, bottom: px; y grows downward.
    """

    text: str
    left: float
    top: float
    right: float
    bottom: float

    def overlaps(self, other: Box) -> bool:
        """Whether the two share any area."""
        return (
            self.left < other.right
            and other.left < self.right
            and self.top < other.bottom
            and other.top < self.bottom
        )


class Sheet:
    """Shapes in order of drawing. Lengths in px, y downward.

    :param title: what the picture shows, also for those who do not see it.
    :param description: the same at more length.
    """

    def __init__(self, width: int, height: int, title: str, description: str) -> None:
        self.width, self.height = width, height
        self._head = (title, description)
        self._items: list[str] = []
        self._used = {"sheet"}
        #: every text written, to see whether any lie on each other
        self.texts: list[Box] = []

    def _add(self, style: str, item: str) -> None:
        self._used.add(style)
        self._items.append(item)

    def circle(self, at: Point, radius: float, style: str) -> None:
        """A disc."""
        x, y = at
        self._add(style, f'<circle class="{style}" cx="{x:g}" cy="{y:g}" r="{radius:g}"/>')

    def rect(self, at: Point, size: Point, style: str, *, radius: float = 0.0) -> None:
        """A rectangle around the point ``at``, with round corners."""
        (x, y), (w, h) = at, size
        self._add(
            style,
            f'<rect class="{style}" x="{x - w / 2:g}" y="{y - h / 2:g}" width="{w:g}" '
            f'height="{h:g}" rx="{radius:g}"/>',
        )

    def polygon(self, points: Sequence[Point], style: str) -> None:
        """A filled shape."""
        text = " ".join(f"{x:.4g},{y:.4g}" for x, y in points)
        self._add(style, f'<polygon class="{style}" points="{text}"/>')

    def line(self, points: Sequence[Point], style: str) -> None:
        """A line through the points."""
        text = " ".join(f"{x:.4g},{y:.4g}" for x, y in points)
        self._add(style, f'<polyline class="{style}" points="{text}"/>')

    def limb(self, points: Sequence[Point], width: float, style: str) -> None:
        """A thick line with round ends, in style ``bone``, or ``edge`` to lie under one."""
        text = " ".join(f"{x:.4g},{y:.4g}" for x, y in points)
        self._add(style, f'<polyline class="{style}" stroke-width="{width:g}" points="{text}"/>')

    def arrow(self, start: Point, bend: Point, end: Point) -> None:
        """A curved arrow that leaves ``start`` toward ``bend``."""
        dx, dy = end[0] - bend[0], end[1] - bend[1]
        length = max((dx * dx + dy * dy) ** 0.5, 1e-9)
        ux, uy = dx / length, dy / length
        neck = (end[0] - 7 * ux, end[1] - 7 * uy)
        at = [f"{x:.4g} {y:.4g}" for x, y in (start, bend, neck)]
        self._add("arrow", f'<path class="arrow" d="M{at[0]}Q{at[1]} {at[2]}"/>')
        left = (end[0] - 9 * ux + 4.5 * uy, end[1] - 9 * uy - 4.5 * ux)
        right = (end[0] - 9 * ux - 4.5 * uy, end[1] - 9 * uy + 4.5 * ux)
        self.polygon((end, left, right), "head")

    def text(
        self,
        at: Point,
        text: str,
        style: str = "ink",
        *,
        size: float = 12.0,
        bold: bool = False,
        anchor: str = "start",
    ) -> None:
        """A line of text with its baseline at ``at``.

        :param anchor: ``start``, ``middle`` or ``end``: which part of the text is at x.
        """
        x, y = at
        width = len(text) * size * (_BOLD if bold else _WIDE)
        left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
        self.texts.append(Box(text, left, y - 0.75 * size, left + width, y + 0.2 * size))
        weight = ' font-weight="600"' if bold else ""
        self._add(
            style,
            f'<text class="{style}" x="{x:g}" y="{y:g}" font-size="{size:g}"{weight} '
            f'text-anchor="{anchor}">{escape(text)}</text>',
        )

    def svg(self) -> str:
        """The whole file."""
        title, description = (escape(text) for text in self._head)
        frame = (
            f'<rect class="sheet" x="0.5" y="0.5" width="{self.width - 1}" '
            f'height="{self.height - 1}" rx="10"/>'
        )
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
                f'width="{self.width}" height="{self.height}" role="img" font-family="{_FONT}">',
                f"<title>{title}</title>",
                f"<desc>{description}</desc>",
                f"<style>\n{self._rules()}\n</style>",
                frame,
                *self._items,
                "</svg>\n",
            ]
        )

    def _rules(self) -> str:
        rules = []
        for style in sorted(self._used):
            fixed = ""
            if style in _STROKES:
                fixed += f"stroke-width: {_STROKES[style]:g}; "
            if not any(name == "fill" for name, _, _ in _COLOURS[style]):
                fixed += "fill: none; stroke-linecap: round; stroke-linejoin: round; "
            if style == "ghost":
                fixed += "stroke-dasharray: 5 4; "
            rules.append(f".{style} {{ {fixed}{self._paint(style, 1)} }}")
        dark = "\n".join(
            f"  .{style} {{ {self._paint(style, 2)} }}" for style in sorted(self._used)
        )
        return "\n".join([*rules, f"@media (prefers-color-scheme: dark) {{\n{dark}\n}}"])

    def _paint(self, style: str, mode: int) -> str:
        return " ".join(f"{entry[0]}: {entry[mode]};" for entry in _COLOURS[style])
