"""The body of a Dex3-1: seven geared motors, what they run into, and what the hand feels of it.

Pure: no clock, no wire, no DDS. Whoever owns it calls :meth:`Dex3Body.step` as time passes;
``sim-dex3`` does that directly, the emulated USB device behind its protocol.

From the manual (seed 002): ratios, torques and speeds of the two motors, the hand's static and
largest current, the sensors' number and range, the joints' angles. Everything else here is
tuned or assumed and says so: inertia, friction, heat, the geometry of a grip.

Not modelled: gravity on the fingers, links and their collisions (every joint moves alone), the
coupling of a finger's two joints through an object, backlash, encoder noise, motors that trip
by themselves (a grip of full torque ends at about 75 °C).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dexkit.emulators.mechanics import Joint, Wall
from dexkit.errors import UsageError
from dexkit.hand import (
    Floats,
    HandCommand,
    HandState,
    ImuState,
    JointMode,
    JointSpec,
    MotorError,
    Side,
    SupplyState,
)
from dexkit.models import DEX3_1

__all__ = ["F_1515_108", "F_1515_214", "STEP", "Dex3Body", "MotorModel"]

STEP = 0.5e-3
"""Integration step, seconds."""


@dataclass(frozen=True)
class MotorModel:
    """A motor with its gearing, SI units at the joint.

    The manual gives three largest torques: an "ideal" one, and "actual" ones with the torque in
    the direction of the speed and against it. They are read as what the motor itself makes, and
    what is left of it (or comes on top of it) behind the friction of the gearing.

    :param gear_ratio: turns of the rotor for one of the joint.
    :param dq_max: rad/s, without load.
    :param tau_max: of the motor itself ("ideal").
    :param tau_driving: at the joint, in the direction of the speed.
    :param tau_holding: at the joint, against the speed.
    """

    name: str
    gear_ratio: float
    dq_max: float
    tau_max: float
    tau_driving: float
    tau_holding: float

    @property
    def driving_loss(self) -> float:
        """Part of the motor's torque that the gearing takes while it drives."""
        return 1.0 - self.tau_driving / self.tau_max

    @property
    def holding_loss(self) -> float:
        """Part of the motor's torque that the gearing adds while it is driven back."""
        return self.tau_holding / self.tau_max - 1.0


# seed 002 "Miniature Brushless Force Control Joint Parameters"
F_1515_108 = MotorModel("F-1515-108", 108.0, 23.0, 0.76, 0.49, 1.37)
F_1515_214 = MotorModel("F-1515-214", 214.0, 11.0, 1.498, 0.86, 3.1)
_MOTORS = {m.gear_ratio: m for m in (F_1515_108, F_1515_214)}

# Tuned, not measured. With kp 1.5 and kd 0.2 the joints follow the commands of the recording
# dex3_pinch within 0.03 rad of the hands in it, which are simulated as well.
_ROTOR_INERTIA = 1.7e-8  # kg m²; 2e-4 at the joint with ratio 108
_ROTOR_BRAKE = 1e-5  # N m s/rad of shorted windings; 0.12 at the joint with ratio 108
_COULOMB = 0.002 / 108.0  # N m per unit of ratio
_VISCOUS = 0.002
_STOP_MARGIN = math.radians(2.0)  # hard stops beyond the limits of the model; assumed
_STOP_STIFFNESS, _STOP_DAMPING = 200.0, 0.1
_OBJECT_STIFFNESS, _OBJECT_DAMPING = 60.0, 0.1

# Heat, assumed: at full torque a winding goes to some 90 °C in minutes, its case to some 70.
AMBIENT = 25.0
"""°C around the hand."""
_SLOW_STEPS = 20  # heat and fans are stepped once in so many steps
_COPPER_LOSS = 6.0  # W at full torque
_WINDING_CAPACITY, _CASE_CAPACITY = 2.0, 20.0  # J/K
_WINDING_TO_CASE, _CASE_TO_AIR = 3.0, 8.0  # K/W
_CASE_LIMIT, _WINDING_LIMIT = 85.0, 120.0  # °C where a motor reports an error
_LIMIT_HYSTERESIS = 10.0
_FANS_ON, _FANS_OFF = 45.0, 40.0  # °C of the hottest case

_STATIC_POWER = 0.2 * 58.0  # W (seed 002 "Static Current: 58V @ 0.2A")
_BUCK_OUTPUT = 24.0  # V: motors take 12 to 24 V, the hand 24 to 58 V (seed 002)
_CURRENT_MAX = 10.0  # A (seed 002)

