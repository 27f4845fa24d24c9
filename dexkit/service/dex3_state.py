"""The state of a Dex3-1 as the bytes of a ``HandState_``, fast enough for 1000 Hz.

Seven motors and nine sensor packets are some 340 values. To make a message object of them and
encode that costs a thread that publishes 1000 times a second a third of its time
(``python -m benchmarks codec``), so here the values are copied into the bytes of a message that
was encoded once.

What each field holds is in docs/dex3.md.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from dexkit.hand import Floats, HandSpec, HandState, MotorError
from dexkit.messages import message_type, unitree_hg

__all__ = ["NO_VALUE", "Dex3StateEncoder"]

NO_VALUE = 30000.0  #: the pressure of a slot without a sensor element (seed 002)

_TYPE = message_type("unitree_hg::msg::dds_::HandState_")
_BESIDE_NO_VALUE = np.nextafter(np.float32(NO_VALUE), np.float32(np.inf))
_FLOAT_MAX = float(np.finfo(np.float32).max)
_U32 = 0xFFFFFFFF
_LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
_TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)
_TAXELS = 12  # of a PressSensorState_

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
_REST = np.dtype(
    [
        ("imu", "<f4", 13),  # quaternion, gyroscope, accelerometer, rpy
        ("imu_temperature", "<i2"),
        ("padding", "u1", 2),
        ("supply", "<f4", 4),
        ("error", "<u4", 2),
        ("reserve", "<u4", 2),
    ]
)


class Dex3StateEncoder:
    """Encodes states of one hand. May be called from several threads.

    :param known: also what the vendor's service does not say: ddq, missed exchanges, whether q
        is predicted.
    """

    def __init__(self, spec: HandSpec, *, known: bool = True) -> None:
        n, sensors = spec.n_joints, spec.n_sensors
        blank = unitree_hg.HandState_(
            [unitree_hg.MotorState_() for _ in range(n)],
            [unitree_hg.PressSensorState_() for _ in range(sensors)],
        )
        self._lock = threading.Lock()
        self._known = known
        self._bytes = bytearray(_TYPE.encode(blank))
        at = 8
        self._motors = np.frombuffer(self._bytes, _MOTOR, n, at)
        at += n * _MOTOR.itemsize + 4
        self._sensors = np.frombuffer(self._bytes, _SENSOR, sensors, at)
        at += sensors * _SENSOR.itemsize
        self._rest = np.frombuffer(self._bytes, _REST, 1, at)[0:1]
        # looked up once: a field of a structured array costs as much as its values
        self._mode = self._motors["mode"]
        self._values = self._motors["values"].T
        self._celsius = self._motors["temperature"].T
        self._vol = self._motors["vol"]
        self._motorstate = self._motors["motorstate"]
        self._predicted = self._motors["reserve"][:, 0]
        self._pressure = self._sensors["pressure"]
        self._taxel_celsius = self._sensors["temperature"]
        self._lost = self._sensors["lost"]
        self._imu = self._rest["imu"][0]
        self._imu_celsius = self._rest["imu_temperature"]
        self._supply = self._rest["supply"][0]
        self._error = self._rest["error"][0]
        self._floats = np.zeros((5, n))
        self._degrees = np.zeros((2, n))
        self._nothing = np.full(n, np.nan)

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
            self._put_motors(state, fault, tripped)
            if len(self._sensors):
                self._put_sensors(state)
            self._put_rest(state, fault, missed)
            return bytes(self._bytes)

    def _put_motors(self, s: HandState, fault: Sequence[int], tripped: Sequence[bool]) -> None:
        self._mode[:] = [
            i | (int(status) & 7) << 4 | (0x80 if bits & _TRIPPED else 0)
            for i, (status, bits) in enumerate(zip(s.mode.tolist(), fault, strict=True))
        ]
        if any(tripped):
            self._mode[np.array(tripped, dtype=bool)] |= 0x80
        floats = self._floats
        floats[0] = s.q
        floats[1] = s.dq
        floats[2] = s.ddq if self._known else 0.0
        floats[3] = s.tau_est
        floats[4] = s.voltage
        _finite(floats)
        self._values[:] = floats[:4]
        self._vol[:] = floats[4]
        degrees = self._degrees
        degrees[0] = s.temperature
        degrees[1] = s.winding_temperature if s.winding_temperature is not None else self._nothing
        self._celsius[:] = _whole(degrees)
        self._motorstate[:] = [bits & _U32 for bits in fault]
        if self._known:
            self._predicted[:] = 0 if s.measured else 1

    def _put_sensors(self, s: HandState) -> None:
        if s.pressure is None:
            self._pressure[:] = NO_VALUE
        else:
            known = np.isfinite(s.pressure)
            self._pressure[:] = np.clip(s.pressure, -_FLOAT_MAX, _FLOAT_MAX)
            # a real reading must not look like none
            np.copyto(self._pressure, _BESIDE_NO_VALUE, where=self._pressure == NO_VALUE)
            np.copyto(self._pressure, NO_VALUE, where=~known)
        if s.sensor_temperature is None:
            self._taxel_celsius[:] = 0.0
        else:
            self._taxel_celsius[:] = _finite(s.sensor_temperature.copy())
        self._lost[:] = s.sensor_lost if s.sensor_lost is not None else 0

    def _put_rest(self, s: HandState, fault: Sequence[int], missed: int) -> None:
        if s.imu is None:
            self._imu[:] = 0.0
            self._imu_celsius[:] = 0
        else:
            i = s.imu
            values = np.array([*i.quaternion, *i.gyroscope, *i.accelerometer, *i.rpy])
            self._imu[:] = _finite(values)
            self._imu_celsius[:] = _whole(np.array([i.temperature]))
        if s.supply is None:
            self._supply[:] = 0.0
        else:
            p = s.supply
            self._supply[:] = _finite(np.array([p.power_v, p.power_a, p.system_v, p.device_v]))
        link = _LINK if all(bits & _LINK for bits in fault) else 0
        self._error[:] = ((s.error | link) & _U32, min(missed, _U32) if self._known else 0)


def _finite(values: Floats) -> Floats:
    """``values``, changed in place to what float32 can hold; 0 where one is not known."""
    unknown = ~np.isfinite(values)
    np.minimum(values, _FLOAT_MAX, out=values)
    np.maximum(values, -_FLOAT_MAX, out=values)
    np.copyto(values, 0.0, where=unknown)
    return values


def _whole(values: Floats) -> Floats:
    """``values``, changed in place to what int16 can hold."""
    _finite(values)
    np.rint(values, out=values)
    np.minimum(values, 32767, out=values)
    np.maximum(values, -32768, out=values)
    return values
