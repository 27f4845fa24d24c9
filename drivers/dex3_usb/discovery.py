"""Find a Dex3-1 on this machine's USB or behind a USB/IP server."""

from __future__ import annotations

import errno
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import usb.backend.libusb1

from dexkit.drivers.dex3_usb.link import Backend, hand_error, read_serial
from dexkit.errors import HandError, HandNotFound, HandRefused, UsageError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

__all__ = ["LOCAL_SERVER", "Candidate", "Server", "find_hand", "list_hands", "parse_server"]

log = logging.getLogger(__name__)

_SIDES = {product: side for side, product in PRODUCT_ID.items()}
_DEFAULT_PORT = 3240  # the TCP port that IANA registered for USB/IP
_NO_LIBUSB = "libusb is not installed"
_INSTALL_LIBUSB = "install it: sudo apt install libusb-1.0-0"
_SYSFS = Path("/sys/bus/usb/devices")
_renewing = threading.Lock()
_replaced: list[Backend] = []
_given_up: set[tuple[int, int]] = set()  # in sysfs, and in no list of libusb


@dataclass(frozen=True)
class Server:
    """A USB/IP server."""

    host: str
    port: int = _DEFAULT_PORT

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"usbip://{host}:{self.port}"


LOCAL_SERVER = Server("127.0.0.1")
"""Searched last if no place is given: the server of ``dexkit emulate dex3-usb``."""


def parse_server(text: str) -> tuple[Server, str | None]:
    """Parse ``usbip://host[:port][/serial]``; return the server and the serial number.

    :raises UsageError: the text has another form.
    """
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError as error:
        raise UsageError(f"{text}: {error}", hint=_URL_HINT) from error
    extra = parts.query or parts.fragment or parts.username or parts.password
    serial = parts.path.removeprefix("/")
    if parts.scheme != "usbip" or not parts.hostname or extra or "/" in serial:
        raise UsageError(f"{text} is no address of a USB/IP server", hint=_URL_HINT)
    return Server(parts.hostname, _DEFAULT_PORT if port is None else port), serial or None


_URL_HINT = "write usbip://HOST[:PORT][/SERIAL], for example usbip://127.0.0.1:3240"


@dataclass
class Candidate:
    """A USB device with the vendor and product id of a Dex3-1.

    :param backend: PyUSB backend that lists it.
    :param device: one of the backend's devices.
    :param side: from its product id.
    :param where: its place, for messages.
    :param server: the USB/IP server that exports it; None for this machine's USB.
    :param node: its bus and device number.
    """

    backend: Backend
    device: Any
    side: Side
    where: str
    server: Server | None = None
    node: tuple[int, int] = (0, 0)

    def __str__(self) -> str:
        return f"the {self.side} Dex3-1 on {self.where}"

    def serial(self) -> str:
        """Read the serial number; empty if the device has none.

        :raises OSError: from libusb, for example without permission to open the device.
        """
        handle = self.backend.open_device(self.device)
        try:
            return read_serial(self.backend, handle)
        finally:
            self.backend.close_device(handle)


def find_hand(
    side: Side, *, serial: str | None = None, server: Server | None = None, local: bool = True
) -> Candidate:
    """Find the hand of ``side``, or the one with a serial number.

    :param server: search this server only; otherwise this machine's USB, then
        :data:`LOCAL_SERVER`.
    :param local: whether to search :data:`LOCAL_SERVER` at all.
    :raises HandNotFound: there is none, or more than one; the message lists what there is.
    :raises HandRefused: the hand with that serial number is the other side's, or the number may not
        be read.
    """
    seen: list[str] = []
    hints: list[str] = []
    if server is not None:
        try:
            candidates = _list_on_server(server)
        except OSError as error:
            raise HandNotFound(
                f"no USB/IP server at {server}: {error.__cause__ or error.strerror or error}",
                hint=f"start one there: dexkit emulate dex3-usb --side {side}, or usbipd for a "
                "real hand",
            ) from error
        with _translate_errors(f"looking at {server}"):
            found = _choose_candidate(candidates, side, serial, seen)
        places = str(server)
    else:
        with _translate_errors("looking at the USB devices"):
            found = _choose_candidate(_list_on_usb(seen, hints), side, serial, seen)
        places = "this machine's USB"
        if found is None and local:
            try:
                candidates = _list_on_server(LOCAL_SERVER)
            except OSError:
                candidates = []
                seen.append("no USB/IP server there")
            with _translate_errors(f"looking at {LOCAL_SERVER}"):
                found = _choose_candidate(candidates, side, serial, seen)
            if found is not None:
                log.info("no %s hand on this machine's USB; taking %s", side, found)
            places += f" or {LOCAL_SERVER}"
    if found is not None:
        return found
    what = f"serial number {serial}" if serial else f"{VENDOR_ID:04x}:{PRODUCT_ID[side]:04x}"
    raise HandNotFound(
        f"no {side} Dex3-1 ({what}) on {places}" + (f": {'; '.join(seen)}" if seen else ""),
        hint="; ".join(
            [
                *hints,
                f"is it plugged in and powered (24 to 58 V)? See: lsusb -d {VENDOR_ID:04x}:",
                f"without hardware: dexkit emulate dex3-usb --side {side}",
            ]
        ),
    )


