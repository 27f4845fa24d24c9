"""Test the suite as users run it: pytest options, and live runs on DDS."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from dexkit.conformance.faults import any_model, plan_for
from dexkit.conformance.faults.registry import mix
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit import suite_run
from dexkit.conformance.kit.backend_processes import RigOptions
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.known_backends import EXTERNAL
from dexkit.conformance.kit.live import LiveOptions, record_run
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import Level, select
from dexkit.conformance.kit.requirements import catalogue as requirements
from dexkit.conformance.kit.results import Overall, RunResult
from dexkit.conformance.kit.selection import length, quick
from dexkit.conformance.kit.suite_run import SuiteOptions
from dexkit.conformance.stimuli import CommandSession, phases_for
from dexkit.conformance.virtual import run_virtual
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.conformance.virtual.on_dds import ServiceOnDds
from dexkit.errors import ConformanceError, TopicConflict, UnknownBackend, UsageError
from dexkit.hand import Side
from dexkit.models import BUILT_IN, dialect
from dexkit.robots import ROBOTS
from dexkit.service.realtime import real_time
from dexkit.traces import Recorder, open_trace, sample_path
from tests.conformance_helpers import (
    SUITE,
    copy_of,
    failed,
    failed_or_excused,
    short_run,
    with_beats,
)
from tests.dds_helpers import DdsNode, free_domain
from tests.each import each
from tests.reproduction_helpers import checked
from tests.slow_hand import SLOW

ROOT = Path(__file__).parent.parent

ATTEMPTS = 5
"""Runs of a suite, about 20 s each on an idle machine, which a busy one may leave inconclusive.

An idle machine needs one. A command that is late does not reach the gripper, and what it should
have shown is left open: it was not judged, so no record can stand for it, and the report says to
run it again. A test asks for each verdict, so it does that, and fails after the last run.
"""


def suite(*arguments: object, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SUITE, "-q", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout,
        env={**os.environ, "NO_COLOR": "1"},
    )


# --------------------------------------------------------------------------------- options

IN_ONE_PROCESS = """
import contextlib, io, json, sys
import pytest
ran = []
for arguments in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = pytest.main(arguments)
    ran.append((int(code), out.getvalue(), err.getvalue()))
