"""Encode and decode serial frames of Inspire's RH56DFX, sans I/O (docs/sources/unitree-dex.md#j2).

A frame is two bytes of head, the device's id, the number of bytes that follow before the checksum,
an operation (read or write), the address of a register, data, and a checksum: the sum of all bytes
after the head. A read request holds the number of bytes wanted, its answer those bytes; a write
request holds the bytes, its answer one byte. Numbers are little endian.

Registers are addressed by byte. Those of the joints hold six 16-bit numbers, or six bytes, in the
order of the joints: pinky, ring, middle, index, thumb bend, thumb rotation.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from dexkit.errors import ChecksumError, EncodeError, OversizeError, TruncatedError, WireError
from dexkit.hand import MotorError
from dexkit.wire.frame_buffer import FrameBuffer

__all__ = [
    "BAUD_RATE",
    "DONE",
    "FAULTS",
    "FULL",
    "IDS",
    "JOINTS",
    "UNCHANGED",
    "Error",
    "Frame",
    "FrameParser",
    "Operation",
    "Register",
    "Status",
    "numbers",
    "read",
    "write",
]

BAUD_RATE = 115200
JOINTS = 6
FULL = 1000
"""Full travel, speed or force in the registers; angle 0 is closed, this value is open."""
UNCHANGED = -1
"""A goal that leaves a joint as it is."""
IDS = range(1, 255)
DONE = 1
"""The byte in the answer to a write."""
_OVERHEAD = 5  # bytes of a frame that its length does not count
_LEAST = 3  # operation and address


class Operation(IntEnum):
    """Operation of a request or answer."""

    READ = 0x11
    WRITE = 0x12


class Register(IntEnum):
    """Addresses of registers."""

    ID = 1000
    CLEAR_ERROR = 1004
    ANGLE_SET = 1486
    FORCE_SET = 1498
    SPEED_SET = 1522
    ANGLE_ACT = 1546
    FORCE_ACT = 1582
    CURRENT = 1594
    ERROR = 1606
    STATUS = 1612
    TEMPERATURE = 1618
    TOUCH = 3000
    """Of a hand with tactile areas: their elements, 16 bits each, one area behind the other."""


class Error(IntFlag):
    """Bits of a joint's ERROR byte."""

    LOCKED_ROTOR = 1
    OVER_TEMPERATURE = 2
    OVER_CURRENT = 4
    MOTOR = 8
    COMMUNICATION = 16


FAULTS: Mapping[Error, MotorError] = {
    Error.LOCKED_ROTOR: MotorError.LOCKED,
    Error.OVER_TEMPERATURE: MotorError.CASE_TEMPERATURE,
    Error.OVER_CURRENT: MotorError.OVERCURRENT,
    Error.MOTOR: MotorError.ABNORMAL_RESET,
    Error.COMMUNICATION: MotorError.COMMUNICATION_CHECK,
}
"""The bits as they appear in a :class:`~dexkit.hand.HandState`."""


class Status(IntEnum):
    """A joint's STATUS byte."""

    OPENING = 0
    CLOSING = 1
    ARRIVED = 2
    FORCE_REACHED = 3
    CURRENT_PROTECTION = 5
    LOCKED_ROTOR = 6
    FAULT = 7


_HEADS = {False: b"\xeb\x90", True: b"\x90\xeb"}


@dataclass(frozen=True)
class Frame:
    """One frame.

    :param answer: from the device, and not to it.
    """

    device: int
    operation: Operation
    address: int
    data: bytes
    answer: bool = False

    def pack(self) -> bytes:
        """The bytes on the line.

        :raises EncodeError: a value does not fit.
        """
        length = _LEAST + len(self.data)
        if self.device not in range(256) or self.address not in range(1 << 16) or length > 255:
            raise EncodeError(f"{self} does not fit into a frame")
        body = struct.pack("<BBBH", self.device, length, self.operation, self.address) + self.data
        return _HEADS[self.answer] + body + bytes([sum(body) & 0xFF])

    @classmethod
    def parse(cls, data: bytes) -> Frame:
        """Read one whole frame.

        :raises TruncatedError: it ends too early.
        :raises OversizeError: bytes are left over.
        :raises ChecksumError: the checksum is wrong.
        :raises WireError: no head, or an unknown operation.
        """
        if len(data) < _OVERHEAD + _LEAST:
            raise TruncatedError(f"{len(data)} bytes are no frame")
        answers = [answer for answer, head in _HEADS.items() if data.startswith(head)]
        if not answers:
            raise WireError(f"{data[:2].hex()} is no head of a frame")
        size = data[3] + _OVERHEAD
        if data[3] < _LEAST:
            raise WireError(f"a length of {data[3]} has no room for an address")
        if len(data) < size:
            raise TruncatedError(f"a frame of {size} bytes, there are {len(data)}")
        if len(data) > size:
            raise OversizeError(f"{len(data) - size} bytes after the end of a frame")
        if sum(data[2:-1]) & 0xFF != data[-1]:
            raise ChecksumError(f"checksum {data[-1]:#04x}, not {sum(data[2:-1]) & 0xFF:#04x}")
        if data[4] not in {int(operation) for operation in Operation}:
            raise WireError(f"unknown operation {data[4]:#04x}")
        address = int.from_bytes(data[5:7], "little")
        return cls(data[2], Operation(data[4]), address, bytes(data[7:-1]), answers[0])


def read(device: int, register: int, count: int) -> Frame:
    """A request to read ``count`` bytes."""
    return Frame(device, Operation.READ, register, bytes([count]))


def write(device: int, register: int, values: Sequence[int]) -> Frame:
    """A request to write 16-bit numbers.

    :raises EncodeError: one does not fit.
    """
    try:
        data = struct.pack(f"<{len(values)}h", *values)
    except struct.error as error:
        raise EncodeError(f"{list(values)} are no 16-bit numbers") from error
    return Frame(device, Operation.WRITE, register, data)


def numbers(data: bytes) -> tuple[int, ...]:
    """The 16-bit numbers in the data of a frame.

    :raises WireError: an odd number of bytes.
    """
    if len(data) % 2:
        raise WireError(f"{len(data)} bytes are no 16-bit numbers")
    return struct.unpack(f"<{len(data) // 2}h", data)


class FrameParser(FrameBuffer):
    """Finds frames in a stream of bytes that may arrive in any pieces, with garbage between them.

    After a frame that cannot be read the search continues at the next byte, so that frames within
    it are still found. Less than one frame is buffered.

    :param answers: look for answers instead of requests.
    :ivar skipped: bytes that belonged to no frame.
    :ivar damaged: heads whose frame could not be read.
    """

    def __init__(self, *, answers: bool) -> None:
        super().__init__()
        self._head = _HEADS[answers]
        self.damaged = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Take ``data`` and return the frames that are now complete."""
        found: list[Frame] = []
        buffer = self._buffer
        buffer += data
        while True:
            at = buffer.find(self._head)
            if at < 0:
                at = len(buffer) - buffer.endswith(self._head[:1])
            self.skipped += at
            del buffer[:at]
            if len(buffer) < 4 or len(buffer) < buffer[3] + _OVERHEAD:
                return found
            try:
                size = buffer[3] + _OVERHEAD
                found.append(Frame.parse(bytes(buffer[:size])))
                del buffer[:size]
            except WireError:
                self.damaged += 1
                self.skipped += 1
                del buffer[:1]
