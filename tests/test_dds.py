"""Readers, writers and discovery on loopback, within one process."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from dexkit.dds import (
    DdsNode,
    DiscoveryEvent,
    Endpoint,
    Qos,
    Reader,
    interfaces,
    type_hash,
)
from dexkit.errors import DdsError, DdsSetupError, EncodeError, UsageError, WireError
from dexkit.interface_filter import interface_address
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from tests.dds_helpers import dds_domain, dds_node, free_domain, take_until, wait_until

__all__ = ["dds_domain", "dds_node"]

CMDS = "unitree_go::msg::dds_::MotorCmds_"
STATES = "unitree_go::msg::dds_::MotorStates_"


def test_sample_arrives_unchanged_with_its_timestamp(dds_node: DdsNode) -> None:
    with DdsNode(dds_node.domain, "lo") as other:
        reader = other.reader("rt/t1", STATES)
        writer = dds_node.writer("rt/t1", STATES)
        assert writer.wait_matched(60)
        assert reader.wait_matched(60)
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


def test_reader_keeps_as_many_samples_as_its_depth_in_order(dds_node: DdsNode) -> None:
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
    assert writer.wait_matched(60)
    for _ in range(20):
        writer.write(MotorStates_([]))
        assert arrived.acquire(timeout=60)
        assert len(reader.take()) == 1
    reader.close()
    reader.close()
    assert reader.closed
    writer.write(MotorStates_([]))
    with pytest.raises(DdsError, match="closed"):
        reader.take()
    assert not arrived.acquire(timeout=0.05)


def test_polled_reader_gets_samples_and_wakes_no_thread(
    dds_node: DdsNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    woken: list[Reader] = []
    on_status = Reader._on_status
    monkeypatch.setattr(Reader, "_on_status", lambda r: (woken.append(r), on_status(r)))
    with DdsNode(dds_node.domain, "lo") as other:
        polled = dds_node.reader("rt/polled", CMDS, most=40, polled=True)
        waited = dds_node.reader("rt/polled", CMDS, most=40)
        writer = other.writer("rt/polled", CMDS)
        assert writer.wait_matched(60, count=2)
        found = []
        for i in range(40):
            writer.write(MotorCmds_([MotorCmd_(q=float(i))]))
            found += take_until(waited, bool)
        assert [s.message.cmds[0].q for s in found] == list(range(40))
        got: list[bytes] = []
        wait_until(lambda: got.extend(s.data for s in polled.take()) or len(got) >= len(found))
        assert got == [s.data for s in found]
        assert woken.count(waited) >= 40
        assert woken.count(polled) < 10  # by the writer that was matched
        with pytest.raises(UsageError, match="polled"):
            polled.wait(0)
        with pytest.raises(UsageError, match="polled"):
            dds_node.reader("rt/polled", CMDS, polled=True, on_data=bool)


def test_a_callback_may_close_its_reader_and_its_node(dds_domain: int) -> None:
    done = threading.Event()
    with DdsNode(dds_domain) as other:
        node = DdsNode(dds_domain)

        def close() -> None:
            reader.close()
            node.close()
            done.set()

        reader = node.reader("rt/t11", STATES, on_data=close)
        writer = other.writer("rt/t11", STATES)
        assert reader.wait_matched(60)
        assert writer.wait_matched(60)
        writer.write(MotorStates_([]))
        assert done.wait(60)
        assert node.closed
        node.close()


def test_failing_callback_is_logged_and_the_node_continues(
    dds_node: DdsNode, caplog: pytest.LogCaptureFixture
) -> None:
    called = threading.Semaphore(0)

    def fail() -> None:
        called.release()
        raise RuntimeError("on purpose")

    dds_node.reader("rt/t4", STATES, on_data=fail)
    writer = dds_node.writer("rt/t4", STATES)
    assert writer.wait_matched(60)
    with caplog.at_level(logging.ERROR, logger="dexkit.dds"):
        for _ in range(2):
            writer.write(MotorStates_([]))
            assert called.acquire(timeout=60)
        writer.close()
    assert "on purpose" in caplog.text


def test_discovery_reports_process_topic_type_and_qos(dds_node: DdsNode) -> None:
    events: list[DiscoveryEvent] = []
    unsubscribe = dds_node.discovery.subscribe(events.append)

    def on_topic(found: list[Endpoint]) -> list[Endpoint]:
        return [e for e in found if e.topic == "rt/t5"]

    with DdsNode(dds_node.domain, "lo") as other:
        writer = other.writer("rt/t5", STATES)
        other.reader("rt/t5", CMDS, qos=Qos("reliable", "transient_local", None))
        mine = dds_node.reader("rt/t5", STATES, depth=7)
        assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 3, 60)
        found = {(e.kind, e.type_name, e.own): e for e in on_topic(dds_node.endpoints())}
        assert found["writer", STATES, False].qos == Qos.writer_default()
        assert found["reader", CMDS, False].qos == Qos("reliable", "transient_local", None)
        assert found["reader", STATES, True].qos == Qos("best_effort", "volatile", 7)
        assert len({e.participant for e in found.values()}) == 2
        # same process: the other node announces its process
        assert f"(pid {__import__('os').getpid()})" in found["writer", STATES, False].process
        assert mine.wait_matched(60)
        assert mine.matched == 1  # the reader of another type is not a match
        writer.close()
        assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 2, 60)
    assert dds_node.discovery.wait(lambda e: len(on_topic(e)) == 1, 60)
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


def test_nodes_that_discover_at_once_do_not_mix_up_policies(dds_domain: int) -> None:
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ExitStack() as stack:
            nodes = [stack.enter_context(DdsNode(dds_domain)) for _ in range(4)]
            kinds = {f"rt/{i}": ("reliable", "best_effort")[i % 2] for i in range(150)}
            for topic, kind in kinds.items():
                stack.enter_context(nodes[0].writer(topic, STATES, qos=Qos(kind)))
            for node in nodes:
                assert node.discovery.wait(lambda seen: len(seen) == len(kinds), timeout=60)
                assert {e.topic: e.qos.reliability for e in node.endpoints()} == kinds
    finally:
        sys.setswitchinterval(interval)


def test_incompatible_qos_does_not_match(dds_node: DdsNode) -> None:
    reader = dds_node.reader("rt/t6", STATES, qos=Qos("reliable"))
    writer = dds_node.writer("rt/t6", STATES, qos=Qos("best_effort"))
    good = dds_node.writer("rt/t6", STATES)
    assert good.wait_matched(60)
    assert reader.matched == 1
    assert not writer.wait_matched(0.05)


def test_two_domains_in_one_process_are_separate() -> None:
    with DdsNode(free_domain()) as a, DdsNode(free_domain()) as b:
        reader = b.reader("rt/t7", STATES)
        near = a.reader("rt/t7", STATES)
        writer = a.writer("rt/t7", STATES)
        assert near.wait_matched(60)
        writer.write(MotorStates_([]))
        assert take_until(near, bool)
        assert reader.take() == []
        assert not [e for e in b.endpoints() if not e.own]


def test_a_domain_can_be_opened_again_after_the_last_node_closed() -> None:
    domain = free_domain()
    for _ in range(3):
        with DdsNode(domain) as node:
            reader, writer = node.reader("rt/t8", CMDS), node.writer("rt/t8", CMDS)
            assert writer.wait_matched(60)
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
        thread.join(60)
    # a waiter that comes after the close is refused instead, but none hangs
    assert all(r is False for r in results)


def test_setup_errors_name_the_available_interfaces(dds_domain: int) -> None:
    with pytest.raises(DdsSetupError, match="no network interface 'nope0'") as caught:
        DdsNode(free_domain(), "nope0")
    assert "lo" in caught.value.hint
    assert "lo" in interfaces()
    with pytest.raises(UsageError):
        DdsNode(231)
    other = next((i for i in interfaces() if i != "lo" and interface_address(i)), None)
    if other is not None:
        with DdsNode(dds_domain), pytest.raises(DdsSetupError, match="is on lo, not"):
            DdsNode(dds_domain, other)


def test_invalid_calls_are_refused(dds_node: DdsNode) -> None:
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


def test_invalid_payload_is_delivered_and_raises_on_decoding(dds_node: DdsNode) -> None:
    reader = dds_node.reader("rt/t12", CMDS)
    writer = dds_node.writer("rt/t12", CMDS)
    assert writer.wait_matched(60)
    writer.write_raw(b"\x00\x01\x00\x00\xff\xff\xff\xff")
    (sample,) = take_until(reader, bool)
    with pytest.raises(WireError):
        _ = sample.message


def _run(script: str, *arguments: str, quiet: bool = True) -> str:
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr if quiet else "") == (0, "")
    return done.stdout


@pytest.mark.slow
def test_domain_configured_by_other_code_is_used_and_kept() -> None:
    script = f"""
