"""A result beside its recording: everything that follows from the recording is compared."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dexkit.conformance.kit import rejudge
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.rejudge import Comparison, compare_with_recording
from dexkit.conformance.kit.requirements import CAPABILITIES, Kind, catalogue
from dexkit.conformance.kit.result_file import as_document, parse_result
from dexkit.conformance.kit.results import Evidence, Overall, Verdict
from dexkit.conformance.kit.robot import robot_dialect
from dexkit.conformance.kit.run_record import RECORD, run_record
from dexkit.conformance.stimuli import Plan
from dexkit.conformance.virtual import run_virtual
from dexkit.conformance.virtual.robot import ReferenceRobot
from dexkit.digests import sha256_of_file
from dexkit.errors import DexkitError, UsageError
from dexkit.hand import ROBOT, Side
from dexkit.traces import open_trace, sample_path
from dexkit.traces.recorder import Recorder
from tests import hostile
from tests.each import each
from tests.reproduction_helpers import CLAIMS, write_run, write_trace

Document = dict[str, Any]


def document_of(path: Path, sides: tuple[Side, ...] = (), **options: Any) -> Document:
    """The result file that a judging of the recording writes."""
    view = recording_of(open_trace(path), None, sides)
    subject = {"recording": path.name, "recording_sha256": sha256_of_file(path)}
    found: Document = json.loads(json.dumps(as_document(judge(view, subject=subject, **options))))
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a live run of the left hand."""
    return write_run(tmp_path_factory.mktemp("run") / "run.mcap")


@pytest.fixture(scope="module")
def of_run(run: Path) -> Document:
    return document_of(run, claims=CLAIMS)


@pytest.fixture(scope="module")
def session() -> Path:
    """The recording of a session with both hands, one of which drops out."""
    return sample_path("dex1_hand_dropout")


@pytest.fixture(scope="module")
def of_session(session: Path) -> Document:
    return document_of(session)


def changed(document: Document, change: Callable[[Document], object]) -> Document:
    found: Document = json.loads(json.dumps(document))
    change(found)
    return found


def paths(found: Comparison) -> set[str]:
    return {d.path for d in found.differences}


def recomputed(document: Document, **changes: Any) -> Document:
    """The result with other members, and with all summaries as they follow from these."""
    found = replace(parse_result(document, "it"), **changes)
    written: Document = json.loads(json.dumps(as_document(found)))
    return written


def without_failures(document: Document) -> Document:
    """What a signer would like to show: the failed requirements were never there."""
    found = parse_result(document, "it")
    bad = {r.requirement.id for r in found.results if r.verdict in (Verdict.FAIL, Verdict.BLOCKED)}
    assert bad
    kept = [r for r in found.results if r.requirement.id not in bad]
    count = len({r.requirement.id for r in kept})
    client = [r for r in found.client if r.verdict is not Verdict.WARN]
    forged = recomputed(document, results=kept, catalogue=count, client=client)
    assert forged["grades"]["drop-in"]["overall"] == "pass"
    return forged


# ---------------------------------------------------------------------- the same documents


def test_result_of_its_recording_has_no_difference(
    run: Path, of_run: Document, session: Path, of_session: Document
) -> None:
    for path, document in ((run, of_run), (session, of_session)):
        found = compare_with_recording(document, path)
        assert found.differences == ()
        assert not found.is_part
        assert found.part() == []
        assert set(found.stated) == set(rejudge.STATED)


def test_live_run_and_check_of_its_recording_write_the_same(tmp_path: Path) -> None:
    """A robot's, with the subject of the run record, which the suite takes from there, too."""
    plan = Plan(robot_dialect("h1"), (ROBOT,), phases=frozenset())
    trace = run_virtual(plan, ReferenceRobot)
    about = {"backend": "sim-h1", "device": "emulated", "object": ""}
    trace.metadata[RECORD] = run_record(
        subject=about,
        dialect="h1",
        sides=[ROBOT],
        phases=[],
        rounds=1,
        requirements=catalogue("h1", "robot"),
        claims=Claims(),
    )
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        write_trace(trace, recorder)
    document = document_of(path)
    assert document["subject"]["backend"] == "sim-h1"
    assert document["subject"]["device"] == "emulated"
    assert "object" not in document["subject"]
    assert compare_with_recording(document, path).differences == ()
    forged = changed(document, lambda d: d["subject"].update(device="/dev/ttyUSB0"))
    assert paths(compare_with_recording(forged, path)) == {"subject.device"}


# ----------------------------------------------------------------------------- parts


