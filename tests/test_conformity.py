"""Every statement of the user's documents has a row, and every row leads somewhere."""

from __future__ import annotations

import re

from tests.test_citations import ROOT, unresolved
from tools.generate import conformity_page
from tools.generate.conformity_page import STATUSES, TABLE, read, reference_error

ROWS = [
    (document.id, section.title, row)
    for document in read()
    for section in document.sections
    for row in section.rows
]


def test_rows_have_a_status_a_text_and_a_reference() -> None:
    wrong = []
    for document, section, row in ROWS:
        place = f"{document}, {section}: {row.says}"
        if row.status not in STATUSES or not row.says:
            wrong.append(f"{place}: unknown status {row.status!r}")
        if row.status != "fact" and not row.where:
            wrong.append(f"{place}: no reference")
        if row.status == "otherwise" and not row.does:
            wrong.append(f"{place}: what is done instead, and why?")
        if row.status == "open" and not row.does and "enhancement" not in section.lower():
            wrong.append(f"{place}: what is open?")
    assert not wrong, "\n".join(wrong)


def test_every_reference_leads_somewhere() -> None:
    lost = []
    for document, section, row in ROWS:
        for reference in row.where:
            error = reference_error(reference)
            target, _, anchor = reference.partition("#")
            if error is None and anchor and unresolved(ROOT / target, anchor):
                error = "there is no such anchor"
            if error is not None:
                lost.append(f"{document}, {section}: {reference}: {error}")
    assert not lost, "\n".join(lost)


def test_no_statement_is_listed_twice() -> None:
    places = [(document, section, row.says) for document, section, row in ROWS]
    assert len(set(places)) == len(places)


def test_references_that_lead_nowhere_are_found() -> None:
    assert (
        reference_error("tests/test_conformity.py::test_rows_have_a_status_a_text_and_a_reference")
        is None
    )
    assert reference_error("DEX1-SAFE-01") is None
    assert reference_error("dexkit/no_such.py") == "there is no such file"
    assert reference_error("DEX1-SAFE-99") == "there is no such requirement"
    missing = reference_error("tests/test_conformity.py::test_no_such")
    assert missing is not None
    assert "does not define" in missing


def test_the_page_names_no_place_outside_the_repository() -> None:
    for text in (conformity_page.page(), TABLE.read_text(encoding="utf-8")):
        assert not re.search(r"(?<![\w.~])/(?!usr/local|lowcmd|lowstate|dev/)\w+/", text)
