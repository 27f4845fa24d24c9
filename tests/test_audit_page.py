"""The page of an audit: what to keep, review and drop, and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.summary_page import Summary, render
from dexkit.conformance.dataset.findings import Curve, Finding, Judgement, Shot, Use
from dexkit.conformance.dataset.judge import CHECKS, TITLES

HOSTILE = "<script>alert(1)</script>"


def record(number: int, use: Use, *findings: Finding, **more: Any) -> EpisodeRecord:
    judged = [check.name for check in CHECKS if check.name != "camera-late"]
    return EpisodeRecord(
        f"set/episode_{number:06d}",
        state=State.JUDGED,
        exit_code=int(use is Use.DROP),
        facts={"duration_s": 36.0},
        source="set",
        episode=str(number),
        form="LeRobot v2.1",
        judgement=Judgement(
            use, list(findings), figures={"lag, s": 0.1 + 0.001 * number}, judged=judged, **more
        ),
    )


def page(*records: EpisodeRecord, **more: Any) -> str:
    summary = Summary()
    for each in records:
        summary.add(each)
    return render(summary, locations=["set"], **more)


def frozen(text: str = "the left hand stands still") -> Finding:
    return Finding("frozen", Use.DROP, text, "left_hand", (0,), 2.0, 3.5)


def test_page_says_how_many_and_why_and_what_to_do_next() -> None:
    curve = Curve(0, "thumb_0", "rad", [1.0, 2.0, 3.0], [0.1, 0.1, None], [0.1, 0.5, 0.9])
    text = page(
        record(0, Use.KEEP),
        record(1, Use.REVIEW, Finding("idle", Use.REVIEW, "nothing moves", "", (), 0.0, 9.0)),
        record(2, Use.DROP, frozen(), curves=[curve], shots=[Shot(0, "head", 2.75, "QUJD")]),
        commands=[("set without 1 episode", "dexkit export set --out set-clean --drop e.json")],
    )
    assert "3 episodes: 1 keep, 1 review, 1 drop" in text
    assert "dexkit export set --out set-clean --drop e.json" in text
    assert text.index("the left hand stands still") < text.index("nothing moves")  # worst first
    assert "2.0 to 3.5 s" in text
    assert "left hand, thumb_0" in text
    assert "data:image/jpeg;base64,QUJD" in text
    assert "Recordings of the wire" not in text


def test_what_was_not_judged_is_said() -> None:
    text = page(record(0, Use.KEEP))
    silent = text[text.index("What was not judged") :]
    assert "camera-late" in silent
    assert "LeRobot v2.1 (1)" in silent
    assert "frozen" not in silent


def test_findings_about_a_whole_set_and_episodes_that_cannot_be_read() -> None:
    whole = EpisodeRecord("set", state=State.JUDGED, source="set", is_set=True, exit_code=0)
    whole.judgement = Judgement(Use.REVIEW, [Finding("statistics", Use.REVIEW, "of other data")])
    broken = EpisodeRecord("set/episode_000001", state=State.UNREADABLE, error="half of it")
    text = page(record(0, Use.KEEP), whole, broken)
    assert "2 episodes: 1 keep, 0 review, 0 drop, 1 not usable or inconclusive" in text
    assert "of other data" in text
    assert "half of it" in text


def test_distributions_name_the_episodes_that_are_far_from_the_others() -> None:
    records = [record(i, Use.KEEP) for i in range(12)]
    records[7].judgement.figures["lag, s"] = 2.5  # type: ignore[union-attr]
    text = page(*records)
    assert "How the episodes of a set differ" in text
    assert "far from it: <b>2.5 s</b> episode_000007" in text


def test_hostile_texts_are_escaped() -> None:
    finding = frozen(HOSTILE)
    curve = Curve(0, HOSTILE, HOSTILE, [1.0, 2.0], [0.0, 1.0])
    shot = Shot(0, HOSTILE, 1.0, '"' + HOSTILE)
    bad = record(0, Use.DROP, finding, curves=[curve], shots=[shot])
    bad.name = bad.source = HOSTILE
    assert "<script" not in page(bad, commands=[(HOSTILE, HOSTILE)])


def test_page_of_many_bad_episodes_stays_small() -> None:
    t = [0.01 * i for i in range(160)]
    wave = [0.001 * (i * i % 977) for i in range(160)]
    curves = [Curve(0, "thumb_0", "rad", t, list(wave), wave[::-1])] * 3
    text = page(*(record(i, Use.DROP, frozen(), curves=curves) for i in range(400)))
    assert "400 episodes" in text
    assert "200 episodes more" in text
    assert len(text) < 3_000_000


def test_every_check_is_described() -> None:
    text = (Path(__file__).parent.parent / "docs/audit.md").read_text()
    assert [name for name in TITLES if f"`{name}`" not in text] == []
