"""The Dex3-1 on its topics: mode bytes, time-outs joint by joint, every field of a state."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.backends import BackendOptions
from dexkit.clock import ManualClock
from dexkit.emulators.sim_dex3 import SimDex3, sim_dex3
from dexkit.errors import UsageError
from dexkit.hand import (
    CommandGate,
    HandCommand,
    HandSpec,
    HandState,
    ImuState,
    JointMode,
    ModeRule,
    MotorError,
    Side,
    SupplyState,
)
from dexkit.messages import message_type, unitree_hg
from dexkit.models import DEX3_1, dialect
from dexkit.service import HandService, Publisher
from dexkit.service.dialects import DialectMap, Fill, StateView, dialect_map
from dexkit.service.hand_core import HandCore
from tests.each import each
from tests.service_helpers import FakeNode, deliver_until, wait_until

DEX3 = dialect("dex3")
STATES, COMMANDS = message_type(DEX3.state_type), message_type(DEX3.cmd_type)
LEFT, RIGHT = Side.LEFT, Side.RIGHT
LINK, TRIPPED = int(MotorError.HOST_SAW_MOTOR_TIMEOUT), int(MotorError.MOTOR_SAW_HOST_TIMEOUT)
N, SENSORS = 7, 9


def spec(side: Side = LEFT) -> HandSpec:
    return DEX3_1.spec(side, io_rate=1000.0, simulated=True)


def mapping(fill: Fill = Fill.KNOWN, side: Side = LEFT) -> DialectMap:
    return dialect_map(DEX3, {side: spec(side)}, fill)


def message(modes: list[int] | None = None, **fields: float) -> unitree_hg.HandCmd_:
    """As xr_teleoperate's controller sends it, unless given otherwise."""
    values = {"kp": 1.5, "kd": 0.2, **fields}
    modes = modes if modes is not None else [0x10 | i for i in range(N)]
    return unitree_hg.HandCmd_([unitree_hg.MotorCmd_(mode=m, **values) for m in modes])  # type: ignore[arg-type]


def understood(modes: list[int]) -> HandCommand:
    command = mapping().command(message(modes), LEFT)
    assert command is not None
    return command


class TestModeByte:
    @given(st.lists(st.integers(0, 255), min_size=N, max_size=N))
    def test_every_mode_byte_is_decoded_as_in_the_manual(self, modes: list[int]) -> None:
        command = understood(modes)
        assert command.timeout is not None
        assert command.mode.tolist() == [
            JointMode.FOC if (m >> 4) & 7 == 1 else JointMode.BRAKE for m in modes
        ]
        assert command.timeout.tolist() == [m >= 0x80 for m in modes]
        counters = {r.counter for r in mapping().remarks(message(modes), LEFT)}
        assert ("wrong_ids" in counters) == any(m & 15 != i for i, m in enumerate(modes))
        assert ("unknown_status" in counters) == any((m >> 4) & 7 > 1 for m in modes)

    def test_mode_byte_1_for_every_motor_locks_all_and_is_explained(self) -> None:
        """A public client does this: id 1, status 0 of RIS_Mode."""
        assert understood([1] * N).is_brake
        (remark,) = mapping().remarks(message([1] * N), LEFT)
        assert remark.counter == "wrong_ids"
        assert "mode byte 0x01 of motor 0 has id 1, status 0" in remark.text
        assert "locks it" in remark.text
        assert "send 0x10 (0x10 | index) to drive motor 0" in remark.text

    @each("rule", list(ModeRule))
    def test_another_firmware_drives_by_other_bytes(self, rule: ModeRule) -> None:
        """docs/dex3.md#firmware"""
        hand = SimDex3(LEFT, mode_rule=rule)
        m = dialect_map(DEX3, {LEFT: hand.spec}, Fill.KNOWN)
        for byte, drives in {
            0x00: (rule is ModeRule.IGNORED),
            0x01: (rule is not ModeRule.MANUAL),
            0x80: (rule is not ModeRule.MANUAL),
            0x60: (rule is not ModeRule.MANUAL),
            0x10: True,
            0x90: True,
        }.items():
            command = m.command(message([byte] * N), LEFT)
            assert command is not None
            assert command.timeout is not None
            assert command.mode.tolist() == [int(drives)] * N, hex(byte)
            assert command.timeout.tolist() == [byte >= 0x80] * N
            texts = [r.text for r in m.remarks(message([byte] * N), LEFT)]
            assert not drives or not any("locks it" in t or "is locked" in t for t in texts)

    def test_firmware_is_a_setting(self) -> None:
        made = [
            sim_dex3.make(BackendOptions(LEFT, settings={"mode_byte": rule.value}))
            for rule in ModeRule
        ]
        assert [hand.spec.mode_rule for hand in made] == list(ModeRule)
        assert sim_dex3.make(BackendOptions(LEFT)).spec.mode_rule is ModeRule.MANUAL
        with pytest.raises(UsageError, match="no mode_byte 'other'"):
            sim_dex3.make(BackendOptions(LEFT, settings={"mode_byte": "other"}))

    def test_motors_go_by_index_whatever_their_id(self) -> None:
        commands = message([0x10 | (N - 1 - i) for i in range(N)])
        for i, motor in enumerate(commands.motor_cmd):
            motor.q = 0.1 * i
        command = mapping().command(commands, LEFT)
        assert command is not None
        assert command.q.tolist() == pytest.approx([0.1 * i for i in range(N)])


