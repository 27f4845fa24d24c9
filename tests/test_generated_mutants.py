"""Test generated hands, the oracle that grades them, their score, and hands of other people."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.conformance.faults import generated, outsiders
from dexkit.conformance.faults.__main__ import command
from dexkit.conformance.faults.generated import Fault, Generated, dialects, oracle, parse
from dexkit.conformance.faults.generated.campaign import Campaign, Trial, try_generated
from dexkit.conformance.faults.generated.choices import DEVIATIONS
from dexkit.conformance.faults.generated.faults import FAULTS, KINDS
from dexkit.conformance.faults.generated.rig import What, compose
from dexkit.conformance.faults.generated.stimulus import play_order, random_segments
from dexkit.conformance.faults.generated.times import WHENS
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.selection import RunKind
from dexkit.conformance.virtual import Service
from dexkit.errors import ConformanceError, DexkitError, ModelBroken, UsageError
from dexkit.hand import Side
from dexkit.models import Dialect, dialect

ROOT = Path(__file__).parent.parent
DOCUMENT = ROOT / "docs" / "mutants.md"


# ----------------------------------------------------------------------------- composition


def test_names_of_samples_round_trip() -> None:
    spoken = dialects()
    wrong = generated.sample(300, 5, spoken)
    good = generated.sample_good(300, 5, spoken)
    for hand in wrong + good:
        assert parse(hand.name) == hand
        assert hand.summary
    assert not any(h.good for h in wrong)
    assert all(h.good for h in good)
    assert {h.kind for h in wrong} == {*KINDS, "two faults"}
    assert {h.dialect.name for h in wrong} == {d.name for d in spoken}


def test_a_seed_gives_the_same_sample_again() -> None:
    spoken = dialects("dex3-1")
    first = generated.sample(50, 9, spoken)
    assert first == generated.sample(50, 9, spoken)
    assert first != generated.sample(50, 10, spoken)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("dex1-1", "names no generated hand"),
        ("dex9-1/unitree_go:q-echo@left,joint0,always", "no hand model"),
        ("dex3-1/unitree_go:q-echo@left,joint0,always", "has no dialect"),
        ("dex1-1/unitree_go:q-ech@left,joint0,always", "'q-ech' in"),
        ("dex1-1/unitree_go:q-echo@top,joint0,always", "'top' in"),
        ("dex1-1/unitree_go:q-echo@left,joint7,always", "'joint7' in"),
        ("dex1-1/unitree_go:q-echo@left,joint0,always&never", "'never' in"),
        ("dex1-1/unitree_go:q-echo", "no deviation"),
    ],
)
def test_a_name_that_is_no_hand_is_an_error(name: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        parse(name)


def test_every_fault_condition_and_deviation_has_a_description() -> None:
    for made in (*FAULTS.values(), *DEVIATIONS.values(), *WHENS.values()):
        assert made.title
        assert made.summary
    assert all(w.areas for w in FAULTS.values())
    assert {w.kind for w in FAULTS.values()} == set(KINDS)


def test_a_reference_without_known_mechanics_is_refused() -> None:
    with pytest.raises(ModelBroken, match="no ReferenceService"):
        compose("x", "", Service, ())


@pytest.mark.slow
@pytest.mark.parametrize("spoken", dialects(), ids=lambda d: f"{d.model}-{d.name}")
def test_a_reference_reports_what_the_oracle_takes_for_true(spoken: Dialect) -> None:
    sides = (Side.LEFT,)
    plan = oracle._plan(spoken.name, sides)
    events, _ = play_order(random_segments(plan, 1)[:4])
    seen = oracle._observe(oracle._reference(spoken.name, sides), plan, events)
    assert oracle._compare(spoken, seen, seen) == []


# ------------------------------------------------------------------------------ properties


def changes(what: type[What], name: str) -> bool:
    """Whether a fault changes what an observer sees under the random stimulus."""
    spoken = dialect(name)
    hand = Generated(spoken, (Fault(what.title, "right", "joint0"),))
    plan = oracle._plan(name, hand.sides)
    events, _ = oracle._stimulus(name, hand.sides, 1)
    seen = oracle._observe(hand.service(), plan, events)[Side.RIGHT]
    reference = oracle._reference_run(name, hand.sides, 1)[Side.RIGHT]
    if not (seen.q == reference.q).all() or not (seen.tau == reference.tau).all():
        return True
    if seen.states is None or reference.states is None:
        return True
    if len(seen.states) != len(reference.states):
        return True
    return any(
        getattr(seen.states, column).tobytes() != getattr(reference.states, column).tobytes()
        for column in ("t", "sent", "q", "dq", "ddq", "tau", "mode")
    ) or not bool((seen.driven == reference.driven).all())


@pytest.mark.soak
@pytest.mark.parametrize(
    ("title", "name"),
    [
        (t, n)
        for t, w in FAULTS.items()
        for n in ("unitree_go", "dex3")
        if n == "dex3" or not w.several
    ],
)
def test_every_fault_does_something_under_always(title: str, name: str) -> None:
    what = FAULTS[title]
    assert changes(what, name) or what.idle, what.summary


# -------------------------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("name", "severity", "caught"),
    [
        # a good one is below
        pytest.param(
            *("dex1-1/unitree_go:q-mirror@left,joint0,always", "must-breaking", True),
            marks=pytest.mark.soak,
        ),
        pytest.param(
            *("dex1-1/unitree_go:nan-is-zero@left,joint0,unled", "equivalent", False),
            marks=pytest.mark.soak,
        ),
    ],
)
def test_a_generated_hand_is_graded_and_judged(name: str, severity: str, caught: bool) -> None:
    trial = try_generated(parse(name))
    assert (trial.severity, trial.caught) == (severity, caught), trial
    assert (trial.effect == "") is (severity in ("equivalent", "good"))


def trial(**changes: object) -> Trial:
    blank = Trial("a", "position", "", "must-breaking", areas=("FIELD", "MOVE"))
    return replace(blank, **changes)  # type: ignore[arg-type]


def test_only_a_failed_must_of_a_declared_area_catches_a_breaking_hand() -> None:
    assert trial(failed=("DEX1-MOVE-02",)).caught
    assert trial(failed=("MY-HAND-MOVE-02",)).caught
    assert not trial(warned=("DEX1-MOVE-02",)).caught
    assert not trial(failed=("DEX1-RATE-01",)).caught
    assert trial(failed=("DEX1-RATE-01",)).wrong_reason
    assert trial(severity="lesser", warned=("DEX1-MOVE-02",)).caught
    assert trial(severity="good").caught
    assert not trial(severity="good", warned=("DEX1-MOVE-02",)).caught


# -------------------------------------------------------------------------------- commands

HAND = "dex1-1/unitree_go:noise-q-small"


def test_a_campaign_is_resumed_and_not_done_again(tmp_path: Path) -> None:
    done, score = tmp_path / "done.jsonl", tmp_path / "score.json"
    hands = generated.sample_good(3, 1, dialects("dex1-1", "unitree_go"))
    campaign = Campaign(1, done)
    for hand in hands[:2]:
        campaign._add(Trial(hand.name, "good", "", "good"))
    with done.open("a") as cut:
        cut.write('{"seed": 1, "na')  # stopped while it wrote
    again = Campaign(1, done)
    assert set(again._done()) == {h.name for h in hands[:2]}
    campaign.write_json(score)
    assert json.loads(score.read_text())["score"]["good"]["count"] == 2
    with pytest.raises(UsageError, match="has the seed 1"):
        Campaign(2, done)._done()
    with pytest.raises(UsageError, match="is of default runs, not quick ones"):
        Campaign(1, done, kind=RunKind.QUICK)._done()
    # as earlier versions have written it
    done.write_text(done.read_text().replace('"run": "default", ', ""))
    assert set(again._done()) == {h.name for h in hands[:2]}
    done.write_text("no\nmore\n")
    with pytest.raises(UsageError, match="no trial of generated hands"):
        Campaign(1, done)._done()


@pytest.mark.soak
def test_command_tries_a_generated_hand(tmp_path: Path) -> None:
    path = tmp_path / "score.json"
    run = CliRunner().invoke(command, ["--hand", HAND, "--jobs", "1", "--result", str(path)])
    assert run.exit_code == 0, run.output
    assert "1 good hands: 0 fail a MUST, 0 are warned" in run.output
    assert json.loads(path.read_text())["run"] == "default"
    (found,) = json.loads(path.read_text())["hands"]
    assert found["name"] == HAND
    assert found["caught"] is True


@pytest.mark.slow
def test_a_quick_run_judges_only_its_requirements() -> None:
    found = try_generated(parse("dex1-1/unitree_go:q-offset@left,joint0,always"), 1, RunKind.QUICK)
    quick = {r.id for r in RunKind.QUICK.requirements(catalogue("dex1-1"))}
    assert found.severity == "must-breaking"
    assert found.failed
    assert {*found.failed, *found.warned} <= quick


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--good"], "need --generated"),
        (["--quick"], "need --generated"),
        (["--thorough", "--from", "a.py"], "need --generated"),
        (["--generated", "1", "--quick", "--thorough"], "exclude each other"),
        (["--generated", "1", "--require", "DEX1"], "cannot be combined"),
        (["--generated", "1", "--model", "h1"], "is a robot"),
        (
            ["--generated", "1", "--model", "dex1-1", "--dialect", "dex3"],
            "dex1-1 has no dialect dex3",
        ),
        (["--from", "a.py", "--model", "dex1-1"], "combined with --from"),
        (["--from", "there-is-none.py"], "no such file"),
    ],
)
def test_contradicting_options_are_errors(arguments: list[str], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        CliRunner().invoke(command, arguments, catch_exceptions=False)


# ------------------------------------------------------------------------- of other people


def test_the_documented_mixin_is_of_two_models(tmp_path: Path) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(\"\"\"A fault in two models.*?)```", text, re.DOTALL)
    (tmp_path / "halfway.py").write_text(example)
    loaded = outsiders.load(str(tmp_path / "halfway.py"))
    assert [o.dialect.name for o in loaded] == ["dex3", "dex5"]


def documented_example() -> str:
    text = DOCUMENT.read_text(encoding="utf-8")
    (example,) = re.findall(r"<!-- example: .* -->\n```python\n(.*?)```", text, re.DOTALL)
    return str(example)


def test_the_documented_example_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "grippers.py").write_text(documented_example())
    loaded = outsiders.load(str(tmp_path / "grippers.py"))
    assert {o.name for o in loaded} == {"StopsHalfway", "Heavier", "Alone"}


@pytest.mark.soak  # hands of other people are tried in the test of one that fails, below
def test_the_documented_example_is_tried(tmp_path: Path) -> None:
    (tmp_path / "grippers.py").write_text(documented_example())
    path = tmp_path / "verdicts.json"
    arguments = ["--from", str(tmp_path / "grippers.py"), "--result", str(path), "--jobs", "1"]
    run = CliRunner().invoke(command, arguments)
    assert run.exit_code == 0, run.output
    found = {h["name"]: h for h in json.loads(path.read_text())["hands"]}
    assert set(found) == {"StopsHalfway", "Heavier", "Alone"}
    assert found["StopsHalfway"]["failed"]
    assert found["StopsHalfway"]["story"] in run.output
    assert found["Heavier"]["grade"] == "good"
    assert not found["Heavier"]["story"]
    assert found["StopsHalfway"]["summary"] == "Goes half of the way only."


_HEAD = """
from dexkit.conformance.faults.outsiders import hand
from dexkit.conformance.virtual.gripper import ReferenceService
"""
_DFX = """
from dexkit.conformance.faults.outsiders import hand
from dexkit.conformance.virtual.inspire import InspireService
"""


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1 +", "SyntaxError"),
        ("import nowhere_at_all", "nowhere_at_all"),
        (_HEAD + "@hand('bad')\nclass A(ReferenceService): pass", "no grade"),
        (_HEAD + "@hand('good')\nclass A: pass", "no service of hands"),
        (_HEAD + "@hand('good', dialects='dex3')\nclass A(ReferenceService): pass", "dex3"),
        (_HEAD + "@hand('lesser', expects='DEX9-A')\nclass A(ReferenceService): pass", "DEX9-A"),
        (_HEAD + "class A(ReferenceService): pass", "is marked"),
        (_HEAD + "@hand('good', lacks='touch')\nclass A(ReferenceService): pass", "no unit"),
        (_HEAD + "@hand('good', sides='middle')\nclass A(ReferenceService): pass", "no side"),
        (_DFX + "@hand('good', sides='left')\nclass A(InspireService): pass", "moves both"),
    ],
)
def test_a_file_that_cannot_be_used_is_an_error(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "hands.py"
    path.write_text(text)
    with pytest.raises(DexkitError, match=why):
        outsiders.load(str(path))


def test_what_a_hand_lacks_is_not_claimed(tmp_path: Path) -> None:
    (tmp_path / "hands.py").write_text(
        "from dexkit.conformance.faults.outsiders import hand\n"
        "from dexkit.conformance.virtual.dex5 import Dex5Service\n"
        "from dexkit.conformance.virtual.fingers import Dex3Service\n"
        "@hand('good', lacks=('force', 'low_rate'), sides='left')\nclass A(Dex3Service): pass\n"
        "@hand('good', lacks='force')\nclass B(Dex5Service): pass\n"
        "@hand('good')\nclass C(Dex3Service): pass\n"
    )
    a, b, c = outsiders.load(str(tmp_path / "hands.py"))
    assert a.claims.units is not None
    assert {u for u, claimed in a.claims.units.items() if not claimed} == {"force", "low_rate"}
    assert a.sides == (Side.LEFT,)
    assert b.claims.units is not None
    assert not b.claims.units["imu"]  # its reference has none
    assert (c.claims.units, c.sides) == (None, tuple(Side))


def test_one_hand_without_force_is_good(tmp_path: Path) -> None:
    (tmp_path / "grippers.py").write_text(documented_example())
    (alone,) = (o for o in outsiders.load(str(tmp_path / "grippers.py")) if o.name == "Alone")
    found = outsiders.try_hand(alone)
    assert found.right, found


@pytest.mark.slow
def test_a_hand_that_fails_leaves_the_others(tmp_path: Path) -> None:
    path = tmp_path / "hands.py"
    fails = "    def live(self, dt): raise RuntimeError('mine')\n"
    mute = "    def publish(self): return []\n"  # which ends its run at once
    path.write_text(
        _HEAD
        + f"@hand('good', dialects='unitree_go')\nclass A(ReferenceService):\n{fails}"
        + f"@hand('must-breaking', dialects='unitree_go')\nclass B(ReferenceService):\n{mute}"
    )
    out = tmp_path / "verdicts.json"
    run = CliRunner().invoke(command, ["--from", str(path), "--result", str(out), "--jobs", "1"])
    assert run.exit_code == 1, run.output
    failed, found = json.loads(out.read_text())["hands"]
    assert failed["problem"].startswith("A failed: RuntimeError: mine")
    assert "hands.py" in failed["problem"]
    assert (failed["right"], found["right"], found["problem"]) == (False, True, "")


@pytest.mark.slow
def test_an_outsider_that_ends_its_process_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "hands.py"
    body = "    def live(self, dt):\n        import os\n        os._exit(0)\n"
    path.write_text(
        _HEAD + "@hand('good', dialects='unitree_go')\nclass A(ReferenceService):\n" + body
    )
    with pytest.raises(ConformanceError, match="ended its worker process"):
        list(outsiders.try_all(str(path), 1, jobs=1))


# -------------------------------------------------------------------- good hands, many hands


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "dex1-1/unitree_go:lighter+predicts-100+servo-own",  # starts from rest between two samples
        "dex1-1/unitree_go:faster+sags-down",  # falls while it is limp
        "dex1-1/unitree_go:backlash-more+top-speed-4.5+latency-20",
        "dex1-1/unitree_go:slower+predicts-150+pauses",  # no state at the end of a step
        "dex1-1/unitree_go:lighter+top-speed-4.5+pauses",  # q changes most over a pause of states
        "dex1-1/unitree_go:backlash-more+soft-start+pauses+latency-20",  # a jerk in the play
        "dex1-1/unitree_go:sticky+noise-q-wide+predicts-100+servo-stiff",  # hardly gives way
        "dex1-1/unitree_actuator:backlash-more+soft-start+pauses+sags-down",
        "dex3-1/dex3:predicts-150",
        "dex3-1/dex3:state-late-10+pauses",
        "dex5-1/dex5:brake-release-fast+counts-16384+pauses+state-late-10",
        "brainco-revo2/brainco:backlash+counts-16384+jitter-5+state-late-10",
        "brainco-revo2/brainco:brake-relax+soft-stops+predicts-100+sags-down",  # gives back 3 %
        "inspire-dfx/inspire_dfx:backlash+heavier+predicts-150",
        "dex1-1/unitree_actuator:slower+noise-q-wide+predicts-100+state-late-10",  # hides a torque
        "dex1-1/unitree_go:noise-q-wide+predicts-150+servo-stiff",  # hides that a target is held
        "dex3-1/dex3:backlash-more+lighter+counts-4096+latency-20",  # torque follows commands late
        "inspire-dfx/inspire_dfx:brake-release+soft-start+latency-20",  # returns when released
    ],
)
def test_good_hands_that_once_failed_pass(name: str) -> None:
    trial = try_generated(parse(name))
    assert (trial.failed, trial.warned) == ((), ()), name


def digest_of_the_code() -> str:
    """What trials depend on: those of other code are not gone on with."""
    folders = ("conformance", "dexkit", "drivers", "emulators", "traces")
    files = (f for folder in folders for f in (ROOT / folder).rglob("*") if f.is_file())
    code = sorted(f for f in files if f.suffix in {".py", ".toml"})
    return hashlib.sha256(b"".join(f.name.encode() + f.read_bytes() for f in code)).hexdigest()


@pytest.mark.soak
def test_a_trial_of_all_models(cache: pytest.Cache) -> None:
    """Bounded: every class, dialect and good deviation several times. The score is reported.

    It takes two to three hours: one that was stopped is gone on with, if the code is the same.
    """
    file = cache.mkdir("trials") / f"{digest_of_the_code()}.jsonl"
    trial = Campaign(1, file)
    hands = generated.sample(400, 1, dialects()) + generated.sample_good(400, 1, dialects())
    assert len(list(trial.run(hands))) == 800
    file.unlink()
    print(json.dumps(trial.as_dict()["score"], indent=2))
    assert [t.name for t in trial.trials if t.errors] == []
    assert [(t.name, t.failed + t.warned) for t in trial.blamed] == []
