"""What holds for every hand of dexkit: resting pose, simulated hand, time-out, topics and units."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dexkit.backends import BackendOptions, backend, simulators
from dexkit.cli import cli
from dexkit.clock import ManualClock
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Verdict
from dexkit.emulators.simulated_hand import SimulatedHand
from dexkit.errors import HandLost, UsageError
from dexkit.hand import (
    CommandGate,
    Floats,
    Hand,
    HandCommand,
    HandState,
    ImuState,
    JointMode,
    Side,
    SupplyState,
)
from dexkit.messages import message_type
from dexkit.models import BUILT_IN, HandModel
from dexkit.service.dialects import StateView, dialect_map
from dexkit.service.hand_core import HandCore
from dexkit.topics import roles
from dexkit.watch.fields import parts_of
from tests.each import each
from tests.emulated_service import EmulatedService

SIMULATORS = simulators()
RADIANS = re.compile(r"\brad\b|\bradians\b|N m\b|_rad\b")
SERVOS = [hand for hand in BUILT_IN if hand.dialects[0].position_servo]

every_hand = pytest.mark.parametrize("hand", BUILT_IN, ids=lambda hand: hand.name)
both_sides = pytest.mark.parametrize("side", Side)


def simulated(hand: HandModel, side: Side, **settings: str) -> tuple[SimulatedHand, ManualClock]:
    """The hand that its backend makes, on a clock of its own."""
    made = backend(SIMULATORS[hand.name]).create(BackendOptions(side, settings=settings))
    assert isinstance(made, SimulatedHand)
    made._clock = clock = ManualClock()
    return made, clock


def towards(hand: HandModel, goal: Floats) -> HandCommand:
    """The client's command to go to ``goal``, as fast as it can."""
    kp, kd = np.array(hand.gains).T
    full = [joint.dq_max for joint in hand.joints[Side.LEFT]]
    dq = full if hand.dialects[0].position_servo else 0.0
    return HandCommand.position(goal, dq=dq, kp=kp, kd=kd)


def hold(
    made: SimulatedHand, clock: ManualClock, command: HandCommand, seconds: float
) -> HandState:
    state = made.exchange(command)
    for _ in range(round(seconds * 100)):
        clock.advance(0.01)
        state = made.exchange(command)
    return state


# --------------------------------------------------------------------------------- simulated hand


@every_hand
def test_simulated_hand_implements_hand(hand: HandModel) -> None:
    made, clock = simulated(hand, Side.RIGHT)
    assert isinstance(made, Hand)
    assert made.spec.simulated
    assert (made.spec.model, made.spec.side) == (hand.name, Side.RIGHT)
    assert made.spec.joints == hand.joints[Side.RIGHT]
    assert made.spec.n_sensors == len(hand.sensors) + len(hand.dialects[0].areas)
    n = made.spec.n_joints
    with pytest.raises(HandLost):
        made.exchange(HandCommand.brake(n))
    made.open()
    closed = towards(hand, np.array([joint.q_min for joint in made.spec.joints]))
    before = hold(made, clock, closed, 0.1).q
    made.close()
    with pytest.raises(HandLost):
        made.exchange(HandCommand.brake(n))
    clock.advance(5.0)
    made.open()
    assert np.allclose(hold(made, clock, HandCommand.brake(n), 0.1).q, before, atol=0.05)


@every_hand
@both_sides
def test_it_begins_in_the_resting_pose_clear_of_all_stops(hand: HandModel, side: Side) -> None:
    made, clock = simulated(hand, side)
    made.open()
    state = hold(made, clock, HandCommand.brake(made.spec.n_joints), 0.2)
    assert state.q == pytest.approx(hand.rest_q[side])
    assert not state.mode.any()
    assert state.measured
    assert state.stamp == clock.now()
    for q, joint in zip(hand.rest_q[side], hand.joints[side], strict=True):
        assert joint.q_min < q < joint.q_max
        assert q != 0.0


