"""A port in front of another library's web server, which refuses requests of foreign web pages.

Neither server behind it, viser's or that of Foxglove's SDK, looks at Host or Origin, and the second
has no place to do so. So it listens where nothing else can connect to it, and dexkit has the port
that is known: it reads the head of each request (:mod:`dexkit.view.web_origins`), answers 403 to
those that are refused, and passes the others on as they are.

What keeps browsers from going round it is a filter in the kernel, on the socket of the server
behind: it takes packets from one address of loopback only, drawn at random, which connections have
that bind to it, and a browser's have not.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import secrets
import socket
import threading
from types import TracebackType

from dexkit import interface_filter
from dexkit.dds_socket_filter import copies_of_sockets
from dexkit.errors import UsageError
from dexkit.tcp_listener import listen
from dexkit.view.web_origins import Allowed, Refused, read_request

__all__ = ["GuardedPort", "HiddenAddress"]

_log = logging.getLogger(__name__)

_PATIENCE = 20.0  # seconds for the head of a request
_LONGEST = 1 << 16  # bytes of a head, and of a piece that is passed on
_DRAWS = 5
_PLAIN = "127.0.0.1"


class HiddenAddress:
    """Where the server behind listens: a free port of an address of loopback.

    :ivar host: to give to the server, with ``port``.
    :ivar sender: the address to connect from.
    """

    def __init__(self) -> None:
        self.sender = _draw()
        # before the filter is there, this is what a page would have to guess
        self.host = _draw()
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.bind((self.host, 0))
            self.port: int = probe.getsockname()[1]

    def hide(self) -> None:
        """Accept connections from :attr:`sender` only; the server listens by now.

        :raises UsageError: the system has no such filter.
        """
        try:
            if self.sender == _PLAIN:  # every browser's
                raise OSError(errno.EADDRNOTAVAIL, "loopback has one address")
            with self._listener() as listener:
                indices = interface_filter.accepted_indices("lo")
                interface_filter.accept_only(listener, indices, self.sender)
        except OSError as error:
            why = f"web pages of others cannot be kept from the view: {error.strerror or error}"
            if not interface_filter.all_interfaces_allowed():
                raise UsageError(why, hint=interface_filter.HINT) from error
            _log.warning("%s", why)

    def _listener(self) -> socket.socket:
        for sock in copies_of_sockets():
            if sock.family == socket.AF_INET and sock.type == socket.SOCK_STREAM:
                listening = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
                if listening and sock.getsockname() == (self.host, self.port):
                    return sock
            sock.close()
        raise OSError("the socket of the server was not found")


def _draw() -> str:
    """An address of loopback at random; 127.0.0.1 on systems that have no other."""
    for _ in range(_DRAWS):
        address = ".".join(("127", *(str(1 + secrets.randbelow(254)) for _ in range(3))))
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe,
        ):
            probe.bind((address, 0))
            return address
    return _PLAIN


class GuardedPort:
    """The port that browsers connect to; it accepts them from :meth:`open` on.

    :param ports: tried one after another; 0 is any.
    :param allowed: whose requests are passed on.
    :raises UsageError: none is free.

    :ivar hidden: where the server behind is to listen.
    """

    def __init__(self, host: str, ports: range, allowed: Allowed) -> None:
        self.host = host
        self._allowed = allowed
        self.hidden = HiddenAddress()
        self._listener = _first_free(host, ports)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="guarded-port", daemon=True)
        self._told: set[str] = set()

    @property
    def authority(self) -> str:
        """``HOST:PORT``, for URLs."""
        host = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        return f"{f'[{host}]' if ':' in host else host}:{self.port}"

    def open(self) -> None:
        """Hide the server behind, which listens by now, and pass requests on to it.

        :raises UsageError: it cannot be hidden.
        """
        self.hidden.hide()
        self._thread.start()

    def close(self) -> None:
        """End the connections and the port. May be called twice."""
        if self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                self._loop.call_soon_threadsafe(self._end.set)
            self._thread.join()
        self._listener.close()
        if not self._loop.is_closed():
            self._loop.close()

    def __enter__(self) -> GuardedPort:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -- the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._client, sock=self._listener, limit=_LONGEST)
        await self._end.wait()
        server.close()
        tasks = [t for t in asyncio.all_tasks() if t is not asyncio.current_task()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # whatever ends a connection, by either end, ends it alone
        ends = (OSError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError)
        try:
            with contextlib.suppress(*ends):
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _PATIENCE)
                try:
                    request = read_request(head)
                    self._allowed.check(request)
                except Refused as refused:
                    self._tell(str(refused))
                    writer.write(_refusal(str(refused)))
                    await writer.drain()
                    return
                await self._pass_on(head, request.upgrade, reader, writer)
        finally:
            writer.close()

    async def _pass_on(
        self,
        head: bytes,
        upgrade: bool,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        inner_reader, inner_writer = await asyncio.open_connection(
            self.hidden.host, self.hidden.port, local_addr=(self.hidden.sender, 0), limit=_LONGEST
        )
        try:
            inner_writer.write(head)
            if not upgrade:  # nothing more is passed on: it would be a request without a check
                await _pump(inner_reader, writer)
                return
            pumps = [
                asyncio.ensure_future(_pump(source, sink))
                for source, sink in ((inner_reader, writer), (reader, inner_writer))
            ]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)
        finally:
            inner_writer.close()

    def _tell(self, reason: str) -> None:
        if reason not in self._told and len(self._told) < 20:
            self._told.add(reason)
            _log.warning("a request was refused: %s (logged once)", reason)


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Pass on what comes, to its end."""
    while data := await reader.read(_LONGEST):
        writer.write(data)
        await writer.drain()


def _refusal(reason: str) -> bytes:
    body = f"Refused: {reason}\n".encode()
    head = (
        "HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"X-Content-Type-Options: nosniff\r\nContent-Length: {len(body)}\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode() + body


def _first_free(host: str, ports: range) -> socket.socket:
    problem: Exception | None = None
    for port in ports:
        try:
            return listen(host, port)
        except OSError as error:
            problem = error
        except (TypeError, ValueError) as error:  # no host has such a name
            problem = error
            break
    reason = getattr(problem, "strerror", None) or str(problem)
    raise UsageError(
        f"the view cannot be bound to {host}, port {ports.start}: {reason}",
        hint="choose another one: --port",
    )
