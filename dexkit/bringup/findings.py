"""The findings of a bring-up so far, so that it can be resumed, replayed and stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dexkit.errors import UsageError

__all__ = ["Findings", "MotorFound", "TravelFound"]


@dataclass(frozen=True)
class MotorFound:
    """Which joint a motor moves.

    :param sign: +1 if q rises with the motor's position, else -1.
    """

    joint: str
    sign: int


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
        return {
            "motors": {address: vars(found) for address, found in self.motors.items()},
            "travel": {joint: vars(found) for joint, found in self.travel.items()},
            "sensors": dict(self.sensors),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any], answers: Mapping[str, str]) -> Findings:
        """Parse what :meth:`to_document` wrote.

        :raises UsageError: it is something else.
        """
        try:
            return cls(
                {
                    str(a): MotorFound(str(m["joint"]), {1: 1, -1: -1}[m["sign"]])
                    for a, m in document.get("motors", {}).items()
                },
                {
                    str(j): TravelFound(
                        float(t["ratio"]),
                        float(t["offset"]),
                        float(t["low"]),
                        float(t["high"]),
                        bool(t["confirmed"]),
                    )
                    for j, t in document.get("travel", {}).items()
                },
                {
                    str(p): None if a is None else str(a)
                    for p, a in document.get("sensors", {}).items()
                },
                dict(answers),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"cannot read the findings of a bring-up: {type(error).__name__}: {error}",
                hint="start again: dexkit bringup ... --restart",
            ) from error
