"""Emulated robots on a manual clock."""

from __future__ import annotations

import dataclasses
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.emulators.robot import Remote, Settings
from dexkit.errors import UsageError
from dexkit.hand import MotorError
from dexkit.messages import encode, message_type
from dexkit.robots import DQ_STOP, G1, H1, Q_STOP, ROBOTS, RobotModel
from dexkit.wire.low_level import (
    LOW_LEVEL_TYPES,
    encode_with_crc,
    payload_of_struct,
    struct_of_payload,
    verify_payload,
)
from tests.each import each
from tests.robot_helpers import Bench, low_cmd

both = pytest.mark.parametrize("model", list(ROBOTS.values()), ids=list(ROBOTS))
FIELDS = ("q", "dq", "tau", "kp", "kd")


# ------------------------------------------------------------------------------------ data


def test_motor_slots_are_those_of_the_sdk() -> None:
    """A few of the indices that Unitree's examples name (docs/sources/unitree-dex.md#a8)."""
    assert (H1.slots, len(H1.used), H1.joints[9]) == (20, 19, None)
    assert (G1.slots, G1.used) == (35, tuple(range(29)))
    for model, slots in (
        (H1, {"right_hip_roll": 0, "left_knee": 5, "waist_yaw": 6, "right_hip_yaw": 8}),
        (H1, {"left_ankle": 10, "right_shoulder_pitch": 12, "left_elbow": 19}),
        (G1, {"left_hip_pitch": 0, "right_ankle_roll": 11, "waist_pitch": 14}),
        (G1, {"left_elbow": 18, "left_wrist_yaw": 21, "right_wrist_yaw": 28}),
    ):
        assert {name: model.slot(name) for name in slots} == slots
    assert [H1.enable[i] for i in (0, 6, 10, 12, 19)] == [10, 10, 1, 1, 1]


@both
def test_joint_limits_are_consistent(model: RobotModel) -> None:
    for slot in model.used:
        joint = model.joint(slot)
        assert joint.q_min < model.rest_q[slot] < joint.q_max
        if joint.name.startswith("left_"):
            other = model.joint(model.slot(joint.name.replace("left", "right")))
            mirrored = joint.name.endswith(("roll", "yaw"))
            limits = (-joint.q_max, -joint.q_min) if mirrored else (joint.q_min, joint.q_max)
            assert (other.q_min, other.q_max) == limits


# --------------------------------------------------------------------------------- commands


@both
def test_joints_reach_their_goal_positions(model: RobotModel) -> None:
    bench = Bench(model)
    goal = {}
    for slot in model.used:
        joint = model.joint(slot)
        goal[slot] = 0.5 * (model.rest_q[slot] + (joint.q_max if slot % 2 else joint.q_min))
    state = bench.run(3.0, low_cmd(model, goal))
    for slot in model.used:
        motor = state.motor_state[slot]
        assert motor.q == pytest.approx(goal[slot], abs=0.02), model.joint(slot)
        assert motor.dq == pytest.approx(0.0, abs=1e-3)
        assert motor.mode == model.enable[slot]
    assert bench.reports == []


@both
def test_state_before_any_command(model: RobotModel) -> None:
    bench = Bench(model)
    state = bench.run(0.5)
    assert [m.q for m in state.motor_state] == pytest.approx(model.rest_q)
    assert {m.mode for m in state.motor_state} == {0}
    assert state.imu_state.quaternion == (1, 0, 0, 0)
    assert state.imu_state.accelerometer == pytest.approx((0, 0, 9.81))
    assert state.tick == 500
    assert bench.run(0.002, hz=500).tick == 502
    if model is G1:
        assert (state.mode_machine, state.mode_pr) == (5, 0)
        assert state.motor_state[0].vol == pytest.approx(53, abs=3)
    else:
        assert (state.head, state.level_flag) == ((0xFE, 0xEF), 0xFF)
        assert state.power_v == pytest.approx(61, abs=2)


@both
def test_joint_torque_follows_the_motors_law(model: RobotModel) -> None:
    """tau = tau_ff + kp (q_des - q) + kd (dq_des - dq), reported at the end of the step."""
    bench = Bench(model)
    slot = model.slot("left_elbow")
    order = {"q": 0.8, "dq": 0.5, "tau": 1.0, "kp": 4.0, "kd": 0.5}
    state = bench.run(0.1, low_cmd(model, change={slot: order})).motor_state[slot]
    law = 1.0 + 4.0 * (0.8 - state.q) + 0.5 * (0.5 - state.dq)
    assert state.tau_est == pytest.approx(law, abs=1e-4)
    assert state.dq > 0.1


