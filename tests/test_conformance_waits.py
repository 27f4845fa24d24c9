"""What the processes of a hand waited for a processor: measured, recorded, and as an excuse."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.checks import Outcome
from dexkit.conformance.faults import plan_for
from dexkit.conformance.faults.gripper import Inverted, NanVelocity, Percent
from dexkit.conformance.kit import run_queue
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.processor_waits import ProcessWaits, Starvation, Waits
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Evidence, RunResult, Verdict
from dexkit.conformance.kit.run_queue import RunQueue, Watched
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.conformance.kit.verdicts import BEFORE, excuse
from dexkit.conformance.virtual import MemoryTrace, run_virtual
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.errors import TraceUnsupported
from dexkit.hand import Side, Subject
from tests.conformance_helpers import copy_of, result_of, short_run
from tests.dds_helpers import wait_until
from tests.each import each

BY_ID = {r.id: r for r in catalogue(None, None)}
GAP = BY_ID["DEX1-RATE-03"]
RATE = BY_ID["DEX1-RATE-01"]
MOVE = BY_ID["DEX1-MOVE-02"]
FIELD = BY_ID["DEX1-FIELD-01"]  # of the states alone
SAMPLE_US = 10_000
STATES = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")


def waits(
    *waited_us: int, longest: int | None = None, side: Side = Side.LEFT, begin_ns: int = 0
) -> Waits:
    """One process, sampled every 10 ms; each wait is a single one unless ``longest`` is given."""
    times = [SAMPLE_US * (i + 1) for i in range(len(waited_us))]
    most = [x if longest is None else min(x, longest) for x in waited_us]
    process = ProcessWaits("the service", 42, (side,), list(waited_us), most)
    return Waits(begin_ns, times, [process])


class Machine:
    """A machine whose timer is not late; the hand's process waited."""

    def __init__(self, found: Waits) -> None:
        self._waits = found

    def excess_lateness(self, begin: float, end: float) -> Lateness | None:
        return Lateness(0.0, 0.0, 0.0)

    def starvation(self, subject: Subject, begin: float, end: float) -> Starvation | None:
        return self._waits.starvation(subject, round(begin * 1e9), round(end * 1e9))


def failure(begin: float, end: float) -> Outcome:
    return Outcome(False, evidence=(Evidence("t", begin, 0, end),))


QUIET = [0] * 200
ONE_LONG = waits(*QUIET[:120], 150_000, *QUIET[121:])
MANY_SHORT = waits(*[4_000] * 200)


@each(
    ("requirement", "outcome", "found", "excused"),
    [
        # the wait of 0.15 s ends at 1.21 s
        (GAP, failure(1.1, 1.3).if_late(0.1), ONE_LONG, True),
        (GAP, failure(1.1, 1.3).if_late(0.7), ONE_LONG, False),
        (GAP, failure(1.1, 1.3).if_late(0.1), waits(*QUIET), False),
        # it shows a while longer, but not before it began
        (GAP, failure(1.3, 1.5).if_late(0.1), ONE_LONG, True),
        (GAP, failure(1.3 + BEFORE, 1.9 + BEFORE).if_late(0.1), ONE_LONG, False),
        (GAP, failure(0.8, 1.0).if_late(0.1), ONE_LONG, False),
        # many short waits add up in what happens once
        (GAP, failure(1.0, 1.5).if_late(1.5), MANY_SHORT, True),
        (GAP, failure(1.0, 1.5).if_late(2.0), MANY_SHORT, False),
        # they make each one late that happens again and again
        (RATE, failure(0.5, 1.5).if_late(0.011, how="mean"), MANY_SHORT, True),
        (RATE, failure(0.5, 1.5).if_late(0.013, how="mean"), MANY_SHORT, False),
        # one long wait makes no rate low
        (RATE, failure(0.0, 2.0).if_late(0.005, how="mean"), ONE_LONG, False),
        # a motion without a size is as large as it is long
        (MOVE, failure(1.0, 1.5), waits(*QUIET[:120], 500_000, *QUIET[121:]), True),
        (MOVE, failure(1.0, 3.5), ONE_LONG, False),
        (MOVE, failure(0.0, 2.0), waits(*[2_000] * 200), False),
        # no wait makes a wrong field, nor what no delay can make
        (FIELD, failure(1.1, 1.2), waits(*[100_000] * 200), False),
        (RATE, failure(1.1, 1.2).if_late(float("inf"), how="mean"), MANY_SHORT, False),
        # those of the other hand do not count
        (
            GAP,
            failure(1.1, 1.3).if_late(0.1),
            msgspec.structs.replace(ONE_LONG, processes=[]),
            False,
        ),
        (GAP, failure(1.1, 1.3).if_late(0.1), waits(*[150_000] * 200, side=Side.RIGHT), False),
    ],
)
def test_waits_excuse_only_failures_they_can_cause(
    requirement: object, outcome: Outcome, found: Waits, excused: bool
) -> None:
    assert excuse(Machine(found), requirement, outcome, Side.LEFT).excused is excused  # type: ignore[arg-type]


