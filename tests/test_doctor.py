"""Faults on DDS, made with real participants, get the doctor's diagnosis.

One look sees all situations, each on a domain of its own.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from click.testing import CliRunner

from dexkit.child_processes import command_line
from dexkit.cli import cli
from dexkit.dds import DdsNode, Qos, Writer, type_hash
from dexkit.doctor import Finding, Observations, Scope, diagnose, readiness
from dexkit.doctor import dds as doctor_dds
from dexkit.doctor.rtps import parse_message, unicast_port
from dexkit.doctor.type_hashes import TYPE_HASHES
from dexkit.domains import ReservedDomain
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from dexkit.models import DIALECTS
from tests import doctor_packets as packets
from tests.dds_helpers import free_domain, wait_until
from tests.patience import PATIENCE
from tests.process_helpers import started

CMDS, STATES = (f"unitree_go::msg::dds_::{name}" for name in ("MotorCmds_", "MotorStates_"))
HAND_CMD, HAND_STATE = (f"unitree_hg::msg::dds_::{name}" for name in ("HandCmd_", "HandState_"))
HG_LOW = "unitree_hg::msg::dds_::LowState_"

_FIRST_DOMAIN = 80
"""Below those that programs and free_domain() choose: these would meet somebody."""


class _World:
    """Participants by situation, and a thread that publishes for all of them."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.stack = stack
        self.domains: dict[str, int] = {}
        self._publishing: list[tuple[Writer, list[bytes]]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)

    def node(self, situation: str) -> DdsNode:
        domain = self.domains.setdefault(situation, _FIRST_DOMAIN + len(self.domains))
        return self.stack.enter_context(DdsNode(domain, "lo"))

    def write(self, node: DdsNode, topic: str, type_name: str, *messages: object) -> None:
        writer = node.writer(topic, type_name)
        self._publishing.append((writer, [writer.type.encode(m) for m in messages]))

    def start(self) -> None:
        self._thread.start()
        self.stack.callback(self._end)  # before the nodes close

    def _publish(self) -> None:
        turn = 0
        while not self._stop.wait(0.01):
            turn += 1
            for writer, messages in self._publishing:
                if messages:
                    writer.write_raw(messages[turn % len(messages)])

    def _end(self) -> None:
        self._stop.set()
        self._thread.join()


def _states(q: float = 2.5) -> go.MotorStates_:
    return go.MotorStates_([go.MotorState_(q=q)])


def _hand(q: float) -> hg.HandState_:
    return hg.HandState_([hg.MotorState_(q=q) for _ in range(7)])


def _gripper(world: _World, node: DdsNode, *sides: str, **more: float) -> None:
    for side in sides or ("left", "right"):
        world.write(node, f"rt/dex1/{side}/state", STATES, _states(**more))
        node.reader(f"rt/dex1/{side}/cmd", CMDS)


def _client(node: DdsNode, *sides: str) -> None:
    for side in sides or ("left", "right"):
        node.reader(f"rt/dex1/{side}/state", STATES)
        node.writer(f"rt/dex1/{side}/cmd", CMDS)


def _dex3(world: _World, node: DdsNode, q: float) -> None:
    for side in ("left", "right"):
        world.write(node, f"rt/dex3/{side}/state", HAND_STATE, _hand(q))
        node.reader(f"rt/dex3/{side}/cmd", HAND_CMD)


