"""Encode and decode Modbus, sans I/O: registers only, on TCP and on serial lines (RTU).

Four functions, as the hands use them (docs/sources/unitree-dex.md#j1, #j2): read holding or input
registers, write one or several holding registers. Registers are 16 bits, high byte first; the
caller knows which of them are signed.

An RTU frame has no length. On a real line silence ends it; here the length follows from the
function code and the byte count, because a pseudo-terminal does not preserve silence.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from fastcrc import crc16

from dexkit.errors import ChecksumError, EncodeError, OversizeError, TruncatedError, WireError
from dexkit.wire.frame_buffer import FrameBuffer

__all__ = [
    "MOST_READ",
    "MOST_WRITTEN",
    "Adu",
    "Exceptional",
    "Function",
    "Refusal",
    "Request",
    "RtuParser",
    "TcpParser",
    "answer",
    "parse_answer",
    "parse_request",
    "refuse",
    "signed",
]

MOST_READ, MOST_WRITTEN = 125, 123
"""Registers in one request."""
_FAILED = 0x80  # added to the function code of a refusal
_MBAP = struct.Struct(">HHH")  # transaction, protocol (0), bytes that follow
_LARGEST = 254  # bytes that may follow in a TCP frame: unit and 253 of the PDU
_CRC = 2


class Function(IntEnum):
    """Modbus function codes."""

    READ_HOLDING = 3
    READ_INPUT = 4
    WRITE_ONE = 6
    WRITE = 16


class Exceptional(IntEnum):
    """Why a device refuses a request."""

    ILLEGAL_FUNCTION = 1
    ILLEGAL_ADDRESS = 2
    ILLEGAL_VALUE = 3
    DEVICE_FAILURE = 4


class Refusal(WireError):
    """A request that a device refuses, or its answer that says so.

    :param code: :class:`Exceptional`, or another number.
    """

    def __init__(self, code: int) -> None:
        names = {int(each): each.name.replace("_", " ").lower() for each in Exceptional}
        super().__init__(f"Modbus exception {code} ({names.get(code, 'unknown')})")
        self.code = code


@dataclass(frozen=True)
class Request:
    """One request.

    :param count: registers; of a write those in ``values``.
    :param values: to write, 0 to 65535; negative ones as two's complement from -32768 on.
    """

    function: Function
    address: int
    count: int = 1
    values: tuple[int, ...] = ()

    @classmethod
    def write(cls, address: int, values: Sequence[int]) -> Request:
        """A request to write several registers."""
        return cls(Function.WRITE, address, len(values), tuple(values))

    def pack(self) -> bytes:
        """The PDU: function and data.

        :raises EncodeError: a value does not fit.
        """
        try:
            head = struct.pack(">BH", self.function, self.address)
            if self.function is Function.WRITE_ONE:
                (value,) = self.values
                return head + struct.pack(">H", value & 0xFFFF)
            if self.function is Function.WRITE:
                if not 1 <= len(self.values) <= MOST_WRITTEN:
                    raise ValueError("too few or too many registers")
                if not all(-0x8000 <= value <= 0xFFFF for value in self.values):
                    raise ValueError("a value of more than 16 bits")
                n = len(self.values)
                words = [value & 0xFFFF for value in self.values]
                return head + struct.pack(f">HB{n}H", n, 2 * n, *words)
            if not 1 <= self.count <= MOST_READ:
                raise ValueError("too few or too many registers")
            return head + struct.pack(">H", self.count)
        except (struct.error, ValueError) as error:
            raise EncodeError(f"{self} is no Modbus request: {error}") from error


def parse_request(pdu: bytes) -> Request:
    """Read the PDU of a request.

    :raises Refusal: a device refuses it: unsupported function, or a number out of range.
    :raises WireError: wrong length for its function.
    """
    if not pdu:
        raise TruncatedError("an empty Modbus request")
    if pdu[0] not in {int(each) for each in Function}:
        raise Refusal(Exceptional.ILLEGAL_FUNCTION)
    function = Function(pdu[0])
    if len(pdu) < 5:
        raise TruncatedError(f"a Modbus request of {len(pdu)} bytes")
    address, second = struct.unpack_from(">HH", pdu, 1)
    if function is Function.WRITE:
        if not 1 <= second <= MOST_WRITTEN or len(pdu) < 6 or pdu[5] != 2 * second:
            raise Refusal(Exceptional.ILLEGAL_VALUE)
        _check_length(pdu, 6 + 2 * second)
        return Request(function, address, second, struct.unpack_from(f">{second}H", pdu, 6))
    _check_length(pdu, 5)
    if function is Function.WRITE_ONE:
        return Request(function, address, 1, (second,))
    if not 1 <= second <= MOST_READ:
        raise Refusal(Exceptional.ILLEGAL_VALUE)
    return Request(function, address, second)


def answer(request: Request, values: Sequence[int] = ()) -> bytes:
    """The PDU that answers a request.

    :param values: of the registers that were read.
    """
    if request.function in (Function.WRITE, Function.WRITE_ONE):
        return request.pack()[:5]
    n = len(values)
    words = [value & 0xFFFF for value in values]
    return struct.pack(f">BB{n}H", request.function, 2 * n, *words)


def refuse(function: int, code: int) -> bytes:
    """The PDU that refuses a request."""
    return bytes([(function | _FAILED) & 0xFF, code])


def parse_answer(pdu: bytes, request: Request) -> tuple[int, ...]:
    """The registers in the PDU that answers ``request``; of a write none.

    :raises Refusal: the device refuses.
    :raises WireError: not an answer to this request.
    """
    if not pdu:
        raise TruncatedError("an empty Modbus answer")
    if pdu[0] == request.function | _FAILED:
        _check_length(pdu, 2)
        raise Refusal(pdu[1])
    if pdu[0] != request.function:
        raise WireError(f"function {pdu[0]} answers {int(request.function)}")
    if request.function in (Function.WRITE, Function.WRITE_ONE):
        if pdu != answer(request):
            raise WireError("the answer to a write names other registers")
        return ()
    n = request.count
    _check_length(pdu, 2 + 2 * n)
    if pdu[1] != 2 * n:
        raise WireError(f"{pdu[1]} bytes answer {n} registers")
    return struct.unpack_from(f">{n}H", pdu, 2)


def signed(values: Sequence[int]) -> tuple[int, ...]:
    """Registers as two's complement."""
    return tuple(value - 0x10000 if value >= 0x8000 else value for value in values)


