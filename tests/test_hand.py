"""The common hand interface: shapes, defaults, the gate that every command passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.errors import CommandRejected, UsageError
from dexkit.hand import (
    CommandGate,
    HandCommand,
    HandSpec,
    HandState,
    JointMode,
    JointSpec,
    Side,
)
from dexkit.models import DEX1_1, DIALECTS, MODELS, dialect, model
from tests.each import each

THREE = HandSpec(
    model="three",
    side=Side.LEFT,
    joints=(
        JointSpec("a", q_min=-1.0, q_max=1.0, dq_max=5.0, tau_max=2.0),
        JointSpec("b", q_min=0.0, q_max=2.0, dq_max=6.0, tau_max=3.0),
        JointSpec("c", q_min=-3.0, q_max=-1.0, dq_max=7.0, tau_max=4.0),
    ),
    io_rate=100.0,
)
FIELDS = ("q", "dq", "tau", "kp", "kd")
any_float = st.floats(allow_nan=True, allow_infinity=True)


def command(values: dict[str, list[float]]) -> HandCommand:
    arrays = {name: np.array(values[name]) for name in FIELDS}
    return HandCommand(**arrays, mode=np.full(3, JointMode.FOC, dtype=np.uint8))


class TestGate:
    @given(st.fixed_dictionaries({n: st.lists(any_float, min_size=3, max_size=3) for n in FIELDS}))
    def test_admits_within_the_limits_or_rejects_the_whole(
        self, values: dict[str, list[float]]
    ) -> None:
        gate = CommandGate(THREE)
        finite = all(math.isfinite(v) for name in FIELDS for v in values[name])
        if not finite:
            with pytest.raises(CommandRejected):
                gate.admit(command(values))
            assert (gate.rejected, gate.clamped) == (1, 0)
            return
        out = gate.admit(command(values))
        for i, joint in enumerate(THREE.joints):
            assert joint.q_min <= out.q[i] <= joint.q_max
            assert abs(out.dq[i]) <= joint.dq_max
            assert abs(out.tau[i]) <= joint.tau_max
            assert out.kp[i] >= 0
            assert out.kd[i] >= 0
        assert gate.rejected == 0
        assert gate.clamped == (not out.same_as(command(values)))

    def test_command_within_the_limits_is_admitted_unchanged(self) -> None:
        gate = CommandGate(THREE)
        c = HandCommand.position([0.5, 1.0, -2.0])
        assert gate.admit(c) is c

    @each("n", [1, 2, 4])
    @each("field", [*FIELDS, "mode"])
    def test_a_wrong_shape_is_rejected(self, field: str, n: int) -> None:
        c = HandCommand.position([0.5, 1.0, -2.0])
        object.__setattr__(c, field, np.zeros(n))
        with pytest.raises(CommandRejected, match=f"{field} has shape .* 3 joint"):
            CommandGate(THREE).admit(c)

    def test_a_rejection_names_field_and_joint(self) -> None:
        c = HandCommand.position([0.5, math.nan, -2.0])
        with pytest.raises(CommandRejected, match="field q is not finite: b = nan"):
            CommandGate(THREE).admit(c)

    def test_the_command_is_not_changed_in_place(self) -> None:
        c = HandCommand.position([9.0, 9.0, 9.0])
        CommandGate(THREE).admit(c)
        assert list(c.q) == [9.0, 9.0, 9.0]


class TestCommand:
    def test_position_has_the_gains_of_teleoperation(self) -> None:
        c = HandCommand.position(2.0)
        assert (c.kp[0], c.kd[0], c.mode[0]) == (5.0, 0.05, JointMode.FOC)
        assert not c.is_brake

    def test_brake_command_has_no_gains(self) -> None:
        c = HandCommand.brake(3)
        assert c.is_brake
        assert not c.kp.any()
        assert CommandGate(DEX1_1.spec(Side.LEFT, io_rate=1.0)).admit(HandCommand.brake(1)).is_brake

    def test_commands_with_different_gains_are_not_the_same(self) -> None:
        assert HandCommand.position(1.0).same_as(HandCommand.position(1.0))
        assert not HandCommand.position(1.0).same_as(HandCommand.position(1.0, kd=0.1))


class TestState:
    def test_unknown_values_are_nan(self) -> None:
        s = HandState.from_values([1.0, 2.0], stamp=3.0)
        assert s.dq.shape == (2,)
        assert np.isnan(s.temperature).all()
        assert np.isnan(s.voltage).all()
        assert (s.pressure, s.imu, s.supply) == (None, None, None)
        assert s.measured


class TestSpec:
    @each(
        "fields",
        [
            {"q_min": 1.0, "q_max": 1.0},
            {"q_min": 2.0, "q_max": 1.0},
            {"dq_max": 0.0},
            {"tau_max": -1.0},
            {"closing": 2},
        ],
    )
    def test_invalid_joint_limits_are_refused(self, fields: dict[str, float]) -> None:
        good = {"q_min": 0.0, "q_max": 1.0, "dq_max": 1.0, "tau_max": 1.0}
        with pytest.raises(UsageError, match="joint x"):
            JointSpec("x", **{**good, **fields})  # type: ignore[arg-type]

    @each("io_rate", [0.0, -1.0, math.inf, math.nan])
    def test_io_rate_must_be_a_rate(self, io_rate: float) -> None:
        with pytest.raises(UsageError, match="io_rate"):
            DEX1_1.spec(Side.LEFT, io_rate=io_rate)

    def test_a_hand_has_joints(self) -> None:
        with pytest.raises(UsageError, match="at least one joint"):
            HandSpec(model="x", side=Side.LEFT, joints=(), io_rate=1.0)


class TestModels:
    def test_dex1_profile_agrees_with_its_sources(self) -> None:
        """docs/sources/unitree-dex.md#a1, docs/sources/unitree-dex.md#b1,
        docs/sources/unitree-dex.md#b2, docs/sources/unitree-dex.md#b3.
        """
        joint = DEX1_1.joints[Side.LEFT][0]
        assert (joint.q_min, joint.q_max) == (0.0, 5.4)
        assert (DEX1_1.state_rate, DEX1_1.command_rate) == (500.0, 200.0)
        assert DEX1_1.command_timeout == 1.0
        assert DEX1_1.vendor_ids == {Side.RIGHT: 0, Side.LEFT: 1}

    @each(
        ("name", "side", "topics", "types"),
        [
            ("unitree_go", Side.LEFT, ("rt/dex1/left/cmd", "rt/dex1/left/state"),
             ("unitree_go::msg::dds_::MotorCmds_", "unitree_go::msg::dds_::MotorStates_")),
            ("unitree_hg", Side.RIGHT, ("rt/dex1/right/cmd", "rt/dex1/right/state"),
             ("unitree_hg::msg::dds_::HandCmd_", "unitree_hg::msg::dds_::HandState_")),
            ("unitree_actuator", Side.RIGHT,
             ("rt/unitree_actuator/cmd", "rt/unitree_actuator/state"),
             ("unitree_go::msg::dds_::MotorCmds_", "unitree_go::msg::dds_::MotorStates_")),
        ],
    )  # fmt: skip
    def test_dialect_has_its_topics_and_types(
        self, name: str, side: Side, topics: tuple[str, str], types: tuple[str, str]
    ) -> None:
        d = dialect(name)
        assert d.topics(side) == topics
        assert (d.cmd_type, d.state_type) == types

    def test_unknown_model_error_lists_the_known_ones(self) -> None:
        with pytest.raises(UsageError) as raised:
            model("dex9")
        assert "dex9" in raised.value.message
        assert all(name in raised.value.hint for name in MODELS)
        with pytest.raises(UsageError) as raised:
            dialect("klingon")
        assert all(name in raised.value.hint for name in DIALECTS)
