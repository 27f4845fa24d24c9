"""Measure the link to another machine: round trips, intervals of samples, and receive buffers.

No privilege and no program at the other end are needed. A round trip is an ICMP echo where the
system permits it, else a TCP connection to a closed port, which is refused at once. The samples of
the machine's DDS writers carry sequence numbers and the time at which they were written: the first
give losses, the second delays. The least delay belongs to the least round trip, of which half is
taken for the way here, so the clocks' difference and the age of each sample follow.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from dexkit.doctor.observations import DomainView, Link, Stream
from dexkit.topics import roles

__all__ = ["RoundTrips", "link_to", "measure_round_trips", "percentile"]

_EVERY = 0.05  # seconds between two echoes
_PATIENCE = 1.0  # seconds after which an echo is lost
_CLOSED_PORT = 9  # discard; nothing serves it
_ECHO, _ECHO_REPLY = 8, 0
_RMEM = Path("/proc/sys/net/core/rmem_max")


class RoundTrips:
    """Round-trip times, seconds, and how many were sent.

    :ivar method: how they were measured.
    """

    def __init__(self, method: str) -> None:
        self.method = method
        self.sent = 0
        self.times: list[float] = []


def percentile(values: Iterable[float], share: float) -> float:
    """The value below which a share (0 to 1) of the values is; NaN of none."""
    ordered = sorted(values)
    return ordered[round(share * (len(ordered) - 1))] if ordered else float("nan")


def _icmp_socket(interface_address: str) -> socket.socket | None:
    for kind in (socket.SOCK_DGRAM, socket.SOCK_RAW):
        with contextlib.suppress(OSError):
            sock = socket.socket(socket.AF_INET, kind, socket.IPPROTO_ICMP)
            sock.bind((interface_address, 0))
            return sock
    return None


def _checksum(data: bytes) -> int:
    total: int = sum(struct.unpack(f"!{len(data) // 2}H", data))
    total = (total >> 16) + (total & 0xFFFF)
    return ~(total + (total >> 16)) & 0xFFFF


def measure_round_trips(
    address: str, own_address: str, seconds: float, stop: threading.Event
) -> RoundTrips:
    """Send echoes for some seconds.

    :param own_address: of the interface to use.
    """
    sock = _icmp_socket(own_address)
    if sock is None:
        return _by_tcp(address, own_address, seconds, stop)
    with sock:
        return _by_icmp(sock, address, seconds, stop)


def _by_icmp(
    sock: socket.socket, address: str, seconds: float, stop: threading.Event
) -> RoundTrips:
    found = RoundTrips("ICMP echo")
    raw = sock.type == socket.SOCK_RAW
    ident = os.getpid() & 0xFFFF
    sent: dict[int, float] = {}
    began = time.monotonic()
    sending_ends = began + seconds
    at = began
    while not stop.is_set():
        now = time.monotonic()
        if now >= at and now < sending_ends:
            at = max(at + _EVERY, now)
            number = found.sent & 0xFFFF
            body = struct.pack("!HH", ident, number) + b"dexkit link."
            head = struct.pack("!BBH", _ECHO, 0, 0)
            packet = struct.pack("!BBH", _ECHO, 0, _checksum(head + body)) + body
            found.sent += 1
            sent[number] = time.monotonic()
            with contextlib.suppress(OSError):  # unreachable: it is lost
                sock.sendto(packet, (address, 0))
        elif now >= sending_ends and (not sent or now >= sending_ends + _PATIENCE):
            break
        ready, _, _ = select.select([sock], [], [], 0.01)
        if not ready:
            continue
        try:
            data, (source, _) = sock.recvfrom(2048)
        except OSError:
            continue
        if raw:
            data = data[(data[0] & 15) * 4 :]
        if source != address or len(data) < 8 or data[0] != _ECHO_REPLY:
            continue
        theirs, number = struct.unpack_from("!HH", data, 4)
        if (not raw or theirs == ident) and number in sent:
            found.times.append(time.monotonic() - sent.pop(number))
    return found


def _by_tcp(address: str, own_address: str, seconds: float, stop: threading.Event) -> RoundTrips:
    found = RoundTrips("TCP connection to a closed port")
    end = time.monotonic() + seconds
    while time.monotonic() < end and not stop.is_set():
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
            sock.settimeout(_PATIENCE)
            sock.bind((own_address, 0))
            found.sent += 1
            began = time.monotonic()
            code = sock.connect_ex((address, _CLOSED_PORT))
            # a lost packet is sent again after a second
            if code in (0, errno.ECONNREFUSED) and time.monotonic() - began < _PATIENCE:
                found.times.append(time.monotonic() - began)
        stop.wait(_EVERY)
    return found


def receive_buffer_limit() -> int:
    """Bytes that a program may ask for as receive buffer (net.core.rmem_max); 0 if unknown."""
    try:
        return int(_RMEM.read_text())
    except (OSError, ValueError):
        return 0


def link_to(
    host: str,
    address: str,
    interface: str,
    trips: RoundTrips,
    by_multicast: Sequence[DomainView],
    by_unicast: Sequence[DomainView],
    *,
    rmem_max: int | None = None,
    dropped: int = 0,
) -> Link:
    """Derive the figures of a link from its measurements.

    :param by_multicast: the domains as seen with announcements by multicast only.
    :param by_unicast: as seen with announcements to the machine itself.
    :param dropped: datagrams that found a receive buffer of this machine full meanwhile.
    """

    def there(views: Sequence[DomainView]) -> set[str]:
        return {p.key for v in views for p in v.participants if address in p.addresses}

    multicast, unicast = there(by_multicast), there(by_unicast) | there(by_multicast)
    owners = {e.key: e for v in by_unicast for e in v.endpoints if e.participant in unicast}
    streams = [s for v in by_unicast for s in v.streams if s.writer in owners and s.samples]
    least = min((s.delay_min for s in streams if s.delay_min == s.delay_min), default=float("nan"))
    one_way = percentile(trips.times, 0.0) / 2
    return Link(
        host=host,
        address=address,
        interface=interface,
        method=trips.method,
        sent=trips.sent,
        received=len(trips.times),
        rtt_min=percentile(trips.times, 0.0),
        rtt_median=percentile(trips.times, 0.5),
        rtt_95=percentile(trips.times, 0.95),
        participants=len(unicast),
        multicast=None if not unicast else bool(multicast),
        clock_offset=one_way - least,
        samples=sum(s.samples for s in streams),
        lost=sum(s.lost for s in streams),
        state_age_95=_age(streams, _topics("state"), least, one_way),
        command_age_95=_age(streams, _topics("cmd"), least, one_way),
        rmem_max=receive_buffer_limit() if rmem_max is None else rmem_max,
        dropped=dropped,
    )


def _topics(kind: str) -> Callable[[str], bool]:
    """Whether a topic is one of commands (``cmd``), or of states."""
    return lambda topic: topic.endswith(kind) or any(r.kind == kind for r in roles(topic))


def _age(
    streams: Iterable[Stream], of: Callable[[str], bool], least: float, one_way: float
) -> float:
    """Age on arrival, seconds, that 95 % of the samples of some topics are below; NaN of none."""
    ages = [s.delay_95 - least + one_way for s in streams if of(s.topic)]
    return max(ages, default=float("nan"))
