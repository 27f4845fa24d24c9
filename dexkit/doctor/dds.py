"""Observe DDS domains: sockets for the observers, and their results as observations."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from dexkit import interface_filter
from dexkit.child_processes import process_id
from dexkit.doctor import rtps
from dexkit.doctor.awaited_topics import AWAITED
from dexkit.doctor.environment import shown_uri
from dexkit.doctor.link import percentile
from dexkit.doctor.network import address_of
from dexkit.doctor.observations import DomainView, Endpoint, Participant, Stream
from dexkit.doctor.observer import Observer, Send
from dexkit.doctor.proc_files import command_line, environment_of, start_time
from dexkit.doctor.rtps import EndpointData, Locator
from dexkit.doctor.topic_spelling import is_asked, is_driven, is_hand_topic, is_limp
from dexkit.errors import DdsSetupError, DexkitError
from dexkit.messages import message_type
from dexkit.messages.columns import Columns
from dexkit.messages.earlier import layout_of
from dexkit.other_interfaces import is_two_fingers
from dexkit.topics import roles, split_prefix

__all__ = ["DISCOVERY_SECONDS", "observe_domains"]

DISCOVERY_SECONDS = 0.7
"""Seconds to wait on an empty domain; a participant on this machine answers within 10 ms."""

_GROUP = "239.255.0.1"  # of discovery (RTPS 9.6.2.3)
_INDICES = 61  # participants on one machine and domain that are called by port, as dexkit.dds
_ANNOUNCE_AT = (0.0, 0.15, 0.5, 1.2, 2.5)
_TICK = 0.05
_BUFFER = 4 << 20
_DECODE_EVERY = 0.02  # seconds between samples of a stream whose positions are read
_MOST_DELAYS = 100_000  # of one writer
_LOOPBACK = "127.0.0.1"
_FAST = "fastdds.physical_data."  # prefix of the properties of a Fast DDS participant


def _is_watched(topic: str, type_name: str) -> bool:
    """Whether the samples of a topic are counted."""
    return topic in AWAITED or is_hand_topic(topic, type_name)


@dataclass
class _Watch:
    """One writer's samples as they come."""

    endpoint: EndpointData
    first_time: float
    first_sequence: int
    last_time: float
    last_sequence: int
    samples: int = 0
    first: bytes = b""
    identical: bool = True
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)
    q: tuple[float, ...] = ()
    began: tuple[float, ...] = ()
    driven: dict[int, tuple[float, float]] = field(default_factory=dict)
    limp: dict[int, tuple[float, float]] = field(default_factory=dict)
    asked: dict[int, tuple[float, float]] = field(default_factory=dict)
    modes: tuple[int, ...] = ()
    tau: float = 0.0
    blank: bool = True
    nonzero: bool = False
    two_fingers: bool | None = None
    undecodable: int = 0
    earlier: str = ""
    decoded_at: float = float("-inf")
    newest: bytes = b""
    delays: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        found = roles(split_prefix(self.endpoint.topic)[1], self.endpoint.type_name)
        self.dialects = [role.dialect for role in found if role.kind == "cmd"]
        self.states = any(role.kind == "state" for role in found)

    def take(self, sequence: int, data: bytes, now: float, written: float) -> None:
        if self.samples and sequence <= self.last_sequence:
            return
        self.samples += 1
        if written and len(self.delays) < _MOST_DELAYS:
            self.delays.append(now + _wall_clock_offset() - written)
        self.last_time, self.last_sequence, self.newest = now, sequence, data
        if not self.first:
            self.first = data
        elif data != self.first:
            self.identical = False
        if now - self.decoded_at >= _DECODE_EVERY:
            self.decoded_at = now
            self.decode(data)

    def decode(self, data: bytes) -> None:
        if not is_hand_topic(self.endpoint.topic, self.endpoint.type_name):
            return  # that they come is enough
        try:
            kind = message_type(self.endpoint.type_name)
            motors = kind.motors(kind.decode(data))
        except DexkitError:
            self.undecodable += 1
            known = layout_of(self.endpoint.type_name, data)
            self.earlier = known.when if known is not None else ""
            return
        q = [float(motor.q) for motor in motors]
        self.nonzero = self.nonzero or any(q)
        self.q = tuple(q)
        self.modes = tuple(int(getattr(motor, "mode", 0)) for motor in motors)
        if self.states:
            self.tau = max((abs(float(m.tau_est)) for m in motors), default=0.0)
            self.blank = self.blank and Columns(kind.layout, [data]).are_zero
        if self.dialects:
            kp = [float(motor.kp) for motor in motors]
            self.two_fingers = self.two_fingers is not False and is_two_fingers(q, kp)
        for i, motor in enumerate(motors if self.dialects else ()):
            for seen, matches in (
                *((self.driven, is_driven), (self.asked, is_asked)),
                *((self.limp, is_limp),),
            ):
                if any(matches(motor, dialect) for dialect in self.dialects):
                    low, high = seen.get(i, (q[i], q[i]))
                    seen[i] = min(low, q[i]), max(high, q[i])
        if len(q) != len(self.low):
            self.low, self.high = list(q), list(q)
            self.began = tuple(q)
        self.low = [min(pair) for pair in zip(self.low, q, strict=True)]
        self.high = [max(pair) for pair in zip(self.high, q, strict=True)]

    def stream(self, until: float, since: float) -> Stream:
        if self.samples:
            self.decode(self.newest)
        gaps = self.last_sequence - self.first_sequence
        elapsed = self.last_time - self.first_time
        # one that falls silent has the rate of what came in the whole time
        if until - self.last_time > max(0.3, 3 * elapsed / max(gaps, 1)):
            elapsed = until - self.first_time
        return Stream(
            topic=self.endpoint.topic,
            writer=self.endpoint.guid.hex(),
            seconds=until - since,
            samples=self.samples,
            rate=gaps / elapsed if gaps and elapsed > 0 else 0.0,
            identical=self.identical and self.samples > 1,
            q=self.q,
            began=self.began,
            q_span=max((h - low for low, h in zip(self.low, self.high, strict=True)), default=0.0),
            driven_span=_widest(self.driven),
            limp_span=_widest(self.limp),
            asked_span=_widest(self.asked),
            drives=bool(self.driven),
            asks=bool(self.asked),
            limp=bool(self.limp),
            modes=self.modes,
            tau=self.tau,
            nonzero=self.nonzero,
            blank=self.blank and self.states and self.samples > self.undecodable,
            undecodable=self.undecodable,
            earlier=self.earlier,
            lost=gaps + 1 - self.samples if self.samples else 0,
            two_fingers=bool(self.two_fingers),
            delay_min=percentile(self.delays, 0.0),
            delay_95=percentile(self.delays, 0.95),
        )