def _check_length(data: bytes, length: int) -> None:
    if len(data) < length:
        raise TruncatedError(f"{len(data)} bytes of {length}")
    if len(data) > length:
        raise OversizeError(f"{len(data) - length} bytes after the end")


@dataclass(frozen=True)
class Adu:
    """One frame: a PDU, for or from a device.

    :param transaction: of TCP, repeated in the answer; RTU has none.
    """

    unit: int
    pdu: bytes
    transaction: int = 0

    def pack_tcp(self) -> bytes:
        """The bytes on a TCP connection.

        :raises EncodeError: a number does not fit.
        """
        try:
            head = _MBAP.pack(self.transaction, 0, 1 + len(self.pdu)) + bytes([self.unit])
        except (struct.error, ValueError) as error:
            raise EncodeError(f"{self} is no Modbus TCP frame: {error}") from error
        return head + self.pdu

    def pack_rtu(self) -> bytes:
        """The bytes on a serial line.

        :raises EncodeError: a number does not fit.
        """
        if self.unit not in range(256):
            raise EncodeError(f"{self.unit} is no unit")
        body = bytes([self.unit]) + self.pdu
        return body + struct.pack("<H", crc16.modbus(body))

    @classmethod
    def parse_rtu(cls, data: bytes) -> Adu:
        """Read one whole frame of a serial line.

        :raises TruncatedError: it is too short.
        :raises ChecksumError: the checksum is wrong.
        """
        if len(data) < 2 + _CRC:
            raise TruncatedError(f"{len(data)} bytes are no Modbus frame")
        found, meant = struct.unpack("<H", data[-_CRC:])[0], crc16.modbus(bytes(data[:-_CRC]))
        if found != meant:
            raise ChecksumError(f"checksum {found:#06x}, not {meant:#06x}")
        return cls(data[0], bytes(data[1:-_CRC]))


