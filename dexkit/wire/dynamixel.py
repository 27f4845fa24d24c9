"""Encode and decode DYNAMIXEL Protocol 2.0 packets (instruction and status), without I/O.

A frame is ``FF FF FD 00, ID, length (2, little-endian), instruction, parameters, CRC (2)``;
the length counts everything after itself. A status packet has instruction 0x55 and an error
byte before its data. (docs/sources/mx64-ezgripper.md#a.)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import fastcrc

from dexkit.errors import ChecksumError, EncodeError, OversizeError, TruncatedError, WireError
from dexkit.wire.frame_buffer import FrameBuffer

__all__ = [
    "ALERT",
    "BACKUP_KEY",
    "BROADCAST_ID",
    "CLEAR_POSITION_KEY",
    "HEADER",
    "MAX_ID",
    "MAX_LENGTH",
    "MAX_PACKET",
    "ErrorNumber",
    "Instruction",
    "Packet",
    "PacketParser",
    "crc16",
    "decode",
    "encode",
    "fast_length",
    "fast_status",
    "split_fast_status",
    "status",
    "stuff",
    "unstuff",
]

HEADER = b"\xff\xff\xfd\x00"
MAX_ID = 252
BROADCAST_ID = 0xFE
ALERT = 0x80
"""Bit of a status packet's error byte: Hardware Error Status is not zero."""
MAX_PACKET = 1024
"""Longest packet, header and CRC included: the bound of ROBOTIS' own SDK
(docs/sources/mx64-ezgripper.md#a1)."""
MAX_LENGTH = MAX_PACKET - 7
"""Largest value of a packet's length field."""
CLEAR_POSITION_KEY = bytes.fromhex("0144584c22")
BACKUP_KEY = b"CTRL"

_MIN_LENGTH = 3  # instruction and CRC
_OVERHEAD = 7  # what the length field does not count: header, id, the length itself
_PATTERN = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"


class Instruction(IntEnum):
    """Instruction codes (docs/sources/mx64-ezgripper.md#a5)."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class ErrorNumber(IntEnum):
    """Bits 0 to 6 of a status packet's error byte (docs/sources/mx64-ezgripper.md#a4)."""

    NONE = 0x00
    RESULT_FAIL = 0x01
    INSTRUCTION = 0x02
    CRC = 0x03
    DATA_RANGE = 0x04
    DATA_LENGTH = 0x05
    DATA_LIMIT = 0x06
    ACCESS = 0x07


def crc16(data: bytes) -> int:
    """CRC-16/UMTS (polynomial 0x8005, initial value 0, not reflected) of ``data``."""
    value: int = fastcrc.crc16.umts(data)
    return value


def stuff(body: bytes) -> bytes:
    """Insert FD after every FF FF FD of ``body`` (instruction and parameters)."""
    return body.replace(_PATTERN, _STUFFED)


def unstuff(body: bytes) -> bytes:
    """Undo :func:`stuff`."""
    return body.replace(_STUFFED, _PATTERN)


@dataclass(frozen=True)
class Packet:
    """One packet, byte stuffing removed.

    :param id: 0 to 252, or 254 for all.
    :param instruction: :class:`Instruction` or any other byte that was sent.
    :param params: what follows the instruction, without the CRC. In a status packet it starts
        with the error byte; in the combined status of a fast read it is everything up to the
        last CRC (:func:`split_fast_status`).
    :param crc_ok: False only from a parser with ``keep_bad``.
    """

    id: int
    instruction: int
    params: bytes = b""
    crc_ok: bool = True

    @property
    def is_status(self) -> bool:
        """Whether this is an answer."""
        return self.instruction == Instruction.STATUS

    @property
    def error(self) -> int:
        """The error byte of a status packet.

        :raises WireError: this is an instruction packet.
        """
        self._expect_status()
        return self.params[0]

    @property
    def error_number(self) -> int:
        """The error byte without the alert bit; see :class:`ErrorNumber`."""
        return self.error & ~ALERT

    @property
    def alert(self) -> bool:
        """Whether the servo reports a hardware error."""
        return bool(self.error & ALERT)

    @property
    def data(self) -> bytes:
        """The data of a status packet, after the error byte."""
        self._expect_status()
        return self.params[1:]

    def _expect_status(self) -> None:
        if not self.is_status:
            raise WireError(f"instruction 0x{self.instruction:02X} is not a status packet")
        if not self.params:
            raise TruncatedError("a status packet without an error byte")


