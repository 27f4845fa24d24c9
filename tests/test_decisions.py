"""The decisions have one form, and their chapters are listed."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = (Path(__file__).parents[1] / "docs" / "decisions.md").read_text(encoding="utf-8")
PARTS = ["Decision", "Reason", "Consequence"]


def test_every_entry_has_decision_reason_and_consequence() -> None:
    entries = re.split(r"(?m)^### ", PAGE)[1:]
    assert len(entries) > 200
    wrong = [
        entry.split("\n", 1)[0]
        for entry in entries
        if re.findall(r"(?m)^\*\*(\w+)\.\*\* ", entry) != PARTS
    ]
    assert not wrong, "\n".join(wrong)


def test_chapters_are_listed_in_their_order() -> None:
    listed = PAGE.partition("Chapters: ")[2].partition("\n\n")[0]
    assert re.findall(r"\[([^]]+)\]", listed) == re.findall(r"(?m)^## (.+)$", PAGE)


def test_headings_stand_between_blank_lines() -> None:
    assert not re.findall(r"(?m)[^\n]\n(#+ .+)$|^(#+ .+)\n[^\n]", PAGE)