@both
def test_limits_of_torque_speed_and_travel(model: RobotModel) -> None:
    bench = Bench(model)
    slot = model.slot("right_elbow")
    joint = model.joint(slot)
    push = low_cmd(model, change={slot: {"kp": 0.0, "kd": 0.0, "tau": 1e6}})
    assert bench.send(push)
    fastest = 0.0
    while True:
        state = bench.run(0.002, push, hz=500).motor_state[slot]
        assert abs(state.tau_est) <= joint.tau_max * (1 + 1e-6)
        fastest = max(fastest, state.dq)
        if state.q >= joint.q_max - 1e-6:
            break
    assert fastest == pytest.approx(joint.dq_max)
    state = bench.run(0.1, push).motor_state[slot]
    assert (state.q, state.dq) == (pytest.approx(joint.q_max), 0)
    assert state.tau_est == pytest.approx(joint.tau_max)  # still pushing


@both
def test_motor_that_is_off_is_limp(model: RobotModel) -> None:
    slot, other = model.slot("left_knee"), model.slot("right_knee")
    mode = [0 if i == slot else m for i, m in enumerate(model.enable)]
    bench = Bench(model)
    state = bench.run(1.0, low_cmd(model, {slot: 0.8, other: 0.8}, mode=mode))
    assert (state.motor_state[slot].q, state.motor_state[slot].mode) == (
        pytest.approx(model.rest_q[slot]),
        0,
    )
    assert state.motor_state[slot].tau_est == 0
    assert state.motor_state[other].q == pytest.approx(0.8, abs=0.02)


def test_mode_of_another_motor_type_does_not_drive() -> None:
    """Strong motors of an H1 take 10, weak ones 1 (docs/sources/unitree-dex.md#a8)."""
    hip, elbow = H1.slot("left_hip_pitch"), H1.slot("left_elbow")
    order = low_cmd(H1, {hip: 0.4, elbow: 0.8}, mode=[1] * 20)
    bench = Bench(H1)
    state = bench.run(1.0, order)
    assert state.motor_state[hip].q == pytest.approx(H1.rest_q[hip])
    assert state.motor_state[elbow].q == pytest.approx(0.8, abs=0.01)
    assert bench.robot.counters.wrong_mode == bench.robot.counters.commands == 250
    assert len(bench.reports) == 1
    assert "mode 0x01 for motor 0 (right_hip_roll), which takes 0x0A" in bench.reports[0]
    lenient = Bench(H1, Settings(lenient=True))
    state = lenient.run(1.0, order)
    assert state.motor_state[hip].q == pytest.approx(0.4, abs=0.02)
    assert state.motor_state[hip].mode == 1  # as commanded
    assert not lenient.reports


@both
def test_position_and_velocity_stop_constants_drop_their_terms(model: RobotModel) -> None:
    """Position and velocity terms can be left out with kp and kd set
    (docs/sources/unitree-dex.md#a8).
    """
    slot = model.slot("left_elbow")
    bench = Bench(model)
    order = {"q": Q_STOP, "dq": DQ_STOP, "kp": 100.0, "kd": 5.0}
    state = bench.run(0.5, low_cmd(model, change={slot: order})).motor_state[slot]
    assert (state.q, state.tau_est) == (pytest.approx(model.rest_q[slot]), 0)
    # a velocity of the joint's alone
    spin = {"q": Q_STOP, "dq": 0.5, "kp": 100.0, "kd": 5.0}
    state = bench.run(0.3, low_cmd(model, change={slot: spin})).motor_state[slot]
    assert state.dq == pytest.approx(0.5, abs=0.05)


