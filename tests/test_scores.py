"""Test how many wrong hands a run is said to catch: the sentence, its absence, and its source."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.console import Console

from dexkit.conformance import scores
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.generated.campaign import Trial
from dexkit.conformance.hands import under_test
from dexkit.conformance.judge import judge
from dexkit.conformance.layers import recording_of
from dexkit.conformance.recording import Recording
from dexkit.conformance.report.badge import render_badge
from dexkit.conformance.report.html import render
from dexkit.conformance.report.junit import write_junit
from dexkit.conformance.report.markdown import plain, render_markdown
from dexkit.conformance.report.terminal import print_result
from dexkit.conformance.requirements import Level, catalogue
from dexkit.conformance.result_file import read_json
from dexkit.conformance.results import RunResult
from dexkit.conformance.scores import (
    NO_SCORE,
    Caught,
    Entry,
    Score,
    Setting,
    catalogue_digest,
    entries,
    score_of,
    wilson,
)
from dexkit.conformance.selection import THOROUGH_ROUNDS, RunKind
from dexkit.conformance.stimulus_record import Planned, Stimulus
from dexkit.conformance.virtual import run_virtual
from dexkit.errors import TraceUnsupported, UsageError
from dexkit.escaping import html
from dexkit.hand import Side
from dexkit.traces import open_trace, sample_path
from tests.report_helpers import result_of_every_kind
from tools.scores import (
    SEED,
    _entry,
    _keep,
    _kept,
    _try,
    as_text,
    is_current,
    scored_models,
    tasks,
)

ROOT = Path(__file__).parent.parent
KNOWN = Score(
    run="default",
    setting="whole",
    must_breaking=Caught(90, 50, (0.4527, 0.6541)),
    lesser=Caught(9, 3, (0.1206, 0.6458)),
    seed=1,
    catalogue="abc",
)
SENTENCE = (
    "In a trial of 90 generated wrong hands that break a MUST, a run like this (default) caught "
    "56 % (95 % interval 45 to 65 %)."
)


# ---------------------------------------------------------------------------- the sentence


def test_a_score_is_a_sentence_with_its_uncertainty() -> None:
    assert KNOWN.sentence() == SENTENCE
    external = replace(KNOWN, setting="external").sentence()
    assert "(default; the service not restarted, nothing in the hands)" in external
    few = replace(KNOWN, unjudged=("DEX1-A-01",)).sentence()
    assert few == SENTENCE[:-1] + ", without DEX1-A-01, not judged for each hand."


def test_without_a_score_the_sentence_says_why() -> None:
    assert Score("a part was selected").sentence() == (
        "No score is known for this run: a part was selected."
    )
    for nothing in (Score(), replace(KNOWN, must_breaking=Caught(0, 0, (0.0, 1.0)))):
        assert nothing.sentence() == "No score is known for this run: no wrong hand was tried."


def renderings(result: RunResult, folder: Path) -> Iterator[tuple[str, str]]:
    """Each report's name, and its text without its own escapes."""
    sentence = result.score.sentence()
    out = io.StringIO()
    print_result(result, Console(file=out, width=60))
    yield "terminal", out.getvalue()
    yield "page", render(result).replace(html(sentence), sentence)
    yield "Markdown", render_markdown(result).replace(plain(sentence), sentence)
    yield "JSON", json.dumps(result.as_dict())
    image = ElementTree.fromstring(render_badge(result))
    title = image.find("{http://www.w3.org/2000/svg}title")
    assert title is not None
    yield "title of the badge", title.text or ""
    yield "label of the badge", image.attrib["aria-label"]
    write_junit(result, folder / "junit.xml")
    yield "JUnit", (folder / "junit.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize("score", [KNOWN, Score("requirements were left out: A-B-01"), NO_SCORE])
def test_every_report_has_the_sentence(score: Score, tmp_path: Path) -> None:
    for name, text in renderings(replace(result_of_every_kind(), score=score), tmp_path):
        assert score.sentence() in text, name


def test_wilson_interval() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(8, 10)
    assert (round(low, 3), round(high, 3)) == (0.490, 0.943)
    assert wilson(10, 10)[1] == pytest.approx(1.0)


# ------------------------------------------------------------------------- the result file


@pytest.mark.parametrize(
    "score", [KNOWN, replace(KNOWN, unjudged=("DEX1-A-01", "DEX1-B-01")), Score("it is so")]
)
def test_the_result_file_keeps_the_score(score: Score, tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    replace(result_of_every_kind(), score=score).write_json(path)
    assert json.loads(path.read_text())["score"]["sentence"] == score.sentence()
    assert read_json(path).score == score


def test_a_score_of_an_earlier_version_has_judged_everything(tmp_path: Path) -> None:
    data = replace(result_of_every_kind(), score=KNOWN).as_dict()
    del data["score"]["unjudged"]
    path = tmp_path / "result.json"
    path.write_text(json.dumps(data))
    assert read_json(path).score == KNOWN


def test_a_result_file_without_a_score_is_read(tmp_path: Path) -> None:
    data = result_of_every_kind().as_dict()
    del data["score"]
    path = tmp_path / "result.json"
    path.write_text(json.dumps(data))
    assert read_json(path).score == NO_SCORE


@pytest.mark.parametrize(
    ("member", "value"),
    [
        ("run", "slow"),
        ("must_breaking", {"count": 1}),
        ("must_breaking", {"count": 2, "caught": 1, "interval": [0.0, 1.0, 1.0]}),
        ("seed", "1"),
        ("unjudged", "DEX1-A-01"),
        ("unjudged", [1]),
        ("surprise", 1),
    ],
)
def test_a_wrong_score_in_a_result_file_is_refused(
    member: str, value: object, tmp_path: Path
) -> None:
    data = replace(result_of_every_kind(), score=KNOWN).as_dict()
    data["score"][member] = value
    path = tmp_path / "result.json"
    path.write_text(json.dumps(data))
    with pytest.raises(UsageError, match="score"):
        read_json(path)


# ------------------------------------------------------------------- which run has which score

IDS = ("DEX1-A-01", "DEX1-B-01", "DEX1-C-01")
PHASES = frozenset({"step", "silence"})
A, B, C = (frozenset({name}) for name in IDS)
GRAVE = (A, A | B, C, frozenset[str]())
BOTH = {"DEX1-A-01": 2, "DEX1-B-01": 2, "DEX1-C-01": 1}


def entry(run: str = "default", setting: str = "whole", **changes: Any) -> Entry:
    """An entry of a file of scores, of a gripper."""
    made = Entry(
        model="dex1-1",
        run=run,
        setting=setting,
        seed=1,
        hands=6,
        equivalent=1,
        must_breaking=GRAVE,
        lesser=(B,),
        catalogue=catalogue_digest("dex1-1"),
        rounds=1,
        phases=PHASES,
        requirements=IDS,
        fewer={"unitree_go": {"DEX1-C-01": 1}},
    )
    return replace(made, **changes)


NOT_HELD = {"unitree_go": {"DEX1-B-01": 0, "DEX1-C-01": 0}}
FILE = (
    entry("quick", requirements=IDS[:1], phases=frozenset({"step"})),
    entry(),
    entry(setting="external", fewer=NOT_HELD),
    entry("thorough", rounds=10),
)


def found(known: tuple[Entry, ...] = FILE, **changes: Any) -> Score:
    """The score of a whole default run, but for the changes."""
    stimulus = Stimulus(planned=Planned(PHASES), objects={Side.LEFT: None, Side.RIGHT: 1.0})
    run: dict[str, Any] = {
        "model": "dex1-1",
        "dialect": "unitree_go",
        "sides": ["left", "right"],
        "stimulus": stimulus,
        "judged": BOTH,
        **changes,
    }
    return score_of(**run, known=known)


def test_a_complete_run_has_the_score_of_its_kind() -> None:
    assert (found().run, found().setting, found().why) == ("default", "whole", "")
    held: dict[Any, float | None] = {Side.RIGHT: 1.0}
    thorough = Stimulus(planned=Planned(PHASES, 10), objects=held)
    assert found(stimulus=thorough).run == "thorough"
    quick = Stimulus(planned=Planned(frozenset({"step"})), objects=held)
    assert found(stimulus=quick, judged={IDS[0]: 2}).run == "quick"
    external = Stimulus(planned=Planned(PHASES), objects={Side.LEFT: None, Side.RIGHT: None})
    assert found(stimulus=external, judged={IDS[0]: 2}).setting == "external"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"stimulus": None}, "a recorded session was judged"),
        ({"model": "g1"}, "no wrong robots of the model"),
        ({"model": "twofinger"}, "no wrong hands of the model twofinger"),
        ({"stimulus": Stimulus()}, "does not say which stimuli"),
        ({"stimulus": Stimulus(planned=Planned(PHASES, 3))}, "no kind of run that was tried"),
        ({"stimulus": Stimulus(planned=Planned(frozenset("a")))}, "stimuli are those of no kind"),
        ({"sides": ["left"]}, "only the left hand was judged"),
        ({"known": (entry(catalogue="0"),)}, "requirements have changed"),
        ({"known": ()}, "no wrong hands of the model"),
    ],
)
def test_other_runs_have_no_score_and_give_the_reason(changes: dict[str, Any], why: str) -> None:
    score = found(**changes)
    assert score.must_breaking is None
    assert why in score.sentence()


