"""One publisher a topic: which one gives way, for any delay of discovery."""

from __future__ import annotations

import heapq
import itertools
import random
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from dexkit.dds import DdsNode
from dexkit.emulators.robot import run_robot
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.errors import TopicConflict
from dexkit.hand import Side
from dexkit.models import DIALECTS
from dexkit.robots import G1
from dexkit.service import HandService
from dexkit.single_publisher import SEARCH, SETTLE, Claim, NodeTopics, SolePublisher
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.live import LiveClient
from dexkit.traces import sample_path
from tests.cli_helpers import running
from tests.dds_helpers import free_domain, wait_until

TOPIC = "rt/dex1/left/state"
GO = DIALECTS["unitree_go"]


# --- on a network of virtual time


@dataclass
class Seen:
    """A writer as others see it."""

    key: str
    user_data: bytes = b""
    topic: str = TOPIC
    type_name: str = "T"
    kind: str = "writer"
    process: str = ""
    own: bool = False


@dataclass
class FakeNode:
    known: dict[str, Seen] = field(default_factory=dict)
    domain: int = 1

    def endpoints(self) -> list[Seen]:
        return list(self.known.values())


class Network:
    """Programs that start, announce and leave; news travels with any delay, in order."""

    def __init__(self, rnd: random.Random, slow: float) -> None:
        self.now = 0.0
        self.random = rnd
        self.slow = slow
        self.programs: list[Program] = []
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._count = itertools.count()
        self._arrives: dict[tuple[int, int], float] = {}

    def at(self, time: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time, next(self._count), what))

    def deliver(self, sender: Program, news: Callable[[Program], None]) -> None:
        for other in self.programs:
            if other is sender:
                continue
            pair = id(sender), id(other)
            delay = self.random.choice((0.0, 0.001, 0.05, 0.2, 1.0)) * self.slow
            arrives = max(self.now + delay, self._arrives.get(pair, 0.0) + 1e-9)
            self._arrives[pair] = arrives
            self.at(arrives, lambda other=other: news(other))  # type: ignore[misc]

    def run(self) -> None:
        while self._events:
            self.now, _, what = heapq.heappop(self._events)
            what()


class Program:
    """What HandService and the others do, step by step."""

    def __init__(self, net: Network, name: str, start: float, skew: float, **options: bool) -> None:
        self.net, self.name, self.skew = net, name, skew
        self.node = FakeNode()
        self.sole = SolePublisher([NodeTopics(self.node, {TOPIC})], hint="", **options)
        self.started = self.gone = False
        net.programs.append(self)
        net.at(start, self._start)

    def _start(self) -> None:
        self.started = True
        self._step()
        self.net.at(self.net.now + SEARCH, self._announce)

    def _announce(self) -> None:
        if not self._step():
            return
        since = round((self.net.now + self.skew) * 1e9)
        self.sole._claim = Claim(since, self.net.random.getrandbits(64))
        self.sole._phase = type(self.sole._phase).SETTLE
        mine = Seen(self.name, self.sole.announce(), process=self.name)
        self.net.deliver(self, lambda other: other._discover(mine))
        self.net.at(self.net.now + SETTLE, self._begin)

    def _begin(self) -> None:
        if self._step():
            self.sole.begin()
            self._step()

    def _discover(self, seen: Seen) -> None:
        self.node.known[seen.key] = seen
        if self.started:
            self._step()

    def _miss(self, key: str) -> None:
        self.node.known.pop(key, None)

    def _step(self) -> bool:
        if not self.gone:
            try:
                self.sole.check()
            except TopicConflict:
                self.gone = True
                self.net.deliver(self, lambda other: other._miss(self.name))
        return not self.gone


def test_one_of_many_simultaneous_publishers_remains() -> None:
    for seed in range(300):
        rnd = random.Random(seed)
        net = Network(rnd, slow=rnd.choice((0.1, 1.0, 5.0)))
        skew = rnd.choice((0.0, 100.0))
        for i in range(rnd.choice((2, 2, 3, 5))):
            start = rnd.choice((0.0, 0.0, rnd.random(), 3 * rnd.random()))
            Program(net, f"p{i}", start, skew * rnd.random())
        net.run()
        left = [p.name for p in net.programs if not p.gone]
        assert len(left) == 1, f"seed {seed}: {left} remain"


