"""Parse and build the RTPS messages that the observer of a domain needs, sans IO.

An observer speaks RTPS itself instead of joining with CycloneDDS, for three reasons. It sees
peers that CycloneDDS 0.10 does not survive: what kills a 0.10 process is the type object that an
11.x peer sends when asked for it (docs/sources/unitree-dex.md#f), and an observer never asks. It
needs no CycloneDDS, so it works on any Python. And it costs a socket a domain, so that a dozen
domains are looked at in a second.

Numbers are those of the OMG's "DDS Interoperability Wire Protocol" 2.5, chapter 9. Vendor ids
are from the OMG's registry; the vendor parameter 0x8007, in which CycloneDDS announces its
version, was found in the announcements of real 0.10.5 and 11.0.1 participants.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from dexkit.errors import TruncatedError, WireError

__all__ = [
    "BUILTIN_ENDPOINTS",
    "SEDP_PUBLICATIONS",
    "SEDP_SUBSCRIPTIONS",
    "SPDP_WRITER",
    "AckNack",
    "Data",
    "DataFrag",
    "EndpointData",
    "Gap",
    "Heartbeat",
    "Locator",
    "ParticipantData",
    "Policies",
    "Submessage",
    "build_acknack",
    "build_data",
    "build_endpoint",
    "build_heartbeat",
    "build_participant",
    "detector_of",
    "message",
    "parse_endpoint",
    "parse_message",
    "parse_participant",
    "spdp_multicast_port",
    "unicast_port",
    "vendor_name",
]

SPDP_WRITER = bytes.fromhex("000100c2")
SEDP_PUBLICATIONS = bytes.fromhex("000003c2")
SEDP_SUBSCRIPTIONS = bytes.fromhex("000004c2")
_PARTICIPANT = bytes.fromhex("000001c1")

BUILTIN_ENDPOINTS = 0b111011
"""Built-in endpoints of an observer (PID_BUILTIN_ENDPOINT_SET): it announces its participant (bit
0) and its
subscriptions (4), and detects participants (1), publications (3) and subscriptions (5). It
publishes nothing."""

_VENDORS = {
    0x0101: "RTI Connext",
    0x0102: "OpenSplice",
    0x0103: "OpenDDS",
    0x0106: "CoreDX",
    0x010F: "Fast DDS",
    0x0110: "CycloneDDS",
    0x0112: "RustDDS",
}

_PID_SENTINEL = 0x0001
_PID_LEASE = 0x0002
_PID_TOPIC = 0x0005
_PID_TYPE = 0x0007
_PID_DOMAIN = 0x000F
_PID_PROTOCOL = 0x0015
_PID_VENDOR = 0x0016
_PID_RELIABILITY = 0x001A
_PID_LIVELINESS = 0x001B
_PID_DURABILITY = 0x001D
_PID_OWNERSHIP = 0x001F
_PID_DEADLINE = 0x0023
_PID_PARTITION = 0x0029
_PID_UNICAST = 0x0031
_PID_META_UNICAST = 0x0032
_PID_MULTICAST = 0x0033
_PID_META_MULTICAST = 0x0048
_PID_PARTICIPANT_GUID = 0x0050
_PID_BUILTIN_SET = 0x0058
_PID_PROPERTIES = 0x0059
_PID_ENDPOINT_GUID = 0x005A
_PID_STATUS_INFO = 0x0071
_PID_REPRESENTATION = 0x0073
_PID_TYPE_INFORMATION = 0x0075
_PID_CYCLONE_VERSION = 0x8007

_MUST_UNDERSTAND = 0x4000

_UDPV4 = 1
_INFINITE = (0x7FFFFFFF, 0xFFFFFFFF)
_HEADER = 20
_GONE = 0x3  # disposed or unregistered
_MAX_BITS = 256  # of a sequence number set


def spdp_multicast_port(domain: int) -> int:
    """UDP port on which participants of a domain discover each other by multicast."""
    return 7400 + 250 * domain


def unicast_port(domain: int, index: int) -> int:
    """UDP port of discovery of the participant with an index on its machine."""
    return 7410 + 250 * domain + 2 * index


def vendor_name(vendor: int) -> str:
    """Name of a vendor id."""
    return _VENDORS.get(vendor, f"vendor 0x{vendor:04x}")


@dataclass(frozen=True, slots=True)
class Locator:
    """An IPv4 address and UDP port."""

    address: str
    port: int


@dataclass(frozen=True, slots=True)
class Data:
    """One sample or one announcement.

    :param source: GUID prefix of the sender, 12 bytes.
    :param writer: entity id, 4 bytes.
    :param payload: serialised, encapsulation header included; empty when there is none.
    :param gone: the instance was disposed of or unregistered.
    :param written: when it was written by the writer's clock, seconds since the epoch; 0 if that
        is not said.
    """

    source: bytes
    writer: bytes
    sequence: int
    payload: bytes
    gone: bool
    written: float = 0.0


@dataclass(frozen=True, slots=True)
class DataFrag:
    """A part of a sample that is too long for one packet.

    :param first: number of the first fragment in it, counted from 1.
    :param size: bytes of each fragment but the last.
    :param total: bytes of the sample.
    """

    source: bytes
    writer: bytes
    sequence: int
    first: int
    size: int
    total: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A reliable writer announces which samples it holds.

    :param final: it wants no answer.
    """

    source: bytes
    writer: bytes
    first: int
    last: int
    final: bool