@every_hand
@both_sides
def test_every_joint_arrives_by_the_clients_commands(hand: HandModel, side: Side) -> None:
    made, clock = simulated(hand, side)
    made.open()
    low, high = made.spec.q_min, made.spec.q_max
    for part in (0.8, 0.2):
        goal = low + part * (high - low)
        state = hold(made, clock, towards(hand, goal), 2.0)
        assert (np.abs(state.q - goal) < 0.01 * (high - low)).all()
        assert np.abs(state.dq).max() < 0.01
        if not hand.dialects[0].position_servo:  # which has no mode
            assert set(state.mode.tolist()) == {JointMode.FOC}


@every_hand
def test_an_object_stops_it(hand: HandModel) -> None:
    is_gripper = hand.dialects[0].is_gripper
    made, clock = simulated(hand, Side.RIGHT, object="50", start="80" if is_gripper else "0")
    made.open()
    flexing = [joint for joint in made.spec.joints if joint.closing]
    index = [made.spec.joints.index(joint) for joint in flexing]
    goal = np.array([0.5 * (j.q_min + j.q_max) for j in made.spec.joints])
    goal[index] = [j.q_max if j.closing > 0 else j.q_min for j in flexing]
    state = hold(made, clock, towards(hand, goal), 2.0)
    # percent of opening for a gripper, of closing for others
    middle = [0.5 * j.q_max if is_gripper else j.closed_by(0.5) for j in flexing]
    strokes = np.array([j.stroke for j in flexing])
    assert (np.abs(state.q[index] - middle) < 0.05 * strokes).all()


