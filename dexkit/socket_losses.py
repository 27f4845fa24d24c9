"""Count the datagrams that the kernel dropped on DDS sockets, and enlarge their buffers.

CycloneDDS does not report a datagram that is lost because its socket's receive buffer was full, so
the kernel's counters are read. Linux only; elsewhere no sockets are found.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

__all__ = ["ReceiveBuffers", "receive_buffer_errors"]

_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
_MEMINFO = struct.Struct("=9I")
_RCVBUF, _DROPS = 1, 8  # fields of SO_MEMINFO
_FD = Path("/proc/self/fd")
_SNMP = Path("/proc/net/snmp")


class ReceiveBuffers:
    """The receive buffers of the sockets that a domain's samples come to, in this process.

    They are known by their ports (RTPS 9.6.1.1): 7400 + 250 x domain and the 250 that follow; the
    odd ones are for samples, the even ones for discovery. A domain with other port numbers has
    none here, and :attr:`known` is False.
    """

    def __init__(self, domain: int) -> None:
        first = 7400 + 250 * domain
        self._ports = range(first + 1, min(first + 250, 65536), 2)
        self._seen = self._drops()
        self._errors = receive_buffer_errors()
        self.dropped = 0
        """Datagrams with samples that the kernel dropped since this was made, as last counted."""

    @property
    def known(self) -> bool:
        """Whether the sockets can be found."""
        return bool(self._seen)

    def _sockets(self) -> Iterator[socket.socket]:
        try:
            numbers = [int(name) for name in os.listdir(_FD)]
        except OSError:
            return
        for number in numbers:
            # a descriptor may be closed, or be another's, by now
            with contextlib.suppress(OSError, ValueError):
                if not os.readlink(_FD / str(number)).startswith("socket:"):
                    continue
                with socket.socket(fileno=os.dup(number)) as sock:
                    if sock.family != socket.AF_INET or sock.type != socket.SOCK_DGRAM:
                        continue
                    if sock.getsockname()[1] in self._ports:
                        yield sock

    def _drops(self) -> dict[int, int]:
        """Datagrams dropped ever, by socket (its inode)."""
        found = {}
        for sock in self._sockets():
            info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
            if len(info) == _MEMINFO.size:
                found[os.fstat(sock.fileno()).st_ino] = _MEMINFO.unpack(info)[_DROPS]
        return found

    def count_new_drops(self) -> int:
        """Datagrams that the kernel dropped since the last call, for want of buffer space.

        The socket's counter includes what a filter kept out, so it is believed only as far as
        the system counted errors of receive buffers meanwhile.
        """
        drops, errors = self._drops(), receive_buffer_errors()
        more = sum(max(count - self._seen.get(inode, 0), 0) for inode, count in drops.items())
        new = min(more, max(errors - self._errors, 0))
        self._seen, self._errors = drops, errors
        self.dropped += new
        return new

    def enlarge(self, size: int) -> int:
        """Give each socket a receive buffer of at least ``size`` bytes, as far as is allowed.

        Without privileges no more than ``net.core.rmem_max`` is.

        :returns: bytes that the smallest has now, as the kernel counts (twice what was asked
            for, to hold its own records too); 0 when there are no sockets.
        """
        found = []
        for sock in self._sockets():
            if sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < 2 * size:
                for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):
                    with contextlib.suppress(OSError):
                        sock.setsockopt(socket.SOL_SOCKET, option, size)
                        break
            found.append(sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        return min(found, default=0)


def receive_buffer_errors() -> int:
    """UDP datagrams that found a receive buffer full, ever, in this network namespace."""
    try:
        rows = [r.split() for r in _SNMP.read_text().splitlines() if r.startswith("Udp:")]
        return int(rows[1][rows[0].index("RcvbufErrors")])
    except (OSError, ValueError, IndexError):
        return 0
