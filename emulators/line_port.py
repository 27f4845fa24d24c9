"""Choose how an emulated serial line is served: on a pseudo-terminal, or behind an FTDI adapter."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from dexkit.emulators.serial_line import SerialLine
from dexkit.emulators.serial_port import Port
from dexkit.errors import UsageError
from dexkit.escaping import one_line

if TYPE_CHECKING:
    from dexkit.emulators.ftdi import FtdiPort

__all__ = ["SCHEME", "line_port", "server_address"]

SCHEME = "usbip://"
_PORT = 3240


def line_port(
    line: SerialLine,
    link: str | os.PathLike[str] | None,
    *,
    serial: str,
    fast: bool = False,
    check_baudrate: bool = True,
) -> Port | FtdiPort:
    """Make the port of a line; its ``start`` serves it.

    :param link: ``usbip://HOST[:PORT]`` (3240; 0 takes a free one) for an adapter on USB/IP, else
        as of :class:`~dexkit.emulators.serial_port.Port`.
    :param serial: serial number of the adapter.
    :param fast: an FT232H, which does 12 Mbaud, instead of an FT232R, which does 3.
    :raises UsageError: the address is invalid.
    :raises EmulatorError: it cannot be opened.
    """
    if not isinstance(link, str) or not link.startswith(SCHEME):
        return Port(line, link, check_baudrate=check_baudrate)
    host, port = server_address(link)
    # imported here, because a pseudo-terminal needs none of the USB packages
    from dexkit.emulators.ftdi import FT232H, FT232R, FtdiPort, FtdiUsb

    model = FT232H if fast else FT232R
    adapter = FtdiUsb(line, serial, model=model, check_baudrate=check_baudrate)
    return FtdiPort([adapter], host=host, port=port)


def server_address(link: str) -> tuple[str, int]:
    """Host and port of ``usbip://HOST[:PORT]``; 3240 if none is named.

    :raises UsageError: it is none.
    """
    try:
        parts = urlsplit(link)
        host, port = parts.hostname, _PORT if parts.port is None else parts.port
        if parts.scheme != "usbip" or not host or parts.path or parts.query or parts.username:
            raise ValueError
    except ValueError as error:
        raise UsageError(
            f"{one_line(link, 80)} is no address of a server", hint=f"{SCHEME}127.0.0.1:{_PORT}"
        ) from error
    return host, port
