"""A minimal USB host for the kit, independent of the driver.

It opens a device by serial number through PyUSB and the system's libusb, or by
``usbip://host:port[/serial]`` over USB/IP. The USB/IP client is implemented here, because a
transfer that times out must be unlinked (CMD_UNLINK) as a kernel does it, without losing the
connection.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol
from urllib.parse import urlsplit

from dexkit.conformance.usb.record import TIMED_OUT, Descriptors
from dexkit.conformance.usb.recording import Endpoint, parse_device
from dexkit.errors import ConformanceError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

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

# the kernel's Documentation/usb/usbip_protocol.rst; all big endian
_VERSION = 0x0111
_OP = struct.Struct("!HHI")
_DEVICE = struct.Struct("!256s32sIIIHHHBBBBBB")
_SUBMIT = struct.Struct("!IIIIIIiiii8s")
_UNLINK = struct.Struct("!IIIIII24x")
_REPLY = struct.Struct("!IIIIIiiiii8x")
_REQ_DEVLIST, _REP_DEVLIST, _REQ_IMPORT, _REP_IMPORT = 0x8005, 5, 0x8003, 3
_CMD_SUBMIT, _CMD_UNLINK, _RET_SUBMIT, _RET_UNLINK = 1, 2, 3, 4
_OUT, _IN = 0, 1
_NOT_ISO = 0


@dataclass(frozen=True)
class _Exported:
    """One device that a server offers."""

    busid: bytes
    id: int
    speed: int
    vendor: int
    product: int

    @classmethod
    def of(cls, raw: bytes) -> tuple[_Exported, int]:
        """Decode a device and the number of interface descriptions that follow."""
        v = _DEVICE.unpack(raw)
        return cls(v[1], v[2] << 16 | v[3], v[4], v[5], v[6]), v[13]


class _Gone(Exception):
    """The server has closed the connection."""


class _UsbIp:
    """A device of a USB/IP server."""

    def __init__(self, url: str, side: Side) -> None:
        parts = urlsplit(url)
        try:
            self._address = (parts.hostname or "127.0.0.1", parts.port or 3240)
        except ValueError as error:
            raise ConformanceError(f"{url}: {error}") from error
        self._url, self._side = url, side
        self._serial = parts.path.strip("/")
        self._socket = socket.socket()  # until it is connected
        self._open()

    def _open(self) -> None:
        try:
            offered = list(self._offered())
            mine = [
                e for e in offered if (e.vendor, e.product) == (VENDOR_ID, PRODUCT_ID[self._side])
            ]
            if self._serial or not mine:
                mine = [e for e in offered if e.vendor == VENDOR_ID]
            offers = ", ".join(f"{e.vendor:04x}:{e.product:04x}" for e in offered)
            for exported in mine:
                self._attach(exported)
                if not self._serial or parse_device(self.descriptors).serial == self._serial:
                    return
                self._socket.close()
            _first([], self._url, self._side, offers)
        except ConformanceError:
            self.close()
            raise
        except (OSError, _Gone, struct.error) as error:
            self.close()
            raise ConformanceError(
                f"{self._url}: {error or 'the server has closed the connection'}",
                hint="is the server running, and is the hand not attached elsewhere?",
            ) from error

    def _connect(self, request: int, reply: int, data: bytes = b"") -> None:
        self._socket = socket.create_connection(self._address, _TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = bytearray()
        self._socket.sendall(_OP.pack(_VERSION, request, 0) + data)
        _, code, status = _OP.unpack(self._take(_OP.size, None))
        if code != reply or status:
            raise ConformanceError(
                f"{self._url}: refused (status {status})",
                hint="another program may have attached it",
            )

    def _offered(self) -> Iterator[_Exported]:
        self._connect(_REQ_DEVLIST, _REP_DEVLIST)
        try:
            for _ in range(struct.unpack("!I", self._take(4, None))[0]):
                exported, interfaces = _Exported.of(self._take(_DEVICE.size, None))
                self._take(4 * interfaces, None)
                yield exported
        finally:
            self._socket.close()

    def _attach(self, exported: _Exported) -> None:
        self._connect(_REQ_IMPORT, _REP_IMPORT, exported.busid)
        self._device, _ = _Exported.of(self._take(_DEVICE.size, None))
        self._sequence = 0

        def get(value: int, index: int, length: int) -> bytes:
            setup = struct.pack("<BBHHH", 0x80, 6, value, index, length)
            return self._transfer(_IN, 0, b"", length, _TIMEOUT, setup)[1]

        self._transfer(_OUT, 0, b"", 0, _TIMEOUT, struct.pack("<BBHHH", 0, 9, 1, 0, 0))
        self.descriptors = _describe(get, self._device.speed)

    def _take(self, size: int, end: float | None) -> bytes:
        """Receive a number of bytes; after ``TimeoutError`` the next call goes on from there.

        :param end: monotonic time to wait until, None for the usual time-out.
        """
        end = time.monotonic() + _TIMEOUT if end is None else end
        while len(self._buffer) < size:
            self._socket.settimeout(max(1e-4, end - time.monotonic()))
            data = self._socket.recv(65536)
            if not data:
                raise _Gone
            self._buffer += data
        taken = bytes(self._buffer[:size])
        del self._buffer[:size]
        return taken

    def _receive(self, end: float | None) -> tuple[int, int, int, bytes]:
        """One reply: command, sequence number, status, data."""
        while len(self._buffer) < _REPLY.size:
            head = self._take(_REPLY.size, end)
            self._buffer[:0] = head
        command, sequence, _, _, _, status, length, *_ = _REPLY.unpack_from(self._buffer)
        coming = length if command == _RET_SUBMIT and sequence in self._inward else 0
        whole = self._take(_REPLY.size + coming, end)
        return command, sequence, status, whole[_REPLY.size :]

    def _transfer(
        self, direction: int, endpoint: int, data: bytes, length: int, timeout: float, setup: bytes
    ) -> tuple[int, bytes]:
        self._sequence += 1
        mine = self._sequence
        self._inward = {mine} if direction == _IN else set()
        head = (_CMD_SUBMIT, mine, self._device.id, direction, endpoint)
        try:
            self._socket.settimeout(_TIMEOUT)
            self._socket.sendall(_SUBMIT.pack(*head, 0, length, 0, _NOT_ISO, 0, setup) + data)
            try:
                _, _, status, came = self._receive(time.monotonic() + timeout)
                return status, came
            except TimeoutError:
                return self._take_back(mine, endpoint)
        except (_Gone, OSError):
            return -errno.ENODEV, b""

    def _take_back(self, mine: int, endpoint: int) -> tuple[int, bytes]:
        """Unlink a transfer that has timed out; it may have ended meanwhile."""
        self._sequence += 1
        number = self._sequence
        self._socket.settimeout(_TIMEOUT)
        self._socket.sendall(_UNLINK.pack(_CMD_UNLINK, number, self._device.id, 0, endpoint, mine))
        result: tuple[int, bytes] = (TIMED_OUT, b"")
        while True:
            command, sequence, status, data = self._receive(None)
            if command == _RET_UNLINK and sequence == number:
                return result
            if command == _RET_SUBMIT and sequence == mine:
                result = (status, data)

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
        self._socket.close()


def bulk_pair(descriptors: Descriptors) -> tuple[Endpoint, Endpoint] | None:
    """The first bulk OUT and the first bulk IN endpoint of interface 0."""
    bulk = [e for e in parse_device(descriptors).endpoints if e.bulk]
    out = next((e for e in bulk if not e.inward), None)
    inward = next((e for e in bulk if e.inward), None)
    return None if out is None or inward is None else (out, inward)
