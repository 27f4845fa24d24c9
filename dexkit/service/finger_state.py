"""Encode the state of a hand with several joints as a ``HandState_``, fast enough for 1000 Hz.

The seven motors and nine sensor packets of a Dex3-1 are some 340 values, 1000 times a second for
each hand. Here they are copied into the bytes of a message that was encoded once, array by array;
a message object for each state would have to be filled value by value.

What each field holds is in docs/dex3.md, and for the Dex5-1 in docs/dex5.md.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats, HandSpec, HandState, ImuState, MotorError, SupplyState
from dexkit.messages import message_type, unitree_hg
from dexkit.pressure import NO_VALUE

__all__ = ["FingerStateEncoder"]

_TYPE = message_type("unitree_hg::msg::dds_::HandState_")
_BESIDE_NO_VALUE = np.nextafter(np.float32(NO_VALUE), np.float32(np.inf))
_FLOAT_MAX = float(np.finfo(np.float32).max)
_U32 = 0xFFFFFFFF
_LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
_TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)
_TAXELS = 12  # of a PressSensorState_
_NO_IMU = ImuState(quaternion=(0.0, 0.0, 0.0, 0.0))
_NO_SUPPLY = SupplyState()

# The members after the 4-byte header and the sequence lengths; every one is a multiple of 4 and
# aligned, so that CDR adds no padding but what stands here.
_MOTOR = np.dtype(
    [
        ("mode", "u1"),
        ("padding", "u1", 3),
        ("values", "<f4", 4),  # q, dq, ddq, tau_est
        ("temperature", "<i2", 2),
        ("vol", "<f4"),
        ("sensor", "<u4", 2),
        ("motorstate", "<u4"),
        ("reserve", "<u4", 4),
    ]
)
_SENSOR = np.dtype(
    [
        ("pressure", "<f4", _TAXELS),
        ("temperature", "<f4", _TAXELS),
        ("lost", "<u4"),
        ("reserve", "<u4"),
    ]
)
# imu: quaternion, gyroscope, accelerometer, rpy, temperature; supply: V, A, V, V; error; reserve
_REST = Struct("<13fh2x4f4I")


class FingerStateEncoder:
    """Encodes states of one hand. May be called from several threads.

    :param known: also what the vendor's service does not publish: ddq, missed exchanges, whether q
        is predicted.
    :param ids: the mode byte is RIS_Mode, with id and time-out bit
        (docs/sources/unitree-dex.md#b4); else it is the bare status.
    :param torque_units: N·m in one unit of each motor's tau_est; empty for N·m throughout.
    """

    def __init__(
        self,
        spec: HandSpec,
        *,
        known: bool = True,
        ids: bool = True,
        torque_units: Sequence[float] = (),
    ) -> None:
        n, sensors = spec.n_joints, spec.n_sensors
        self._ids = ids
        self._torque_units = np.array(torque_units) if torque_units else None
        blank = unitree_hg.HandState_(
            [unitree_hg.MotorState_() for _ in range(n)],
            [unitree_hg.PressSensorState_() for _ in range(sensors)],
        )
        self._lock = threading.Lock()
        self._known = known
        self._bytes = bytearray(_TYPE.encode(blank))
        at = 8
        motors = np.frombuffer(self._bytes, _MOTOR, n, at)
        at += n * _MOTOR.itemsize + 4
        slots = np.frombuffer(self._bytes, _SENSOR, sensors, at)
        self._rest_at = at + sensors * _SENSOR.itemsize
        # looked up once: a field of a structured array costs as much as its values
        self._mode = motors["mode"]
        self._values = motors["values"].T
        self._celsius = motors["temperature"].T
        self._vol = motors["vol"]
        self._motorstate = motors["motorstate"]
        self._predicted = motors["reserve"][:, 0]
        self._pressure = slots["pressure"]
        self._taxel_celsius = slots["temperature"]
        self._lost = slots["lost"]
        self._floats = np.zeros((7, n))
        self._taxels = np.zeros((2, sensors, _TAXELS))
        # what the bytes hold now, because much of a state is often that of the one before
        self._flags: tuple[object, ...] = ()
        self._felt: tuple[object, ...] = ()
        self._last_rest: tuple[object, ...] = ()

    def encode(
        self,
        state: HandState,
        fault: Sequence[int],
        missed: int = 0,
        tripped: Sequence[bool] = (),
    ) -> bytes:
        """The sample for ``state``, encapsulation header included.

        :param fault: MotorError bits per joint.
        :param missed: exchanges missed since the last good one.
        :param tripped: per joint, whether the time-out protection has stopped it.
        """
        with self._lock:
            self._put_motors(state)
            self._put_flags(state, tuple(fault), tuple(tripped))
            if len(self._pressure):
                self._put_sensors(state)
            self._put_rest(state, fault, missed)
            return bytes(self._bytes)

    def _put_motors(self, s: HandState) -> None:
        floats = self._floats
        floats[0] = s.q
        floats[1] = s.dq
        floats[2] = s.ddq if self._known else 0.0
        floats[3] = s.tau_est if self._torque_units is None else s.tau_est / self._torque_units
        floats[4] = s.voltage
        floats[5] = s.temperature
        floats[6] = s.winding_temperature if s.winding_temperature is not None else 0.0
        _finite(floats)
        self._values[:] = floats[:4]
        self._vol[:] = floats[4]
        celsius = floats[5:]
        np.rint(celsius, out=celsius)
        np.minimum(celsius, 32767, out=celsius)
        np.maximum(celsius, -32768, out=celsius)
        self._celsius[:] = celsius

    def _put_flags(self, s: HandState, fault: tuple[int, ...], tripped: tuple[bool, ...]) -> None:
        modes = np.asarray(s.mode, dtype=np.uint8).tobytes()
        flags = (modes, fault, tripped, s.measured)
        if flags == self._flags:
            return
        self._flags = flags
        if self._ids:
            self._mode[:] = [
                i | (status & 7) << 4 | (0x80 if bits & _TRIPPED else 0)
                for i, (status, bits) in enumerate(zip(modes, fault, strict=True))
            ]
            if any(tripped):
                self._mode[np.array(tripped, dtype=bool)] |= 0x80
        else:
            self._mode[:] = list(modes)
        self._motorstate[:] = [bits & _U32 for bits in fault]
        if self._known:
            self._predicted[:] = 0 if s.measured else 1

    def _put_sensors(self, s: HandState) -> None:
        felt = tuple(
            None if values is None else values.tobytes()
            for values in (s.pressure, s.sensor_temperature, s.sensor_lost)
        )
        if felt == self._felt:
            return
        self._felt = felt
        pressure, celsius = self._taxels
        pressure[:] = s.pressure if s.pressure is not None else np.nan
        celsius[:] = s.sensor_temperature if s.sensor_temperature is not None else 0.0
        unknown = _finite(self._taxels)
        self._pressure[:] = pressure
        # a real reading must not look like none
        np.copyto(self._pressure, _BESIDE_NO_VALUE, where=self._pressure == NO_VALUE)
        np.copyto(self._pressure, NO_VALUE, where=unknown[0])
        self._taxel_celsius[:] = celsius
        self._lost[:] = s.sensor_lost if s.sensor_lost is not None else 0

    def _put_rest(self, s: HandState, fault: Sequence[int], missed: int) -> None:
        link = _LINK if all(bits & _LINK for bits in fault) else 0
        rest = (s.imu, s.supply, s.error | link, missed)
        if rest == self._last_rest:
            return
        self._last_rest = rest
        i = s.imu if s.imu is not None else _NO_IMU
        p = s.supply if s.supply is not None else _NO_SUPPLY
        inertial = (*i.quaternion, *i.gyroscope, *i.accelerometer, *i.rpy)
        _REST.pack_into(
            self._bytes,
            self._rest_at,
            *map(_known, inertial),
            min(max(round(_known(i.temperature)), -32768), 32767),
            *map(_known, (p.power_v, p.power_a, p.system_v, p.device_v)),
            (s.error | link) & _U32,
            min(missed, _U32) if self._known else 0,
            0,
            0,
        )


def _finite(values: Floats) -> NDArray[np.bool_]:
    """Change ``values`` in place to what float32 can hold, 0 where one is not known.

    :returns: which were not known.
    """
    unknown = ~np.isfinite(values)
    np.minimum(values, _FLOAT_MAX, out=values)
    np.maximum(values, -_FLOAT_MAX, out=values)
    np.copyto(values, 0.0, where=unknown)
    return unknown


def _known(value: float) -> float:
    return value if -_FLOAT_MAX <= value <= _FLOAT_MAX else 0.0
