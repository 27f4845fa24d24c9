"""Simulate the mechanics of a Dex3-1: motors, supply and pressure sensors.

:mod:`dexkit.emulators.finger_mechanics` has the joints. The owner of the mechanics calls ``step``
as time passes: ``sim-dex3`` directly, the emulated USB device behind its protocol.

largest current, the sensors' number and range, the joints' angles. Everything else here is
tuned or assumed and says so: inertia, friction, heat, the geometry of a grip.


Not modelled, besides what is said there: motors that trip by themselves (a grip of full torque
ends at about 75 °C).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dexkit.emulators.barometers import untouched
from dexkit.emulators.finger_mechanics import AMBIENT, FingerMechanics, MotorModel
from dexkit.errors import UsageError
from dexkit.hand import Floats, ImuState, Side, SupplyState
from dexkit.models import DEX3_1

__all__ = ["F_1515_108", "F_1515_214", "Dex3Mechanics"]

# Tuned, not measured. With kp 1.5 and kd 0.2 the joints follow the commands of the recording
# dex3_pinch within 0.03 rad of the hands in it, which are simulated as well.
_ROTOR_INERTIA = 1.7e-8  # kg m²; 2e-4 at the joint with ratio 108
_ROTOR_BRAKE = 1e-5  # N m s/rad of shorted windings; 0.12 at the joint with ratio 108
_COULOMB = 0.002 / 108.0  # N m per unit of ratio
_VISCOUS = 0.002  # N m s/rad


def _f_1515(
    ratio: float, dq_max: float, ideal: float, driving: float, holding: float
) -> MotorModel:
    return MotorModel(
        f"F-1515-{ratio:g}",
        ratio,
        dq_max,
        ideal,
        driving,
        holding,
        inertia=_ROTOR_INERTIA * ratio * ratio,
        brake=_ROTOR_BRAKE * ratio**2,
        coulomb=_COULOMB * ratio,
        viscous=_VISCOUS,
    )


# the Dex3-1 manual "Miniature Brushless Force Control Joint Parameters". It gives three largest
# torques: an "ideal" one, and "actual" ones with the torque in the direction of the speed and
# against it.
F_1515_108 = _f_1515(108.0, 23.0, 0.76, 0.49, 1.37)
F_1515_214 = _f_1515(214.0, 11.0, 1.498, 0.86, 3.1)
_MOTORS = {m.gear_ratio: m for m in (F_1515_108, F_1515_214)}

_FANS_ON, _FANS_OFF = 45.0, 40.0  # °C of the hottest case

_STATIC_POWER = 0.2 * 58.0  # W (the Dex3-1 manual "Static Current: 58V @ 0.2A")
_BUCK_OUTPUT = 24.0  # V: motors take 12 to 24 V, the hand 24 to 58 V (the Dex3-1 manual)
_CURRENT_MAX = 10.0  # A (the Dex3-1 manual)

# A grip, assumed: lever arms from a joint to where the object lies against its link, how a
# link's force spreads over the elements there, and what the palm gets of it.
_PAD_LEVER, _TIP_LEVER = 0.06, 0.04  # m
_PAD_SHARE = (0.3, 0.3, 0.2, 0.2)
_TIP_SHARE = (0.25, 0.5, 0.25)
_PALM_SHARES = (1.0 / 12.0,) * 4
_PALM_FROM = 6.0  # N of the fingers' pads from which the object is pressed into the palm
_GRAVITY = 9.81
_FORCE_MIN, _FORCE_MAX = 0.010 * _GRAVITY, 2.5 * _GRAVITY  # the Dex3-1 manual "Range of Perception"
# m² of one element. About a square centimetre: then the least force that an element feels is 1090
# Pa, above the 1000 from which a program of real hands sees a contact
# (docs/sources/real-hands.md#touch-sign).
_ELEMENT_AREA = 0.9e-4

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
_SENSOR_TEMPERATURE = AMBIENT + 0.0 * _SHARES


class Dex3Mechanics(FingerMechanics):
    """A Dex3-1 hand without its electronics.

    :param object_at: how far the six flexing joints close before they touch an object; see
        :class:`~dexkit.emulators.finger_mechanics.FingerMechanics`.
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
        motors = [_MOTORS[joint.gear_ratio] for joint in DEX3_1.joints[side]]
        super().__init__(DEX3_1, side, motors, object_at=object_at, start=start)
        if not 24.0 <= supply_v <= 58.0:
            raise UsageError(f"the hand takes 24 to 58 V, not {supply_v}")
        self.supply_v = supply_v
        self.fans = False
        self._presses = [0.0] * len(DEX3_1.sensors)
        self._time = 0.0
        self._rest: Floats = untouched(side, 0.0)
        self._touched: list[float] = []
        self._felt: Floats = self._rest

    def press(self, sensor: int, force: float) -> None:
        """Press a sensor from outside, as a person does; the joints do not yield.

        :param force: N, on the whole sensor; 0 to let go.
        """
        self._presses[sensor] = force

    def _step_slowly(self, dt: float) -> None:
        super()._step_slowly(dt)
        self._time += dt
        hottest = max(motor.case for motor in self._motors)
        if hottest > _FANS_ON:
            self.fans = True
        elif hottest < _FANS_OFF:
            self.fans = False

    @property
    def motor_v(self) -> float:
        """Voltage at the motors, V, behind the buck converter."""
        return min(self.supply_v, _BUCK_OUTPUT)

    @property
    def current(self) -> float:
        """Current from the supply, A: static, mechanical power and losses; at most 10 A."""
        power = _STATIC_POWER
        for motor in self._motors:
            part = motor.torque / motor.model.tau_max
            # regenerated power is lost in the motor
            power += motor.model.copper_loss * part * part + max(0.0, motor.torque * motor.joint.dq)
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
    def untouched(self) -> Floats:
        """The pressure at this time if nothing touched the hand, read-only."""
        return untouched(self.side, self._time)

    @property
    def pressure(self) -> Floats:
        """Pa, absolute, shape (9, 12), NaN where there is no element.

        The first joint of a finger (thumb_1 for the thumb) presses its pad against the object,
        the second its tip, which raises it above :attr:`untouched`. An element measures 10 g to
        2500 g: less changes nothing, more reads as the maximum.
        """
        torques = [motor.contact() for motor in self._motors]
        key = torques + self._presses
        rest = self.untouched
        if key == self._touched and rest is self._rest:
            return self._felt.copy()
        forces = [torques[joint] / lever for joint, lever in _TOUCH]
        palm = sum(forces[i] for i in _ON_PALM) - _PALM_FROM
        forces += [palm if palm > 0.0 else 0.0] * (len(DEX3_1.sensors) - len(forces))
        forces = [force + press for force, press in zip(forces, self._presses, strict=True)]
        felt: Floats = _SHARES * np.array(forces)[:, np.newaxis]
        np.minimum(felt, _FORCE_MAX, out=felt)
        felt[felt < _FORCE_MIN] = 0.0
        felt /= _ELEMENT_AREA
        felt += rest
        self._touched, self._rest, self._felt = key, rest, felt
        return felt.copy()

    @property
    def sensor_temperature(self) -> Floats:
        """Air temperature, °C, shape (9, 12), NaN where there is no element."""
        return _SENSOR_TEMPERATURE.copy()

    def _extra_state(self) -> dict[str, Any]:
        return {
            "pressure": self.pressure,
            "sensor_temperature": self.sensor_temperature,
            "sensor_lost": np.zeros(len(DEX3_1.sensors), dtype=np.uint32),
            "imu": self.imu,
            "supply": self.supply,
        }


_IMU = ImuState(accelerometer=(0.0, 0.0, _GRAVITY), temperature=AMBIENT)
