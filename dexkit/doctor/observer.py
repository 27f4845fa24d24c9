"""Observe a DDS domain as an RTPS participant, sans IO: packets in and out, on an injected clock.

It announces itself, so that others send it their announcements; it reads topics best-effort, as
Unitree's clients do; it has no writer of its own. What it needs from the outside is that
:meth:`Observer.receive` gets what comes to its address, that what the methods return is sent,
and that :meth:`Observer.tick` is called some ten times a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from dexkit.doctor import rtps
from dexkit.doctor.rtps import AckNack, Data, DataFrag, Gap, Heartbeat, Locator
from dexkit.errors import WireError

__all__ = ["Observer", "SampleHandler", "Send"]

Send = tuple[bytes, Locator]
"""A packet and where to send it."""

SampleHandler = Callable[[rtps.EndpointData, int, bytes, float, float], object]
"""Takes a sample: its writer, sequence number, bytes, when it came, and when it was written by the
writer's clock, seconds since the epoch (0 if that is not said)."""

_SEDP = {rtps.SEDP_PUBLICATIONS: True, rtps.SEDP_SUBSCRIPTIONS: False}
_REPEAT = 0.2  # seconds between requests for announcements, or announcements of our readers
_TRIES = 15
_LEASE = 20  # seconds; an observation is shorter, and ends with a farewell
_MOST = 4096  # announcements of one writer
_LAST = (1 << 63) - 1  # the largest sequence number
_MAX_SAMPLE = 1 << 20
_PARTIAL = 4  # incomplete samples kept of a writer


@dataclass
class _History:
    """The samples that a reliable built-in writer has, and those received."""

    seen: set[int] = field(default_factory=set)
    first: int = 1
    last: int = 0
    announced: bool = False  # a heartbeat has come: first and last are known

    def missing_numbers(self) -> list[int]:
        return [n for n in range(self.first, self.last + 1) if n not in self.seen]

    @property
    def complete(self) -> bool:
        return self.announced and not self.missing_numbers()


@dataclass
class _Peer:
    data: rtps.ParticipantData
    places: Sequence[Locator]  # where packets are sent to: one, or none
    histories: dict[bytes, _History]
    acked: int = 0  # of our announcements of readers
    tries: int = 0
    next_try: float = 0.0


@dataclass
class _Partial:
    fragments: dict[int, bytes] = field(default_factory=dict)


