"""Print tables and coloured text on a terminal, with control characters escaped."""

from __future__ import annotations

from collections.abc import Iterable
from typing import IO, Any

import rich.console
import rich.markup
from rich.segment import Segment

from dexkit.errors import OutputError
from dexkit.escaping import REMARK, Guard, one_line, visible

__all__ = ["Console", "markup"]


def markup(text: object, longest: int = REMARK) -> str:
    """A name or a remark as markup of rich that shows just that, in one line."""
    return rich.markup.escape(one_line(text, longest))


class Console(rich.console.Console):
    """A console of rich whose texts are shown clean; its own colours and cursor pass."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"highlight": False, "emoji": False, **settings})

    @property
    def file(self) -> IO[str]:
        """The stream: behind the guard, for colours are no text from outside."""
        found = rich.console.Console.file.fget(self)  # type: ignore[attr-defined]
        return found.trusted if isinstance(found, Guard) else found  # type: ignore[return-value]

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        self._file = new_file

    def render(
        self,
        renderable: rich.console.RenderableType,
        options: rich.console.ConsoleOptions | None = None,
    ) -> Iterable[Segment]:
        """Render it, texts cleaned."""
        for segment in super().render(renderable, options):
            text = segment.text
            if segment.control or text.isprintable():
                yield segment
            else:
                yield Segment(visible(text), segment.style)

    def on_broken_pipe(self) -> None:
        """Report a broken pipe as any other stream does."""
        raise OutputError("cannot write standard output: Broken pipe")
