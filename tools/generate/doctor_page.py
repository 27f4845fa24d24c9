"""The table of docs/doctor.md: every diagnosis of the doctor with symptom and remedy."""

from __future__ import annotations

import re
from pathlib import Path

from dexkit.doctor.catalogue import DIAGNOSES
from tools.generate import DOCS

__all__ = ["files", "table"]

_HEAD = "| You see | Diagnosis | What to do |\n"
_TABLE = re.compile(re.escape(_HEAD) + r"(\|.*\n)*")


def table() -> str:
    """The diagnoses as a Markdown table: symptom, diagnosis, remedy."""
    rows = ["| --- | --- | --- |"]
    rows += [
        f"| {_cell(d.symptom)} | `{d.id}` ({d.severity}): {d.title}; {d.why} | {_cell(d.fix)} |"
        for d in DIAGNOSES.values()
    ]
    return _HEAD + "\n".join(rows) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def files() -> dict[Path, str]:
    """The page with the table generated."""
    page = DOCS / "doctor.md"
    return {page: _TABLE.sub(lambda _: table(), page.read_text(encoding="utf-8"))}
