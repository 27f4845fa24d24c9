"""The common hand interface: anything that can exchange one command for one state.

A backend implements :class:`Hand`: a ``spec``, ``open``, ``close`` and ``exchange``.
Rates, watchdogs, prediction, DDS and logging belong to :mod:`dexkit.service`.

Joint space, SI units, throughout: q in rad, dq in rad/s, ddq in rad/s², tau in N·m, kp in
N·m/rad, kd in N·m·s/rad, temperature in °C, voltage in V, current in A. Hands whose vendor gives q
in parts of the full travel have that unit instead of rad (:class:`~dexkit.models.HandModel`).
Per-joint values are numpy arrays of shape ``(n_joints,)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum, IntFlag
from typing import Final, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexkit.errors import CommandRejected, UsageError

__all__ = [
    "ROBOT",
    "CommandGate",
    "Floats",
    "Hand",
    "HandCommand",
    "HandSpec",
    "HandState",
    "ImuState",
    "JointMode",
    "JointSpec",
    "ModeRule",
    "MotorError",
    "RobotSubject",
    "Side",
    "Subject",
    "SupplyState",
]

Floats: TypeAlias = NDArray[np.float64]


class Side(str, Enum):
    """Which of the robot's two hands."""

    LEFT = "left"
    RIGHT = "right"

    def __str__(self) -> str:
        return self.value


class RobotSubject(str, Enum):
    """The subject of a robot, in place of a hand's side."""

    ROBOT = "robot"

    def __str__(self) -> str:
        return self.value


ROBOT: Final = RobotSubject.ROBOT

Subject: TypeAlias = Side | RobotSubject
"""The subject of a conformance run: a hand, named by its side, or a robot."""


class JointMode(IntEnum):
    """Mode of a joint's motor: the RIS_Mode status values of Unitree's motors.

    (docs/sources/unitree-dex.md#b4, "Mode byte".)
    """

    BRAKE = 0
    FOC = 1


class ModeRule(str, Enum):
    """What a hand's firmware takes for "drive" in a mode byte that holds RIS_Mode.

    Which of them a genuine Dex3-1 has is disputed (docs/sources/real-hands.md#mode-status).
    """

    MANUAL = "manual"
    """Status 1 in bits 4 to 6; any other one brakes."""
    NONZERO = "nonzero"
    """Any byte but 0; 0 brakes."""
    IGNORED = "ignored"
    """Every byte: the gains decide alone."""

    def drives(self, mode: int) -> bool:
        """Whether a mode byte drives its motor."""
        if self is ModeRule.MANUAL:
            return (mode >> 4) & 7 == JointMode.FOC
        return self is ModeRule.IGNORED or mode != 0


class MotorError(IntFlag):
    """Unitree's motor error bits, the one fault vocabulary of all hands.

    (docs/sources/unitree-dex.md#b6.)
    """

    NONE = 0
    OVERCURRENT = 0x1
    OVERVOLTAGE_TRANSIENT = 0x2
    OVERVOLTAGE = 0x4
    UNDERVOLTAGE = 0x8
    CHIP_OVERTEMPERATURE = 0x10
    MOS_TEMPERATURE = 0x20
    MOS_TEMPERATURE_ABNORMAL = 0x40
    CASE_TEMPERATURE = 0x80
    CASE_TEMPERATURE_ABNORMAL = 0x100
    WINDING_OVERTEMPERATURE = 0x200
    ROTOR_ENCODER_1 = 0x400
    ROTOR_ENCODER_2 = 0x800
    OUTPUT_ENCODER = 0x1000
    CALIBRATION_DATA = 0x2000
    ABNORMAL_RESET = 0x4000
    LOCKED = 0x8000
    CHIP_VERIFICATION = 0x10000
    CALIBRATION_MODE = 0x20000
    COMMUNICATION_CHECK = 0x40000
    DRIVER_VERSION = 0x80000
    MOTOR_SAW_HOST_TIMEOUT = 0x40000000
    HOST_SAW_MOTOR_TIMEOUT = 0x80000000


