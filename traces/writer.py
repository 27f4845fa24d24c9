"""Write a recording from existing data: in order, without drops, atomically.

:class:`~dexkit.traces.recorder.Recorder` serves live samples and drops what its queue cannot hold.
:class:`RecordingWriter` serves imports and edits: :meth:`RecordingWriter.put` blocks until the
message is accepted, and the same messages give the same file. The file appears under its name when
it is finished; after an error there is none, and a file that it was to replace is kept.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, cast

from mcap.writer import CompressionType, Writer

from dexkit import __version__
from dexkit.errors import TraceError, UsageError
from dexkit.messages import MessageType
from dexkit.traces.reader import Definition
from dexkit.traces.recording_file import RecordingFile

__all__ = ["RecordingWriter", "definition"]

# Bytes written in one system call.
_COMMIT_AT = 4 * 2**20
# Bytes of payload in a chunk.
_CHUNK = 2**20
_TIMES = 2**64
_MAX_CHANNELS = 2**16 - 1


def definition(
    topic: str, kind: MessageType, metadata: Mapping[str, str] | None = None
) -> Definition:
    """A channel of one of dexkit's types, as the recorder writes it."""
    values = {"dds.type": kind.name, **(metadata or {})}
    return Definition(topic, "cdr", values, (kind.ros_name, "ros2msg", kind.ros2msg.encode()))


class RecordingWriter:
    """Writes an mcap file; a context manager. An exception inside leaves no file.

    :param overwrite: replace an existing file, when the new one is finished.
    :raises UsageError: the file exists and ``overwrite`` is False, or it is being recorded.
    :raises TraceError: it cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self.written = 0
        self._counts: dict[int, int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._file = RecordingFile(self.path, overwrite=overwrite, whole=True)
        self._file.open()
        self._writer = Writer(
            cast(BinaryIO, self._file),
            chunk_size=_CHUNK,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._writer.start(profile="ros2", library=f"dexkit {__version__}")

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: object, *exc: object) -> None:
        if kind is not None:
            self._file.close(keep=False)
        else:
            self.close()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record; text that is not valid UTF-8 is escaped."""
        self._writer.add_metadata(_utf8(name), {_utf8(k): _utf8(v) for k, v in values.items()})

    def add_channel(self, channel: Definition) -> int:
        """Write a channel; return its number for :meth:`put`.

        :raises UsageError: a file holds 65,535 channels at most.
        """
        if len(self._counts) >= _MAX_CHANNELS:
            raise UsageError(f"a recording holds {_MAX_CHANNELS} channels at most")
        schema = 0
        if channel.schema is not None:
            if channel.schema not in self._schemas:
                self._schemas[channel.schema] = self._writer.register_schema(*channel.schema)
            schema = self._schemas[channel.schema]
        number = self._writer.register_channel(
            _utf8(channel.topic),
            channel.message_encoding,
            schema,
            {_utf8(k): _utf8(v) for k, v in channel.metadata.items()},
        )
        self._counts[number] = 0
        return number

    def put(self, channel: int, data: bytes, log_time_ns: int, publish_time_ns: int = 0) -> None:
        """Write one message.

        :raises UsageError: a time is out of range.
        :raises TraceError: the disk is full, for example.
        """
        if not (0 <= log_time_ns < _TIMES and 0 <= publish_time_ns < _TIMES):
            raise UsageError(f"not times in ns since the epoch: {log_time_ns}, {publish_time_ns}")
        self._counts[channel] += 1
        sequence = self._counts[channel] & 0xFFFFFFFF
        self._writer.add_message(channel, log_time_ns, data, publish_time_ns, sequence)
        self.written += 1
        if self._file.waiting >= _COMMIT_AT:
            self._commit()

    def close(self) -> None:
        """Finish the file and rename it to its final name.

        :raises TraceError: it cannot be written.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._commit()
        except BaseException:
            self._file.close(keep=False)
            raise
        self._file.close(keep=True)

    def _commit(self) -> None:
        try:
            self._file.commit()
        except OSError as error:
            raise TraceError(f"cannot write {self.path}: {error.strerror or error}") from error


def _utf8(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()