def _build(world: _World) -> None:
    node = world.node("good")
    _gripper(world, node)
    _client(world.node("good"))

    _client(world.node("nobody"))

    _gripper(world, world.node("one side"), "left")
    _client(world.node("one side"))

    node = world.node("other stack")
    world.write(node, "rt/unitree_actuator/state", STATES, go.MotorStates_([go.MotorState_()] * 2))
    node.reader("rt/unitree_actuator/cmd", CMDS)
    _client(world.node("other stack"))

    node = world.node("name")
    world.write(node, "dex1/left/state", STATES, _states())
    world.write(node, "/dex1/right/state", STATES, _states())
    _client(world.node("name"))

    node = world.node("type")
    world.write(node, "rt/dex1/left/state", HAND_STATE, hg.HandState_([hg.MotorState_(q=1.0)]))
    _client(world.node("type"), "left")

    node = world.node("qos")
    node.writer("rt/dex1/left/state", STATES, qos=Qos("best_effort"))
    world.node("qos").reader("rt/dex1/left/state", STATES, qos=Qos("reliable"))

    node = world.node("silent")
    for side in ("left", "right"):
        node.writer(f"rt/dex1/{side}/state", STATES)
    node.reader("rt/dex1/left/cmd", CMDS)

    _dex3(world, world.node("zero"), 0.0)
    _dex3(world, world.node("dex3"), 0.3)

    node = world.node("frozen")
    _gripper(world, node)
    client = world.node("frozen")
    for side in ("left", "right"):
        commands = [go.MotorCmds_([go.MotorCmd_(q=q, kp=5.0)]) for q in (1.0, 2.0, 3.0)]
        world.write(client, f"rt/dex1/{side}/cmd", CMDS, *commands)

    node = world.node("limp")
    _gripper(world, node)
    client = world.node("limp")
    for side in ("left", "right"):
        commands = [go.MotorCmds_([go.MotorCmd_(q=q)]) for q in (1.0, 2.0, 3.0)]
        world.write(client, f"rt/dex1/{side}/cmd", CMDS, *commands)

    for q in (1.0, 4.0):
        _gripper(world, world.node("two publishers"), q=q)

    node = world.node("body")
    for topic in ("rt/lowstate", "rt/lf/lowstate"):
        node.reader(topic, HG_LOW)
    world.write(world.node("body"), "rt/lowstate", HG_LOW, hg.LowState_())

    world.write(world.node("unheard"), "rt/dex3/left/cmd", HAND_CMD, hg.HandCmd_())


@dataclass(frozen=True)
class _Looked:
    domains: dict[str, int]
    seen: Observations

    def findings(self, situation: str, *dialects: str) -> dict[str, Finding]:
        number = self.domains[situation]
        views = [v for v in self.seen.domains if v.number == number]
        scope = Scope(number, tuple(DIALECTS[name] for name in dialects))
        return {f.id: f for f in diagnose(Observations(domains=tuple(views)), scope)}

    def ready(self, situation: str) -> dict[str, str]:
        views = [v for v in self.seen.domains if v.number == self.domains[situation]]
        found = readiness(Observations(domains=tuple(views)))
        return {r.dialect: r.missing for r in found}


def _reserved() -> ReservedDomain:
    """The first domain, as soon as no other worker, checkout or user of this machine has it."""
    found: list[ReservedDomain] = []

    def reserve() -> bool:
        with contextlib.suppress(OSError):
            found.append(ReservedDomain(_FIRST_DOMAIN))
        return bool(found)

    wait_until(reserve, 4 * PATIENCE)
    return found[0]


@pytest.fixture(scope="module")
def looked() -> _Looked:
    with contextlib.ExitStack() as stack:
        stack.enter_context(_reserved())
        world = _World(stack)
        _build(world)
        world.start()
        views = doctor_dds.observe_domains(sorted(world.domains.values()), seconds=1.0)
    return _Looked(world.domains, Observations(domains=views))


def test_working_client_and_service_have_no_finding(looked: _Looked) -> None:
    # 100 states a second is what this test publishes: too slow, and nothing else
    assert set(looked.findings("good")) == {"DDS-RATE"}
    assert looked.ready("good") == {"unitree_go": ""}
    assert set(looked.findings("dex3")) == {"DDS-RATE", "DDS-NO-CLIENT"}
    assert looked.ready("dex3") == {"dex3": ""}