class TestCommand:
    @each("count", range(N))
    def test_fewer_motors_than_seven_hold_no_command(self, count: int) -> None:
        assert mapping().command(message([0x10] * count), LEFT) is None

    def test_command_with_more_motors_uses_the_first_seven(self) -> None:
        m = mapping()
        commands = message([0x10 | i for i in range(9)])
        command = m.command(commands, LEFT)
        assert command is not None
        assert command.q.shape == (N,)
        assert m.motors(commands) > m.length == N

    @each("side", list(Side))
    @each("end", ["q_min", "q_max"])
    def test_position_at_the_limit_as_float32_is_accepted(self, side: Side, end: str) -> None:
        joints = DEX3_1.joints[side]
        commands = message()
        for motor, joint in zip(commands.motor_cmd, joints, strict=True):
            motor.q = getattr(joint, end)
        sent = COMMANDS.decode(COMMANDS.encode(commands))
        command = mapping(side=side).command(sent, side)
        assert command is not None
        assert command.q.tolist() == pytest.approx([getattr(j, end) for j in joints], abs=1e-6)
        gate = CommandGate(spec(side))
        gate.admit(command)
        assert gate.clamped == 0


def full_state(**fields: Any) -> HandState:
    """Every value different, so that none can stand in for another."""
    pressure = np.full((SENSORS, 12), np.nan)
    for i, sensor in enumerate(DEX3_1.sensors):
        for slot in sensor.slots:
            pressure[i, slot] = 1000.0 * (i + 1) + slot
    values: dict[str, Any] = {
        "dq": 0.25 * np.arange(N),
        "ddq": 2.0 * np.arange(N),
        "tau_est": -0.125 * np.arange(N),
        "temperature": 30.0 + np.arange(N),
        "winding_temperature": 40.4 + np.arange(N),
        "voltage": 24.0 + 0.5 * np.arange(N),
        "mode": [1, 0, 1, 0, 1, 0, 1],
        "pressure": pressure,
        "sensor_temperature": 20.0 + np.arange(12.0 * SENSORS).reshape(SENSORS, 12) / 4,
        "sensor_lost": np.arange(SENSORS, dtype=np.uint32),
        "imu": ImuState((0.5, -0.5, 0.25, 0.75), (1, 2, 3), (4, 5, 9.75), (7, 8, 9), 30.6),
        "supply": SupplyState(24.5, 0.5, 12.25, 5.0),
        "error": 0x10,
        **fields,
    }
    return HandState.from_values(DEX3_1.rest_q[LEFT], stamp=0.0, **values)


def sent(view: StateView, fill: Fill = Fill.KNOWN) -> unitree_hg.HandState_:
    found: unitree_hg.HandState_ = STATES.decode(mapping(fill).encode({LEFT: view}))
    return found


