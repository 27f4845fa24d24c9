"""Result files of version 2 can still be read, reported and compared.

``tests/results_v2`` holds files that the dexkit of that version wrote: of a hand on a busy and on
an overloaded machine, of a robot, and of a hand on USB.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.conformance.plots import Plot, PlotKind
from dexkit.conformance.report.labels import device_kind
from dexkit.conformance.result_file import read_json
from dexkit.conformance.results import VERSION, Load, Overall, RunResult, Verdict

FOLDER = Path(__file__).parent / "results_v2"
NAMES = ("hand_busy", "hand_too_busy", "robot", "usb")


def read(name: str) -> RunResult:
    return read_json(FOLDER / f"{name}.json")


def test_verdicts_and_texts_are_those_of_the_file() -> None:
    for name in NAMES:
        document = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
        assert document["version"] == 2
        result = read(name)
        assert str(result.overall) == document["overall"], name
        assert device_kind(result) == "simulated", name
        for entry, told in zip(result.results, document["results"], strict=True):
            for key in ("figure", "observed", "reason", "cause", "blocked_by"):
                assert getattr(entry, key) == told[key], (name, key)
            assert str(entry.verdict) == told["verdict"], name


def test_the_load_of_the_machine_is_read_from_the_reason() -> None:
    for name, load, overall in (
        ("hand_busy", Load.BUSY, Overall.FAIL),
        ("hand_too_busy", Load.TOO_BUSY, Overall.INCONCLUSIVE),
    ):
        result = read(name)
        gap = next(r for r in result.results if r.requirement.id == "DEX1-RATE-03")
        assert (gap.disturbance.load, gap.retry) == (load, True), name
        assert gap.plots == (Plot(PlotKind.GAP), Plot(PlotKind.POSITION)), name
        assert (result.overall, result.disturbed_by) == (overall, [gap]), name
        others = [r for r in result.results if r is not gap]
        assert {(r.disturbance.load, r.retry) for r in others} == {(Load.NONE, False)}, name


def test_subject_body_of_version_2_is_read_as_robot() -> None:
    result = read("robot")
    assert set(result.stage) == {"robot"}
    assert {r.side for r in result.results} == {"robot"}
    assert {r.requirement.layer for r in result.results} == {"robot"}
    bad = next(r for r in result.results if r.verdict is Verdict.FAIL)
    assert len(bad.joints) == 1
    assert "right_knee" in bad.observed


def test_a_usb_result_names_its_joints_and_plots() -> None:
    bad = next(r for r in read("usb").results if r.verdict is Verdict.FAIL)
    assert bad.joints == (0,)
    assert PlotKind.ANSWERS in {plot.kind for plot in bad.plots}


def test_result_of_version_2_is_reported_compared_and_written_as_version_3(tmp_path: Path) -> None:
    for name in NAMES:
        result = read(name)
        result.write_json(tmp_path / "now.json")
        assert json.loads((tmp_path / "now.json").read_text())["version"] == VERSION
        assert read_json(tmp_path / "now.json").as_dict() == result.as_dict(), name
        page = tmp_path / f"{name}.html"
        args = ["report", str(FOLDER / f"{name}.json"), "--html", str(page)]
        assert CliRunner().invoke(cli, args).exit_code == 0, name
        assert "<h1>" in page.read_text(encoding="utf-8")
    same = [str(FOLDER / "hand_busy.json"), str(FOLDER / "hand_busy.json")]
    done = CliRunner().invoke(cli, ["compare", *same])
    assert done.exit_code == 0
    assert "Nowhere: all verdicts agree" in done.output


@pytest.mark.parametrize("key", ["results", "stage", "subject"])
def test_damaged_result_of_version_2_is_refused(key: str, tmp_path: Path) -> None:
    document = json.loads((FOLDER / "robot.json").read_text(encoding="utf-8"))
    document[key] = [1, {"side": 2, "requirement": 3}]
    (tmp_path / "x.json").write_text(json.dumps(document), encoding="utf-8")
    done = CliRunner().invoke(cli, ["report", str(tmp_path / "x.json")])
    assert done.exit_code != 0
    assert done.exception is not None
