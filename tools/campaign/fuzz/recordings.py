"""Damaged and hostile recordings from a seed.

Three of ten have records made up and checksums made right again, the others are damaged without. A
finding is an error that is not dexkit's own, work out of proportion to the size of the file, or a
change of what is read that the reader does not report.
"""

from __future__ import annotations

import io
import random
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.writer import CompressionType, IndexType, Writer

from dexkit.cli.info import summary
from dexkit.messages import message_type
from dexkit.traces import open_trace
from dexkit.traces.mcap_records import HEAD, walk
from tools.campaign.fuzz.case import Difference, FuzzCase, Target
from tools.campaign.fuzz.messages import filled
from tools.campaign.mutate import mutator

__all__ = ["TIME", "TYPES", "cases", "content", "count_calls", "damage", "small_recording"]

TIME = 1_795_251_429_000_000_000
TYPES = {
    "rt/dex1/left/cmd": "unitree_go::msg::dds_::MotorCmds_",
    "rt/dex1/left/state": "unitree_go::msg::dds_::MotorStates_",
    "rt/dex3/left/state": "unitree_hg::msg::dds_::HandState_",
}

# Calls that reading may take: for the file's bytes, for those that its chunks unpack to, and for
# anything at all (types are compared with dexkit's own).
_PER_BYTE, _PER_UNPACKED, _FIXED = 20, 2, 200_000

_NUMBERS = (0, 1, 7, 8, 9, 21, 22, 255, 2**16 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1)
_TEXTS = (
    b"",
    b"rt/dex1/left/cmd",
    b"unitree_go/msg/MotorStates",
    b"\xff\xfe",
    b"\n" * 5000,
    b"/* " * 2000,
    b'"\\' * 2000,
    b"MSG: a/b\n" * 500,
    b"sequence<" * 500,
    "²\0\x1b[2J".encode(),
)


def small_recording(
    rng: random.Random,
    compression: CompressionType = CompressionType.NONE,
    *,
    index: IndexType = IndexType.ALL,
    chunked: bool = True,
    summary: bool = True,
    sums: bool = True,
) -> bytes:
    """A recording by the mcap library, with dexkit's topics and schemas.

    :param sums: whether all bytes are under a checksum.
    """
    out = io.BytesIO()
    writer = Writer(
        out,
        chunk_size=700,
        compression=compression,
        index_types=index,
        use_chunking=chunked,
        repeat_channels=summary,
        repeat_schemas=summary,
        use_statistics=summary,
        use_summary_offsets=summary,
        enable_data_crcs=sums,
    )
    writer.start(profile="ros2", library="campaign")
    for at, (topic, name) in enumerate(TYPES.items()):
        kind = message_type(name)
        schema = writer.register_schema(kind.layout.ros_name, "ros2msg", kind.ros2msg.encode())
        channel = writer.register_channel(topic, "cdr", schema, {"dds.type": kind.name})
        for number in range(4):
            stamp = TIME + number * 10_000_000 + at
            writer.add_message(channel, stamp, kind.encode(filled(name, rng)), stamp, number)
    writer.add_metadata(
        "dds_endpoints", {"rt/dex1/left/cmd writer": "Reliable, Durability.Volatile"}
    )
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def _bases(rng: random.Random) -> list[tuple[bytes, bool]]:
    """Small recordings of each shape, and whether all of their bytes are under a checksum."""
    zstd, lz4_ = CompressionType.ZSTD, CompressionType.LZ4
    return [
        (small_recording(rng), True),
        (small_recording(rng, zstd), True),
        (small_recording(rng, lz4_), True),
        (small_recording(rng, chunked=False), True),
        (small_recording(rng, zstd, sums=False), False),
        (small_recording(rng, index=IndexType.NONE, sums=False), False),
        (small_recording(rng, chunked=False, summary=False, sums=False), False),
    ]


def content(path: Path) -> tuple[Any, bool]:
    """(all that is read of a file, whether the reader reports damage or a missing end)."""
    trace = open_trace(path)
    messages = [tuple(m) for m in trace.messages()]
    loaded = {
        topic: (
            samples.type_name,
            samples.log_time_ns.tolist(),
            samples.publish_time_ns.tolist(),
            list(samples.payloads),
        )
        for topic, samples in trace.load().items()
    }
    for samples in trace.load(decode=True).values():
        if samples.decoded is not None:
            assert len(samples.decoded) == len(samples)
    summary(trace)
    assert isinstance(trace.endpoints, list)
    reported = bool(trace.damage or trace.truncated)
    if not reported:
        assert trace.message_count == len(messages), "counted other messages than it gave"
        given = sum(len(times) for _, times, _, _ in loaded.values())
        if len(trace.channels) == len(trace.topics):
            assert given == len(messages), "the two ways of reading give different numbers"
    channels = [
        (
            *(c.topic, c.type_name, c.schema_encoding, c.message_count, c.first_ns, c.last_ns),
            *(tuple(c.metadata.items()), c.recorded_topic, c.message_encoding, c.problem),
        )
        for c in trace.channels
    ]
    about = (trace.metadata, trace.library, trace.profile)
    return (messages, loaded, channels, about), reported