@dataclass(frozen=True)
class JointSpec:
    """One joint: its name and its limits, SI units.

    :param closing: sign of dq that closes the hand (+1 or -1), or 0 where neither does.
    :param straight: q of an open hand; of a joint that closes.
    :param urdf: name of the joint in Unitree's URDF, or empty.
    :param gear_ratio: turns of the rotor for one of the joint.
    :param coupled: moved by the motor of the joint before it, not by one of its own.
    :param finger: to which it belongs: ``thumb``, ``index``, ``middle`` or another; empty for a
        gripper's and a robot's joints.
    """

    name: str
    q_min: float
    q_max: float
    dq_max: float
    tau_max: float
    closing: int = 0
    urdf: str = ""
    gear_ratio: float = 1.0
    straight: float = 0.0
    coupled: bool = False
    finger: str = ""

    def __post_init__(self) -> None:
        if not self.q_min < self.q_max:
            raise UsageError(
                f"joint {self.name}: q_min {self.q_min} is not below q_max {self.q_max}"
            )
        if self.dq_max <= 0 or self.tau_max <= 0:
            raise UsageError(f"joint {self.name}: dq_max and tau_max must be positive")
        if self.closing not in (-1, 0, 1):
            raise UsageError(f"joint {self.name}: closing must be -1, 0 or 1")
        if self.gear_ratio <= 0:
            raise UsageError(f"joint {self.name}: gear_ratio must be positive")

    @property
    def stroke(self) -> float:
        """Width of the joint's range, rad."""
        return self.q_max - self.q_min

    def closed_by(self, part: float) -> float:
        """Q of a joint that is so far closed, 0 open to 1 as far as it goes; see `closing`."""
        end = self.q_max if self.closing > 0 else self.q_min
        return self.straight + part * (end - self.straight)


@dataclass(frozen=True)
class HandSpec:
    """The properties of a hand: model, side, joints and rates.

    :param model: name in :data:`dexkit.models.MODELS`, for example ``"dex1-1"``.
    :param side: which hand.
    :param joints: in the order of the DDS sequences.
    :param io_rate: exchanges a second that can be expected of the backend when nothing is wrong:
        the service asks for no more, and counts what it gets.
    :param exchange_timeout: seconds after which ``exchange`` has returned or raised.
    :param n_sensors: pressure sensor packets in a state, or tactile areas of a touch topic.
    :param simulated: no real device moves when this hand is commanded.
    :param mode_rule: which mode bytes drive a motor, where the byte holds RIS_Mode.
    """

    model: str
    side: Side
    joints: tuple[JointSpec, ...]
    io_rate: float
    exchange_timeout: float = 0.1
    n_sensors: int = 0
    simulated: bool = False
    mode_rule: ModeRule = ModeRule.MANUAL

    def __post_init__(self) -> None:
        if not self.joints:
            raise UsageError("a hand needs at least one joint")
        if not 0 < self.io_rate < math.inf:
            raise UsageError(f"io_rate must be positive, got {self.io_rate}")

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def q_min(self) -> Floats:
        """Lower limits, shape (n_joints,), rad."""
        return np.array([j.q_min for j in self.joints])

    @property
    def q_max(self) -> Floats:
        """Upper limits, shape (n_joints,), rad."""
        return np.array([j.q_max for j in self.joints])


def _vector(value: ArrayLike, n: int | None = None) -> Floats:
    array = np.array(value, dtype=np.float64, ndmin=1)
    if n is not None and array.shape == (1,) and n != 1:
        array = np.full(n, array[0])
    return array


