"""Test what a verdict says of its measured figure, its limit and the kit's own error."""

from __future__ import annotations

import math

import pytest

from dexkit.conformance.checks import Outcome
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.measurement_error import Measure, weigh
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Evidence, Result, RunResult, Verdict
from dexkit.conformance.kit.stimulus_record import RECORD, Calibration, Stimulus
from dexkit.conformance.kit.verdicts import Excuse, Judgement
from dexkit.conformance.report.card import Card, near_limits
from dexkit.conformance.report.html import render
from dexkit.conformance.virtual import MemoryTrace
from dexkit.errors import TraceUnsupported
from dexkit.hand import Side
from tests.conformance_helpers import copy_of, result_of, short_run, with_beats
from tests.each import each

BY_ID = {r.id: r for r in catalogue(None, None)}
GAP = BY_ID["DEX1-RATE-03"]  # a MUST
WARNS = BY_ID["DEX1-FIELD-08"]  # a SHOULD


class Clock:
    """A recording whose times have one error, or another one from a second on."""

    def __init__(self, error: float | None, later: float | None = None) -> None:
        self.error, self.later = error, later

    def time_error(self, begin: float, end: float) -> float | None:
        return self.error if self.later is None or begin < 1 else self.later


def judged(seconds: float, error: float | None, requirement: str = GAP.id) -> Result:
    met = seconds <= 0.1
    outcome = Outcome(met, evidence=(Evidence("t", 1.0, 0, 1.0 + seconds),)).timed(seconds, 0.1)
    return Judgement(BY_ID[requirement], Side.LEFT, Claims(), {}).run_check(
        lambda: outcome,
        lambda _: Excuse(),
        lambda o: weigh(Clock(error), o.measures, [(1.0, 1.0 + seconds)], (0.0, 9.0)),
    )


@each(
    ("seconds", "error", "verdict", "uncertain"),
    [
        (0.09, 0.002, Verdict.PASS, False),
        (0.099, 0.002, Verdict.PASS, True),
        (0.101, 0.002, Verdict.BLOCKED, True),
        (0.103, 0.002, Verdict.FAIL, False),
        # exact, and not known: as without a measure
        (0.1001, 0.0, Verdict.FAIL, False),
        (0.1001, None, Verdict.FAIL, False),
        (0.0999, None, Verdict.PASS, False),
    ],
)
def test_failure_within_the_kits_error_is_inconclusive(
    seconds: float, error: float | None, verdict: Verdict, uncertain: bool
) -> None:
    found = judged(seconds, error)
    assert found.measure is not None
    assert (found.verdict, found.measure.uncertain) == (verdict, uncertain)
    assert found.retry is found.within_error is (verdict is Verdict.BLOCKED)
    assert Card.from_results([found]).as_text().count("with a limit of") == 1
    if verdict is Verdict.BLOCKED:
        assert "fails by less than the kit's measurement error of 0.002 s" in found.reason
        assert "a quieter machine or another run may decide it" in found.reason
        assert RunResult({}, [found]).exit_code() == 2
        assert RunResult({}, [found]).disturbed_by


def weighed_failure(*values: float) -> Result:
    """A failure with these figures, each with a limit of 0.1 s and an error of 2 ms."""
    outcome = Outcome(False, measures=tuple(Measure(value, 0.1) for value in values))
    return Judgement(GAP, Side.LEFT, Claims(), {}).run_check(
        lambda: outcome,
        lambda _: Excuse(),
        lambda o: weigh(Clock(0.002), o.measures, [(1.0, 1.1)], (0.0, 9.0)),
    )


def test_failure_for_another_reason_is_not_excused_by_a_figure_that_passes() -> None:
    assert weighed_failure(0.0999).verdict is Verdict.FAIL


def test_figure_without_end_is_not_hidden_by_one_near_the_limit() -> None:
    assert weighed_failure(0.1001).verdict is Verdict.BLOCKED
    assert weighed_failure(0.1001, math.inf).verdict is Verdict.FAIL


def test_should_within_the_kits_error_warns_all_the_same() -> None:
    found = judged(0.101, 0.002, WARNS.id)
    assert found.verdict is Verdict.WARN
    assert "fails by less than the kit's measurement error" in Card.from_results([found]).as_text()


def test_pass_within_the_kits_error_is_shown_on_card_and_page() -> None:
    found = judged(0.099, 0.002)
    told = "passes by less than the kit's measurement error of 0.002 s"
    assert told in Card.from_results([found]).as_text()
    about = {"model": "dex1-1", "dialect": "unitree_go", "sides": "left"}
    result = RunResult(about, [found, judged(0.05, 0.002)])
    assert [told in text for text in near_limits(result)] == [True]
    assert "Nearer to a limit than the kit can measure" in render(result)


def test_virtual_run_measures_without_error_and_others_do_not_know() -> None:
    trace = copy_of(short_run())
    exact = result_of(judge(Recording.decode(trace)), GAP.id).measure
    assert exact is not None
    assert (exact.error, exact.margin_in_errors) == (0.0, None)
    trace.metadata.clear()
    unknown = result_of(judge(Recording.decode(trace)), GAP.id).measure
    assert unknown is not None
    assert unknown.error is None
    assert unknown.sentence().endswith("the kit's measurement error is not known here")


def test_calibration_is_the_least_error_of_times() -> None:
    trace = copy_of(short_run())
    stimulus = Stimulus.from_metadata(with_beats_record(trace))
    assert stimulus.time_error(stimulus.beats.begin_ns, 2**62) == pytest.approx(0.001)
    stimulus.calibration = Calibration(4, [100, 200, 300, 9_000], [0, 0, 0, 0], 2)
    again = Stimulus.from_metadata(stimulus.to_metadata())
    assert again == stimulus
    error = again.time_error(stimulus.beats.begin_ns, 2**62)
    assert error == pytest.approx(0.009, rel=0.05)
    assert Calibration(4, [100], [0] * 4).time_error is None  # most messages were lost
    assert Calibration(2, [100, 100], [0, 0], clock_us=500).time_error == pytest.approx(0.0005)


def with_beats_record(trace: MemoryTrace) -> dict[str, str]:
    with_beats(trace, usual_us=1_000)
    return trace.metadata[RECORD]


@each(
    "text",
    ["[]", "3", '{"sent": 1.5}', '{"delay_us": ["x"]}', '{"delay_us": 3}', '{"strange": 1}'],
)
def test_damaged_calibration_is_refused(text: str) -> None:
    record = {**short_run().metadata[RECORD], "calibration": text}
    with pytest.raises(TraceUnsupported):
        Stimulus.from_metadata(record)
