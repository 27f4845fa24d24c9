"""What a simulated hand measures survives every encoding it has: DDS messages and USB frames."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.clock import Clock, ManualClock
from dexkit.emulators.sim_brainco import SimBrainCo
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.emulators.sim_dex3 import SimDex3
from dexkit.emulators.sim_dex5 import SimDex5
from dexkit.emulators.sim_inspire import SimInspireDfx, SimInspireFtp
from dexkit.emulators.simulated_hand import SimulatedHand
from dexkit.errors import EncodeError
from dexkit.hand import HandCommand, HandState, Side
from dexkit.messages import message_type
from dexkit.models import DEX3_1, Dialect, model
from dexkit.service.dialects import StateView, dialect_map
from dexkit.wire.dex3_usb import HandCodec
from tests.each import each

CODECS = {side: HandCodec(DEX3_1.joints[side]) for side in Side}
# with an object between the fingers, so that touch and force are not 0
HANDS: tuple[Callable[[Side, Clock], SimulatedHand], ...] = (
    lambda side, clock: SimHand(side, object_pct=30.0, clock=clock),
    lambda side, clock: SimDex3(side, object_at=30.0, clock=clock),
    lambda side, clock: SimDex5(side, object_at=30.0, clock=clock),
    lambda side, clock: SimBrainCo(side, object_at=30.0, clock=clock),
    lambda side, clock: SimInspireDfx(side, object_at=30.0, clock=clock),
    lambda side, clock: SimInspireFtp(side, object_at=30.0, clock=clock),
)

# a goal as a fraction of the range, whether the drive is stiff, seconds until the next
motions = st.lists(
    st.tuples(st.floats(0.0, 1.0), st.booleans(), st.floats(0.0, 0.2)), min_size=1, max_size=3
)
sides = st.sampled_from(list(Side))


def states(
    make: Callable[[Side, Clock], SimulatedHand],
    side: Side,
    plan: Sequence[tuple[float, bool, float]],
) -> list[HandState]:
    """The states of a hand that moves by ``plan``, the first before any command."""
    clock = ManualClock()
    hand = make(side, clock)
    hand.open()
    spec = hand.spec
    found = [hand.exchange(HandCommand.brake(spec.n_joints))]
    for part, stiff, seconds in plan:
        q = spec.q_min + part * (spec.q_max - spec.q_min)
        command = HandCommand.position(q, kp=1.5 if stiff else 0.2, kd=0.1)
        hand.exchange(command)
        clock.advance(seconds)
        found.append(hand.exchange(command))
    return found


def close(got: object, wanted: object, step: object, what: str) -> None:
    """Assert that no value is further than ``step`` from what was measured; unknown is 0."""
    expected = np.nan_to_num(np.asarray(wanted, dtype=np.float64))
    error = np.abs(np.asarray(got, dtype=np.float64) - expected)
    assert (error <= np.asarray(step) * (1 + 1e-6)).all(), what


@settings(max_examples=10, deadline=None)
@given(sides, motions)
def test_every_state_survives_its_dds_messages(
    side: Side, plan: list[tuple[float, bool, float]]
) -> None:
    for make in HANDS:
        spec = make(side, ManualClock()).spec
        for dialect in model(spec.model).dialects:
            for state in states(make, side, plan):
                check_message(dialect, side, make, state)


def check_message(
    dialect: Dialect,
    side: Side,
    make: Callable[[Side, Clock], SimulatedHand],
    state: HandState,
) -> None:
    spec = make(side, ManualClock()).spec
    fault = tuple(int(bits) for bits in state.fault)
    mapping = dialect_map(dialect, {side: spec})
    kind = message_type(dialect.state_type)
    message = kind.decode(mapping.encode({side: StateView(state, fault)}))
    first = dialect.index[side]
    motors = getattr(message, kind.motor_sequence)[first : first + spec.n_joints]
    if not hasattr(motors[0], "q"):  # whole thousandths in lists of their own
        close(motors, state.q * 1000, 0.5, "q")
        return
    scale = dialect.q_open / spec.joints[0].q_max if dialect.name == "unitree_hg" else 1.0
    units_of_tau = np.array(dialect.torque_units or 1.0)
    tau = state.tau_est / units_of_tau
    float32 = 1e-5
    close([m.q for m in motors], state.q * scale, float32, "q")
    dq = state.dq * scale / np.array(dialect.speed_units or 1.0)
    close([m.dq for m in motors], dq, 1e-3, "dq")
    close(
        [m.tau_est for m in motors],
        np.abs(tau) if dialect.name == "unitree_hg" else tau,
        1e-4 * (1 + np.abs(tau)),
        "tau_est",
    )


@settings(max_examples=25, deadline=None)
@given(
    st.sets(st.sampled_from(["temperature", "winding_temperature", "voltage"])),
    st.booleans(),
    st.booleans(),
    st.lists(st.integers(0, 6), max_size=7),
)
def test_values_unknown_to_a_backend_are_sent_as_0(
    unknown: set[str], no_heat: bool, no_imu: bool, joints: list[int]
) -> None:
    (state,) = states(HANDS[1], Side.LEFT, [])
    changed = {}
    for name in unknown:
        values = np.array(getattr(state, name))
        values[joints] = math.nan
        changed[name] = values
    assert state.imu is not None
    assert state.sensor_temperature is not None
    state = dataclasses.replace(
        state,
        **changed,  # type: ignore[arg-type]
        sensor_temperature=np.full((9, 12), math.nan) if no_heat else state.sensor_temperature,
        imu=dataclasses.replace(state.imu, gyroscope=(math.nan,) * 3) if no_imu else state.imu,
    )
    decoded = CODECS[Side.LEFT].decode(CODECS[Side.LEFT].encode_state(state), 0.0)
    for name in unknown:
        assert not getattr(decoded, name)[joints].any()
    assert decoded.imu is not None
    assert decoded.imu.gyroscope == (0.0, 0.0, 0.0)


@each("name", ["q", "dq", "tau_est"])
def test_an_unknown_position_speed_or_torque_is_not_made_up(name: str) -> None:
    (state,) = states(HANDS[1], Side.LEFT, [])
    values = np.array(getattr(state, name))
    values[3] = math.nan
    state = dataclasses.replace(state, **{name: values})  # type: ignore[arg-type]
    codec = CODECS[Side.LEFT]
    with pytest.raises(EncodeError):
        codec.encode_state(state)
    decoded = codec.decode(codec.encode_state(state, motors=[0, 1, 2, 4, 5, 6]), 0.0)
    assert np.isnan(decoded.q[3])
