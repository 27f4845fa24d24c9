"""Every fact about a real hand leads somewhere, and its verdict has what it needs."""

from __future__ import annotations

import re
from collections import Counter

from dexkit.conformance.kit.requirements import Level, catalogue
from tests.test_citations import ROOT, unresolved
from tools.generate import real_hands_page
from tools.generate.real_hands_page import BASES, VERDICTS, basis, read, verdicts

SOURCES, HANDS = read()
FACTS = [fact for hand in HANDS for fact in hand.facts]


def test_a_verdict_other_than_no_evidence_has_a_real_hand() -> None:
    wrong = []
    for fact in FACTS:
        kinds = {SOURCES[key].kind for key in fact.sources}
        if fact.verdict not in VERDICTS:
            wrong.append(f"{fact.anchor}: unknown verdict {fact.verdict!r}")
        if fact.verdict != "no evidence" and "hand" not in kinds:
            wrong.append(f"{fact.anchor}: {fact.verdict} without a hand")
        if fact.verdict == "disputed" and len(fact.sources) < 2:
            wrong.append(f"{fact.anchor}: disputed by whom?")
    assert not wrong, "\n".join(wrong)


def test_every_reference_of_a_fact_leads_somewhere() -> None:
    ids = {r.id for r in catalogue(None, None)}
    lost = []
    for fact in FACTS:
        lost += [f"{fact.anchor}: no requirement {r}" for r in fact.requirements if r not in ids]
        if not fact.where:
            lost.append(f"{fact.anchor}: no place")
        for reference in fact.where:
            page, _, anchor = reference.partition("#")
            if not (ROOT / page).exists() or (anchor and unresolved(ROOT / page, anchor)):
                lost.append(f"{fact.anchor}: {reference}")
    assert not lost, "\n".join(lost)


def test_every_source_is_used_and_has_a_kind() -> None:
    used = {key for fact in FACTS for key in fact.sources}
    assert used == set(SOURCES)
    assert {source.kind for source in SOURCES.values()} <= {"hand", "document", "code"}
    assert len({fact.anchor for fact in FACTS}) == len(FACTS)


def test_the_counts_of_the_page_are_those_of_the_catalogue() -> None:
    must = [r for r in catalogue(None, None) if r.level is Level.MUST]
    carried = Counter(map(basis, must))
    judged = Counter(verdicts().get(r.id, "") for r in must)
    assert set(carried) <= set(BASES)
    [total] = re.findall(r"(?m)^\| all \| ((?:\d+ \| ){10}\d+) \|$", real_hands_page.bases())
    assert list(map(int, total.split(" | "))) == [
        len(must),
        *(carried[name] for name in BASES),
        *(judged[name] for name in VERDICTS),
        judged[""],
    ]


def test_a_requirement_on_several_facts_has_the_worst_verdict() -> None:
    named = [f.verdict for f in FACTS if "DEX3-SENS-04" in f.requirements]
    assert sorted(named) == ["agrees", "disputed"]
    assert verdicts()["DEX3-SENS-04"] == "disputed"
