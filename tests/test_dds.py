"""Readers, writers and discovery on loopback, within one process."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time

import pytest

from dexkit.dds import DdsNode, DiscoveryEvent, Endpoint, Qos, interfaces
from dexkit.errors import DdsError, DdsSetupError, EncodeError, UsageError
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from tests.dds_helpers import dds_domain, dds_node, free_domain, take_until

__all__ = ["dds_domain", "dds_node"]

CMDS = "unitree_go::msg::dds_::MotorCmds_"
STATES = "unitree_go::msg::dds_::MotorStates_"


def test_a_sample_travels_unchanged_with_its_timestamp(dds_node: DdsNode) -> None:
    with DdsNode(dds_node.domain, "lo") as other:
        reader = other.reader("rt/t1", STATES)
        writer = dds_node.writer("rt/t1", STATES)
        assert writer.wait_matched(10)
        assert reader.wait_matched(10)
        message = MotorStates_([MotorState_(q=1.5, tau_est=-0.5)])
        before = time.time_ns()
        assert writer.write(message, source_timestamp_ns=123_456_789_000)
        (sample,) = take_until(reader, bool)
        assert sample.data == message_type(STATES).encode(message)
        assert sample.message == message
        assert sample.source_timestamp_ns == 123_456_789_000
        assert before <= sample.reception_ns <= time.time_ns()
        writer.write(message)
        (sample,) = take_until(reader, bool)
        assert before <= sample.source_timestamp_ns <= sample.reception_ns


def test_depth_and_order(dds_node: DdsNode) -> None:
    deep = dds_node.reader("rt/t2", STATES, depth=1000)
    shallow = dds_node.reader("rt/t2", STATES)
    writer = dds_node.writer("rt/t2", STATES)
    assert writer.wait_matched(10, count=2)
    for i in range(300):
        writer.write(MotorStates_([MotorState_(lost=i)]))
    samples = take_until(deep, lambda s: len(s) >= 300)
    assert [s.message.states[0].lost for s in samples] == list(range(300))
    assert len({s.writer for s in samples}) == 1
    (newest,) = shallow.take()
    assert newest.message.states[0].lost == 299
    assert shallow.take() == []
    assert not shallow.wait(0)


def test_on_data_wakes_once_per_arrival_and_never_after_close(dds_node: DdsNode) -> None:
    arrived = threading.Semaphore(0)
    reader = dds_node.reader("rt/t3", STATES, on_data=arrived.release)
    writer = dds_node.writer("rt/t3", STATES)
    assert writer.wait_matched(10)
    for _ in range(20):
        writer.write(MotorStates_([]))
        assert arrived.acquire(timeout=10)
        assert len(reader.take()) == 1
    reader.close()
    reader.close()
    assert reader.closed
    writer.write(MotorStates_([]))
    with pytest.raises(DdsError, match="closed"):
        reader.take()
    assert not arrived.acquire(timeout=0.05)


def test_a_failing_callback_is_logged_and_the_node_lives_on(
    dds_node: DdsNode, caplog: pytest.LogCaptureFixture
) -> None:
    called = threading.Semaphore(0)

    def fail() -> None:
        called.release()
        raise RuntimeError("on purpose")

    dds_node.reader("rt/t4", STATES, on_data=fail)
    writer = dds_node.writer("rt/t4", STATES)
    assert writer.wait_matched(10)
    with caplog.at_level(logging.ERROR, logger="dexkit.dds"):
        for _ in range(2):
            writer.write(MotorStates_([]))
            assert called.acquire(timeout=10)
        writer.close()
    assert "on purpose" in caplog.text


def test_discovery_tells_who_what_and_how(dds_node: DdsNode) -> None:
    events: list[DiscoveryEvent] = []
    unsubscribe = dds_node.discovery.subscribe(events.append)

    def on_topic(found: list[Endpoint]) -> list[Endpoint]:
        return [e for e in found if e.topic == "rt/t5"]

    with DdsNode(dds_node.domain, "lo") as other:
        writer = other.writer("rt/t5", STATES)
        other.reader("rt/t5", CMDS, qos=Qos("reliable", "transient_local", None))
        mine = dds_node.reader("rt/t5", STATES, depth=7)
        assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 3, 10)
        found = {(e.kind, e.type_name, e.own): e for e in on_topic(dds_node.endpoints())}
        assert found["writer", STATES, False].qos == Qos.writer_default()
        assert found["reader", CMDS, False].qos == Qos("reliable", "transient_local", None)
        assert found["reader", STATES, True].qos == Qos("best_effort", "volatile", 7)
        assert len({e.participant for e in found.values()}) == 2
        # same process: the other node says who it is
        assert f"(pid {__import__('os').getpid()})" in found["writer", STATES, False].process
        assert mine.wait_matched(10)
        assert mine.matched == 1  # the reader of another type is not a match
        writer.close()
        assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 2, 10)
    assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 1, 10)
    unsubscribe()
    seen = [(e.appeared, e.endpoint.kind) for e in events if e.endpoint.topic == "rt/t5"]
    assert sorted(seen) == sorted(
        [
            (True, "writer"),
            (True, "reader"),
            (True, "reader"),
            (False, "writer"),
            (False, "reader"),
        ]
    )


def test_incompatible_qos_does_not_match(dds_node: DdsNode) -> None:
    reader = dds_node.reader("rt/t6", STATES, qos=Qos("reliable"))
    writer = dds_node.writer("rt/t6", STATES, qos=Qos("best_effort"))
    good = dds_node.writer("rt/t6", STATES)
    assert good.wait_matched(10)
    assert reader.matched == 1
    assert not writer.wait_matched(0.05)


def test_two_domains_in_one_process_do_not_mix() -> None:
    with DdsNode(free_domain()) as a, DdsNode(free_domain()) as b:
        reader = b.reader("rt/t7", STATES)
        near = a.reader("rt/t7", STATES)
        writer = a.writer("rt/t7", STATES)
        assert near.wait_matched(10)
        writer.write(MotorStates_([]))
        assert take_until(near, bool)
        assert reader.take() == []
        assert not [e for e in b.endpoints() if not e.own]


def test_a_domain_can_be_opened_again_after_the_last_node_closed() -> None:
    domain = free_domain()
    for _ in range(3):
        with DdsNode(domain) as node:
            reader, writer = node.reader("rt/t8", CMDS), node.writer("rt/t8", CMDS)
            assert writer.wait_matched(10)
            writer.write(MotorCmds_([MotorCmd_(q=1.0)]))
            assert take_until(reader, bool)
        node.close()
        assert node.closed
        assert reader.closed
        with pytest.raises(DdsError, match="closed"):
            writer.write(MotorCmds_([]))
        with pytest.raises(DdsError, match="closed"):
            node.reader("rt/t8", CMDS)


def test_a_node_that_closes_frees_waiters(dds_domain: int) -> None:
    node = DdsNode(dds_domain)
    reader, writer = node.reader("rt/t9", CMDS), node.writer("rt/t9", STATES)
    results: list[bool] = []
    threads = [
        threading.Thread(target=lambda f=f: results.append(f()))  # type: ignore[misc]
        for f in (reader.wait, writer.wait_matched, lambda: node.discovery.wait(lambda e: False))
    ]
    for thread in threads:
        thread.start()
    node.close()
    for thread in threads:
        thread.join(10)
    # a waiter that comes after the close is refused instead, but none hangs
    assert all(r is False for r in results)


def test_setup_errors_name_what_there_is(dds_domain: int) -> None:
    with pytest.raises(DdsSetupError, match="no network interface 'nope0'") as caught:
        DdsNode(free_domain(), "nope0")
    assert "lo" in caught.value.hint
    assert "lo" in interfaces()
    with pytest.raises(UsageError):
        DdsNode(231)
    other = next((i for i in interfaces() if i != "lo"), None)
    if other is not None:
        with DdsNode(dds_domain), pytest.raises(DdsSetupError, match="is on lo, not"):
            DdsNode(dds_domain, other)


def test_bad_use_is_refused(dds_node: DdsNode) -> None:
    writer = dds_node.writer("rt/t10", CMDS)
    with pytest.raises(EncodeError):
        writer.write(MotorStates_([]))
    with pytest.raises(EncodeError):
        writer.write_raw(b"\x00\x01")
    with pytest.raises(UsageError):
        dds_node.reader("rt/t10", "no::such::Type_")
    with pytest.raises(UsageError):
        Qos("sometimes")
    with pytest.raises(DdsSetupError):
        dds_node.reader("no spaces allowed", CMDS)


def test_nothing_reaches_stderr_and_exit_without_close_is_clean() -> None:
    script = (
        "from dexkit.dds import DdsNode\n"
        f"node = DdsNode({free_domain()})\n"
        f"r = node.reader('rt/x', '{CMDS}'); w = node.writer('rt/x', '{CMDS}')\n"
        "print(w.wait_matched(10))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")
