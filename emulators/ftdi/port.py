"""Serve serial lines behind emulated FTDI adapters on USB/IP."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from dexkit.clock import RealClock
from dexkit.emulators.dex3_mcu.server import Server
from dexkit.emulators.faults import Fault
from dexkit.emulators.ftdi.usb import FtdiUsb
from dexkit.emulators.serial_line import SerialLine

__all__ = ["FtdiPort"]


class FtdiPort:
    """Serves adapters with their lines on one USB/IP server.

    :param adapters: the first is at bus id 1-1, the second at 1-2.
    :param host: address to bind.
    :param port: 0 takes any free one.
    :raises EmulatorError: the port cannot be opened.

    ``start`` serves in a thread. Also a context manager.

    :ivar overruns: always 0; each adapter's chip counts the bytes that its host did not read.
    """

    overruns = 0

    def __init__(
        self, adapters: Sequence[FtdiUsb], *, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self.adapters = list(adapters)
        self._server = Server(self.adapters, host=host, port=port)

    def start(self) -> None:
        """Serve in a background thread."""
        self._server.start()

    @property
    def line(self) -> SerialLine:
        """The first adapter's line."""
        return self.adapters[0].line

    @property
    def path(self) -> str:
        """URL for clients: ``usbip://HOST:PORT``."""
        return self._server.url

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return self._server.port

    @property
    def place(self) -> str:
        """Description for the ready line."""
        one = self.adapters[0]
        return f"busid={one.device.busid} adapter={one.chip.model.name} serial={one.serial}"

    @property
    def error(self) -> BaseException | None:
        """The error that ended the server, or None."""
        return self._server.error

    @property
    def failure(self) -> Exception | None:
        """The first exception on a client's message, which the server has survived, if any."""
        return self._server.failure

    def inject(self, fault: Fault) -> None:
        """Inject a fault into every line, its time counted from now; from any thread."""
        for adapter in self.adapters:
            self._server.call(partial(_add, adapter, fault))

    def close(self) -> None:
        """Disconnect clients and free the port. May be called twice."""
        self._server.close()

    def __enter__(self) -> FtdiPort:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _add(adapter: FtdiUsb, fault: Fault) -> None:
    adapter.line.schedule.add(fault, RealClock().now())
