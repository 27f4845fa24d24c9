"""Decide when a servo in hardware shutdown may be rebooted.

After a shutdown (overload, overheating, electrical shock) only a reboot restores torque
(docs/sources/mx64-ezgripper.md#b6). Immediate and endless reboots would overheat the motor under
the same load, so the delay doubles with each further fault, and a hot motor must cool down first.
No I/O and no clock of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dexkit.backoff import Backoff
from dexkit.hand import MotorError
from dexkit.wire.mx64 import HardwareError

__all__ = ["RebootPolicy", "describe", "motor_error"]

_MOTOR_ERRORS = {
    HardwareError.OVERHEATING: MotorError.WINDING_OVERTEMPERATURE,
    # the MX-64's encoder sits on the output shaft (docs/sources/mx64-ezgripper.md#b1)
    HardwareError.ENCODER: MotorError.OUTPUT_ENCODER,
    # "electrical shock on the circuit, or insufficient power to operate the motor"
    # (docs/sources/mx64-ezgripper.md#b6)
    HardwareError.ELECTRICAL_SHOCK: MotorError.UNDERVOLTAGE,
    HardwareError.OVERLOAD: MotorError.OVERCURRENT,
}


def motor_error(error: int, voltage: float, voltage_min: float, voltage_max: float) -> MotorError:
    """Translate the servo's error bits to :class:`MotorError` (docs/sources/unitree-dex.md#b6).

    The servo keeps an input voltage error until it is rebooted; it is reported only while the
    voltage is outside the limits.

    :param voltage: present supply voltage, V.
    :param voltage_min: the servo's lower limit, V.
    :param voltage_max: the servo's upper limit, V.
    """
    bits = MotorError.NONE
    if not error:
        return bits
    if error & HardwareError.INPUT_VOLTAGE:
        if voltage > voltage_max:
            bits |= MotorError.OVERVOLTAGE
        elif voltage < voltage_min:
            bits |= MotorError.UNDERVOLTAGE
    for servo_bit, bit in _MOTOR_ERRORS.items():
        if error & servo_bit:
            bits |= bit
    return bits


def describe(error: int) -> str:
    """Describe the error bits in words."""
    names = [e.name.lower().replace("_", " ") for e in HardwareError if e & error and e.name]
    return " and ".join(names) or (f"unknown error 0x{error:02X}" if error else "no error")


@dataclass
class RebootPolicy:
    """Limits reboots after faults.

    The delays are those of a :class:`~dexkit.backoff.Backoff`; in addition the policy forgets old
    faults, and an overheated servo must cool down first.

    :param first: seconds from the first fault to its reboot.
    :param factor: factor by which each further fault's delay grows.
    :param longest: longest delay, seconds.
    :param forget: seconds without a fault after which the next counts as the first.
    :param cool: °C below the temperature limit at which an overheated servo may be rebooted.
    """

    first: float = 0.5
    factor: float = 2.0
    longest: float = 30.0
    forget: float = 60.0
    cool: float = 10.0

    def __post_init__(self) -> None:
        self._backoff = Backoff(self.first, self.longest, self.factor)
        self._delay = self.first
        self._due = -math.inf
        self._last = -math.inf

    @property
    def delay(self) -> float:
        """Delay of the present (or last) fault, seconds."""
        return self._delay

    def fault(self, now: float) -> None:
        """Note a fault, or a reboot that has not cleared it."""
        if now - self._last > self.forget:
            self._backoff.reset()
        self._delay = self._backoff.next()
        self._last = now
        self._due = now + self._delay

    def due(self, now: float, error: int, temperature: float, temperature_limit: float) -> bool:
        """Whether a reboot is due.

        :param temperature: present, °C.
        """
        if error & HardwareError.OVERHEATING and temperature > temperature_limit - self.cool:
            return False
        return now >= self._due
