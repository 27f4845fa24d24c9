"""From findings to verdicts: what blocks, whose fault it is, what the kit's own jitter excuses."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.checks import Outcome
from dexkit.conformance.claims import Claims
from dexkit.conformance.heartbeat import Heartbeat
from dexkit.conformance.judge import judge
from dexkit.conformance.mutants import plan_for
from dexkit.conformance.mutants.operator import LateState
from dexkit.conformance.phases import RECORD, Beats, Stall, Stimulus
from dexkit.conformance.requirements import Requirement, catalogue
from dexkit.conformance.results import TOO_BUSY, Evidence, Result, Verdict
from dexkit.conformance.stimuli.operator import OPERATOR
from dexkit.conformance.verdicts import MOST_PLACES, Judgement, excuse
from dexkit.conformance.view import Recording
from dexkit.conformance.virtual import run_virtual
from dexkit.hand import Side
from tests.conformance_helpers import copy_of, of, short_run

BY_ID = {r.id: r for r in catalogue(None, None)}
GAP = BY_ID["DEX1-RATE-03"]  # max_gap_s
RATE = BY_ID["DEX1-RATE-01"]  # min_rate_hz
MOVE = BY_ID["DEX1-MOVE-02"]  # not of real time


class Machine:
    """A machine that was so late, and lacked so much."""

    def __init__(self, late: tuple[float, float] | None, starved: float = 0.0) -> None:
        self._late, self._starved = late, starved

    def starved(self, begin: float, end: float) -> float:
        return self._starved

    def lateness(self, begin: float, end: float) -> tuple[float, float] | None:
        return self._late


def failure(*ends: float) -> Outcome:
    return Outcome(False, evidence=tuple(Evidence("t", 1.0, 0, end) for end in ends))


@pytest.mark.parametrize(
    ("requirement", "machine", "excused"),
    [
        (GAP, Machine(None), False),
        (GAP, Machine((0.0, 0.04)), False),
        (GAP, Machine((0.0, 0.06)), True),
        (GAP, Machine(None, starved=0.6), True),
        (RATE, Machine((0.0, 0.06)), False),  # now and then does not move a mean
        (RATE, Machine((0.004, 0.06)), True),
        (MOVE, Machine((1.0, 1.0), starved=1.0), False),
    ],
)
def test_what_the_kits_own_machine_excuses(
    requirement: Requirement, machine: Machine, excused: bool
) -> None:
    found = excuse(machine, requirement, failure(2.0))
    assert found.startswith(TOO_BUSY) if excused else not found


def test_every_place_of_a_failure_has_to_be_excused() -> None:
    class Once(Machine):
        def lateness(self, begin: float, end: float) -> tuple[float, float] | None:
            return (0.0, 0.06) if end < 3 else (0.0, 0.0)

    assert excuse(Once(None), GAP, failure(2.0))
    assert not excuse(Once(None), GAP, failure(2.0, 4.0))


def test_a_place_that_is_not_shown_counts_all_the_same() -> None:
    """Six gaps: five while the machine was stalled, and one that is the hand's."""
    trace = copy_of(short_run())
    key = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    begin = trace.rows[key][0][0]
    starts = [begin + round((0.2 + 0.25 * i) * 1e9) for i in range(6)]
    trace.rows[key] = [
        row for row in trace.rows[key] if not any(a < row[0] < a + 150_000_000 for a in starts)
    ]
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    stimulus.stalls += [Stall(a, a + 150_000_000) for a in starts[:5]]
    trace.metadata[RECORD] = stimulus.to_metadata()
    found = of(judge(Recording.of(trace)), "DEX1-RATE-03")
    assert found.verdict is Verdict.FAIL
    assert found.values["gaps"] == 6
    assert len(found.evidence) == MOST_PLACES
    stimulus.stalls.append(Stall(starts[5], starts[5] + 150_000_000))
    trace.metadata[RECORD] = stimulus.to_metadata()
    assert of(judge(Recording.of(trace)), "DEX1-RATE-03").verdict is Verdict.BLOCKED


def test_a_failure_without_a_place_is_excused_by_the_whole_run_if_at_all() -> None:
    assert not excuse(Machine((0.0, 0.06)), GAP, Outcome(False))
    assert excuse(Machine((0.0, 0.06)), GAP, Outcome(False), (0.0, 10.0))


