"""``dexkit check``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from dexkit.cli import main
from dexkit.conformance.kit.requirements import catalogue
from dexkit.traces import sample_path


def check(*arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        main(["check", *map(str, arguments)])
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.mark.parametrize("name", ["dex1_pick_place", "dex1_idle_then_startle", "dex1_legacy_v1_1"])
def test_good_recording_passes(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(sample_path(name)) == 0
    out = capsys.readouterr().out
    assert "PASS: every MUST that could be judged is met" in out
    assert "(-v shows why)" in out


def test_recording_with_a_dropout_fails_with_an_explanation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("r.json", "r.xml", "r.html")]
    code = check(
        sample_path("dex1_hand_dropout"),
        *("--result", files[0], "--junit", files[1], "--html", files[2]),
    )
    assert code == 1
    out = capsys.readouterr().out
    assert "DEX1-RATE-03 (MUST) left: fail" in out
    assert "rt/dex1/left/state at 9.49" in out
    assert json.loads(files[0].read_text())["overall"] == "fail"
    suite = ElementTree.parse(files[1]).getroot()
    failures = suite.findall("./testcase/failure")
    assert (suite.get("failures"), len(failures)) == ("1", 1)
    assert "never longer than 0.1 s" in (failures[0].text or "")
    assert "Fail" in files[2].read_text()


def test_one_side_can_be_judged_alone() -> None:
    assert check(sample_path("dex1_hand_dropout"), "--side", "right") == 0


def test_a_genuine_dex3_session_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(sample_path("dex3_pinch")) == 0
    out = capsys.readouterr().out
    assert "DEX3-START-01" in out
    assert "DEX1" not in out


def test_check_refuses_a_dialect_that_is_not_in_the_recording(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert check(sample_path("dex3_pinch"), "--dialect", "unitree_go") == 2
    assert "rt/dex3/left/state" in capsys.readouterr().err


def test_file_that_is_no_recording_has_exit_code_2(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"not a recording")
    assert check(path) == 2
    assert check(tmp_path / "missing.mcap") == 2


def test_check_without_a_verdict_does_not_pass(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(sample_path("dex1_pick_place"), "--require", "DEX1-MOVE") == 2
    assert "nothing was judged, which is not a pass" in capsys.readouterr().err


def test_check_judges_only_the_selected_requirements(capsys: pytest.CaptureFixture[str]) -> None:
    chosen = ("--require", "DEX1-RATE", "--require", "DEX1-FIELD-08", "--level", "must")
    assert check(sample_path("dex1_pick_place"), *chosen) == 0
    out = capsys.readouterr().out
    assert "DEX1-RATE-01" in out
    assert "DEX1-FIELD-08" not in out
    every = catalogue("dex1-1")
    assert f"(2 of {len(every)} requirements: 2 pass)" in out
    assert check(sample_path("dex1_pick_place"), "--require", "DEX7") == 2
    assert (
        check(sample_path("dex1_pick_place"), "--require", "DEX1-FIELD-08", "--level", "must") == 2
    )


def test_the_selection_is_listed_without_a_recording(capsys: pytest.CaptureFixture[str]) -> None:
    assert check("--list", "--require", "DEX3-SENS") == 0
    rows = [r for r in capsys.readouterr().out.splitlines() if r.startswith("DEX3-SENS")]
    assert len(rows) >= 4
    assert any("phase:squeeze" in r and r.endswith("pressure") for r in rows)
    assert check(sample_path("dex3_pinch"), "--list") == 0
    assert "DEX1" not in capsys.readouterr().out
    assert check() == 2
    assert "which recording is to be judged" in capsys.readouterr().err


def test_check_applies_the_claims_of_a_vendor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    claims, out = tmp_path / "capabilities.toml", tmp_path / "r.json"
    claims.write_text('[hand]\nname = "X"\n[claims]\nvelocity = true\n')
    junit = tmp_path / "r.xml"
    sample = sample_path("dex1_pick_place")
    assert check(sample, "--capabilities", claims, "--result", out, "--junit", junit) == 0
    data = json.loads(out.read_text())
    verdicts = {r["id"]: r["verdict"] for r in data["results"]}
    levels = {r["id"]: r["requirement"]["level"] for r in data["results"]}
    assert (verdicts["DEX1-FIELD-04"], levels["DEX1-FIELD-04"]) == ("pass", "MUST")
    assert verdicts["DEX1-FORCE-03"] == "not claimed"
    assert data["claims"]["force"] is False
    suite = ElementTree.parse(junit).getroot()
    assert "is not claimed" in ElementTree.tostring(suite, "unicode")
    claims.write_text('[hand]\nmodel = "dex3-1"\n')
    assert check(sample, "--capabilities", claims) == 2
    assert "about a dex3-1" in capsys.readouterr().err


def test_verbose_lists_requirements_without_a_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    assert check(sample_path("dex1_pick_place"), "-v") == 0
    out = capsys.readouterr().out
    assert "DEX1-WDOG-01 left and right: needs the stimulus 'silence'" in " ".join(out.split())


def test_unwritable_result_file_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    name = "/no/such/directory/r.json"
    assert check(sample_path("dex1_pick_place"), "--require", "DEX1-RATE", "--result", name) == 2
    assert f"error: cannot write {name}: No such file or directory" in capsys.readouterr().err


_NUMPY = tuple(map(int, np.__version__.split(".")[:2]))
_UNUSED = (
    *("cyclonedds", "pytest", "mcap.writer", "dexkit.dds", "dexkit.service"),
    # np.unique of numpy 2.4 needs it
    *(("numpy.ma",) if _NUMPY < (2, 4) else ()),
    *("dexkit.teleop", "dexkit.drivers", "dexkit.emulators", "dexkit.backends"),
    *("dexkit.conformance.faults", "dexkit.conformance.kit.live", "dexkit.conformance.usb.run"),
    *("dexkit.conformance.report.html", "dexkit.traces.recorder"),
    *("dexkit.messages.unitree_go", "dexkit.messages.unitree_hg"),
)


def test_check_imports_no_unneeded_modules() -> None:
    code = (
        "import sys\nfrom dexkit.cli import main\ntry:\n    main()\nexcept SystemExit as end:\n"
        f"    print('loaded', end.code, [m for m in {_UNUSED!r} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "check", str(sample_path("dex3_pinch"))],
        capture_output=True,
        text=True,
    )
    assert done.stdout.splitlines()[-1] == "loaded 0 []", done.stdout + done.stderr
