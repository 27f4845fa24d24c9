"""Translate command messages to hand commands, and hand states to messages, by dialect.

Pure functions of values; which topics and types a dialect uses is in :mod:`dexkit.models`.

=================  ================================================================================
unitree_go         q, dq, tau, kp, kd as they are; the mode byte is ignored, so kp = kd = 0
                   is limp and not a brake (docs/sources/unitree-dex.md#b2).
unitree_actuator   the same, two motors in one message: 0 right, 1 left
                   (docs/sources/unitree-dex.md#a1).
unitree_hg         the interface specification: q runs to 2 pi; a command at or below 0.1
                   closes, at or above 6.0 opens; dq, tau, kp and kd of a command are unused
                   (clients send 0), the gains are those of xr_teleoperate; tau_est of the
                   state is grip strength, not signed.
RIS_Mode           hands of several joints: all values as they are, in the order of the IDL; the
                   mode byte has the id, the status (0 lock, 1 FOC) and the time-out bit (the
                   Dex3-1 manual).
status             the same; mode 1 is position control, 0 brakes
                   (docs/sources/unitree-dex.md#b5); tau and tau_est in the dialect's units.
=================  ================================================================================

**What a state holds.** ``Fill.VENDOR`` fills what the reference fills and leaves the rest 0:
q, dq, tau_est for unitree_go (the vendor's service, docs/sources/unitree-dex.md#b2); q, tau_est and
the fixed temperature 25, 25 and vol 12.0 for unitree_hg (the interface specification).
``Fill.KNOWN``, the default, adds what the backend really measured, and what is wrong:

======================  ===========================  ==============================================
what                    unitree_go, _actuator        unitree_hg
======================  ===========================  ==============================================
braking or driven       mode 0 or 1                  mode stays 0 (it means "position")
ddq                     ddq                          ddq
dq                      dq                           dq
temperature             temperature, 0..127          temperature, twice; 25 where unknown
voltage                 no field                     vol; 12.0 where unknown; supply in power_v,
                                                     power_a, system_v, device_v
MotorError bits         reserve[0]                   motorstate; all joints together in error[0]
exchanges missed since  lost                         error[1]
the last good one
q is predicted          reserve[1] = 1               reserve[0] = 1
======================  ===========================  ==============================================

The state of a hand of several joints is described on the page of the hand;
:mod:`dexkit.service.finger_state` encodes them.

``temperature`` of unitree_go stops at 127 because Unitree's Python SDK cannot pack more
(docs/sources/unitree-dex.md#a7). What a backend does not know (NaN) is sent as 0.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from dexkit.errors import UsageError
from dexkit.hand import (
    Floats,
    HandCommand,
    HandSpec,
    HandState,
    ImuState,
    JointMode,
    JointSpec,
    ModeRule,
    Side,
    SupplyState,
)
from dexkit.messages import message_type, unitree_go, unitree_hg
from dexkit.models import Dialect, ModeByte, model
from dexkit.service.finger_state import FingerStateEncoder

__all__ = [
    "DialectMap",
    "Fill",
    "FingerMap",
    "InterfaceSpecificationMap",
    "MotorCmdsMap",
    "Remark",
    "RisModeMap",
    "StateView",
    "StatusModeMap",
    "dialect_map",
]

# what xr_teleoperate sends to a Dex1 (docs/sources/unitree-dex.md#b1)
_KP, _KD = 5.0, 0.05
_HG_TEMPERATURE, _HG_VOL = 25, 12.0  # the interface specification, "MotorState_"
_ROUNDING = 1e-6  # rad; more than float32 loses of a limit
_U32 = 0xFFFFFFFF
_FLOAT_MAX = float(np.finfo(np.float32).max)


class Fill(str, Enum):
    """Which fields of a state are filled."""

    KNOWN = "known"
    VENDOR = "vendor"


@dataclass(frozen=True)
class StateView:
    """The state of one hand as it is to be published.

    :param fault: :class:`~dexkit.hand.MotorError` bits per joint, the link's included.
    :param missed: exchanges missed since the last good one.
    :param tripped: per joint, whether the time-out that the client asked for has stopped it;
        empty where none has.
    """

    state: HandState
    fault: tuple[int, ...]
    missed: int = 0
    tripped: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Remark:
    """A remark on an unusual command that is obeyed that is obeyed nevertheless.

    :param counter: which of :class:`~dexkit.service.counters.HandCounters` counts it.
    :param text: what is odd, and what to send instead.
    """

    counter: str
    text: str


class DialectMap(ABC):
    """Messages of one dialect from and to the values of the hands that share a topic pair.

    :param specs: the hands by side; exactly one where each side has its own topics.
    :raises UsageError: the dialect is not one of the hand model.
    """

    def __init__(
        self, dialect: Dialect, specs: Mapping[Side, HandSpec], fill: Fill = Fill.KNOWN
    ) -> None:
        for spec in specs.values():
            if spec.model != dialect.model:
                raise UsageError(f"a {spec.model} has no dialect {dialect.name}")
        self.dialect = dialect
        self.fill = fill
        self._specs = dict(specs)
        self._state_type = message_type(dialect.state_type)
        self._command_type = message_type(dialect.cmd_type)
        self._first = {side: dialect.index[side] for side in specs}
        self._length = max(
            max(self._first[s] + spec.n_joints for s, spec in specs.items()), dialect.length
        )

    def motors(self, message: Any) -> int:
        """The number of motors in a command message, which should be :attr:`length`."""
        return len(self._motor_commands(message))

    @property
    def length(self) -> int:
        """Motors in a well-formed message."""
        return self._length

    def command(self, message: Any, side: Side) -> HandCommand | None:
        """The command for a side, not yet through the gate; None when it holds none."""
        first, spec = self._first[side], self._specs[side]
        motors = self._motor_commands(message)[first : first + spec.n_joints]
        if len(motors) < spec.n_joints:
            return None
        return HandCommand(
            q=np.array([self._q_in(m.q, j) for m, j in zip(motors, spec.joints, strict=True)]),
            dq=self._feed_forward([m.dq for m in motors]),
            tau=self._torques([m.tau for m in motors]),
            kp=self._gains([m.kp for m in motors], _KP),
            kd=self._gains([m.kd for m in motors], _KD),
            mode=np.full(len(motors), JointMode.FOC, dtype=np.uint8),
        )

    def remarks(self, message: Any, side: Side) -> Sequence[Remark]:
        """Remarks on a command that :meth:`command` accepts."""
        return ()

    @abstractmethod
    def state(self, views: Mapping[Side, StateView]) -> Any:
        """The state message; a hand of the topic pair that is not in ``views`` is all 0."""

    def encode(self, views: Mapping[Side, StateView]) -> bytes:
        """The state message as a DDS sample.

        :raises WireError: a value that the message cannot hold.
        """
        return self._state_type.encode(self.state(views))

    def encode_touch(self, views: Mapping[Side, StateView]) -> bytes | None:
        """The touch message as a DDS sample; None where the dialect or the hand has none."""
        return None

    def _motor_commands(self, message: Any) -> list[Any]:
        """The motors of a command message."""
        return self._command_type.motors(message)

    def _q_in(self, q: float, joint: JointSpec) -> float:
        # 5.4 as float32 is 1e-7 above 5.4: not a command beyond the limit
        if 0 < q - joint.q_max < _ROUNDING:
            return joint.q_max
        return joint.q_min if 0 < joint.q_min - q < _ROUNDING else q

    def _feed_forward(self, values: list[float]) -> Floats:
        return np.array(values)

    def _torques(self, values: list[float]) -> Floats:
        return self._feed_forward(values)

    def _gains(self, values: list[float], default: float) -> Floats:
        return np.array(values)


class MotorCmdsMap(DialectMap):
    """Grippers in ``MotorCmds_`` and ``MotorStates_``: all values as they are."""

    def state(self, views: Mapping[Side, StateView]) -> unitree_go.MotorStates_:
        """The state message."""
        motors = [unitree_go.MotorState_() for _ in range(self._length)]
        for side, view in views.items():
            s = view.state
            for joint in range(self._specs[side].n_joints):
                m = motors[self._first[side] + joint]
                m.q = _known(s.q[joint])
                m.dq = _known(s.dq[joint])
                m.tau_est = _known(s.tau_est[joint])
                if self.fill is Fill.VENDOR:
                    continue
                m.mode = int(s.mode[joint])
                m.ddq = _known(s.ddq[joint])
                m.temperature = _celsius(s.temperature[joint], low=0, high=127)
                m.lost = min(view.missed, _U32)
                m.reserve = (view.fault[joint] & _U32, 0 if s.measured else 1)
        return unitree_go.MotorStates_(motors)


class ServoMap(MotorCmdsMap):
    """Position servos in ``MotorCmds_`` and ``MotorStates_``: gains and torque of a command are not
    used, and dq, where it is, limits the speed of the way to q.
    """

    def command(self, message: Any, side: Side) -> HandCommand | None:
        """The command for a side: dq is the most that each joint may move with, 0 at least."""
        command = super().command(message, side)
        if command is None:
            return None
        full = np.array([joint.dq_max for joint in self._specs[side].joints])
        if self.dialect.speed_units:
            # a clipped infinity would be a speed
            asked = np.where(np.isfinite(command.dq), np.clip(command.dq, 0.0, 1.0), math.nan)
            return replace(command, dq=asked * full)
        return replace(command, dq=full + command.dq)

    def state(self, views: Mapping[Side, StateView]) -> unitree_go.MotorStates_:
        """The state message; dq in parts of the full speed."""
        return super().state({side: self._scaled(view) for side, view in views.items()})

    def _scaled(self, view: StateView) -> StateView:
        units = self.dialect.speed_units
        if not units:
            return view
        state = view.state
        return replace(view, state=replace(state, dq=state.dq / units, ddq=state.ddq / units))

    def _feed_forward(self, values: list[float]) -> Floats:
        return np.array(values) if self.dialect.speed_units else _zero_where_finite(values)

    def _torques(self, values: list[float]) -> Floats:
        return _zero_where_finite(values)

    def _gains(self, values: list[float], default: float) -> Floats:
        return _zero_where_finite(values) + default


class InterfaceSpecificationMap(DialectMap):
    """Grippers as the DDS interface specification defines them: 2 pi rad of opening, no gains."""

    def state(self, views: Mapping[Side, StateView]) -> unitree_hg.HandState_:
        """The state message."""
        (side,) = self._specs
        view = views[side]
        s, spec = view.state, self._specs[side]
        known = self.fill is Fill.KNOWN
        motors = []
        scale = self._scale()
        for joint in range(len(spec.joints)):
            m = unitree_hg.MotorState_(
                q=_known(s.q[joint] * scale),
                tau_est=abs(_known(s.tau_est[joint])),
                temperature=(_HG_TEMPERATURE, _HG_TEMPERATURE),
                vol=_HG_VOL,
            )
            if known:
                m.dq = _known(s.dq[joint] * scale)
                m.ddq = _known(s.ddq[joint] * scale)
                if math.isfinite(s.temperature[joint]):
                    celsius = _celsius(s.temperature[joint], low=-32768, high=32767)
                    m.temperature = (celsius, celsius)
                if math.isfinite(s.voltage[joint]):
                    m.vol = float(s.voltage[joint])
                m.motorstate = view.fault[joint] & _U32
                m.reserve = (0 if s.measured else 1, 0, 0, 0)
            motors.append(m)
        message = unitree_hg.HandState_(motors)
        if known:
            self._fill(message, s, view)
        return message

    def _fill(self, message: unitree_hg.HandState_, s: HandState, view: StateView) -> None:
        bits = 0
        for fault in view.fault:
            bits |= fault
        message.error = (bits & _U32, min(view.missed, _U32))
        if s.imu is not None:
            message.imu_state = _imu(s.imu)
        if s.supply is not None:
            _supply(message, s.supply)
        if s.pressure is not None:
            message.press_sensor_state = [
                unitree_hg.PressSensorState_(pressure=tuple(_known(p) for p in sensor))
                for sensor in s.pressure
            ]

    def _scale(self) -> float:
        """2 pi over the model's stroke; a hand that opens wider goes beyond 2 pi."""
        return self.dialect.q_open / self._fully_open()

    def _fully_open(self) -> float:
        (joint,) = model(self.dialect.model).joints[Side.LEFT]  # the same on both sides
        return joint.q_max

    def _q_in(self, q: float, joint: JointSpec) -> float:
        if not math.isfinite(q):
            return q  # for the gate to reject: minus infinity is not "closed"
        # The wire carries float32, and 0.1 as float32 is above 0.1 as a double.
        closed, opened = (float(np.float32(end)) for end in self.dialect.ends)
        if q <= closed:
            return 0.0
        if q >= opened:
            return self._fully_open()
        return q / self._scale()

    def _feed_forward(self, values: list[float]) -> Floats:
        return _zero_where_finite(values)

    def _gains(self, values: list[float], default: float) -> Floats:
        return _zero_where_finite(values) + default


