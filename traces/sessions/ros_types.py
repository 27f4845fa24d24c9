"""Encode and decode the standard ROS 2 types in imported recordings, as plain CDR.

Imported data that do not fit Unitree's messages use types that Foxglove, PlotJuggler and rosbags
know: groups of joints as ``sensor_msgs/msg/JointState``, pictures as
``sensor_msgs/msg/CompressedImage``, everything else as JSON in ``std_msgs/msg/String``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from dexkit.errors import OversizeError, TruncatedError, WireError
from dexkit.traces.names import SESSION, dds_type
from dexkit.traces.reader import Definition

__all__ = [
    "COMPRESSED_IMAGE",
    "JOINT_STATE",
    "STRING",
    "CompressedImage",
    "JointState",
    "RosType",
    "decode_compressed_image",
    "decode_joint_state",
    "decode_string",
    "encode_compressed_image",
    "encode_joint_state",
    "encode_string",
    "group_topic",
]

_HEADER = b"\x00\x01\x00\x00"
_MAX = 64 * 2**20  # bytes of one message
_SEPARATOR = "=" * 80
_STAMP = f"""{_SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


@dataclass(frozen=True)
class RosType:
    """A type and its definition."""

    ros_name: str
    text: str

    @property
    def dds_name(self) -> str:
        """Its DDS name, as in the reader of recordings."""
        return dds_type(self.ros_name)

    def definition(self, topic: str, metadata: dict[str, str] | None = None) -> Definition:
        """A channel of this type."""
        schema = (self.ros_name, "ros2msg", self.text.encode())
        return Definition(topic, "cdr", metadata or {}, schema)


JOINT_STATE = RosType(
    "sensor_msgs/msg/JointState",
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{_STAMP}",
)
COMPRESSED_IMAGE = RosType(
    "sensor_msgs/msg/CompressedImage",
    f"std_msgs/Header header\nstring format\nuint8[] data\n{_STAMP}",
)
STRING = RosType("std_msgs/msg/String", "string data\n")


@dataclass(frozen=True)
class JointState:
    """Joints at one time; an unknown column is empty.

    :param stamp_ns: ns since the epoch.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


@dataclass(frozen=True)
class CompressedImage:
    """An encoded picture.

    :param form: ``jpeg`` or ``png``.
    """

    stamp_ns: int
    frame_id: str
    form: str
    data: bytes


def group_topic(part: str, what: str) -> str:
    """The topic of a part: ``rt/session/left_arm/state``."""
    return f"{SESSION}{part}/{what}"


class _Out:
    def __init__(self) -> None:
        self._data = bytearray()

    def align(self, size: int) -> None:
        self._data += b"\x00" * (-len(self._data) % size)

    def number(self, form: str, value: float) -> None:
        self.align(struct.calcsize(form))
        self._data += struct.pack(f"<{form}", value)

    def text(self, text: str) -> None:
        # half a surrogate pair, which JSON can hold, becomes JSON's escape of it
        data = text.encode("utf-8", "backslashreplace")
        self.number("I", len(data) + 1)
        self._data += data + b"\x00"

    def data(self, data: bytes) -> None:
        self.number("I", len(data))
        self._data += data

    def floats(self, values: tuple[float, ...]) -> None:
        self.number("I", len(values))
        if values:
            self.align(8)
            self._data += struct.pack(f"<{len(values)}d", *values)

    def stamp(self, stamp_ns: int, frame_id: str) -> None:
        self.number("i", stamp_ns // 10**9)
        self.number("I", stamp_ns % 10**9)
        self.text(frame_id)

    def done(self) -> bytes:
        return _HEADER + bytes(self._data)


class _In:
    """Reads fields in order.

    :raises WireError: not plain little-endian CDR, or it ends too early.
    """

    def __init__(self, name: str, data: bytes) -> None:
        if data[:2] != _HEADER[:2]:
            raise WireError(f"{name}: not plain little-endian CDR")
        if len(data) > _MAX:
            raise OversizeError(f"{name}: {len(data)} bytes, at most {_MAX} are accepted")
        self._name = name
        self._data = data[4:]
        self._at = 0

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise TruncatedError(f"{self._name}: ends within a field")
        self._at += size
        return self._data[self._at - size : self._at]

    def align(self, size: int) -> None:
        self._take(min(-self._at % size, len(self._data) - self._at))

    def number(self, form: str) -> int:
        size = struct.calcsize(form)
        self.align(size)
        return int(struct.unpack(f"<{form}", self._take(size))[0])

    def text(self) -> str:
        try:
            return self._take(self.number("I")).rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise WireError(f"{self._name}: a text is not UTF-8") from None

    def data(self) -> bytes:
        return self._take(self.number("I"))

    def floats(self) -> tuple[float, ...]:
        count = self.number("I")
        if not count:
            return ()
        self.align(8)
        return struct.unpack(f"<{count}d", self._take(8 * count))

    def stamp(self) -> tuple[int, str]:
        seconds, nanos = self.number("i"), self.number("I")
        return seconds * 10**9 + nanos, self.text()


def encode_joint_state(state: JointState) -> bytes:
    """One message."""
    out = _Out()
    out.stamp(state.stamp_ns, "")
    out.number("I", len(state.names))
    for name in state.names:
        out.text(name)
    for column in (state.position, state.velocity, state.effort):
        out.floats(column)
    return out.done()


def decode_joint_state(data: bytes) -> JointState:
    """One message.

    :raises WireError: it is none.
    """
    source = _In("JointState", data)
    stamp, _ = source.stamp()
    count = source.number("I")
    if count > len(data) // 5:
        raise TruncatedError("JointState: more names than bytes")
    names = tuple(source.text() for _ in range(count))
    return JointState(stamp, names, source.floats(), source.floats(), source.floats())


def encode_compressed_image(image: CompressedImage) -> bytes:
    """One message."""
    out = _Out()
    out.stamp(image.stamp_ns, image.frame_id)
    out.text(image.form)
    out.data(image.data)
    return out.done()


def decode_compressed_image(data: bytes) -> CompressedImage:
    """One message.

    :raises WireError: it is none.
    """
    source = _In("CompressedImage", data)
    stamp, frame = source.stamp()
    return CompressedImage(stamp, frame, source.text(), source.data())


def encode_string(text: str) -> bytes:
    """One message."""
    out = _Out()
    out.text(text)
    return out.done()


def decode_string(data: bytes) -> str:
    """One message.

    :raises WireError: it is none.
    """
    return _In("String", data).text()
