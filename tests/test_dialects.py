"""Values to and from messages, per dialect, against the sources' own formulas and bytes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.errors import CommandRejected, UsageError
from dexkit.hand import CommandGate, HandSpec, HandState, ImuState, JointMode, Side, SupplyState
from dexkit.messages import message_type, unitree_go, unitree_hg
from dexkit.models import DEX1_1, dialect
from dexkit.service.dialects import DialectMap, Fill, StateView, dialect_map
from tests.each import each

LEFT, RIGHT = Side.LEFT, Side.RIGHT
SPECS = {side: DEX1_1.spec(side, io_rate=500.0) for side in Side}


def one(name: str, side: Side = LEFT, fill: Fill = Fill.KNOWN) -> DialectMap:
    return dialect_map(dialect(name), {side: SPECS[side]}, fill)


def go_cmd(*motors: unitree_go.MotorCmd_) -> unitree_go.MotorCmds_:
    return unitree_go.MotorCmds_(list(motors))


def hg_cmd(q: float, **fields: Any) -> unitree_hg.HandCmd_:
    return unitree_hg.HandCmd_([unitree_hg.MotorCmd_(q=q, **fields)])


def view(q: float = 1.0, *, missed: int = 0, fault: int = 0, **state: Any) -> StateView:
    return StateView(HandState.from_values(q, stamp=0.0, **state), (fault,), missed)


def via_wire(name: str, message: Any) -> Any:
    """As a peer sees it: float32 and all."""
    mt = message_type(dialect(name).cmd_type)
    return mt.decode(mt.encode(message))


class TestGoCommand:
    def test_fields_pass_as_they_are(self) -> None:
        motor = unitree_go.MotorCmd_(mode=7, q=1.5, dq=0.25, tau=-0.5, kp=5.0, kd=0.05)
        command = one("unitree_go").command(go_cmd(motor), LEFT)
        assert command is not None
        assert [float(getattr(command, f)[0]) for f in ("q", "dq", "tau", "kp", "kd")] == [
            1.5, 0.25, -0.5, 5.0, 0.05,
        ]  # fmt: skip

    @given(st.integers(0, 255))
    def test_the_mode_byte_is_ignored(self, mode: int) -> None:
        """docs/sources/unitree-dex.md#d11: clients send 0 and 1; limp is kp = kd = 0, not a
        mode.
        """
        command = one("unitree_go").command(go_cmd(unitree_go.MotorCmd_(mode=mode)), LEFT)
        assert command is not None
        assert command.mode[0] == JointMode.FOC
        assert (command.kp[0], command.kd[0]) == (0.0, 0.0)

    def test_fully_open_as_float32_is_not_beyond_the_limit(self) -> None:
        message = via_wire("unitree_go", go_cmd(unitree_go.MotorCmd_(q=5.4)))
        assert message.cmds[0].q > 5.4
        command = one("unitree_go").command(message, LEFT)
        assert command is not None
        gate = CommandGate(SPECS[LEFT])
        gate.admit(command)
        assert gate.clamped == 0

    def test_an_empty_sequence_holds_no_command(self) -> None:
        assert one("unitree_go").command(go_cmd(), LEFT) is None

    def test_first_motor_of_a_long_message_counts(self) -> None:
        """As the vendor's service reads cmds()[0] (docs/sources/unitree-dex.md#b2)."""
        message = go_cmd(*(unitree_go.MotorCmd_(q=q) for q in (1.0, 2.0, 3.0)))
        mapping = one("unitree_go")
        command = mapping.command(message, LEFT)
        assert command is not None
        assert command.q[0] == 1.0
        assert mapping.motors(message) > mapping.length == 1


class TestActuator:
    def test_right_is_0_and_left_is_1(self) -> None:
        mapping = dialect_map(dialect("unitree_actuator"), SPECS)
        message = go_cmd(unitree_go.MotorCmd_(q=1.0), unitree_go.MotorCmd_(q=2.0))
        right, left = mapping.command(message, RIGHT), mapping.command(message, LEFT)
        assert right is not None
        assert left is not None
        assert (right.q[0], left.q[0]) == (1.0, 2.0)
        state = mapping.state({RIGHT: view(1.5), LEFT: view(2.5)})
        assert [m.q for m in state.states] == [1.5, 2.5]
        assert mapping.length == 2

    def test_a_single_hand_leaves_the_other_at_zero(self) -> None:
        state = one("unitree_actuator", LEFT).state({LEFT: view(2.5)})
        assert [m.q for m in state.states] == [0.0, 2.5]

    def test_a_message_for_the_right_only_commands_no_left(self) -> None:
        mapping = dialect_map(dialect("unitree_actuator"), SPECS)
        message = go_cmd(unitree_go.MotorCmd_(q=1.0))
        assert mapping.command(message, RIGHT) is not None
        assert mapping.command(message, LEFT) is None