class TestState:
    VIEW = StateView(
        full_state(measured=False), (0, 1, 0, TRIPPED, 0, 0, LINK), 3, (True,) + (False,) * 6
    )

    def test_every_field_is_published(self) -> None:
        m = sent(self.VIEW)
        s = self.VIEW.state
        assert [x.mode for x in m.motor_state] == [0x90, 0x01, 0x12, 0x83, 0x14, 0x05, 0x16]
        for name in ("q", "dq", "ddq", "tau_est"):
            values = [getattr(x, name) for x in m.motor_state]
            assert values == pytest.approx(getattr(s, name).tolist())
        assert [x.temperature for x in m.motor_state] == [(30 + i, 40 + i) for i in range(N)]
        assert [x.vol for x in m.motor_state] == [24.0 + 0.5 * i for i in range(N)]
        assert [x.motorstate for x in m.motor_state] == list(self.VIEW.fault)
        assert [tuple(x.reserve) for x in m.motor_state] == [(1, 0, 0, 0)] * N
        assert len(m.press_sensor_state) == SENSORS
        for i, packet in enumerate(m.press_sensor_state):
            slots = DEX3_1.sensors[i].slots
            assert packet.pressure == tuple(
                1000.0 * (i + 1) + j if j in slots else 30000.0 for j in range(12)
            )
            assert packet.temperature == tuple(20.0 + (12 * i + j) / 4 for j in range(12))
            assert (packet.lost, packet.reserve) == (i, 0)
        assert m.imu_state == unitree_hg.IMUState_(
            (0.5, -0.5, 0.25, 0.75), (1, 2, 3), (4, 5, 9.75), (7, 8, 9), 31
        )
        assert (m.power_v, m.power_a, m.system_v, m.device_v) == (24.5, 0.5, 12.25, 5.0)
        assert tuple(m.error) == (0x10, 3)
        assert len(mapping().encode({LEFT: self.VIEW})) == 1428  # docs/sources/unitree-dex.md#a4

    def test_the_message_equals_the_encoded_values(self) -> None:
        m = mapping()
        assert m.state({LEFT: self.VIEW}) == STATES.decode(m.encode({LEFT: self.VIEW}))

    def test_vendor_fill_omits_fields_the_vendor_does_not_set(self) -> None:
        m = sent(self.VIEW, Fill.VENDOR)
        assert [x.ddq for x in m.motor_state] == [0.0] * N
        assert [tuple(x.reserve) for x in m.motor_state] == [(0,) * 4] * N
        assert tuple(m.error) == (0x10, 0)
        assert m.motor_state[0].temperature == (30, 40)

    def test_unknown_values_are_zero_or_no_value(self) -> None:
        m = sent(StateView(HandState.from_values([0.1] * N, stamp=0.0, dq=math.nan), (0,) * N))
        assert [x.dq for x in m.motor_state] == [0.0] * N
        assert [x.temperature for x in m.motor_state] == [(0, 0)] * N
        assert [p.pressure for p in m.press_sensor_state] == [(30000.0,) * 12] * SENSORS
        assert m.imu_state == unitree_hg.IMUState_()
        assert (m.power_v, m.power_a, m.system_v, m.device_v) == (0.0,) * 4

    @each("reading", [30000.0, 30000.0009, 29999.9995])
    def test_reading_is_never_encoded_as_no_value(self, reading: float) -> None:
        m = sent(StateView(full_state(pressure=np.full((SENSORS, 12), reading)), (0,) * N))
        for packet in m.press_sensor_state:
            assert all(p != 30000.0 for p in packet.pressure)
            assert packet.pressure[0] == pytest.approx(reading, abs=0.003)

    anything = st.floats(allow_nan=True, allow_infinity=True)


class Bench:
    """A core on a manual clock, exchanging by hand."""

    def __init__(self) -> None:
        self.clock = ManualClock(100.0)
        self.core = HandCore(spec(), DEX3_1, self.clock)
        self.core.opened(spec())
        self.exchange()

    def send(self, protected: list[bool], mode: list[int] | None = None) -> None:
        n = np.arange(N)
        self.core.submit(
            HandCommand(
                q=np.clip(0.01 * n, spec().q_min, spec().q_max),
                dq=np.full(N, 0.5),
                tau=np.full(N, 0.1),
                kp=np.full(N, 1.5),
                kd=np.full(N, 0.2),
                mode=np.array(mode or [1] * N, dtype=np.uint8),
                timeout=np.array(protected),
            )
        )

    def exchange(self) -> HandCommand:
        command = self.core.next_command()
        self.core.measured(
            HandState.from_values(
                DEX3_1.rest_q[LEFT], stamp=self.clock.now(), mode=command.mode.tolist()
            )
        )
        return command

    def after(self, seconds: float) -> HandCommand:
        """The command of the exchange after a silence."""
        self.clock.advance(seconds)
        return self.exchange()

    @property
    def modes(self) -> list[int]:
        view = self.core.view()
        assert view is not None
        return [x.mode for x in sent(view).motor_state]


