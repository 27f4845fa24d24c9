"""Compute and verify the CRC in the last member of ``LowCmd_`` and ``LowState_``
(docs/sources/unitree-dex.md#a7).

    >>> from dexkit.messages.unitree_go import LowCmd_
    >>> hex(crc_of(LowCmd_()))
    '0x4b5a4880'
    >>> payload = encode_with_crc(LowCmd_(head=(0xFE, 0xEF), level_flag=0xFF))
    >>> verify_payload("unitree_go::msg::dds_::LowCmd_", payload)
    True

It is :func:`~dexkit.wire.crc32.crc32_words` of all members before it, not of the CDR sample but of
the C struct in Unitree's C++ program: each member is aligned to its size, each inner struct to its
largest member, and padding is zero. The two are easily confused: a whole CDR sample with its header
is as long as the struct.

A sender that leaves the ``u8`` temperatures of ``unitree_go`` at 127 or less also suits Unitree's
Python SDK, whose CRC function packs them as signed numbers and raises above that.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from dexkit.errors import UsageError
from dexkit.messages import encode, message_type
from dexkit.messages.codec import Buffer, is_big, truncated
from dexkit.messages.layout import STRUCTS, Primitive, Struct
from dexkit.wire.crc32 import crc32_swapped

__all__ = [
    "LOW_LEVEL_TYPES",
    "crc_of",
    "crc_of_payload",
    "encode_with_crc",
    "payload_of_struct",
    "struct_of_payload",
    "verify",
    "verify_payload",
]

LOW_LEVEL_TYPES = tuple(name for name, kind in STRUCTS.items() if kind.fields[-1].name == "crc")
"""DDS names of the types that carry the CRC."""


def _alignment(kind: Primitive | Struct) -> int:
    if isinstance(kind, Primitive):
        return kind.size
    return max(_alignment(member.type) for member in kind.fields)


def _number_offsets(kind: Primitive | Struct, at: int) -> Iterator[tuple[int, int]]:
    """Where each number of a C object at ``at`` lies, and its size; last, where it ends, and 0."""
    if isinstance(kind, Primitive):
        yield at, kind.size
        yield at + kind.size, 0
        return
    for member in kind.fields:
        at = -(-at // _alignment(member.type)) * _alignment(member.type)
        for _ in range(member.array or 1):
            *numbers, (at, _) = _number_offsets(member.type, at)
            yield from numbers
    yield -(-at // _alignment(kind)) * _alignment(kind), 0


class _Image:
    """How a sample's bytes become those of the C struct."""

    def __init__(self, name: str) -> None:
        self._type = message_type(name)
        kind = self._type.layout
        *numbers, (self.size, _) = _number_offsets(kind, 0)
        source = np.zeros(self.size, dtype=np.intp)
        gap = np.ones(self.size, dtype=np.bool_)
        wire = 4
        for at, size in numbers:
            wire += -wire % size
            source[at : at + size] = np.arange(wire, wire + size)
            gap[at : at + size] = False
            wire += size
        self._wire_size = wire
        self._back = np.zeros(wire, dtype=np.intp)  # where in the struct each byte comes from
        self._back[source[~gap]] = np.flatnonzero(~gap)
        self._header_and_gaps = np.setdiff1d(np.arange(wire), source[~gap])
        self._source, self._gaps = source, np.flatnonzero(gap)
        # all words but the last (the CRC itself), byte-swapped for the CRC
        turned = np.arange(self.size - 4).reshape(-1, 4)[:, ::-1].reshape(-1)
        self._turned, self._turned_gaps = source[turned], np.flatnonzero(gap[turned])

    def little(self, payload: Buffer) -> Buffer:
        """The sample in little endian, if it is one."""
        if is_big(payload, self._wire_size, self._type.layout.name):
            return self._type.encode(self._type.decode(payload))
        if len(payload) < self._wire_size:
            raise truncated(self._type.layout.name, self._wire_size, len(payload))
        return payload

    def struct(self, payload: Buffer) -> bytes:
        """The C struct."""
        image = np.frombuffer(payload, dtype=np.uint8)[self._source]
        image[self._gaps] = 0
        return image.tobytes()

    def payload(self, struct: Buffer) -> bytes:
        """The sample, from the C struct."""
        sample = np.frombuffer(struct, dtype=np.uint8)[self._back]
        sample[self._header_and_gaps] = 0
        sample[1] = 1  # plain CDR, little endian
        return sample.tobytes()

    def crc(self, payload: Buffer) -> int:
        """The CRC that its last member should hold."""
        words = np.frombuffer(payload, dtype=np.uint8)[self._turned]
        words[self._turned_gaps] = 0
        return crc32_swapped(words.data)