def test_hand_that_keeps_the_processors_busy_itself_is_not_excused() -> None:
    """Three of its threads compute on two processors: each waits for the others of its own."""
    busy = [2 * SAMPLE_US] * 200
    slow = failure(0.5, 1.5).if_late(0.004, how="mean")
    own = msgspec.structs.replace(MANY_SHORT, busy_us=busy, own_us=[round(1.8 * SAMPLE_US)] * 200)
    others = msgspec.structs.replace(MANY_SHORT, busy_us=busy, own_us=[SAMPLE_US // 5] * 200)
    assert excuse(Machine(others), RATE, slow, Side.LEFT).excused
    assert not excuse(Machine(own), RATE, slow, Side.LEFT).excused
    assert own.others(0, 10**9) == pytest.approx(0.1)  # on processors whose number is not known
    assert msgspec.structs.replace(own, busy_us=[0] * 200).others(0, 10**9) == 0.0
    assert MANY_SHORT.others(0, 10**9) == 1.0  # not known


@given(
    waited=st.lists(st.integers(0, 300_000), min_size=1, max_size=60),
    more=st.integers(0, 100_000),
    size=st.floats(0.001, 2),
    larger=st.floats(0, 1),
)
def test_longer_waits_excuse_more_and_larger_failures_are_excused_less(
    waited: list[int], more: int, size: float, larger: float
) -> None:
    def excused(late: float, add: int) -> bool:
        machine = Machine(waits(*(x + add for x in waited)))
        return excuse(machine, GAP, failure(0.0, 1.0).if_late(late), Side.LEFT).excused

    assert excused(size, more) >= excused(size, 0) >= excused(size + larger, 0)


# ------------------------------------------------------------------------------- recordings


def with_waits(trace: MemoryTrace, found: Waits | None) -> Recording:
    """The recording, with what its left hand's process waited from its first sample on."""
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    first = min(row[0] for rows in trace.rows.values() for row in rows)
    stimulus.waits = None if found is None else msgspec.structs.replace(found, begin_ns=first)
    trace.metadata[RECORD] = stimulus.to_metadata()
    return Recording.decode(trace)


def verdicts(result: RunResult) -> list[object]:
    return [(r.requirement.id, r.side, r.verdict, r.figure, r.reason) for r in result.results]


def test_gap_is_open_where_the_process_waited() -> None:
    trace = copy_of(short_run())
    begin = trace.rows[STATES][0][0] + round(2.5e9)
    trace.rows[STATES] = [r for r in trace.rows[STATES] if not begin <= r[0] < begin + 200_000_000]
    assert result_of(judge(with_waits(trace, None)), GAP.id).verdict is Verdict.FAIL
    assert result_of(judge(with_waits(trace, waits(*[100] * 2000))), GAP.id).verdict is Verdict.FAIL
    first = min(row[0] for rows in trace.rows.values() for row in rows)
    sample = (begin + 200_000_000 - first) // 10**7
    result = judge(with_waits(trace, waits(*[0] * sample, 190_000, *[0] * 2000)))
    found = result_of(result, GAP.id)
    assert found.verdict is Verdict.BLOCKED
    assert "the service (pid 42) waited" in found.reason
    assert result.disturbed_by
    assert str(result.overall) == "inconclusive"
    assert result.harness["longest_wait_ms"] == 190.0


def test_idle_waits_change_no_verdict() -> None:
    trace = copy_of(short_run())
    without = judge(with_waits(trace, None))
    assert "waited" not in without.harness
    assert verdicts(judge(with_waits(trace, waits(*[900] * 2000)))) == verdicts(without)


@each(
    ("service", "requirement"),
    [
        (Inverted, MOVE.id),
        (Percent, "DEX1-FIELD-03"),
        (NanVelocity, FIELD.id),
    ],
)
def test_failure_that_load_cannot_cause_fails_on_a_busy_machine(
    service: type[ReferenceService], requirement: str
) -> None:
    """Its process waits for half of the time, up to 20 ms at once."""
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step"}))
    busy = with_waits(run_virtual(plan, service), waits(*[5_000, 20_000, 0] * 700))
    result = judge(busy)
    assert result_of(result, requirement).verdict is Verdict.FAIL
    assert str(result.overall) == "fail"


def test_record_keeps_waits() -> None:
    found = msgspec.structs.replace(
        waits(1, 2, 30, begin_ns=5), busy_us=[1, 0, 2], own_us=[0, 0, 1]
    )
    stimulus = Stimulus(waits=found)
    assert Stimulus.from_metadata(stimulus.to_metadata()).waits == stimulus.waits
    assert Stimulus.from_metadata(Stimulus().to_metadata()).waits is None


@each(
    "change",
    [
        {"t_us": [1]},
        {"t_us": ["x", 2]},
        {"begin_ns": 2**63},
        {"busy_us": [1]},
        {"processes": [{"name": "a"}]},
        {"processes": 3},
        {
            "processes": [
                {"name": "", "pid": True, "subjects": [], "waited_us": [], "longest_us": []}
            ]
        },
    ],
)
def test_damaged_waits_are_refused(change: dict[str, object]) -> None:
    record = Stimulus(waits=waits(1, 2)).to_metadata()
    record["waits"] = json.dumps({**json.loads(record["waits"]), **change})
    with pytest.raises(TraceUnsupported, match="damaged"):
        Stimulus.from_metadata(record)


# ------------------------------------------------------------------------------ measurement


def test_nothing_is_measured_without_proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_queue, "_PROC", tmp_path / "none")
    watched = [Watched("a", 1, (Side.LEFT,)), Watched("b", 0, (Side.LEFT,))]
    with RunQueue(lambda: watched) as queue:
        wait_until(lambda: len(queue._t_us) > 2)
    assert queue.waits is None


@contextlib.contextmanager
def burner(processor: int) -> Iterator[int]:
    """A process that computes on that processor only."""
    code = (
        f"import os\nos.sched_setaffinity(0, {{{processor}}})\nprint(flush=True)\nwhile True: pass"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process.pid
        finally:
            process.kill()


def waited_ns(pid: int) -> int:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])


@pytest.mark.skipif(
    not Path("/proc/self/schedstat").exists(), reason="this kernel does not count waits"
)
def test_two_that_share_a_processor_wait_and_a_stopped_one_does_not() -> None:
    processor = min(os.sched_getaffinity(0))
    with burner(processor) as one, burner(processor) as two, burner(processor) as stopped:
        os.kill(stopped, signal.SIGSTOP)
        wait_until(lambda: Path(f"/proc/{stopped}/stat").read_text().split()[2] == "T")
        watched = [Watched(str(pid), pid, (Side.LEFT,)) for pid in (one, two, stopped)]
        with RunQueue(lambda: watched) as queue:
            enough = {pid: waited_ns(pid) + 300_000_000 for pid in (one, two)}
            wait_until(lambda: all(waited_ns(pid) > ns for pid, ns in enough.items()))
    found = queue.waits
    assert found is not None
    waited = [sum(p.waited_us) for p in found.processes]
    assert min(waited[:2]) > 20_000
    assert waited[2] == 0
    assert sum(found.busy_us) > 0
