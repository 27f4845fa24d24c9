"""A minimal USB host for the kit, independent of the driver.

Two ways lead to a device: the system's libusb through PyUSB, for a serial number, and USB/IP
(``usbip://host:port[/serial]``) through :mod:`dexkit.usbip`, which cancels a transfer that times
out (CMD_UNLINK) as a kernel does it, and keeps the connection.
"""

from __future__ import annotations

import errno
import struct
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

from dexkit.conformance.usb.record import TIMED_OUT, Descriptors
from dexkit.conformance.usb.recording import Endpoint, parse_device
from dexkit.errors import ConformanceError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

if TYPE_CHECKING:
    from dexkit.usbip import Connection

__all__ = ["UsbHost", "bulk_pair", "open_device"]

_TIMEOUT = 2.0  # s, for descriptors and the like
_ENGLISH = 0x0409


class UsbHost(Protocol):
    """An opened device, interface 0 claimed."""

    descriptors: Descriptors

    def write(self, endpoint: int, data: bytes, timeout: float) -> int:
        """A bulk OUT transfer; 0 or a negative errno."""

    def read(self, endpoint: int, length: int, timeout: float) -> tuple[int, bytes]:
        """A bulk IN transfer: 0 or a negative errno, and the data."""

    def reopen(self) -> None:
        """Release the interface, close the device, open and claim it again.

        :raises ConformanceError: it cannot be opened again.
        """

    def close(self) -> None:
        """Release the interface and close the device."""


def open_device(where: str, side: Side) -> UsbHost:
    """Open one hand.

    :param where: ``usbip://host:port``, the same with ``/serial``, a serial number, or empty for
        the only hand of that side on this machine.
    :raises ConformanceError: there is none, or it cannot be opened.
    """
    if where.startswith("usbip://"):
        return _UsbIp(where, side)
    return _LibUsb(where, side)


Control = Callable[[int, int, int], bytes]
"""GET_DESCRIPTOR: (type << 8 | index, language, length) -> data."""


def _describe(get: Control, speed: int) -> Descriptors:
    """Read all descriptors (USB 2.0 specification 9.4.3)."""
    device = get(0x0100, 0, 18)
    head = get(0x0200, 0, 9)
    total = struct.unpack_from("<H", head, 2)[0] if len(head) >= 4 else 9
    strings: dict[int, str] = {}
    for index in {i for i in device[14:17] if i}:
        raw = get(0x0300 | index, _ENGLISH, 255)
        strings[index] = raw[2 : raw[0] if raw else 0].decode("utf-16-le", "replace")
    return Descriptors(device, get(0x0200, 0, total), strings, speed)


def _first(candidates: list[Any], where: str, side: Side, offers: str) -> Any:
    if not candidates:
        raise ConformanceError(
            f"no {side} Dex3-1 at {where or 'this machine'}",
            hint=f"there is: {offers or 'nothing'}",
        )
    return candidates[0]


# ------------------------------------------------------------------------------------- libusb


class _LibUsb:
    """A device of this machine."""

    def __init__(self, serial: str, side: Side) -> None:
        import usb.core
        import usb.util

        self._core, self._util = usb.core, usb.util
        self._serial, self._side = serial, side
        self._open()

    def _open(self) -> None:
        core, found = self._core, []
        try:
            for device in core.find(find_all=True, idVendor=VENDOR_ID):
                if self._serial:
                    mine = device.serial_number == self._serial
                else:
                    mine = device.idProduct == PRODUCT_ID[self._side]
                found += [device] if mine else []
            self._device = _first(found, self._serial, self._side, "no such device on USB")
            try:
                self._claim()
            except BaseException:
                self.close()
                raise
        except core.NoBackendError as error:
            raise ConformanceError(
                "there is no libusb on this machine", hint="install libusb-1.0"
            ) from error
        except (core.USBError, ValueError, NotImplementedError) as error:
            raise ConformanceError(
                f"the {self._side} hand cannot be opened: {error}",
                hint="no permission: a udev rule is in packaging/; busy: stop what uses the hand",
            ) from error

    def _claim(self) -> None:
        device = self._device
        try:
            if device.is_kernel_driver_active(0):
                device.detach_kernel_driver(0)
        except NotImplementedError:  # a system without kernel drivers for it
            pass
        try:
            device.get_active_configuration()
        except self._core.USBError:
            device.set_configuration()
        self._util.claim_interface(device, 0)

        def get(value: int, index: int, length: int) -> bytes:
            raw = device.ctrl_transfer(0x80, 6, value, index, length, timeout=_TIMEOUT * 1000)
            return bytes(raw)

        self.descriptors = _describe(get, device.speed or 0)

    def _status(self, error: Any) -> int:
        if isinstance(error, self._core.USBTimeoutError):
            return TIMED_OUT
        return -(error.errno or errno.EIO)

    def write(self, endpoint: int, data: bytes, timeout: float) -> int:
        try:
            self._device.write(endpoint, data, max(1, round(timeout * 1000)))
        except self._core.USBError as error:
            return self._status(error)
        return 0

    def read(self, endpoint: int, length: int, timeout: float) -> tuple[int, bytes]:
        try:
            data = self._device.read(endpoint, length, max(1, round(timeout * 1000)))
        except self._core.USBError as error:
            return self._status(error), b""
        return 0, bytes(data)

    def reopen(self) -> None:
        self.close()
        self._open()

    def close(self) -> None:
        self._util.dispose_resources(self._device)


