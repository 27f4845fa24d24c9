"""Judge good hands with permitted pauses of the state where they hide what a check reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexkit.conformance.checks import Context
from dexkit.conformance.faults import plan_for
from dexkit.conformance.faults.generated import parse
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual import run_virtual
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.conformance.virtual.memory_trace import MemoryTrace

PAUSE, EVERY = 0.072, 1.0  # seconds
MADE_ONCE = {"DEX1-LIFE-04", "DEX3-GAIN-02", "DEX5-GAIN-02", "DEX3-OPER-01"}
"""Requirements about an event that a run has only once, which a pause may hide: a service that is
stopped in motion, a step with a tenth of the stiffness, a full stroke of the operator.
"""
BLAMES = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)


def without(trace: MemoryTrace, commands: str, at: float) -> MemoryTrace:
    """A recording without the states of 72 ms in each second, from ``at`` on."""
    origin = min(rows[0][0] for rows in trace.rows.values())

    def kept(log_ns: int) -> bool:
        seconds = (log_ns - origin) / 1e9
        return seconds <= 1.0 or (seconds - at) % EVERY >= PAUSE

    rows = {
        (topic, kind): some if kind == commands else [r for r in some if kept(r[0])]
        for (topic, kind), some in trace.rows.items()
    }
    return replace(trace, rows=rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "places"),
    [
        # DEX1-GAIN-03: the begin or the end of a push
        ("dex1-1/unitree_actuator:backlash-more+soft-start+sags-down", (0.0, 0.2)),
        # DEX3-GAIN-04: the end of a push and the begin of the next one
        ("dex3-1/dex3:backlash-more+latency-20", (0.12,)),
        *(
            pytest.param(name, places, marks=pytest.mark.soak)
            for name, places in (
                # when it begins to move
                ("dex1-1/unitree_go:backlash-more+latency-20", (0.04, 0.76)),
                # most of the motion in a window
                ("dex1-1/unitree_hg:backlash-more+soft-start", (0.52,)),
                # that it moves before a step
                ("dex3-1/dex3:backlash-more+latency-20", (0.64, 0.8)),
                # DEX5-GAIN-02: how a step gets half-way
                ("dex5-1/dex5:backlash-more+state-late-10", (0.66, 0.78)),
            )
        ),
    ],
)
def test_a_pause_is_no_failure_of_what_it_hides(name: str, places: tuple[float, ...]) -> None:
    hand = parse(name)
    plan = plan_for(hand.dialect.name, sides=hand.sides)
    trace = run_virtual(plan, hand.service())
    whole = judge(recording_of(trace, plan.dialect.name, plan.sides)).results
    passed = {(r.requirement.id, r.side) for r in whole if r.verdict is Verdict.PASS}
    for at in places:
        less = without(trace, plan.dialect.cmd_type, at)
        found = judge(recording_of(less, plan.dialect.name, plan.sides)).results
        assert [r.requirement.id for r in found if r.verdict in BLAMES] == [], at
        lost = {r.requirement.id for r in found if (r.requirement.id, r.side) in passed}
        lost -= {r.requirement.id for r in found if r.verdict is Verdict.PASS}
        assert lost <= MADE_ONCE, at


def test_a_stretch_is_seen_unless_a_gap_in_the_states_reaches_into_it() -> None:
    plan = replace(plan_for("unitree_go"), phases=frozenset({"step"}))
    trace = without(run_virtual(plan, ReferenceService), plan.dialect.cmd_type, 0.5)
    recording = recording_of(trace, plan.dialect.name, plan.sides)
    hand = recording.sides[recording.judged[0]]
    context = Context(recording, hand, catalogue("dex1-1")[0])
    gap = int(np.argmax(np.diff(hand.states.t)))
    begin, end = hand.states.t[gap : gap + 2].tolist()
    assert end - begin > 0.07
    assert context.seen(begin - 0.1, begin)
    assert context.seen(end, end + 0.1)
    assert context.seen(begin - 0.1, begin + 0.02)
    assert not context.seen(begin - 0.1, begin + 0.05)
    assert not context.seen(begin - 0.1, end + 0.1)
    assert not context.seen(begin + 0.01, end - 0.01)
    assert not context.seen(begin - 0.1, begin + 0.02, 0.01)
