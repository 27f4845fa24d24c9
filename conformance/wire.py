"""The kit's own reading of the dialects: which member of which message is which motor.

Kept apart from the service on purpose: a mistake there must not be repeated here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dexkit.hand import Side
from dexkit.messages import MessageType, message_type
from dexkit.models import Dialect

__all__ = ["Motor", "Wire"]

# the sequence of motors in a message, and the class of one of them, by type
_SEQUENCE = {
    "unitree_go::msg::dds_::MotorCmds_": ("cmds", "unitree_go::msg::dds_::MotorCmd_"),
    "unitree_go::msg::dds_::MotorStates_": ("states", "unitree_go::msg::dds_::MotorState_"),
    "unitree_hg::msg::dds_::HandCmd_": ("motor_cmd", "unitree_hg::msg::dds_::MotorCmd_"),
    "unitree_hg::msg::dds_::HandState_": ("motor_state", "unitree_hg::msg::dds_::MotorState_"),
}


@dataclass(frozen=True)
class Motor:
    """One motor's command in the dialect's own units; the defaults are xr_teleoperate's gains."""

    q: float = 0.0
    dq: float = 0.0
    tau: float = 0.0
    kp: float = 5.0  # xr_teleoperate on Dex1 (facts/unitree-dex B.1)
    kd: float = 0.05
    mode: int = 0


LIMP = Motor(kp=0.0, kd=0.0)
"""No torque: what fills the place of a motor that is not meant."""


class Wire:
    """Encodes commands and reads states of one dialect."""

    def __init__(self, dialect: Dialect) -> None:
        self.dialect = dialect
        self.command: MessageType = message_type(dialect.cmd_type)
        self.state: MessageType = message_type(dialect.state_type)
        self.command_sequence, motor = _SEQUENCE[dialect.cmd_type]
        self.state_sequence, self._state_motor = _SEQUENCE[dialect.state_type]
        self._motor = message_type(motor).cls
        self._states: dict[int, Any] = {}
        self.command_topics = {s: dialect.topics(s)[0] for s in Side}
        self.state_topics = {s: dialect.topics(s)[1] for s in Side}
        self.shared = len(set(self.command_topics.values())) == 1

    def encode(self, motors: Mapping[Side, Motor]) -> list[tuple[str, bytes]]:
        """(topic, payload) of the commands to these sides, all in one message if they share it."""
        if not self.shared:
            return [
                (self.command_topics[side], self._payload([motor]))
                for side, motor in motors.items()
            ]
        places = [LIMP] * self.dialect.length
        for side, motor in motors.items():
            places[self.dialect.index[side]] = motor
        return [(self.dialect.cmd_topic, self._payload(places))]

    def encode_empty(self, sides: tuple[Side, ...]) -> list[tuple[str, bytes]]:
        """The same with no motor in the sequence."""
        topics = dict.fromkeys(self.command_topics[side] for side in sides)
        return [(topic, self._payload([])) for topic in topics]

    def _payload(self, motors: list[Motor]) -> bytes:
        message = self.command.cls()
        setattr(
            message,
            self.command_sequence,
            [self._motor(mode=m.mode, q=m.q, dq=m.dq, tau=m.tau, kp=m.kp, kd=m.kd) for m in motors],
        )
        return self.command.encode(message)

    def read_state(self, data: bytes, side: Side) -> tuple[float, float, float] | None:
        """(q, dq, tau_est) of a side in a state payload, or None if it is not there.

        :raises WireError: the payload is not of the dialect's state type.
        """
        motors = getattr(self.state.decode(data), self.state_sequence)
        index = self.dialect.index[side]
        if index >= len(motors):
            return None
        motor = motors[index]
        return motor.q, motor.dq, motor.tau_est

    def read_command(self, data: bytes, side: Side) -> Motor | None:
        """A side's motor in a command payload, or None if it is not there.

        :raises WireError: the payload is not of the dialect's command type.
        """
        motors = getattr(self.command.decode(data), self.command_sequence)
        index = self.dialect.index[side]
        if index >= len(motors):
            return None
        m = motors[index]
        return Motor(q=m.q, dq=m.dq, tau=m.tau, kp=m.kp, kd=m.kd, mode=m.mode)

    def state_payload(
        self, motors: Mapping[Side, Mapping[str, float]], length: int | None = None
    ) -> bytes:
        """A state message, for hands that the kit plays itself.

        :param motors: fields of each side's motor.
        :param length: motors in the sequence, if not the dialect's.
        """
        count = self.dialect.length if length is None else length
        message, places = self._blank_state(count)
        for side, fields in motors.items():
            index = self.dialect.index[side]
            if index < count:
                for name, value in fields.items():
                    setattr(places[index], name, value)
        return self.state.encode(message)

    def _blank_state(self, length: int) -> tuple[Any, list[Any]]:
        """A state message of that length and its motors; made once, filled again and again."""
        if length not in self._states:
            kind = message_type(self._state_motor).cls
            message = self.state.cls()
            setattr(message, self.state_sequence, [kind() for _ in range(length)])
            self._states[length] = message
        message = self._states[length]
        return message, getattr(message, self.state_sequence)
