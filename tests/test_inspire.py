"""Test Inspire's DFX hands: profile, one message of both, simulated hand, client and the doctor."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dexkit.cli import cli
from dexkit.clock import ManualClock
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.kit.backend_processes import RigOptions
from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual.fingers import Ints
from dexkit.conformance.virtual.inspire import InspireHand, InspireService
from dexkit.doctor import Observations, diagnose
from dexkit.doctor.dds import _Watch
from dexkit.doctor.observations import DomainView, Endpoint, Participant, Policies, Stream
from dexkit.doctor.rtps import EndpointData
from dexkit.emulators.sim_inspire import SimInspireDfx
from dexkit.errors import UsageError
from dexkit.hand import Floats, HandCommand, HandState, Side
from dexkit.messages import message_type, unitree_go
from dexkit.models import INSPIRE_DFX, dialect
from dexkit.service.dialects import DialectMap, Fill, StateView, dialect_map
from dexkit.service.hand_core import HandCore
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.client_codec import ClientCodec
from dexkit.topics import roles
from dexkit.watch.fields import parts_of
from tests.each import each

DFX = dialect("inspire_dfx")
STATES, COMMANDS = message_type(DFX.state_type), message_type(DFX.cmd_type)
LEFT, RIGHT = Side.LEFT, Side.RIGHT
N = 6


# --------------------------------------------------------------------------------------- the model


def test_inspire_q_is_1_when_open_and_right_motors_come_first() -> None:
    for side in Side:
        joints = INSPIRE_DFX.joints[side]
        names = ["pinky", "ring", "middle", "index", "thumb_bend", "thumb_rotation"]
        assert [j.name for j in joints] == names
        assert {(j.q_min, j.q_max, j.closing, j.straight) for j in joints} == {(0.0, 1.0, -1, 1.0)}
        assert [j.closed_by(0.25) for j in joints] == [0.75] * N
    assert (DFX.index[RIGHT], DFX.index[LEFT], DFX.length) == (0, 6, 12)
    assert DFX.shared
    assert DFX.commands_both
    assert not dialect("brainco").shared
    assert not dialect("unitree_actuator").commands_both  # a motor without gains is limp


def test_inspire_topic_carries_both_hands() -> None:
    (state,) = roles("rt/inspire/state")
    assert (state.kind, state.dialect.name, set(state.sides)) == ("state", "inspire_dfx", set(Side))


def test_the_halves_of_a_message_are_described() -> None:
    text = CliRunner().invoke(cli, ["models", "inspire-dfx"]).output
    assert "12 motors in a message: 6 to 11 left, 0 to 5 right" in text
    parts = parts_of("rt/inspire/state", DFX.state_type)
    assert {p.subject for p in parts} == set(Side)
    for part in parts:
        first = DFX.index[Side(part.subject)]
        assert next(f.path for f in part.fields if f.quantity == "q") == f"states[{first}].q"


# --------------------------------------------------------------------------------- simulated hand


def opened(side: Side = LEFT, **options: float) -> tuple[SimInspireDfx, ManualClock]:
    clock = ManualClock()
    hand = SimInspireDfx(side, clock=clock, **options)
    hand.open()
    return hand, clock


def hold(hand: SimInspireDfx, clock: ManualClock, q: float, seconds: float) -> HandState:
    command = HandCommand.position([q] * N, dq=[j.dq_max for j in hand.spec.joints])
    state = hand.exchange(command)
    for _ in range(round(seconds * 100)):
        clock.advance(0.01)
        state = hand.exchange(command)
    return state


def test_only_the_position_is_measured_and_the_full_travel_takes_0_8_s() -> None:
    hand, clock = opened(start=0.0)
    state = hold(hand, clock, 0.0, 0.4)
    assert np.allclose(state.q, 0.5, atol=0.04)
    assert not state.dq.any()
    assert not state.tau_est.any()
    for goal in (0.0, 1.0, 0.4567):
        assert np.abs(hold(hand, clock, goal, 1.5).q - goal).max() <= 0.0005


# --------------------------------------------------------------------------------------- dialect


def mapping(fill: Fill = Fill.KNOWN, sides: tuple[Side, ...] = tuple(Side)) -> DialectMap:
    return dialect_map(DFX, {s: INSPIRE_DFX.spec(s, io_rate=100.0) for s in sides}, fill)


def message(*q: float, **fields: float) -> unitree_go.MotorCmds_:
    return unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=x, **fields) for x in q])  # type: ignore[arg-type]


@given(st.lists(st.floats(0, 1, width=32), min_size=12, max_size=12))
def test_each_hand_gets_its_half_of_a_command(q: list[float]) -> None:
    sent = COMMANDS.decode(COMMANDS.encode(message(*q, dq=0.3, kp=2.0, tau=-1.0)))
    for side, half in ((RIGHT, q[:N]), (LEFT, q[N:])):
        command = mapping().command(sent, side)
        assert command is not None
        assert command.q.tolist() == half
        assert command.dq.tolist() == [1.25] * N  # as fast as it can, whatever dq is
        assert not command.tau.any()
        assert not command.is_limp


@given(st.lists(st.floats(0, 1, width=32), min_size=12, max_size=12), st.sampled_from(Fill))
def test_both_hands_are_in_one_state(q: list[float], fill: Fill) -> None:
    views = {
        side: StateView(HandState.from_values(half, stamp=0.0), (0,) * N)
        for side, half in ((RIGHT, q[:N]), (LEFT, q[N:]))
    }
    sent = STATES.decode(mapping(fill).encode(views))
    assert [m.q for m in sent.states] == q
    assert not any((m.dq, m.ddq, m.tau_est) != (0.0, 0.0, 0.0) for m in sent.states)


def test_state_of_one_hand_leaves_the_motors_of_the_other_0() -> None:
    view = StateView(HandState.from_values([0.5] * N, stamp=0.0), (0,) * N)
    sent = STATES.decode(mapping(sides=(LEFT,)).encode({LEFT: view}))
    assert [m.q for m in sent.states] == [0.0] * N + [0.5] * N


@each("value", [math.nan, math.inf, -math.inf])
def test_non_finite_values_reject_one_hand_only(value: float) -> None:
    commands = message(*[0.3] * 5, value, *[0.6] * N)
    for side, good in ((RIGHT, False), (LEFT, True)):
        core = HandCore(INSPIRE_DFX.spec(side, io_rate=100.0), INSPIRE_DFX, ManualClock())
        core.opened(core.spec)
        command = mapping().command(commands, side)
        assert command is not None
        assert core.submit(command) is good


def test_eleven_motors_are_a_command_to_the_right_hand_alone() -> None:
    assert mapping().command(message(*[0.3] * 11), RIGHT) is not None
    assert mapping().command(message(*[0.3] * 11), LEFT) is None
    assert mapping().length == 12


# ----------------------------------------------------------------------------------------- clients


def test_client_waits_for_the_right_hand_and_begins_open() -> None:
    client = client_for("inspire_dfx")
    closed, half = (0.0,) * N, (0.5,) * N
    client.receive(0.0, {LEFT: half, RIGHT: closed})
    assert client.step(0.01, {}, {}) == {}
    assert client.missing == {RIGHT: "every q is exactly 0"}
    client.receive(0.02, {LEFT: closed, RIGHT: half})
    commands = client.step(0.03, {}, {})
    assert {tuple(m) for motors in commands.values() for m in motors} == {(0, 1.0, 0, 0, 0, 0)}
    fist = Operator(profile("fist", "inspire-dfx"), DFX).inputs(2.5, Side)[LEFT]
    assert fist is not None
    assert min(fist) < 0.4


def test_one_hand_alone_is_not_commanded() -> None:
    for attempt in (
        lambda: client_for("inspire_dfx", (LEFT,)),
        lambda: RigOptions("external", (RIGHT,), DFX, 0).check(),
    ):
        with pytest.raises(UsageError, match="moves both hands") as caught:
            attempt()
        assert caught.value.hint == "choose both sides"
    wire, client = ClientCodec(DFX), client_for("inspire_dfx")
    client.receive(0.0, dict.fromkeys(Side, (0.5,) * N))
    commands = client.step(0.01, {}, {})
    assert wire.encode({LEFT: commands[LEFT]}) == []
    ((topic, payload),) = wire.encode(commands)
    assert (topic, len(COMMANDS.decode(payload).cmds)) == ("rt/inspire/cmd", 12)


def test_shorter_and_longer_commands_carry_both_hands() -> None:
    codec = MotorCodec(DFX)
    hands = {RIGHT: [Motor(0.1)] * N, LEFT: [Motor(0.2)] * N}

    def sent(encoded: list[tuple[str, bytes]]) -> list[float]:
        ((topic, payload),) = encoded
        assert topic == "rt/inspire/cmd"
        return [round(m.q, 6) for m in COMMANDS.decode(payload).cmds]

    assert sent(codec.encode(hands)) == [0.1] * N + [0.2] * N
    assert sent(codec.encode_shorter(hands)) == [0.1] * N + [0.2] * 5
    assert sent(codec.encode_longer(hands, [Motor(1.0)])) == [0.1] * N + [0.2] * N + [1.0]


# ------------------------------------------------------------------------------------ conformance


def test_requirements_and_wrong_hands_come_from_the_nearest_relative() -> None:
    by_id = {r.id: r for r in catalogue("inspire-dfx")}
    assert by_id["DFX-MOVE-02"].lineage == ("BRAINCO-MOVE-02", "DEX3-MOVE-02")
    assert by_id["DFX-START-01"].lineage == ("BRAINCO-START-01", "DEX3-START-01")
    assert by_id["DFX-STILL-02"].tolerances == catalogue_of("brainco-revo2")["BRAINCO-STILL-02"]


def catalogue_of(model: str) -> dict[str, object]:
    return {r.id: r.tolerances for r in catalogue(model)}


class _SlowRing(InspireHand):
    """Its ring finger needs 2 s for the whole travel."""

    def take(self, rows: Floats, mode: Ints) -> None:
        super().take(rows, mode)
        self.reach[1] = 0.5


class _SlowRings(InspireService):
    hand = _SlowRing


def test_slow_joints_are_warned_of_with_a_fast_client() -> None:
    plan = replace(plan_for("inspire_dfx"), phases=frozenset(["listen", "joint", "operator"]))
    result = run_mutant(_SlowRings, plan)
    verdicts = {r.verdict for r in result.results if r.requirement.id == "DFX-OPER-01"}
    assert verdicts == {Verdict.WARN}


# ----------------------------------------------------------------------------------------- doctor


@each(
    ("state", "expected"),
    [
        # each from right to left, as both are commanded from 0.9 to 0.1 and from 0.3 to 0.7
        ((0.9, 0.3, 0.1, 0.7), set()),
        ((0.1, 0.7, 0.9, 0.3), {"DDS-REVERSED"}),
        ((0.3, 0.9, 0.7, 0.1), {"DDS-SIDES-SWAPPED"}),
    ],
)
def test_doctor_sees_each_half_of_the_message(
    state: tuple[float, float, float, float], expected: set[str]
) -> None:
    def stream(name: str, right: float, left: float, now_right: float, now_left: float) -> Stream:
        began, q = ((a,) * N + (b,) * N for a, b in ((right, left), (now_right, now_left)))
        return Stream(f"rt/inspire/{name}", name, 2.0, 200, 100.0, q=q, began=began, nonzero=True)

    ends = (
        Endpoint("rt/inspire/state", DFX.state_type, "writer", "state", "hand"),
        Endpoint("rt/inspire/cmd", DFX.cmd_type, "reader", "reads", "hand"),
        Endpoint("rt/inspire/cmd", DFX.cmd_type, "writer", "cmd", "client"),
        Endpoint("rt/inspire/state", DFX.state_type, "reader", "shows", "client"),
    )
    streams = (stream("state", *state), stream("cmd", 0.9, 0.3, 0.1, 0.7))
    people = tuple(
        Participant(key, version="0.10.5", process="python") for key in ("hand", "client")
    )
    found = {f.id for f in diagnose(Observations((DomainView(1, people, ends, streams),)))}
    assert found & {"DDS-REVERSED", "DDS-SIDES-SWAPPED"} == expected


def test_doctor_reads_positions_of_a_topic_that_clients_wait_for() -> None:
    kind = EndpointData(bytes(16), "rt/inspire/state", DFX.state_type, Policies(), "")
    watch = _Watch(kind, 0.0, 1, 0.0, 1)
    for i, q in enumerate((0.9, 0.1)):
        watch.take(i + 1, STATES.encode(unitree_go.MotorStates_(
            [unitree_go.MotorState_(q=q) for _ in range(12)]
        )), float(i), 0.0)  # fmt: skip
    stream = watch.stream(2.0, 0.0)
    assert (len(stream.q), round(stream.began[0], 3), round(stream.q[0], 3)) == (12, 0.9, 0.1)
