"""Recordings of hands and of robots are decoded in the same way, odd ones included."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from dexkit.conformance.faults.trials import plan_for
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.layers import layer_of_model
from dexkit.conformance.virtual import MemoryTrace, run_virtual
from dexkit.hand import ROBOT, Side, Subject
from tests.conformance_helpers import copy_of


@cache
def session(dialect: str) -> MemoryTrace:
    """A short virtual run of the reference."""
    plan = replace(plan_for(dialect), phases=frozenset({"foreign"}))
    return run_virtual(plan, layer_of_model(plan.dialect.model).reference(plan.dialect.model))


@dataclass(frozen=True)
class Case:
    """A recording of one kind of device.

    :param subject: one of those in it.
    """

    dialect: str
    subject: Subject
    state_topic: str
    cmd_topic: str

    def trace(self) -> MemoryTrace:
        """A copy of a good recording."""
        return copy_of(session(self.dialect))

    def recording(self, trace: MemoryTrace) -> Recording:
        """It, decoded."""
        return recording_of(trace, self.dialect, (self.subject,))


CASES = (
    Case("unitree_go", Side.LEFT, "rt/dex1/left/state", "rt/dex1/left/cmd"),
    Case("h1", ROBOT, "rt/lowstate", "rt/lowcmd"),
    Case("g1", ROBOT, "rt/lowstate", "rt/lowcmd"),
)
both = pytest.mark.parametrize("case", CASES, ids=lambda case: case.dialect)


def rows_of(trace: MemoryTrace, topic: str) -> tuple[str, str]:
    return next(key for key in trace.rows if key[0] == topic)


@both
def test_time_of_publication_may_be_unknown(case: Case) -> None:
    trace = case.trace()
    key = rows_of(trace, case.state_topic)
    trace.rows[key] = [(log, 0, data) for log, _, data in trace.rows[key]]
    states = case.recording(trace).sides[case.subject].states
    assert np.isnan(states.sent).all()
    assert (states.clock == states.t).all()


@both
def test_message_that_does_not_decode_has_no_values(case: Case) -> None:
    trace = case.trace()
    for topic in (case.state_topic, case.cmd_topic):
        key = rows_of(trace, topic)
        rows = list(trace.rows[key])
        rows[3] = (*rows[3][:2], rows[3][2][:20])
        trace.rows[key] = rows
    view = case.recording(trace).sides[case.subject]
    assert list(view.states.errors) == [3]
    for part in (view.states, view.commands):
        assert np.flatnonzero(part.length < 0).tolist() == [3]
        assert np.isnan(part.q[3]).all()
        assert np.isfinite(part.q[4]).all()


@both
def test_topic_that_is_missing_or_of_another_type_is_empty(case: Case) -> None:
    joints = len(case.recording(case.trace()).sides[case.subject].joints)
    for topic in (case.state_topic, case.cmd_topic):
        for other in ({}, {(topic, "std_msgs::msg::dds_::String_"): [(1, 1, b"")]}):
            trace = case.trace()
            del trace.rows[rows_of(trace, topic)]
            trace.rows |= other
            view = case.recording(trace).sides[case.subject]
            part = view.states if topic == case.state_topic else view.commands
            assert part.topic == topic
            assert len(part) == 0
            assert part.q.shape == (0, joints)


@both
def test_notes_name_what_is_odd_but_not_what_the_kit_did(case: Case) -> None:
    trace = case.trace()
    trace.truncated = True
    trace.warnings = ["a warning", "two types of commands"]
    trace.mixed_types = {case.cmd_topic: "two types of commands"}
    unfinished = "the recording is unfinished; it is judged as far as it goes"
    assert list(case.recording(trace).notes) == ["a warning", unfinished]
