"""Decode the parts of hand states that a replay supervises: positions, torques and faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dexkit.hand import MotorError, Side
from dexkit.messages import message_type
from dexkit.models import Dialect, ModeByte, model

__all__ = ["DecodedHand", "HandStateCodec"]

Values = tuple[float, ...]


@dataclass(frozen=True)
class DecodedHand:
    """One state of a hand.

    :param q: rad; ``tau`` N·m; per joint.
    :param fault: :class:`~dexkit.hand.MotorError` bits per joint.
    :param tripped: per joint, whether the time-out protection has stopped it.
    """

    q: Values
    tau: Values
    fault: tuple[int, ...] = ()
    tripped: tuple[bool, ...] = ()

    def problem(self, names: Sequence[str]) -> str:
        """Describe the fault of the hand; empty if there is none.

        :param names: of the joints.
        """
        for name, bits in zip(names, self.fault, strict=False):
            if bits:
                known = [str(e.name).lower() for e in MotorError if e and bits & e]
                return f"{name} reports {', '.join(known) or hex(bits)}"
        stopped = [n for n, is_so in zip(names, self.tripped, strict=False) if is_so]
        if stopped:
            return f"its time-out protection has stopped {', '.join(stopped)}"
        return ""


class HandStateCodec:
    """Decodes the states of a dialect."""

    def __init__(self, spoken: Dialect) -> None:
        hand = model(spoken.model)
        self._dialect = spoken
        self._joints = len(hand.joints[Side.LEFT])
        self._type = message_type(spoken.state_type)
        self._units = spoken.torque_units or (1.0,) * self._joints
        self._ris = spoken.mode_byte is ModeByte.RIS
        self.topics = {s: spoken.topics(s)[1] for s in Side}

    def seen(self, topic: str, data: bytes) -> dict[Side, DecodedHand]:
        """The hands in a state message; a hand beyond its end is left out.

        :raises WireError: it is not of the dialect's state type.
        """
        message = self._type.decode(data)
        motors = self._type.motors(message)
        found = {}
        for side, its_topic in self.topics.items():
            first = self._dialect.index[side]
            mine = motors[first : first + self._joints]
            if its_topic == topic and len(mine) == self._joints:
                found[side] = self._hand(mine)
        return found

    def _hand(self, motors: Sequence[Any]) -> DecodedHand:
        return DecodedHand(
            q=tuple(m.q for m in motors),
            tau=tuple(m.tau_est * unit for m, unit in zip(motors, self._units, strict=True)),
            # the second word is a motor's own, the first one of a gripper's reserve
            # (dexkit.service.dialects)
            fault=tuple(
                int(m.motorstate if hasattr(m, "motorstate") else m.reserve[0]) for m in motors
            ),
            tripped=tuple(bool(m.mode & 0x80) for m in motors) if self._ris else (),
        )
