"""Fill the templates of the pages, in ``templates``. No page loads anything or runs a script.

What is put into a template is text: it is escaped, and characters that cannot be seen are shown,
unless it is marked as HTML or, as a chart, makes its own.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from dexkit.escaping import html

__all__ = ["fill"]

_HERE = Path(__file__).parent


def fill(template: str, **values: object) -> str:
    """The page that a template makes of these values."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=True,
        finalize=_shown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["zip"] = zip
    environment.globals["style"] = Markup(_HERE.joinpath("report.css").read_text(encoding="utf-8"))
    return environment


def _shown(value: Any) -> Markup:
    return Markup(value.__html__() if hasattr(value, "__html__") else html(value))