import logging
from cyclonedds.domain import Domain, DomainParticipant
from dexkit.dds import DdsNode
from dexkit.dds.domain import config
records = []
logging.getLogger("dexkit.dds").warning = lambda *args: records.append(args)
foreign = Domain({free_domain()}, config("lo"))
for _ in range(2):
    with DdsNode(foreign._id) as node, DdsNode(foreign._id) as other:
        writer = node.writer("rt/x", "{CMDS}")
        reader = other.reader("rt/x", "{CMDS}")
        print(writer.wait_matched(60), len(records))
participant = DomainParticipant(foreign._id)
print(len(foreign.get_participants()))
"""
    assert _run(script, quiet=False) == "True 1\nTrue 2\n1\n"


@pytest.mark.slow
def test_participants_of_other_code_outlive_our_domain() -> None:
    script = f"""
from cyclonedds.domain import DomainParticipant
from dexkit.dds import DdsNode
number = {free_domain()}
node = DdsNode(number)
theirs = DomainParticipant(number)
node.close()
print(theirs.domain_id == number)
with DdsNode(number) as node:
    print(node.writer("rt/x", "{CMDS}").matched)
"""
    assert _run(script) == "True\n0\n"


def test_peer_with_an_older_type_layout_is_identified(dds_node: DdsNode) -> None:
    """HandState_ of 2024-08
    (docs/sources/unitree-dex.md#a3) has the same name and does not match.
    """
    name = "unitree_hg::msg::dds_::HandCmd_"
    script = f"""
import sys
from cyclonedds.idl import make_idl_struct, annotations, types
from dexkit import dds
old = make_idl_struct(
    "HandCmd_", "unitree_hg.msg.dds_.HandCmd_",
    dict(motor_cmd=types.sequence[dds.cyclone_type("unitree_hg::msg::dds_::MotorCmd_")]),
)
annotations.final(old)
annotations.autoid("sequential")(old)
dds.node.cyclone_type = lambda name: old
with dds.DdsNode({dds_node.domain}) as node:
    writer = node.writer("rt/t13", "{name}")
    print("up", flush=True)
    sys.stdin.read()
    print(writer.matched)
"""
    reader = dds_node.reader("rt/t13", name)
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert dds_node.discovery.wait(
            lambda found: any(e.topic == "rt/t13" and not e.own for e in found), 30
        )
        (theirs,) = [e for e in dds_node.endpoints() if e.topic == "rt/t13" and not e.own]
        assert theirs.type_name == name
        assert theirs.type_hash not in ("", type_hash(name))
        assert not reader.wait_matched(0.2)
    finally:
        output, _ = process.communicate(timeout=60)
    assert output == "up\n0\n"


def test_missing_cyclonedds_is_reported_on_use_and_not_on_import() -> None:
    script = """
import sys
sys.modules["cyclonedds"] = None
import dexkit.dds
from dexkit.errors import DdsUnavailable
try:
    dexkit.dds.DdsNode(1)
except DdsUnavailable as error:
    print(isinstance(error, ImportError), "dexkit setup-dds" in error.hint)
"""
    assert _run(script) == "True True\n"
    assert _run("import sys, dexkit.dds; print('cyclonedds' in sys.modules)") == "False\n"


@pytest.mark.slow
def test_two_libraries_in_one_process_are_refused(tmp_path: Path) -> None:
    """As where ROS 2's library is preloaded, or came with rclpy; it hung."""
    script = """
import ctypes, shutil, sys
import cyclonedds.core
from dexkit.dds_library import loaded_here
(own,) = loaded_here()
other = shutil.copy(own, sys.argv[1])
ctypes.CDLL(other)
from dexkit.dds import DdsNode
try:
    DdsNode(1)
except ImportError as error:
    print(own in str(error), other in str(error), "rclpy" in error.hint)
"""
    assert _run(script, str(tmp_path / "libddsc.so.0")) == "True True True\n"


@pytest.mark.slow
def test_cyclonedds_11_is_refused() -> None:
    script = """
from importlib import metadata
metadata.version = lambda name: "11.0.1"
from dexkit.dds import DdsNode
try:
    DdsNode(1)
except ImportError as error:
    print(error)
"""
    assert _run(script) == "CycloneDDS 11.0.1 is installed, dexkit needs 0.10.x\n"


@pytest.mark.slow
def test_the_log_goes_to_a_file_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "dds.log"
    script = f"""
import os
os.environ["DEXKIT_DDS_LOG"] = {str(path)!r}
from dexkit.dds import DdsNode
DdsNode({free_domain()}).close()
"""
    assert _run(script) == ""
    assert "lo" in path.read_text()


def test_nothing_reaches_stderr_and_exit_without_close_is_clean() -> None:
    script = (
        "from dexkit.dds import DdsNode\n"
        f"node = DdsNode({free_domain()})\n"
        f"r = node.reader('rt/x', '{CMDS}'); w = node.writer('rt/x', '{CMDS}')\n"
        "print(w.wait_matched(60))\n"
    )
    assert _run(script) == "True\n"


STUCK = """
import logging
import sys
import threading
from dexkit import dds

logging.basicConfig()
dds.node._EXIT_PATIENCE = 0.2
node, other = dds.DdsNode(int(sys.argv[1])), dds.DdsNode(int(sys.argv[1]))
inside = threading.Event()

def callback(event):
    inside.set()
    threading.Event().wait()

node.discovery.subscribe(lambda event: event.endpoint.own or callback(event))
other.writer("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
assert inside.wait(60)
"""


@pytest.mark.slow
def test_a_callback_that_never_returns_does_not_keep_the_process() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STUCK, str(free_domain())],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == 0, done.stderr
    assert "was not closed within 0.2 s" in done.stderr