def _frame(packet_id: int, body: bytes) -> bytes:
    length = len(body) + 2
    if length + _OVERHEAD > MAX_PACKET:
        raise OversizeError(f"a packet of {length + _OVERHEAD} bytes; at most {MAX_PACKET}")
    data = HEADER + bytes((packet_id, length & 0xFF, length >> 8)) + body
    return data + crc16(data).to_bytes(2, "little")


def encode(packet_id: int, instruction: int, params: bytes = b"") -> bytes:
    """Bytes of an instruction packet, stuffed.

    :raises EncodeError: no such id or instruction.
    :raises OversizeError: longer than :data:`MAX_PACKET`.
    """
    if not (0 <= packet_id <= MAX_ID or packet_id == BROADCAST_ID):
        raise EncodeError(f"id {packet_id} is not 0 to {MAX_ID} or {BROADCAST_ID}")
    if not 0 <= instruction <= 0xFF:
        raise EncodeError(f"instruction {instruction} is not a byte")
    return _frame(packet_id, stuff(bytes((instruction,)) + params))


def status(packet_id: int, error: int = 0, data: bytes = b"") -> bytes:
    """Bytes of a status packet, stuffed.

    :raises EncodeError: no such id or error byte.
    :raises OversizeError: longer than :data:`MAX_PACKET`.
    """
    if not 0 <= error <= 0xFF:
        raise EncodeError(f"error {error} is not a byte")
    return encode(packet_id, Instruction.STATUS, bytes((error,)) + data)


def fast_length(sizes: Iterable[int]) -> int:
    """Length field of the combined status of a fast read.

    :param sizes: data bytes of each device.
    """
    return 1 + sum(4 + size for size in sizes)


def fast_status(parts: Sequence[tuple[int, int, bytes]]) -> bytes:
    """Combined status of a fast sync or bulk read, which is never stuffed.

    :param parts: ``(id, error, data)`` of each device, in order.
    :raises EncodeError: no part.
    :raises OversizeError: longer than :data:`MAX_PACKET`.

    Each device's CRC runs from the first header byte up to itself, the CRCs before it included.
    """
    if not parts:
        raise EncodeError("a combined status needs at least one device")
    length = fast_length(len(data) for _, _, data in parts)
    if length + _OVERHEAD > MAX_PACKET:
        raise OversizeError(f"a packet of {length + _OVERHEAD} bytes; at most {MAX_PACKET}")
    out = bytearray(HEADER)
    out += bytes((BROADCAST_ID, length & 0xFF, length >> 8, Instruction.STATUS))
    for device, error, data in parts:
        out += bytes((error, device)) + data
        out += crc16(bytes(out)).to_bytes(2, "little")
    return bytes(out)


def split_fast_status(packet: Packet, sizes: Sequence[int]) -> list[tuple[int, int, bytes]]:
    """``(id, error, data)`` of each device in a combined status.

    :param sizes: data bytes asked of each device, in the order asked.
    :raises TruncatedError: fewer or more bytes than ``sizes`` ask for.
    """
    expected = sum(4 + size for size in sizes) - 2  # the last CRC is not in params
    if len(packet.params) != expected:
        raise TruncatedError(
            f"a combined status of {len(packet.params)} bytes, expected {expected}"
        )
    parts = []
    offset = 0
    for size in sizes:
        error, device = packet.params[offset], packet.params[offset + 1]
        parts.append((device, error, packet.params[offset + 2 : offset + 2 + size]))
        offset += 4 + size
    return parts


