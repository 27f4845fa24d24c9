"""Test how outcomes become verdicts: blocking, errors of the kit, and load of the machine."""

from __future__ import annotations

import itertools
import math
import threading
import time
from dataclasses import replace

import pytest

from dexkit.conformance.behaviours.operator import OPERATOR
from dexkit.conformance.checks import Outcome
from dexkit.conformance.faults import plan_for
from dexkit.conformance.faults.operator import LateState
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.heartbeat import Heartbeat
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.kit.results import Evidence, Load, Verdict
from dexkit.conformance.kit.verdicts import MOST_PLACES, Judgement, excuse
from dexkit.conformance.virtual import run_virtual
from dexkit.hand import Side, Subject
from tests.conformance_helpers import copy_of, result_of, short_run, with_beats
from tests.dds_helpers import wait_until
from tests.each import each

BY_ID = {r.id: r for r in catalogue(None, None)}
GAP = BY_ID["DEX1-RATE-03"]  # max_gap_s
RATE = BY_ID["DEX1-RATE-01"]  # min_rate_hz
FIELD = BY_ID["DEX1-FIELD-01"]  # of the states alone


IDLE = Lateness(0.0, 0.0, 0.0)
LATE = Lateness(total=0.1, mean=0.001, p99=0.01)


class Machine:
    """A machine whose timer was late by that much."""

    def __init__(self, lost: Lateness | None) -> None:
        self._lost = lost

    def excess_lateness(self, begin: float, end: float) -> Lateness | None:
        return self._lost

    def starvation(self, subject: Subject, begin: float, end: float) -> None:
        return None


BUSY_ONE = Machine(LATE)


def failure(*ends: float) -> Outcome:
    return Outcome(False, evidence=tuple(Evidence("t", 1.0, 0, end) for end in ends))


def rate(hz: float) -> Outcome:
    return failure(2.0).if_late(1 / hz - 1 / 200, how="mean")


def gap(seconds: float) -> Outcome:
    return failure(1.0 + seconds).if_late(seconds - 0.1)


@each(
    ("requirement", "outcome", "machine", "excused"),
    [
        # any failure on an idle machine is the hand's
        (RATE, rate(195.0), Machine(IDLE), False),
        (GAP, gap(0.101), Machine(IDLE), False),
        # a delay excuses a failure of its own size
        (RATE, rate(50.0), BUSY_ONE, False),
        (RATE, rate(125.0), BUSY_ONE, True),
        (RATE, rate(180.0), BUSY_ONE, True),
        (GAP, gap(0.45), BUSY_ONE, True),
        (GAP, gap(0.55), BUSY_ONE, False),
        # occasional lateness hardly changes a mean
        (RATE, rate(120.0), Machine(Lateness(0.06, 0.0006, 0.06)), False),
        # not known
        (GAP, gap(0.2), Machine(None), False),
        # load excuses neither too high a rate nor failures without a relation to time
        (RATE, failure(2.0).if_late(math.inf, how="mean"), BUSY_ONE, False),
        (FIELD, gap(0.2), Machine(Lateness(1.0, 1.0, 1.0)), False),
        # a failure without a size is as large as its place
        (GAP, failure(1.3), BUSY_ONE, True),
        (GAP, failure(2.0), BUSY_ONE, False),
    ],
)
def test_machine_load_excuses_only_failures_it_can_cause(
    requirement: Requirement, outcome: Outcome, machine: Machine, excused: bool
) -> None:
    found = excuse(machine, requirement, outcome, Side.LEFT)
    assert found.excused is excused
    assert found.text.startswith("the machine was too busy") is excused
    assert (found.disturbance.load is Load.TOO_BUSY) is excused


def test_places_that_are_not_shown_count_too() -> None:
    """Six gaps: five while the machine was stalled, and one that is the hand's."""
    trace = copy_of(short_run())
    key = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    begin = trace.rows[key][0][0]
    starts = [begin + round((0.2 + 0.25 * i) * 1e9) for i in range(6)]
    trace.rows[key] = [
        row for row in trace.rows[key] if not any(a < row[0] < a + 150_000_000 for a in starts)
    ]
    found = result_of(judge(with_beats(trace, stalls=starts[:5])), "DEX1-RATE-03")
    assert found.verdict is Verdict.FAIL
    assert found.values["gaps"] == 6
    assert len(found.evidence) == MOST_PLACES
    found = result_of(judge(with_beats(trace, stalls=starts)), "DEX1-RATE-03")
    assert found.verdict is Verdict.BLOCKED