class FingerMap(DialectMap):
    """Hands of several joints: all values as they are, but for the mode byte."""

    def __init__(
        self, dialect: Dialect, specs: Mapping[Side, HandSpec], fill: Fill = Fill.KNOWN
    ) -> None:
        super().__init__(dialect, specs, fill)
        ((_, spec),) = specs.items()
        units = dialect.torque_units
        self._torque_units = np.array(units or (1.0,) * spec.n_joints)
        self._encoder = FingerStateEncoder(
            spec,
            known=fill is Fill.KNOWN,
            ids=dialect.mode_byte is ModeByte.RIS,
            torque_units=units,
        )

    def state(self, views: Mapping[Side, StateView]) -> Any:
        """The state message."""
        return self._state_type.decode(self.encode(views))

    def encode(self, views: Mapping[Side, StateView]) -> bytes:
        """The state message as a DDS sample."""
        (view,) = views.values()
        return self._encoder.encode(view.state, view.fault, view.missed, view.tripped)

    def _modes(self, message: Any, side: Side) -> list[int]:
        """The mode bytes of a side's motors."""
        return [m.mode for m in self._motor_commands(message)[: self._specs[side].n_joints]]

    def _torques(self, values: list[float]) -> Floats:
        return np.asarray(self._torque_units * values)


