"""Robots in the conformance kit: their dialect, messages with a CRC, and decoded recordings.

A robot has no sides: where a hand has a side, it has
:data:`dexkit.hand.ROBOT`. Its joints are those of the used motor slots, in
their order. What hands do not have: a CRC in each message, and slots that are not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec, Motors
from dexkit.conformance.kit.recording import Recording, TopicDecoder, TraceLike
from dexkit.errors import WireError
from dexkit.hand import ROBOT, Floats, Subject
from dexkit.messages import Columns, MessageType, message_type
from dexkit.models import Dialect
from dexkit.robots import H1, ROBOTS, RobotModel, robot
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.low_level import encode_with_crc, verify_payload

__all__ = [
    "WRONG_CRCS",
    "RobotMotorCodec",
    "RobotRecording",
    "codec_for",
    "robot_dialect",
    "robot_in",
    "robot_recording",
]

Flags = NDArray[np.bool_]


@cache
def robot_dialect(name: str) -> Dialect:
    """A robot's topics and types as a dialect.

    :raises UsageError: there is no such robot.
    """
    model = robot(name)
    return Dialect(
        name=model.name,
        model=model.name,
        cmd_topic=model.cmd_topic,
        state_topic=model.state_topic,
        cmd_type=model.cmd_type,
        state_type=model.state_type,
        index={ROBOT: 0},
        length=model.slots,
        q_open=math.nan,
        summary=f"{model.title} on Unitree's low-level topics",
    )


WRONG_CRCS = {
    "bit": "a CRC that is off by a bit",
    "zero": "a CRC of 0",
    "cdr": "a CRC over the CDR bytes",
}
"""Wrong CRCs of commands."""


class RobotMotorCodec(MotorCodec):
    """Encodes commands with their CRC and decodes states of a robot.

    :ivar machine: ``mode_machine`` of the last state that was read; commands repeat it.
    """

    def __init__(self, dialect: Dialect) -> None:
        self.robot: RobotModel = robot(dialect.model)
        other = next(b for b in ROBOTS.values() if b.family != self.robot.family)
        super().__init__(
            dialect, joints=len(self.robot.used), foreign=other.cmd_type, subjects=(ROBOT,)
        )
        self.machine = 0

    def read_state(
        self, data: bytes, side: Subject
    ) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """(q, dq) of the used slots.

        :raises WireError: the payload is not of the robot's state type.
        """
        message = self.state.decode(data)
        self.machine = getattr(message, "mode_machine", 0)
        motors = [message.motor_state[slot] for slot in self.robot.used]
        return tuple(m.q for m in motors), tuple(m.dq for m in motors)

    def encode_low_command(self, motors: Motors, machine: int, wrong_crc: str = "") -> bytes:
        """Encode a command for all motor slots, with its CRC.

        :param wrong_crc: one of :data:`WRONG_CRCS`, for a CRC that is wrong in that way.
        """
        message = self._message(self.command.name, motors)
        if hasattr(message, "mode_machine"):
            message.mode_machine = machine
        sealed = encode_with_crc(message)
        if not wrong_crc:
            return sealed
        right = int.from_bytes(sealed[-4:], "little")
        crc = {"bit": right ^ 0x10, "zero": 0, "cdr": crc32_words(sealed[4:-4])}[wrong_crc]
        return sealed[:-4] + crc.to_bytes(4, "little")

    def encode_foreign_command(self, motors: Motors) -> bytes:
        """Encode a command in the other family's type, with its CRC."""
        return encode_with_crc(self._message(self.foreign.name, motors))

    def column(self, columns: Columns, side: Subject, kind: MessageType, name: str) -> Floats:
        """A value of the used slots: shape (n, n_joints)."""
        sequence = self.state_sequence if kind is self.state else self.command_sequence
        return np.ascontiguousarray(columns[f"{sequence}[].{name}"].T[list(self.robot.used)]).T

    def count(self, columns: Columns, sequence: str) -> NDArray[np.intp]:
        """All motor slots: the messages have arrays; -1 where one does not decode."""
        return np.where(columns.ok, self.robot.slots, -1).astype(np.intp)

    def _message(self, type_name: str, motors: Sequence[Motor]) -> Any:
        message = message_type(type_name).cls()
        for place, m in zip(message.motor_cmd, motors, strict=False):
            place.mode, place.q, place.dq = m.mode, m.q, m.dq
            place.tau, place.kp, place.kd = m.tau, m.kp, m.kd
        if hasattr(message, "head"):
            message.head, message.level_flag = (0xFE, 0xEF), 0xFF  # docs/sources/unitree-dex.md#a8
        return message


def codec_for(dialect: Dialect) -> MotorCodec:
    """The codec of a hand's or robot's dialect."""
    return RobotMotorCodec(dialect) if dialect.model in ROBOTS else MotorCodec(dialect)


@dataclass(frozen=True, eq=False)
class RobotRecording(Recording):
    """A recording of a robot, decoded.

    :param payloads: of the states, likewise of the commands.
    """

    robot: RobotModel = H1
    payloads: Sequence[bytes] = field(default=(), repr=False)
    command_payloads: Sequence[bytes] = field(default=(), repr=False)

    layer = "robot"

    @property
    def model(self) -> RobotModel:
        """The robot's model."""
        return self.robot

    @property
    def low(self) -> Columns | None:
        """The states, all members; None without any."""
        return self.sides[ROBOT].states.columns

    @cached_property
    def intact(self) -> Flags:
        """Which states decode and carry the right CRC."""
        return _intact(self.robot.state_type, self.payloads)

    @cached_property
    def commands_intact(self) -> Flags:
        """Which commands decode and carry the right CRC."""
        return _intact(self.robot.cmd_type, self.command_payloads)


def _intact(type_name: str, payloads: Sequence[bytes]) -> Flags:
    def good(payload: bytes) -> bool:
        try:
            return verify_payload(type_name, payload)
        except WireError:
            return False

    return np.fromiter(map(good, payloads), dtype=np.bool_, count=len(payloads))


def robot_in(trace: TraceLike) -> RobotModel | None:
    """The robot whose topics, of its types, are in a recording; None without any."""
    seen = {(c.topic, c.type_name) for c in trace.channels}
    seen |= {(e.topic, e.type_name) for e in trace.endpoints}
    # the state topic first: a command topic alone may be a client's of the other robot
    for topic in ("state", "cmd"):
        for model in ROBOTS.values():
            if (getattr(model, f"{topic}_topic"), getattr(model, f"{topic}_type")) in seen:
                return model
    return None


def robot_recording(trace: TraceLike, name: str) -> RobotRecording:
    """Decode the part of ``trace`` that is about a robot.

    :raises ConformanceError: it has none of the robot's topics.
    :raises TraceUnsupported: its stimulus record cannot be read.
    """
    codec = RobotMotorCodec(robot_dialect(name))
    model, dialect = codec.robot, codec.dialect
    found = TopicDecoder(trace, codec, missing=f"topic of the {model.title}", payloads=True)
    states = found.of_type(dialect.state_topic, dialect.state_type)
    commands = found.of_type(dialect.cmd_topic, dialect.cmd_type)
    return RobotRecording(
        **found.common(),
        sides={ROBOT: found.view(ROBOT, tuple(model.joint(slot) for slot in model.used))},
        judged=(ROBOT,),
        notes=found.notes((ROBOT,)),
        robot=model,
        payloads=states.payloads if states is not None else (),
        command_payloads=commands.payloads if commands is not None else (),
    )