def test_running_publisher_stays_and_new_one_leaves() -> None:
    for seed in range(60):
        rnd = random.Random(seed)
        net = Network(rnd, slow=0.1)
        first = Program(net, "first", 0.0, 50.0)  # its clock is wrong, and does not matter
        second = Program(net, "second", 2.0, 0.0)
        net.run()
        assert (first.gone, second.gone) == (False, True), seed
        assert first.sole.rivals == 0, "the second never announced itself"


def test_forced_publishers_stay_and_log_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    net = Network(random.Random(0), slow=0.1)
    first = Program(net, "first", 0.0, 0.0)
    second = Program(net, "second", 2.0, 0.0, force=True)
    net.run()
    assert not first.gone
    assert not second.gone
    assert first.sole.rivals == second.sole.rivals == 1
    said = sorted(r.getMessage() for r in caplog.records)
    assert said == [
        f"first publishes {TOPIC} on domain 1, too; their samples mix",
        f"second publishes {TOPIC} on domain 1, too; their samples mix",
    ]


def test_publisher_gives_way_to_one_without_a_claim() -> None:
    vendor = Seen("v", process="vendor")

    def sole(**options: bool) -> tuple[FakeNode, SolePublisher]:
        node = FakeNode()
        return node, SolePublisher([NodeTopics(node, {TOPIC})], hint="stop it", **options)

    node, one = sole()
    node.known["v"] = vendor
    with pytest.raises(TopicConflict, match=f"vendor already publishes {TOPIC} on domain 1") as e:
        one.search()
    assert e.value.hint == "stop it"
    node, one = sole()
    one.search()
    one.announce()
    node.known["v"] = vendor
    with pytest.raises(TopicConflict):
        one.settle()
    for yields in (False, True):
        node, one = sole(yields=yields)
        one.search()
        one.announce()
        one.settle()
        node.known["v"] = vendor
        if yields:
            with pytest.raises(TopicConflict, match="too"):
                one.check()
            assert one.lost
        else:
            one.check()
            one.check()
            assert one.rivals == 1
            del node.known["v"]
            one.check()
            assert one.describe_rival() is None


def test_a_publisher_that_is_heard_counts_whatever_is_discovered() -> None:
    def sole(**options: bool) -> tuple[FakeNode, SolePublisher]:
        node = FakeNode({"v": Seen("v", process="idle")})
        topics = NodeTopics(node, {TOPIC}, lambda endpoint: False)
        return node, SolePublisher([topics], hint="stop it", **options)

    _, one = sole()
    one.search()  # a writer that writes nothing
    assert one.describe_rival() is None
    _, one = sole()
    with pytest.raises(TopicConflict, match=f"idle already publishes {TOPIC} on domain 1"):
        one.search(lambda: TOPIC)
    node, one = sole()
    node.known.clear()
    with pytest.raises(TopicConflict, match=f"another program already publishes {TOPIC}") as e:
        one.search(lambda: TOPIC)
    assert (e.value.hint, one.lost) == ("stop it", True)
    _, one = sole(force=True)
    one.search(lambda: TOPIC)
    assert not one.lost


def test_invalid_claims_are_ignored() -> None:
    mine = Claim.now()
    assert Claim.decode(mine.encode()) == mine
    for data in (
        b"",
        b"dexkit-claim 1 1 1",
        b"dexkit-claim 2 1 0000000000000001",
        b"dexkit-claim 1 " + b"9" * 5000 + b" 0000000000000001",
        b"dexkit-claim 1 -1 0000000000000001",
        mine.encode() + b"\n",
        b"\xff" * 70000,
    ):
        assert Claim.decode(data) is None, data[:40]


def test_many_publishers_are_counted_and_not_stored(caplog: pytest.LogCaptureFixture) -> None:
    node = FakeNode()
    one = SolePublisher([NodeTopics(node, {TOPIC})], hint="")
    one.begin()
    for i in range(1000):
        node.known = {f"k{i}": Seen(f"k{i}", process=f"p{i}")}
        one.check()
    assert one.rivals == 1000
    assert len(one._known_rivals) == 1
    assert len(caplog.records) == 20


# --- on DDS