class RisModeMap(FingerMap):
    """Hands of several joints whose mode byte is RIS_Mode: id in bits 0 to 3, status in 4 to 6,
    time-out in 7 (the Dex3-1 manual). The hand's specification says which bytes drive.
    """

    def command(self, message: Any, side: Side) -> HandCommand | None:
        """The command for a side, with its mode bytes."""
        command = super().command(message, side)
        if command is None:
            return None
        modes = self._modes(message, side)
        # by the manual a status that is neither lock nor FOC brakes: nothing moves that was not
        # understood
        foc = [self._specs[side].mode_rule.drives(mode) for mode in modes]
        return replace(
            command,
            mode=np.where(foc, JointMode.FOC, JointMode.BRAKE).astype(np.uint8),
            timeout=np.array([mode & 0x80 != 0 for mode in modes]),
        )

    def remarks(self, message: Any, side: Side) -> Sequence[Remark]:
        """Mode bytes that mean something else than their sender may think."""
        found: dict[str, Remark] = {}
        by_manual = self._specs[side].mode_rule is ModeRule.MANUAL
        for i, mode in enumerate(self._modes(message, side)):
            if mode & 0x6F == i:  # its own id, and status 0 or 1
                continue
            status = (mode >> 4) & 7
            decoded = f"mode byte {mode:#04x} of motor {i} has id {mode & 15}, status {status}"
            right = f"send {0x10 | i:#04x} (0x10 | index) to drive motor {i}, {i:#04x} to lock it"
            if mode & 15 != i:
                does = "; status 0 locks it" if status == JointMode.BRAKE and by_manual else ""
                text = f"{decoded}: the id is not its index{does}. Motors go by index; {right}"
                found.setdefault("wrong_ids", Remark("wrong_ids", text))
            if by_manual and status not in (JointMode.BRAKE, JointMode.FOC):
                text = f"{decoded}: neither 0 (lock) nor 1 (FOC), so it is locked; {right}"
                found.setdefault("unknown_status", Remark("unknown_status", text))
        return tuple(found.values())