@dataclass(frozen=True, eq=False)
class HandCommand:
    """One command: per joint ``mode, q, dq, tau, kp, kd``, arrays of shape (n_joints,).

    The motors follow ``tau_motor = kp (q - q_now) + kd (dq - dq_now) + tau`` in mode FOC.

    :param timeout: which joints the client wants braked when its commands stop (bit 7 of
        RIS_Mode, docs/sources/unitree-dex.md#b4), shape (n_joints,); None where the dialect has no
        such bit, and the service's own time-out holds for all.
    """

    q: Floats
    dq: Floats
    tau: Floats
    kp: Floats
    kd: Floats
    mode: NDArray[np.uint8]
    timeout: NDArray[np.bool_] | None = None

    @classmethod
    def position(
        cls,
        q: ArrayLike,
        *,
        dq: ArrayLike = 0.0,
        tau: ArrayLike = 0.0,
        kp: ArrayLike = 5.0,
        kd: ArrayLike = 0.05,
    ) -> HandCommand:
        """Go to ``q``. The default gains are those xr_teleoperate sends to a Dex1
        (docs/sources/unitree-dex.md#b1).
        """
        goal = _vector(q)
        n = len(goal)
        return cls(
            q=goal,
            dq=_vector(dq, n),
            tau=_vector(tau, n),
            kp=_vector(kp, n),
            kd=_vector(kd, n),
            mode=np.full(n, JointMode.FOC, dtype=np.uint8),
        )

    @classmethod
    def brake(cls, n_joints: int) -> HandCommand:
        """Brake every joint, as the vendor's service does on time-out
        (docs/sources/unitree-dex.md#b2).
        """
        return cls(
            q=np.zeros(n_joints),
            dq=np.zeros(n_joints),
            tau=np.zeros(n_joints),
            kp=np.zeros(n_joints),
            kd=np.zeros(n_joints),
            mode=np.full(n_joints, JointMode.BRAKE, dtype=np.uint8),
        )

    @property
    def is_brake(self) -> bool:
        """Whether every joint brakes."""
        return not self.mode.any()

    @property
    def is_limp(self) -> bool:
        """Whether it drives no joint: kp, kd, dq and tau are 0 throughout, and no joint brakes."""
        return bool(self.mode.all()) and not any(
            values.any() for values in (self.kp, self.kd, self.dq, self.tau)
        )

    def same_as(self, other: HandCommand) -> bool:
        """Whether all fields are equal."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("q", "dq", "tau", "kp", "kd", "mode", "timeout")
        )


@dataclass(frozen=True)
class ImuState:
    """Inertial unit of a hand: quaternion w x y z, rad/s, m/s², rad, °C."""

    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    gyroscope: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accelerometer: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature: float = math.nan


@dataclass(frozen=True)
class SupplyState:
    """Supply of a hand: V, A; NaN where it is not measured."""

    power_v: float = math.nan
    power_a: float = math.nan
    system_v: float = math.nan
    device_v: float = math.nan


@dataclass(frozen=True, eq=False)
class HandState:
    """One state. Values that a backend does not know stay NaN (or None).

    :param q: joint position, rad, shape (n_joints,).
    :param temperature: of the motor's case, °C, shape (n_joints,).
    :param winding_temperature: likewise of its winding, or None where it is not measured apart.
    :param fault: :class:`MotorError` bits per joint.
    :param pressure: Pa, absolute (about 100,000 with nothing on an element, see
        :mod:`dexkit.pressure`), shape (n_sensors, 12), NaN where there is no sensor element; or
        None without sensors. Of tactile areas: the device's own counts, shape (n_sensors, elements
        of the largest area), row after row.
    :param sensor_temperature: °C, shape (n_sensors, 12), or None.
    :param sensor_lost: packets that each sensor has missed, shape (n_sensors,), or None.
    :param error: the hand's own error word, apart from its motors'.
    :param stamp: monotonic time of *measurement*, seconds.
    :param measured: False when an estimator predicted ``q``.
    """

    q: Floats
    dq: Floats
    ddq: Floats
    tau_est: Floats
    temperature: Floats
    voltage: Floats
    mode: NDArray[np.uint8]
    fault: NDArray[np.uint32]
    stamp: float
    measured: bool = True
    pressure: Floats | None = None
    imu: ImuState | None = None
    supply: SupplyState | None = None
    winding_temperature: Floats | None = None
    sensor_temperature: Floats | None = None
    sensor_lost: NDArray[np.uint32] | None = None
    error: int = 0

    @classmethod
    def from_values(
        cls,
        q: ArrayLike,
        *,
        stamp: float,
        dq: ArrayLike = 0.0,
        ddq: ArrayLike = 0.0,
        tau_est: ArrayLike = 0.0,
        temperature: ArrayLike = math.nan,
        voltage: ArrayLike = math.nan,
        mode: int | Sequence[int] = JointMode.BRAKE,
        fault: int | Sequence[int] = 0,
        measured: bool = True,
        pressure: Floats | None = None,
        imu: ImuState | None = None,
        supply: SupplyState | None = None,
        winding_temperature: Floats | None = None,
        sensor_temperature: Floats | None = None,
        sensor_lost: NDArray[np.uint32] | None = None,
        error: int = 0,
    ) -> HandState:
        """Build a state from scalars or sequences; scalars are repeated for each joint."""
        position = _vector(q)
        n = len(position)
        return cls(
            q=position,
            dq=_vector(dq, n),
            ddq=_vector(ddq, n),
            tau_est=_vector(tau_est, n),
            temperature=_vector(temperature, n),
            voltage=_vector(voltage, n),
            mode=np.broadcast_to(np.asarray(mode, dtype=np.uint8), (n,)).copy(),
            fault=np.broadcast_to(np.asarray(fault, dtype=np.uint32), (n,)).copy(),
            stamp=stamp,
            measured=measured,
            pressure=pressure,
            imu=imu,
            supply=supply,
            winding_temperature=winding_temperature,
            sensor_temperature=sensor_temperature,
            sensor_lost=sensor_lost,
            error=error,
        )


@runtime_checkable
class Hand(Protocol):
    """The interface of every backend. ``exchange`` is called from one thread."""

    @property
    def spec(self) -> HandSpec:
        """The properties of this hand. May be read before ``open``, which may refine the rate."""
        ...

    def open(self) -> None:
        """Connect and make ready, without moving.

        :raises HandError: if that is impossible; nothing stays open then.
        """
        ...

    def close(self) -> None:
        """Leave the device safe (not moving) and release it. May be called twice."""
        ...

    def exchange(self, command: HandCommand) -> HandState:
        """Send one command, return one state: one bounded I/O transaction.

        :param command: has passed a :class:`CommandGate`: finite, right shape, within limits.
        :raises HandLost: the device has gone; ``close`` and ``open`` may bring it back.
        :raises HandTimeout: no answer within ``spec.exchange_timeout``.
        :raises HandFault: the device refuses because of a hardware error.
        """
        ...


@dataclass
class CommandGate:
    """The boundary that every command passes before it reaches a hand.

    NaN, infinity or a wrong shape rejects the whole command; finite values outside the limits
    are clamped. Both are counted.
    """

    spec: HandSpec
    rejected: int = 0
    clamped: int = 0
    _q_min: Floats = field(init=False, repr=False)
    _q_max: Floats = field(init=False, repr=False)
    _dq_max: Floats = field(init=False, repr=False)
    _tau_max: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._q_min = self.spec.q_min
        self._q_max = self.spec.q_max
        self._dq_max = np.array([j.dq_max for j in self.spec.joints])
        self._tau_max = np.array([j.tau_max for j in self.spec.joints])

    def admit(self, command: HandCommand) -> HandCommand:
        """Return ``command`` within the limits.

        :raises CommandRejected: a field has the wrong shape or is not finite.
        """
        n = self.spec.n_joints
        for name in ("q", "dq", "tau", "kp", "kd", "mode"):
            value = getattr(command, name)
            if value.shape != (n,):
                self.rejected += 1
                raise CommandRejected(
                    f"command field {name} has shape {value.shape}, this hand has {n} joint(s)"
                )
            if not np.isfinite(value).all():
                self.rejected += 1
                raise CommandRejected(
                    f"command field {name} is not finite: {_joint_values(self.spec, value)}"
                )
        q = np.clip(command.q, self._q_min, self._q_max)
        dq = np.clip(command.dq, -self._dq_max, self._dq_max)
        tau = np.clip(command.tau, -self._tau_max, self._tau_max)
        kp = np.maximum(command.kp, 0.0)
        kd = np.maximum(command.kd, 0.0)
        changed = (
            (q != command.q)
            | (dq != command.dq)
            | (tau != command.tau)
            | (kp != command.kp)
            | (kd != command.kd)
        )
        if not changed.any():
            return command
        self.clamped += 1
        return replace(command, q=q, dq=dq, tau=tau, kp=kp, kd=kd)


def _joint_values(spec: HandSpec, values: Iterable[float]) -> str:
    bad = [
        f"{joint.name} = {value}"
        for joint, value in zip(spec.joints, values, strict=True)
        if not math.isfinite(value)
    ]
    return ", ".join(bad)
