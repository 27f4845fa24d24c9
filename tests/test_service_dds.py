"""The service on real DDS, on loopback: a simulated hand and clients that come and go."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from dexkit.dds import DdsNode, Qos, Reader, Sample, Writer
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.errors import TopicConflict
from dexkit.hand import MotorError, Side
from dexkit.messages import unitree_go
from dexkit.models import dialect
from dexkit.service import HandService
from tests.dds_helpers import dds_domain, dds_node, take_until, wait_until
from tests.service_helpers import ScriptedHand

__all__ = ["dds_domain", "dds_node"]

GO = dialect("unitree_go")
CMD, STATE = GO.topics(Side.LEFT)
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


class Client:
    """A client on a node of its own."""

    def __init__(self, domain: int) -> None:
        self.node = DdsNode(domain, "lo")
        self.states: Reader = self.node.reader(
            STATE, GO.state_type, qos=Qos("best_effort", depth=5000)
        )
        self.commands: Writer = self.node.writer(CMD, GO.cmd_type)
        assert self.commands.wait_matched(60)

    def command(self, q: float, kp: float = 5.0) -> None:
        self.commands.write(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q, kp=kp, kd=0.05)]))

    def state(self) -> unitree_go.MotorState_:
        """The next state to come."""
        self.states.take()
        motor: unitree_go.MotorState_ = take_until(self.states, bool)[-1].message.states[0]
        return motor

    def drive_to(self, q: float, tolerance: float = 0.1) -> None:
        """Command at about 200 Hz until the state is there."""

        def there(samples: list[Sample]) -> bool:
            self.command(q)
            time.sleep(0.005)
            return bool(samples) and abs(samples[-1].message.states[0].q - q) < tolerance

        take_until(self.states, there)

    def close(self) -> None:
        self.node.close()


@pytest.fixture
def service(dds_domain: int) -> Iterator[HandService]:
    with HandService(SimHand(Side.LEFT), domain=dds_domain) as running:
        yield running


@pytest.fixture
def client(service: HandService) -> Iterator[Client]:
    one = Client(service.domain)
    yield one
    one.close()


def test_state_flows_before_any_command(service: HandService, client: Client) -> None:
    samples = take_until(client.states, lambda s: len(s) >= 100)
    motor = samples[0].message.states[0]
    assert len(samples[0].message.states) == 1
    assert motor.q == pytest.approx(0.2 * 5.4, abs=1e-3)
    assert (motor.mode, motor.lost) == (0, 0)
    assert service.counters.received == 0


@pytest.mark.realtime
def test_state_comes_at_500_hz(service: HandService, client: Client) -> None:
    """Never faster; slower only by deadlines that a busy machine made it miss, which it counts."""

    counters = service.counters

    def deadlines() -> int:
        return counters.published + counters.publish_misses

    for _ in range(20):
        begin, before, published = time.monotonic(), deadlines(), counters.published
        pauses = counters.pauses
        take_until(client.states, lambda s: len(s) >= 600)
        # one that is less than a period late is made up for
        assert counters.published - published <= 500.0 * (time.monotonic() - begin) + 2
        # those missed while it stood still are counted as soon as it goes on
        if deadlines() - before >= 500.0 * (time.monotonic() - begin) - 5:
            return
        # a pause of the whole program is counted as such
        assert counters.pauses > pauses or deadlines() - before >= 400.0
    raise AssertionError("deadlines are lost without being counted")


def test_commands_move_and_silence_brakes(service: HandService, client: Client) -> None:
    client.drive_to(4.0)
    assert client.state().mode == 1
    core = service.cores[Side.LEFT]
    wait_until(lambda: not core.driving)
    assert client.state().mode == 0
    assert core.counters.brakes == 1


def test_the_qos_is_that_of_unitrees_software(service: HandService, dds_node: DdsNode) -> None:
    def mine() -> list[object]:
        return [e for e in dds_node.endpoints() if e.topic in (CMD, STATE)]

    assert dds_node.discovery.wait(lambda _: len(mine()) == 2, 60)
    reader, writer = sorted(
        (e for e in dds_node.endpoints() if e.topic in (CMD, STATE)), key=lambda e: e.kind
    )
    assert (reader.topic, reader.type_name, reader.qos) == (CMD, GO.cmd_type, Qos("best_effort"))
    assert (writer.topic, writer.type_name, writer.qos) == (STATE, GO.state_type, Qos("reliable"))


def test_late_and_restarted_clients_get_states(service: HandService) -> None:
    first = Client(service.domain)
    first.drive_to(2.0)
    late = Client(service.domain)
    assert late.state().q == pytest.approx(2.0, abs=0.3)
    first.close()
    late.drive_to(3.0)
    again = Client(service.domain)
    again.drive_to(1.0)
    assert late.state().q == pytest.approx(1.0, abs=0.3)
    again.close()
    late.close()


def test_a_second_service_on_the_topic_is_refused(service: HandService) -> None:
    other = ScriptedHand(Side.LEFT)
    with pytest.raises(TopicConflict, match="already publishes rt/dex1/left/state"):
        HandService(other, domain=service.domain).start()
    assert other.opens == 0
    with HandService(ScriptedHand(Side.RIGHT), domain=service.domain):
        pass


def test_hand_unplugged_in_motion_is_reopened(dds_domain: int) -> None:
    hand = ScriptedHand(Side.LEFT)
    with HandService(hand, domain=dds_domain) as service:
        client = Client(dds_domain)
        client.drive_to(2.0)
        hand.plugged = False
        lost = take_until(client.states, lambda s: bool(s) and s[-1].message.states[0].lost > 1)
        motor = lost[-1].message.states[0]
        assert (motor.q, motor.reserve[0]) == (2.0, LINK)
        hand.plugged = True
        core = service.cores[Side.LEFT]
        wait_until(lambda: core.counters.reconnects == 1)
        assert client.state().q == 2.0
        client.drive_to(4.0)
        assert client.state().lost == 0
        client.close()