TIMEOUT = DEX3_1.command_timeout
ON, OFF = [True] * N, [False] * N


class TestTimeouts:
    def test_after_a_pause_joints_without_protection_brake_too(self) -> None:
        bench = Bench()
        bench.send(OFF)
        assert not bench.exchange().is_brake
        bench.clock.advance(3 * TIMEOUT)
        bench.core.paused()
        assert bench.exchange().is_brake
        assert not bench.core.holding
        assert bench.core.tripped == ()
        bench.clock.advance(0.01)
        bench.send(OFF)
        assert not bench.exchange().is_brake

    def test_a_stale_command_with_the_bit_clear_does_not_clear_it(self) -> None:
        bench = Bench()
        bench.send(ON)
        bench.after(TIMEOUT)
        old = replace(HandCommand.position(np.zeros(N)), timeout=np.array(OFF))
        assert not bench.core.submit(old, bench.clock.now() - 0.5)
        assert bench.core.tripped == tuple(range(N))
        assert bench.exchange().is_brake

    def test_tripped_joint_brakes_until_a_command_with_bit_7_clear(self) -> None:
        bench = Bench()
        bench.send(ON)
        bench.after(TIMEOUT)
        bench.send(ON)
        assert bench.exchange().is_brake
        assert bench.core.tripped == tuple(range(N))
        bench.send(OFF)
        assert not bench.exchange().is_brake
        assert bench.modes == [0x10 | i for i in range(N)]
        bench.send(ON)  # cleared: the protection is armed again
        assert not bench.exchange().is_brake

    def test_unprotected_joint_keeps_position_but_no_velocity_or_torque(self) -> None:
        bench = Bench()
        bench.send(OFF)
        driven = bench.exchange()
        held = bench.after(60.0)
        assert held.mode.tolist() == [JointMode.FOC] * N
        for name in ("q", "kp", "kd"):
            assert np.array_equal(getattr(held, name), getattr(driven, name))
        assert not held.dq.any()
        assert not held.tau.any()
        assert bench.modes == [0x10 | i for i in range(N)]
        assert bench.core.driving
        assert bench.core.holding
        bench.after(1.0)
        assert (bench.core.counters.brakes, bench.core.counters.holds) == (0, 1)
        bench.send(OFF)
        assert np.array_equal(bench.exchange().dq, driven.dq)
        assert not bench.core.holding

    def test_a_locked_joint_stays_locked(self) -> None:
        bench = Bench()
        bench.send(OFF, mode=[0, 1, 1, 1, 1, 1, 1])
        assert bench.after(TIMEOUT).mode.tolist() == [0, 1, 1, 1, 1, 1, 1]

    def test_rejected_command_neither_resets_nor_clears_the_protection(self) -> None:
        bench = Bench()
        bench.send(ON)
        bench.after(TIMEOUT)
        command = HandCommand.position(np.full(N, math.nan))
        assert not bench.core.submit(command)
        assert bench.exchange().is_brake
        assert bench.core.tripped == tuple(range(N))

    def test_a_position_is_not_held_across_a_lost_link(self) -> None:
        bench = Bench()
        bench.send(OFF)
        bench.after(TIMEOUT)
        bench.core.closed()
        bench.core.opened(spec())
        assert bench.exchange().is_brake
        assert not bench.core.holding
        bench.send(OFF)
        assert not bench.exchange().is_brake

    def test_tripped_joint_stays_tripped_after_a_lost_link(self) -> None:
        bench = Bench()
        bench.send(ON)
        bench.after(TIMEOUT)
        bench.core.closed()
        bench.core.opened(spec())
        bench.send(ON)
        assert bench.exchange().is_brake

    @given(
        st.lists(
            st.one_of(
                st.floats(0.0, 2 * TIMEOUT),
                st.lists(st.booleans(), min_size=N, max_size=N),
            ),
            max_size=12,
        )
    )
    def test_a_joint_is_driven_only_as_its_bits_allow(
        self, events: list[float | list[bool]]
    ) -> None:
        """Beside an independent model of the manual's one sentence."""
        bench = Bench()
        last: tuple[float, list[bool]] | None = None
        tripped = OFF
        for event in events:
            if isinstance(event, float):
                bench.clock.advance(event)
            late = last is not None and bench.clock.now() - last[0] >= TIMEOUT
            if last is not None and late:
                tripped = [t or asked for t, asked in zip(tripped, last[1], strict=True)]
            if isinstance(event, list):
                tripped = [t and asked for t, asked in zip(tripped, event, strict=True)]
                last = (bench.clock.now(), event)
                bench.send(event)
            command = bench.exchange()
            assert command.mode.tolist() == [int(last is not None and not t) for t in tripped]
            assert [m >> 7 for m in bench.modes] == [int(t) for t in tripped]