print(json.dumps(ran))
"""
SIM = ("--backend", "sim-dex1")
ENDS = [
    # arguments, exit code, and what standard output and standard error say
    (("-k", "DEX1-RATE", "-rs"), 2, ["which is not a pass", "--backend ezgripper"], ""),
    (("--side", "left"), 4, [], "--side without --backend"),
    ((*SIM, "--trace", "missing.mcap"), 4, [], "no such file: missing.mcap"),
    ((*SIM, "--result", "/no/such/r.json"), 4, [], "cannot write /no/such/r.json"),
    ((*SIM, "-n", "2"), 4, [], "pytest-xdist's -n cannot divide it"),
    (
        (*SIM, "-k", "nothing-is-called-so"),
        2,
        ["Nothing was judged, which is not a pass. No requirement was left"],
        "",
    ),
    (
        (*SIM, "-o", "python_files=check_*.py"),
        2,
        ["pytest found none of the suite's tests", "add -c /dev/null"],
        "",
    ),
    (
        (*SIM, "--side", "left", "--require", "DEX1-RATE", "--collect-only"),
        0,
        [f"test_requirement[{i}-left]" for i in ("DEX1-RATE-01", "DEX1-RATE-03")],
        "",
    ),
    (("--list", "--capabilities", "wrong.toml"), 4, [], "Object contains unknown field speed"),
    (("--list", "--capabilities", "right.toml", "--require", "DEX1-FIELD"), 0, [], ""),
    # the last one: its plug-in shortens discovery in the whole process
    (
        (
            *("-p", "tests.short_discovery", "--backend", "external", "--quick"),
            *("--side", "left", "--domain", "DOMAIN"),
        ),
        2,
        ["publishes rt/dex1/left/state"],
        "",
    ),
]


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str, str]]:
    """Exit code and output of each of these; one process saves ten starts of the suite."""
    folder = tmp_path_factory.mktemp("claims")
    (folder / "right.toml").write_text("[claims]\nvelocity = true\n")
    (folder / "wrong.toml").write_text("[claims]\nspeed = true\n")
    told = {"DOMAIN": str(free_domain())} | {f.name: str(f) for f in folder.iterdir()}
    ran = [[*SUITE[3:], "-q", "conformance/", *(told.get(w, w) for w in r[0])] for r in ENDS]
    done = subprocess.run(
        [sys.executable, "-c", IN_ONE_PROCESS, json.dumps(ran)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "NO_COLOR": "1"},
    )
    assert done.returncode == 0, done.stderr
    found: list[tuple[int, str, str]] = json.loads(done.stdout)
    return found


@each("number", range(len(ENDS)))
def test_what_judges_nothing_has_a_reason_and_an_exit_code(
    number: int, ends: list[tuple[int, str, str]]
) -> None:
    _, code, printed, error = ENDS[number]
    found, out, err = ends[number]
    assert found == code, out + err
    assert all(text in out for text in printed), out
    assert error in err
    assert "passed" not in out


def test_selection_is_listed_without_hand(ends: list[tuple[int, str, str]]) -> None:
    (out,) = (e[1] for e, r in zip(ends, ENDS, strict=True) if "right.toml" in r[0])
    lines = out.splitlines()
    rows = [line.split("  ") for line in lines if line.startswith("DEX")]
    expected = [r for r in requirements() if r.id.startswith("DEX1-FIELD")]
    assert [row[0] for row in rows] == [r.id for r in expected]
    assert lines[-1] == f"{len(rows)} requirements"
    by_id = {row[0]: " ".join(filter(None, row)).split() for row in rows}
    assert by_id["DEX1-FIELD-04"][1] == "MUST"
    assert by_id["DEX1-FIELD-04"][-1] == "velocity"
    for r in expected:
        assert r.confidence in " ".join(by_id[r.id])
        assert r.needs in by_id[r.id]


@pytest.mark.parametrize("name", [*(m.name for m in BUILT_IN), *ROBOTS])
def test_quick_run_has_musts_of_its_phases(name: str) -> None:
    every = requirements(name, None)
    chosen = quick(every)
    planned = frozenset(under_test(name).quick_phases)
    assert phases_for(chosen) == planned
    assert "late-joiner" in planned  # a client that never gets a state is the worst that happens
    assert "replay" not in planned
    assert {r.level for r in chosen} == {Level.MUST}
    assert any(r.area == "Motion" for r in chosen)
    # 15 s, less 4 s for start and judgement; a G1 has 29 joints, one moved after the other
    assert length(name, planned) <= (14.0 if name == "g1" else 11.0)
    musts = [r for r in every if r.level is Level.MUST and r.layer != "usb"]
    assert {r.id for r in musts if phases_for([r]) <= planned} <= {r.id for r in chosen}
    assert all(set(r.phases) <= planned for r in chosen)
    assert quick([r for r in every if r.level is not Level.MUST]) == ()


@pytest.mark.parametrize("name", [m.name for m in BUILT_IN])
def test_a_default_run_of_hands_is_short_enough(name: str) -> None:
    """90 s, less 4 s for start and judgement, and 9 s in which the slowest hand arrives."""
    stimuli = length(name, phases_for(requirements(name)))
    session = CommandSession.default(name).duration if under_test(name).session else 0.0
    assert stimuli + session <= 77.0


def test_length_of_stimulus_equals_length_of_run() -> None:
    plan = replace(plan_for(), phases=frozenset({"step", "nan", "squeeze"}), session=None)
    recording = Recording.decode(run_virtual(plan, ReferenceService))
    assert length("dex1-1", plan.phases) == pytest.approx(recording.duration, rel=0.3)


def test_suite_options_have_their_defaults() -> None:
    options = SuiteOptions.make(backend="ezgripper")
    assert options.sides == (Side.LEFT, Side.RIGHT)
    assert options.domain is None
    assert options.objects == {Side.RIGHT: 37.0}
    assert options.rig(0).subject["device"] == "emulated"
    pseudo = SuiteOptions.make(backend="ezgripper", devices=["/dev/pts/7"])  # as emulators make
    assert pseudo.rig(0).subject["device"] == "emulated"
    real = SuiteOptions.make(backend="ezgripper", devices=["/dev/ttyUSB0"])
    assert real.rig(0).subject["device"] == "left /dev/ttyUSB0"
    assert (real.sides, real.domain, real.objects) == ((Side.LEFT,), 0, {})
    outside = SuiteOptions.make(backend="external", side="right", objects=["right=25"])
    assert (outside.domain, outside.objects) == (0, {Side.RIGHT: 25.0})
    assert SuiteOptions.make(backend="sim-dex1", objects=["none"]).objects == {}


def test_contradictory_options_are_refused() -> None:
    with pytest.raises(UsageError, match="one --device for two hands"):
        SuiteOptions.make(backend="ezgripper", side="both", devices=["/dev/ttyUSB0"])
    with pytest.raises(UsageError, match="a device is needed for each side"):
        SuiteOptions.make(backend="ezgripper", side="both", devices=["left=/dev/ttyUSB0"])
    with pytest.raises(UsageError, match="not under test"):
        SuiteOptions.make(backend="external", side="left", objects=["right=30"])
    with pytest.raises(UsageError, match="at 5 to 60 % of opening"):
        SuiteOptions.make(backend="external", objects=["80"])
    with pytest.raises(UsageError, match="not a number"):
        SuiteOptions.make(backend="external", objects=["soft"])
    with pytest.raises(UsageError, match="external starts nothing"):
        SuiteOptions.make(backend="external", settings=["a=b"])
    with pytest.raises(UsageError, match="no requirement begins with 'DEX9'"):
        SuiteOptions.make(backend="external", require=["DEX9"])
    with pytest.raises(UnknownBackend):
        SuiteOptions.make(backend="unknown")


# ------------------------------------------------------------------------------- live runs


def test_a_repeated_run_says_what_was_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is recorded here: the recordings are a run on the virtual clock."""
    trace = copy_of(short_run())
    key = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    begin = trace.rows[key][0][0] + round(2.5e9)
    good = Recording.decode(trace)
    trace.rows[key] = [r for r in trace.rows[key] if not begin <= r[0] < begin + 200_000_000]
    recordings = [with_beats(trace, [begin]), good]
    monkeypatch.setattr("dexkit.conformance.kit.live.record_run", lambda *args, **kwargs: True)
    monkeypatch.setattr("dexkit.traces.open_trace", lambda path: SimpleNamespace(damage=()))
    monkeypatch.setattr(suite_run, "recording_of", lambda *args: recordings.pop(0))
    said: list[str] = []
    options = SuiteOptions.make(backend="sim-dex1", side="left", require=["DEX1-RATE-03"])
    result = suite_run.run_suite(options, said.append)
    assert (result.overall, recordings) == (Overall.PASS, [])
    (again,) = [text for text in said if "once more" in text]
    assert again.startswith("this machine was too busy to be fair to the hand: DEX1-RATE-03 (")
    assert "late by 149 ms in all" in again