def _widest(ranges: dict[int, tuple[float, float]]) -> float:
    """The widest of some ranges."""
    return max((high - low for low, high in ranges.values()), default=0.0)


def _wall_clock_offset() -> float:
    """Seconds since the epoch at the zero of the monotonic clock."""
    return time.time() - time.monotonic()


class _Window:
    """One domain, seen from one interface."""

    def __init__(self, domain: int, interface: str, peers: Sequence[str] = ()) -> None:
        self.domain = domain
        self.interface = interface
        self.peers = peers
        self.address = address_of(interface)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            with contextlib.suppress(OSError):
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            self._restrict()
            self.socket.bind((self.address, 0))
            self.socket.setblocking(False)
            packed = socket.inet_aton(self.address)
            self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, packed)
            # no further than the next network, and to the other processes of this machine
            self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        except DdsSetupError:
            self.socket.close()
            raise
        except OSError as error:
            self.socket.close()
            raise DdsSetupError(f"cannot examine {interface}: {error.strerror}") from error
        self.watches: dict[bytes, _Watch] = {}
        self.observer = Observer(
            os.urandom(12),
            Locator(self.address, self.socket.getsockname()[1]),
            properties={
                "__ProcessName": "dexkit doctor",
                "__Pid": str(os.getpid()),
                "__Hostname": socket.gethostname(),
            },
            domain=domain,
            wanted=_is_watched,
            on_sample=self.sample,
        )

    def _restrict(self) -> None:
        """See what comes by this interface only: an address is reached by the others, too."""
        try:
            interface_filter.restrict(self.socket, self.interface)
        except OSError as error:
            if not interface_filter.all_interfaces_allowed():
                raise DdsSetupError(
                    f"packets of networks other than {self.interface} cannot be kept out: "
                    f"{error.strerror}",
                    hint=interface_filter.HINT,
                ) from error

    def sample(
        self, writer: EndpointData, sequence: int, data: bytes, now: float, written: float
    ) -> None:
        watch = self.watches.get(writer.guid)
        if watch is None:
            watch = self.watches[writer.guid] = _Watch(writer, now, sequence, now, sequence)
        watch.take(sequence, data, now, written)

    def everywhere(self, packet: bytes) -> list[Send]:
        """A packet to wherever a participant may listen."""
        places = [Locator(_GROUP, rtps.spdp_multicast_port(self.domain)), *self.observer.addresses]
        # where there is no multicast, participants listen to these ports alone
        called = (_LOOPBACK,) if self.address == _LOOPBACK else self.peers
        places += [
            Locator(peer, rtps.unicast_port(self.domain, i))
            for peer in called
            for i in range(_INDICES)
        ]
        return [(packet, place) for place in dict.fromkeys(places) if place.port < 65536]

    def send(self, packets: Iterable[Send]) -> None:
        for packet, place in packets:
            try:
                self.socket.sendto(packet, (place.address, place.port))
            except OSError as error:
                # no multicast on this interface, an address of another network, a full buffer:
                # a participant that is not reached is not discovered, which is the result
                if error.errno == errno.EBADF:
                    raise

    def receive(self) -> None:
        for _ in range(512):
            try:
                packet, (address, _port) = self.socket.recvfrom(65536)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue
            self.send(self.observer.receive(packet, time.monotonic(), address))

    @property
    def streaming(self) -> bool:
        """A topic of a hand or robot is written here, so that it pays to wait."""
        return any(
            is_writer and _is_watched(e.topic, e.type_name)
            for e, is_writer in self.observer.endpoints.values()
        )


