"""Emulate an H1 or G1: obey command samples and produce state samples.

No thread, clock or DDS: the caller of :class:`RobotMechanics` passes the time and the samples.
:mod:`dexkit.emulators.robot.run` connects it to the topics.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.emulators.joint_mechanics import FixedSteps
from dexkit.emulators.robot.c_struct_image import Image
from dexkit.emulators.robot.joints import Joints, Law
from dexkit.emulators.robot.settings import STEP, Remote, Settings
from dexkit.emulators.robot.supply import PERIOD, Supply
from dexkit.errors import WireError
from dexkit.hand import MotorError
from dexkit.messages.unitree_go import WirelessController_
from dexkit.robots import DQ_STOP, Q_STOP, RobotModel

__all__ = ["Counters", "RobotMechanics"]

Array = NDArray[np.float64]

_GRAVITY = 9.81  # m/s²
_IMU_TEMPERATURE = 60
_GYRO_NOISE, _ACCELEROMETER_NOISE = 0.005, 0.05
_BOARD_TEMPERATURE = 35
_CYCLES = 10
# head and level_flag of unitree_go (docs/sources/unitree-dex.md#a8)
_LOW_LEVEL = [0xFE, 0xEF], 0xFF
_REMOTE = struct.Struct("<2xH5f16x")  # head, keys, lx rx ry L2 ly, idle


@dataclass
class Counters:
    """Counters of an emulated robot.

    :ivar commands: obeyed.
    :ivar arm_commands: obeyed, on the arm topic.
    :ivar bad_crc: commands ignored because their CRC is wrong.
    :ivar bad_number: commands ignored because a number is NaN or infinite.
    :ivar bad_machine: commands ignored because their ``mode_machine`` is another robot's.
    :ivar malformed: samples that cannot be decoded.
    :ivar wrong_mode: commands obeyed that hold a mode byte which its motor does not know.
    :ivar stale: commands ignored because they were old, or may have been sent before a pause ended.
    :ivar pauses: times that the program stood still; the robot damps then until a new command.
    :ivar timeouts: times the robot began to damp because commands stopped.
    :ivar states: published.
    """

    commands: int = 0
    arm_commands: int = 0
    bad_crc: int = 0
    bad_number: int = 0
    bad_machine: int = 0
    malformed: int = 0
    wrong_mode: int = 0
    stale: int = 0
    pauses: int = 0
    timeouts: int = 0
    states: int = 0

    def summary(self) -> str:
        """The counters that are not 0, as text."""
        pairs = dataclasses.asdict(self).items()
        return ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in pairs if n)


@dataclass(frozen=True)
class _ActiveCommand:
    """A command in force."""

    law: Law
    mode: NDArray[np.uint8]  # as in the state; 0 for motors that are off
    since: float
    weight: float = 1.0


def _law(numbers: Array, on: NDArray[np.bool_]) -> Law:
    """The law of motors that are commanded q, dq, tau, kp, kd (shape (5, n)); none where off."""
    q, dq, tau, kp, kd = numbers
    kp = (on & (np.abs(q) < Q_STOP)) * np.maximum(kp, 0.0)
    kd = (on & (np.abs(dq) < DQ_STOP)) * np.maximum(kd, 0.0)
    return Law(on * tau + kp * q + kd * dq, kp, kd)


class RobotMechanics:
    """An emulated H1 or G1: see docs/robots.md for what is and what is not emulated.

    :param now: seconds of any monotonic clock, the same as in the other calls.
    :param report: called with a sentence for each kind of problem, once.

    :ivar remote: the wireless remote; assign another to press keys.
    """

    def __init__(
        self,
        model: RobotModel,
        settings: Settings | None = None,
        *,
        now: float = 0.0,
        report: Callable[[str], object] = lambda text: None,
    ) -> None:
        self.model = model
        self.settings = settings = settings or Settings()
        self.counters = Counters()
        self.remote = Remote()
        self.joints = Joints(model, settings)
        self.supply = Supply(model, self.joints, settings)
        self.timeout = settings.command_timeout or model.command_timeout
        self._report = report
        self._reported: set[str] = set()
        self._steps = FixedSteps(STEP, most=0.1)
        self._steps.restart(now)
        self._start = now
        self._lived = 0
        self._used = np.array(model.used)
        self._enable = np.array([model.enable[slot] for slot in model.used], np.uint8)
        self._all_off = np.zeros_like(self._enable)
        self._arm = np.isin(self._used, model.arm_slots)
        self._damping = Law.damping(np.array([model.client_gains[slot][1] for slot in model.used]))
        self._law = self._damping
        self._active_command: _ActiveCommand | None = None
        self._active_arm_command: _ActiveCommand | None = None
        self._lost = False
        self._mode_pr = 0
        self._random = np.random.default_rng(settings.seed)
        self._cmd = Image(model.cmd_type)
        self._state = Image(model.state_type)
        self._orders = self._cmd.floats("motor_cmd", "q", 5)  # q dq tau kp kd
        self._motion = self._state.floats("motor_state", "q", 4)  # q dq ddq tau_est
        self._raw = (
            self._state.floats("motor_state", "q_raw", 3) if model.mode_machine is None else None
        )
        self._prepare_state()

    @property
    def driven(self) -> bool:
        """Whether commands are in force; otherwise it damps."""
        return self._active_command is not None or self._active_arm_command is not None

    def position(self, slot: int) -> float:
        """Where a joint is, rad."""
        return float(self.joints.q[self.model.used.index(slot)])

    # commands

    def command(self, data: bytes, now: float) -> bool:
        """Process a sample of the command topic; return whether it is obeyed."""
        topic = self.model.cmd_topic
        if not self._read(data, topic):
            return False
        numbers = self._read_setpoints(topic)
        if numbers is None or not self._check_header(topic):
            return False
        mode = self._accepted_modes(topic)
        self._active_command = _ActiveCommand(_law(numbers, mode != 0), mode, now)
        self._lost = False
        self.counters.commands += 1
        self._update_law()
        return True

    def arm_command(self, data: bytes, now: float) -> bool:
        """Process a sample of the arm topic; return whether it is obeyed.

        Unitree's arm examples set neither CRC nor mode bytes (unitree_sdk2
        ``g1_arm7_sdk_dds_example.cpp``), so a CRC of 0 counts as none, and all modes as on.
        """
        topic = self.model.arm_topic
        if not self._read(data, topic, crc_may_be_unset=True):
            return False
        numbers = self._read_setpoints(topic)
        weight = float(self._orders[self.model.weight_slot, 0])
        if numbers is None or not self._finite(weight, topic):
            return False
        weight = min(max(weight, 0.0), 1.0)
        mode = self._enable * (self._arm & (weight > 0))
        self._active_arm_command = _ActiveCommand(_law(numbers, self._arm), mode, now, weight)
        self.counters.arm_commands += 1
        self._update_law()
        return True

    def _read(self, data: bytes, topic: str, *, crc_may_be_unset: bool = False) -> bool:
        """Take a sample into the image of a command, if it is one and has the right CRC."""
        try:
            self._cmd.read(data)
        except WireError as error:
            self.counters.malformed += 1
            self._report_once("malformed", f"{topic}: no {self.model.cmd_type}: {error}; ignored")
            return False
        crc, right = int(self._cmd.message["crc"][0]), self._cmd.crc()
        if crc == right or (crc_may_be_unset and crc == 0):
            return True
        self.counters.bad_crc += 1
        self._report_once(
            "crc",
            f"{topic}: the CRC is 0x{crc:08X} and should be 0x{right:08X}; such commands are "
            "ignored" + (" (it was never set)" if crc == 0 else ""),
        )
        return False

    def _check_header(self, topic: str) -> bool:
        """Check head, level_flag, mode_machine and mode_pr; return whether to obey the command."""
        message, machine = self._cmd.message, self.model.mode_machine
        if machine is None:
            if (message["head"][0].tolist(), message["level_flag"][0]) != _LOW_LEVEL:
                self._report_once(
                    "head", f"{topic}: head and level_flag are not FE EF FF; obeyed all the same"
                )
            return True
        sent = int(message["mode_machine"][0])
        if sent != machine and not self.settings.lenient:
            self.counters.bad_machine += 1
            self._report_once(
                "machine",
                f"{topic}: mode_machine is {sent} and should be {machine}, as in "
                f"{self.model.state_topic}; such commands are ignored",
            )
            return False
        self._mode_pr = int(message["mode_pr"][0])
        if self._mode_pr:
            self._report_once(
                "mode_pr",
                f"{topic}: mode_pr {self._mode_pr}: motors A and B are taken for pitch and roll",
            )
        return True

    def _read_setpoints(self, topic: str) -> Array | None:
        """q, dq, tau, kp, kd of the used motors, shape (5, n); None if one is no number."""
        # values that are not finite are found and reported below
        with np.errstate(invalid="ignore"):
            numbers: Array = self._orders[self._used].astype(np.float64).T
            # in double precision a sum of some singles cannot overflow
            total = float(numbers.sum())
        return numbers if self._finite(total, topic) else None

    def _finite(self, number: float, topic: str) -> bool:
        if math.isfinite(number):
            return True
        self.counters.bad_number += 1
        self._report_once("number", f"{topic}: NaN or infinity; such commands are ignored")
        return False

    def _accepted_modes(self, topic: str) -> NDArray[np.uint8]:
        """The mode bytes of the used motors, 0 in the place of those that a motor does not know."""
        mode: NDArray[np.uint8] = self._cmd.message["motor_cmd"][0]["mode"][self._used]
        known: NDArray[np.bool_] = mode == self._enable
        if self.settings.lenient or (known | (mode == 0)).all():
            return mode
        self.counters.wrong_mode += 1
        first = int(np.argmax(~known & (mode != 0)))
        slot = self.model.used[first]
        self._report_once(
            "mode",
            f"{topic}: mode 0x{int(mode[first]):02X} for motor {slot} "
            f"({self.model.joint(slot).name}), which takes 0x{self.model.enable[slot]:02X}; "
            "motors with a wrong mode stay off",
        )
        mode = np.where(known, mode, self._all_off)
        return mode

    def _update_law(self) -> None:
        """Compute the motors' control law from the active commands."""
        law = self._active_command.law if self._active_command is not None else self._damping
        if self._active_arm_command is not None:
            law = law.blend(
                self._active_arm_command.law,
                np.where(self._arm, self._active_arm_command.weight, 0.0),
            )
        self._law = law

    def _report_once(self, kind: str, text: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._report(text)

    # time

    def advance(self, now: float) -> None:
        """Advance to ``now``; after a pause of more than 0.1 s, by its last 0.1 s only."""
        for order in (self._active_command, self._active_arm_command):
            if order is not None and now - order.since > self.timeout:
                self.counters.timeouts += 1
                topic = self._expire(order)
                text = f"{topic}: no command for {self.timeout:g} s; its motors damp"
                self._report_once(f"timeout {topic}", text)
        for _ in range(self._steps.due(now)):
            self.joints.step(self._law)
            self._lived += 1
            if self._lived % round(PERIOD / STEP) == 0:
                self.supply.step()
                self._show_supply()

    def paused(self) -> None:
        """Drop all commands: the program was paused, so they are stale."""
        for order in (self._active_command, self._active_arm_command):
            if order is not None:
                self._expire(order)
        self.counters.pauses += 1
        self._report_once(
            "paused",
            "this program stood still (stopped, suspended, or a machine that is too busy); the "
            "motors damp until a command comes that was sent later",
        )

    def _expire(self, order: _ActiveCommand) -> str:
        """Drop a command; return the topic that it came on."""
        if order is self._active_command:
            self._active_command = None
            self._lost = True
            topic = self.model.cmd_topic
        else:
            self._active_arm_command = None
            topic = self.model.arm_topic
        self._update_law()
        return topic

    # states

    def _prepare_state(self) -> None:
        """Fill in the constant members of the state, and note where the others are."""
        message = self._state.message
        imu = message["imu_state"][0]
        imu["quaternion"] = 1.0, 0.0, 0.0, 0.0
        imu["accelerometer"] = 0.0, 0.0, _GRAVITY
        imu["temperature"] = _IMU_TEMPERATURE
        if self.model.mode_machine is None:
            message["head"], message["level_flag"] = _LOW_LEVEL
            message["bms_state"]["cycle"] = _CYCLES
            message["bms_state"]["version_high"] = 1
            message["bms_state"]["bq_ntc"] = _BOARD_TEMPERATURE
            message["bms_state"]["mcu_ntc"] = _BOARD_TEMPERATURE
            message["temperature_ntc1"] = message["temperature_ntc2"] = _BOARD_TEMPERATURE
        else:
            message["mode_machine"] = self.model.mode_machine
        self._show_supply()

    def _show_supply(self) -> None:
        message, supply = self._state.message, self.supply
        motors = message["motor_state"][0]
        warm = np.rint(supply.temperature).astype(np.int16)
        if self.model.mode_machine is None:
            motors["temperature"][self._used] = warm
            bms = message["bms_state"]
            bms["soc"] = round(supply.charge)
            bms["current"] = -round(1000 * supply.current)
            bms["cell_vol"] = (round(1000 * supply.cell_voltage),) * supply.cells
            message["power_v"] = supply.voltage
            message["power_a"] = supply.current
        else:
            motors["temperature"][self._used] = warm[:, None]  # case and winding alike
            motors["vol"][self._used] = supply.voltage

    def state(self, now: float) -> bytes:
        """The present state, as a sample with its CRC."""
        message, joints, used = self._state.message, self.joints, self._used
        motors = message["motor_state"][0]
        mode = self._active_command.mode if self._active_command is not None else self._all_off
        if self._active_arm_command is not None:
            mode = np.where(self._active_arm_command.mode, self._active_arm_command.mode, mode)
        motors["mode"][used] = mode
        motion = np.array((joints.q, joints.dq, joints.ddq, joints.tau)).T
        self._motion[used] = motion
        if self._raw is not None:
            self._raw[used] = motion[:, :3]
        else:
            message["mode_pr"] = self._mode_pr
            error = MotorError.MOTOR_SAW_HOST_TIMEOUT if self._lost else MotorError.NONE
            motors["motorstate"][used] = int(error)
        if self.settings.noise:
            self._add_imu_noise(message["imu_state"][0])
        message["tick"] = int((now - self._start) * 1000.0) & 0xFFFFFFFF
        message["wireless_remote"] = np.frombuffer(self._remote_bytes(), np.uint8)
        self.counters.states += 1
        return self._state.seal()

    def remote_message(self) -> WirelessController_:
        """The sample of the wireless remote's own topic."""
        sticks = {name: self.remote.sticks.get(name, 0.0) for name in Remote.STICKS}
        return WirelessController_(**sticks, keys=self.remote.bits)

    def _add_imu_noise(self, imu: Any) -> None:
        noise = self.settings.noise * self._random.standard_normal((2, 3))
        imu["gyroscope"] = _GYRO_NOISE * noise[0]
        imu["accelerometer"] = _ACCELEROMETER_NOISE * noise[1] + (0.0, 0.0, _GRAVITY)

    def _remote_bytes(self) -> bytes:
        sticks = self.remote.sticks
        lx, rx, ry, ly = (sticks.get(name, 0.0) for name in Remote.STICKS)
        l2 = 1.0 if "L2" in self.remote.keys else 0.0
        return _REMOTE.pack(self.remote.bits, lx, rx, ry, l2, ly)
