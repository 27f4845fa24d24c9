"""Recordings in files of their own, to be judged again: small, quickly read, never shared.

A file is one zstd frame with a checksum. In it are a header (:class:`_Head`, MessagePack, its
length before it) and for each channel the log times, the times of sending, the sizes of the
payloads, and the payloads.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from dexkit.conformance.virtual import MemoryTrace
from dexkit.messages.packed import Packed
from dexkit.traces import ChannelInfo, SampleArray, TraceEndpoint
from dexkit.traces.clock_steps import ClockStep

__all__ = ["Broken", "KeptTrace", "pack", "unpack"]

_LENGTH = struct.Struct("<I")


class Broken(Exception):
    """A file is damaged, or not such a file."""


class _Channel(msgspec.Struct, frozen=True):
    topic: str
    type_name: str
    count: int
    size: int
    """Bytes of all payloads."""


class _Head(msgspec.Struct, frozen=True):
    channels: list[_Channel]
    endpoints: list[TraceEndpoint]
    metadata: dict[str, dict[str, str]]
    warnings: list[str]
    mixed_types: dict[str, str]
    truncated: bool


@dataclass
class KeptTrace:
    """A recording of such a file, in the form that the kit reads recordings in."""

    samples: Sequence[SampleArray]
    endpoints: list[TraceEndpoint] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    mixed_types: dict[str, str] = field(default_factory=dict)
    truncated: bool = False
    clock_steps: list[ClockStep] = field(default_factory=list)

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel."""
        return [
            ChannelInfo(
                *(s.topic, s.type_name, "", len(s)),
                *(int(s.log_time_ns[0]), int(s.log_time_ns[-1])),
                *({}, s.topic),
            )
            for s in self.samples
        ]

    def load(
        self, topics: Iterable[str] | None = None, *, decode: bool = False
    ) -> dict[str, SampleArray]:
        """Samples by topic; nothing is decoded here."""
        wanted = None if topics is None else set(topics)
        return {s.topic: s for s in self.samples if wanted is None or s.topic in wanted}


def pack(trace: MemoryTrace) -> bytes:
    """The content of a recording's file."""
    channels, parts = [], []
    for (topic, type_name), rows in trace.rows.items():
        payloads = [data for _, _, data in rows]
        # differences are packed better than the times
        log = np.diff(np.array([log for log, _, _ in rows], dtype="<i8"), prepend=0)
        sent = np.diff(np.array([sent for _, sent, _ in rows], dtype="<i8"), prepend=0)
        sizes = np.array([len(data) for data in payloads], dtype="<i8")
        channels.append(_Channel(topic, type_name, len(rows), int(sizes.sum())))
        parts += [log.tobytes(), sent.tobytes(), sizes.tobytes(), *payloads]
    head = msgspec.msgpack.encode(
        _Head(
            channels,
            trace.endpoints,
            trace.metadata,
            trace.warnings,
            trace.mixed_types,
            trace.truncated,
        )
    )
    content = b"".join([_LENGTH.pack(len(head)), head, *parts])
    return zstandard.ZstdCompressor(level=3, write_checksum=True).compress(content)


def unpack(data: bytes) -> KeptTrace:
    """The recording in a file's content.

    :raises Broken: it is damaged.
    """
    try:
        content = zstandard.ZstdDecompressor().decompress(data)
        (length,) = _LENGTH.unpack_from(content)
        at = _LENGTH.size + length
        head = msgspec.msgpack.decode(content[_LENGTH.size : at], type=_Head)
        samples = []
        for channel in head.channels:
            numbers = np.frombuffer(content, "<i8", 3 * channel.count, at)
            log, sent, sizes = numbers.reshape(3, channel.count)
            at += numbers.nbytes
            payloads: NDArray[np.uint8] = np.frombuffer(content, np.uint8, channel.size, at)
            at += channel.size
            if not channel.count or (sizes < 0).any() or sizes.sum() != channel.size:
                raise Broken(f"{channel.topic}: sizes that contradict each other")
            starts = np.cumsum(sizes) - sizes
            samples.append(
                SampleArray(
                    channel.topic,
                    channel.type_name,
                    np.cumsum(log),
                    np.cumsum(sent),
                    Packed([payloads], starts, np.array(sizes)),
                )
            )
    except (zstandard.ZstdError, struct.error, msgspec.MsgspecError, ValueError) as error:
        raise Broken(str(error)) from error
    return KeptTrace(
        samples, head.endpoints, head.metadata, head.warnings, head.mixed_types, head.truncated
    )
