"""Test what a run shows of whether q is measured."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.claims import Claims
from dexkit.conformance.layers import recording_of
from dexkit.conformance.measured_q import (
    Confidence,
    Finding,
    MeasuredQ,
    Observation,
    measured_q,
    solved,
)
from dexkit.conformance.mutants.generated import parse
from dexkit.conformance.mutants.trials import plan_for
from dexkit.conformance.recording import Recording
from dexkit.conformance.report.html import render
from dexkit.conformance.report.markdown import render_markdown
from dexkit.conformance.report.terminal import print_result
from dexkit.conformance.result_file import parse_result, read_json
from dexkit.conformance.run_record import recorded_claims, run_record
from dexkit.conformance.virtual import run_virtual
from dexkit.console import Console
from dexkit.errors import UsageError
from dexkit.hand import Side
from tests.each import each
from tests.report_helpers import result_of_every_kind

PHASES = frozenset({"step", "squeeze", "release", "nudge", "stiffness", "limp", "soft-grip"})
GOOD = "dex1-1/unitree_go:noise-q-small"
ECHO = "dex1-1/unitree_go:q-echo@both,all,always"


@cache
def recorded(name: str) -> Recording:
    """A generated pair of grippers, the right one with an object, on the virtual clock."""
    hand = parse(name)
    plan = replace(plan_for(hand.dialect.name), phases=PHASES)
    return recording_of(run_virtual(plan, hand.service()), hand.dialect.name, plan.sides)


def findings(found: MeasuredQ) -> dict[str, Finding]:
    return {o.name: o.finding for o in found.observations}


def test_measured_position_is_recognised() -> None:
    free, gripping = measured_q(recorded(GOOD))
    assert (free.side, gripping.side) == ("left", "right")
    assert free.confidence is Confidence.MEDIUM
    assert findings(free)["object"] is Finding.NOT_TRIED
    assert findings(free)["torque"] is Finding.SHOWS
    assert gripping.confidence is Confidence.HIGH
    assert set(findings(gripping).values()) == {Finding.SHOWS}


def test_echoed_command_is_not_taken_for_a_measurement() -> None:
    free, gripping = measured_q(recorded(ECHO))
    assert free.confidence is Confidence.NONE
    assert "manual test" in free.sentence()
    assert gripping.confidence is Confidence.CONTRADICTED
    assert findings(gripping)["object"] is Finding.CONTRADICTS


def test_locked_fingers_of_an_empty_hand_are_not_taken_for_stopped_ones() -> None:
    phases = frozenset({"step", "squeeze", "lock", "mixed"})
    plan = replace(plan_for("dex3", sides=tuple(Side)), phases=phases)
    trace = run_virtual(plan, parse("dex3-1/dex3:latency-5").service())
    empty, gripping = measured_q(recording_of(trace, "dex3", plan.sides))
    assert findings(empty)["object"] is Finding.NOT_TRIED
    assert findings(gripping)["object"] is Finding.SHOWS


def test_recording_that_no_run_of_the_kit_made_has_no_finding() -> None:
    assert measured_q(replace(recorded(GOOD), stimulus=None)) == ()


def example() -> MeasuredQ:
    return MeasuredQ(
        "left",
        (
            Observation("object", "an object", Finding.SHOWS, "37% of the stroke short"),
            Observation("mass", "one mass", Finding.NO_SIGN),
            Observation("limp", "zero gains", Finding.NOT_TRIED),
        ),
    )


def test_one_sign_is_low_confidence_and_the_object_medium() -> None:
    assert example().confidence is Confidence.MEDIUM
    assert example().sentence() == (
        "left: q is measured: medium confidence (1 of 2 observations: object)"
    )
    noise = MeasuredQ("left", (Observation("noise", "noise", Finding.SHOWS),))
    assert noise.confidence is Confidence.LOW


def test_result_file_and_reports_have_the_finding(tmp_path: Path) -> None:
    result = replace(result_of_every_kind(), measured_q=(example(),), manual_test="held <by hand>")
    path = tmp_path / "result.json"
    result.write_json(path)
    back = read_json(path)
    assert back.measured_q == (example(),)
    assert back.manual_test == "held <by hand>"
    page = render(back)
    assert "Is q measured?" in page
    assert "37% of the stroke short" in page
    assert "held &lt;by hand&gt;" in page
    assert example().sentence() in render_markdown(back).replace("\\", "")
    output = StringIO()
    print_result(back, Console(file=output, width=200))
    assert example().sentence() in output.getvalue()
    older = json.loads(path.read_text())
    del older["measured_q"]
    assert parse_result(older, path).measured_q == ()
    older["measured_q"] = {"hands": [{"side": "left"}], "manual_test": ""}
    with pytest.raises(UsageError, match="confidence"):
        parse_result(older, path)


def test_manual_test_is_claimed_and_kept_with_the_recording() -> None:
    text = '[manual_test]\nq_is_measured = " 2026-11-20: held, 0.01 rad "'
    claims = Claims.parse(text)
    assert claims.manual_test == "2026-11-20: held, 0.01 rad"
    run = run_record(
        subject={"backend": "x"},
        dialect="unitree_go",
        sides=(Side.LEFT,),
        phases=(),
        rounds=1,
        requirements=(),
        claims=claims,
    )
    assert recorded_claims(run) == claims


@each("text", ["manual_test = 1", "[manual_test]\nheld = 'x'", "[manual_test]\nq_is_measured = 1"])
def test_invalid_manual_test_is_an_error(text: str) -> None:
    with pytest.raises(UsageError, match=r"\[manual_test\] is not understood"):
        Claims.parse(text)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_linear_equations_are_solved(seed: int, size: int) -> None:
    draw = np.random.default_rng(seed)
    matrix, wanted = draw.normal(size=(size, size)), draw.normal(size=size)
    rows = np.column_stack([matrix, matrix @ wanted]).tolist()
    found = solved(rows)
    assert found is not None
    scale = float(np.linalg.cond(matrix))
    assert np.allclose(found, wanted, atol=1e-12 * scale * (1 + abs(wanted).max()))


def test_singular_equations_have_no_solution() -> None:
    assert solved([[1.0, 1.0, 2.0], [2.0, 2.0, 4.0]]) is None