def test_an_honest_part_is_named_and_is_no_pass(session: Path, of_session: Document) -> None:
    some = [r for r in catalogue("dex1-1", "dds") if r.id.startswith("DEX1-TOPIC")]
    document = document_of(session, requirements=some)
    found = compare_with_recording(document, session)
    assert found.differences == ()
    assert found.is_part
    every = {r["id"] for r in [*of_session["results"], *of_session["client"]["results"]]}
    assert set(found.left_out) == every - {r.id for r in some}
    assert found.part()[0] == (
        f"a part only: {len(some)} of {len(every)} requirements (those about the client included), "
        "a chosen part"
    )
    grade = parse_result(document, "it").grade(Kind.DROP_IN)
    assert grade.overall is Overall.PASS
    assert "PASS:" not in grade.sentence()
    assert "A PART PASSES" in document["grades"]["drop-in"]["sentence"]


# ------------------------------------------------------------------------ every member


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all members that hold no others; of lists, of the first and the last item."""
    if isinstance(value, dict) and value:
        return [p for k, v in value.items() for p in leaves(v, (*path, k))]
    if isinstance(value, list) and value:
        ends = {0, len(value) - 1}
        return [p for i in sorted(ends) for p in leaves(value[i], (*path, i))]
    return [path]


def test_every_member_is_compared(of_run: Document) -> None:
    """Each leaf of a result is changed in turn; only what is on the list may go unnoticed."""
    every = parse_result(of_run, "it")
    with_measure = next(r for r in every.results if r.measure is not None)
    failed = replace(every.results[0], evidence=(Evidence("rt/x", 1.0, 1_000_000_000),))
    judged = replace(every, results=[failed, with_measure])  # few, to be fast
    document = as_document(judged)
    unnoticed = set()
    for path in leaves(json.loads(json.dumps(document))):
        found = json.loads(json.dumps(document))
        *way, last = path
        place = found
        for name in way:
            place = place[name]
        place[last] = "another" if place[last] != "another" else "text"
        if not list(rejudge.document_differences(found, judged, rejudge.STATED)):
            unnoticed.add(".".join(map(str, path)))
    assert unnoticed == set(rejudge.STATED)


def add(name: str, value: Any) -> Callable[[Document], object]:
    return lambda d: d.update({name: value})


def swap(document: Document) -> None:
    results = document["results"]
    results[0], results[-1] = results[-1], results[0]


FORGED: dict[str, tuple[Callable[[Document], object], str]] = {
    "sentence": (add("sentence", "PASS: every MUST is met"), "sentence"),
    "note": (lambda d: d["notes"].append("a perfect hand"), "notes[0]"),
    "new member": (add("certified_by", "Unitree"), "certified_by"),
    "subject": (lambda d: d["subject"].update(certified="yes"), "subject.certified"),
    "hand": (lambda d: d["subject"].update(hand="Another"), "subject.hand"),
    "backend": (lambda d: d["subject"].update(backend="external"), "subject.backend"),
    "claims": (lambda d: d["claims"].update(force=False), "claims.force"),
    "no claims": (add("claims", None), "claims"),
    "version": (lambda d: d["environment"].update(dexkit="9.9"), "environment.dexkit"),
    "digest": (lambda d: d["subject"].pop("recording_sha256"), "subject.recording_sha256"),
    "run": (lambda d: d["run"].update(processor="another"), "run.processor"),
    "figure": (lambda d: d["results"][0].update(figure="1 kHz"), "results[0].figure"),
    "order": (swap, "results"),
    "twice": (lambda d: d["results"].append(d["results"][0]), ""),
    "level": (
        lambda d: d["results"][0]["requirement"].update(level="INFO"),
        "results[0].requirement.level",
    ),
    "one side": (lambda d: d["results"].pop(), "results"),
    "grades": (lambda d: d.pop("grades"), "grades"),
    "retry": (lambda d: d["results"][0].update(retry=not d["results"][0]["retry"]), ""),
}


@each("name", FORGED)
def test_forged_member_is_named(name: str, run: Path, of_run: Document) -> None:
    change, path = FORGED[name]
    judged = parse_result(of_run, "it")
    found = list(rejudge.document_differences(changed(of_run, change), judged, rejudge.STATED))
    assert path in {d.path for d in found} if path else found
    assert all(str(d).isprintable() for d in found)


def test_claims_of_a_session_are_what_the_signer_states(session: Path) -> None:
    units = dict.fromkeys(CAPABILITIES, True)
    claims = Claims(units, {"name": "X", "vendor": "Y"})
    document = document_of(session, claims=claims)
    found = compare_with_recording(document, session)
    assert found.differences == ()
    assert found.stated["subject.hand"] == "X"
    assert found.stated["subject.vendor"] == "Y"
    assert found.stated["claims"] == units
    forged = changed(document, lambda d: d["claims"].update(force=False))
    assert any(p.startswith("results") for p in paths(compare_with_recording(forged, session)))
    forged = changed(document, lambda d: d["claims"].update(wings=True))
    with pytest.raises(UsageError, match="wings"):
        compare_with_recording(forged, session)
    forged = changed(document_of(session), lambda d: d["subject"].update(hand="X"))
    assert "subject.hand" in paths(compare_with_recording(forged, session))


def test_result_of_another_dialect_is_an_error_or_a_difference(
    session: Path, of_session: Document
) -> None:
    forged = changed(of_session, lambda d: d["subject"].update(dialect="latin"))
    with pytest.raises(DexkitError, match="latin"):
        compare_with_recording(forged, session)
    forged = changed(of_session, lambda d: d["subject"].update(sides="right, left"))
    assert paths(compare_with_recording(forged, session)) == {"subject.sides"}


def test_result_of_an_earlier_version_is_refused(session: Path, of_session: Document) -> None:
    old = changed(of_session, add("version", 2))
    with pytest.raises(UsageError, match=r"version 2 .* is not read by this dexkit"):
        compare_with_recording(old, session)


def test_difference_shows_no_control_characters(of_run: Document) -> None:
    judged = parse_result(of_run, "it")
    forged = changed(of_run, add("\x1b[31m\n", "\x1b[2J" * 1000))
    (found,) = rejudge.document_differences(forged, judged)
    assert str(found).isprintable()
    assert len(str(found)) < 600


# -------------------------------------------------------------------------- the command


def against(recording: Path, result: object, *more: object) -> tuple[int, str, str]:
    """Exit code and output of ``dexkit check RECORDING --against RESULT``."""
    words = ("check", recording, "--against", result, *more)
    code, out, err = hostile.run_command([str(w) for w in words])
    assert "Traceback" not in err
    return code, out, err


@pytest.fixture
def result(tmp_path: Path, session: Path) -> Path:
    """The result file that ``dexkit check`` writes of the session."""
    path = tmp_path / "result.json"
    code, out, _ = hostile.run_command(["check", str(session), "--result", str(path)])
    assert code == 1  # a hand that drops out
    assert sha256_of_file(session) in out
    return path


def test_command_finds_an_unchanged_result_the_same(result: Path, session: Path) -> None:
    code, out, err = against(session, result)
    assert (code, err) == (0, "")
    assert "the same: " in out
    assert "drop-in: FAIL: a MUST is not met" in out
    assert "as stated, not compared: environment.python " in out
    assert "as stated, not compared: subject.recording " in out


@each("name", ("sentence", "note"))
def test_command_names_a_forged_member(
    name: str, tmp_path: Path, of_session: Document, session: Path
) -> None:
    change, path = FORGED[name]
    forged = tmp_path / "result.json"
    forged.write_text(json.dumps(changed(of_session, change)))
    code, out, err = against(session, forged)
    assert (code, err) == (1, "")
    assert out.rstrip().splitlines()[-1].startswith(f"  {path}: ")


def test_command_finds_removed_failures(result: Path, session: Path) -> None:
    result.write_text(json.dumps(without_failures(json.loads(result.read_text()))))
    code, out, _ = against(session, result)
    assert code == 1
    assert "a part only: " in out
    assert "left out, fail when judged: " in out
    assert "all requirements together: FAIL: a MUST is not met" in out
    assert "\n  grades.drop-in.sentence: " in out


def test_command_refuses_another_recording(result: Path) -> None:
    other = sample_path("dex3_pinch")
    code, out, err = against(other, result)
    assert (code, err) == (1, "")
    assert "is not the recording that" in out
    assert sha256_of_file(other) in out


def test_command_needs_two_usable_files_and_no_options(result: Path, session: Path) -> None:
    assert against(session, session)[0] == 2
    code, _, err = against(session, result, "--side", "left")
    assert (code, "takes no other options" in err) == (2, True)
    text = result.read_text()
    for bad in (text + "{}", text.replace("{", '{"format": 1,', 1), '{"format": "another"}'):
        result.write_text(bad)
        code, out, _ = against(session, result)
        assert (code, out) == (2, "")
