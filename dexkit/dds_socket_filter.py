"""Restrict the sockets that CycloneDDS opens for a domain to one network interface.

CycloneDDS 0.10 binds them to all addresses, has no call that returns them, and asks for the index
of its interface once. So they are found among the sockets of the process, get a filter
(:mod:`dexkit.interface_filter`), and follow an interface that is unplugged and comes back as
another one.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import stat
import struct
import threading
import time
from collections.abc import Container, Iterator

from dexkit import interface_filter
from dexkit.errors import DdsSetupError

__all__ = ["DomainSockets", "copies_of_sockets", "open_sockets"]

_log = logging.getLogger(__name__)

_GROUP = "239.255.0.1"  # of discovery, and of samples by default (RTPS 9.6.2.3)
_EMPTY = b"RTPS\2\1\0\0" + bytes(12)  # a header without a submessage: receivers ignore it
_EARLY_PATIENCE = 5000  # looks, 1 ms apart
_WAKE_EVERY = 0.01  # seconds
_INTERNET = (socket.AF_INET, socket.AF_INET6)
_WILDCARD = ("0.0.0.0", "::")


def open_sockets() -> dict[int, int]:
    """Sockets of this process, inode to a file descriptor; empty where there is no /proc."""
    found = {}
    with contextlib.suppress(OSError):
        for name in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):  # closed meanwhile, as that of the listing is
                status = os.fstat(int(name))
                if stat.S_ISSOCK(status.st_mode):
                    found[status.st_ino] = int(name)
    return found


def copies_of_sockets(besides: Container[int] = ()) -> Iterator[socket.socket]:
    """A copy of each open socket of this process; the caller closes it.

    :param besides: inodes that are left out.
    """
    for inode, descriptor in open_sockets().items():
        if inode in besides:
            continue
        try:
            sock = socket.socket(fileno=os.dup(descriptor))
        except OSError as error:
            if error.errno == errno.EBADF:
                continue  # another thread's, and closed meanwhile
            raise
        yield sock


class DomainSockets:
    """The sockets of one domain, restricted to packets of its interface and of this machine.

    Create it while the domain receives nothing: packets that came before the filter was set must
    be dropped.

    :param before: :func:`open_sockets` before CycloneDDS made the domain.
    :raises OSError: they are not found, or the system has no such filter.
    :raises DdsSetupError: more comes in than can be read.
    """

    def __init__(self, domain: int, interface: str, before: dict[int, int]) -> None:
        self.interface = interface
        self.fixed = interface_filter.is_loopback(interface)
        """The interface stays as it is, so that :meth:`follow` is never needed."""
        self._first_port = 7400 + 250 * domain  # RTPS 9.6.2
        self._indices = interface_filter.accepted_indices(interface)
        self._address = self._seen_address = interface_filter.interface_address(interface)
        self._lock = threading.Lock()
        self._receiving: list[socket.socket] = []
        self._sending: list[socket.socket] = []
        try:
            self._find(before)
            # of discovery and of samples, and what both are sent from
            if len(self._receiving) < 2 or not self._sending:
                raise OSError("the sockets of CycloneDDS were not found")
            self._filter()
            self._settle()
        except BaseException:
            self.close()
            raise

    def _sockets(self) -> Iterator[socket.socket]:
        # CycloneDDS reads also what comes to the socket that it sends from, and takes it as well
        yield from self._receiving
        yield from self._sending

    def _filter(self) -> None:
        for sock in self._sockets():
            interface_filter.accept_only(sock, self._indices)

    def _find(self, before: dict[int, int]) -> None:
        # CycloneDDS takes any of its interface's addresses
        addresses = interface_filter.interface_addresses(self.interface)
        for sock in copies_of_sockets(before):
            ours: list[socket.socket] | None = None
            if sock.type == socket.SOCK_DGRAM and sock.family in _INTERNET:
                # by address and port: another thread may have opened one meanwhile
                address, port = sock.getsockname()[:2]
                if address in _WILDCARD and 0 <= port - self._first_port < 250:
                    ours = self._receiving
                elif address in addresses:
                    ours = self._sending
            if ours is None:
                sock.close()
            else:
                ours.append(sock)

    def _group(self, index: int) -> bytes:
        # ip_mreqn: group, address, index of the interface
        return struct.pack("4s4si", socket.inet_aton(_GROUP), bytes(4), index)

    def _of_multicast(self, sock: socket.socket) -> bool:
        # other processes have these ports, too
        return bool(sock.getsockname()[1] - self._first_port < 2)

    def _poke(self, index: int) -> None:
        """Send an empty packet to each socket, for multicasts by the interface with that index."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            with contextlib.suppress(OSError):
                group = self._group(index)
                sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, group)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)  # not to the network
            for sock in self._sockets():
                address, port = sock.getsockname()
                if address in _WILDCARD:
                    address = _GROUP if self._of_multicast(sock) else "127.0.0.1"
                with contextlib.suppress(OSError):
                    sender.sendto(_EMPTY, (address, port))

    def _settle(self) -> None:
        """Wait until CycloneDDS has read and dropped what came before the filter was set.

        An empty packet goes to each socket, behind what waits there. When nothing waits any more
        it has been read, and what CycloneDDS had read before it has been thrown away.
        """
        self._poke(socket.if_nametoindex(self.interface))
        waiting = select.poll()
        for sock in self._sockets():
            waiting.register(sock, select.POLLIN)
        for _ in range(_EARLY_PATIENCE):
            time.sleep(0.001)
            if not waiting.poll(0):
                return
        raise DdsSetupError(
            f"{self.interface} receives more for this domain than this process can read",
            hint="is something flooding its ports? The machine may also be overloaded: try again",
        )

    def follow(self) -> None:
        """Follow a change of the interface: set the filters again and log it.

        To be called about twice a second; cheap.
        """
        with self._lock:
            indices = interface_filter.accepted_indices(self.interface)
            if indices != self._indices:
                self._indices = indices
                self._change()
            address = interface_filter.interface_address(self.interface)
            if address in ("", self._seen_address):
                return
            self._seen_address = address
            if address != self._address:
                _log.error(
                    "the address of %s was %s and is %s: others cannot reach this program any "
                    "more; start it again",
                    self.interface,
                    self._address,
                    address,
                )

    def _change(self) -> None:
        try:
            self._filter()
        except OSError as error:
            # the filters of before are in force, for an index that nothing has any more
            _log.error(
                "nothing is received on network interface %s any more: %s", self.interface, error
            )
            return
        try:
            group = self._group(socket.if_nametoindex(self.interface))
        except OSError:
            _log.error(
                "network interface %s is gone: only packets of this machine are received",
                self.interface,
            )
            return
        # what CycloneDDS did with the interface that was there before
        for sock in filter(self._of_multicast, self._receiving):
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        for sock in self._sending:
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, group)
        _log.warning("network interface %s is back, and receives again", self.interface)

    @contextlib.contextmanager
    def ending(self) -> Iterator[None]:
        """Within this context the end of the domain does not wait without limit.

        CycloneDDS wakes its threads by packets to itself, which do not arrive when the interface
        is gone or down. Here they come by loopback.
        """
        if self.fixed:
            self.close()
            yield
            return
        done = threading.Event()
        thread = threading.Thread(target=self._wake, args=(done,), name="dds-wake", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            self.close()

    def _wake(self, done: threading.Event) -> None:
        loopback = socket.if_nametoindex("lo")
        for sock in filter(self._of_multicast, self._receiving):
            with contextlib.suppress(OSError):
                group = self._group(loopback)
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        while not done.wait(_WAKE_EVERY):
            self._poke(loopback)

    def close(self) -> None:
        """Close the duplicated sockets; their filters stay."""
        for sock in self._sockets():
            sock.close()