@both
@given(st.data(), st.sampled_from(FIELDS), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_non_finite_value_rejects_the_command(
    model: RobotModel, data: Any, field: str, value: float
) -> None:
    bench = Bench(model)
    slot = data.draw(st.sampled_from(model.used))
    assert not bench.send(low_cmd(model, change={slot: {field: value}}))
    assert bench.robot.counters.bad_number == 1
    assert not bench.robot.driven
    assert "NaN or infinity" in bench.reports[0]


@both
@given(st.data())
def test_command_with_a_flipped_bit_is_rejected(model: RobotModel, data: Any) -> None:
    bench = Bench(model)
    good = encode_with_crc(low_cmd(model))
    image = bytearray(struct_of_payload(model.cmd_type, good))
    bit = data.draw(st.integers(0, 8 * len(image) - 1))
    image[bit // 8] ^= 1 << bit % 8
    bad = payload_of_struct(model.cmd_type, bytes(image))
    obeyed = bench.robot.command(bad, 0.0)
    assert obeyed == (bad == good)  # the gaps of the struct are not sent
    if not obeyed:
        assert bench.robot.counters.bad_crc == 1
        assert "the CRC is 0x" in bench.reports[0]


@both
@given(st.binary(max_size=1100))
def test_garbage_is_rejected(model: RobotModel, data: bytes) -> None:
    bench = Bench(model)
    assert not bench.robot.command(data, 0.0)
    assert bench.robot.counters.malformed == 1


@both
def test_command_with_an_unset_crc_is_refused(model: RobotModel) -> None:
    bench = Bench(model)
    assert not bench.robot.command(encode(low_cmd(model)), 0.0)
    assert "(it was never set)" in bench.reports[0]
    assert bench.robot.command(encode_with_crc(low_cmd(model)), 0.0)


def test_command_for_another_machine_is_refused() -> None:
    order = low_cmd(G1, mode_machine=0)
    bench = Bench(G1)
    assert not bench.send(order)
    assert bench.robot.counters.bad_machine == 1
    assert "mode_machine is 0 and should be 5" in bench.reports[0]
    assert Bench(G1, Settings(lenient=True)).send(order)
    other = Bench(dataclasses.replace(G1, mode_machine=13))
    assert other.state().mode_machine == 13
    assert other.send(low_cmd(G1, mode_machine=13))


@both
def test_missing_commands_damp_the_joints(model: RobotModel) -> None:
    slot = model.slot("waist_yaw")
    bench = Bench(model)
    spin = {slot: {"kp": 0.0, "kd": 50.0, "dq": 1.0, "q": 0.0}}
    state = bench.run(0.3, low_cmd(model, change=spin))
    assert state.motor_state[slot].dq == pytest.approx(1.0, abs=0.1)
    assert bench.run(0.9 * model.command_timeout).motor_state[slot].dq > 0.9  # the last one holds
    state = bench.run(1.0)
    assert state.motor_state[slot].dq == pytest.approx(0.0, abs=1e-3)
    assert {m.mode for m in state.motor_state} == {0}
    assert bench.robot.counters.timeouts == 1
    assert "no command for 1 s" in bench.reports[0]
    rested = state.motor_state[slot].q
    assert bench.run(1.0).motor_state[slot].q == pytest.approx(rested, abs=1e-3)
    if model is G1:
        assert state.motor_state[slot].motorstate == MotorError.MOTOR_SAW_HOST_TIMEOUT
    state = bench.run(1.0, low_cmd(model, {slot: 0.5}))
    assert state.motor_state[slot].q == pytest.approx(0.5, abs=0.02)
    if model is G1:
        assert state.motor_state[slot].motorstate == 0


# ------------------------------------------------------------------------------------- arms


@both
def test_arm_topic_moves_the_arms_by_its_weight(model: RobotModel) -> None:
    """As Unitree's examples send it: no CRC, no mode bytes, a weight in a slot not used."""
    arm, leg = model.slot("left_elbow"), model.slot("left_knee")
    bench = Bench(model)

    def send(weight: float) -> None:
        order = low_cmd(
            model,
            {arm: 1.0, leg: 1.0},
            mode=[0] * model.slots,
            change={model.weight_slot: {"mode": 0, "q": weight}},
        )
        assert bench.robot.arm_command(encode(order), bench.now)

    def run(weight: float) -> Any:
        for _ in range(200):
            send(weight)
            bench.run(0.004)
        return bench.state()

    state = run(0.0)
    assert state.motor_state[arm].q == pytest.approx(model.rest_q[arm])
    assert state.motor_state[arm].mode == 0
    state = run(1.0)
    assert state.motor_state[arm].q == pytest.approx(1.0, abs=0.01)
    assert state.motor_state[leg].q == pytest.approx(model.rest_q[leg])
    assert state.motor_state[arm].mode == model.enable[arm]
    assert state.motor_state[leg].mode == 0
    # half of one command and half of another, with equal gains: the middle
    assert bench.send(low_cmd(model, {arm: 0.0}))
    state = run(0.5)
    assert state.motor_state[arm].q == pytest.approx(0.5, abs=0.02)
    assert bench.robot.counters.arm_commands == 600
    assert bench.run(1.5).motor_state[arm].mode == 0  # both have been silent
    assert bench.robot.counters.timeouts == 2


@both
def test_arm_topic_rejects_invalid_commands(model: RobotModel) -> None:
    bench = Bench(model)
    order = encode_with_crc(low_cmd(model))
    wrong = order[:-4] + struct.pack("<I", 12345)
    assert not bench.robot.arm_command(wrong, 0.0)
    assert not bench.robot.arm_command(
        encode(low_cmd(model, change={model.weight_slot: {"q": math.nan}})), 0.0
    )
    assert bench.robot.counters.summary() == "bad crc 1, bad number 1"
    assert bench.robot.arm_command(order, 0.0)


# ----------------------------------------------------------------------------------- states


@both
@settings(max_examples=20, deadline=None)
@given(st.data())
def test_any_command_keeps_the_state_finite(model: RobotModel, data: Any) -> None:
    """States stay finite, within the limits, with a right CRC, whatever finite is commanded."""
    bench = Bench(model)
    number = st.floats(width=32, allow_nan=False, allow_infinity=False)
    for _ in range(4):
        change = {
            slot: {field: data.draw(number) for field in FIELDS}
            for slot in data.draw(st.sets(st.sampled_from(model.used), max_size=4))
        }
        assert bench.send(low_cmd(model, change=change))
        bench.run(0.05)
        sample = bench.robot.state(bench.now)
        assert verify_payload(model.state_type, sample)
        state = message_type(model.state_type).decode(sample)
        for slot in model.used:
            motor, joint = state.motor_state[slot], model.joint(slot)
            assert joint.q_min - 1e-6 <= motor.q <= joint.q_max + 1e-6
            assert abs(motor.dq) <= joint.dq_max * (1 + 1e-6)
            assert abs(motor.tau_est) <= joint.tau_max * (1 + 1e-6)
            assert math.isfinite(motor.ddq)


@both
def test_the_same_commands_give_the_same_states(model: RobotModel) -> None:
    def run() -> list[bytes]:
        bench = Bench(model, Settings(noise=1.0, seed=3))
        out = []
        for _ in range(20):
            bench.run(0.02, low_cmd(model, {model.used[3]: 0.7}))
            out.append(bench.robot.state(bench.now))
        return out

    assert run() == run()


@both
def test_work_heats_motors_and_drains_the_battery(model: RobotModel) -> None:
    slot = model.slot("left_knee")
    bench = Bench(model, Settings(warm_up=5.0, capacity=1.0))
    before = bench.state()
    push = low_cmd(model, change={slot: {"tau": 1e3, "kp": 0.0}})
    after = bench.run(6.0, push, hz=50)
    hot, cold = (np.ravel(s.motor_state[slot].temperature)[0] for s in (after, before))
    assert cold + 40 < hot <= 127
    assert np.ravel(after.motor_state[model.slot("right_knee")].temperature)[0] == cold
    if model is H1:
        assert after.bms_state.soc < before.bms_state.soc
        assert after.power_v < before.power_v
        assert after.power_a > before.power_a
        assert after.bms_state.cell_vol[0] == pytest.approx(1000 * after.power_v / 15, abs=1)
        assert after.bms_state.current == pytest.approx(-1000 * after.power_a, abs=1)


@both
def test_long_pause_is_not_simulated(model: RobotModel) -> None:
    bench = Bench(model)
    slot = model.slot("waist_yaw")
    bench.run(0.2, low_cmd(model, change={slot: {"kp": 0.0, "kd": 50.0, "dq": 1.0}}))
    before = bench.robot.position(slot)
    bench.robot.advance(bench.now + 0.9)
    assert bench.robot.position(slot) - before == pytest.approx(0.1, abs=0.02)


@both
def test_state_holds_keys_and_sticks_of_the_remote(model: RobotModel) -> None:
    bench = Bench(model)
    bench.robot.remote = Remote.parse("A, R1,lx=0.5,ry=-1")
    sent = bytes(bench.state().wireless_remote)
    keys, lx, rx, ry, l2, ly = struct.unpack_from("<2xH5f", sent)
    assert keys == 1 << 8 | 1
    assert (lx, rx, ry, l2, ly) == (0.5, 0, -1, 0, 0)
    message = bench.robot.remote_message()
    assert (message.keys, message.lx, message.ry, message.ly) == (keys, 0.5, -1, 0)
    bench.robot.remote = Remote.parse("")
    assert not any(bytes(bench.state().wireless_remote))


@each("text", ["C", "lx=2", "lx=left", "lz=0"])
def test_unknown_remote_key_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        Remote.parse(text)


@given(st.sampled_from(LOW_LEVEL_TYPES), st.binary(min_size=2100, max_size=2100))
def test_sample_converts_to_c_struct_and_back(name: str, noise: bytes) -> None:
    """To a sample and back loses nothing but what lies in the gaps."""
    size = len(struct_of_payload(name, encode(message_type(name).cls())))
    sample = payload_of_struct(name, noise[:size])
    image = struct_of_payload(name, sample)
    assert payload_of_struct(name, image) == sample
    assert all(a in (0, b) for a, b in zip(image, noise, strict=False))
    with pytest.raises(UsageError, match=f"has {size} bytes"):
        payload_of_struct(name, image[:-1])