class TcpParser(FrameBuffer):
    """Finds frames in the bytes of a TCP connection, which may arrive in any pieces.

    TCP loses nothing within a connection, so there is no resynchronisation: after an invalid head
    ``broken`` is true, and the connection is unusable.

    :ivar skipped: bytes that belonged to no frame; ``damaged``: invalid heads.
    """

    def __init__(self) -> None:
        super().__init__()
        self.damaged = 0
        self.broken = False

    def reset(self) -> None:
        """Discard buffered bytes, for a new connection."""
        super().reset()
        self.broken = False

    def feed(self, data: bytes) -> list[Adu]:
        """Take ``data`` and return the frames that are now complete."""
        found: list[Adu] = []
        buffer = self._buffer
        buffer += data
        while len(buffer) >= _MBAP.size and not self.broken:
            transaction, protocol, size = _MBAP.unpack_from(buffer)
            if protocol != 0 or not 2 <= size <= _LARGEST:
                self.broken = True
                self.damaged += 1
                break
            if len(buffer) < _MBAP.size + size:
                return found
            body = bytes(buffer[_MBAP.size : _MBAP.size + size])
            found.append(Adu(body[0], body[1:], transaction))
            del buffer[: _MBAP.size + size]
        if self.broken:
            self.skipped += len(buffer)
            buffer.clear()
        return found


class RtuParser(FrameBuffer):
    """Finds frames in the bytes of a serial line, which may arrive in any pieces, among garbage.

    After bytes that are no frame the search continues at the next byte, so that frames among them
    are still found.

    :param answers: look for answers, and not for requests: they have other lengths.
    :ivar skipped: bytes that belonged to no frame.
    :ivar damaged: possible frames with a wrong checksum.
    """

    def __init__(self, *, answers: bool) -> None:
        super().__init__()
        self._answers = answers
        self.damaged = 0

    def feed(self, data: bytes) -> list[Adu]:
        """Take ``data`` and return the frames that are now complete."""
        found: list[Adu] = []
        buffer = self._buffer
        buffer += data
        while len(buffer) >= 3:
            size = self._size()
            if size is None:
                self._skip()
                continue
            if size == 0 or len(buffer) < size:
                return found
            try:
                found.append(Adu.parse_rtu(bytes(buffer[:size])))
                del buffer[:size]
            except WireError:
                self.damaged += 1
                self._skip()
        return found

    def _skip(self) -> None:
        self.skipped += 1
        del self._buffer[:1]

    def _size(self) -> int | None:
        """Bytes of the frame that begins here; 0 if that is not known yet, None for no frame."""
        buffer, head = self._buffer, 1 + _CRC  # unit and checksum
        function = buffer[1]
        write = function in (Function.WRITE, Function.WRITE_ONE)
        read = function in (Function.READ_HOLDING, Function.READ_INPUT)
        if self._answers:
            if function & _FAILED and function & ~_FAILED in {int(each) for each in Function}:
                return head + 2
            if read:
                return head + 2 + buffer[2] if buffer[2] % 2 == 0 and buffer[2] else None
            return head + 5 if write else None
        if function == Function.WRITE:
            if len(buffer) < 7:
                return 0
            count = int.from_bytes(buffer[4:6], "big")
            fits = 1 <= count <= MOST_WRITTEN and buffer[6] == 2 * count
            return head + 6 + buffer[6] if fits else None
        return head + 5 if read or write else None
