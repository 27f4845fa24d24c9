"""Encode motor commands and decode motor states of each dialect, independently of the service.

Which member of which message is which motor is written down here a second time on purpose: the
kit judges dexkit's own service as well, and with shared code it could not see a mistake in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats, JointMode, Side, Subject
from dexkit.messages import Columns, MessageType, message_type
from dexkit.messages import layout as layouts
from dexkit.models import DEX1_1, DEX3_1, Dialect, ModeByte, model

__all__ = ["Motor", "MotorCodec", "Motors", "mode_byte", "sequence_of"]

# The sequence of motors in a message, and the type of one of them. Written down here and not
# taken from MessageType.motor_sequence: the kit's reading does not depend on what it tests.
_SEQUENCE = {
    "unitree_go::msg::dds_::MotorCmds_": ("cmds", "unitree_go::msg::dds_::MotorCmd_"),
    "unitree_go::msg::dds_::MotorStates_": ("states", "unitree_go::msg::dds_::MotorState_"),
    "unitree_hg::msg::dds_::HandCmd_": ("motor_cmd", "unitree_hg::msg::dds_::MotorCmd_"),
    "unitree_hg::msg::dds_::HandState_": ("motor_state", "unitree_hg::msg::dds_::MotorState_"),
    "unitree_go::msg::dds_::LowCmd_": ("motor_cmd", "unitree_go::msg::dds_::MotorCmd_"),
    "unitree_go::msg::dds_::LowState_": ("motor_state", "unitree_go::msg::dds_::MotorState_"),
    "unitree_hg::msg::dds_::LowCmd_": ("motor_cmd", "unitree_hg::msg::dds_::MotorCmd_"),
    "unitree_hg::msg::dds_::LowState_": ("motor_state", "unitree_hg::msg::dds_::MotorState_"),
    "inspire::inspire_hand_ctrl": ("angle_set", "unitree_go::msg::dds_::MotorCmd_"),
    "inspire::inspire_hand_state": ("angle_act", "unitree_go::msg::dds_::MotorState_"),
}
# Where each quantity has a list of its own: which, and how many there are one.
_LISTS = {
    "inspire::inspire_hand_ctrl": {"q": ("angle_set", 1000)},
    "inspire::inspire_hand_state": {"q": ("angle_act", 1000), "tau_est": ("force_act", -1000)},
}
_ANGLES = 1
"""The mode of a command whose angles count."""


def sequence_of(type_name: str) -> str:
    """Name of the member that holds the motors in a message of that type."""
    return _SEQUENCE[type_name][0]


def state_member(state_type: str, name: str) -> str:
    """The name by which a state of that type has a quantity that others have in each motor."""
    return _LISTS.get(state_type, {}).get(name, (name, 1))[0]


@dataclass(frozen=True)
class Motor:
    """One motor's command in the dialect's own units; the defaults are xr_teleoperate's gains."""

    q: float = 0.0
    dq: float = 0.0
    tau: float = 0.0
    kp: float = DEX1_1.gains[0][0]
    kd: float = DEX1_1.gains[0][1]
    mode: int = 0


Motors = Sequence[Motor]
"""The motors of one hand, in the dialect's order."""

LIMP = Motor(kp=0.0, kd=0.0)
"""No torque: what fills the place of a motor that is not meant."""


def _members(motors: Sequence[Any]) -> Callable[[str], list[Any]]:
    """A member of each of these objects, by its name."""
    return lambda name: [getattr(m, name) for m in motors]


def _as_int16(values: Iterable[float], scale: float) -> list[int]:
    """Scale, round and saturate to int16; NaN becomes -1, which leaves a joint alone.

    Plain numbers: there are too few joints for numpy to be quick.
    """
    scaled = [value * scale for value in values]
    return [round(x) if -32768.0 <= x <= 32767.0 else _saturated(x) for x in scaled]


def _saturated(value: float) -> int:
    """The int16 of a value out of its range, or of NaN."""
    return -1 if value != value else 32767 if value > 0.0 else -32768


def mode_byte(index: int, status: int = JointMode.FOC, timeout: bool = False) -> int:
    """RIS_Mode: id in bits 0 to 3, status in 4 to 6, time-out in 7
    (docs/sources/unitree-dex.md#b4).
    """
    return index | status << 4 | timeout << 7