@pytest.mark.parametrize(
    ("situation", "name", "expected"),
    [
        ("nobody", "DDS-NOBODY", "no hand on any domain"),
        ("one side", "DDS-ONE-SIDE", "not rt/dex1/right/state"),
        ("other stack", "DDS-OTHER-STACK", "rt/unitree_actuator/state"),
        ("name", "DDS-NAME", "rt/"),
        ("type", "DDS-TYPE", "unitree_hg HandState_"),
        ("qos", "DDS-QOS", "the reader asks for reliable and the writer is best-effort"),
        ("silent", "DDS-SILENT", "no sample"),
        ("silent", "DDS-HAND-DEAF", "rt/dex1/right/cmd"),
        ("zero", "DDS-ALL-ZERO", "every q is 0.0"),
        ("frozen", "DDS-FROZEN", "identical states while the commands moved by 2.00 rad"),
        ("two publishers", "DDS-TWO-PUBLISHERS", " and by "),
        ("body", "DDS-UNPUBLISHED", "waits for rt/lf/lowstate (unitree_hg LowState_)"),
        ("unheard", "DDS-UNHEARD", "rt/dex3/left/cmd"),
    ],
)
def test_each_fault_gets_its_diagnosis(
    looked: _Looked, situation: str, name: str, expected: str
) -> None:
    found = looked.findings(situation)
    assert name in found, sorted(found)
    assert expected in found[name].seen
    assert found[name].fix
    if situation == "body":
        (stream,) = [s for v in looked.seen.domains for s in v.streams if s.topic == "rt/lowstate"]
        assert stream.samples > 0
        assert len([f for f in found if f == name]) == 1
    if situation not in ("two publishers", "frozen", "body"):
        assert all(looked.ready(situation).values())


def test_hand_that_is_commanded_without_gains_is_not_frozen(looked: _Looked) -> None:
    assert looked.seen.domains
    (command,) = {
        (s.q_span, s.driven_span)
        for view in looked.seen.domains
        if view.number == looked.domains["limp"]
        for s in view.streams
        if s.topic.endswith("cmd")
    }
    assert command == (2.0, 0.0)
    assert "DDS-FROZEN" not in looked.findings("limp")
    assert "DDS-NO-GAINS" in looked.findings("limp")


def test_hand_on_another_domain_is_reported(looked: _Looked) -> None:
    hand, client = looked.domains["good"], looked.domains["nobody"]
    views = tuple(v for v in looked.seen.domains if v.number in (hand, client))
    seen = Observations(domains=views)
    for scope in (Scope(), Scope(domain=client)):
        (found,) = [f for f in diagnose(seen, scope) if f.id == "DDS-OTHER-DOMAIN"]
        assert f"on domain {hand}" in found.seen
        assert "DDS-NOBODY" not in {f.id for f in diagnose(seen, scope)}


_DOMAIN_ID = b"\x0f\0\4\0"  # the parameter's number and length


@contextlib.contextmanager
def _played(*answers: bytes) -> Iterator[int]:
    """A domain on which announcements get what a real participant answered; yields its number."""
    domain = free_domain()
    stop = threading.Event()

    def play(sock: socket.socket) -> None:
        owner = answers[-1][8:20]
        while not stop.is_set():
            try:
                data, source = sock.recvfrom(65536)
            except TimeoutError:
                continue
            asker, _ = parse_message(data)
            for packet in answers:
                # those of two captured participants; here they are one
                prefix = packet[8:20]
                told = (
                    packet[:24].replace(prefix, owner) + asker + packet[36:].replace(prefix, owner)
                )
                at = told.find(_DOMAIN_ID) + len(_DOMAIN_ID)
                if at >= len(_DOMAIN_ID):
                    told = told[:at] + struct.pack("<I", domain) + told[at + 4 :]
                sock.sendto(told, source)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", unicast_port(domain, 3)))
        sock.settimeout(0.05)
        thread = threading.Thread(target=play, args=(sock,))
        thread.start()
        try:
            yield domain
        finally:
            stop.set()
            thread.join()


def _cyclone_11(*answers: bytes) -> tuple[list[Finding], str]:
    """The findings of DDS-CYCLONE-11, and the version that is announced."""
    with _played(*answers) as domain:
        views = doctor_dds.observe_domains([domain], seconds=0.2)
    ((one,), ends) = views[0].participants, views[0].endpoints
    assert ends
    found = [f for f in diagnose(Observations(domains=views)) if f.id == "DDS-CYCLONE-11"]
    return found, one.version


def test_participant_of_cyclonedds_11_is_an_error() -> None:
    (found,), version = _cyclone_11(packets.CYCLONE_11_PARTICIPANT, packets.CYCLONE_11_PUBLICATION)
    assert version == "11.0.1"
    assert "CycloneDDS 11.0.1" in found.seen
    assert str(found.severity) == "error"


def test_the_wheel_of_cyclonedds_0_10_2_is_not_taken_for_11() -> None:
    found, version = _cyclone_11(
        packets.CYCLONE_0_10_2_PARTICIPANT, packets.CYCLONE_0_10_2_ENDPOINTS
    )
    assert version == "0.11.0"
    assert not found