class TestHgCommand:
    @staticmethod
    def specified(q_radians: float) -> float:
        """dex1_to_ezgripper of the interface specification, in percent."""
        if q_radians <= 0.1:
            return 0.0
        elif q_radians >= 6.0:
            return 100.0
        else:
            return (q_radians / (2.0 * math.pi)) * 100.0

    @given(st.floats(-10.0, 10.0))
    def test_position_formula_is_that_of_the_specification(self, q: float) -> None:
        command = one("unitree_hg").command(hg_cmd(q), LEFT)
        assert command is not None
        assert command.q[0] / 5.4 * 100.0 == pytest.approx(self.specified(q))

    @each(
        ("q", "percent"),
        [
            (0.1, 0.0),
            (float(np.float32(0.1)), 0.0),  # as it arrives
            (0.1001, 0.1001 / math.tau * 100),
            (math.pi, 50.0),
            (5.9999, None),
            (6.0, 100),
        ],
    )
    def test_positions_near_the_limits_snap_to_them(self, q: float, percent: float | None) -> None:
        command = one("unitree_hg").command(hg_cmd(q), LEFT)
        assert command is not None
        expected = percent if percent is not None else q / math.tau * 100
        assert command.q[0] / 5.4 * 100 == pytest.approx(expected)

    def test_gains_are_those_of_the_service(self) -> None:
        """Clients of this interface send kp = kd = 0 and expect to be obeyed."""
        command = one("unitree_hg").command(hg_cmd(3.0, kp=0.0, kd=9.0, tau=1.0, dq=1.0), LEFT)
        assert command is not None
        assert (command.kp[0], command.kd[0]) == (5.0, 0.05)
        assert (command.tau[0], command.dq[0]) == (0.0, 0.0)

    @each("field", ["q", "dq", "tau", "kp", "kd"])
    @each("value", [math.nan, math.inf, -math.inf])
    def test_not_finite_is_rejected_and_not_snapped(self, field: str, value: float) -> None:
        message = hg_cmd(3.0)
        setattr(message.motor_cmd[0], field, value)
        command = one("unitree_hg").command(message, LEFT)
        assert command is not None
        with pytest.raises(CommandRejected):
            CommandGate(SPECS[LEFT]).admit(command)


class TestGoState:
    def test_the_golden_bytes(self) -> None:
        """docs/sources/unitree-dex.md#a4: q 1.5, dq 0.25, tau_est -0.5, rest 0, as CycloneDDS
        writes it.
        """
        message = one("unitree_go").state({LEFT: view(1.5, dq=0.25, tau_est=-0.5)})
        data = message_type(dialect("unitree_go").state_type).encode(message)
        assert data.hex() == (
            "00010000" "01000000" "00000000" "0000c03f" "0000803e" "00000000" "000000bf"
            "00000000" "00000000" "00000000" "00000000" "00000000" "00000000" "00000000"
        )  # fmt: skip

    FULL = StateView(
        HandState.from_values(
            1.5, stamp=0.0, dq=0.25, ddq=2.0, tau_est=-0.5, temperature=31.4, voltage=12.1,
            mode=JointMode.FOC, measured=False,
        ),
        (0x80000001,),
        7,
    )  # fmt: skip

    def test_known_fields_are_filled(self) -> None:
        motor = one("unitree_go").state({LEFT: self.FULL}).states[0]
        assert (motor.mode, motor.ddq, motor.temperature, motor.lost) == (1, 2.0, 31, 7)
        assert tuple(motor.reserve) == (0x80000001, 1)

    def test_vendor_fill_is_the_vendors(self) -> None:
        motor = one("unitree_go", fill=Fill.VENDOR).state({LEFT: self.FULL}).states[0]
        assert motor == unitree_go.MotorState_(q=1.5, dq=0.25, tau_est=-0.5)

    @each(("celsius", "sent"), [(math.nan, 0), (-12.0, 0), (126.6, 127), (200.0, 127)])
    def test_temperature_fits_the_sdks_signed_byte(self, celsius: float, sent: int) -> None:
        motor = one("unitree_go").state({LEFT: view(temperature=celsius)}).states[0]
        assert motor.temperature == sent

    def test_unknown_fields_are_zero_and_never_nan(self) -> None:
        motor = one("unitree_go").state({LEFT: view(dq=math.nan, tau_est=math.nan)}).states[0]
        assert (motor.dq, motor.tau_est) == (0.0, 0.0)