class _Shape:
    """States of one shape: with the header, length and lengths of sequences of one that has been
    decoded.

    Such a state can be decoded as well, so that q and dq are read without all the rest: a script
    looks at every state of a hand.

    :param message: what ``data``, which is little endian, was decoded to.
    """

    def __init__(self, kind: MessageType, data: bytes, message: Any) -> None:
        sequence, motor = _SEQUENCE[kind.name]
        lengths, at, begin, count = "<4s", 4, 0, 0
        for member in kind.layout.fields:
            if not member.sequence:
                at = 4 + layouts.Struct((), "", (member,)).end(at - 4)
                continue
            pad = -at % 4
            at += pad + 4
            lengths += f"{at - 4 - Struct(lengths).size}xI"
            elements = len(getattr(message, member.name))
            if member.name == sequence:
                begin, count = at, elements
            at += elements * member.element_size
        self._lengths = Struct(lengths)
        self._same = self._lengths.unpack_from(data)
        self._scale = 0
        if kind.name in _LISTS:
            self._scale = _LISTS[kind.name]["q"][1]
            self._numbers = Struct(f"<{begin}x{count}h")
            return
        size = message_type(motor).layout.end(0)
        q, dq = (_offset(message_type(motor).layout, name) for name in ("q", "dq"))
        assert dq == q + 4
        self._numbers = Struct(f"<{begin}x" + f"{q}x2f{size - q - 8}x" * count)

    def fits(self, data: bytes) -> bool:
        """Whether a state of the same length has this shape."""
        return self._lengths.unpack_from(data) == self._same

    def read(self, data: bytes) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """(q, dq) of all motors of a state of this shape."""
        found = self._numbers.unpack_from(data)
        if self._scale:
            return tuple([x / self._scale for x in found]), (0.0,) * len(found)
        return found[::2], found[1::2]


def _offset(kind: layouts.Struct, name: str) -> int:
    """Where a number is in a struct, bytes."""
    at = 0
    for leaf in kind.leaves():
        at += -at % leaf.type.size
        if leaf.path == (name,):
            return at
        at += leaf.count * leaf.type.size
    raise AssertionError(name)