@every_hand
@each(
    "settings",
    [
        {"start": "half"},
        {"start": "101"},
        {"object": "0"},
        {"object": "many"},
        {"colour": "red"},
    ],
)
def test_settings_that_make_no_sense_are_refused(hand: HandModel, settings: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        simulated(hand, Side.LEFT, **settings)


@pytest.mark.parametrize("hand", BUILT_IN[1:], ids=lambda hand: hand.name)
def test_a_start_inside_the_object_is_refused(hand: HandModel) -> None:
    with pytest.raises(UsageError, match="inside the object"):
        simulated(hand, Side.LEFT, start="50", object="40")


@every_hand
def test_the_same_commands_give_the_same_states(hand: HandModel) -> None:
    def run() -> list[HandState]:
        made, clock = simulated(hand, Side.LEFT)
        made.open()
        random = np.random.default_rng(1)
        low, stroke = made.spec.q_min, made.spec.q_max - made.spec.q_min
        goals = [low + random.random(low.size) * stroke for _ in range(10)]
        return [hold(made, clock, towards(hand, goal), 0.05) for goal in goals]

    for one, other in zip(run(), run(), strict=True):
        for name in ("q", "dq", "tau_est", "pressure"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@every_hand
@given(st.lists(st.floats(-1e4, 1e4), min_size=4, max_size=4), st.floats(0.0, 1.0))
def test_it_stays_within_its_stops_under_any_command(
    hand: HandModel, values: list[float], part: float
) -> None:
    kp, kd, tau, dq = values
    made, clock = simulated(hand, Side.LEFT)
    made.open()
    low, stroke = made.spec.q_min, made.spec.q_max - made.spec.q_min
    wild = HandCommand.position(low + part * stroke, kp=kp, kd=kd, tau=tau, dq=dq)
    command = CommandGate(made.spec).admit(wild)
    state = hold(made, clock, command, 0.3)
    assert ((state.q > low - 0.1 * stroke) & (state.q < low + 1.1 * stroke)).all()
    most = np.array([joint.tau_max for joint in made.spec.joints])
    assert (np.abs(state.tau_est) <= most).all()
    assert np.isfinite(state.dq).all()


@every_hand
def test_a_long_pause_is_survived(hand: HandModel) -> None:
    made, clock = simulated(hand, Side.LEFT)
    made.open()
    made.exchange(towards(hand, made.spec.q_max))
    clock.advance(3600.0)
    assert np.isfinite(made.exchange(HandCommand.brake(made.spec.n_joints)).q).all()


# ------------------------------------------------------------------------------ service and topics


def numbers(value: object) -> Iterator[float]:
    """Every number in a message."""
    if isinstance(value, (int, float)):
        yield float(value)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from numbers(item)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from numbers(getattr(value, field.name))


anything = st.floats(allow_nan=True, allow_infinity=True, width=32)


@every_hand
@given(st.lists(anything, min_size=6, max_size=6), st.integers(0, 2**32 - 1), st.integers(0, 2**40))
def test_whatever_a_backend_returns_no_client_reads_nan(
    hand: HandModel, values: list[float], fault: int, missed: int
) -> None:
    dq, tau, celsius, volt, pascal, amps = values
    joints, sensors = len(hand.joints[Side.LEFT]), (len(hand.sensors), 12)
    state = HandState.from_values(
        hand.rest_q[Side.LEFT],
        stamp=0.0,
        dq=dq,
        ddq=tau,
        tau_est=tau,
        temperature=celsius,
        voltage=volt,
        winding_temperature=np.full(joints, celsius),
        pressure=np.full(sensors, pascal) if hand.sensors else None,
        sensor_temperature=np.full(sensors, celsius) if hand.sensors else None,
        imu=ImuState(rpy=(dq, tau, volt), temperature=celsius),
        supply=SupplyState(volt, amps, volt, amps),
    )
    spec = hand.spec(Side.LEFT, io_rate=100.0)
    for dialect in hand.dialects:
        mapping = dialect_map(dialect, {Side.LEFT: spec})
        sent = mapping.encode({Side.LEFT: StateView(state, (fault,) * joints, missed)})
        message = message_type(dialect.state_type).decode(sent)
        assert all(map(math.isfinite, numbers(message)))


@every_hand
def test_it_is_held_when_no_command_has_come_for_the_time_out(hand: HandModel) -> None:
    clock = ManualClock()
    core = HandCore(hand.spec(Side.LEFT, io_rate=100.0, simulated=True), hand, clock)
    core.opened(core.spec)
    clock.advance(0.01)
    assert core.submit(towards(hand, np.array(hand.rest_q[Side.LEFT])))
    clock.advance(hand.command_timeout - 0.02)
    assert not core.next_command().is_brake
    clock.advance(0.04)
    assert core.next_command().is_brake
    assert core.submit(towards(hand, np.array(hand.rest_q[Side.LEFT])))
    assert not core.next_command().is_brake


@every_hand
def test_topics_belong_to_their_dialects(hand: HandModel) -> None:
    for dialect in hand.dialects:
        for side in Side:
            for kind, topic in zip(("cmd", "state"), dialect.topics(side), strict=True):
                (role,) = (r for r in roles(topic) if r.dialect.name == dialect.name)
                assert role.kind == kind
                assert side in role.sides


# ------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize("hand", SERVOS, ids=lambda hand: hand.name)
def test_a_hand_in_parts_of_its_travel_is_not_described_in_radians(hand: HandModel) -> None:
    for options in ((), ("--json",)):
        text = CliRunner().invoke(cli, ["models", hand.name, *options]).output
        assert "full travel" in text
        assert not RADIANS.search(text)
    dialect = hand.dialects[0]
    parts = parts_of(dialect.topics(Side.LEFT)[1], dialect.state_type)
    for part in parts:
        units = {f.quantity: f.unit for f in part.fields}
        assert units["q"] == "full travel"
        assert units.get("tau", hand.torque_unit) == hand.torque_unit
    for r in catalogue(hand.name, None):
        for words in (r.title, r.sentence, r.expected):
            assert not RADIANS.search(words), r.id


# ------------------------------------------------------------------------------------- conformance


@pytest.mark.soak
@pytest.mark.parametrize("hand", SERVOS, ids=lambda hand: hand.name)
def test_served_simulated_hands_meet_every_requirement(hand: HandModel) -> None:
    class Emulated(EmulatedService):
        simulated = type(simulated(hand, Side.LEFT)[0])

    result = run_mutant(Emulated, plan_for(hand.dialects[0].name))
    bad = [
        r.explain()
        for r in result.results
        if r.verdict not in (Verdict.PASS, Verdict.NOT_APPLICABLE)
    ]
    assert not bad, "\n".join(bad)
    passed = {r.requirement.id for r in result.results if r.verdict is Verdict.PASS}
    assert passed == {r.id for r in catalogue(hand.name)}
