"""Fill the templates of pages, pictures and summaries, in ``templates``. No page loads anything or
runs a script.

What is put into a template is text. It is escaped, as HTML or XML, or as Markdown where the
template's name ends with ``.md``, and characters that cannot be seen are shown, unless it is marked
as HTML or, as a chart, makes its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from dexkit.escaping import REMARK, html, one_line

__all__ = ["code", "fill", "plain"]

_HERE = Path(__file__).parent
_SPECIAL = re.compile(r"([\\`*_\[\]|~#])")
_NOTHING = "&#8203;"


def fill(template: str, **values: object) -> str:
    """The page that a template makes of these values."""
    environment = _environment(plain if template.endswith(".md") else html)
    return environment.get_template(template).render(values)


@cache
def _environment(escape: Callable[[str], str]) -> Environment:
    def shown(value: Any) -> Markup:
        """What stands in the page for a value."""
        own = hasattr(value, "__html__")
        return Markup(value.__html__() if own else escape(str(value)))

    environment = Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=True,
        finalize=shown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"zip": zip, "code": code}
    environment.globals["style"] = Markup(_HERE.joinpath("report.css").read_text(encoding="utf-8"))
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
