"""The templates of the reports, in ``templates``. No page loads anything or runs a script."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from dexkit.templates import Templates

__all__ = ["fill"]

_HERE = Path(__file__).parent
fill = Templates(
    _HERE / "templates",
    style=Markup(_HERE.joinpath("report.css").read_text(encoding="utf-8")),
).fill
