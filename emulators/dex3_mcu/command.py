"""Decode ordinary Dex3-1 command frames, fast enough for 1000 Hz.

It handles the frames that a driver sends: every packet intact and for an existing motor.
:meth:`dexkit.wire.dex3_usb.HandCodec.decode_command` handles all others.
"""

from __future__ import annotations

import struct
from typing import TypeAlias

from dexkit.emulators.dex3_mcu.wiring import Wiring
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import COMMAND_LAYOUTS, MOTOR_CMD, N_BUSES, units

__all__ = ["CommandReader", "MotorCommand"]

MotorCommand: TypeAlias = tuple[int, int, bool, float, float, float, float, float]
"""Joint, status, bit 7, q, dq, tau, kp, kd: at the joint, SI units."""

_SIZES = struct.Struct(f"<{N_BUSES}I")
_SIZES_AT = COMMAND_LAYOUTS[0].structure.offsets["cmd_size"]
_FIRST, _BEHIND = MOTOR_CMD.covered


class CommandReader:
    """Decodes command frames of one hand."""

    def __init__(self, wiring: Wiring) -> None:
        self._layouts = {layout.size: layout for layout in COMMAND_LAYOUTS}
        mounting = wiring.mounting
        turning = (units.POSITION, units.VELOCITY, units.TORQUE)
        gains = (units.STIFFNESS, units.DAMPING)
        self._motors = {
            address: (
                joint,
                [sign / scale.factor(ratio) for scale in turning]
                + [1.0 / scale.factor(ratio) for scale in gains],
                sign * offset,
            )
            for joint, (address, sign, offset, ratio) in enumerate(
                zip(
                    wiring.bus_map.motors,
                    mounting.signs,
                    mounting.offsets,
                    mounting.ratios,
                    strict=True,
                )
            )
        }

    def read(self, data: bytes) -> list[MotorCommand] | None:
        """Return the motor commands in the frame's order; None if the frame is not ordinary."""
        layout = self._layouts.get(len(data))
        if layout is None or not _intact(data, layout.structure.covered):
            return None
        size = MOTOR_CMD.size
        unpack = MOTOR_CMD.struct.unpack
        commands: list[MotorCommand] = []
        for bus, used in enumerate(_SIZES.unpack_from(data, _SIZES_AT)):
            if used % size or used > layout.bus_size:
                return None
            start = layout.bus_offset(bus)
            for at in range(start, start + used, size):
                packet = data[at : at + size]
                head, mode, _, tau, dq, q, kp, kd, crc = unpack(packet)
                motor = self._motors.get((bus, mode & 0x0F))
                if motor is None or head != MOTOR_CMD.head:
                    return None
                if crc32_words(packet[_FIRST:_BEHIND]) != crc:
                    return None
                joint, (per_q, per_dq, per_tau, per_kp, per_kd), zero = motor
                commands.append(
                    (
                        joint,
                        mode >> 4 & 7,
                        mode > 0x7F,
                        q * per_q - zero,
                        dq * per_dq,
                        tau * per_tau,
                        kp * per_kp,
                        kd * per_kd,
                    )
                )
        return commands


def _intact(data: bytes, covered: tuple[int, int]) -> bool:
    first, behind = covered
    return crc32_words(data[first:behind]) == int.from_bytes(data[behind:], "little")
