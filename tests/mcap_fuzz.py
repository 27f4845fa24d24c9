"""A fuzzer for recordings that knows what they are made of.

:func:`run` makes files, changes them and reads them. What must hold is in :func:`check`: no error
but dexkit's own, work that follows the file's size, and no loss that is not told. The same seed
gives the same files. ``python -m tests.mcap_fuzz SEED INPUTS`` runs it by itself.
"""

from __future__ import annotations

import random
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.writer import CompressionType, IndexType

from dexkit.cli.info import summary
from dexkit.errors import DexkitError
from dexkit.traces import open_trace
from tests.trace_helpers import Shape, mcap_bytes, rows

__all__ = ["Finding", "Result", "check", "content", "run"]

# Calls that reading may take: for the file's bytes, for those that its chunks unpack to, and for
# anything at all (types are compared with dexkit's own).
_PER_BYTE, _PER_UNPACKED, _FIXED = 20, 2, 200_000

_HEAD = struct.Struct("<BQ")
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


@dataclass(frozen=True)
class Finding:
    """A file that was not read as it must be. :attr:`data` repeats it."""

    seed: int
    number: int
    what: str
    data: bytes = field(repr=False)


@dataclass
class Result:
    """What a run did.

    :param told: how files were answered: ``same``, ``told``, ``refused``.
    :param slowest: most processor time that one file took, seconds (told, not judged).
    :param calls: most calls that one took, as a part of what is allowed.
    """

    inputs: int = 0
    told: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    slowest: float = 0.0
    calls: float = 0.0


@cache
def _bases() -> list[tuple[bytes, bool]]:
    """Small files of each shape, and whether each of their bytes is under a checksum."""
    found = []
    shapes = [
        (Shape(chunk_size=700), True),
        (Shape(CompressionType.ZSTD, chunk_size=700), True),
        (Shape(CompressionType.LZ4, chunk_size=700), True),
        (Shape(chunked=False), True),
        (Shape(CompressionType.ZSTD, chunk_size=700), False),
        (Shape(index=IndexType.NONE), False),
        (Shape(chunked=False, summary=False), False),
    ]
    for shape, sums in shapes:
        found.append((mcap_bytes(rows(24), shape, metadata={"m": {"k": "v"}}, data_crc=sums), sums))
    return found


def content(path: Path) -> tuple[Any, bool]:
    """(all that is read of a file, whether it is said to be incomplete or damaged)."""
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
    told = bool(trace.damage or trace.truncated)
    if not told:
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
    return (messages, loaded, channels, about), told


def _records(data: bytes, at: int, end: int) -> list[tuple[int, bytes]]:
    found = []
    while at + 9 <= end:
        opcode, length = _HEAD.unpack_from(data, at)
        found.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def _joined(found: list[tuple[int, bytes]]) -> bytes:
    return b"".join(_HEAD.pack(opcode, len(body)) + body for opcode, body in found)


# -- changes that nobody covers up: whatever they lose must be told ------------------------------


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
    """A head, or eight bytes of a body, that say something else."""
    out = bytearray(data)
    at, places = 8, []
    while at + 9 <= len(out) - 8:
        places.append(at)
        at += 9 + _HEAD.unpack_from(out, at)[1]
    at = rng.choice(places)
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


# -- changes with checksums made right again: somebody wants to be believed ----------------------


def _chunk(rng: random.Random, inner: bytes, start: int = 0, end: int = 2**63) -> bytes:
    name, pack = rng.choice(
        [(b"", bytes), (b"zstd", zstandard.compress), (b"lz4", lz4.frame.compress)]
    )
    packed = pack(inner)
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
            head = _HEAD.pack(2, 20) + struct.pack("<QQ", begin, 0)
            body = head[9:] + struct.pack("<I", zlib.crc32(out[summary_at:] + head))
        out += _HEAD.pack(opcode, len(body)) + body
        if opcode == 15:
            summary_at = len(out)
    return out + data[-8:]


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


def _calls(function: Callable[[], Any]) -> tuple[Any, int]:
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


def check(path: Path, original: Any | None) -> tuple[str, int]:
    """Read a file; returns how it was answered, and how many calls that took.

    :param original: what must be read if nothing is told; None if that is not known.
    :raises AssertionError: it was not read as it must be.
    """
    try:
        (got, told), calls = _calls(lambda: content(path))
    except DexkitError:
        return "refused", 0
    except RecursionError as error:
        raise AssertionError(f"RecursionError: {error}") from None
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}") from error
    if not told and original is not None and got != original:
        raise AssertionError("what is read has changed, and nothing is said")
    return ("told" if told else "same"), calls


def run(
    seed: int, inputs: int, say: Callable[[str], None] = lambda text: None, *, folder: str = ""
) -> Result:
    """Read ``inputs`` files made from ``seed``.

    :param say: is told each finding at once.
    :param folder: where the files are written; else a temporary folder.
    """
    result = Result()
    with tempfile.TemporaryDirectory(dir=folder or None) as place:
        path = Path(place) / "a.mcap"
        originals = []
        for data, _ in _bases():
            path.write_bytes(data)
            got, told = content(path)
            assert not told
            originals.append(got)
        for number in range(inputs):
            rng = random.Random(f"{seed}/{number}")
            which = rng.randrange(len(originals))
            data, sums = _bases()[which]
            crafted = rng.random() < 0.4
            data = _craft(rng, data) if crafted else rng.choice(_PLAIN)(rng, data)
            path.write_bytes(data)
            begin = time.process_time()
            try:
                # a file without checksums cannot tell everything
                how, calls = check(path, originals[which] if sums and not crafted else None)
                allowed = _FIXED + _PER_BYTE * len(data) + _PER_UNPACKED * unpacked(path)
                result.calls = max(result.calls, calls / allowed)
                assert calls <= allowed, f"{calls} calls for {len(data)} bytes"
                result.told[how] += 1
            except AssertionError as error:
                finding = Finding(seed, number, str(error), data)
                result.findings.append(finding)
                say(f"recordings: seed {seed}, input {number}: {error}")
            result.slowest = max(result.slowest, time.process_time() - begin)
            result.inputs += 1
    return result


def unpacked(path: Path) -> int:
    """Bytes that the chunks of a file unpack to, as far as they are read."""
    try:
        return sum(segment.size for segment in open_trace(path)._file.segments)
    except DexkitError:
        return 0


if __name__ == "__main__":
    found = run(int(sys.argv[1]), int(sys.argv[2]), print)
    print(
        f"{found.inputs} files, {dict(found.told)}, {len(found.findings)} findings, slowest "
        f"{found.slowest:.2f} s, at most {found.calls:.0%} of the calls allowed"
    )
    sys.exit(bool(found.findings))