def service(node: DdsNode, **options: bool) -> HandService:
    return HandService(SimHand(Side.LEFT), node=node, domain=node.domain, **options)


def test_one_of_two_simultaneous_services_remains() -> None:
    dds_domain = free_domain()
    with DdsNode(dds_domain) as a, DdsNode(dds_domain) as b, DdsNode(dds_domain) as watcher:
        nodes = [a, b]
        both = [service(node) for node in nodes]
        refused: list[TopicConflict] = []
        barrier = threading.Barrier(2)

        def start(one: HandService) -> None:
            barrier.wait()
            try:
                one.start()
            except TopicConflict as error:
                refused.append(error)

        threads = [threading.Thread(target=start, args=(one,)) for one in both]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

        def alone() -> bool:
            writers = [e for e in watcher.endpoints() if e.topic == TOPIC and e.kind == "writer"]
            return len(writers) == 1 or sum(s.failure is not None for s in both) == 1

        wait_until(alone)
        gone = [s for s in both if isinstance(s.failure, TopicConflict)]
        assert len(refused) + len(gone) == 1
        for one in both:
            one.stop()


def test_service_that_discovers_an_earlier_one_late_brakes_and_ends() -> None:
    dds_domain = free_domain()
    with DdsNode(dds_domain) as near, DdsNode(dds_domain) as far:
        with service(near) as served:
            # one that was there before, and was not discovered
            claim = Claim(1, 1).encode()
            with far.writer(TOPIC, GO.state_type, user_data=claim):
                wait_until(lambda: served.failure is not None)
                assert isinstance(served.failure, TopicConflict)
                core = served.cores[Side.LEFT]
                wait_until(lambda: not core.driving)
                assert served.snapshot()["rivals"] == 0
        # it left without a last state, which would be the other one's
        wait_until(lambda: not any(e.topic == TOPIC for e in near.endpoints()))
        with service(near) as served, far.writer(TOPIC, GO.state_type):
            wait_until(lambda: served.snapshot()["rivals"] == 1)
            assert served.failure is None  # the vendor's came later: only logged


def test_publish_gives_way_to_a_new_publisher() -> None:
    domain = free_domain()
    topic = GO.topics(Side.LEFT)[0]
    arguments = ("--wait", 0, "--loop", "--domain", domain)
    with running("publish", sample_path("dex1_pick_place"), *arguments) as replay:
        stdout = replay._popen.stdout
        assert stdout is not None
        assert any(line.startswith("ready:") for line in stdout)
        with DdsNode(domain) as client, client.writer(topic, GO.cmd_type):
            code, _, errors = replay.end()
    assert code == 1, errors
    assert f"publishes {topic} on domain {domain}, too" in errors
    assert "Traceback" not in errors


def test_teleoperation_gives_way_without_a_final_command() -> None:
    domain = free_domain()
    topic = GO.topics(Side.LEFT)[0]
    steps = profile("steps", "dex1-1")
    with DdsNode(domain) as near, DdsNode(domain) as far, service(far):
        client = client_for(GO, (Side.LEFT,), release=None, simulated=True)
        live = LiveClient(near, client)
        assert live.wait_ready(threading.Event(), lambda missing, seconds: None)
        with DdsNode(domain) as other, other.writer(topic, GO.cmd_type):
            near.discovery.wait(lambda es: sum(e.topic == topic for e in es) >= 3, 10)
            with pytest.raises(TopicConflict, match=f"commands {topic}"):
                live.perform(Operator(steps, GO), 60.0, threading.Event())
            sent: list[object] = []
            live._send = sent.append  # type: ignore[method-assign]
            live.leave()
            assert sent == []


def test_one_of_two_simultaneous_robots_remains() -> None:
    domain = free_domain()
    stop = threading.Event()
    ended: list[TopicConflict] = []
    barrier = threading.Barrier(2)

    def live() -> None:
        barrier.wait()
        try:
            run_robot(G1, domain=domain, stop=stop)
        except TopicConflict as error:
            ended.append(error)

    threads = [threading.Thread(target=live) for _ in range(2)]
    for thread in threads:
        thread.start()
    wait_until(lambda: ended)
    stop.set()
    for thread in threads:
        thread.join()
    assert len(ended) == 1
    assert "rt/lowstate" in str(ended[0])