# A grip, assumed: lever arms from a joint to where the object lies against its link, how a
# link's force spreads over the elements there, and what the palm gets of it.
_PAD_LEVER, _TIP_LEVER = 0.06, 0.04  # m
_PAD_SHARE = (0.3, 0.3, 0.2, 0.2)
_TIP_SHARE = (0.25, 0.5, 0.25)
_PALM_SHARES = (1.0 / 12.0,) * 4
_PALM_FROM = 6.0  # N of the fingers' pads from which the object is pressed into the palm
_GRAVITY = 9.81
_FORCE_MIN, _FORCE_MAX = 0.010 * _GRAVITY, 2.5 * _GRAVITY  # seed 002 "Range of Perception"
# m² of one element. A square centimetre, and a little more so that a full reading stays below
# the code for "no value" on the wire (30000 counts of 8 Pa).
_ELEMENT_AREA = 1.05e-4

# per place of a finger: (joint that presses it, lever arm, share of each element)
_INDEX = {spec.name: i for i, spec in enumerate(DEX3_1.joints[Side.LEFT])}
_PRESSES = {
    "thumb tip": ("thumb_2", _TIP_LEVER, _TIP_SHARE),
    "thumb pad": ("thumb_1", _PAD_LEVER, _PAD_SHARE),
    "middle tip": ("middle_1", _TIP_LEVER, _TIP_SHARE),
    "middle pad": ("middle_0", _PAD_LEVER, _PAD_SHARE),
    "index tip": ("index_1", _TIP_LEVER, _TIP_SHARE),
    "index pad": ("index_0", _PAD_LEVER, _PAD_SHARE),
}
_PLACES = [sensor.place for sensor in DEX3_1.sensors]
_TOUCH = [(_INDEX[_PRESSES[p][0]], _PRESSES[p][1]) for p in _PLACES if p in _PRESSES]
_ON_PALM = [_PLACES.index("middle pad"), _PLACES.index("index pad")]
_SHARES = np.full((len(_PLACES), 12), math.nan)
for _row, _sensor in zip(_SHARES, DEX3_1.sensors, strict=True):
    _row[list(_sensor.slots)] = _PRESSES.get(_sensor.place, (None, None, _PALM_SHARES))[2]
_NO_PRESSURE = 0.0 * _SHARES
_SENSOR_TEMPERATURE = AMBIENT + _NO_PRESSURE


# plain integers: an enum's attribute look-up costs more than what it guards
_BRAKE, _FOC = int(JointMode.BRAKE), int(JointMode.FOC)


class _Motor:
    """One motor and its joint."""

    __slots__ = (
        "before",
        "case",
        "damping",
        "driving_loss",
        "droop",
        "error",
        "feedforward",
        "holding_loss",
        "joint",
        "kp",
        "mode",
        "model",
        "most",
        "object_wall",
        "q",
        "rests_at",
        "torque",
        "winding",
    )

    def __init__(self, spec: JointSpec, start: float, object_at: float | None) -> None:
        self.model = _MOTORS[spec.gear_ratio]
        ratio = spec.gear_ratio
        walls = [
            Wall(spec.q_min - _STOP_MARGIN, +1, _STOP_STIFFNESS, _STOP_DAMPING),
            Wall(spec.q_max + _STOP_MARGIN, -1, _STOP_STIFFNESS, _STOP_DAMPING),
        ]
        self.object_wall: Wall | None = None
        if object_at is not None and spec.closing:
            self.object_wall = Wall(
                _closed_by(spec, object_at), -spec.closing, _OBJECT_STIFFNESS, _OBJECT_DAMPING
            )
            walls.append(self.object_wall)
        self.joint = Joint(
            inertia=_ROTOR_INERTIA * ratio * ratio,
            coulomb=_COULOMB * ratio,
            viscous=_VISCOUS,
            walls=tuple(walls),
            q=start,
        )
        self.driving_loss = self.model.driving_loss
        self.holding_loss = self.model.holding_loss
        self.power(True)
        self.error = 0
        self.case = self.winding = AMBIENT
        self.torque = 0.0
        self.before = 0.0  # rad/s, before the last call of Dex3Body.step
        self.brake()

    def power(self, on: bool) -> None:
        """Give it torque, or none."""
        self.most = self.model.tau_max if on else 0.0
        self.droop = self.most / self.model.dq_max  # torque lost per rad/s
        self.rests_at = math.nan

    def follow(self, q: float, feedforward: float, kp: float, kd: float) -> None:
        """Obey the motor's law."""
        self.mode = _FOC
        self.q = q
        self.feedforward = feedforward
        self.kp = kp
        self.damping = kd + kp * STEP
        self.rests_at = math.nan

    def brake(self) -> None:
        """Short the windings."""
        self.follow(0.0, 0.0, 0.0, _ROTOR_BRAKE * self.model.gear_ratio**2)
        self.mode = _BRAKE

    def contact(self) -> float:
        """Torque that the object takes, N·m."""
        wall = self.object_wall
        if wall is None:
            return 0.0
        return max(0.0, wall.stiffness * (wall.q - self.joint.q) * wall.push)

    def heat(self, dt: float) -> None:
        """Warm up by the torque and cool down for ``dt`` seconds."""
        part = self.torque / self.model.tau_max
        to_case = (self.winding - self.case) / _WINDING_TO_CASE
        to_air = (self.case - AMBIENT) / _CASE_TO_AIR
        self.winding += dt * (_COPPER_LOSS * part * part - to_case) / _WINDING_CAPACITY
        self.case += dt * (to_case - to_air) / _CASE_CAPACITY


