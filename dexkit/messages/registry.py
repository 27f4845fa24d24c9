"""Message types by name."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Callable, Sequence
from functools import cache, cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import EncodeError, UsageError
from dexkit.messages import layout, schemas
from dexkit.messages.codec import ArrayLengthError, Buffer, explain, is_big
from dexkit.messages.columns import Columns
from dexkit.messages.joint_lists import JOINT_LISTS, JointLists

__all__ = ["MessageType", "decode", "encode", "message_type", "message_types"]

# what the packing of a value that does not fit can raise
_PACK_ERRORS = (
    struct.error,
    ArrayLengthError,
    OverflowError,
    TypeError,
    AttributeError,
    ValueError,
)

# the structs of which one is one motor
_MOTORS = ("MotorCmd_", "MotorState_")


class MessageType:
    """One message type. Get it from :func:`message_type`.

    :ivar name: DDS name, ``unitree_go::msg::dds_::MotorCmds_``.
    :ivar ros_name: name of the ROS 2 type, ``unitree_go/msg/MotorCmds``.
    :ivar max_size: bytes of the longest sample that is accepted.
    """

    def __init__(self, kind: layout.Struct) -> None:
        self.layout = kind
        self.name = kind.dds_name
        self.ros_name = kind.ros_name
        self.max_size = layout.max_size(kind)

    def __repr__(self) -> str:
        return f"<MessageType {self.name}>"

    @cached_property
    def _module(self) -> ModuleType:
        # loaded when a single sample is wanted; columns need only the layout
        return importlib.import_module(f"dexkit.messages.{self.layout.scope[0]}")

    @cached_property
    def cls(self) -> type[Any]:
        """The dataclass."""
        found: type[Any] = getattr(self._module, self.layout.name)
        return found

    @cached_property
    def motor_sequence(self) -> str:
        """Name of the member that holds the motors of a command or state: ``motor_cmd``.

        A robot's messages have a fixed array of them. Where each quantity has a list, that of the
        positions.

        :raises UsageError: the type has no sequence of motors.
        """
        return self._lists.sequence if self._lists else self._motor_member.name

    @cached_property
    def motor_type(self) -> MessageType:
        """Type of one of :meth:`motors`.

        :raises UsageError: the type has no sequence of motors.
        """
        if self._lists:
            return message_type(self._lists.motor)
        assert isinstance(self._motor_member.type, layout.Struct)
        return message_type(self._motor_member.type.dds_name)

    def motors(self, message: Any) -> list[Any]:
        """The motors of a command or state, each of :attr:`motor_type`.

        :raises UsageError: the type has no sequence of motors.
        """
        if self._lists:
            return self._lists.motors(message, self.motor_type.cls)
        found: list[Any] = getattr(message, self.motor_sequence)
        return found

    def of_motors(self, motors: Sequence[Any]) -> Any:
        """A message with these motors; every other member has its default.

        :raises UsageError: the type has no sequence of motors.
        """
        if self._lists:
            return self._lists.message(motors, self.cls)
        return self.cls(**{self.motor_sequence: list(motors)})

    def motor_place(self, member: str, slot: int) -> tuple[str, int] | None:
        """Path of a motor's value in a message and how many there are one; None if it has none.

        :raises UsageError: the type has no sequence of motors.
        """
        if not self._lists:
            return f"{self.motor_sequence}[{slot}].{member}", 1
        if member not in self._lists.lists:
            return None
        name, scale = self._lists.lists[member]
        return f"{name}[{slot}]", scale

    def motor_table(
        self, columns: Columns, member: str, slots: Sequence[int]
    ) -> NDArray[np.float64]:
        """A value of some motors in each sample, shape (n, len(slots)); 0 where the type lacks it.

        :raises UsageError: the type has no such member, or no sequence of motors.
        """
        places = [self.motor_place(member, slot) for slot in slots]
        here = [place for place in places if place is not None]
        if len(here) < len(places) or not here:
            return np.zeros((len(columns), len(places)))
        table = columns.table([path for path, _ in here])
        return table if not self._lists else table / here[0][1]

    def motor_values_sent(
        self, member: str, values: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """What a message holds of such values: rounded; None if it has no place for them."""
        if not self._lists:
            return values.astype(np.float32).astype(np.float64)
        place = self.motor_place(member, 0)
        if place is None:
            return None
        return np.asarray(np.rint(np.clip(values * place[1], -32768, 32767)) / place[1])

    @cached_property
    def _lists(self) -> JointLists | None:
        return JOINT_LISTS.get(self.name)

    @cached_property
    def _motor_member(self) -> layout.Field:
        for member in self.layout.fields:
            struct = member.type
            is_motor = isinstance(struct, layout.Struct) and struct.name in _MOTORS
            if is_motor and (member.sequence or member.array is not None):
                return member
        raise UsageError(f"{self.name} has no sequence of motors")

    @cached_property
    def _encode(self) -> Callable[[Any], bytes]:
        found: Callable[[Any], bytes] = getattr(self._module, f"encode_{self.layout.name}")
        return found

    @cached_property
    def _decode(self) -> Callable[[Buffer, bool], Any]:
        found: Callable[[Buffer, bool], Any] = getattr(self._module, f"decode_{self.layout.name}")
        return found

    def encode(self, message: Any) -> bytes:
        """Encapsulation header and plain CDR, little endian.

        :raises EncodeError: another class, a value that its type cannot hold, or a sequence or
            array of the wrong length. The message names the member.
        """
        if not isinstance(message, self.cls):
            raise EncodeError(
                f"a {type(message).__module__}.{type(message).__name__} is not a {self.name}"
            )
        try:
            return self._encode(message)
        except _PACK_ERRORS as error:
            raise explain(message, self.layout, error) from error

    def decode(self, data: Buffer) -> Any:
        """The message in ``data``: plain CDR of either byte order, header included.

        Arrays come as tuples, sequences as lists.

        :raises TruncatedError: the data end too early.
        :raises OversizeError: bytes are left over, or a sequence exceeds the bound.
        :raises WireError: not plain CDR.
        """
        return self._decode(data, is_big(data, self.max_size, self.layout.name))

    def columns(self, payloads: Sequence[bytes]) -> Columns:
        """Many samples at once, as numpy columns; see :class:`~dexkit.messages.Columns`.

        :raises UsageError: the type holds text or bytes.
        """
        if any(member.is_bytes for member in self.layout.fields):
            raise UsageError(f"{self.name} holds text, which has no columns")
        return Columns(self.layout, payloads)

    @cached_property
    def ros2msg(self) -> str:
        """Concatenated ``.msg`` definition for recordings."""
        return schemas.ros2msg(self.layout)

    @cached_property
    def omgidl(self) -> str:
        """Self-contained IDL text for recordings."""
        return schemas.omgidl(self.layout)


@cache
def _by_layout(name: str) -> MessageType:
    return MessageType(layout.ALL[name])


_NAMES = {
    alias: name
    for name, kind in layout.ALL.items()
    for alias in (name, kind.ros_name, name.replace("::", "."))
}


def message_type(name: str) -> MessageType:
    """The type called ``name``.

    :param name: DDS name (``unitree_go::msg::dds_::MotorCmds_``), the same with dots, or ROS 2
        name (``unitree_go/msg/MotorCmds``).
    :raises UsageError: dexkit does not know it.
    """
    try:
        return _by_layout(_NAMES[name])
    except KeyError:
        known = ", ".join(layout.ALL)
        raise UsageError(f"unknown message type {name!r}", hint=f"known: {known}") from None


def message_types() -> list[MessageType]:
    """The types of hands and robots; requests and responses of services are not among them."""
    return [_by_layout(name) for name in layout.STRUCTS]


@cache
def _by_class() -> dict[type[Any], MessageType]:
    return {mt.cls: mt for mt in map(_by_layout, layout.ALL)}


def encode(message: Any) -> bytes:
    """Encode a message of any known class.

    :raises EncodeError: see :meth:`MessageType.encode`.
    """
    kind = _by_class().get(type(message))
    if kind is None:
        raise EncodeError(f"a {type(message).__name__} is not a message")
    return kind.encode(message)


def decode(name: str, data: Buffer) -> Any:
    """Decode ``data`` as the type called ``name``.

    :raises UsageError: unknown type.
    :raises WireError: see :meth:`MessageType.decode`.
    """
    return message_type(name).decode(data)