class InstantDex3:
    """A hand that is always at its goal."""

    def __init__(self, side: Side = LEFT) -> None:
        self.spec = spec(side)
        self.q = np.array(DEX3_1.rest_q[side])

    def open(self) -> None: ...
    def close(self) -> None: ...

    def exchange(self, command: HandCommand) -> HandState:
        self.q = np.where((command.mode == 1) & (command.kp > 0), command.q, self.q)
        return HandState.from_values(self.q, stamp=time.monotonic(), mode=command.mode.tolist())


CMD, STATE = DEX3.topics(LEFT)
LOW = DEX3.low_rate_topic.format(side=LEFT)


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def service(node: FakeNode) -> Iterator[HandService]:
    with HandService(InstantDex3(), node=node) as served:
        yield served


def newest(node: FakeNode, topic: str = STATE) -> Any:
    return STATES.decode(next(data for t, data in reversed(node.sent) if t == topic))


class TestService:
    def test_the_models_own_dialect_and_rate(self, node: FakeNode, service: HandService) -> None:
        assert service.dialect.name == "dex3"
        assert service.state_rate == 1000.0
        assert node.types == {CMD: DEX3.cmd_type, STATE: DEX3.state_type, LOW: DEX3.state_type}
        wait_until(lambda: len(node.sent) > 5)
        assert any(m.q != 0.0 for m in newest(node).motor_state)  # xr_teleoperate waits for it

    def test_low_rate_topic_has_nine_states_a_second(
        self, node: FakeNode, service: HandService
    ) -> None:
        wait_until(lambda: service.counters.published >= 250)
        topics = [t for t, _ in node.sent]
        last = len(topics) - topics[::-1].index(LOW)
        assert topics[:last].count(STATE) == 110 * topics[:last].count(LOW)
        at = topics.index(LOW)
        assert node.sent[at][1] == node.sent[at - 1][1]
        assert topics[at - 1] == STATE

    def test_unusual_command_is_counted_and_logged_once(
        self, node: FakeNode, service: HandService, caplog: pytest.LogCaptureFixture
    ) -> None:
        hand = service.snapshot()["hands"]["left"]
        assert (hand["wrong_ids"], hand["unknown_status"]) == (0, 0)
        high = [joint.q_max for joint in spec().joints]
        beyond = message()
        for motor, q in zip(beyond.motor_cmd, high, strict=True):
            motor.q = q
        beyond.motor_cmd[4].q = 0.3
        odd = [
            message([1] * N),
            message([0x20 | i for i in range(N)]),
            message([0x10] * 3),
            message([0x10 | i for i in range(9)]),
            beyond,
        ]
        with caplog.at_level(logging.WARNING):
            for number, commands in enumerate(odd * 2):
                node.deliver(CMD, COMMANDS.encode(commands))
                wait_until(lambda n=number: service.counters.received > n)  # type: ignore[misc]
            wait_until(lambda: newest(node).motor_state[0].q == pytest.approx(high[0]))
            # a command is counted as received before it is looked into
            wait_until(lambda: service.snapshot()["hands"]["left"]["clamped"] == 2)
        snapshot = service.snapshot()
        hand = snapshot["hands"]["left"]
        assert (hand["wrong_ids"], hand["unknown_status"], hand["clamped"]) == (2, 2, 2)
        assert (snapshot["short"], snapshot["overlong"]) == (2, 2)
        said = [r.getMessage() for r in caplog.records]
        assert len(said) == 5
        assert sum("q of middle_1 = 0.3 rad is outside -1.7453 .. 0" in text for text in said) == 1
        assert sum("mode byte 0x01 of motor 0 has id 1" in text for text in said) == 1

    def test_a_joint_that_stays_tripped_is_explained(
        self, node: FakeNode, caplog: pytest.LogCaptureFixture
    ) -> None:
        with HandService(InstantDex3(), node=node) as service:
            core = service.cores[LEFT]
            core._timeout = 0.05
            protected = COMMANDS.encode(message([0x90 | i for i in range(N)]))
            node.deliver(CMD, protected)
            wait_until(lambda: core.tripped)
            node.deliver(CMD, protected)
            wait_until(lambda: "stay braked" in caplog.text)
            assert "send it once with bit 7 = 0" in caplog.text
            wait_until(lambda: newest(node).motor_state[0].mode == 0x80)
            deliver_until(
                node,
                CMD,
                COMMANDS.encode(message()),
                lambda: newest(node).motor_state[0].mode == 0x10,
            )


