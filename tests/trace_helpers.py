"""Small mcap files of every shape, written with the mcap library itself."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer

from dexkit.errors import TraceError
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from dexkit.traces import open_trace

CMD_TYPE = "unitree_go::msg::dds_::MotorCmds_"
STATE_TYPE = "unitree_go::msg::dds_::MotorStates_"
CMD = "rt/dex1/left/cmd"
STATE = "rt/dex1/left/state"
T0 = 1_795_251_429_000_000_000


def cmd(q: float) -> bytes:
    return message_type(CMD_TYPE).encode(MotorCmds_([MotorCmd_(q=q, kp=5.0, kd=0.05)]))


def state(q: float, tau: float = 0.0) -> bytes:
    return message_type(STATE_TYPE).encode(MotorStates_([MotorState_(q=q, tau_est=tau)]))


def messages_on_disk(path: Path, topic: str) -> int:
    """Messages in a recording that is being written; 0 before it can be read."""
    try:
        trace = open_trace(path)
    except TraceError:
        return 0
    return len(trace.samples(topic)) if topic in trace.topics else 0


@dataclass(frozen=True)
class Shape:
    """The ways in which mcap files with the same content differ."""

    compression: CompressionType = CompressionType.NONE
    chunked: bool = True
    chunk_size: int = 1024
    index: IndexType = IndexType.ALL
    summary: bool = True

    def __str__(self) -> str:
        parts = [self.compression.name.lower() if self.chunked else "unchunked"]
        if self.index is IndexType.NONE:
            parts.append("noindex")
        if not self.summary:
            parts.append("nosummary")
        return "-".join(parts)


SHAPES = [
    Shape(),
    Shape(CompressionType.ZSTD),
    Shape(CompressionType.LZ4),
    Shape(index=IndexType.NONE),
    Shape(CompressionType.ZSTD, index=IndexType.NONE, summary=False),
    Shape(chunked=False),
    Shape(chunked=False, summary=False),
]

Row = tuple[str, int, int, bytes]  # topic, log time, publish time, payload


def mcap_bytes(
    rows: Iterable[Row],
    shape: Shape = Shape(),
    *,
    types: dict[str, str] | None = None,
    encoding: str = "ros2msg",
    schema_text: str | None = None,
    schema_name: str | None = None,
    message_encoding: str = "cdr",
    metadata: dict[str, dict[str, str]] | None = None,
    profile: str = "ros2",
    data_crc: bool = False,
) -> bytes:
    types = types or {CMD: CMD_TYPE, STATE: STATE_TYPE}
    out = io.BytesIO()
    writer = Writer(
        out,
        chunk_size=shape.chunk_size,
        compression=shape.compression,
        index_types=shape.index,
        use_chunking=shape.chunked,
        repeat_channels=shape.summary,
        repeat_schemas=shape.summary,
        use_statistics=shape.summary,
        use_summary_offsets=shape.summary,
        enable_data_crcs=data_crc,
    )
    writer.start(profile=profile, library="a test")
    for name, values in (metadata or {}).items():
        writer.add_metadata(name, values)
    channels: dict[str, int] = {}
    for topic, log, publish, data in rows:
        if topic not in channels:
            kind = message_type(types[topic])
            if encoding == "omgidl":
                name, text = kind.name, kind.omgidl
            else:
                name, text = kind.ros_name, kind.ros2msg
            schema = writer.register_schema(
                schema_name or name, encoding, (schema_text or text).encode()
            )
            channels[topic] = writer.register_channel(
                topic, message_encoding, schema, {"dds.type": kind.name}
            )
        writer.add_message(channels[topic], log, data, publish)
    writer.finish()
    return out.getvalue()


def rows(n: int = 60, start: int = T0) -> list[Row]:
    """``n`` states at 500 Hz and n/2 commands at 250 Hz."""
    found: list[Row] = []
    for i in range(n):
        at = start + i * 2_000_000
        found.append((STATE, at, at - 50_000, state(0.01 * i)))
        if i % 2:
            found.append((CMD, at + 300_000, at + 250_000, cmd(0.02 * i)))
    return found


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