class MotorCodec:
    """Encodes commands and decodes states of one dialect.

    :param joints: of one subject; by default those of a hand of the dialect's model.
    :param foreign: another command type, which the device must ignore; by default the other one
        of hands.
    :param subjects: what has a topic or a place in the messages.
    """

    machine = 0
    """``mode_machine`` of the last state, where there is one."""

    def __init__(
        self,
        dialect: Dialect,
        *,
        joints: int | None = None,
        foreign: str | None = None,
        subjects: Sequence[Subject] = tuple(Side),
    ) -> None:
        self.dialect = dialect
        self.joints = joints or len(model(dialect.model).joints[Side.LEFT])
        self.command: MessageType = message_type(dialect.cmd_type)
        self.state: MessageType = message_type(dialect.state_type)
        self.command_sequence, self._command_motor = _SEQUENCE[dialect.cmd_type]
        self.state_sequence, self._state_motor = _SEQUENCE[dialect.state_type]
        if foreign is None:
            others = (DEX1_1.dialects[0].cmd_type, DEX3_1.dialects[0].cmd_type)
            foreign = next(t for t in others if t != dialect.cmd_type)
        self.foreign: MessageType = message_type(foreign)
        self._states: dict[int, Any] = {}
        self._shapes: dict[int, _Shape] = {}
        self._ids = dialect.mode_byte is ModeByte.RIS
        self._modes = dialect.mode_byte is not ModeByte.UNUSED
        self.command_topics: Mapping[Subject, str] = {s: dialect.topics(s)[0] for s in subjects}
        self.state_topics: Mapping[Subject, str] = {s: dialect.topics(s)[1] for s in subjects}
        self.shared = len(set(self.command_topics.values())) < len(subjects)

    def mode(self, index: int, status: int = JointMode.FOC, timeout: bool = False) -> int:
        """The mode byte of a motor: RIS_Mode, a status (1 is position control,
        docs/sources/unitree-dex.md#b5), or 0 where the dialect does not use it.
        """
        if self._ids:
            return mode_byte(index, status, timeout)
        return int(status) if self._modes else 0

    def status(self, modes: NDArray[np.intp]) -> NDArray[np.intp]:
        """The status in mode bytes of states: 1 driven, 0 not."""
        return np.asarray(modes >> 4 & 7) if self._ids else modes

    @cached_property
    def _motor(self) -> type[Any]:
        return message_type(self._command_motor).cls

    @property
    def holds_nan(self) -> bool:
        """Whether a command can hold a value that is not finite; one of integers cannot."""
        return self.command.name not in _LISTS

    def encode(self, hands: Mapping[Side, Motors]) -> list[tuple[str, bytes]]:
        """Encode commands to these sides as (topic, payload); one message if they share a topic.

        On a topic of its own a hand is sent as many motors as are given, however wrong.
        """
        return [(t, self._payload(motors)) for t, motors in self._by_topic(hands).items()]

    def encode_longer(
        self, hands: Mapping[Side, Motors], surplus: Motors
    ) -> list[tuple[str, bytes]]:
        """Encode commands with surplus motors at the end of the sequence."""
        return [
            (topic, self._payload([*motors, *surplus]))
            for topic, motors in self._by_topic(hands).items()
        ]

    def encode_shorter(self, hands: Mapping[Side, Motors]) -> list[tuple[str, bytes]]:
        """Encode commands without the last motor of the sequence."""
        return [(t, self._payload(motors[:-1])) for t, motors in self._by_topic(hands).items()]

    def encode_foreign(self, hands: Mapping[Side, Motors]) -> list[tuple[str, bytes]]:
        """Encode commands in :attr:`foreign`, another command type of the Dex family."""
        sequence, motor = _SEQUENCE[self.foreign.name]
        kind = message_type(motor).cls
        found = []
        for topic, group in self._by_topic(hands).items():
            message = self.foreign.cls()
            setattr(
                message,
                sequence,
                [kind(mode=m.mode, q=m.q, dq=m.dq, tau=m.tau, kp=m.kp, kd=m.kd) for m in group],
            )
            found.append((topic, self.foreign.encode(message)))
        return found

    def _by_topic(self, hands: Mapping[Side, Motors]) -> dict[str, Motors]:
        if not self.shared:
            return {self.command_topics[side]: motors for side, motors in hands.items()}
        places = [LIMP] * self.dialect.length
        for side, motors in hands.items():
            first = self.dialect.index[side]
            mine = motors[: self.joints]
            places[first : first + len(mine)] = mine
        return {self.dialect.cmd_topic: places}

    def encode_empty(self, sides: Sequence[Side]) -> list[tuple[str, bytes]]:
        """Encode commands with no motor in the sequence."""
        topics = dict.fromkeys(self.command_topics[side] for side in sides)
        return [(topic, self._payload([])) for topic in topics]

    def _payload(self, motors: Motors) -> bytes:
        if self.command.name in _LISTS:
            message = self._lists(self.command, len(motors), _members(motors))
            message.mode = _ANGLES
            return self.command.encode(message)
        message = self.command.cls()
        setattr(
            message,
            self.command_sequence,
            [self._motor(mode=m.mode, q=m.q, dq=m.dq, tau=m.tau, kp=m.kp, kd=m.kd) for m in motors],
        )
        return self.command.encode(message)

    def read_state(
        self, data: bytes, side: Subject
    ) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Decode (q, dq) of a subject's joints; None if the sequence is too short.

        :raises WireError: the payload is not of the dialect's state type.
        """
        shape = self._shapes.get(len(data))
        if shape is None or not shape.fits(data):
            message = self.state.decode(data)
            motors = self._motors(self.state, message)
            if data[1] == 1:  # little endian
                self._shapes[len(data)] = _Shape(self.state, data, message)
            q, dq = tuple(m.q for m in motors), tuple(m.dq for m in motors)
        else:
            q, dq = shape.read(data)
        first = self.dialect.index[side]
        end = first + self.joints
        return None if len(q) < end else (q[first:end], dq[first:end])

    def read_command(self, data: bytes, side: Subject) -> tuple[Motor, ...] | None:
        """Decode a subject's motors of a command; None if the sequence is too short.

        :raises WireError: the payload is not of the dialect's command type.
        """
        motors = self._mine(self.commanded(data), side)
        if motors is None:
            return None
        return tuple(
            Motor(q=m.q, dq=m.dq, tau=m.tau, kp=m.kp, kd=m.kd, mode=m.mode) for m in motors
        )

    def commanded(self, data: bytes) -> Sequence[Any]:
        """All motors of a command.

        :raises WireError: the payload is not of the dialect's command type.
        """
        return self._motors(self.command, self.command.decode(data))

    def _motors(self, kind: MessageType, message: Any) -> Sequence[Any]:
        sequence, motor = _SEQUENCE[kind.name]
        motors: Sequence[Any] = getattr(message, sequence)
        if kind.name not in _LISTS:
            return motors
        if getattr(message, "mode", _ANGLES) & _ANGLES == 0:
            return []
        make = message_type(motor).cls
        lists = _LISTS[kind.name].items()
        return [
            make(**{member: getattr(message, name)[i] / scale for member, (name, scale) in lists})
            for i in range(len(motors))
        ]

    def _lists(self, kind: MessageType, count: int, member_of: Callable[[str], Any]) -> Any:
        """A message with a list for each quantity.

        :param member_of: a member of each of the ``count`` motors.
        """
        every = [f.name for f in kind.layout.fields if f.sequence]
        message = kind.cls(**{name: [0] * count for name in every})
        for member, (name, scale) in _LISTS[kind.name].items():
            setattr(message, name, _as_int16(member_of(member), scale))
        return message

    def state_lists(self, motors: Any) -> bytes:
        """Encode a state that has a list for each quantity.

        :param motors: array of structs with the members of motors.
        """
        data, numbers, places = self._blank_lists(len(motors))
        for member, (name, scale) in _LISTS[self.state.name].items():
            numbers.pack_into(data, places[name], *_as_int16(motors[member].tolist(), scale))
        return bytes(data)

    def _blank_lists(self, count: int) -> tuple[bytearray, Struct, Mapping[str, int]]:
        """A state of lists of that length, how one of int16 is packed, and where each begins;
        made once.
        """
        if count not in self._states:
            blank = self._lists(self.state, count, lambda member: [0.0] * count)
            places: dict[str, int] = {}
            at = 4  # header
            for field in self.state.layout.fields:
                at += -at % 4 + 4  # its length
                places[field.name] = at
                at += count * field.element_size
            data = bytearray(self.state.encode(blank))
            self._states[count] = data, Struct(f"<{count}h"), places
        found: tuple[bytearray, Struct, Mapping[str, int]] = self._states[count]
        return found

    def column(self, columns: Columns, side: Subject, kind: MessageType, name: str) -> Floats:
        """A value of a subject's joints: shape (n, n_joints), NaN where the sequence is too short.

        What the type does not have is 0.
        """
        first = self.dialect.index[side]
        slots = range(first, first + self.joints)
        if kind.name not in _LISTS:
            # the values of one joint are contiguous: checks read one joint at a time
            sequence, _ = _SEQUENCE[kind.name]
            paths = [f"{sequence}[{i}].{name}" for i in slots]
            rows = [columns.constant(path) for path in paths]
            same = [row for row in rows if row is not None]
            if len(same) == len(rows):  # one row for all messages: no memory, however many
                return np.broadcast_to(np.concatenate(same), (len(columns), len(rows)))
            return columns.table(paths)
        where, scale = _LISTS[kind.name].get(name, _LISTS[kind.name]["q"])
        table = columns.table([f"{where}[{i}]" for i in slots]) / scale
        return table if name in _LISTS[kind.name] else table * 0.0

    def count(self, columns: Columns, sequence: str) -> NDArray[np.intp]:
        """Motors in the sequence of each message; -1 where it does not decode."""
        return columns.count(sequence)

    def _mine(self, motors: Sequence[Any], side: Subject) -> Sequence[Any] | None:
        first = self.dialect.index[side]
        mine = motors[first : first + self.joints]
        return mine if len(mine) == self.joints else None

    def state_payload(
        self,
        hands: Mapping[Side, Sequence[Mapping[str, Any]]],
        length: int | None = None,
        **rest: Any,
    ) -> bytes:
        """Encode a state message, for the reference hands.

        :param hands: fields of each side's motors.
        :param length: motors in the sequence, if not the dialect's.
        :param rest: other members of the message.
        """
        count = self.dialect.length if length is None else length
        if self.state.name in _LISTS:
            kind = message_type(self._state_motor).cls
            given = next(iter(hands.values()), ())
            made = [kind(**dict(fields)) for fields in given] or [kind() for _ in range(count)]
            return self.state.encode(
                self._lists(self.state, len(made[:count]), _members(made[:count]))
            )
        message, places = self._blank_state(count)
        for side, motors in hands.items():
            for index, fields in enumerate(motors, self.dialect.index[side]):
                if index < count:
                    for name, value in fields.items():
                        setattr(places[index], name, value)
        for name, value in rest.items():
            setattr(message, name, value)
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