class StatusModeMap(FingerMap):
    """Hands of several joints whose mode byte is a status: 1 is position control, 0 brakes
    (docs/sources/unitree-dex.md#b5, docs/sources/unitree-dex.md#d26).
    """

    def command(self, message: Any, side: Side) -> HandCommand | None:
        """The command for a side, with its mode bytes."""
        command = super().command(message, side)
        if command is None:
            return None
        driven = np.array(self._modes(message, side)) == JointMode.FOC
        # no source documents another mode: a motor with an unknown one does not move
        return replace(
            command, mode=np.where(driven, JointMode.FOC, JointMode.BRAKE).astype(np.uint8)
        )

    def remarks(self, message: Any, side: Side) -> Sequence[Remark]:
        """Mode bytes that mean something else than their sender may think."""
        for i, mode in enumerate(self._modes(message, side)):
            if mode not in (JointMode.BRAKE, JointMode.FOC):
                text = f"mode byte {mode:#04x} of joint {i} is unknown, so it is locked"
                if mode & 0x70:
                    product = model(self.dialect.model).title.partition(" ")[0]
                    text += f"; a {product} has no RIS_Mode with ids, as a Dex3-1 has"
                return (Remark("unknown_status", f"{text}; send 1 to drive it, 0 to lock it"),)
        return ()