def test_a_build_that_announces_the_same_version_and_crashes_peers_is_found() -> None:
    (found,), version = _cyclone_11(
        packets.CYCLONE_NIGHTLY_PARTICIPANT, packets.CYCLONE_NIGHTLY_PUBLICATION
    )
    assert version == "0.11.0"
    assert str(found.severity) == "error"


def test_known_hashes_are_those_of_cyclonedds_0_10() -> None:
    assert {name: type_hash(name) for name in TYPE_HASHES} == TYPE_HASHES


def test_writer_of_an_earlier_layout_is_named_by_its_samples() -> None:
    domain, kind = free_domain(), "unitree_hg::msg::dds_::HandState_"
    old = b"\0\1\0\0" + bytes(4) + bytes(56) + bytes(4) + bytes(16)  # 2024-08, nothing in it
    stop = threading.Event()
    with DdsNode(domain, "lo") as node, node.writer("rt/dex3/left/state", kind) as writer:

        def publish() -> None:
            while not stop.wait(0.01):
                writer.write_raw(old)

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            (view,) = doctor_dds.observe_domains([domain], seconds=0.3)
        finally:
            stop.set()
            thread.join()
    found = [f for f in diagnose(Observations(domains=(view,))) if f.id == "DDS-LAYOUT"]
    assert len(found) == 1
    assert "publishes rt/dex3/left/state" in found[0].seen
    assert "of 2024-08" in found[0].seen


def test_observation_leaves_no_reader_behind() -> None:
    domain = free_domain()
    with DdsNode(domain, "lo") as node:
        writer = node.writer("rt/dex1/left/state", STATES)
        matched = threading.Event()

        def watch() -> None:
            if writer.wait_matched(60):
                matched.set()

        thread = threading.Thread(target=watch)
        thread.start()
        (view,) = doctor_dds.observe_domains([domain], seconds=0.3)
        thread.join()
        assert view.streams[0].samples == 0
        assert matched.is_set()  # it was a reader while it looked
        deadline = time.monotonic() + 60
        while writer.matched and time.monotonic() < deadline:
            time.sleep(0.005)
        assert writer.matched == 0  # and said good-bye, long before its lease ends
        # the endpoints are taken back in a message of their own
        assert node.discovery.wait(lambda seen: all(e.own for e in seen), timeout=60)


@pytest.fixture
def service() -> Iterator[int]:
    """The domain of a real ``dexkit serve`` in another process."""
    domain = free_domain()
    command = command_line("serve", "sim-dex1", "--side", "both")
    with started([*command, "--domain", domain, "--quiet"]) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        assert process.stdout.readline().startswith("ready: ")
        yield domain
        process.terminate()


def test_doctor_prints_its_verdict_and_sets_the_exit_code(service: int) -> None:
    base = ["doctor", "--domain", str(service), "--scan", "none", "--seconds", "1"]
    good = CliRunner().invoke(cli, base, standalone_mode=False)
    assert good.return_value == 0, good.output
    assert good.output.startswith("Healthy")
    assert "a client gets past its wait" in good.output
    bad = CliRunner().invoke(cli, [*base, "--dialect", "dex3", "--json"], standalone_mode=False)
    assert bad.return_value == 1
    data = json.loads(bad.stdout)
    assert not data["healthy"]
    assert "DDS-OTHER-HAND" in {f["id"] for f in data["findings"]}
    (domain,) = data["observations"]["domains"]
    assert domain["number"] == service
    assert "dexkit serve sim-dex1 --side both" in domain["participants"][0]["command"]


def test_watch_reports_when_a_client_would_start() -> None:
    domain = free_domain()
    command = (sys.executable, "-m", "dexkit", "doctor", "--watch", "--domain", domain)
    with started([*command, "--scan", "none", "--seconds", "0.3"]) as process:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        assert any("DDS-NOBODY" in line for line in lines)
        with contextlib.ExitStack() as stack:
            world = _World(stack)
            world.domains["watch"] = domain
            _gripper(world, world.node("watch"))
            world.start()
            assert any("a client would now start" in line for line in lines)
        assert any("DDS-NOBODY" in line for line in lines)
        process.send_signal(2)
        process.stdout.read()
        assert process.wait(60) == 1  # as the last look found