@dataclass(frozen=True, slots=True)
class Gap:
    """A writer announces that these samples will not come."""

    source: bytes
    writer: bytes
    numbers: tuple[int, ...]
    before: int
    start: int


@dataclass(frozen=True, slots=True)
class AckNack:
    """A reader acknowledges everything before ``base``, and requests ``missing``."""

    source: bytes
    writer: bytes
    base: int
    missing: tuple[int, ...]
    final: bool


Submessage = Data | DataFrag | Heartbeat | Gap | AckNack


@dataclass(frozen=True)
class ParticipantData:
    """The announcement of a participant.

    :param prefix: GUID prefix, 12 bytes.
    :param version: of CycloneDDS, e.g. ``"0.10.5"``, or empty.
    :param properties: ``__ProcessName``, ``__Pid``, ``__Hostname`` with CycloneDDS.
    :param discovery: where it takes discovery messages.
    :param data: where it takes samples.
    :param multicast: it listens to multicast.
    :param domain: number of its domain; None where it does not say.
    """

    prefix: bytes
    vendor: int
    version: str
    properties: dict[str, str]
    discovery: tuple[Locator, ...]
    data: tuple[Locator, ...]
    multicast: bool
    domain: int | None = None


@dataclass(frozen=True)
class Policies:
    """Quality of service of an endpoint; a policy that it does not announce has the default.

    :param reliability: ``"reliable"`` or ``"best_effort"``.
    :param durability: ``"volatile"``, ``"transient_local"``, ``"transient"``, ``"persistent"``.
    :param deadline: seconds; infinity when there is none.
    :param liveliness: 0 automatic, 1 manual by participant, 2 manual by topic.
    :param exclusive: exclusive ownership.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: float = float("inf")
    liveliness: int = 0
    exclusive: bool = False
    partitions: tuple[str, ...] = ()


@dataclass(frozen=True)
class EndpointData:
    """The announcement of a reader or writer.

    :param guid: 16 bytes.
    :param type_hash: of the complete type, hex, as :attr:`dexkit.dds.Endpoint.type_hash`; empty
        when no type is described.
    """

    guid: bytes
    topic: str
    type_name: str
    qos: Policies
    type_hash: str


# --- reading


def parse_message(data: bytes) -> tuple[bytes, list[tuple[bytes, Submessage]]]:
    """The submessages of a packet that an observer understands; it skips the others.

    :returns: GUID prefix of the sender, and ``(destination, submessage)`` pairs; a destination
        of zeros means everybody.
    :raises WireError: not an RTPS packet.
    :raises TruncatedError: it ends within a submessage.
    """
    if len(data) < _HEADER or data[:4] != b"RTPS":
        raise WireError("not an RTPS packet")
    if data[4] != 2:
        raise WireError(f"RTPS version {data[4]}")
    sender = source = data[8:20]
    destination = bytes(12)
    written = 0.0
    found: list[tuple[bytes, Submessage]] = []
    at = _HEADER
    while at + 4 <= len(data):
        kind, flags = data[at], data[at + 1]
        order = "<" if flags & 1 else ">"
        (length,) = struct.unpack_from(order + "H", data, at + 2)
        # 0 in the last submessage means "to the end", but for PAD and INFO_TS
        if length == 0 and kind not in (0x01, 0x09):
            length = len(data) - at - 4
        body = data[at + 4 : at + 4 + length]
        if len(body) < length:
            raise TruncatedError(f"submessage 0x{kind:02x} of {length} bytes ends early")
        at += 4 + length
        try:
            if kind == 0x0E:
                destination = body[:12].ljust(12, b"\0")
            elif kind == 0x0C and len(body) >= 20:
                source = body[8:20]
            elif kind == 0x09:  # INFO_TS: the time of what follows, or none
                whole, fraction = (0, 0) if flags & 2 else struct.unpack_from(order + "II", body)
                written = whole + fraction / 2**32
            elif kind in _READERS:
                item = _READERS[kind](source, body, flags, order)
                if written and isinstance(item, Data):
                    item = replace(item, written=written)
                found.append((destination, item))
        except struct.error:
            raise TruncatedError(f"submessage 0x{kind:02x} is too short") from None
    return sender, found


def _number(body: bytes, at: int, order: str) -> int:
    high, low = struct.unpack_from(order + "iI", body, at)
    return int(high) << 32 | int(low)


def _number_set(body: bytes, at: int, order: str) -> tuple[int, tuple[int, ...]]:
    base = _number(body, at, order)
    (bits,) = struct.unpack_from(order + "I", body, at + 8)
    if bits > _MAX_BITS:
        raise WireError(f"a sequence number set of {bits} bits")
    words = struct.unpack_from(f"{order}{(bits + 31) // 32}I", body, at + 12)
    return base, tuple(base + i for i in range(bits) if words[i // 32] >> (31 - i % 32) & 1)


def _data(source: bytes, body: bytes, flags: int, order: str) -> Data:
    (to_qos,) = struct.unpack_from(order + "H", body, 2)
    writer, sequence = body[8:12], _number(body, 12, order)
    at, gone = 4 + to_qos, False
    if flags & 0x02:
        at, gone = _inline_qos(body, at, order)
    payload = body[at:] if flags & 0x0C else b""
    return Data(source, writer, sequence, payload, gone)


def _data_frag(source: bytes, body: bytes, flags: int, order: str) -> DataFrag:
    (to_qos,) = struct.unpack_from(order + "H", body, 2)
    first, _, size, total = struct.unpack_from(order + "IHHI", body, 20)
    at = 4 + to_qos
    if flags & 0x02:
        at, _ = _inline_qos(body, at, order)
    return DataFrag(
        source, body[8:12], _number(body, 12, order), first, size, total, bytes(body[at:])
    )


def _inline_qos(body: bytes, at: int, order: str) -> tuple[int, bool]:
    gone = False
    while True:
        pid, length = struct.unpack_from(order + "HH", body, at)
        at += 4
        if pid == _PID_SENTINEL:
            return at, gone
        if pid == _PID_STATUS_INFO and length >= 4:
            gone = bool(body[at + 3 : at + 4] and body[at + 3] & _GONE)
        at += length


def _heartbeat(source: bytes, body: bytes, flags: int, order: str) -> Heartbeat:
    first, last = _number(body, 8, order), _number(body, 16, order)
    return Heartbeat(source, body[4:8], first, last, bool(flags & 0x02))


def _gap(source: bytes, body: bytes, flags: int, order: str) -> Gap:
    start = _number(body, 8, order)
    before, numbers = _number_set(body, 16, order)
    return Gap(source, body[4:8], numbers, before, start)


def _acknack(source: bytes, body: bytes, flags: int, order: str) -> AckNack:
    base, missing = _number_set(body, 8, order)
    return AckNack(source, body[4:8], base, missing, bool(flags & 0x02))


_READERS: dict[int, Callable[[bytes, bytes, int, str], Submessage]] = {
    0x15: _data,
    0x16: _data_frag,
    0x07: _heartbeat,
    0x08: _gap,
    0x06: _acknack,
}


def _parameters(payload: bytes) -> tuple[str, Iterator[tuple[int, bytes]]]:
    """Byte order and ``(id, value)`` pairs of a serialised parameter list."""
    if len(payload) < 4 or payload[0] != 0 or payload[1] not in (2, 3):
        raise WireError("not a parameter list")
    order = "<" if payload[1] == 3 else ">"

    def pairs() -> Iterator[tuple[int, bytes]]:
        at = 4
        while at + 4 <= len(payload):
            pid, length = struct.unpack_from(order + "HH", payload, at)
            if pid == _PID_SENTINEL:
                return
            value = payload[at + 4 : at + 4 + length]
            if len(value) < length:
                raise TruncatedError(f"parameter 0x{pid:04x} of {length} bytes ends early")
            yield pid & ~_MUST_UNDERSTAND, value
            at += 4 + length

    return order, pairs()


def _string(value: bytes, order: str, at: int = 0) -> tuple[str, int]:
    """A CDR string and where the next one begins."""
    (length,) = struct.unpack_from(order + "I", value, at)
    at += 4
    text = value[at : at + length]
    if len(text) < length:
        raise TruncatedError(f"a string of {length} bytes ends early")
    at += length
    return text.rstrip(b"\0").decode("utf-8", "replace"), at + -at % 4


def _locator(value: bytes, order: str) -> Locator | None:
    kind, port = struct.unpack_from(order + "iI", value)
    if kind != _UDPV4 or len(value) < 24 or not 0 < port < 65536:
        return None
    return Locator(socket.inet_ntoa(value[20:24]), port)


def parse_participant(payload: bytes) -> ParticipantData:
    """Read an SPDP announcement.

    :raises WireError: it is none.
    """
    order, pairs = _parameters(payload)
    prefix, vendor, version = b"", 0, ""
    domain: int | None = None
    properties: dict[str, str] = {}
    places: dict[int, list[Locator]] = {
        pid: [] for pid in (_PID_UNICAST, _PID_META_UNICAST, _PID_MULTICAST, _PID_META_MULTICAST)
    }
    try:
        for pid, value in pairs:
            if pid == _PID_PARTICIPANT_GUID:
                prefix = value[:12]
            elif pid == _PID_VENDOR and len(value) >= 2:
                vendor = value[0] << 8 | value[1]
            elif pid == _PID_DOMAIN:
                domain = _word(value, order)
            elif pid in places:
                place = _locator(value, order)
                if place is not None:
                    places[pid].append(place)
            elif pid == _PID_PROPERTIES:
                (count,) = struct.unpack_from(order + "I", value)
                at = 4
                for _ in range(min(count, 64)):
                    key, at = _string(value, order, at)
                    properties[key], at = _string(value, order, at)
            elif pid == _PID_CYCLONE_VERSION and len(value) >= 24:
                # a version, flags, three words, and "host/0.10.5/Linux/Linux"
                parts = _string(value, order, 20)[0].rsplit("/", 3)
                version = parts[1] if len(parts) == 4 else ""
    except struct.error:
        raise TruncatedError("an announcement of a participant is too short") from None
    if len(prefix) != 12:
        raise WireError("an announcement without a participant")
    return ParticipantData(
        prefix=bytes(prefix),
        vendor=vendor,
        version=version if vendor == 0x0110 else "",
        properties=properties,
        discovery=tuple(places[_PID_META_UNICAST]),
        data=tuple(places[_PID_UNICAST]),
        multicast=bool(places[_PID_MULTICAST] or places[_PID_META_MULTICAST]),
        domain=domain,
    )


_DURABILITY = ("volatile", "transient_local", "transient", "persistent")


def parse_endpoint(payload: bytes, *, writer: bool) -> EndpointData:
    """Read an SEDP announcement.

    :param writer: it is a writer, whose default is to be reliable; a reader's is not.
    :raises WireError: it is none.
    """
    order, pairs = _parameters(payload)
    guid, topic, type_name, type_hash = b"", "", "", ""
    reliability, durability = "reliable" if writer else "best_effort", "volatile"
    deadline, liveliness, exclusive = float("inf"), 0, False
    partitions: tuple[str, ...] = ()
    try:
        for pid, value in pairs:
            if pid == _PID_ENDPOINT_GUID:
                guid = value[:16]
            elif pid == _PID_TOPIC:
                topic = _string(value, order)[0]
            elif pid == _PID_TYPE:
                type_name = _string(value, order)[0]
            elif pid == _PID_RELIABILITY:
                reliability = "best_effort" if _word(value, order) == 1 else "reliable"
            elif pid == _PID_DURABILITY:
                durability = _DURABILITY[min(_word(value, order), 3)]
            elif pid == _PID_LIVELINESS:
                liveliness = _word(value, order)
            elif pid == _PID_OWNERSHIP:
                exclusive = _word(value, order) == 1
            elif pid == _PID_DEADLINE:
                seconds, fraction = struct.unpack_from(order + "II", value)
                if (seconds, fraction) != _INFINITE:
                    deadline = seconds + fraction / 2**32
            elif pid == _PID_PARTITION:
                names, at = [], 4
                for _ in range(min(_word(value, order), 64)):
                    name, at = _string(value, order, at)
                    names.append(name)
                partitions = tuple(names)
            elif pid == _PID_TYPE_INFORMATION:
                type_hash = _complete_hash(value)
    except struct.error:
        raise TruncatedError("an announcement of an endpoint is too short") from None
    if len(guid) != 16:
        raise WireError("an announcement without an endpoint")
    qos = Policies(reliability, durability, deadline, liveliness, exclusive, partitions)
    return EndpointData(bytes(guid), topic, type_name, qos, type_hash)


def _word(value: bytes, order: str) -> int:
    return int(struct.unpack_from(order + "I", value)[0])


def _complete_hash(value: bytes) -> str:
    """The hash of the complete type in a TypeInformation (DDS-XTypes 7.6.3.2.1).

    The first identifier of the kind EK_COMPLETE (0xf2) in a 20 byte TypeIdentifierWithSize is
    the type's own; those of the types that it contains follow.
    """
    at = value.find(b"\x14\0\0\0\xf2")
    digest = value[at + 5 : at + 19] if at >= 0 else b""
    return digest.hex() if len(digest) == 14 else ""


# --- writing; always little-endian


def message(prefix: bytes, *submessages: bytes) -> bytes:
    """A packet of the participant ``prefix``."""
    return b"RTPS\x02\x01\x00\x00" + prefix + b"".join(submessages)


def _submessage(kind: int, flags: int, body: bytes) -> bytes:
    return struct.pack("<BBH", kind, flags | 1, len(body)) + body


def _to(destination: bytes | None) -> bytes:
    return b"" if destination is None else _submessage(0x0E, 0, destination)


def _pack_number(number: int) -> bytes:
    return struct.pack("<iI", number >> 32, number & 0xFFFFFFFF)


def detector_of(writer: bytes) -> bytes:
    """Entity id of the built-in reader of a built-in writer."""
    return writer[:3] + b"\xc7"


def build_data(
    writer: bytes,
    sequence: int,
    payload: bytes,
    *,
    destination: bytes | None = None,
    gone: bool = False,
) -> bytes:
    """An announcement, to ``destination`` (a GUID prefix) or everybody."""
    body = struct.pack("<HH", 0, 16) + detector_of(writer) + writer + _pack_number(sequence)
    flags = 0x04
    if gone:
        status = struct.pack("<HH", _PID_STATUS_INFO, 4) + bytes((0, 0, 0, _GONE))
        body += status + struct.pack("<HH", _PID_SENTINEL, 0)
        flags = 0x08 | 0x02  # key only, inline QoS
    return _to(destination) + _submessage(0x15, flags, body + payload)


def build_heartbeat(
    writer: bytes, first: int, last: int, count: int, *, destination: bytes | None = None
) -> bytes:
    """A heartbeat that asks for an answer."""
    body = detector_of(writer) + writer + _pack_number(first) + _pack_number(last)
    return _to(destination) + _submessage(0x07, 0, body + struct.pack("<I", count))


def build_acknack(
    writer: bytes, base: int, missing: list[int], count: int, *, destination: bytes, final: bool
) -> bytes:
    """Acknowledge everything before ``base``, and ask for ``missing``.

    :param missing: numbers not before ``base``; those more than 255 after it are left for later.
    :param final: no answer is wanted.
    """
    numbers = [n for n in missing if base <= n < base + _MAX_BITS]
    bits = max(numbers) - base + 1 if numbers else 0
    words = [0] * ((bits + 31) // 32)
    for number in numbers:
        words[(number - base) // 32] |= 1 << (31 - (number - base) % 32)
    body = detector_of(writer) + writer + _pack_number(base)
    body += struct.pack(f"<I{len(words)}II", bits, *words, count)
    return _to(destination) + _submessage(0x06, 0x02 if final else 0, body)


def _parameter(pid: int, value: bytes) -> bytes:
    value += bytes(-len(value) % 4)
    return struct.pack("<HH", pid, len(value)) + value


def _pack_string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


def _pack_locator(place: Locator) -> bytes:
    return struct.pack("<iI", _UDPV4, place.port) + bytes(12) + socket.inet_aton(place.address)


@dataclass(frozen=True)
class _Announcement:
    parameters: list[bytes] = field(default_factory=list)

    def add(self, pid: int, value: bytes) -> None:
        self.parameters.append(_parameter(pid, value))

    def bytes(self) -> bytes:
        return b"\0\x03\0\0" + b"".join(self.parameters) + _parameter(_PID_SENTINEL, b"")


def build_participant(
    prefix: bytes,
    place: Locator,
    *,
    lease: int,
    properties: dict[str, str] | None = None,
    domain: int | None = None,
) -> bytes:
    """The announcement of a participant that takes everything at one place.

    :param lease: seconds after which others forget it.
    :param domain: number of its domain; None does not say it.
    """
    out = _Announcement()
    out.add(_PID_PROTOCOL, b"\x02\x01")
    out.add(_PID_VENDOR, b"\0\0")
    out.add(_PID_PARTICIPANT_GUID, prefix + _PARTICIPANT)
    if domain is not None:
        out.add(_PID_DOMAIN, struct.pack("<I", domain))
    out.add(_PID_BUILTIN_SET, struct.pack("<I", BUILTIN_ENDPOINTS))
    out.add(_PID_LEASE, struct.pack("<iI", lease, 0))
    out.add(_PID_UNICAST, _pack_locator(place))
    out.add(_PID_META_UNICAST, _pack_locator(place))
    if properties:
        packed = struct.pack("<I", len(properties))
        for key, value in properties.items():
            packed += _pack_string(key) + _pack_string(value)
        out.add(_PID_PROPERTIES, packed)
    return out.bytes()


def build_endpoint(guid: bytes, topic: str, type_name: str) -> bytes:
    """The announcement of a best-effort, volatile reader that describes no type."""
    out = _Announcement()
    out.add(_PID_TOPIC, _pack_string(topic))
    out.add(_PID_TYPE, _pack_string(type_name))
    out.add(_PID_RELIABILITY, struct.pack("<IiI", 1, 0, 0))
    out.add(_PID_REPRESENTATION, struct.pack("<IHH", 2, 0, 2))  # XCDR1, XCDR2
    out.add(_PID_PROTOCOL, b"\x02\x01")
    out.add(_PID_VENDOR, b"\0\0")
    out.add(_PID_PARTICIPANT_GUID, guid[:12] + _PARTICIPANT)
    out.add(_PID_ENDPOINT_GUID, guid)
    return out.bytes()
