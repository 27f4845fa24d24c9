"""The bridge's translation and timing rules, without DDS and on a manual clock."""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import astuple, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.bridge.forwarding import PATIENCE, SILENT, Commands, Outgoing, States
from dexkit.bridge.translate import PartCodec, Reachable, translator
from dexkit.hand import MotorError, Side
from dexkit.messages import message_type, unitree_go, unitree_hg
from dexkit.models import DEX1_1, Dialect, dialect
from dexkit.teleop.client import LEAD, StickyFilter
from tests.each import each

LEFT, RIGHT = Side.LEFT, Side.RIGHT
BOTH = tuple(Side)
GO, HG, ACTUATOR = (dialect(n) for n in ("unitree_go", "unitree_hg", "unitree_actuator"))
PAIRS = list(itertools.permutations((GO, HG, ACTUATOR), 2))
SCALE = 2 * math.pi / 5.4
TIMEOUT = DEX1_1.command_timeout
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)

float32 = st.floats(-1e4, 1e4, width=32)
u32 = st.integers(0, 2**32 - 1)
go_commands = st.builds(
    unitree_go.MotorCmd_,
    mode=st.integers(0, 255),
    q=float32,
    dq=float32,
    tau=float32,
    kp=st.floats(0, 1e4, width=32),
    kd=st.floats(0, 1e4, width=32),
    reserve=st.tuples(u32, u32, u32),
)
go_states = st.builds(
    unitree_go.MotorState_,
    mode=st.integers(0, 255),
    q=float32,
    dq=float32,
    ddq=float32,
    tau_est=float32,
    q_raw=float32,
    temperature=st.integers(0, 255),
    lost=u32,
    reserve=st.tuples(u32, u32),
)


def near(value: float) -> Any:
    return pytest.approx(value, rel=2e-7, abs=1e-30)


def on_wire(spoken: Dialect, kind: str, part: Any) -> Any:
    """A part as it comes out of the message it was sent in."""
    side = LEFT
    codec = PartCodec(spoken, kind)
    message = codec.type.decode(codec.type.encode(codec.put({side: part})))
    return codec.take(message, side)


def there_and_back(via: Dialect, kind: str, part: Any) -> Any:
    there = on_wire(via, kind, translator(GO, via, kind)(part))
    return on_wire(GO, kind, translator(via, GO, kind)(there))


