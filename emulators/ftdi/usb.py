"""The USB side of an emulated FTDI chip, and a serial line behind it."""

from __future__ import annotations

from typing import Any

from usbip.core import IN, SPEED_FULL, SPEED_HIGH, InterfaceDescriptor, Stall
from usbip.device import In, Out, USBDevice

from dexkit.clock import Clock, RealClock
from dexkit.emulators.ftdi.chip import FT232R, ChipModel, FtdiChip
from dexkit.emulators.serial_line import SerialLine

__all__ = ["FtdiUsb"]

_VENDOR_ID = 0x0403
_IN_ENDPOINT, _OUT_ENDPOINT = 0x81, 0x02
_VENDOR_CLASS = 0xFF
_NOMINAL = (9600, 19200, 38400, 57600, 115_200, 230_400, 460_800, 921_600)
"""Nominal rates. A divisor misses them by up to 0.2 %: a receiver takes 57692 baud for 57600."""
_TOLERANCE = 0.02
_BUSY_TICK = 4e-3  # seconds between updates of moving devices


class FtdiUsb:
    """A USB-serial adapter with devices on its line; plugs into a
    :class:`~dexkit.emulators.dex3_mcu.server.Server`.

    :param line: with its devices. Its own latency timer is switched off: the chip has one.
    :param serial: serial number of the adapter.
    :param check_baudrate: devices ignore a host that uses another baud rate.

    A transfer to the host ends with a packet that is not full, as USB has it. Not modelled: the
    chip's transmit FIFO, which throttles a host that sends faster than the line.
    """

    def __init__(
        self,
        line: SerialLine,
        serial: str,
        *,
        model: ChipModel = FT232R,
        clock: Clock | None = None,
        check_baudrate: bool = True,
    ) -> None:
        line.latency_timer = 0.0
        self.line = line
        self.serial = serial
        self._clock: Clock = clock or RealClock()
        self._check_baudrate = check_baudrate
        self.chip = FtdiChip(model, self._clock.now())
        self._transfer = bytearray()
        self.device: Any = USBDevice(
            _VENDOR_ID,
            model.product_id,
            manufacturer="FTDI",
            product=f"{model.name} USB UART (emulated)",
            serial=serial,
            bcdDevice=model.release,
        )
        self.device.set_speed(SPEED_HIGH if model.high_speed else SPEED_FULL)
        group = self.device.add_group()
        number = group.claim_interface()
        triple = (_VENDOR_CLASS, _VENDOR_CLASS, _VENDOR_CLASS)
        group.add(InterfaceDescriptor(number, 0, 2, *triple).pack())
        self._in = group.add_endpoint(In(_IN_ENDPOINT, "bulk", model.packet))
        self._out = group.add_endpoint(Out(_OUT_ENDPOINT, "bulk", model.packet))
        self._out.on_out = self._received
        self.device.on_control(None, self._control)

    @property
    def plugged(self) -> bool:
        """Whether the adapter is plugged."""
        return not self.line.unplugged

    def advance(self) -> float | None:
        """Advance to the present time; return the time of the next event, or None."""
        now = self._clock.now()
        self.line.advance_to(now)
        self.chip.receive(self.line.due(now))
        self._answer_reads(now)
        times = [self.line.next_time, self.chip.next_time if self._in._pending else None]
        if self.line.busy:
            times.append(now + _BUSY_TICK)
        return min((time for time in times if time is not None), default=None)

    def attached(self) -> None:
        """Reset the bus: the chip discards bytes that the last host had not read."""
        self._transfer.clear()
        self.chip = FtdiChip(self.chip.model, self._clock.now())
        self.device.reset_io()

    def _answer_reads(self, now: float) -> None:
        pending = self._in._pending  # the package has no query for it
        size = self.chip.model.packet
        while pending:
            packet = self.chip.packet(now)
            if packet is None:
                return
            self._transfer += packet
            if len(packet) < size or len(self._transfer) + size > pending[0][0]:
                done = bytes(self._transfer)
                self._transfer.clear()
                self._in.write(done)

    def _received(self, endpoint: Any, data: bytes) -> None:
        now = self._clock.now()
        if self._check_baudrate:
            self.line.host_baudrate = _nominal(self.chip.baudrate)
        self.line.advance_to(now)
        if self.plugged and not self.chip.breaking:
            self.line.receive(data, now)

    def _control(self, setup: Any, data: bytes = b"") -> bytes:
        answer = self.chip.control(setup.bRequest, setup.wValue, setup.wIndex, self._clock.now())
        if answer is None or (setup.direction == IN and not answer):
            raise Stall
        return answer


def _nominal(rate: int) -> int:
    """The nominal rate that devices on the line assume."""
    return next((r for r in _NOMINAL if abs(rate - r) < _TOLERANCE * r), rate)