class TestHgState:
    def test_the_example_of_the_specification(self) -> None:
        """The interface specification, "Gripper Publishes State": 50 % open with an effort of 5
        %.
        """
        message = one("unitree_hg", fill=Fill.VENDOR).state({LEFT: view(2.7, tau_est=0.5)})
        motor = message.motor_state[0]
        assert motor == unitree_hg.MotorState_(
            q=pytest.approx(math.pi), tau_est=0.5, temperature=(25, 25), vol=12.0
        )
        assert message == unitree_hg.HandState_([motor])

    @given(st.floats(0.0, 5.4))
    def test_hg_position_is_that_of_the_specification(self, q: float) -> None:
        percent = q / 5.4 * 100
        motor = one("unitree_hg").state({LEFT: view(q)}).motor_state[0]
        assert motor.q == pytest.approx((percent / 100.0) * 2.0 * math.pi)

    def test_grip_strength_has_no_sign(self) -> None:
        assert one("unitree_hg").state({LEFT: view(tau_est=-0.9)}).motor_state[0].tau_est == 0.9

    def test_known_values_replace_the_fixed_ones(self) -> None:
        mapping = one("unitree_hg")
        unknown = mapping.state({LEFT: view()}).motor_state[0]
        assert (unknown.temperature, unknown.vol) == ((25, 25), 12.0)
        known = mapping.state({LEFT: view(temperature=41.0, voltage=11.1)}).motor_state[0]
        assert (known.temperature, known.vol) == ((41, 41), 11.1)

    def test_state_holds_faults_and_missed_exchanges(self) -> None:
        message = one("unitree_hg").state({LEFT: view(fault=0x80000020, missed=3, measured=False)})
        assert tuple(message.error) == (0x80000020, 3)
        assert message.motor_state[0].motorstate == 0x80000020
        assert tuple(message.motor_state[0].reserve) == (1, 0, 0, 0)

    def test_state_holds_pressure_attitude_and_supply(self) -> None:
        pressure = np.full((2, 12), 0.5)
        message = one("unitree_hg").state(
            {
                LEFT: view(
                    pressure=pressure,
                    imu=ImuState(rpy=(0.1, 0.2, 0.3), temperature=30.6),
                    supply=SupplyState(power_v=24.0),
                )
            }
        )
        assert [s.pressure for s in message.press_sensor_state] == [(0.5,) * 12] * 2
        assert message.imu_state.rpy == (0.1, 0.2, 0.3)
        assert message.imu_state.temperature == 31
        assert (message.power_v, message.power_a) == (24.0, 0.0)

    def test_state_without_vendor_fill_follows_the_specification(self) -> None:
        message = one("unitree_hg").state({LEFT: view()})
        assert message.press_sensor_state == []
        assert message.imu_state == unitree_hg.IMUState_()
        assert (message.power_v, message.power_a, message.system_v, message.device_v) == (0,) * 4


def test_another_model_is_refused() -> None:
    spec = HandSpec(model="other-hand", side=LEFT, joints=DEX1_1.joints[LEFT], io_rate=100.0)
    with pytest.raises(UsageError, match="other-hand has no dialect unitree_go"):
        dialect_map(dialect("unitree_go"), {LEFT: spec})


def test_a_hand_that_opens_wider_than_its_model_keeps_the_scale_of_the_specification() -> None:
    spec = SPECS[LEFT]
    wider = replace(spec, joints=tuple(replace(j, q_max=5.5) for j in spec.joints))
    mapping = dialect_map(dialect("unitree_hg"), {LEFT: wider})
    for asked, expected in ((math.pi, 2.7), (6.2, 5.4)):
        command = mapping.command(hg_cmd(asked), LEFT)
        assert command is not None
        assert command.q[0] == pytest.approx(expected)
    assert mapping.state({LEFT: view(5.4)}).motor_state[0].q == pytest.approx(math.tau)