def _records(data: bytes, at: int, end: int) -> list[tuple[int, bytes]]:
    return [(opcode, data[begin + 9 : after]) for opcode, begin, after in walk(data, at, end)]


def _joined(found: list[tuple[int, bytes]]) -> bytes:
    return b"".join(HEAD.pack(opcode, len(body)) + body for opcode, body in found)


# -- damage without new checksums: the reader must report what is lost ----------------------------


def _flip(rng: random.Random, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        out[rng.randrange(len(out))] ^= rng.choice((1 << rng.randrange(8), 0xFF))
    return bytes(out)


def _overwrite(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + rng.randbytes(rng.randrange(1, 40)) + data[at + rng.randrange(1, 40) :]


def _zeros(rng: random.Random, data: bytes) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + bytes(min(rng.choice((1, 16, 512)), len(data) - at)) + data[at + 512 :]


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.randrange(len(data))] + bytes(rng.choice((0, 0, 5000)))


def _move(rng: random.Random, data: bytes) -> bytes:
    """Records left out, repeated, exchanged."""
    found = _records(data, 8, len(data) - 8)
    a, b = rng.randrange(len(found)), rng.randrange(len(found))
    kind = rng.randrange(3)
    if kind == 0:
        del found[a]
    elif kind == 1:
        found.insert(b, found[a])
    else:
        found[a], found[b] = found[b], found[a]
    return data[:8] + _joined(found) + data[-8:]


def _field(rng: random.Random, data: bytes) -> bytes:
    """Another opcode, length, or eight other bytes of a record."""
    out = bytearray(data)
    at = rng.choice([begin for _, begin, _ in walk(data, 8, len(data) - 8)])
    kind = rng.randrange(3)
    if kind == 0:
        out[at] = rng.choice((0, *range(1, 18), 0x80, 0xFF))
    elif kind == 1:
        (length,) = struct.unpack_from("<Q", out, at + 1)
        other = rng.choice((*_NUMBERS, length + 1, max(0, length - 1), len(data), length + 9))
        struct.pack_into("<Q", out, at + 1, other)
    else:
        place = min(at + 9 + rng.randrange(40), len(out) - 8)
        struct.pack_into("<Q", out, place, rng.choice(_NUMBERS))
    return bytes(out)


# -- records made up, with valid checksums ----------------------


def _chunk(rng: random.Random, inner: bytes, start: int = 0, end: int = 2**63) -> bytes:
    name, pack = rng.choice(
        [(b"", bytes), (b"zstd", zstandard.compress), (b"lz4", lz4.frame.compress)]
    )
    packed: bytes = pack(inner)
    size = rng.choice((len(inner),) * 5 + _NUMBERS)
    crc = rng.choice((0, zlib.crc32(inner)))
    head = struct.pack("<QQQII", start, end, size, crc, len(name)) + name
    return head + struct.pack("<Q", len(packed)) + packed


def _text(rng: random.Random) -> bytes:
    text = rng.choice(_TEXTS)
    return struct.pack("<I", rng.choice((len(text),) * 9 + (2**32 - 1,))) + text


def _made(rng: random.Random, depth: int = 0) -> tuple[int, bytes]:
    """A record of any kind."""
    opcode = rng.choice((3, 4, 5, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0x10, 0x80))
    number = struct.pack("<H", rng.choice((0, 1, 2, 3, 65535)))
    times = struct.pack("<QQ", rng.choice(_NUMBERS), rng.choice(_NUMBERS))
    if opcode == 3:
        encoding = rng.choice((b"omgidl", b"ros2msg", b"ros2idl", b"json"))
        name = struct.pack("<I", len(encoding)) + encoding
        body = number + _text(rng) + name + _text(rng)
    elif opcode == 4:
        body = number + struct.pack("<H", rng.randrange(3)) + _text(rng) + _text(rng)
        body += struct.pack("<I", 0)
    elif opcode == 5:
        body = number + struct.pack("<I", rng.randrange(9)) + times + rng.randbytes(20)
    elif opcode == 6:
        inner = [_made(rng, depth + 1) for _ in range(rng.randrange(8))] if depth < 2 else []
        body = _chunk(rng, _joined(inner) * rng.choice((1, 1, 50)))
    elif opcode == 7:
        entries = rng.randrange(4)
        body = number + struct.pack("<I", rng.choice((16 * entries, 16 * entries + 8)))
        body += b"".join(struct.pack("<QQ", *(rng.choice(_NUMBERS),) * 2) for _ in range(entries))
    elif opcode == 12:
        pair = _text(rng) + _text(rng)
        body = _text(rng) + struct.pack("<I", len(pair)) + pair
    else:
        body = rng.randbytes(rng.choice((0, 4, 20, 70)))
    return opcode, body


def _craft(rng: random.Random, data: bytes) -> bytes:
    """Records made up, in the file and in its chunks; checksums are made right or left out."""
    found = _records(data, 8, len(data) - 8)
    if rng.random() < 0.5:  # without indexes and summary, so that nothing contradicts it
        end = [opcode for opcode, _ in found].index(15)
        found = [(o, b) for o, b in found[: end + 1] if o != 7] + [(2, bytes(20))]
    for _ in range(rng.randrange(1, 4)):
        found.insert(rng.randrange(1, len(found)), _made(rng))
    for place, (opcode, body) in enumerate(found):
        if opcode == 6 and rng.random() < 0.5 and body[28:32] == bytes(4):
            inner = _records(body[40:], 0, len(body) - 40)
            inner.insert(rng.randrange(len(inner) + 1), _made(rng, 1))
            first, last = struct.unpack_from("<QQ", body)
            found[place] = (6, _chunk(rng, _joined(inner), first, last))
    out = data[:8]
    summary_at = 0
    for opcode, body in found:
        if opcode == 15:
            body = struct.pack("<I", rng.choice((0, zlib.crc32(out))))
        elif opcode == 2:
            begin = summary_at if len(out) > summary_at else 0
            head = HEAD.pack(2, 20) + struct.pack("<QQ", begin, 0)
            body = head[9:] + struct.pack("<I", zlib.crc32(out[summary_at:] + head))
        out += HEAD.pack(opcode, len(body)) + body
        if opcode == 15:
            summary_at = len(out)
    return out + data[-8:]


def damage(rng: random.Random, data: bytes) -> bytes:
    """Damage a file in one of the ways."""
    return rng.choice(_PLAIN)(rng, data)


_PLAIN: tuple[Callable[[random.Random, bytes], bytes], ...] = (
    _flip,
    _flip,
    _overwrite,
    _zeros,
    _cut,
    _move,
    _field,
    _field,
)


def count_calls(function: Callable[[], Any]) -> tuple[Any, int]:
    """What ``function`` gives, and how many calls it took: work, whatever the machine's speed."""
    count = 0

    def tick(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += 1

    before = sys.getprofile()
    sys.setprofile(tick)
    try:
        return function(), count
    finally:
        sys.setprofile(before)


def _read(path: Path, original: Any | None) -> None:
    """Read a file, and hold what it takes against its size.

    :param original: what must be read if no damage is reported; None if that is not known.
    :raises Difference: the content has changed, or reading takes too many calls.
    """
    (found, reported), calls = count_calls(lambda: content(path))
    if original is not None and found != original and not reported:
        raise Difference("what is read has changed, and no damage is reported")
    size = path.stat().st_size
    unpacked = sum(segment.size for segment in open_trace(path)._file.segments)
    if calls > _FIXED + _PER_BYTE * size + _PER_UNPACKED * unpacked:
        raise Difference(f"{calls} calls for {size} bytes that unpack to {unpacked}")


def _damaged(rng: random.Random, scratch: Path) -> Target:
    """Recordings of each shape, damaged or with records made up."""
    path = scratch / "x.mcap"
    bases = _bases(rng)
    originals = []
    for data, _ in bases:
        path.write_bytes(data)
        found, reported = content(path)
        assert not reported
        originals.append(found)
    mutated = mutator([data for data, _ in bases], rng)
    expected: Any = None

    def make() -> bytes:
        nonlocal expected
        expected = None
        chance = rng.random()
        if chance < 0.2:
            return mutated()
        which = rng.randrange(len(bases))
        data, sums = bases[which]
        if chance < 0.5:
            return _craft(rng, data)
        # a recording without checksums cannot show each change
        expected = originals[which] if sums else None
        return damage(rng, data)

    def run(data: bytes) -> None:
        path.write_bytes(data)
        _read(path, expected)

    return Target(make, run)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    return [FuzzCase("mcap", "recordings, damaged or made up", _damaged)]