def run_live(
    service: type[ReferenceService], prefix: str, tmp_path: Path, *, sides: tuple[Side, ...]
) -> RunResult:
    """Judge a reference or wrong hand on DDS by the live suite."""
    domain, chosen = free_domain(), dialect("unitree_go")
    wanted = select(requirements(), prefixes=[prefix])
    path = tmp_path / "run.mcap"
    rig = RigOptions(EXTERNAL, sides, chosen, domain)
    with ServiceOnDds(service(chosen, sides, {}), domain):
        assert record_run(LiveOptions(rig, phases_for(wanted)), path)
    return judge(Recording.decode(open_trace(path), sides=sides), requirements=wanted)


def test_reference_hand_passes_on_dds(tmp_path: Path) -> None:
    result = run_live(ReferenceService, "DEX1-LIFE-01", tmp_path, sides=(Side.LEFT,))
    assert str(result.overall) == "pass"
    if Path("/proc/self/schedstat").exists():
        # the hand's process is on this machine: this one
        stimulus = Recording.decode(open_trace(tmp_path / "run.mcap")).stimulus
        assert stimulus is not None
        assert stimulus.waits is not None
        assert {p.pid for p in stimulus.waits.processes} == {os.getpid()}
        assert {p.subjects for p in stimulus.waits.processes} == {("left",)}


