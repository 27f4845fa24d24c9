"""The findings of a bring-up so far, so that it can be resumed, replayed and stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from dexkit.records import as_plain, to_record

__all__ = ["Findings", "MotorFound", "TravelFound"]


@dataclass(frozen=True)
class MotorFound:
    """Which joint a motor moves.

    :param sign: +1 if q rises with the motor's position, else -1.
    """

    joint: str
    sign: int

    def __post_init__(self) -> None:
        if self.sign not in (1, -1):
            raise ValueError(f"the sign {self.sign}")


@dataclass(frozen=True)
class TravelFound:
    """Properties of a joint derived from its stops.

    :param ratio: its gear ratio.
    :param offset: the motor's position where q = 0, rad at the joint.
    :param low: lowest q that was reached, and ``high`` the highest.
    :param confirmed: the person saw the joint at its zero.
    """

    ratio: float
    offset: float
    low: float
    high: float
    confirmed: bool


@dataclass
class Findings:
    """All that is known of one hand.

    :ivar motors: by address.
    :ivar travel: by joint; of a joint that more than one motor moves, by motor.
    :ivar sensors: address of each place's sensor; None where the person has skipped it.
    :ivar answers: what was answered to each question, by its key.
    """

    motors: dict[str, MotorFound] = field(default_factory=dict)
    travel: dict[str, TravelFound] = field(default_factory=dict)
    sensors: dict[str, str | None] = field(default_factory=dict)
    answers: dict[str, str] = field(default_factory=dict)

    def motors_of(self, joint: str) -> list[str]:
        """Addresses of all motors that move a joint."""
        return [address for address, found in self.motors.items() if found.joint == joint]

    def to_document(self) -> dict[str, Any]:
        """Everything but the answers, for a JSON file."""
        document: dict[str, Any] = as_plain(_Details(self.motors, self.travel, self.sensors))
        return document

    @classmethod
    def from_document(cls, document: Mapping[str, Any], answers: Mapping[str, str]) -> Findings:
        """Parse what :meth:`to_document` wrote.

        :raises UsageError: it is something else.
        """
        hint = "start again: dexkit bringup ... --restart"
        found = to_record(document, _Details, "the findings of a bring-up", hint=hint)
        return cls(found.motors, found.travel, found.sensors, dict(answers))


class _Details(msgspec.Struct):
    motors: dict[str, MotorFound] = {}
    travel: dict[str, TravelFound] = {}
    sensors: dict[str, str | None] = {}