def decode(data: bytes) -> Packet:
    """Decode ``data``, which must be exactly one packet.

    :raises WireError: it does not start with the header, or bytes follow it.
    :raises TruncatedError: it ends too early.
    :raises OversizeError: its length field is beyond :data:`MAX_PACKET`.
    :raises ChecksumError: the CRC does not match.
    """
    if len(data) < _OVERHEAD + _MIN_LENGTH:
        raise TruncatedError(f"{len(data)} bytes; the shortest packet has 10")
    if not data.startswith(HEADER):
        raise WireError(f"no header in {data[:4].hex(' ')}")
    length = int.from_bytes(data[5:7], "little")
    if length < _MIN_LENGTH:
        raise TruncatedError(f"length field {length}; the shortest is {_MIN_LENGTH}")
    if length + _OVERHEAD > MAX_PACKET:
        raise OversizeError(f"length field {length} is beyond the bound of {MAX_PACKET} bytes")
    if len(data) < length + _OVERHEAD:
        raise TruncatedError(f"{len(data)} bytes of a packet of {length + _OVERHEAD}")
    if len(data) > length + _OVERHEAD:
        raise WireError(f"{len(data) - length - _OVERHEAD} bytes after the packet")
    packet = _packet(data)
    if not packet.crc_ok:
        raise ChecksumError(
            f"CRC 0x{int.from_bytes(data[-2:], 'little'):04X}, computed 0x{crc16(data[:-2]):04X}"
        )
    return packet


def _packet(frame: bytes) -> Packet:
    crc_ok = crc16(frame[:-2]) == int.from_bytes(frame[-2:], "little")
    packet_id, instruction = frame[4], frame[7]
    # the combined status of a fast read is the one packet that is not stuffed
    combined = packet_id == BROADCAST_ID and instruction == Instruction.STATUS
    params = frame[8:-2] if combined else unstuff(frame[7:-2])[1:]
    return Packet(packet_id, instruction, params, crc_ok)


class PacketParser(FrameBuffer):
    """Finds packets in a stream of bytes that may arrive in any pieces, with garbage between them.

    :param keep_bad: also return packets whose CRC does not match, marked ``crc_ok=False``.

    After a false header (impossible length or wrong CRC) the search continues at the next byte, so
    packets within its supposed length are still found. At most :data:`MAX_PACKET` bytes are
    buffered.

    :ivar skipped: bytes that belonged to no packet.
    :ivar crc_errors: packets whose CRC did not match.
    """

    def __init__(self, *, keep_bad: bool = False) -> None:
        super().__init__()
        self.keep_bad = keep_bad
        self.crc_errors = 0

    def reset(self) -> None:
        """Discard a packet begun: what a servo does after 1.5 ms of silence
        (docs/sources/mx64-ezgripper.md#a1).
        """
        super().reset()

    def feed(self, data: bytes) -> list[Packet]:
        """Take ``data`` and return the packets that are now complete."""
        buffer = self._buffer
        buffer += data
        packets: list[Packet] = []
        start = 0  # of what is not yet consumed
        while start < len(buffer):
            found = buffer.find(HEADER, start)
            if found < 0:
                # keep a tail that may be the first bytes of a header
                keep = next(
                    (n for n in (3, 2, 1) if len(buffer) - start >= n and _is_head(buffer, n)), 0
                )
                self.skipped += len(buffer) - keep - start
                start = len(buffer) - keep
                break
            self.skipped += found - start
            start = found
            if len(buffer) - start < _OVERHEAD:
                break
            length = buffer[start + 5] | buffer[start + 6] << 8
            packet_id = buffer[start + 4]
            if not _MIN_LENGTH <= length <= MAX_PACKET - _OVERHEAD or (
                packet_id > MAX_ID and packet_id != BROADCAST_ID
            ):
                self.skipped += len(HEADER)
                start += len(HEADER)
                continue
            end = start + _OVERHEAD + length
            if len(buffer) < end:
                break
            packet = _packet(bytes(buffer[start:end]))
            if packet.crc_ok:
                packets.append(packet)
                start = end
                continue
            self.crc_errors += 1
            if self.keep_bad:
                packets.append(packet)
            self.skipped += len(HEADER)
            start += len(HEADER)
        del buffer[:start]
        return packets


def _is_head(buffer: bytearray, n: int) -> bool:
    return buffer[-n:] == HEADER[:n]