# ------------------------------------------------------------------------------------- USB/IP

_OUT, _IN = 0, 1
_PORT = 3240  # registered for USB/IP


class _UsbIp:
    """A device of a USB/IP server."""

    def __init__(self, url: str, side: Side) -> None:
        parts = urlsplit(url)
        try:
            self._address = (parts.hostname or "127.0.0.1", parts.port or _PORT)
        except ValueError as error:
            raise ConformanceError(f"{url}: {error}") from error
        self._url, self._side = url, side
        self._serial = parts.path.strip("/")
        self._connection: Connection | None = None
        self._open()

    def _open(self) -> None:
        from dexkit.usbip import UsbIpBackend

        backend = UsbIpBackend(*self._address, _TIMEOUT)
        try:
            offered = backend.enumerate_devices()
            product = PRODUCT_ID[self._side]
            mine = [d for d in offered if (d.id_vendor, d.id_product) == (VENDOR_ID, product)]
            if self._serial or not mine:
                mine = [d for d in offered if d.id_vendor == VENDOR_ID]
            offers = ", ".join(f"{d.id_vendor:04x}:{d.id_product:04x}" for d in offered)
            for device in mine:
                self._connection = backend.open_device(device)
                self._describe(device.speed)
                if not self._serial or parse_device(self.descriptors).serial == self._serial:
                    return
                self.close()
            _first([], self._url, self._side, offers)
        except ConformanceError:
            self.close()
            raise
        except OSError as error:
            self.close()
            busy = error.errno == errno.EBUSY
            why = "refused" if busy else error.__cause__ or error.strerror or error
            raise ConformanceError(
                f"{self._url}: {why}",
                hint="another client may have attached it"
                if busy
                else "is the server running, and is the hand not attached elsewhere?",
            ) from error

    def _describe(self, speed: int) -> None:
        def get(value: int, index: int, length: int) -> bytes:
            setup = struct.pack("<BBHHH", 0x80, 6, value, index, length)
            return self._transfer(_IN, 0, b"", length, _TIMEOUT, setup)[1]

        self._transfer(_OUT, 0, b"", 0, _TIMEOUT, struct.pack("<BBHHH", 0, 9, 1, 0, 0))
        self.descriptors = _describe(get, speed)

    def _transfer(
        self, direction: int, endpoint: int, data: bytes, length: int, timeout: float, setup: bytes
    ) -> tuple[int, bytes]:
        if self._connection is None:
            return -errno.ENODEV, b""
        try:
            return self._connection.submit(
                direction=direction,
                ep=endpoint,
                setup=setup,
                transfer_buffer_length=length,
                out_payload=data,
                timeout_ms=max(1, round(timeout * 1000)),
                settle_ms=round(_TIMEOUT * 1000),
            )
        except OSError as error:
            return (TIMED_OUT if error.errno == errno.ETIMEDOUT else -errno.ENODEV), b""

    def write(self, endpoint: int, data: bytes, timeout: float) -> int:
        return self._transfer(_OUT, endpoint & 15, data, len(data), timeout, bytes(8))[0]

    def read(self, endpoint: int, length: int, timeout: float) -> tuple[int, bytes]:
        return self._transfer(_IN, endpoint & 15, b"", length, timeout, bytes(8))

    def reopen(self) -> None:
        self.close()
        end = time.monotonic() + _TIMEOUT
        while True:  # a server may need some time to detect that the connection is closed
            try:
                return self._open()
            except ConformanceError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()


def bulk_pair(descriptors: Descriptors) -> tuple[Endpoint, Endpoint] | None:
    """The first bulk OUT and the first bulk IN endpoint of interface 0."""
    bulk = [e for e in parse_device(descriptors).endpoints if e.bulk]
    out = next((e for e in bulk if not e.inward), None)
    inward = next((e for e in bulk if e.inward), None)
    return None if out is None or inward is None else (out, inward)
