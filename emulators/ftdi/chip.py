"""The logic of an FTDI USB-serial chip, without I/O: vendor requests, divisors, packets, timer.

What is modelled is what Linux's ``ftdi_sio`` and a serial line need (FTDI AN232B-04 and -05,
``drivers/usb/serial/ftdi_sio.h``): each packet to the host begins with two bytes of modem and line
status; a packet is sent as soon as it is full, or when the latency timer ends, with or without
data. Not modelled: EEPROM contents, bit-bang modes, flow control, event characters.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

__all__ = ["FT232H", "FT232R", "STATUS_BYTES", "ChipModel", "FtdiChip", "Request", "baudrate_of"]

STATUS_BYTES = 2
_FULL_SPEED_STATUS, _HIGH_SPEED_STATUS = 0x01, 0x02  # low nibble of the modem status
_CTS, _DSR, _DCD = 0x10, 0x20, 0x80
_OVERRUN, _IDLE = 0x02, 0x60  # line status: overrun; holding and shift register empty
_FRACTIONS = (0, 4, 2, 1, 3, 5, 6, 7)  # eighths, by code
_LOW_BASE, _HIGH_BASE = 3_000_000, 12_000_000  # clock / 16, clock / 10
_HIGH_CLOCK = 1 << 17  # bit of the divisor
_BREAK = 1 << 14
_PURGE_RX = 1
_MIN_LATENCY = 1  # ms


class Request(IntEnum):
    """Vendor requests."""

    RESET = 0x00
    SET_MODEM = 0x01
    SET_FLOW = 0x02
    SET_BAUDRATE = 0x03
    SET_DATA = 0x04
    GET_MODEM = 0x05
    SET_EVENT_CHAR = 0x06
    SET_ERROR_CHAR = 0x07
    SET_LATENCY = 0x09
    GET_LATENCY = 0x0A
    SET_BITMODE = 0x0B
    READ_PINS = 0x0C
    READ_EEPROM = 0x90


@dataclass(frozen=True)
class ChipModel:
    """What differs between chips.

    :ivar product_id: USB product number; the vendor is 0403.
    :ivar release: bcdDevice, by which drivers tell chips apart.
    :ivar packet: bytes of a bulk packet, status included.
    :ivar fifo: bytes from the line that the chip holds.
    """

    name: str
    product_id: int
    release: int
    packet: int
    fifo: int

    @property
    def high_speed(self) -> bool:
        """Whether it is a high-speed chip, whose divisor can use the fast clock."""
        return self.packet > 64


FT232R = ChipModel("FT232R", 0x6001, 0x0600, 64, 256)
"""At most 3 Mbaud."""
FT232H = ChipModel("FT232H", 0x6014, 0x0900, 512, 1024)
"""At most 12 Mbaud."""


def baudrate_of(model: ChipModel, value: int, index: int) -> int:
    """Bits a second of a SET_BAUDRATE request.

    The divisor has an integer of 14 bits and a code for its eighths of three, the third of which is
    in ``index``: in bit 0, or, where ``index`` has a channel in its low byte, in bit 8. Integers 0
    and 1 without a fraction stand for 1 and 1.5.
    """
    high = index >> 8 if model.high_speed else index
    divisor = value | high << 16
    whole, code = divisor & 0x3FFF, divisor >> 14 & 7
    base = _HIGH_BASE if model.high_speed and divisor & _HIGH_CLOCK else _LOW_BASE
    eighths = 8 * whole + _FRACTIONS[code]
    if not code and whole < 2:
        eighths = 12 if whole else 8
    return round(base * 8 / max(8, eighths))


class FtdiChip:
    """One chip with one channel.

    :param start: time on the caller's clock.

    :ivar baudrate: bits a second on the line.
    :ivar latency: milliseconds of the latency timer.
    :ivar breaking: whether the host holds the line in break.
    :ivar overruns: bytes from the line lost because the buffer was full.
    :ivar requests: vendor requests that were obeyed.
    """

    def __init__(self, model: ChipModel, start: float = 0.0) -> None:
        self.model = model
        self.overruns = self.requests = 0
        self._waiting = bytearray()
        self._overrun = False
        self.baudrate = 9600
        self.latency = 16
        self.dtr = self.rts = self.breaking = False
        self._tick = start + self.latency * 1e-3

    # --- the host's requests

    def control(self, request: int, value: int, index: int, now: float) -> bytes | None:
        """Handle a vendor request; return its data (empty for none), or None to stall it."""
        answer = b""
        if request == Request.RESET:
            if value == 0:
                self.breaking = self.dtr = self.rts = False
            if value in (0, _PURGE_RX):
                self._waiting.clear()
        elif request == Request.SET_MODEM:
            if value & 0x100:
                self.dtr = bool(value & 1)
            if value & 0x200:
                self.rts = bool(value & 2)
        elif request == Request.SET_BAUDRATE:
            self.baudrate = baudrate_of(self.model, value, index)
        elif request == Request.SET_DATA:
            self.breaking = bool(value & _BREAK)
        elif request == Request.GET_MODEM:
            answer = self._status()
        elif request == Request.SET_LATENCY:
            if not _MIN_LATENCY <= value <= 0xFF:
                return None
            self.latency = value
            self._tick = now + value * 1e-3
        elif request == Request.GET_LATENCY:
            answer = bytes([self.latency])
        elif request == Request.READ_PINS:
            answer = b"\xff"
        elif request == Request.READ_EEPROM:
            answer = b"\xff\xff"
        elif request not in tuple(Request):
            return None
        self.requests += 1
        return answer

    def _status(self) -> bytes:
        modem = _HIGH_SPEED_STATUS if self.model.high_speed else _FULL_SPEED_STATUS
        return bytes([modem | _CTS | _DSR | _DCD, _IDLE | self._overrun * _OVERRUN])

    # --- the line and the host's reads

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; bytes beyond the buffer are lost and counted."""
        room = self.model.fifo - len(self._waiting)
        self._waiting += data[:room]
        if len(data) > room:
            self.overruns += len(data) - room
            self._overrun = True

    def packet(self, now: float) -> bytes | None:
        """The next packet to the host, if one is due: full, or at the end of the timer.

        Call it only while the host reads: unread bytes stay in the chip.
        """
        payload = self.model.packet - STATUS_BYTES
        if len(self._waiting) < payload and now < self._tick:
            return None
        packet = self._status() + self._waiting[:payload]
        del self._waiting[:payload]
        self._overrun = False
        if len(packet) < self.model.packet:
            # the timer runs freely, but does not catch up with a host that did not read
            period = self.latency * 1e-3
            self._tick += period
            if self._tick <= now:
                self._tick = now + period
        return bytes(packet)

    @property
    def next_time(self) -> float:
        """When the timer ends."""
        return self._tick