def _closed_by(spec: JointSpec, percent: float) -> float:
    """The angle of a joint that is ``percent`` of the way from straight (0) to closed."""
    return percent / 100.0 * (spec.q_max if spec.closing > 0 else spec.q_min)


class Dex3Body:
    """A Dex3-1 hand without its electronics.

    :param side: which hand; the right one is the mirror of the left.
    :param object_at: how far the six flexing joints close before they touch an object, percent
        of the way from straight to closed; None for no object. Not more than can be reached,
        and joints that rest beyond it start where they touch it.
    :param start: how far they are closed at first, percent; None for the model's rest pose,
        which is about 20 %.
    :param supply_v: voltage of the supply, V.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side,
        *,
        object_at: float | None = None,
        start: float | None = None,
        supply_v: float = 24.0,
    ) -> None:
        if object_at is not None and not 0.0 < object_at < 100.0:
            raise UsageError(f"an object is touched between 0 and 100 % closed, not {object_at}")
        if start is not None and not 0.0 <= start <= 100.0:
            raise UsageError(f"start is a percentage of closing, not {start}")
        if start is not None and object_at is not None and start > object_at:
            raise UsageError(
                f"the hand would start inside the object: start {start:g} %, object {object_at:g} %"
            )
        if not 24.0 <= supply_v <= 58.0:
            raise UsageError(f"the hand takes 24 to 58 V, not {supply_v}")
        self.side = side
        self.specs = DEX3_1.joints[side]
        self.supply_v = supply_v
        self.fans = False
        self._motors = tuple(
            _Motor(spec, _start(spec, rest, start, object_at), object_at)
            for spec, rest in zip(self.specs, DEX3_1.rest_q[side], strict=True)
        )
        self.joints = tuple(motor.joint for motor in self._motors)
        self._lived = STEP
        self._touched: list[float] = []
        self._felt = _NO_PRESSURE
        self._to_slow = _SLOW_STEPS

    # -- commands ------------------------------------------------------------------------------

    def command(
        self,
        joint: int,
        mode: int,
        q: float = 0.0,
        dq: float = 0.0,
        tau: float = 0.0,
        kp: float = 0.0,
        kd: float = 0.0,
    ) -> None:
        """What one motor does from here on: ``tau = kp (q - q_now) + kd (dq - dq_now) + tau``.

        :param mode: FOC (1) drives; everything else brakes.
        :param kp: gains below zero count as zero.
        """
        motor = self._motors[joint]
        if mode != _FOC or motor.error:
            if motor.mode != _BRAKE:
                motor.brake()
            return
        kp = kp if kp > 0.0 else 0.0
        kd = kd if kd > 0.0 else 0.0
        feedforward = kd * dq + tau
        if (
            motor.q != q
            or motor.feedforward != feedforward
            or motor.kp != kp
            or motor.damping != kd + kp * STEP
            or motor.mode != _FOC
        ):
            motor.follow(q, feedforward, kp, kd)

    def use(self, command: HandCommand) -> None:
        """Give every motor its part of ``command``."""
        for i, row in enumerate(
            zip(
                command.mode.tolist(),
                command.q.tolist(),
                command.dq.tolist(),
                command.tau.tolist(),
                command.kp.tolist(),
                command.kd.tolist(),
                strict=True,
            )
        ):
            self.command(i, *row)

    def brake(self) -> None:
        """Brake every joint."""
        for motor in self._motors:
            motor.brake()

    def stop(self) -> None:
        """Brake and stand still at once."""
        self.brake()
        for joint in self.joints:
            joint.dq = 0.0

    # -- time ----------------------------------------------------------------------------------

    def step(self, steps: int = 1) -> None:
        """Live through ``steps`` times :data:`STEP`."""
        if steps <= 0:
            return
        motors = self._motors
        for motor in motors:
            motor.before = motor.joint.dq
        self._lived = steps * STEP
        for _ in range(steps):
            for motor in motors:
                joint = motor.joint
                speed = joint.dq
                if speed == 0.0 and joint.q == motor.rests_at:
                    continue  # nothing has changed: this step would end as the last one did
                most = motor.most
                # the faster it turns, the less it can push on: nothing is left at the top speed
                along = most - motor.droop * (speed if speed > 0.0 else -speed)
                motor.torque = joint.drive(
                    motor.kp * (motor.q - joint.q) + motor.feedforward,
                    motor.damping,
                    most,
                    along if along > 0.0 else 0.0,
                    STEP,
                    motor.driving_loss,
                    motor.holding_loss,
                )
                motor.rests_at = joint.q if speed == 0.0 == joint.dq else math.nan
            self._to_slow -= 1
            if self._to_slow == 0:
                self._to_slow = _SLOW_STEPS
                self._slowly(_SLOW_STEPS * STEP)

    def _slowly(self, dt: float) -> None:
        for motor in self._motors:
            motor.heat(dt)
            self._watch(motor)
        hottest = max(motor.case for motor in self._motors)
        if hottest > _FANS_ON:
            self.fans = True
        elif hottest < _FANS_OFF:
            self.fans = False

    def _watch(self, motor: _Motor) -> None:
        for value, limit, bit in (
            (motor.case, _CASE_LIMIT, MotorError.CASE_TEMPERATURE),
            (motor.winding, _WINDING_LIMIT, MotorError.WINDING_OVERTEMPERATURE),
        ):
            if value > limit:
                motor.error |= bit
                motor.brake()
            elif value < limit - _LIMIT_HYSTERESIS:
                motor.error &= ~bit

    # -- faults --------------------------------------------------------------------------------

    def power(self, joint: int, on: bool) -> None:
        """Cut a motor's power (it is limp then, and would not answer), or give it back."""
        self._motors[joint].power(on)
        self._motors[joint].brake()

    def heat(self, joint: int, celsius: float) -> None:
        """Have case and winding of a motor at a temperature; it cools from there."""
        motor = self._motors[joint]
        motor.case = motor.winding = celsius
        self._watch(motor)

    def fail(self, joint: int, error: MotorError) -> None:
        """Raise an error of a motor: it brakes until :meth:`recover`."""
        self._motors[joint].error |= error
        self._motors[joint].brake()

    def recover(self, joint: int, error: MotorError) -> None:
        """Take an error back; the motor brakes until its next command."""
        self._motors[joint].error &= ~error

    def jam(self, joint: int, stuck: bool) -> None:
        """Have a joint stuck where it is, or free it."""
        self.joints[joint].locked = stuck
        self._motors[joint].rests_at = math.nan

    # -- what can be seen ----------------------------------------------------------------------

    @property
    def q(self) -> Floats:
        """Joint positions, rad, shape (7,)."""
        return np.array([joint.q for joint in self.joints])

    @property
    def dq(self) -> Floats:
        """Joint speeds, rad/s, shape (7,)."""
        return np.array([joint.dq for joint in self.joints])

    @property
    def ddq(self) -> Floats:
        """Mean accelerations during the last :meth:`step`, rad/s², shape (7,)."""
        return np.array([(m.joint.dq - m.before) / self._lived for m in self._motors])

    @property
    def tau(self) -> Floats:
        """Torques of the motors, as their current tells it, N·m, shape (7,)."""
        return np.array([motor.torque for motor in self._motors])

    @property
    def mode(self) -> list[int]:
        """What each motor does: :class:`JointMode` values."""
        return [motor.mode for motor in self._motors]

    @property
    def errors(self) -> list[int]:
        """:class:`MotorError` bits of each motor."""
        return [motor.error for motor in self._motors]

    @property
    def powered(self) -> list[bool]:
        """Whether each motor has power."""
        return [motor.most > 0.0 for motor in self._motors]

    @property
    def temperature(self) -> Floats:
        """Of the motors' cases, °C, shape (7,)."""
        return np.array([motor.case for motor in self._motors])

    @property
    def winding_temperature(self) -> Floats:
        """Of their windings, °C, shape (7,)."""
        return np.array([motor.winding for motor in self._motors])

    @property
    def contact(self) -> Floats:
        """Torques that the object takes from the joints, N·m, shape (7,)."""
        return np.array([motor.contact() for motor in self._motors])

    @property
    def motor_v(self) -> float:
        """Voltage at the motors, V, behind the buck converter."""
        return min(self.supply_v, _BUCK_OUTPUT)

    @property
    def current(self) -> float:
        """Drawn from the supply, A: static, mechanical power and losses; at most 10 A."""
        power = _STATIC_POWER
        for motor in self._motors:
            part = motor.torque / motor.model.tau_max
            # what a braking motor gives back stays in its losses
            power += _COPPER_LOSS * part * part + max(0.0, motor.torque * motor.joint.dq)
        return min(power / self.supply_v, _CURRENT_MAX)

    @property
    def supply(self) -> SupplyState:
        """Supply and inner voltages."""
        return SupplyState(
            power_v=self.supply_v,
            power_a=self.current,
            system_v=self.supply_v,
            device_v=self.motor_v,
        )

    @property
    def imu(self) -> ImuState:
        """The inertial unit of a hand at rest, upright."""
        return _IMU

    @property
    def pressure(self) -> Floats:
        """Pa, shape (9, 12), NaN where there is no element, 0 where nothing is touched.

        The first joint of a finger (thumb_1 for the thumb) presses its pad against the object,
        the second its tip. An element feels 10 g to 2500 g: less is 0, more is the most.
        """
        torques = [motor.contact() for motor in self._motors]
        if torques == self._touched:
            return self._felt.copy()
        forces = [torques[joint] / lever for joint, lever in _TOUCH]
        palm = sum(forces[i] for i in _ON_PALM) - _PALM_FROM
        forces += [palm if palm > 0.0 else 0.0] * (len(DEX3_1.sensors) - len(forces))
        felt: Floats = _SHARES * np.array(forces)[:, np.newaxis]
        np.minimum(felt, _FORCE_MAX, out=felt)
        felt[felt < _FORCE_MIN] = 0.0
        felt /= _ELEMENT_AREA
        self._touched, self._felt = torques, felt
        return felt.copy()

    @property
    def sensor_temperature(self) -> Floats:
        """°C, shape (9, 12), NaN where there is no element: always that of the air."""
        return _SENSOR_TEMPERATURE.copy()

    def state(self, stamp: float) -> HandState:
        """All of it, measured at ``stamp``."""
        lived = self._lived
        table = np.array(
            [
                (
                    m.joint.q,
                    m.joint.dq,
                    (m.joint.dq - m.before) / lived,
                    m.torque,
                    m.case,
                    m.winding,
                    self.motor_v,
                )
                for m in self._motors
            ]
        ).T.copy()
        return HandState(
            q=table[0],
            dq=table[1],
            ddq=table[2],
            tau_est=table[3],
            temperature=table[4],
            winding_temperature=table[5],
            voltage=table[6],
            mode=np.array(self.mode, dtype=np.uint8),
            fault=np.array(self.errors, dtype=np.uint32),
            stamp=stamp,
            pressure=self.pressure,
            sensor_temperature=self.sensor_temperature,
            sensor_lost=np.zeros(len(DEX3_1.sensors), dtype=np.uint32),
            imu=self.imu,
            supply=self.supply,
        )


_IMU = ImuState(accelerometer=(0.0, 0.0, _GRAVITY), temperature=AMBIENT)


def _start(spec: JointSpec, rest: float, start: float | None, object_at: float | None) -> float:
    if not spec.closing:
        return rest
    q = rest if start is None else _closed_by(spec, start)
    if object_at is not None:
        touch = _closed_by(spec, object_at)
        q = min(q, touch) if spec.closing > 0 else max(q, touch)
    return q
