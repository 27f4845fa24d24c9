"""USB side of the emulated Dex3-1: descriptors, strings, two bulk endpoints.

Ids and strings are the manual's (docs/sources/unitree-dex.md#c1). No reliable source gives the
endpoint addresses, so they are options.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from usbip.core import SPEED_HIGH, InterfaceDescriptor
from usbip.device import In, Out, USBDevice

from dexkit.clock import Clock
from dexkit.emulators.dex3_mcu.device import Dex3Mcu
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import MANUFACTURER, PRODUCT, PRODUCT_ID, VENDOR_ID

__all__ = ["IN_ENDPOINT", "OUT_ENDPOINT", "SERIAL", "Dex3Usb"]

OUT_ENDPOINT, IN_ENDPOINT = 0x02, 0x81
"""Of a single, unattributed sample (docs/sources/unitree-dex.md#c1): uncertain."""
SERIAL = {Side.LEFT: "2024061800", Side.RIGHT: "2024061801"}
"""The left one is the manual's example."""
MAX_PACKET = 512
"""Bytes of a high-speed bulk packet."""
_MAX_TRANSFER = 4096  # BUF_SIZE of the manual
_MAX_HELD = 64  # answers that a fault delays; a host asks for one at a time
_VENDOR_CLASS = 0xFF


class Dex3Usb:
    """A hand's processor behind its USB connector; plugs into a
    :class:`~dexkit.emulators.dex3_mcu.server.Server`.

    :param clock: the processor's.
    :raises UsageError: an endpoint number is invalid.

    A transfer to the hand ends with a packet shorter than 512 bytes, as USB has it: two writes
    of 512 and 210 bytes are one frame of 722. A delayed answer is delivered when it is due; a newer
    frame does not wait for it.
    """

    def __init__(
        self,
        mcu: Dex3Mcu,
        clock: Clock,
        *,
        serial: str | None = None,
        out_endpoint: int = OUT_ENDPOINT,
        in_endpoint: int = IN_ENDPOINT,
    ) -> None:
        if not 1 <= out_endpoint <= 15:
            raise UsageError(f"an OUT endpoint is 0x01 to 0x0f, not 0x{out_endpoint:02x}")
        if not 0x81 <= in_endpoint <= 0x8F:
            raise UsageError(f"an IN endpoint is 0x81 to 0x8f, not 0x{in_endpoint:02x}")
        self.mcu = mcu
        self.serial = SERIAL[mcu.side] if serial is None else serial
        self._clock = clock
        self._transfer = bytearray()
        self._held: deque[tuple[float, bytes]] = deque()
        self.device: Any = USBDevice(
            VENDOR_ID,
            PRODUCT_ID[mcu.side],
            manufacturer=MANUFACTURER,
            product=PRODUCT[mcu.side],
            serial=self.serial,
            bcdDevice=0x0100,
        )
        self.device.set_speed(SPEED_HIGH)
        group = self.device.add_group()
        number = group.claim_interface()
        group.add(InterfaceDescriptor(number, 0, 2, _VENDOR_CLASS, 0, 0).pack())
        self._out = group.add_endpoint(Out(out_endpoint, "bulk", MAX_PACKET))
        self._in = group.add_endpoint(In(in_endpoint, "bulk", MAX_PACKET))
        self._out.on_out = self._received
        mcu.on_stall = self._stall

    @property
    def plugged(self) -> bool:
        """Whether the cable is plugged."""
        return self.mcu.plugged

    def advance(self) -> float | None:
        """Advance to the present time; return the time of the next event, or None."""
        self.mcu.advance()
        if self._held:
            now = self._clock.now()
            while self._held and self._held[0][0] <= now:
                self._answer(self._held.popleft()[1])
        times = [self._held[0][0]] if self._held else []
        following = self.mcu.next_time
        if following is not None:
            times.append(following)
        return min(times, default=None)

    def attached(self) -> None:
        """Reset the bus: discard transfers and answers; the motors keep their commands."""
        self._transfer.clear()
        self._held.clear()
        self.device.reset_io()
        self._in.clear_halt()
        self._out.clear_halt()

    def _stall(self, endpoint: str) -> None:
        (self._in if endpoint == "in" else self._out).stall()

    def _received(self, endpoint: Any, data: bytes) -> None:
        transfer = self._transfer
        if len(transfer) <= _MAX_TRANSFER:  # longer data are no frame, whatever follows
            transfer += data
        if data and len(data) % MAX_PACKET == 0:
            return
        frame = bytes(transfer)
        transfer.clear()
        answer = self.mcu.exchange(frame)
        if answer is None:
            return
        late = self.mcu.late
        if late or self._held:
            due = self._clock.now() + late
            if self._held:
                due = max(due, self._held[-1][0])  # answers do not overtake each other
            self._held.append((due, answer))
            if len(self._held) > _MAX_HELD:
                self._held.popleft()
                self.mcu.counters.unread += 1
        else:
            self._answer(answer)

    def _answer(self, answer: bytes) -> None:
        self._make_room()
        self._in.write(answer)

    def _make_room(self) -> None:
        """Discard the oldest answers beyond the queue's size, if no transfer waits for one."""
        kept = []
        while (chunk := self._in.take_or_park(0, _reject_probe_data, _PROBE)) is not None:
            kept.append(chunk)
        self._in.cancel(_PROBE)
        room = self.mcu.firmware.queue - 1
        self.mcu.counters.unread += max(0, len(kept) - room)
        for chunk in kept[len(kept) - room :] if room else []:
            self._in.write(chunk)


_PROBE = -1  # no transfer has this number


def _reject_probe_data(data: bytes, status: int = 0) -> None:
    raise AssertionError("the probe of the queue was answered")