def test_run_without_an_object_does_not_get_the_score_of_one_with_it() -> None:
    empty = Stimulus(planned=Planned(PHASES), objects={Side.LEFT: None, Side.RIGHT: None})
    assert "nothing was held" in found((entry(),), stimulus=empty).sentence()


@pytest.mark.parametrize(
    ("judged", "unjudged", "caught", "lesser"),
    [
        (BOTH, (), 3, 1),
        ({**BOTH, "DEX1-D-01": 2}, (), 3, 1),
        ({**BOTH, "DEX1-B-01": 1}, ("DEX1-B-01",), 3, 0),
        ({"DEX1-A-01": 2, "DEX1-B-01": 2}, ("DEX1-C-01",), 2, 1),
        ({"DEX1-B-01": 2}, ("DEX1-A-01", "DEX1-C-01"), 1, 1),
        ({}, IDS, 0, 0),
    ],
)
def test_what_was_not_judged_catches_nothing(
    judged: dict[str, int], unjudged: tuple[str, ...], caught: int, lesser: int
) -> None:
    score = found(judged=judged)
    assert score.unjudged == unjudged
    assert score.must_breaking == Caught(4, caught, rounded(caught, 4))
    assert score.lesser == Caught(1, lesser, rounded(lesser, 1))


def rounded(hits: int, count: int) -> tuple[float, float]:
    """Wilson's interval as scores have it."""
    low, high = wilson(hits, count)
    return round(low, 4), round(high, 4)