class TestTranslation:
    @given(go_commands, go_states)
    def test_message_of_the_same_type_is_forwarded_unchanged(
        self, command: unitree_go.MotorCmd_, state: unitree_go.MotorState_
    ) -> None:
        assert there_and_back(ACTUATOR, "cmd", command) == command
        assert there_and_back(ACTUATOR, "state", state) == state

    @given(st.floats(0.0625, 5.125, width=32).filter(lambda q: 0.1001 < q * SCALE < 5.9999))
    def test_position_survives_conversion_in_both_directions(self, q: float) -> None:
        back = there_and_back(HG, "cmd", unitree_go.MotorCmd_(q=q, kp=5.0, kd=0.05))
        assert back.q == near(q)
        assert (back.kp, back.kd) == (near(5.0), near(0.05))

    @given(go_commands)
    def test_command_gives_the_same_force_in_either_dialect(self, go: unitree_go.MotorCmd_) -> None:
        """The same displacement of the jaws gives the same torque of the same joint."""
        hg = translator(GO, HG, "cmd")(go).motor_cmd[0]
        displacement = 0.3  # rad of 0 .. 5.4
        assert hg.kp * displacement * SCALE == near(go.kp * displacement)
        speed = -1.5
        assert hg.kd * speed * SCALE == near(go.kd * speed)
        assert (hg.tau, hg.mode) == (go.tau, 0)

    @given(
        st.builds(
            unitree_hg.MotorCmd_,
            mode=st.integers(0, 255),
            q=float32,
            dq=float32,
            tau=float32,
            kp=float32,
            kd=float32,
        )
    )
    def test_gains_of_the_specification_are_the_services_own(
        self, motor: unitree_hg.MotorCmd_
    ) -> None:
        go = translator(HG, GO, "cmd")(unitree_hg.HandCmd_([motor]))
        assert (go.dq, go.tau, go.kp, go.kd) == (0.0, 0.0, 5.0, 0.05)

    @given(go_states)
    def test_state_keeps_the_fields_that_both_dialects_have(
        self, go: unitree_go.MotorState_
    ) -> None:
        back = there_and_back(HG, "state", go)
        assert (back.q, back.dq, back.ddq) == (near(go.q), near(go.dq), near(go.ddq))
        assert back.tau_est == -abs(go.tau_est)  # grip strength: what closes
        assert back.temperature == (min(go.temperature, 127) or 25)
        assert (back.lost, back.reserve[0]) == (go.lost, go.reserve[0])
        assert back.reserve[1] == (go.reserve[1] == 1)
        # once more is the same again
        assert astuple(there_and_back(HG, "state", back)) == near_all(back)

    def test_state_of_the_specification_is_translated_to_unitree_go(self) -> None:
        """The interface specification, "Gripper Publishes State"."""
        motor = unitree_hg.MotorState_(
            q=3.14, tau_est=0.5, temperature=(31, 40), vol=12.0, motorstate=0x20
        )
        message = unitree_hg.HandState_([motor], error=(0x20, 7))
        go = translator(HG, GO, "state")(message)
        assert go == unitree_go.MotorState_(
            q=near(3.14 / SCALE), tau_est=-0.5, temperature=31, lost=7, reserve=(0x20, 0)
        )
        assert translator(GO, HG, "state")(go).motor_state[0].vol == 12.0

    @given(st.floats(allow_nan=False, allow_infinity=False, width=32))
    def test_finite_value_stays_finite_after_translation(self, value: float) -> None:
        command = unitree_go.MotorCmd_(q=value, dq=value, tau=value, kp=value, kd=value)
        state = unitree_go.MotorState_(q=value, dq=value, ddq=value, tau_est=value)
        for kind, part in (("cmd", command), ("state", state)):
            there = on_wire(HG, kind, translator(GO, HG, kind)(part))
            assert PartCodec(HG, kind).is_finite(there)


def near_all(state: unitree_go.MotorState_) -> tuple[Any, ...]:
    return tuple(near(v) if isinstance(v, float) else v for v in astuple(state))


class Wire:
    """Both directions of a bridge, and messages for them."""

    def __init__(self, client: Dialect, gripper: Dialect, sides: tuple[Side, ...] = BOTH) -> None:
        self.client, self.gripper = client, gripper
        self.states = States(gripper, client, sides)
        self.commands = Commands(client, gripper, sides, self.states)
        self.now = 10.0

    def command(self, *sides: Side, q: float = 1.0, **fields: Any) -> list[Outgoing]:
        """Commands of q (of 0 .. 5.4; the right's is twice that) for sides, and what follows."""
        fields = {"kp": 5.0, **fields}
        out = []
        for topic, payload in self._messages(self.client, "cmd", sides, q, fields):
            out += self.commands.receive(topic, payload, self.now)
        return out

    def state(self, *sides: Side, q: float = 1.0, **fields: Any) -> list[Outgoing]:
        out = []
        for topic, payload in self._messages(self.gripper, "state", sides, q, fields):
            out += self.states.receive(topic, payload, self.now)
        return out

    @staticmethod
    def _messages(
        spoken: Dialect, kind: str, sides: tuple[Side, ...], q: float, fields: dict[str, Any]
    ) -> list[tuple[str, bytes]]:
        codec = PartCodec(spoken, kind)
        motor = unitree_go.MotorCmd_ if kind == "cmd" else unitree_go.MotorState_
        parts = {}
        for side in sides:
            go = motor(q=q if side is LEFT else 2 * q, **fields)
            part = translator(GO, spoken, kind)(go)
            parts[side] = part
        which = 0 if kind == "cmd" else 1
        if spoken.length > 1:
            topic = spoken.topics(LEFT)[which]
            return [(topic, codec.type.encode(codec.put(parts)))]
        return [
            (spoken.topics(s)[which], codec.type.encode(codec.put({s: p})))
            for s, p in parts.items()
        ]

    def later(self, seconds: float) -> list[Outgoing]:
        """Let time pass; what leaves meanwhile because it has waited long enough."""
        self.now += seconds
        return self.commands.flush(self.now) + self.states.flush(self.now)


