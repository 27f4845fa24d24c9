"""Bytes of a stream that may be the beginning of a frame."""

from __future__ import annotations

__all__ = ["FrameBuffer"]


class FrameBuffer:
    """Base of the parsers of byte streams: holds the bytes of a frame that is not complete yet.

    :ivar skipped: bytes that belonged to no frame.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes held that may be the beginning of a frame."""
        return len(self._buffer)

    def reset(self) -> None:
        """Discard a frame begun, for example after a pause on the line."""
        self.skipped += len(self._buffer)
        self._buffer.clear()