def list_hands(server: Server | None = None) -> list[Candidate]:
    """List every Dex3-1 on this machine's USB, or on a server.

    :raises OSError: from libusb, or the server cannot be reached.
    """
    return _list_on_usb([], []) if server is None else _list_on_server(server)


def _list_on_usb(seen: list[str], hints: list[str]) -> list[Candidate]:
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        seen.append(_NO_LIBUSB)
        hints.append(_INSTALL_LIBUSB)
        return []
    with _renewing:
        found = _find_candidates(backend)
        unlisted = _nodes_of_hands(_SYSFS) - {one.node for one in found} - _given_up
        if unlisted and isinstance(backend, usb.backend.libusb1._LibUSB):
            found = _find_candidates(_renew(backend))
            _given_up.update(unlisted - {one.node for one in found})
    return found


def _renew(backend: Backend) -> Backend:
    """Return a libusb backend with a fresh device list.

    libusb drops a device whose transfer failed, and lists it again only when udev announces it.
    udev does not when a kernel driver was unbound and bound again, nor where no udev runs. The old
    list stays in memory, because it may be in use.
    """
    log.debug("libusb does not list a hand that the system has; asking it anew")
    _replaced.append(backend)
    usb.backend.libusb1._lib_object = type(backend)(backend.lib)
    return usb.backend.libusb1._lib_object


def _nodes_of_hands(sysfs: Path) -> set[tuple[int, int]]:
    """Bus and device number of each hand in sysfs."""
    nodes = set()
    for folder in sysfs.glob("*"):
        try:
            vendor, product = (int((folder / n).read_text(), 16) for n in ("idVendor", "idProduct"))
            if vendor == VENDOR_ID and product in _SIDES:
                bus, number = (int((folder / n).read_text()) for n in ("busnum", "devnum"))
                nodes.add((bus, number))
        except (OSError, ValueError):  # an interface, or a device that goes away meanwhile
            continue
    return nodes


def _list_on_server(server: Server) -> list[Candidate]:
    # imported here because it loads the mDNS code of the usbip package
    from dexkit.usbip import UsbIpBackend

    return _find_candidates(UsbIpBackend(server.host, server.port), server)


def _find_candidates(backend: Backend, server: Server | None = None) -> list[Candidate]:
    where = "USB" if server is None else str(server)
    found = []
    for device in backend.enumerate_devices():
        descriptor = backend.get_device_descriptor(device)
        side = _SIDES.get(descriptor.idProduct)
        if descriptor.idVendor == VENDOR_ID and side is not None:
            node = descriptor.bus, descriptor.address
            place = f"{where}, bus {node[0]} device {node[1]}"
            found.append(Candidate(backend, device, side, place, server, node))
    return found


def _choose_candidate(
    candidates: list[Candidate], side: Side, serial: str | None, seen: list[str]
) -> Candidate | None:
    """Choose the hand by serial number or side; None if it is absent. ``seen`` lists the others."""
    if serial is None:
        mine = [c for c in candidates if c.side is side]
        if len(mine) > 1:
            listed = ", ".join(_name_with_serial(c) for c in mine)
            raise HandNotFound(
                f"more than one {side} Dex3-1: {listed}",
                hint="say which: --device SERIAL, or --device usbip://HOST:PORT/SERIAL",
            )
        if mine:
            return mine[0]
        # their serial numbers are not read: that would open devices that others are about to open
        seen += [f"there is {c}" for c in candidates]
        return None
    denied: OSError | None = None
    for candidate in candidates:
        try:
            number = candidate.serial()
        except OSError as error:
            denied = error
            seen.append(f"{candidate} cannot be asked for its serial number")
            continue
        if number != serial:
            seen.append(f"there is the {candidate.side} hand {number or 'without a number'}")
        elif candidate.side is not side:
            raise HandRefused(
                f"serial number {serial} is that of a {candidate.side} hand, not a {side} one",
                hint=f"--side {candidate.side}, or another --device",
            )
        else:
            return candidate
    if denied is not None:  # it may be the wanted hand
        raise denied
    return None


def _name_with_serial(candidate: Candidate) -> str:
    try:
        number = candidate.serial() or "no serial number"
    except OSError as error:
        busy = error.errno == errno.EBUSY
        number = "another program has it" if busy else f"no serial number: {error}"
    return f"{candidate} ({number})"


@contextmanager
def _translate_errors(what: str) -> Iterator[None]:
    try:
        yield
    except HandError:
        raise
    except (OSError, NotImplementedError) as error:
        raise hand_error(error, what) from error