def q_of(spoken: Dialect, kind: str, out: list[Outgoing]) -> dict[Side, Any]:
    """The q, of 0 .. 5.4, of each side in the newest messages."""
    codec, found = PartCodec(spoken, kind), {}
    for message in out:
        for side in Side:
            if spoken.topics(side)[0 if kind == "cmd" else 1] == message.topic:
                part = codec.take(codec.type.decode(message.payload), side)
                scale = SCALE if spoken is HG else 1.0
                found[side] = pytest.approx(codec.motor(part).q / scale, abs=1e-6)
    return found


def motors(out: list[Outgoing]) -> list[Any]:
    """The motors, right first, of the one message for both sides."""
    (message,) = out
    kind = ACTUATOR.cmd_type if message.topic.endswith("cmd") else ACTUATOR.state_type
    decoded = message_type(kind).decode(message.payload)
    found: list[Any] = decoded.cmds if kind == ACTUATOR.cmd_type else decoded.states
    assert len(found) == 2
    return found


@pytest.mark.parametrize(("client", "gripper"), PAIRS, ids=lambda d: d.name)
class TestEveryPair:
    def test_left_and_right_are_not_exchanged(self, client: Dialect, gripper: Dialect) -> None:
        wire = Wire(client, gripper)
        wire.state(*BOTH, q=0.5)
        assert q_of(client, "state", wire.state(*BOTH, q=1.5)) == {LEFT: 1.5, RIGHT: 3.0}
        wire.command(*BOTH)
        wire.later(PATIENCE)
        assert q_of(gripper, "cmd", wire.command(*BOTH, q=2.0)) == {LEFT: 2.0, RIGHT: 4.0}

    def test_bridge_sends_nothing_without_input(self, client: Dialect, gripper: Dialect) -> None:
        wire = Wire(client, gripper)
        for direction, speak in ((wire.commands, wire.command), (wire.states, wire.state)):
            speak(*BOTH)
            assert direction.due is None
            assert wire.later(5.0) == []

    @each("bad", [math.nan, math.inf, -math.inf])
    @each("field", ["q", "dq", "tau", "kp", "kd"])
    def test_non_finite_command_is_not_forwarded(
        self, client: Dialect, gripper: Dialect, field: str, bad: float
    ) -> None:
        wire = Wire(client, gripper)
        codec = PartCodec(client, "cmd")
        for side in Side:
            good = translator(GO, client, "cmd")(unitree_go.MotorCmd_(q=1.0))
            setattr(codec.motor(good), field, bad)
            payload = codec.type.encode(codec.put({side: good}))
            if client.length == 1:
                assert wire.commands.receive(client.topics(side)[0], payload, wire.now) == []
                assert wire.commands.counts.rejected == 1
                return
            out = wire.commands.receive(client.topics(side)[0], payload, wire.now)
            assert side not in q_of(gripper, "cmd", out)

    def test_undecodable_message_is_counted(self, client: Dialect, gripper: Dialect) -> None:
        wire = Wire(client, gripper)
        topic = client.topics(LEFT)[0]
        assert wire.commands.receive(topic, b"junk", wire.now) == []
        empty = PartCodec(client, "cmd").type
        assert wire.commands.receive(topic, empty.encode(empty.cls()), wire.now) == []
        counts = wire.commands.counts
        assert (counts.received, counts.undecodable) == (2, 1)
        assert counts.short >= 1


