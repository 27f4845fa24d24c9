"""Convert payloads of earlier layouts of Unitree's messages to the present ones, by member name.

A bag's schema gives the layout. Without schemas the present and the earlier layouts are tried
(docs/sources/unitree-dex.md#a3, docs/sources/sessions.md#d2): plain CDR does not name its layout,
but a payload has the right length for only one of them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

from dexkit.errors import TraceUnsupported, WireError
from dexkit.messages import MessageType, message_type
from dexkit.messages.earlier import EARLIER
from dexkit.messages.layout import MAX_ELEMENTS, STRUCTS
from dexkit.messages.layout import Struct as OwnStruct
from dexkit.messages.schemas import omgidl
from dexkit.traces import schemas
from dexkit.traces.names import dds_type

__all__ = [
    "converter",
    "decode",
    "earlier_layouts",
    "matching_layout",
]

# Values of a message that need no byte, and structures around a number.
_NODES, _DEEPEST = 1000, 20
_FORMS = {
    "bool": "?",
    "u8": "B",
    "i8": "b",
    "u16": "H",
    "i16": "h",
    "u32": "I",
    "i32": "i",
    "u64": "Q",
    "i64": "q",
    "f32": "f",
    "f64": "d",
}


def earlier_layouts(type_name: str) -> dict[str, schemas.Struct]:
    """Earlier layouts of a type, by date."""
    return {
        f"of {layout.when}": schemas.parse("omgidl", type_name, omgidl(layout.struct))
        for layout in EARLIER.get(type_name, ())
    }


def converter(
    type_name: str, recorded: schemas.Struct
) -> tuple[Callable[[bytes], bytes] | None, list[str]]:
    """Make a converter from a recorded layout to the present one.

    :returns: (converter, or None if the layouts are equal; the members that differ).
    :raises TraceUnsupported: dexkit does not know the type.
    """
    if type_name not in STRUCTS:
        raise TraceUnsupported(f"dexkit does not know the type {type_name}")
    own = schemas.parse("omgidl", type_name, omgidl(STRUCTS[type_name]))
    breaking, _ = schemas.differences(recorded, own)
    if not breaking:
        return None, []
    mt = message_type(type_name)

    def convert(data: bytes) -> bytes:
        return mt.encode(_message(mt.layout, mt.cls, decode(recorded, data)))

    return convert, breaking


def matching_layout(
    type_name: str, payloads: Sequence[bytes]
) -> tuple[str, schemas.Struct | None] | None:
    """The layout that fits all payloads: its date and structure.

    ``("present", None)`` for the present one, None if there is none.
    """
    mt: MessageType = message_type(type_name)
    if not mt.columns(payloads).errors:
        return "present", None
    for when, layout in earlier_layouts(type_name).items():
        try:
            for data in payloads:
                decode(layout, data)
        except WireError:
            continue
        return when, layout
    return None


def decode(layout: schemas.Struct, data: bytes) -> dict[str, Any]:
    """The values of a payload by member, read by any layout.

    :raises WireError: the payload is not of this layout, or not plain CDR.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise WireError(f"{layout.name}: not plain CDR")
    reader = _Reader(data[4:], "<" if data[1] else ">")
    found: dict[str, Any] = reader.node(layout)
    # writers may pad to a multiple of four bytes
    if reader.left >= 4:
        raise WireError(f"{layout.name}: {reader.left} bytes are left over")
    return found


class _Reader:
    def __init__(self, data: bytes, order: str) -> None:
        self._data = data
        self._order = order
        self._at = 0
        # every number has a byte and at most so many structures around it; an array of structures
        # without members has none, and would have no end
        self._nodes = _NODES + _DEEPEST * len(data)

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def node(self, node: schemas.Node) -> Any:
        self._nodes -= 1
        if self._nodes < 0:
            raise WireError(f"more than {_DEEPEST} members for each byte")
        if isinstance(node, schemas.Struct):
            return {f.name: self.node(f.type) for f in node.fields}
        if isinstance(node, schemas.Array):
            return tuple(self.node(node.element) for _ in range(node.length))
        if isinstance(node, schemas.Sequence):
            count = self._number("I")
            if count > MAX_ELEMENTS:
                raise WireError(f"a sequence of {count} elements")
            return [self.node(node.element) for _ in range(count)]
        if node == "string":
            size = self._number("I")
            return self._take(size).rstrip(b"\x00").decode("utf-8", "replace")
        if node not in _FORMS:
            raise WireError(f"a {node} cannot be read")
        return self._number(_FORMS[node])

    def _take(self, size: int) -> bytes:
        if size > self.left:
            raise WireError("it ends within a member")
        self._at += size
        return self._data[self._at - size : self._at]

    def _number(self, form: str) -> Any:
        size = struct.calcsize(form)
        self._take(min(-self._at % size, self.left))
        return struct.unpack(self._order + form, self._take(size))[0]


def _message(layout: OwnStruct, cls: type[Any], values: Any) -> Any:
    """A message of the present layout; missing members get their default.

    :raises WireError: the earlier layout has something else there than a structure.
    """
    if not isinstance(values, dict):
        raise WireError(f"{layout.ros_name}: it is no structure in this layout")
    given: dict[str, Any] = {}
    for member in layout.fields:
        if member.name not in values:
            continue
        value = values[member.name]
        if isinstance(member.type, OwnStruct):
            inner = member.type
            kind = message_type(dds_type(inner.ros_name)).cls
            if isinstance(value, list | tuple):
                value = type(value)(_message(inner, kind, v) for v in value)
            else:
                value = _message(inner, kind, value)
        given[member.name] = value
    return cls(**given)
