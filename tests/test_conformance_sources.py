"""Who says so: every citation of the catalogue means something to a reader outside the project."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dexkit.conformance.requirements import catalogue
from dexkit.conformance.requirements.sources import (
    DOCUMENTS,
    SECTIONS,
    Section,
    anchor,
    cited,
    linked,
    told,
)

PAGE = Path(__file__).parents[1] / "docs" / "sources.md"
SOURCES = sorted({r.source for r in catalogue(None, None)})


@pytest.mark.parametrize(
    ("source", "text"),
    [
        (
            "dex1_1_service main.cpp (facts/unitree-dex A.1); xr_teleoperate issue 100",
            "dex1_1_service main.cpp (docs/sources.md A.1); xr_teleoperate issue 100",
        ),
        (
            "facts/unitree-dex B.2 'No clamp on q', D 2",
            "dex1_1_service main.cpp, docs/sources.md B.2 'No clamp on q', D 2",
        ),
        ("seed 002 RIS_Mode_t", "Dex3-1 user manual RIS_Mode_t"),
        ("not in any source", "not in any source"),
    ],
)
def test_a_source_is_told_in_names(source: str, text: str) -> None:
    assert told(source) == text


def test_nothing_internal_is_left() -> None:
    for source in SOURCES:
        assert not re.search(r"facts/|seed \d", told(source)), source
        assert all(code in SECTIONS for code in cited(source)), source


def test_the_page_explains_every_code_and_document() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for code, section in SECTIONS.items():
        assert f'<a id="{anchor(code)}"></a>**{code}**' in page
        assert section.title[1:] in page
    for name in DOCUMENTS.values():
        assert name in page
    anchors = re.findall(r'<a id="(\w+)">', page)
    assert len(set(anchors)) == len(anchors) == len(SECTIONS)


def test_codes_can_be_linked() -> None:
    def link(code: str, section: Section) -> str:
        return f"[{code}](#{anchor(code)})"

    found = linked(told("seed 000 on the G1 (facts/unitree-dex B.7, D 10, G)"), link)
    assert found == (
        "the gripper's DDS interface specification on the G1 (docs/sources.md [B.7](#b7), "
        "[D 10](#d10), [G](#g))"
    )