_image = cache(_Image)


def _image_of(name: str) -> _Image:
    if name not in LOW_LEVEL_TYPES:
        raise UsageError(
            f"a {name} carries no CRC", hint=f"those that do: {', '.join(LOW_LEVEL_TYPES)}"
        )
    return _image(name)


def struct_of_payload(name: str, payload: Buffer) -> bytes:
    """The bytes of the C struct whose CDR sample this is, ``crc`` included, gaps zero.

    :param name: DDS type name, one of :data:`LOW_LEVEL_TYPES`.
    :raises UsageError: another type.
    :raises WireError: not a sample of that type.
    """
    image = _image_of(name)
    return image.struct(image.little(payload))


def payload_of_struct(name: str, struct: Buffer) -> bytes:
    """The CDR sample of a C struct, whatever its gaps hold; the inverse of
    :func:`struct_of_payload`.

    :param name: DDS type name, one of :data:`LOW_LEVEL_TYPES`.
    :raises UsageError: another type, or a struct of another size.
    """
    image = _image_of(name)
    if len(struct) != image.size:
        raise UsageError(f"the struct of a {name} has {image.size} bytes, not {len(struct)}")
    return image.payload(struct)


def crc_of_payload(name: str, payload: Buffer) -> int:
    """The CRC that a CDR sample should carry, computed without its present one.

    :param name: DDS type name, one of :data:`LOW_LEVEL_TYPES`.
    :raises UsageError: another type.
    :raises WireError: not a sample of that type.
    """
    image = _image_of(name)
    return image.crc(image.little(payload))


def verify_payload(name: str, payload: Buffer) -> bool:
    """Whether the CRC that a CDR sample carries is right.

    :param name: DDS type name, one of :data:`LOW_LEVEL_TYPES`.
    :raises UsageError: another type.
    :raises WireError: not a sample of that type.
    """
    image = _image_of(name)
    payload = image.little(payload)
    return image.crc(payload) == int.from_bytes(payload[-4:], "little")


def crc_of(message: Any) -> int:
    """The CRC that a message should carry; its member ``crc`` has no part in it.

    :raises UsageError: a type without a CRC.
    :raises EncodeError: a value that its type cannot hold.
    """
    return _image_of(_name(message)).crc(encode(message))


def verify(message: Any) -> bool:
    """Whether ``message.crc`` is the right CRC.

    :raises UsageError: a type without a CRC.
    :raises EncodeError: a value that its type cannot hold.
    """
    return bool(crc_of(message) == message.crc)


def encode_with_crc(message: Any) -> bytes:
    """The message as CDR with the right CRC in its last member, whatever ``message.crc`` says.

    :raises UsageError: a type without a CRC.
    :raises EncodeError: a value that its type cannot hold.
    """
    image = _image_of(_name(message))
    payload = encode(message)
    return payload[:-4] + image.crc(payload).to_bytes(4, "little")


def _name(message: Any) -> str:
    package = type(message).__module__.rsplit(".", 1)[-1]
    return f"{package}::msg::dds_::{type(message).__name__}"
