"""Fill templates of pages, pictures and summaries with text, some of it from outside.

What is put into a template is escaped, as HTML or XML, or as Markdown where the template's name
ends with ``.md``, and characters that cannot be seen are shown, unless it is marked as HTML or
makes its own (``__html__``).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from dexkit.escaping import REMARK, html, one_line

__all__ = ["Templates", "code", "plain"]

_SPECIAL = re.compile(r"([\\`*_\[\]|~#])")
_NOTHING = "&#8203;"


class Templates:
    """The templates of a folder.

    :param values: what each of them may use.
    """

    def __init__(self, folder: Path, **values: object) -> None:
        self._html = _environment(folder, html, values)
        self._markdown = _environment(folder, plain, values)

    def fill(self, template: str, **values: object) -> str:
        """The page that a template makes of these values."""
        environment = self._markdown if template.endswith(".md") else self._html
        return environment.get_template(template).render(values)


def _environment(
    folder: Path, escape: Callable[[str], str], values: dict[str, object]
) -> Environment:
    def shown(value: Any) -> Markup:
        """What stands in the page for a value."""
        own = hasattr(value, "__html__")
        return Markup(value.__html__() if own else escape(str(value)))

    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        finalize=shown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"zip": zip, "code": code}
    environment.globals |= values
    return environment


def plain(text: str) -> str:
    """Escape ``text`` for Markdown, in one line."""
    text = one_line(" ".join(text.split()), REMARK)
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # a zero-width space prevents mentions by @ and links from addresses
    return _SPECIAL.sub(r"\\\1", text).replace("@", f"@{_NOTHING}").replace("://", f":{_NOTHING}//")


def code(text: str) -> Markup:
    """``text`` as code in Markdown; a grave accent in it would end it."""
    shown = one_line(" ".join(text.split())).replace("`", "'").replace("|", "/")
    return Markup(f"`{shown}`")