def test_hand_that_waits_for_commands_fails_on_dds(tmp_path: Path) -> None:
    result = run_live(
        mix(any_model.SilentUntilCommanded, ReferenceService),
        "DEX1-START",
        tmp_path,
        sides=(Side.LEFT,),
    )
    assert failed_or_excused(result) == {("DEX1-START-01", "left")}


def test_hand_that_requests_transient_local_fails_on_dds(tmp_path: Path) -> None:
    result = run_live(
        mix(any_model.DemandsHistory, ReferenceService), "DEX1-QOS", tmp_path, sides=(Side.LEFT,)
    )
    assert failed(result) == {("DEX1-QOS-01", "left")}


def test_missing_hand_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dexkit.conformance.kit.live.DISCOVERY_TIMEOUT", 0.3)  # there is no hand
    rig = RigOptions(EXTERNAL, (Side.LEFT,), dialect("unitree_go"), free_domain())
    with pytest.raises(ConformanceError, match="publishes rt/dex1/left/state") as caught:
        record_run(LiveOptions(rig, frozenset({"step"})), tmp_path / "run.mcap")
    assert "dexkit doctor" in caught.value.hint


def test_error_names_dialect_of_the_hand(tmp_path: Path) -> None:
    rig = RigOptions(EXTERNAL, (Side.LEFT,), dialect("unitree_go"), free_domain())
    legacy = dialect("unitree_actuator")
    with DdsNode(rig.domain, "lo") as other:
        other.writer(legacy.topics(Side.LEFT)[1], legacy.state_type)
        with pytest.raises(ConformanceError) as caught:
            record_run(LiveOptions(rig, frozenset({"step"})), tmp_path / "run.mcap")
    assert "--dialect unitree_actuator" in caught.value.hint


def test_recording_of_nothing_is_not_judged(tmp_path: Path) -> None:
    """Without discovery it cannot tell whether a hand was there."""
    path = tmp_path / "run.mcap"
    with Recorder(path):
        pass
    result = judge(
        Recording.decode(open_trace(path), dialect_name="unitree_go", sides=(Side.LEFT,))
    )
    assert str(result.overall) == "inconclusive"
    assert failed(result) == set()
    assert result.stage == {"left": "no participant"}


def test_suite_refuses_to_start_beside_another_client(tmp_path: Path) -> None:
    domain, chosen = free_domain(), dialect("unitree_go")
    rig = RigOptions(EXTERNAL, (Side.LEFT,), chosen, domain)
    with DdsNode(domain, "lo") as other:
        other.writer("rt/dex1/left/cmd", chosen.cmd_type)
        with pytest.raises(TopicConflict, match="already publishes rt/dex1/left/cmd"):
            record_run(LiveOptions(rig, frozenset()), tmp_path / "run.mcap")


def test_service_that_does_not_start_is_an_error(tmp_path: Path) -> None:
    rig = RigOptions(
        "sim-dex1", (Side.LEFT,), dialect("unitree_go"), free_domain(), settings=("colour=red",)
    )
    with pytest.raises(ConformanceError, match="ended before it was ready") as caught:
        record_run(LiveOptions(rig, frozenset()), tmp_path / "run.mcap")
    assert "colour" in caught.value.hint


def test_stopped_run_leaves_no_process(tmp_path: Path) -> None:
    rig = RigOptions("sim-dex1", (Side.LEFT,), dialect("unitree_go"), free_domain())
    stop = threading.Event()

    def report(text: str) -> None:
        if text.startswith("listening"):
            stop.set()

    assert not record_run(
        LiveOptions(rig, frozenset()), tmp_path / "run.mcap", report=report, stop=stop
    )
    left = subprocess.run(
        ["pgrep", "-f", f"--domain {rig.domain} "], capture_output=True, text=True
    )
    assert left.stdout == ""


