"""Encode the state of the mechanics as Dex3-1 state frames, fast enough for 1000 Hz.

The bytes equal those of :meth:`dexkit.wire.dex3_usb.HandCodec.encode_state`, which encodes a whole
:class:`~dexkit.hand.HandState` per frame; this writes only the fields that change.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from dexkit.emulators.dex3_mcu.wiring import Wiring
from dexkit.emulators.dex3_mechanics import Dex3Mechanics
from dexkit.hand import MotorError
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import (
    MOTOR_STATE,
    N_BUSES,
    SENSOR_STATE,
    STATE,
    STATE_BUS_SIZE,
    units,
)
from dexkit.wire.ris import NUDGE

__all__ = ["AnswerWriter"]

_TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)


class AnswerWriter:
    """Encodes the state frames of one hand.

    :param wiring: bus and id of each joint and sensor, and how the motors are mounted.
    :param model: ``mode[0]`` of the frames.
    :param no_value: counts in a slot without an element.
    """

    def __init__(
        self,
        mechanics: Dex3Mechanics,
        wiring: Wiring,
        model: int,
        no_value: int = units.NO_VALUE,
    ) -> None:
        self._mechanics = mechanics
        self._no_value = no_value
        self._map = bus_map = wiring.bus_map
        mounting = wiring.mounting
        self._model = model
        self._factors = [
            tuple(
                sign * scale.factor(ratio) * NUDGE
                for scale in (units.TORQUE, units.VELOCITY, units.POSITION)
            )
            for sign, ratio in zip(mounting.signs, mounting.ratios, strict=True)
        ]
        self._zeros = [
            offset * units.POSITION.factor(ratio) * NUDGE
            for offset, ratio in zip(mounting.offsets, mounting.ratios, strict=True)
        ]
        self._pressure = b""
        self._sensors = [b""] * len(bus_map.sensors)

    def frame(
        self,
        motors: Sequence[int],
        tripped: Sequence[bool],
        sensors: Collection[int] | None = None,
    ) -> bytes:
        """Encode a state frame with the present state.

        :param motors: indices of the motors that answer.
        :param tripped: whether each motor's time-out protection has tripped.
        :param sensors: indices of the sensors that answer; all by default.
        """
        mechanics = self._mechanics
        buses = [b""] * N_BUSES
        packets = self._motor_packets(tripped)
        for index in motors:
            buses[self._map.motors[index][0]] += packets[index]
        self._renew_sensors()
        for index, ((bus, _), packet) in enumerate(
            zip(self._map.sensors, self._sensors, strict=True)
        ):
            if sensors is None or index in sensors:
                buses[bus] += packet
        supply, imu = mechanics.supply, mechanics.imu
        data = STATE.pack(
            STATE.head,
            self._model,
            int(any(tripped)),
            bytes([mechanics.fans] * 2),
            *map(len, buses),
            b"".join(bus.ljust(STATE_BUS_SIZE, b"\0") for bus in buses),
            *(units.VOLTAGE.encode(v) for v in (supply.power_v, supply.system_v, supply.device_v)),
            units.CURRENT.encode(supply.power_a),
            *(units.ACCELERATION.encode(a) for a in imu.accelerometer),
            *(units.ROTATION.encode(w) for w in imu.gyroscope),
            0,
            *(0,) * 4,
            0,
        )
        return data[:-4] + crc32_words(data[2:-4]).to_bytes(4, "little")

    def _motor_packets(self, tripped: Sequence[bool]) -> list[bytes]:
        mechanics = self._mechanics
        volts = units.MOTOR_VOLTAGE.encode(mechanics.motor_v)
        pack = MOTOR_STATE.struct.pack
        packets = []
        for (_, number), factors, zero, mode, trip, error, case, winding, tau, dq, q in zip(
            self._map.motors,
            self._factors,
            self._zeros,
            mechanics.mode,
            tripped,
            mechanics.errors,
            mechanics.temperature.tolist(),
            mechanics.winding_temperature.tolist(),
            mechanics.tau.tolist(),
            mechanics.dq.tolist(),
            mechanics.q.tolist(),
            strict=True,
        ):
            torque, speed, position = factors
            data = pack(
                MOTOR_STATE.head,
                number | mode << 4 | trip << 7,
                _clamp(case, -128, 127),
                _clamp(winding, 0, 255),
                volts,
                _clamp(tau * torque, -0x8000, 0x7FFF),
                _clamp(dq * speed, -0x8000, 0x7FFF),
                _clamp(q * position + zero, -0x80000000, 0x7FFFFFFF),
                error | _TRIPPED if trip else error,
                0,
                0,
                0,
            )
            packets.append(data[:-4] + crc32_words(data[2:-4]).to_bytes(4, "little"))
        return packets

    def _renew_sensors(self) -> None:
        """Encode the sensor packets again if a pressure has changed."""
        pressure = self._mechanics.pressure
        key = pressure.tobytes()
        if key == self._pressure:
            return
        self._pressure = key
        scale = units.PRESSURE
        with np.errstate(invalid="ignore"):
            counts = np.clip(pressure * (scale.factor() * NUDGE), scale.low, scale.high)
            counts = np.floor(counts)
        # a real reading is never "no value"
        counts[np.isin(counts, (units.NO_VALUE, units.NO_VALUE_COUNTS))] += 1.0
        counts[np.isnan(pressure)] = self._no_value
        rows = counts.astype("<u2")
        heat = np.nan_to_num(self._mechanics.sensor_temperature).astype("i1")
        for i, (_, number) in enumerate(self._map.sensors):
            data = SENSOR_STATE.head + bytes([number, 0]) + rows[i].tobytes() + heat[i].tobytes()
            self._sensors[i] = data + crc32_words(data).to_bytes(4, "little")


def _clamp(value: float, low: int, high: int) -> int:
    count = int(value)
    return low if count < low else high if count > high else count
