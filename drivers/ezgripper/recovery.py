"""When a servo that has shut itself down may be restarted.

After a shutdown (overload, overheating, electrical shock) only a reboot brings torque back
(docs/sources/mx64-ezgripper.md#b6). Rebooting at once and for ever would heat the motor against the
same load, so each further fault within a while waits twice as long, and a hot motor first cools
down. Pure logic: no device, no clock of its own.
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
    """The servo's error bits in the vocabulary of all hands (docs/sources/unitree-dex.md#b6).

    The servo keeps an input voltage error until it is rebooted; it is reported while the
    voltage is outside the limits.

    :param voltage: present supply, V.
    :param voltage_min: the servo's limits, V.
    :param voltage_max: see ``voltage_min``.
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
    """The error bits in words."""
    names = [e.name.lower().replace("_", " ") for e in HardwareError if e & error and e.name]
    return " and ".join(names) or (f"unknown error 0x{error:02X}" if error else "no error")


@dataclass
class RebootPolicy:
    """Whether a reboot is due.

    It limits reboots and is not only a delay between attempts: it forgets old faults, and an
    overheated servo must cool down first. The delays are those of a
    :class:`~dexkit.backoff.Backoff`.

    :param first: seconds from a fault to its reboot.
    :param factor: how much longer each further fault waits.
    :param longest: bound of that, seconds.
    :param forget: seconds without a fault after which the next counts as the first.
    :param cool: °C below the temperature limit at which an overheated servo may go on.
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
        """Seconds that the present (or last) fault waits."""
        return self._delay

    def fault(self, now: float) -> None:
        """A fault has appeared (or a reboot has not helped)."""
        if now - self._last > self.forget:
            self._backoff.reset()
        self._delay = self._backoff.next()
        self._last = now
        self._due = now + self._delay

    def due(self, now: float, error: int, temperature: float, temperature_limit: float) -> bool:
        """Whether to reboot now.

        :param temperature: present, °C.
        """
        if error & HardwareError.OVERHEATING and temperature > temperature_limit - self.cool:
            return False
        return now >= self._due
