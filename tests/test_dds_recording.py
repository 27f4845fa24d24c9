"""Which topics a recording of DDS subscribes to, and as which type."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from dexkit.messages import message_type
from dexkit.models import DIALECTS
from dexkit.traces import Recorder, dds_recording, open_trace
from dexkit.traces.dds_recording import DdsRecording
from tests.dds_helpers import DdsNode, free_domain, wait_until
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, state


def types_read(node: DdsNode) -> set[tuple[str, str]]:
    """What the other participants of the domain subscribe."""
    return {(e.topic, e.type_name) for e in node.endpoints() if e.kind == "reader" and not e.own}


def test_topic_is_recorded_with_the_type_its_writer_announces(tmp_path: Path) -> None:
    """A reader of another dialect's type would look to the service like a peer that errs."""
    domain = free_domain()
    with DdsNode(domain) as hand, DdsNode(domain) as node, Recorder(tmp_path / "a.mcap") as out:
        hand.writer(STATE, STATE_TYPE)
        hand.reader(CMD, CMD_TYPE)
        with DdsRecording(node, out, [STATE, "/dex1/left/cmd"]) as recording:
            expected = {(STATE, STATE_TYPE), (CMD, CMD_TYPE)}
            assert hand.discovery.wait(lambda _: types_read(hand) >= expected, timeout=60)
            assert types_read(hand) == expected
        assert recording.subscribed == [CMD, STATE]


def test_known_topic_is_subscribed_before_it_has_a_writer(tmp_path: Path) -> None:
    domain = free_domain()
    expected = {(CMD, DIALECTS[name].cmd_type) for name in ("unitree_go", "unitree_hg")}
    with (
        DdsNode(domain) as other,
        DdsNode(domain) as node,
        Recorder(tmp_path / "a.mcap") as out,
        DdsRecording(node, out, [CMD, "/unknown/topic"]) as recording,
    ):
        assert recording.subscribed == [CMD]
        assert other.discovery.wait(lambda _: types_read(other) == expected, timeout=60)


def test_topics_that_nothing_uses_yet_are_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dds_recording, "_DISCOVERY_WAIT", 3600.0)
    with (
        DdsNode(free_domain()) as node,
        Recorder(tmp_path / "a.mcap") as out,
        DdsRecording(node, out, [CMD], fresh=True) as recording,
    ):
        assert recording.subscribed == [CMD]


def test_polling_records_every_sample_in_order(tmp_path: Path) -> None:
    domain = free_domain()
    path = tmp_path / "a.mcap"
    kind = message_type(STATE_TYPE)
    with DdsNode(domain) as hand, DdsNode(domain) as node:
        writer = hand.writer(STATE, STATE_TYPE)
        with (
            Recorder(path) as out,
            DdsRecording(node, out, [STATE], types={STATE: STATE_TYPE}, poll=0.001),
        ):
            assert writer.wait_matched(60)
            for i in range(100):
                writer.write_raw(state(float(i)))
            wait_until(lambda: out.offered.get(STATE, 0) == 100)
    found = [kind.decode(m.data).states[0].q for m in open_trace(path).messages()]
    assert found == list(range(100))


def test_given_type_overrides_discovery(tmp_path: Path) -> None:
    domain = free_domain()
    with (
        DdsNode(domain) as other,
        DdsNode(domain) as node,
        Recorder(tmp_path / "a.mcap") as out,
        DdsRecording(node, out, [CMD], types={CMD: CMD_TYPE}),
    ):
        assert other.discovery.wait(lambda _: types_read(other), timeout=60)
        assert types_read(other) == {(CMD, CMD_TYPE)}


def test_time_without_a_look_for_samples_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes meanwhile has the time of its end, which says nothing of the hand."""
    domain = free_domain()
    told: list[tuple[int, int, float]] = []
    held, goes_on = threading.Event(), threading.Event()

    def read_samples(self: DdsRecording) -> None:
        held.set()
        goes_on.wait(60)

    monkeypatch.setattr(DdsRecording, "_read_samples", read_samples)
    begin = time.time_ns()
    with (
        DdsNode(domain) as node,
        Recorder(tmp_path / "a.mcap") as out,
        DdsRecording(
            node,
            out,
            [CMD],
            types={CMD: CMD_TYPE},
            poll=0.01,
            on_late=lambda *x: told.append(x),
        ),
    ):
        assert held.wait(60)
        until = time.monotonic() + 0.1
        wait_until(lambda: time.monotonic() > until)
        goes_on.set()
        # a busy machine may have been late by a little before
        wait_until(lambda: any(late > 0.08 for *_, late in told))
    first, last, late = next(t for t in told if t[2] > 0.08)
    assert begin <= first < last <= time.time_ns()
    assert late == pytest.approx((last - first) / 1e9 - 0.01, abs=0.005)
    assert late > 0.08