def test_failure_without_place_needs_lateness_over_the_run() -> None:
    outcome = Outcome(False).if_late(0.01, how="p99")
    assert not excuse(BUSY_ONE, GAP, outcome, Side.LEFT).excused
    assert excuse(BUSY_ONE, GAP, outcome, Side.LEFT, (0.0, 10.0)).excused


def test_gap_within_the_kits_lateness_is_blocked() -> None:
    trace = copy_of(short_run())
    key = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    begin = trace.rows[key][0][0] + round(2.5e9)
    trace.rows[key] = [r for r in trace.rows[key] if not begin <= r[0] < begin + 200_000_000]
    assert result_of(judge(Recording.decode(trace)), GAP.id).verdict is Verdict.FAIL
    result = judge(with_beats(trace, [begin]))
    found = result_of(result, GAP.id)
    assert found.verdict is Verdict.BLOCKED
    assert "late by 149 ms in all" in found.reason
    assert (found.disturbance.load, found.retry) == (Load.TOO_BUSY, True)
    assert found.disturbance.late_s == pytest.approx(0.149, abs=0.001)
    assert result.disturbed_by
    assert result.harness["jitter_p50_ms"] == pytest.approx(0.1)
    result = judge(with_beats(trace, [begin], stall_s=0.02))
    found = result_of(result, GAP.id)
    assert found.verdict is Verdict.FAIL
    assert (found.disturbance.load, found.retry) == (Load.BUSY, True)
    assert result.disturbed_by  # one more run, to be sure
    assert not judge(with_beats(trace)).disturbed_by


def test_slow_client_of_the_kit_does_not_fail_the_hand() -> None:
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step", OPERATOR}))
    trace = run_virtual(plan, LateState)
    lag = result_of(judge(Recording.decode(trace)), "DEX1-OPER-01")
    assert lag.verdict is Verdict.WARN
    commands = ("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
    trace.rows[commands] = trace.rows[commands][::2]
    starved = result_of(judge(Recording.decode(trace)), "DEX1-OPER-01")
    assert starved.verdict is Verdict.NOT_APPLICABLE
    assert "of 200 commands a second" in starved.reason


def test_blocked_result_names_the_failed_requirement() -> None:
    trace = copy_of(short_run())
    result = judge(Recording.decode(trace, dialect_name="unitree_hg"))
    blocked = [r for r in result.results if r.verdict is Verdict.BLOCKED]
    assert blocked
    failing = {r.requirement.id for r in result.results if r.verdict is not Verdict.PASS}
    for entry in blocked:
        assert entry.blocked_by in entry.requirement.after
        assert entry.blocked_by in failing


# ------------------------------------------------------------------------------ the kit's jitter


def test_heartbeat_measures_its_lateness() -> None:
    begin = time.time_ns()
    with Heartbeat() as heart:
        deadline = time.monotonic() + 60
        while len(heart.beats.t_us) < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert len(heart.beats.t_us) == len(heart.beats.late_us) >= 5
    assert heart.beats.t_us == sorted(heart.beats.t_us)
    assert min(heart.beats.late_us) >= 0
    assert heart.beats.lateness(begin, time.time_ns()) is not None
    assert heart.beats.lateness(begin - 10**9, begin - 10**8) is None


def test_pause_of_the_kit_between_two_beats_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pause may come at any point of the thread, not only while it sleeps."""
    calls = itertools.count()
    resumed = threading.Event()

    def waited() -> float:
        if next(calls) == 3:
            resumed.wait(0.06)
        return 0.0

    monkeypatch.setattr("dexkit.conformance.kit.heartbeat._waited", waited)
    with Heartbeat() as heart:
        wait_until(lambda: len(heart.beats.t_us) > 5)
    assert max(heart.beats.late_us) >= 45_000
    assert heart.stalls


def test_busy_machine_does_not_leave_open_a_must_of_which_a_part_would_warn() -> None:
    def verdict_of(outcome: Outcome) -> Verdict:
        judgement = Judgement(GAP, Side.LEFT, Claims(), {})
        return judgement.run_check(
            lambda: outcome, lambda it: excuse(BUSY_ONE, GAP, it, Side.LEFT)
        ).verdict

    assert verdict_of(gap(0.15)) is Verdict.BLOCKED
    assert verdict_of(gap(0.15).tolerated()) is Verdict.NOT_APPLICABLE
    assert verdict_of(gap(9.0).tolerated()) is Verdict.WARN