def dialect_map(
    dialect: Dialect, specs: Mapping[Side, HandSpec], fill: Fill = Fill.KNOWN
) -> DialectMap:
    """The mapping of ``dialect`` for the hands of one topic pair.

    :raises UsageError: a hand is of another model, or the dialect has no codec.
    :raises ModelBroken: the codec of another package's dialect cannot be loaded.
    """
    if dialect.codec is None:
        raise UsageError(f"the dialect {dialect.name} has no codec in its profile")
    made: type[DialectMap] = dialect.codec.load()
    return made(dialect, specs, fill)


def _known(value: float) -> float:
    """``value`` as the wire's float32 can hold it; 0 where it is not known."""
    number = float(value)
    return min(max(number, -_FLOAT_MAX), _FLOAT_MAX) if math.isfinite(number) else 0.0


def _celsius(value: float, *, low: int, high: int) -> int:
    return min(max(round(_known(value)), low), high)


def _zero_where_finite(values: list[float]) -> Floats:
    # unused fields are not obeyed, but NaN in one still rejects the command
    return np.array([0.0 if math.isfinite(v) else v for v in values])


def _imu(imu: ImuState) -> unitree_hg.IMUState_:
    return unitree_hg.IMUState_(
        quaternion=tuple(map(_known, imu.quaternion)),
        gyroscope=tuple(map(_known, imu.gyroscope)),
        accelerometer=tuple(map(_known, imu.accelerometer)),
        rpy=tuple(map(_known, imu.rpy)),
        temperature=_celsius(imu.temperature, low=-32768, high=32767),
    )


def _supply(message: unitree_hg.HandState_, supply: SupplyState) -> None:
    message.power_v = _known(supply.power_v)
    message.power_a = _known(supply.power_a)
    message.system_v = _known(supply.system_v)
    message.device_v = _known(supply.device_v)
