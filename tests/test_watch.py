"""The collector: rates, ages, gaps and each hand's values, for any moment."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import UsageError
from dexkit.hand import MotorError, Side
from dexkit.messages import message_type, unitree_go, unitree_hg
from dexkit.messages.columns import RowReader
from dexkit.models import DEX1_1, DEX3_1
from dexkit.traces import open_trace, sample_path
from dexkit.traces.watched import feed
from dexkit.watch import Collector
from dexkit.watch.cycles import Cycles
from dexkit.watch.fields import parts_of
from tests.watch_helpers import COMMAND, STATE, closing_hands, dex3_command, dex3_state, ns

LEFT = "rt/dex3/left/state"
GO_STATES = "unitree_go::msg::dds_::MotorStates_"
FEW = settings(max_examples=25, deadline=None)


# -- cycles ----------------------------------------------------------------------------------------


@FEW
@given(missing=st.sets(st.integers(20, 398), max_size=20), cut=st.lists(st.integers(0, 400)))
def test_missed_cycles_are_counted_however_the_times_are_split(
    missing: set[int], cut: list[int]
) -> None:
    times = np.array([i * 0.01 for i in range(400) if i not in missing])
    whole, parts = Cycles(), Cycles()
    whole.add(times)
    edges = sorted({0, len(times), *(c for c in cut if c < len(times))})
    for begin, end in pairwise(edges):
        parts.add(times[begin:end])
    assert (whole.count, whole.missed, whole.gaps) == (parts.count, parts.missed, parts.gaps)
    # one missing cycle is within the jitter; two or more in a row are a gap
    runs = np.split(sorted(missing), np.flatnonzero(np.diff(sorted(missing)) > 1) + 1)
    expected = sum(len(run) for run in runs if len(run) > 1)
    assert whole.missed == expected


def test_gaps_after_a_moment_do_not_count_for_it() -> None:
    cycles = Cycles()
    cycles.add(np.array([*(-0.01 * i for i in range(30, 0, -1)), 0.0]))
    cycles.add(np.array([0.01, 0.11, 0.12, 0.52, 0.53]))
    assert cycles.until(0.3) == (1, 9, pytest.approx(0.1))
    assert cycles.until(1.0) == (2, 48, pytest.approx(0.4))
    early = Cycles()
    early.add(np.array([0.0, 0.01, 0.11, *(0.11 + 0.01 * i for i in range(1, 14))]))
    assert early.count == 0  # not before there are 16 intervals
    early.add(np.array([0.25, 0.26]))
    assert (early.count, early.missed) == (1, 9)


# -- rows ------------------------------------------------------------------------------------------


@FEW
@given(
    counts=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3)), min_size=1, max_size=6),
    spoilt=st.integers(-1, 5),
    big=st.booleans(),
)
def test_rows_are_those_of_columns(counts: list[tuple[int, int]], spoilt: int, big: bool) -> None:
    kind = message_type(STATE)
    payloads = []
    for i, (motors, sensors) in enumerate(counts):
        payload = kind.encode(
            unitree_hg.HandState_(
                [unitree_hg.MotorState_(q=j + i / 8, motorstate=2**31 + j) for j in range(motors)],
                [unitree_hg.PressSensorState_(pressure=(float(i),) * 12) for _ in range(sensors)],
            )
        )
        payloads.append(payload[:-5] if i == spoilt else payload)
    if big:
        # its numbers mean something else then, in both alike
        payloads.append(b"\0\0" + kind.encode(unitree_hg.HandState_())[2:])
    paths = [f.path for f in parts_of(LEFT, STATE)[0].fields]
    rows, good = RowReader(kind.layout, paths).read(payloads)
    columns = kind.columns(payloads)
    assert good.tolist() == columns.ok.tolist()
    np.testing.assert_array_equal(rows, columns.table(paths))


# -- collector -------------------------------------------------------------------------------------


def test_picture_holds_command_and_faults_of_a_hand() -> None:
    collector = Collector()
    q = [0.0, 1.04, 0.5, -0.5, -1.74, -0.5, -0.5]
    bits = int(MotorError.WINDING_OVERTEMPERATURE | MotorError.HOST_SAW_MOTOR_TIMEOUT)
    state = dex3_state(q, {2: bits}, pressure=30000.0)
    collector.take(LEFT, STATE, [state], [ns(0)], [ns(0)])
    collector.take("rt/dex3/left/cmd", COMMAND, [dex3_command([0.1] * 7)], [ns(0.1)], [ns(0.1)])
    (hand,) = collector.picture(0.15).subjects
    assert (hand.subject, hand.model, hand.dialect) == (Side.LEFT, DEX3_1, "dex3")
    np.testing.assert_allclose(hand.q, q, rtol=1e-6)
    np.testing.assert_allclose(hand.target, [0.1] * 7, rtol=1e-6)
    assert hand.near.tolist() == [0, 1, 0, 0, -1, 0, 0]
    assert hand.faults == ["thumb_2: winding overtemperature", "thumb_2: host saw motor timeout"]
    assert len(hand.pressure) == sum(len(s.slots) for s in DEX3_1.sensors)
    assert np.isnan(hand.pressure).all()  # 30000 means that there is no element
    assert hand.age == pytest.approx(0.15)
    assert hand.command_age == pytest.approx(0.05)
    assert not hand.stale
    later = collector.picture(2.0).subjects[0]
    assert later.stale
    assert np.isnan(later.target).all()  # the command has run out


def test_a_brake_has_no_target() -> None:
    collector = Collector()
    braking = dex3_command([0.1] * 7, status=0)
    collector.take("rt/dex3/left/cmd", COMMAND, [braking], [ns(0)], [ns(0)])
    (hand,) = collector.picture(0.0).subjects
    assert np.isnan(hand.target).all()
    assert math.isnan(hand.age)
    assert hand.stale


def test_both_grippers_on_one_topic() -> None:
    states = unitree_go.MotorStates_([unitree_go.MotorState_(q=1.0), unitree_go.MotorState_(q=2.0)])
    payload = message_type(GO_STATES).encode(states)
    collector = Collector()
    collector.take("rt/unitree_actuator/state", GO_STATES, [payload], [ns(0)], [0])
    found = {s.subject: float(s.q[0]) for s in collector.picture(0.0).subjects}
    assert found == {Side.LEFT: 2.0, Side.RIGHT: 1.0}


def test_the_interface_specification_has_its_own_scale() -> None:
    collector = Collector()
    message = unitree_hg.HandState_([unitree_hg.MotorState_(q=2 * math.pi)])
    payload = message_type(STATE).encode(message)
    collector.take("rt/dex1/right/state", STATE, [payload], [ns(0)], [ns(0)])
    (hand,) = collector.picture(0.0).subjects
    assert hand.model is DEX1_1
    assert hand.fraction.tolist() == [pytest.approx(1.0)]
    assert hand.near.tolist() == [1]


def test_samples_taken_together_keep_their_distances() -> None:
    collector = Collector()
    state = dex3_state([0.0] * 7)
    late = 0.005  # between this clock and the publisher's, and on the way
    for begin in range(0, 200, 20):
        sent = [ns(i * 0.01) for i in range(begin, begin + 20)]
        taken = sent[-1] + round(late * 1e9)
        collector.take(LEFT, STATE, [state] * 20, [taken] * 20, sent, [7] * 20)
    at = collector.last
    (topic,) = collector.picture(at).topics
    assert (topic.samples, topic.gaps, topic.missed, topic.writers) == (200, 0, 0, 1)
    assert topic.rate == pytest.approx(100.0, abs=1.0)
    assert topic.expected == DEX3_1.state_rate


def test_two_writers_are_counted_apart() -> None:
    collector = Collector()
    state = dex3_state([0.0] * 7)
    stamps = [ns(i * 0.001) for i in range(500)]
    collector.take(LEFT, STATE, [state] * 500, stamps, stamps, [1, 2] * 250)
    (topic,) = collector.picture(0.499).topics
    assert topic.writers == 2
    assert topic.gaps == 0  # each has a period of 2 ms


def test_what_cannot_be_decoded_is_counted() -> None:
    collector = Collector()
    good = dex3_state([0.0] * 7)
    stamps = [ns(i / 10) for i in range(3)]
    collector.take(LEFT, STATE, [good, good[:-8], b""], stamps, stamps)
    (topic,) = collector.picture(0.2).topics
    assert (topic.samples, topic.undecodable) == (3, 2)


def test_publishers_and_topics_without_samples_are_listed() -> None:
    collector = Collector()
    collector.endpoint("a", LEFT, "writer", "python (pid 7)")
    collector.endpoint("b", LEFT, "reader", "")
    collector.endpoint("c", "rt/dex3/left/cmd", "reader", "python (pid 7)")
    found = {t.name: t for t in collector.picture(0.0).topics}
    assert found[LEFT].publishers == ("python (pid 7)",)
    assert found[LEFT].subscribers == ("?",)
    assert math.isnan(found[LEFT].age)
    collector.endpoint_gone("a")
    collector.endpoint_gone("a")
    assert [t.publishers for t in collector.picture(0.0).topics] == [(), ()]


def test_too_many_topics_are_ignored() -> None:
    collector = Collector()
    for i in range(300):
        collector.take(f"rt/other/{i}", "", [b""], [ns(0)], [0])
    assert len(collector.picture(0.0).topics) == 256
    assert collector.ignored == 44


def test_curves_are_the_history_of_a_number() -> None:
    collector = closing_hands(2.0)
    name, part, field = next(f for f in collector.fields() if f[2].name == "thumb_2 q")
    assert (name, part.subject, field.unit) == ("rt/dex3/left/cmd", Side.LEFT, "rad")
    t, values = collector.curve(LEFT, "motor_state[2].q", 0.5, 1.0)
    assert len(t) == 51
    picture = collector.picture(1.0).subjects[0]
    assert values[-1] == pytest.approx(picture.q[2])
    with pytest.raises(UsageError):
        collector.curve(LEFT, "nothing", 0.0, 1.0)


# -- recordings ------------------------------------------------------------------------------------


def test_a_recording_is_taken_whole() -> None:
    trace = open_trace(sample_path("dex1_hand_dropout"))
    collector = feed(trace)
    picture = collector.picture(collector.last)
    counts = {t.name: t.samples for t in picture.topics}
    assert counts == {c.topic: c.message_count for c in trace.channels}
    # the left hand is silent for 1.5 s in this session (docs/traces.md)
    silent = [
        at
        for at in np.arange(1.0, collector.last - 0.1, 0.1)
        if collector.picture(float(at)).subjects[0].stale
    ]
    assert 8 <= len(silent) <= 12
    (_, length, _) = max(collector.gaps("rt/dex1/left/state"), key=lambda g: g[1])
    assert length == pytest.approx(1.5, abs=0.1)