def observe_domains(
    domains: Sequence[int],
    interfaces: Sequence[str] = ("lo",),
    *,
    seconds: float = 2.0,
    peers: Sequence[str] = (),
    stop: threading.Event | None = None,
    progress: Callable[[str], object] = lambda text: None,
) -> tuple[DomainView, ...]:
    """Look at domains without disturbing anybody: no topic is written.

    :param seconds: how long the samples of hands are watched where there are any.
    :param peers: addresses of other machines to call by unicast.
    :param stop: ends the look early.
    :raises DdsSetupError: an interface is not there or has no address.
    """
    stop = stop or threading.Event()
    windows: list[_Window] = []
    selector = selectors.DefaultSelector()
    try:
        for domain in domains:
            for interface in interfaces:
                window = _Window(domain, interface, peers)
                windows.append(window)
                selector.register(window.socket, selectors.EVENT_READ, window)
        began = time.monotonic()
        progress(f"looking at {len(domains)} domains")
        _run(windows, selector, began, DISCOVERY_SECONDS, stop)
        # topics that are read were asked for as soon as they were seen
        if any(window.streaming for window in windows):
            progress(f"watching the samples for {seconds:g} s")
            _run(windows, selector, began, DISCOVERY_SECONDS + seconds, stop)
        until = time.monotonic()
        for window in windows:
            window.send(window.everywhere(window.observer.withdrawal_packet()))
        return tuple(
            _view(domain, [w for w in windows if w.domain == domain], began, until)
            for domain in domains
        )
    finally:
        selector.close()
        for window in windows:
            window.socket.close()


def _run(
    windows: Sequence[_Window],
    selector: selectors.BaseSelector,
    began: float,
    until: float,
    stop: threading.Event,
) -> None:
    announce = [t for t in _ANNOUNCE_AT if t < until]
    next_tick = 0.0
    while not stop.is_set():
        now = time.monotonic() - began
        if now >= until:
            return
        if announce and now >= announce[0]:
            announce.pop(0)
            for window in windows:
                window.send(window.everywhere(window.observer.announcement()))
                window.receive()
        if now >= next_tick:
            next_tick = now + _TICK
            for window in windows:
                window.send(window.observer.tick(now + began))
        for key, _ in selector.select(min(_TICK, max(until - now, 0.0))):
            key.data.receive()


def _view(number: int, windows: Sequence[_Window], began: float, until: float) -> DomainView:
    participants: dict[str, Participant] = {}
    endpoints: dict[str, Endpoint] = {}
    streams: dict[str, Stream] = {}
    own = {window.observer.prefix for window in windows}
    for window in windows:
        for prefix, data in window.observer.participants.items():
            if prefix not in own:
                participants.setdefault(prefix.hex(), _participant(data, window.interface))
        for guid, (found, is_writer) in window.observer.endpoints.items():
            if guid[:12] in own:
                continue
            endpoints[guid.hex()] = Endpoint(
                topic=found.topic,
                type_name=found.type_name,
                kind="writer" if is_writer else "reader",
                key=guid.hex(),
                participant=guid[:12].hex(),
                qos=found.qos,
                type_hash=found.type_hash,
            )
            if is_writer and _is_watched(found.topic, found.type_name):
                watch = window.watches.get(guid)
                seen = (
                    watch.stream(until, began)
                    if watch
                    else Stream(found.topic, guid.hex(), until - began, 0)
                )
                known = streams.get(seen.writer)
                if known is None or seen.samples > known.samples:
                    streams[seen.writer] = seen
    order = sorted(endpoints.values(), key=lambda e: (e.topic, e.kind, e.type_name, e.key))
    return DomainView(number, tuple(participants.values()), tuple(order), tuple(streams.values()))


def _participant(data: rtps.ParticipantData, interface: str) -> Participant:
    # as CycloneDDS announces them, or as Fast DDS does ("name:hash")
    said = data.properties
    host = said.get("__Hostname", "") or said.get(_FAST + "host", "").rpartition(":")[0]
    pid = process_id(said.get("__Pid", "") or said.get(_FAST + "process", ""))
    here = bool(pid) and host == socket.gethostname()
    return Participant(
        key=data.prefix.hex(),
        vendor=rtps.vendor_name(data.vendor),
        version=data.version,
        process=said.get("__ProcessName", ""),
        pid=pid,
        host=host,
        addresses=tuple(dict.fromkeys(p.address for p in (*data.data, *data.discovery))),
        places=tuple(dict.fromkeys((p.address, p.port) for p in (*data.data, *data.discovery))),
        multicast=data.multicast,
        interface=interface,
        command=command_line(pid) if here else "",
        started=start_time(pid) if here else None,
        dds_config=shown_uri(environment_of(pid, "CYCLONEDDS_URI")) if here else "",
    )