def test_a_requirement_counts_on_as_many_sides_as_in_the_trial() -> None:
    assert found(dialect="unitree_actuator").unjudged == ("DEX1-C-01",)


def test_a_long_list_of_requirements_is_cut() -> None:
    ids = tuple(f"DEX1-A-{i:02}" for i in range(9))
    text = found((entry(requirements=ids),), judged={}).sentence()
    cut = ", without DEX1-A-00, DEX1-A-01, DEX1-A-02 and 6 more, not judged for each hand."
    assert text.endswith(cut)


# ---------------------------------------------------------------------------- real recordings


@pytest.mark.parametrize(
    "run", [RunKind.QUICK, pytest.param(RunKind.DEFAULT, marks=pytest.mark.soak)]
)
def test_a_good_gripper_in_a_complete_run_has_the_score_of_the_file(run: RunKind) -> None:
    wanted = run.requirements(catalogue("dex1-1"))
    result = run_mutant(under_test("dex1-1").reference.load(), plan_for(run=run), wanted)
    (expected,) = (
        e.score()
        for e in entries()
        if (e.model, e.run, e.setting) == ("dex1-1", run, Setting.WHOLE)
    )
    assert result.score == expected
    assert f"({run})" in result.score.sentence()


def test_a_selection_of_a_run_has_the_score_of_its_requirements() -> None:
    plan = plan_for(run=RunKind.QUICK)
    trace = run_virtual(plan, under_test("dex1-1").reference.load())
    recording = recording_of(trace, "unitree_go", plan.sides)
    wanted = RunKind.QUICK.requirements(catalogue("dex1-1"))
    score = judge(recording, requirements=wanted[1:]).score
    assert score.unjudged == (wanted[0].id,)
    assert f", without {wanted[0].id}, not judged for each hand." in score.sentence()
    alone = judge(recording, requirements=wanted[:1]).score
    assert wanted[0].id not in alone.unjudged
    assert alone.must_breaking is not None
    assert score.must_breaking is not None
    assert alone.must_breaking.caught <= score.must_breaking.caught