class TestTwoTopicsIntoOneMessage:
    """To unitree_actuator: what is put in the other side's place."""

    def test_both_commands_leave_together(self) -> None:
        wire = Wire(GO, ACTUATOR)
        wire.command(*BOTH)
        wire.later(PATIENCE)
        wire.later(0.004)
        assert wire.command(LEFT, q=2.0) == []  # the right's is to come
        right, left = motors(wire.command(RIGHT, q=2.0))
        assert (left.q, right.q) == (2.0, 4.0)

    def test_command_waits_for_the_other_side_no_longer_than_the_limit(self) -> None:
        wire = Wire(GO, ACTUATOR)
        wire.command(*BOTH)
        wire.later(0.005)
        wire.command(LEFT, q=2.0)
        assert wire.commands.due == pytest.approx(wire.now + PATIENCE)
        assert wire.later(PATIENCE / 2) == []
        right, left = motors(wire.later(PATIENCE))
        assert (left.q, right.q) == (2.0, 2.0)  # the right's own newest: 2 x 1.0

    def test_side_without_commands_gets_no_gain(self) -> None:
        wire = Wire(GO, ACTUATOR)
        wire.state(*BOTH, q=1.25)
        wire.command(*BOTH, kp=5.0, kd=0.05)
        wire.later(PATIENCE)
        wire.later(TIMEOUT)
        wire.state(*BOTH, q=1.5)
        right, left = motors(wire.command(LEFT, kp=5.0, kd=0.05) or wire.later(PATIENCE))
        assert right == unitree_go.MotorCmd_(mode=0, q=3.0, kd=near32(0.05))
        assert left.kp == 5.0
        wire.state(*BOTH, q=1.75)  # pushed away: it is not to follow
        wire.later(0.005)
        right, _ = motors(wire.command(LEFT))
        assert right.q == 3.0
        # and is commanded again
        wire.later(0.005)
        wire.command(LEFT)
        right, _ = motors(wire.command(RIGHT, q=0.5, kp=5.0) or wire.later(PATIENCE))
        assert (right.q, right.kp) == (1.0, 5.0)

    def test_command_is_not_sent_while_the_other_position_is_unknown(self) -> None:
        wire = Wire(GO, ACTUATOR)
        assert wire.command(LEFT) + wire.later(PATIENCE) == []
        assert wire.commands.counts.held == 1
        assert len(wire.command(RIGHT)) == 1  # both are commanded now: none needed

    def test_nan_does_not_reset_the_age_of_a_command(self) -> None:
        wire = Wire(GO, ACTUATOR)
        wire.state(*BOTH)
        wire.command(*BOTH, kp=5.0)
        for _ in range(20):
            wire.later(TIMEOUT / 10)
            wire.command(RIGHT, q=math.nan)
            out = wire.command(LEFT) or wire.later(PATIENCE)
        right, _ = motors(out)
        assert (right.q, right.kp) == (2.0, 0.0)

    def test_states_wait_for_both_grippers(self) -> None:
        """Or the client would take the 0 of the one that is not there yet for its position."""
        wire = Wire(ACTUATOR, GO)
        assert wire.state(LEFT) == []
        assert wire.states.missing() == [RIGHT]
        right, left = motors(wire.state(RIGHT))
        assert (left.q, right.q) == (1.0, 2.0)
        assert wire.states.missing() == []

    def test_state_of_an_absent_gripper_is_the_default(self) -> None:
        wire = Wire(ACTUATOR, GO, (RIGHT,))
        right, left = motors(wire.state(RIGHT))
        assert (right.q, left) == (2.0, unitree_go.MotorState_())

    def test_silent_gripper_is_marked_as_lost(self) -> None:
        wire = Wire(ACTUATOR, GO)
        wire.state(*BOTH, dq=0.25)
        before = motors(wire.state(*BOTH, dq=0.25))[0]
        assert before.lost == 0
        lost = []
        for _ in range(100):
            wire.later(0.002)
            out = wire.state(LEFT) or wire.later(PATIENCE)
            right, left = motors(out)
            lost.append(right.lost)
            assert (left.lost, left.reserve) == (0, (0, 0))
        assert right == replace(before, lost=lost[-1], reserve=(LINK, 0))
        assert lost[0] == 0
        assert lost[-5:] == list(range(lost[-5], lost[-5] + 5))
        assert lost.count(0) == pytest.approx(SILENT / 0.002, abs=2)
        assert wire.states.silent(wire.now) == [RIGHT]
        wire.later(0.002)
        out = wire.state(RIGHT, q=2.5) or wire.later(PATIENCE)
        assert (motors(out)[0].q, motors(out)[0].lost) == (5.0, 0)  # it is back
        assert wire.states.silent(wire.now) == []

    def test_bridge_publishes_no_state_while_both_grippers_are_silent(self) -> None:
        wire = Wire(ACTUATOR, GO)
        wire.state(*BOTH)
        wire.later(PATIENCE)
        assert wire.later(1.0) == []
        assert wire.states.due is None

    @given(st.lists(st.tuples(st.sampled_from(BOTH), st.floats(0.0, 0.004)), max_size=60))
    def test_newest_command_is_sent_once_and_in_time(
        self, arrivals: list[tuple[Side, float]]
    ) -> None:
        """Whatever order states come in: no message without cause, none later than the patience."""
        wire = Wire(ACTUATOR, GO)
        wire.state(*BOTH)
        newest = {LEFT: 1.0, RIGHT: 2.0}
        came = sent = 0
        for i, (side, gap) in enumerate(arrivals):
            due = wire.states.due
            if due is not None and wire.now + gap >= due:
                out = wire.states.flush(due + 1e-9)
                sent += len(out)
                assert [m.q for m in motors(out)] == [newest[RIGHT], newest[LEFT]]
                assert wire.states.due is None
            wire.later(gap)
            q = float(i + 2)
            newest[side] = q if side is LEFT else 2 * q
            out = wire.state(side, q=q)
            came += 1
            sent += len(out)
            if out:
                assert [m.q for m in motors(out)] == [newest[RIGHT], newest[LEFT]]
            else:
                assert wire.states.due is not None
        assert sent <= came


