"""Drive an Inspire RH56 over any register transport (docs/inspire.md).

Each exchange writes the goals where they have changed and reads the angles; some exchanges read
errors and temperatures as well. :mod:`dexkit.drivers.inspire_serial` and
:mod:`dexkit.drivers.inspire_modbus` access the registers.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dexkit.clock import Clock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel
from dexkit.drivers.goal_hand import GoalHand
from dexkit.drivers.setting_parsers import Parsers
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, JointMode, MotorError, Side
from dexkit.models import INSPIRE_DFX, HandModel
from dexkit.wire import rh56
from dexkit.wire.rh56 import Error, Register

__all__ = ["COMMON_SETTINGS", "InspireHand", "InspireSettings"]

log = logging.getLogger(__name__)

_HEALTH = int(Register.TEMPERATURE) + rh56.JOINTS - int(Register.ERROR)
"""Bytes from the errors to the end of the temperatures."""


@dataclass(frozen=True)
class InspireSettings:
    """Settings of an :class:`InspireHand`.

    :param device: path or address; see the driver.
    :param id: of the hand on the line, or Modbus' unit.
    :param speed: of every joint, 0 to 1000; None leaves what the device has.
    :param force: limit of every joint, 0 to 1000; None leaves what the device has.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    id: int = 1
    speed: int | None = rh56.FULL
    force: int | None = None
    timeout: float = 0.03

    def __post_init__(self) -> None:
        if self.id not in self.ids:
            raise UsageError(f"id must be {self.ids[0]} to {self.ids[-1]}, not {self.id}")
        for name, value in (("speed", self.speed), ("force", self.force)):
            if value is not None and not 0 <= value <= rh56.FULL:
                raise UsageError(f"{name} must be 0 to {rh56.FULL}, not {value}")
        if not 1e-3 <= self.timeout <= 1:
            raise UsageError(f"timeout must be 0.001 to 1 s, not {self.timeout:g}")

    @property
    def ids(self) -> range:
        """Valid ids."""
        return rh56.IDS


class InspireHand(GoalHand):
    """An Inspire RH56 over any register transport; its class names the model.

    :param side: which hand.
    :param configuration: place, id, speed, limit of force and time-out.

    ``open`` clears errors, sets speed and limit of force, and reads the angles. No motion.
    ``close`` has every joint hold where it is.
    """

    model: ClassVar[HandModel] = INSPIRE_DFX
    health_every: ClassVar[int] = 20
    """Errors and temperatures are read once in so many exchanges."""

    def __init__(
        self,
        side: Side,
        configuration: InspireSettings,
        *,
        clock: Clock | None = None,
    ) -> None:
        super().__init__("RH56", self.model, side, configuration.timeout, clock)
        self.configuration = configuration
        self._turn = 0
        self._errors = [Error(0)] * rh56.JOINTS
        self._celsius = [float("nan")] * rh56.JOINTS

    # --- access to the registers

    @abstractmethod
    def _write(
        self, channel: Channel, register: Register, data: bytes, before: WriteDeadline | None
    ) -> None:
        """Write bytes to consecutive registers.

        :raises HandError: the write failed, or was not acknowledged.
        """

    @abstractmethod
    def _read(self, channel: Channel, register: int, count: int) -> bytes:
        """Read ``count`` bytes of consecutive registers.

        :raises HandError: there is no answer.
        """

    # --- one hand

    def _prepare(self) -> None:
        self._turn = 0
        for register, value in (
            (Register.SPEED_SET, self.configuration.speed),
            (Register.FORCE_SET, self.configuration.force),
        ):
            if value is not None:
                self._put(register, [value] * rh56.JOINTS)
        self._read_angles()
        self._read_health()
        if any(self._errors):
            # a joint that has its power again must not go on to a goal of before
            self._put_goals(self._positions)
            self._ask(lambda to: self._write(to, Register.CLEAR_ERROR, b"\x01\x00", None))
            self._read_health()

    def _measure(self, command: HandCommand) -> HandState:
        if self._turn % self.health_every == 0:
            self._read_health()
        self._turn += 1
        self._read_angles()
        driven = command.mode == JointMode.FOC
        return HandState.from_values(
            np.array(self._positions) / rh56.FULL,
            stamp=self._clock.now(),
            temperature=self._celsius,
            mode=driven.astype(int).tolist(),
            fault=[self._fault(error) for error in self._errors],
        )

    def _holding_goals(self) -> list[int]:
        self._read_angles()
        return self._positions

    def _put_goals(self, goals: list[int], before: WriteDeadline | None = None) -> None:
        self._put(Register.ANGLE_SET, goals, before)

    def _goals(self, command: HandCommand) -> list[int]:
        found = []
        for i, (mode, q) in enumerate(zip(command.mode.tolist(), command.q.tolist(), strict=True)):
            if mode == JointMode.FOC:
                self._held[i] = None
                found.append(round(min(max(q, 0.0), 1.0) * rh56.FULL))
            else:
                found.append(self._hold(i))
        return found

    @staticmethod
    def _fault(error: Error) -> int:
        found = MotorError.NONE
        for bit, meaning in rh56.FAULTS.items():
            if error & bit:
                found |= meaning
        return int(found)

    def _read_angles(self) -> None:
        data = self._ask(lambda to: self._read(to, Register.ANGLE_ACT, 2 * rh56.JOINTS))
        self._positions = [min(max(angle, 0), rh56.FULL) for angle in rh56.numbers(data)]

    def _read_health(self) -> None:
        self._take_health(self._ask(lambda to: self._read(to, Register.ERROR, _HEALTH)))

    def _take_health(self, data: bytes) -> None:
        """Take the registers from the errors to the temperatures."""
        errors = [Error(value) for value in data[: rh56.JOINTS]]
        if errors != self._errors:
            names = {
                joint.name: error.name or f"bits {int(error):#x}"
                for joint, error in zip(self._spec.joints, errors, strict=True)
                if error
            }
            if names:
                log.error("the hand reports: %s", names)
            else:
                log.warning("the hand reports no error any more")
        self._errors = errors
        self._celsius = [float(value) for value in data[-rh56.JOINTS :]]

    def _put(
        self, register: Register, values: list[int], before: WriteDeadline | None = None
    ) -> None:
        data = np.array(values, "<i2").tobytes()
        self._ask(lambda to: self._write(to, register, data, before))


COMMON_SETTINGS: Parsers = {
    "speed": (int, f"of every joint, 0 to {rh56.FULL} (default {rh56.FULL})"),
    "force": (int, f"limit of every joint, 0 to {rh56.FULL} (default: what the hand has)"),
}