if find_spec("unitree_sdk2py") is not None:
    from tests.dds_helpers import dds_domain
    from tests.unitree_sdk import SdkClient

    __all__ = ["dds_domain"]

    def until(
        sdk: SdkClient, topic: str, arrived: Callable[[Any], bool], timeout: float = 60.0
    ) -> Any:
        deadline = time.monotonic() + timeout
        while True:
            for sample in sdk.wait(topic):
                if arrived(sample.message):
                    return sample
            assert time.monotonic() < deadline, f"the state never got there: {sample.message}"

    def test_unitree_sdk_as_used_by_xr_teleoperate(dds_domain: int) -> None:
        """Both hands; waits for a q that is not 0; 100 Hz, mode 0x10 | i, kp 1.5, kd 0.2."""
        hands = {side: SimDex3(side, object_at=60.0) for side in Side}
        publisher = Publisher(200.0)  # two hands at 1000 Hz are too much for a busy test machine
        with (
            SdkClient(dds_domain) as sdk,
            HandService(hands[LEFT], domain=dds_domain, publisher=publisher),
            HandService(hands[RIGHT], domain=dds_domain, publisher=publisher),
        ):
            goals = {}
            for side in Side:
                cmd, state = DEX3.topics(side)
                sdk.subscribe(state, DEX3.state_type)
                until(sdk, state, lambda m: any(x.q != 0.0 for x in m.motor_state))
                commands = message()
                # each joint by another amount, toward closing where it has such a direction
                goals[side] = [
                    (j.closing or 1) * (0.35 + 0.05 * i) for i, j in enumerate(DEX3_1.joints[side])
                ]
                for motor, q in zip(commands.motor_cmd, goals[side], strict=True):
                    motor.q = q
                sdk.stream(cmd, DEX3.cmd_type, commands, hz=100)
            for side in Side:
                cmd, state = DEX3.topics(side)
                sample = until(
                    sdk,
                    state,
                    lambda m, side=side: all(
                        abs(x.q - q) < 0.05 for x, q in zip(m.motor_state, goals[side], strict=True)
                    ),
                )
                m = sample.message
                # the SDK has serialised it again: every field has passed through its classes
                assert STATES.encode(m) == sample.data
                assert [x.mode for x in m.motor_state] == [0x10 | i for i in range(N)]
                assert all(0 < x.temperature[0] < 80 and x.vol > 0 for x in m.motor_state)
                assert len(m.press_sensor_state) == SENSORS
                for packet, sensor in zip(m.press_sensor_state, DEX3_1.sensors, strict=True):
                    real = [p != 30000.0 for p in packet.pressure]
                    assert real == [i in sensor.slots for i in range(12)]
                assert m.power_v > 20
                sdk.subscribe(DEX3.low_rate_topic.format(side=side), DEX3.state_type)
                low = sdk.wait(DEX3.low_rate_topic.format(side=side))[0].message
                assert len(low.motor_state) == N
                sdk.stop(cmd)