class TestReachable:
    """All in rad of unitree_hg."""

    @staticmethod
    def goes_to(q: float) -> float:
        """Where a gripper of the interface specification goes."""
        return 0.0 if q <= 0.1 else 2 * math.pi if q >= 6.0 else q

    @given(st.floats(0.0, 2 * math.pi), st.none() | st.floats(0.0, 2 * math.pi))
    def test_command_goes_to_the_nearest_reachable_position(
        self, q: float, position: float | None
    ) -> None:
        sent = Reachable()(q, position, 0.0)
        assert self.goes_to(sent) == pytest.approx(sent)
        reach = (0.0, 2 * math.pi, min(max(q, 0.101), 5.999))
        assert abs(sent - q) == pytest.approx(min(abs(r - q) for r in reach))

    @each("speed", [1.5, 6.5, 24.0])
    @each(("start", "goal"), [(0.0, 5.4), (5.4, 0.0), (5.412, 0.0), (2.7, 5.4), (5.4, 3.0)])
    def test_commands_of_the_teleoperation_client_reach_the_goal(
        self, start: float, goal: float, speed: float
    ) -> None:
        reach, smooth, position = Reachable(), StickyFilter(), start * SCALE
        smooth((start,))
        places = []
        for step in range(1200):
            lead = min(max(goal - position / SCALE, -LEAD), LEAD)
            (q,) = smooth((position / SCALE + lead,))
            target = self.goes_to(reach(q * SCALE, position, 0.005 * step))
            far = 0.005 * speed * SCALE
            position += min(max(target - position, -far), far)
            places.append(position / SCALE)
        # 0.06: its filter stops there, with any gripper
        assert places[-1] == pytest.approx(goal, abs=0.07 if goal == 3.0 else 0.001)
        assert max(places[1000:]) - min(places[1000:]) < 1e-6  # it rests there

    @given(st.floats(0.0, 2 * math.pi), st.floats(0.0, 2 * math.pi))
    def test_constant_command_leaves_the_gripper_at_rest(self, q: float, position: float) -> None:
        reach, places = Reachable(), set()
        for step in range(400):
            position = self.goes_to(reach(q, position, 0.005 * step))
            if step > 200:
                places.add(position)
        assert len(places) == 1


