"""Finding a hand: on this machine's USB, or behind a USB/IP server."""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
_DEFAULT_PORT = 3240  # registered for USB/IP
_NO_LIBUSB = "libusb is not installed"
_INSTALL_LIBUSB = "install it: sudo apt install libusb-1.0-0"


@dataclass(frozen=True)
class Server:
    """A USB/IP server."""

    host: str
    port: int = _DEFAULT_PORT

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"usbip://{host}:{self.port}"


LOCAL_SERVER = Server("127.0.0.1")
"""Where a hand is looked for at last if nobody says where it is: that of
``dexkit emulate dex3-usb``."""


def parse_server(text: str) -> tuple[Server, str | None]:
    """``usbip://host[:port][/serial]``: the server and the serial number.

    :raises UsageError: it is something else.
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
    """A device that says it is a Dex3-1.

    :param backend: PyUSB backend that sees it.
    :param device: one of the backend's devices.
    :param side: by its product id.
    :param where: for messages.
    :param server: that exports it; None for this machine's USB.
    """

    backend: Backend
    device: Any
    side: Side
    where: str
    server: Server | None = None

    def __str__(self) -> str:
        return f"the {self.side} Dex3-1 on {self.where}"

    def serial(self) -> str:
        """Its serial number, empty if it has none.

        :raises OSError: as libusb; no permission to open it, for example.
        """
        handle = self.backend.open_device(self.device)
        try:
            return read_serial(self.backend, handle)
        finally:
            self.backend.close_device(handle)


def find_hand(
    side: Side, *, serial: str | None = None, server: Server | None = None, local: bool = True
) -> Candidate:
    """The hand of ``side``, or the one with a serial number.

    :param server: look there only; otherwise on this machine's USB and, if it is not there, on
        :data:`LOCAL_SERVER`.
    :param local: whether to look on :data:`LOCAL_SERVER` at all.
    :raises HandNotFound: there is none, or more than one; says what there is.
    :raises HandRefused: that serial number is the other side's, or it may not be read.
    """
    seen: list[str] = []
    hints: list[str] = []
    if server is not None:
        try:
            candidates = _on_server(server)
        except OSError as error:
            raise HandNotFound(
                f"no USB/IP server at {server}: {error.__cause__ or error.strerror or error}",
                hint=f"start one there: dexkit emulate dex3-usb --side {side}, or usbipd for a "
                "real hand",
            ) from error
        with _reporting(f"looking at {server}"):
            found = _choose(candidates, side, serial, seen)
        places = str(server)
    else:
        with _reporting("looking at the USB devices"):
            found = _choose(_on_system(seen, hints), side, serial, seen)
        places = "this machine's USB"
        if found is None and local:
            try:
                candidates = _on_server(LOCAL_SERVER)
            except OSError:
                candidates = []
                seen.append("no USB/IP server there")
            with _reporting(f"looking at {LOCAL_SERVER}"):
                found = _choose(candidates, side, serial, seen)
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
    """Every Dex3-1 on this machine's USB, or on a server.

    :raises OSError: as libusb, or the server cannot be reached.
    """
    return _on_system([], []) if server is None else _on_server(server)


def _on_system(seen: list[str], hints: list[str]) -> list[Candidate]:
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        seen.append(_NO_LIBUSB)
        hints.append(_INSTALL_LIBUSB)
        return []
    return _candidates(backend)


def _on_server(server: Server) -> list[Candidate]:
    # here, not above: it loads the mDNS code that comes with the package
    from dexkit.usbip import UsbIpBackend

    return _candidates(UsbIpBackend(server.host, server.port), server)


def _candidates(backend: Backend, server: Server | None = None) -> list[Candidate]:
    where = "USB" if server is None else str(server)
    found = []
    for device in backend.enumerate_devices():
        descriptor = backend.get_device_descriptor(device)
        side = _SIDES.get(descriptor.idProduct)
        if descriptor.idVendor == VENDOR_ID and side is not None:
            place = f"{where}, bus {descriptor.bus} device {descriptor.address}"
            found.append(Candidate(backend, device, side, place, server))
    return found


def _choose(
    candidates: list[Candidate], side: Side, serial: str | None, seen: list[str]
) -> Candidate | None:
    """The one that is meant; None, and what there is in ``seen``, if it is not there."""
    if serial is None:
        mine = [c for c in candidates if c.side is side]
        if len(mine) > 1:
            listed = ", ".join(_name(c) for c in mine)
            raise HandNotFound(
                f"more than one {side} Dex3-1: {listed}",
                hint="say which: --device SERIAL, or --device usbip://HOST:PORT/SERIAL",
            )
        if mine:
            return mine[0]
        # not asked for their numbers: that would take them from whoever is about to have them
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
    if denied is not None:  # it may well be that one
        raise denied
    return None


def _name(candidate: Candidate) -> str:
    try:
        number = candidate.serial() or "no serial number"
    except OSError as error:
        busy = error.errno == errno.EBUSY
        number = "another program has it" if busy else f"no serial number: {error}"
    return f"{candidate} ({number})"


@contextmanager
def _reporting(what: str) -> Iterator[None]:
    try:
        yield
    except HandError:
        raise
    except (OSError, NotImplementedError) as error:
        raise hand_error(error, what) from error
