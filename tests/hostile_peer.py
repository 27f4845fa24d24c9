"""A participant on loopback that announces whatever it likes: RTPS datagrams built by hand.

CycloneDDS would refuse to announce most of it. Announcements go to the unicast discovery ports of
the first participants of a domain, as those of a peer on a network without multicast do.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from collections.abc import Callable, Iterable

from dexkit.doctor import rtps

__all__ = ["HostilePeer", "parameter", "string"]

_PARTICIPANTS = 6  # indices that are spoken to
_WRITER_BITS = 0b111111  # it announces, and detects, participants, publications, subscriptions


def parameter(pid: int, value: bytes) -> bytes:
    """One entry of a parameter list."""
    value += bytes(-len(value) % 4)
    return struct.pack("<HH", pid, len(value)) + value


def string(data: bytes) -> bytes:
    """A CDR string of bytes that need not be text."""
    data += b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


class HostilePeer:
    """Announces participants and endpoints to a domain; a context manager.

    :param domain: whom it speaks to.
    :param prefix: its GUID prefix, 12 bytes; random by default.
    """

    def __init__(self, domain: int, prefix: bytes | None = None) -> None:
        self.domain = domain
        self.prefix = prefix or b"\x01\x10" + os.urandom(10)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._numbers = {rtps.SEDP_PUBLICATIONS: 0, rtps.SEDP_SUBSCRIPTIONS: 0}
        self._entities = 0
        self._lock = threading.Lock()
        self._packets: list[Callable[[], bytes]] = []
        self._ended = threading.Event()
        self._repeater = threading.Thread(target=self._repeat, daemon=True)

    def __enter__(self) -> HostilePeer:
        self._repeater.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._ended.set()
        self._repeater.join()
        self._socket.close()

    def send(self, *submessages: bytes) -> None:
        """Send a packet to every possible participant of the domain, and again from time to time.

        A busy machine may drop one, and this peer does not answer requests for repair.
        """
        packet = rtps.message(self.prefix, *submessages)
        self._send_and_repeat(lambda: packet)

    def _send_and_repeat(self, make: Callable[[], bytes]) -> None:
        self._send(make())
        self._packets.append(make)

    def _repeat(self) -> None:
        while not self._ended.wait(0.5):
            for make in tuple(self._packets):
                self._send(make())

    def _send(self, packet: bytes) -> None:
        for index in range(_PARTICIPANTS):
            self._socket.sendto(packet, ("127.0.0.1", rtps.unicast_port(self.domain, index)))

    def announce(self, properties: Iterable[tuple[bytes, bytes]], extra: bytes = b"") -> None:
        """The participant, with properties of any bytes.

        :param extra: further parameters.
        """
        pairs = list(properties)
        place = struct.pack("<iI", 1, self._socket.getsockname()[1]) + bytes(12)
        place += socket.inet_aton("127.0.0.1")
        packed = struct.pack("<I", len(pairs)) + b"".join(
            string(key) + string(value) for key, value in pairs
        )
        self.send(
            rtps.build_data(
                rtps.SPDP_WRITER,
                1,
                b"\0\x03\0\0"
                + parameter(0x15, b"\x02\x01")
                + parameter(0x16, b"\x01\x10")
                + parameter(0x50, self.prefix + b"\0\0\x01\xc1")
                + parameter(0x58, struct.pack("<I", _WRITER_BITS))
                + parameter(0x02, struct.pack("<iI", 60, 0))
                + parameter(0x31, place)
                + parameter(0x32, place)
                + parameter(0x59, packed)
                + extra
                + parameter(0x01, b""),
            )
        )

    def endpoint(
        self, topic: bytes, type_name: bytes, *, writer: bool = True, extra: bytes = b""
    ) -> None:
        """A writer or reader, with a topic and type of any bytes.

        :param extra: further parameters: policies, type information.
        """
        source = rtps.SEDP_PUBLICATIONS if writer else rtps.SEDP_SUBSCRIPTIONS
        self._entities += 1
        entity = self._entities.to_bytes(3, "big") + (b"\x03" if writer else b"\x04")
        payload = (
            b"\0\x03\0\0"
            + parameter(0x05, string(topic))
            + parameter(0x07, string(type_name))
            + parameter(0x15, b"\x02\x01")
            + parameter(0x16, b"\x01\x10")
            + parameter(0x50, self.prefix + b"\0\0\x01\xc1")
            + parameter(0x5A, self.prefix + entity)
            + extra
            + parameter(0x01, b"")
        )

        def make() -> bytes:
            # a new number each time: a reader drops those before the first that it has received
            with self._lock:
                self._numbers[source] += 1
                number = self._numbers[source]
            heartbeat = rtps.build_heartbeat(source, number, number, number)
            return rtps.message(self.prefix, rtps.build_data(source, number, payload), heartbeat)

        self._send_and_repeat(make)
