"""USB/IP server over TCP in one thread, whose devices can be listed, imported and unplugged.

The ``usbip`` package provides descriptors, control requests, endpoint halts, parked IN transfers
and the bytes of the protocol. Its own listener is not used: it never closes an accepted connection,
so nothing can be unplugged; it does not report which free port it took; and its devices advance
only while a client sends requests.

Only one client at a time can import a device, as on a real host: a second import is refused as
busy.

An unlinked transfer gets one reply, RET_UNLINK with -ECONNRESET; with 0 if RET_SUBMIT went out
before it. Linux' vhci_hcd can send an unlink *before* the transfer that it is for: its thread sends
all queued transfers, then all queued unlinks, and both may be queued in between (``vhci_tx.c``).
Such an unlink waits here for its transfer, which is then not carried out. If it were answered at
once, vhci_hcd would give the transfer back at that answer, and drop the device at the later
RET_SUBMIT ("cannot find a urb of seqnum").

A client's use of memory and connections is bounded:

* :data:`MAX_PARKED` transfers that wait for data; one more ends with -ENOMEM, as a host
  controller's driver ends one for which its ring has no room (Linux ``xhci-ring.c``);
* :data:`MAX_PAYLOAD` bytes of a transfer and :data:`MAX_UNREAD` of replies that it does not
  read: above that, its connection is closed;
* :data:`MAX_CONNECTIONS`: a further one takes the place of the oldest that has no device, and is
  refused if there is none;
* :data:`IMPORT_TIMEOUT` seconds to list or import, and :data:`PEER_TIMEOUT` until a peer that has
  vanished from the network is disconnected; a client with a device may be idle without limit.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from usbip import protocol
from usbip.device import USBDevice

from dexkit.clock import Clock, RealClock
from dexkit.errors import EmulatorError
from dexkit.escaping import one_line
from dexkit.tcp_listener import listen
from dexkit.threads import Worker

__all__ = [
    "IMPORT_TIMEOUT",
    "MAX_CONNECTIONS",
    "MAX_PARKED",
    "MAX_PAYLOAD",
    "MAX_UNREAD",
    "PEER_TIMEOUT",
    "Plug",
    "Server",
]

log = logging.getLogger("dexkit.emulators")

MAX_PARKED = 1024
"""IN transfers of one client that wait for data. A hand's driver has one; 256 fit into a segment of
a Linux xHCI ring (TRBS_PER_SEGMENT)."""
MAX_PAYLOAD = 1 << 20
"""Bytes of a transfer. A frame to a hand has 1234; usbfs of Linux has 16 MB for all programs."""
MAX_UNREAD = 1 << 18
"""Bytes of replies that a client may leave unread: about 200 answers of a hand."""
MAX_CONNECTIONS = 32
"""Clients at a time. Two can import a hand; the others list."""
IMPORT_TIMEOUT = 10.0
"""Seconds from a connection to its import. A list and an import take milliseconds."""
PEER_TIMEOUT = 30
"""Seconds after which a peer that no longer acknowledges TCP data is disconnected."""

_REQUEST = 8  # bytes: version, code, status
_BUSID = 32
_COMMAND = 48
_FIELDS = struct.Struct(">I8xI8xI")  # of a command: its code, direction, length of the data
_ST_DEV_BUSY = 2  # of Linux' usbip_common.h
_RETURN = struct.Struct(">IIIIIi24x")
_SET_CONFIGURATION = b"\x00\x09"
_ACCEPT_PAUSE = 0.1  # seconds without accepting after the system ran out of file descriptors
_NUMBERS = 0xFFFFFFFF
_UNLINKED = -errno.ECONNRESET  # status of an unlinked transfer that Linux' vhci expects
_TICK = 4e-3
_SPIN = 120e-6  # a sleep ends some 50 to 100 us late: poll for the rest


class Plug(Protocol):
    """A device that can be plugged into a :class:`Server`."""

    @property
    def device(self) -> USBDevice:
        """Its descriptors and endpoints."""
        ...

    @property
    def plugged(self) -> bool:
        """Whether the cable is plugged."""
        ...

    def advance(self) -> float | None:
        """Advance to the present time; return the time of the next event, or None."""
        ...

    def attached(self) -> None:
        """Called when a client imports the device: discard transfers of earlier clients."""
        ...


class Server:
    """Serves plugs on a TCP port.

    :param plugs: at least one; they get the bus ids 1-1, 1-2, ... in this order.
    :param host: address to bind.
    :param port: 0 takes any free one.
    :param clock: the plugs' clock.
    :raises EmulatorError: the port is in use, or the address is not this machine's.

    ``run`` serves until ``stop``; ``start`` does so in a thread. Also a context manager.

    :ivar port: the port taken.
    :ivar error: what ended the thread, or None.
    :ivar failure: the first exception while serving a client's message (a defect of the emulator),
        or None; that client was disconnected.
    """

    def __init__(
        self,
        plugs: Sequence[Plug],
        *,
        host: str = "127.0.0.1",
        port: int = 3240,
        clock: Clock | None = None,
    ) -> None:
        self.host = host
        self.error: BaseException | None = None
        self.failure: Exception | None = None
        self._accept_paused_until = 0.0
        self._clock: Clock = clock or RealClock()
        self._plugs = list(plugs)
        for index, plug in enumerate(self._plugs):
            plug.device.set_busid(f"1-{index + 1}")
            plug.device.busnum, plug.device.devnum = 1, index + 2
        self._connections: dict[int, _Connection] = {}
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._closed = False
        self._calls: list[Callable[[], None]] = []
        self._listener = _listen(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_out.setblocking(False)
        self._wake_in.setblocking(False)
        self._poll = select.epoll()
        self._poll.register(self._listener, select.EPOLLIN)
        self._poll.register(self._wake_out, select.EPOLLIN)

    @property
    def url(self) -> str:
        """URL for clients."""
        return f"usbip://{self.host}:{self.port}"

    # --- running

    def start(self) -> None:
        """Serve in a background thread."""
        self._thread = Worker("USB/IP", self.run, failed=self._record_error)
        self._thread.start()

    def _record_error(self, error: Exception) -> None:
        self.error = error

    def stop(self) -> None:
        """Ask :meth:`run` to return; from any thread or a signal handler."""
        self._stopping = True
        self._wake_server()

    def call(self, function: Callable[[], None]) -> None:
        """Have the serving thread call ``function`` soon."""
        self._calls.append(function)  # atomic, as is the pop
        self._wake_server()

    def _wake_server(self) -> None:
        with contextlib.suppress(OSError):
            self._wake_in.send(b"x")

    def run(self) -> None:
        """Serve until :meth:`stop`."""
        clock = self._clock
        while not self._stopping:
            while self._calls:
                self._calls.pop(0)()
            due: float | None = None
            for plug in self._plugs:
                following = plug.advance()
                if following is not None and (due is None or following < due):
                    due = following
            for connection in [c for c in self._connections.values() if c.wants_attention]:
                if connection.cut_off:
                    self._drop(connection)
                else:
                    self._flush(connection)
            self._close_idle_connections(time.monotonic())
            self._wait(clock, due)

    def _close_idle_connections(self, now: float) -> None:
        """Close connections that import nothing in time; accept again after a pause."""
        for connection in [c for c in self._connections.values() if c.until < now]:
            self._drop(connection)
        if self._accept_paused_until and now >= self._accept_paused_until:
            self._accept_paused_until = 0.0
            self._poll.modify(self._listener, select.EPOLLIN)

    def _wait(self, clock: Clock, due: float | None) -> None:
        """Serve requests for one tick, or until ``due`` if that is sooner."""
        pause = _TICK
        if due is not None:
            pause = min(pause, due - clock.now())
        if pause < _TICK:
            pause = max(0.0, pause - _SPIN)
        for fd, events in self._poll.poll(pause):
            if fd == self._listener.fileno():
                self._accept()
            elif fd == self._wake_out.fileno():
                with contextlib.suppress(OSError):
                    self._wake_out.recv(4096)
            else:
                connection = self._connections.get(fd)
                if connection is None:
                    continue
                if events & (select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR):
                    self._receive(connection)
                if events & select.EPOLLOUT and fd in self._connections:
                    self._flush(connection)

    # --- connections

    def _accept(self) -> None:
        for _ in range(MAX_CONNECTIONS):
            if not self._accept_one():
                return

    def _accept_one(self) -> bool:
        """Accept one connection; return whether another may wait."""
        try:
            sock, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                # accepting would fail again at once: pause, to avoid a busy loop
                self._accept_paused_until = time.monotonic() + _ACCEPT_PAUSE
                self._poll.modify(self._listener, 0)
            return False
        if len(self._connections) >= MAX_CONNECTIONS:
            # the oldest first: dictionaries keep their order
            idle = next((c for c in self._connections.values() if c.plug is None), None)
            if idle is None:
                sock.close()
                return True
            self._drop(idle)
        sock.setblocking(False)
        for level, option, value in (
            (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
            (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
            (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, PEER_TIMEOUT // 2),
            (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, PEER_TIMEOUT // 6),
            (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
            (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, PEER_TIMEOUT * 1000),
        ):
            sock.setsockopt(level, option, value)
        self._connections[sock.fileno()] = _Connection(sock, time.monotonic() + IMPORT_TIMEOUT)
        self._poll.register(sock, select.EPOLLIN)
        return True

    def _drop(self, connection: _Connection) -> None:
        if self._connections.pop(connection.sock.fileno(), None) is None:
            return
        self._poll.unregister(connection.sock)
        if connection.plug is not None:
            connection.plug.device.reset_io()  # transfers parked for it must not be completed
        connection.sock.close()

    def _receive(self, connection: _Connection) -> None:
        try:
            data = connection.sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
            return
        if connection.closing:  # it stays open only until its client has read the replies
            return
        connection.inbox += data
        try:
            while connection.inbox and self._serve(connection):
                pass
        except (_NotUsbIp, struct.error):
            connection.close_soon()
        except Exception as error:  # an error on one client's message must not stop the server
            if self.failure is None:
                self.failure = error
                log.error("the emulated device failed (logged once)", exc_info=error)
            connection.close_soon()
        self._flush(connection)

    def _flush(self, connection: _Connection) -> None:
        outbox = connection.outbox
        if outbox:
            try:
                sent = connection.sock.send(outbox)
            except BlockingIOError:
                sent = 0
            except OSError:
                self._drop(connection)
                return
            del outbox[:sent]
            if len(outbox) > MAX_UNREAD:
                self._drop(connection)
                return
        if connection.waiting != bool(outbox):
            connection.waiting = bool(outbox)
            mask = select.EPOLLIN | (select.EPOLLOUT if outbox else 0)
            self._poll.modify(connection.sock, mask)
        if connection.closing and not outbox:
            self._drop(connection)

    def _serve(self, connection: _Connection) -> bool:
        """Serve one message if it is complete."""
        if connection.plug is None:
            return self._serve_list_or_import(connection)
        inbox = connection.inbox
        if len(inbox) < _COMMAND:
            return False
        command, direction, length = _FIELDS.unpack_from(inbox)
        if command not in (protocol.CMD_SUBMIT, protocol.CMD_UNLINK):
            raise _NotUsbIp
        if command == protocol.CMD_SUBMIT:
            if length > MAX_PAYLOAD or direction > 1:
                raise _NotUsbIp
            if direction == protocol.OUT and len(inbox) < _COMMAND + length:
                return False
        urb = protocol.read_cmd(connection)
        device = connection.plug.device
        if urb.command == protocol.CMD_UNLINK:
            self._unlink(connection, device, urb)
        else:
            self._submit(connection, device, urb)
        return True

    def _unlink(self, connection: _Connection, device: USBDevice, urb: Any) -> None:
        number = urb.flags  # this field is the number of the transfer to unlink
        if connection.is_to_come(number):
            if len(connection.unlinked_early) >= MAX_PARKED:
                raise _NotUsbIp
            connection.unlinked_early[number] = urb
            return
        late = connection.complete(number)
        if not late:
            device.cancel_urb(number)
        connection.unlinked(urb, 0 if late else _UNLINKED)

    def _submit(self, connection: _Connection, device: USBDevice, urb: Any) -> None:
        parked = connection.parked
        connection.newest = urb.seqnum
        if (unlink := connection.unlinked_early.pop(urb.seqnum, None)) is not None:
            connection.unlinked(unlink, _UNLINKED)
            return
        if urb.seqnum in parked:  # whose answer would be whose?
            raise _NotUsbIp
        if urb.direction == protocol.IN and urb.ep and len(parked) >= MAX_PARKED:
            connection.fail(urb, -errno.ENOMEM)
            return
        if urb.ep == 0 and urb.setup[:2] == _SET_CONFIGURATION:
            # it resets the endpoints: what waits there ends as where one is disabled
            for waiting in list(parked.values()):
                connection.fail(waiting, -errno.ESHUTDOWN)
        parked[urb.seqnum] = urb
        if device.handle_urb(urb, connection.respond) is not None:
            connection.respond(urb)

    def _serve_list_or_import(self, connection: _Connection) -> bool:
        """Serve a list or an import."""
        inbox = connection.inbox
        if len(inbox) < _REQUEST:
            return False
        code = int.from_bytes(inbox[2:4], "big")
        present = [plug for plug in self._plugs if plug.plugged]
        if code == protocol.OP_REQ_IMPORT:
            if len(inbox) < _REQUEST + _BUSID:
                return False
            busid = bytes(inbox[_REQUEST : _REQUEST + _BUSID]).split(b"\0")[0]
            for plug in present:
                if plug.device.busid.encode() == busid and self._busy(plug):
                    connection.outbox += struct.pack(
                        ">HHI", protocol.VERSION, protocol.OP_REP_IMPORT, _ST_DEV_BUSY
                    )
                    connection.close_soon()
                    return False
        elif code != protocol.OP_REQ_DEVLIST:
            raise _NotUsbIp
        device = protocol.serve_handshake(connection, [plug.device for plug in present])
        connection.plug = next((p for p in present if p.device is device), None)
        if connection.plug is None:
            connection.close_soon()
            return False
        connection.until = math.inf
        connection.plug.attached()
        return True

    def _busy(self, plug: Plug) -> bool:
        for connection in list(self._connections.values()):
            if connection.plug is plug:
                # it may have gone without our having looked yet
                self._receive(connection)
        return any(connection.plug is plug for connection in self._connections.values())

    # --- the end

    def close(self) -> None:
        """Stop, cut all connections and free the port. May be called twice."""
        if self._closed:
            return
        self._closed = True
        self.stop()
        if self._thread is not None:
            self._thread.join()
        for connection in list(self._connections.values()):
            self._drop(connection)
        self._poll.close()
        self._listener.close()
        self._wake_in.close()
        self._wake_out.close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class _NotUsbIp(Exception):
    """The client does not follow the USB/IP protocol."""


class _Connection:
    """One client's connection with its receive and send buffers.

    ``recv`` and ``sendall`` let the protocol's functions use it as a socket, so that header and
    data of a reply are sent together.
    """

    def __init__(self, sock: socket.socket, until: float) -> None:
        self.sock = sock
        self.inbox = bytearray()
        self.outbox = bytearray()
        self.plug: Plug | None = None
        self.parked: dict[int, Any] = {}  # transfers under way, by number
        self.newest: int | None = None  # number of the last transfer that came
        self.unlinked_early: dict[int, Any] = {}  # unlinks by number of a transfer still to come
        self.until = until  # when it is closed without an import
        self.closing = False
        self.waiting = False

    def close_soon(self) -> None:
        """Close it once its client has read the replies, or after a time-out."""
        self.closing = True
        self.inbox.clear()
        self.until = time.monotonic() + IMPORT_TIMEOUT

    @property
    def cut_off(self) -> bool:
        """Whether its device has been unplugged."""
        return self.plug is not None and not self.plug.plugged

    @property
    def wants_attention(self) -> bool:
        """Whether there is something to send, or its device is unplugged."""
        return bool(self.outbox) or self.cut_off

    def recv(self, size: int) -> bytes:
        data = bytes(self.inbox[:size])
        del self.inbox[:size]
        return data

    def sendall(self, data: bytes) -> None:
        self.outbox += data

    def is_to_come(self, seqnum: int) -> bool:
        """Whether a transfer of this number has not come yet: numbers rise, and wrap."""
        return self.newest is None or 0 < (seqnum - self.newest) & _NUMBERS <= _NUMBERS // 2

    def complete(self, seqnum: int) -> bool:
        """Remove a transfer from the list; return True if it was completed before."""
        return self.parked.pop(seqnum, None) is None

    def respond(self, urb: Any) -> None:
        if self.complete(urb.seqnum):
            return
        if urb.direction == protocol.IN:  # as many bytes as there are and were asked for
            urb.actual = min(urb.actual, len(urb.buffer), urb.length)
        protocol.write_ret(self, urb)

    def fail(self, urb: Any, status: int) -> None:
        """End a transfer without data."""
        self.complete(urb.seqnum)
        self._return(protocol.RET_SUBMIT, urb, status)

    def unlinked(self, urb: Any, status: int) -> None:
        self._return(protocol.RET_UNLINK, urb, status)

    def _return(self, command: int, urb: Any, status: int) -> None:
        self.outbox += _RETURN.pack(command, urb.seqnum, urb.devid, urb.direction, urb.ep, status)


def _listen(host: str, port: int) -> socket.socket:
    try:
        listener = listen(host, port, MAX_CONNECTIONS)
    except (OSError, TypeError, ValueError) as error:  # the latter two: no host has such a name
        hint = "serve it on an address of this machine"
        if not isinstance(error, OSError):
            what = f"cannot serve USB/IP on {one_line(host, 80)!r}: no such host"
            raise EmulatorError(what, hint=hint) from error
        if error.errno == errno.EADDRINUSE:
            hint = "another USB/IP server has it; choose another port, or 0 for a free one"
        elif error.errno == errno.EACCES:
            hint = "ports below 1024 belong to root"
        why = error.strerror or str(error)
        raise EmulatorError(f"cannot serve USB/IP on {host}:{port}: {why}", hint=hint) from error
    listener.setblocking(False)
    return listener