def test_live_run_has_the_priority_of_the_service_it_judges(tmp_path: Path) -> None:
    """A service with real-time priority leaves an ordinary process too little."""
    scheduler = getattr(os, "sched_getscheduler", lambda pid: None)  # Linux has one
    before = scheduler(0)
    with real_time() as granted:
        expected = scheduler(0)
    assert not granted or expected == os.SCHED_RR
    rig = RigOptions("sim-dex1", (Side.LEFT,), dialect("unitree_go"), free_domain())
    stop = threading.Event()
    seen = []

    def report(text: str) -> None:
        seen.append(scheduler(0))
        stop.set()

    record_run(LiveOptions(rig, frozenset()), tmp_path / "run.mcap", report=report, stop=stop)
    assert set(seen) == {expected}
    assert scheduler(0) == before


@pytest.mark.parametrize(
    "signum", [pytest.param(signal.SIGTERM, marks=pytest.mark.soak), signal.SIGINT]
)
def test_signal_to_suite_ends_the_service_cleanly(tmp_path: Path, signum: signal.Signals) -> None:
    recording = tmp_path / "run.mcap"
    run = subprocess.Popen(
        [
            *(*SUITE, "conformance/"),
            *("--backend", SLOW[0], "--side", "left", "--recording", str(recording)),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    assert run.stdout is not None
    seen = ""
    for line in run.stdout:
        seen += line
        if "moving slowly" in line or "large steps" in line:
            run.send_signal(signum)
            break
    seen += run.communicate(timeout=60)[0]
    assert run.returncode == 128 + signum, seen
    assert f"the run was stopped ({signum.name}); nothing was judged, which is not a pass" in seen
    # the record is written once every process has ended as it was asked to
    (words,) = open_trace(recording).metadata["dexkit.tools"].items()
    assert words[0].startswith(f"dexkit serve {SLOW[0]}")
    assert '"exchanges"' in words[1], words  # its counters, when it has braked


@pytest.mark.soak
def test_emulated_ezgripper_reports_the_force_of_a_squeeze() -> None:
    """On an idle machine: a service that commands reach late brakes, and lets go."""
    wanted = [word for i in (1, 3) for word in ("--require", f"DEX1-FORCE-0{i}")]
    run = suite("conformance/", "--backend", "ezgripper", "--side", "right", *wanted)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "2 pass" in run.stdout


def test_emulated_ezgripper_passes_from_the_command_line(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("r.json", "r.html", "r.mcap", "junit.xml")]
    # those that a busy machine leaves open are left out: a late command never drives the gripper
    verdicts = {
        "DEX1-TOPIC-01": "pass",
        "DEX1-FIELD-01": "pass",
        "DEX1-FIELD-03": "pass",
        "DEX1-FORCE-02": "pass",
        "DEX1-FORCE-04": "pass",
    }
    wanted = [word for name in verdicts for word in ("--require", name)]
    for _ in range(ATTEMPTS):
        for file in files:
            file.unlink(missing_ok=True)
        run = suite(
            "conformance/", "--backend", "ezgripper", "--side", "right", *wanted,
            "--trace", sample_path("dex1_pick_place"), "--result", files[0], "--report", files[1],
            "--recording", files[2], "--junitxml", files[3],
        )  # fmt: skip
        # inconclusive: the gripper's process stood still, and commands were too old for it
        if run.returncode != Overall.INCONCLUSIVE.exit_code:
            break
    assert run.returncode == 0, run.stdout + run.stderr
    assert "PASS: every MUST that could be judged is met" in run.stdout
    result = json.loads(files[0].read_text())
    assert {r["id"]: r["verdict"] for r in result["results"]} == verdicts
    assert files[1].read_text().startswith("<!doctype html>")
    assert "DEX1-FORCE-04-right" in files[3].read_text()
    # the recording alone gives the same verdicts, with all of their data
    again = checked(files[2], tmp_path / "again.json")
    found = {r["id"]: r for r in again["results"]}
    assert [found[r["id"]] for r in result["results"]] == result["results"]
    assert again["run"] == result["run"]
    assert json.loads(result["run"]["requirements"]) == [r["id"] for r in result["results"]]