def test_a_gap_no_longer_than_the_kits_own_lateness_is_not_blamed_on_the_hand() -> None:
    trace = copy_of(short_run())
    key = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    first = trace.rows[key][0][0]
    begin, end = first + round(2.5e9), first + round(2.7e9)
    trace.rows[key] = [r for r in trace.rows[key] if not begin <= r[0] < end]
    assert of(judge(Recording.of(trace)), GAP.id).verdict is Verdict.FAIL
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    late = [150_000 if 2_600_000 <= t <= 2_710_000 else 100 for t in range(0, 6_000_000, 10_000)]
    stimulus.beats = Beats(first, list(range(0, 6_000_000, 10_000)), late)
    trace.metadata[RECORD] = stimulus.to_metadata()
    result = judge(Recording.of(trace))
    found = of(result, GAP.id)
    assert found.verdict is Verdict.BLOCKED
    assert "late by 150.0 ms" in found.reason
    assert result.disturbed
    assert result.harness["jitter_p50_ms"] == pytest.approx(0.1)
    assert result.harness["jitter_p99_ms"] > 100


def test_a_client_that_could_not_keep_its_rate_blames_no_hand() -> None:
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step", OPERATOR}))
    trace = run_virtual(plan, LateState)
    lag = of(judge(Recording.of(trace)), "DEX1-OPER-02")
    assert lag.verdict is Verdict.WARN
    commands = ("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
    trace.rows[commands] = trace.rows[commands][::2]
    starved = of(judge(Recording.of(trace)), "DEX1-OPER-02")
    assert starved.verdict is Verdict.NOT_APPLICABLE
    assert "of 200 commands a second" in starved.reason


def test_what_a_failure_blocks_names_it() -> None:
    trace = copy_of(short_run())
    result = judge(Recording.of(trace, dialect_name="unitree_hg"))
    blocked = [r for r in result.results if r.verdict is Verdict.BLOCKED]
    assert blocked
    failing = {r.requirement.id for r in result.results if r.verdict is not Verdict.PASS}
    for entry in blocked:
        assert entry.blocked_by in entry.requirement.after
        assert entry.blocked_by in failing


def test_a_check_that_breaks_is_the_kits_error_and_blocks() -> None:
    def broken() -> Outcome:
        raise ZeroDivisionError("1/0")

    found: dict[str, Result] = {}
    error = Judgement(GAP, Side.LEFT, Claims(), found).of(broken, lambda _: "")
    assert error.verdict is Verdict.ERROR
    assert error.reason == "the check itself failed: ZeroDivisionError: 1/0"
    found[GAP.id] = error
    later = Judgement(replace(MOVE, after=(GAP.id,)), Side.LEFT, Claims(), found).blocked()
    assert later is not None
    assert later.blocked_by == GAP.id


def test_a_failure_is_explained_in_full() -> None:
    outcome = Outcome(False, "x", "seen", evidence=(Evidence("rt/x", 1.5, 0, 2.0),))
    result = Judgement(GAP, Side.LEFT, Claims(), {}).of(lambda: outcome, lambda _: "")
    assert result.verdict is Verdict.FAIL
    lines = dict(line.strip().split(": ", 1) for line in result.explain().splitlines()[1:])
    assert {k.strip() for k in lines} >= {"required", "observed", "cause", "try", "source"}
    assert "rt/x at 1.500 s .. 2.000 s" in result.explain()
    assert GAP.cause in result.explain()
    told = Judgement(GAP, Side.LEFT, Claims(), {}).of(
        lambda: outcome.because("the moon"), lambda _: ""
    )
    assert told.cause == "the moon"


# ------------------------------------------------------------------------------ the kit's jitter


def test_the_heartbeat_measures_its_own_lateness() -> None:
    begin = time.time_ns()
    with Heartbeat() as heart:
        deadline = time.monotonic() + 10
        while len(heart.beats.t_us) < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert len(heart.beats.t_us) == len(heart.beats.late_us) >= 5
    assert heart.beats.t_us == sorted(heart.beats.t_us)
    assert min(heart.beats.late_us) >= 0
    assert heart.beats.lateness(begin, time.time_ns()) is not None
    assert heart.beats.lateness(begin - 10**9, begin - 10**8) is None


@given(
    gaps=st.lists(st.integers(1, 50_000), min_size=1, max_size=50),
    late=st.integers(0, 200_000),
)
def test_lateness_lies_between_the_least_and_the_most(gaps: list[int], late: int) -> None:
    times = [sum(gaps[: i + 1]) for i in range(len(gaps))]
    beats = Beats(1000, times, [late + i for i in range(len(times))])
    found = beats.lateness(1000, 1000 + 10**12)
    assert found is not None
    assert late / 1e6 <= found[0] <= found[1] <= (late + len(times)) / 1e6


def test_a_beat_that_was_due_in_a_stretch_counts_for_it() -> None:
    beats = Beats(0, [100_000], [90_000])  # due at 10 ms, fired at 100 ms
    assert beats.lateness(20_000_000, 80_000_000) == (0.09, 0.09)