class Observer:
    """Observes one domain from one address.

    :param prefix: GUID prefix of its own, 12 bytes, unique.
    :param place: where it receives.
    :param properties: properties of its process to announce.
    :param domain: number of the domain; participants that announce another one are left out, for
        the ports of domains from 101 on are also handed out to sockets of other domains. None
        takes all.
    :param wanted: whether to read a topic of a type.
    :param on_sample: takes each sample of the topics that are read.

    :ivar participants: by GUID prefix.
    :ivar endpoints: by GUID, each with whether it is a writer.
    :ivar damaged: packets that could not be read.
    """

    def __init__(
        self,
        prefix: bytes,
        place: Locator,
        *,
        properties: dict[str, str] | None = None,
        domain: int | None = None,
        wanted: Callable[[str, str], bool] = lambda topic, type_name: False,
        on_sample: SampleHandler = lambda writer, sequence, data, now, written: None,
    ) -> None:
        self.prefix = prefix
        self.participants: dict[bytes, rtps.ParticipantData] = {}
        self.endpoints: dict[bytes, tuple[rtps.EndpointData, bool]] = {}
        self.damaged = 0
        self._announcement = rtps.build_participant(
            prefix, place, lease=_LEASE, properties=properties, domain=domain
        )
        self._domain = domain
        self._wanted = wanted
        self._on_sample = on_sample
        self._peers: dict[bytes, _Peer] = {}
        self._readers: dict[tuple[str, str], bytes] = {}  # announcement by topic and type
        self._partials: dict[bytes, dict[int, _Partial]] = {}
        self._count = 0

    @property
    def settled(self) -> bool:
        """Every participant found has announced all its endpoints."""
        return all(h.complete for peer in self._peers.values() for h in peer.histories.values())

    def announcement(self) -> bytes:
        """The packet that makes others answer; to be sent to all addresses where they may be."""
        return rtps.message(self.prefix, rtps.build_data(rtps.SPDP_WRITER, 1, self._announcement))

    def withdrawal_packet(self) -> bytes:
        """The packet that withdraws the announcement, so that others forget this participant."""
        return rtps.message(
            self.prefix, rtps.build_data(rtps.SPDP_WRITER, 2, self._announcement, gone=True)
        )

    @property
    def addresses(self) -> list[Locator]:
        """Locators at which the discovered participants take discovery messages."""
        return [place for peer in self._peers.values() for place in peer.places]

    def receive(self, packet: bytes, now: float, address: str = "") -> list[Send]:
        """Take a packet; returns the answers.

        :param address: where it came from, which is where a participant of several addresses
            is answered.
        """
        out: list[Send] = []
        try:
            sender, submessages = rtps.parse_message(packet)
            if sender == self.prefix:
                return out
            for destination, item in submessages:
                if destination not in (self.prefix, bytes(12)):
                    continue
                if isinstance(item, Data):
                    self._take_data(item, now, address, out)
                elif isinstance(item, DataFrag):
                    self._take_fragment(item, now)
                else:
                    self._take_protocol_message(item, out)
        except WireError:
            self.damaged += 1
        return out

    def tick(self, now: float) -> list[Send]:
        """Return the packets to be sent again because an answer is missing."""
        out: list[Send] = []
        for peer in self._peers.values():
            waiting = [w for w, history in peer.histories.items() if not history.complete]
            announcing = peer.acked < len(self._readers)
            if not (waiting or announcing) or now < peer.next_try or peer.tries >= _TRIES:
                continue
            peer.next_try = now + _REPEAT
            peer.tries += 1
            for writer in waiting:
                self._request_missing(peer, writer, out)
            if announcing:
                self._announce_readers(peer, out)
        return out

    # --- discovery

    def _take_data(self, item: Data, now: float, address: str, out: list[Send]) -> None:
        if item.writer == rtps.SPDP_WRITER:
            self._take_participant(item, now, address, out)
            return
        peer = self._peers.get(item.source)
        if item.writer in _SEDP:
            if peer is not None:
                peer.histories[item.writer].seen.add(item.sequence)
                self._take_endpoint(item, peer, out)
        else:
            guid = item.source + item.writer
            self._take_sample(guid, item.sequence, item.payload, now, item.written)

    def _take_participant(self, item: Data, now: float, address: str, out: list[Send]) -> None:
        if item.gone:
            self._forget(item.source)
            return
        data = rtps.parse_participant(item.payload)
        known = self._peers.get(data.prefix)
        if known is not None or data.prefix == self.prefix:
            return
        if None not in (data.domain, self._domain) and data.domain != self._domain:
            return
        self.participants[data.prefix] = data
        places = [p for p in data.discovery if p.address == address] or data.discovery[:1]
        peer = _Peer(
            data, places[:1], {writer: _History() for writer in _SEDP}, next_try=now + _REPEAT
        )
        self._peers[data.prefix] = peer
        # it may have been found by an announcement of its own: it must know us to answer
        self._send(peer, rtps.build_data(rtps.SPDP_WRITER, 1, self._announcement), out)
        for writer in _SEDP:
            self._request_missing(peer, writer, out)
        if self._readers:
            self._announce_readers(peer, out)

    def _forget(self, prefix: bytes) -> None:
        self._peers.pop(prefix, None)
        self.participants.pop(prefix, None)
        for guid in [guid for guid in self.endpoints if guid[:12] == prefix]:
            del self.endpoints[guid]

    def _take_endpoint(self, item: Data, peer: _Peer, out: list[Send]) -> None:
        if not item.payload:
            return
        is_writer = _SEDP[item.writer]
        found = rtps.parse_endpoint(item.payload, writer=is_writer)
        if item.gone:
            self.endpoints.pop(found.guid, None)
            return
        self.endpoints[found.guid] = (found, is_writer)
        reader = (found.topic, found.type_name)
        if is_writer and reader not in self._readers and self._wanted(*reader):
            entity = (len(self._readers) + 1).to_bytes(3, "big") + b"\x04"  # reader without key
            self._readers[reader] = rtps.build_endpoint(self.prefix + entity, *reader)
            for other in self._peers.values():
                other.tries = 0
                self._announce_readers(other, out)

    def _take_protocol_message(self, item: Heartbeat | Gap | AckNack, out: list[Send]) -> None:
        peer = self._peers.get(item.source)
        if peer is None:
            return
        if isinstance(item, AckNack):
            if item.writer == rtps.SEDP_SUBSCRIPTIONS:
                peer.acked = max(peer.acked, min(item.base - 1, len(self._readers)))
                if any(1 <= n <= len(self._readers) for n in item.missing):
                    self._announce_readers(peer, out)
            return
        history = peer.histories.get(item.writer)
        if history is None:
            return
        if isinstance(item, Gap):
            if item.before - item.start <= _MOST:
                history.seen.update(range(item.start, item.before))
            history.seen.update(item.numbers)
            return
        # RTPS 8.3.7.5.3; what is answered to a wrong one would itself be wrong
        if not 1 <= item.first <= item.last + 1 <= min(item.first + _MOST, _LAST):
            raise WireError(f"a heartbeat of {item.first} to {item.last}")
        history.first, history.last = item.first, item.last
        history.announced = True
        if history.missing_numbers() or not item.final:
            self._request_missing(peer, item.writer, out)

    def _request_missing(self, peer: _Peer, writer: bytes, out: list[Send]) -> None:
        """Request the announcements that are missing from a peer, or acknowledge all of them."""
        history = peer.histories[writer]
        missing = history.missing_numbers()
        base = missing[0] if missing else history.last + 1
        self._count += 1
        ack = rtps.build_acknack(
            writer,
            base,
            missing,
            self._count,
            destination=peer.data.prefix,
            final=history.complete,
        )
        self._send(peer, ack, out)

    def _announce_readers(self, peer: _Peer, out: list[Send]) -> None:
        """Announce to a peer the topics that are read here."""
        writer, to = rtps.SEDP_SUBSCRIPTIONS, peer.data.prefix
        parts = [
            rtps.build_data(writer, number, payload, destination=to)
            for number, payload in enumerate(self._readers.values(), start=1)
            if number > peer.acked
        ]
        self._count += 1
        parts.append(
            rtps.build_heartbeat(writer, 1, len(self._readers), self._count, destination=to)
        )
        for part in parts:  # one a packet: they stay below the size of a frame
            self._send(peer, part, out)

    def _send(self, peer: _Peer, submessage: bytes, out: list[Send]) -> None:
        packet = rtps.message(self.prefix, submessage)
        out += [(packet, place) for place in peer.places]

    # --- samples

    def _take_sample(
        self, guid: bytes, sequence: int, data: bytes, now: float, written: float = 0.0
    ) -> None:
        found = self.endpoints.get(guid)
        if found is not None and found[1] and data:
            self._on_sample(found[0], sequence, data, now, written)

    def _take_fragment(self, item: DataFrag, now: float) -> None:
        guid = item.source + item.writer
        if guid not in self.endpoints:
            return
        if not item.size > 0 or not 0 < item.total <= _MAX_SAMPLE:
            raise WireError(f"fragments of {item.size} bytes of a sample of {item.total}")
        partials = self._partials.setdefault(guid, {})
        partial = partials.setdefault(item.sequence, _Partial())
        count = -(-item.total // item.size)
        for i, at in enumerate(range(0, len(item.payload), item.size)):
            if 1 <= item.first + i <= count:
                partial.fragments[item.first + i] = item.payload[at : at + item.size]
        if len(partial.fragments) == count:
            del partials[item.sequence]
            data = b"".join(partial.fragments[i + 1] for i in range(count))[: item.total]
            self._take_sample(guid, item.sequence, data, now)
        while len(partials) > _PARTIAL:
            del partials[min(partials)]
