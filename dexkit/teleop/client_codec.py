"""Encode a client's commands, and decode the positions of the states that it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import Dialect, model
from dexkit.teleop.client import JointCommand, Pose

__all__ = ["ClientCodec"]

_LIMP = JointCommand(0, 0.0, 0.0, 0.0, 0.0, 0.0)


class ClientCodec:
    """Encodes commands and reads states of one dialect.

    :ivar command_topics: by side; ``state_topics`` likewise.
    """

    def __init__(self, spoken: Dialect) -> None:
        self._dialect = spoken
        self._joints = len(model(spoken.model).joints[Side.LEFT])
        self._command = message_type(spoken.cmd_type)
        self._state = message_type(spoken.state_type)
        self._motor = self._command.motor_type.cls
        self.command_topics = {s: spoken.topics(s)[0] for s in Side}
        self.state_topics = {s: spoken.topics(s)[1] for s in Side}

    def encode(self, commands: Mapping[Side, Sequence[JointCommand]]) -> list[tuple[str, bytes]]:
        """(topic, payload), left before right; one message where both share a topic.

        There the place of a side that is not given is sent without force; where that is not
        possible, nothing is sent.
        """
        if self._dialect.commands_both and len(commands) < len(Side):
            return []
        if len(set(self.command_topics.values())) == len(Side):
            return [(self.command_topics[s], self._payload(c)) for s, c in commands.items()]
        places = [_LIMP] * self._dialect.length
        for side, motors in commands.items():
            first = self._dialect.index[side]
            places[first : first + len(motors)] = motors
        return [(self._dialect.cmd_topic, self._payload(places))] if commands else []

    def _payload(self, motors: Sequence[JointCommand]) -> bytes:
        made = [self._motor(**m._asdict()) for m in motors]
        return self._command.encode(self._command.of_motors(made))

    def positions(self, topic: str, data: bytes) -> dict[Side, Pose]:
        """The positions of the sides in a state message, without those that it is too short for.

        :raises WireError: it is not of the dialect's state type.
        """
        motors = self._state.motors(self._state.decode(data))
        found: dict[Side, Pose] = {}
        for side, its_topic in self.state_topics.items():
            first = self._dialect.index[side]
            if its_topic == topic and len(motors) >= first + self._joints:
                found[side] = tuple(m.q for m in motors[first : first + self._joints])
        return found
