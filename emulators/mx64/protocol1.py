"""Emulate the answers of an MX-64 with Protocol 1.0 firmware that identify it.

Ping and reads of its first registers (model number 310, firmware, id, baud rate); a driver for
Protocol 2.0 should detect it and report that the firmware must be upgraded. Frame: ``FF FF, ID,
length, instruction or error, parameters, checksum`` with the checksum the inverted sum of all bytes
after the header.
"""

from __future__ import annotations

from dexkit.wire import mx64

__all__ = ["Protocol1Servo"]

_BROADCAST = 0xFE
_PING, _READ = 0x01, 0x02
_INSTRUCTION_ERROR, _RANGE_ERROR = 0x40, 0x08
_DELAY = 500e-6
_FIRMWARE = 36


def _frame(body: bytes) -> bytes:
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


class Protocol1Servo:
    """The id and baud rate of a servo that does not understand Protocol 2.0.

    :param servo_id: its id.
    :param baudrate: bits a second; Protocol 1.0 stores 2,000,000 / (value + 1).
    """

    return_delay = _DELAY

    def __init__(self, servo_id: int = 1, *, baudrate: int = 1_000_000) -> None:
        self.id = servo_id
        self.baudrate = baudrate
        self._table = mx64.MODEL_PROTOCOL_1.to_bytes(2, "little") + bytes(
            (_FIRMWARE, servo_id, max(0, round(2_000_000 / baudrate) - 1) & 0xFF)
        )
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes from the line and return the answers, in order."""
        buffer = self._buffer
        buffer += data
        answers: list[bytes] = []
        while True:
            start = buffer.find(b"\xff\xff")
            if start < 0:
                del buffer[: max(0, len(buffer) - 1)]
                return answers
            del buffer[:start]
            if len(buffer) < 4:
                return answers
            length = buffer[3]
            if buffer[2] == 0xFF or not 2 <= length <= 140:
                del buffer[:1]
                continue
            if len(buffer) < 4 + length:
                return answers
            body = bytes(buffer[2 : 4 + length])
            checksum_ok = sum(body) & 0xFF == 0xFF
            if not checksum_ok:
                del buffer[:2]
                continue
            del buffer[: 4 + length]
            answer = self._answer(body[0], body[2], body[3:-1])
            if answer is not None:
                answers.append(answer)

    def _answer(self, packet_id: int, code: int, params: bytes) -> bytes | None:
        if packet_id not in (self.id, _BROADCAST):
            return None
        if code == _PING:
            return self._status(0)
        if packet_id == _BROADCAST:
            return None
        if code == _READ and len(params) == 2:
            address, length = params
            if address + length > len(self._table):
                return self._status(_RANGE_ERROR)
            return self._status(0, self._table[address : address + length])
        return self._status(_INSTRUCTION_ERROR)

    def _status(self, error: int, data: bytes = b"") -> bytes:
        return _frame(bytes((self.id, len(data) + 2, error)) + data)