class TestToTheSpecification:
    """unitree_hg knows no gains."""

    @pytest.mark.parametrize("kp", [0.0, -5.0])
    def test_command_without_positive_gain_does_not_move_the_gripper(self, kp: float) -> None:
        wire = Wire(GO, HG)
        assert wire.command(LEFT, q=0.0, kp=kp) == []  # where is it?
        wire.state(LEFT, q=2.5)
        assert q_of(HG, "cmd", wire.command(LEFT, q=0.0, kp=kp)) == {LEFT: 2.5}
        wire.state(LEFT, q=2.0)  # pushed by hand
        assert q_of(HG, "cmd", wire.command(LEFT, q=0.0, kp=kp, dq=1.0)) == {LEFT: 2.0}
        assert q_of(HG, "cmd", wire.command(LEFT, q=0.0, kp=5.0)) == {LEFT: 0.0}


class TestOneMessageIntoTwoTopics:
    """From unitree_actuator."""

    def test_no_state_is_published_for_an_absent_gripper(self) -> None:
        wire = Wire(GO, ACTUATOR)
        assert set(q_of(GO, "state", wire.state(LEFT))) == {LEFT}
        assert wire.states.counts.blank == 1
        # it may be commanded all the same: there is no gripper
        assert len(wire.command(LEFT) + wire.later(PATIENCE)) == 1

    def test_gripper_at_zero_is_present_after_another_position(self) -> None:
        wire = Wire(GO, ACTUATOR)
        wire.state(*BOTH)
        assert q_of(GO, "state", wire.state(*BOTH, q=0.0)) == {LEFT: 0.0, RIGHT: 0.0}

    def test_one_side_of_a_topic_for_both_hands_is_translated(self) -> None:
        wire = Wire(GO, ACTUATOR, (RIGHT,))
        assert set(q_of(GO, "state", wire.state(*BOTH))) == {RIGHT}
        (right, left) = motors(wire.command(RIGHT, q=1.5, kp=5.0))  # does not wait
        assert (right.q, right.kp) == (3.0, 5.0)
        assert (left.q, left.kp) == (1.0, 0.0)  # where it was seen
        assert wire.commands.inputs == {"rt/dex1/right/cmd": (RIGHT,)}

    def test_message_with_one_motor_commands_the_right_gripper(self) -> None:
        wire = Wire(ACTUATOR, GO)
        payload = message_type(ACTUATOR.cmd_type).encode(
            unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=1.0)])
        )
        out = wire.commands.receive(ACTUATOR.cmd_topic, payload, wire.now)
        assert q_of(GO, "cmd", out) == {RIGHT: 1.0}
        assert wire.commands.counts.short == 1

    def test_additional_motors_of_a_message_are_ignored(self) -> None:
        wire = Wire(ACTUATOR, GO)
        payload = message_type(ACTUATOR.cmd_type).encode(
            unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q) for q in (1.0, 2.0, 3.0)])
        )
        out = wire.commands.receive(ACTUATOR.cmd_topic, payload, wire.now)
        assert q_of(GO, "cmd", out) == {RIGHT: 1.0, LEFT: 2.0}
        assert wire.commands.counts.overlong == 1


def near32(value: float) -> float:
    """``value`` as float32 holds it."""
    found: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return found