def test_a_recorded_session_has_no_score() -> None:
    result = judge(Recording.decode(open_trace(sample_path("dex3_pinch"))))
    assert "a recorded session was judged" in result.score.sentence()


def test_the_recording_keeps_what_was_planned() -> None:
    stimulus = Stimulus(planned=Planned(PHASES, 10))
    assert Stimulus.from_metadata(stimulus.to_metadata()) == stimulus
    earlier = Stimulus().to_metadata()
    assert "planned" not in earlier
    assert Stimulus.from_metadata(earlier).planned is None


@pytest.mark.parametrize(
    "text",
    ["[]", "1", "{}", '{"phases": "ab", "rounds": 1}', '{"phases": [1], "rounds": 1}',
     '{"phases": [], "rounds": "1"}', '{"phases": [], "rounds": true}', "{"],
)  # fmt: skip
def test_a_damaged_plan_is_refused(text: str) -> None:
    with pytest.raises(TraceUnsupported):
        Stimulus.from_metadata({**Stimulus().to_metadata(), "planned": text})


# -------------------------------------------------------------------------------- the digest


def digest_with(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> str:
    """The digest with one requirement changed."""
    every = list(catalogue("dex1-1"))
    at = next(i for i, r in enumerate(every) if r.tolerances)
    if "tolerances" in changes:
        name = next(iter(every[at].tolerances))
        changes["tolerances"] = {**every[at].tolerances, name: every[at].tolerances[name] + 0.001}
    every[at] = replace(every[at], **changes)
    with monkeypatch.context() as patch:
        patch.setattr(scores, "catalogue", lambda name: tuple(every))
        return catalogue_digest.__wrapped__("dex1-1")


@pytest.mark.parametrize(
    "changes",
    [
        {"id": "DEX1-NEW-01"},
        {"level": Level.INFO},
        {"tolerances": {}},
        {"needs": "motion"},
        {"after": ()},
        {"dialects": ()},
        {"repeat": 9},
    ],
)
def test_the_digest_changes_with_the_requirements(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert digest_with(monkeypatch, **changes) != catalogue_digest("dex1-1")


def test_the_digest_does_not_change_with_prose(monkeypatch: pytest.MonkeyPatch) -> None:
    prose = dict.fromkeys(
        ("title", "area", "sentence", "rationale", "source", "advice", "cause", "expected"), "x"
    )
    assert digest_with(monkeypatch, **prose) == catalogue_digest("dex1-1")


# ---------------------------------------------------------------------------------- the file

RENEW = "what it judges has changed: renew conformance/scores.json with python -m tools.scores"


def test_scores_are_of_the_present_requirements() -> None:
    assert "dex1-1" in {e.model for e in entries()} <= set(scored_models())
    for e in entries():
        assert is_current(e), f"{e.model} {e.run}: {RENEW}"


@pytest.mark.parametrize(
    "change",
    [
        {"catalogue": ""},
        {"requirements": ()},
        {"phases": frozenset()},
        {"rounds": 2},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_score_of_another_run_is_not_current(change: dict[str, Any]) -> None:
    entry = next(e for e in entries() if e.run == "quick")
    assert not is_current(replace(entry, **change))


def test_score_file_covers_the_trials_of_the_tool() -> None:
    most = {(t.model, t.run, t.setting): t.hands for name in scored_models() for t in tasks(name)}
    for e in entries():
        assert e.hands <= most[e.model, RunKind(e.run), Setting(e.setting)]
        assert e.seed == SEED


def test_counts_and_requirements_of_the_file_agree() -> None:
    for e in entries():
        assert e.equivalent + len(e.must_breaking) + len(e.lesser) == e.hands
        assert set(e.requirements) >= {r for ids in e.fewer.values() for r in ids}
        assert set(e.requirements) >= frozenset().union(*e.must_breaking, *e.lesser)


def test_score_file_equals_the_output_of_the_tool() -> None:
    assert scores.FILE.read_text(encoding="utf-8") == as_text(entries())


def test_a_missing_or_wrong_file_of_scores(tmp_path: Path) -> None:
    assert entries(tmp_path / "none.json") == ()
    path = tmp_path / "scores.json"
    path.write_text("[]")
    with pytest.raises(UsageError, match="no file of scores"):
        entries(path)


# ---------------------------------------------------------------------------------- the tool


@pytest.mark.soak
def test_the_tool_judges_a_hand_in_every_kind_of_run() -> None:
    chosen = tasks("dex1-1", {(RunKind.QUICK, s): 1 for s in Setting})
    assert [t.setting for t in chosen] == list(Setting)
    trials = _try("dex1-1/unitree_go:q-offset@both,joint0,always", chosen)
    assert len(trials) == 2
    for trial in trials:
        assert trial.severity == "must-breaking"
        assert {r.partition("-")[0] for r in trial.failed} == {"DEX1"}
    quick = {r.id for r in RunKind.QUICK.requirements(catalogue("dex1-1"))}
    assert set(trials[0].failed) <= quick


def test_a_shorter_campaign_has_the_first_hands_only() -> None:
    assert {t.hands for t in tasks("dex1-1", most=3)} == {3}
    assert [t.hands for t in tasks("dex1-1", most=10**6)] == [t.hands for t in tasks("dex1-1")]


def test_the_tool_does_nothing_twice(tmp_path: Path) -> None:
    file = tmp_path / "done.jsonl"
    chosen = tasks("dex1-1", {(RunKind.QUICK, s): 2 for s in Setting})
    assert _kept(None, chosen) == _kept(file, chosen) == {}
    done = {(t, name): Trial(name, "x", "", "lesser") for t in chosen for name in ("a", "b")}
    _keep(file, done)
    with file.open("a") as cut:
        cut.write('{"about": ')  # stopped while it wrote
    assert _kept(file, chosen) == done
    assert _kept(file, tasks("dex1-1", {(RunKind.DEFAULT, Setting.WHOLE): 2})) == {}
    assert _kept(file, tasks("dex3-1", {(RunKind.QUICK, Setting.WHOLE): 2})) == {}
    file.write_text("1\n")
    with pytest.raises(UsageError, match="no trial of a hand"):
        _kept(file, chosen)


def test_an_entry_counts_hands_by_grade() -> None:
    (task,) = tasks("dex1-1", {(RunKind.QUICK, Setting.WHOLE): 5})
    grave = Trial("a", "x", "", "must-breaking", areas=("MOVE",))
    trials = [
        replace(grave, failed=("DEX1-MOVE-02",)),
        replace(grave, failed=("DEX1-RATE-01",)),  # for a wrong reason
        replace(grave, severity="lesser", warned=("DEX1-MOVE-02",)),
        replace(grave, severity="equivalent"),
    ]
    made = _entry(task, trials, {"unitree_go": {}})
    assert (made.hands, made.equivalent) == (4, 1)
    assert made.must_breaking == ({"DEX1-MOVE-02"}, set())
    assert made.lesser == ({"DEX1-MOVE-02"},)
    assert Entry.from_dict(json.loads(json.dumps(made.as_dict()))) == made


def test_thorough_runs_repeat_the_stimuli() -> None:
    assert plan_for(run=RunKind.THOROUGH).rounds == THOROUGH_ROUNDS
    assert plan_for().rounds == plan_for(run=RunKind.QUICK).rounds == 1
    assert plan_for(run=RunKind.QUICK).phases < plan_for().phases


def test_an_external_service_is_neither_restarted_nor_given_an_object() -> None:
    (whole, external) = tasks("dex1-1", {(RunKind.DEFAULT, s): 1 for s in Setting})
    assert whole.plan("unitree_go", tuple(Side)).objects
    plan = external.plan("unitree_go", tuple(Side))
    assert not plan.objects
    assert not plan.phases & {"shutdown", "service-restart"}


def test_the_tool_compares_digests_only_when_asked_to() -> None:
    command = [sys.executable, "-m", "tools.scores", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
