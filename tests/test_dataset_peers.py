"""The comparison of programs that judge datasets: a program that fails is a row, never the end."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks.dataset_peers import Finding, Run
from benchmarks.dataset_peers.__main__ import main
from benchmarks.dataset_peers.doctor import checked, scored
from benchmarks.dataset_peers.labels import GOOD, Label, outcome
from benchmarks.dataset_peers.programs import lerobot_doctor, lerobot_lint, measured

LINT = """
import json, sys
found = [{"check": "DEAD_JOINT", "severity": "error", "episode": 1, "message": "never moved"},
         {"check": "TOO_FEW_EPISODES", "severity": "info", "episode": None, "message": "few"}]
with open(sys.argv[sys.argv.index("--json") + 1], "w") as file:
    json.dump({"findings": found}, file)
sys.exit(2)
"""


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    meta = tmp_path / "set" / "meta"
    meta.mkdir(parents=True)
    info = {"total_episodes": 2, "total_frames": 600, "fps": 30}
    (meta / "info.json").write_text(json.dumps(info))
    return meta.parent


def program(tmp_path: Path, text: str) -> str:
    script = tmp_path / "program.py"
    script.write_text(text)
    return f"{sys.executable} {script}"


def test_a_run_is_measured_and_its_findings_are_read(tmp_path: Path, dataset: Path) -> None:
    run = measured(lerobot_lint(program(tmp_path, LINT)), dataset)
    assert (run.exit, run.trouble, run.episodes, run.recorded_s) == (2, "", 2, 20.0)
    assert [(f.check, f.level, f.episode) for f in run.findings] == [
        ("DEAD_JOINT", "failure", "1"),
        ("TOO_FEW_EPISODES", "note", ""),
    ]
    assert 0 < run.cpu_s < 5 * run.wall_s
    assert 4 < run.peak_mib < 60


@pytest.mark.parametrize(
    ("text", "exit_code", "trouble"),
    [
        ("raise RuntimeError('no such column')", 1, "RuntimeError: no such column"),
        ("import os; os.kill(os.getpid(), 11)", -11, "it printed no findings"),
        ("import time; time.sleep(60)", -9, "ended after 1 s"),
        ("print('{}')", 0, "it printed no findings"),
    ],
)
def test_a_program_that_fails_is_a_row(
    tmp_path: Path, dataset: Path, text: str, exit_code: int, trouble: str
) -> None:
    run = measured(lerobot_doctor(program(tmp_path, text))[0], dataset, timeout=1.0)
    assert (run.exit, run.trouble, run.findings) == (exit_code, trouble, [])


def test_what_is_no_lerobot_dataset_is_a_row(tmp_path: Path) -> None:
    (tmp_path / "episode_0001").mkdir()
    run = measured(lerobot_lint("/nowhere/lelint"), tmp_path)
    assert (run.trouble, run.exit) == ("not run: no LeRobot dataset", None)


def test_a_program_that_is_not_there_is_a_row(dataset: Path) -> None:
    run = measured(lerobot_lint("/nowhere/lelint"), dataset)
    assert run.exit is None
    assert run.trouble.startswith("not started: ")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("action: 14% of episode 3 is consecutive identical actions (frozen)", "frozen-actions 3"),
        ("Episode 7: 2 dropped frame gap(s) at frame indices [5, 9]", "frame-gaps 7"),
        ("2 near-duplicate episode pair(s) detected: [(0, 4), (1, 5)]", "duplicate 4, duplicate 5"),
        ("1 episode(s) missing features present in episode 0: [(2, ['a'])]", "features 2"),
        ("2 episode(s) shorter than 30 frames (<1.0s): [3, 8]", "short 3, short 8"),
        ("head: Video files missing for episodes [1, 2]", "video-missing 1, video-missing 2"),
        ("head: v/episode_000012.mp4 has 9 frames, expected 20 from 1", "video-frames 12"),
        ("action[2]: 60.0% of values at minimum (0.0000)", "clipped -"),
        ("stats.json[action]: 2 dimension(s) have zero std -- NaN/Inf", "zero-std -"),
        ("VLA: no image/video features", "Training -"),
    ],
)
def test_sentences_of_the_doctor(text: str, found: str) -> None:
    messages = [{"severity": "WARN", "message": text}, {"severity": "PASS", "message": "fine"}]
    read = checked(json.dumps({"checks": [{"name": "Training", "messages": messages}]}))
    assert ", ".join(f"{f.check} {f.episode or '-'}" for f in read) == found


def test_the_doctors_summary_of_an_episode_has_several_reasons() -> None:
    text = "Episode 4: 9% of action frozen (consecutive identical); 1 action jump(s) in action"
    message = {"severity": "WARN", "message": text}
    read = checked(json.dumps({"checks": [{"name": "Per-Episode Summary", "messages": [message]}]}))
    assert [(f.check, f.episode) for f in read] == [("frozen-actions", "4"), ("action-jumps", "4")]


def test_scores_of_the_doctor() -> None:
    said = {"recommended_drops": [1], "scores": [{"ep": 0, "score": 90}, {"ep": 1, "score": 9.5}]}
    assert [(f.episode, f.text) for f in scored(json.dumps(said))] == [
        ("1", "score 9.5 of 100: drop")
    ]


@pytest.mark.parametrize(
    ("episode", "fault", "expected"),
    [
        ("1", "frozen_joint", "found"),
        ("1", "no_task", "named"),
        ("2", "no_task", ""),
        ("2", "clipped_action", "in the set"),
        ("2", GOOD, ""),
        ("1", GOOD, "named"),
        ("", "frozen_joint", "found"),
    ],
)
def test_who_has_found_what(episode: str, fault: str, expected: str) -> None:
    findings = [
        Finding("DEAD_JOINT", "failure", "1", ""),
        Finding("clipped", "warning", "", ""),
        Finding("frozen-actions", "note", "2", ""),
    ]
    run = Run("lint", Path("set"), findings=findings)
    assert outcome(Label(Path("set"), episode, fault), run) == expected
    run.trouble = "Traceback"
    assert outcome(Label(Path("set"), episode, fault), run) == "not read"


def test_the_whole_comparison(
    tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        {"dataset": "set", "episode": 0, "expect": "good", "fault": ""},
        {"dataset": "set", "episode": 1, "expect": "spoiled", "fault": "frozen_joint"},
    ]
    (tmp_path / "labels.json").write_text(json.dumps(rows))
    out = tmp_path / "out.json"
    options = ["--labels", str(tmp_path / "labels.json"), "--json", str(out)]
    assert main([*options, "--lint", program(tmp_path, LINT)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split() for line in printed if line.startswith(("frozen_joint", GOOD))] == [
        ["frozen_joint", "1", "0/0/0/1", "1/0/0/0"],
        [GOOD, "1", "0/0/0/1", "0/0/0/0"],
    ]
    saved = json.loads(out.read_text())
    assert saved["runs"][1]["findings"]["1"][0]["check"] == "DEAD_JOINT"
    assert saved["scores"]["frozen_joint"]["lerobot-lint"] == {"found": 1, "episodes": 1}
    assert {run["tool"] for run in saved["runs"]} == {"dexkit audit", "lerobot-lint"}
    assert main([]) == 2
