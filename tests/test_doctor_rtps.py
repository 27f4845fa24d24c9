"""The observer's wire protocol, against packets of real participants and against damage."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.doctor import rtps
from dexkit.doctor.observer import Observer
from dexkit.doctor.rtps import AckNack, Data, DataFrag, Heartbeat, Locator
from tests import doctor_packets as packets

ME = bytes(range(12))
PLACE = Locator("127.0.0.1", 4711)
GO = "unitree_go::msg::dds_::MotorCmds_"


def _addressed(packet: bytes, to: bytes = ME) -> bytes:
    """A captured packet, sent to another participant: INFO_DST is its first submessage."""
    assert packet[20] == 0x0E
    return packet[:24] + to + packet[36:]


def _only(packet: bytes, kind: type) -> Data:
    _, found = rtps.parse_message(packet)
    (item,) = [item for _, item in found if isinstance(item, kind)]
    assert isinstance(item, Data)
    return item


@pytest.mark.parametrize(
    ("packet", "version"),
    [
        (packets.CYCLONE_0_10_PARTICIPANT, "0.10.5"),
        (packets.CYCLONE_11_PARTICIPANT, "11.0.1"),
    ],
)
def test_captured_participant_announcement_is_parsed(packet: bytes, version: str) -> None:
    found = rtps.parse_participant(_only(packet, Data).payload)
    assert rtps.vendor_name(found.vendor) == "CycloneDDS"
    assert found.version == version
    assert found.prefix == packet[8:20]
    assert found.properties["__ProcessName"] == "python"
    assert found.properties["__Hostname"] == "vm"
    assert found.properties["__Pid"].isdigit()
    assert [p.address for p in found.discovery] == ["127.0.0.1"]
    assert found.multicast


def test_observer_requests_missing_discovery_data() -> None:
    wanted: list[tuple[str, str]] = []
    samples: list[tuple[str, int, bytes]] = []
    observer = Observer(
        ME,
        PLACE,
        wanted=lambda *reader: wanted.append(reader) is None,
        on_sample=lambda w, n, data, now, written: samples.append((w.topic, n, data)),
    )
    answers = observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), 0.0)
    asked = [i for p, _ in answers for _, i in rtps.parse_message(p)[1] if isinstance(i, AckNack)]
    assert {a.writer for a in asked} == {rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS}
    assert not any(a.final for a in asked)
    assert not observer.settled
    sent = observer.receive(_addressed(packets.CYCLONE_0_10_PUBLICATION), 0.1)
    assert wanted == [("rt/dex1/left/cmd", GO)]
    # it announces a reader of that topic, best-effort and without a type object
    readers = [
        rtps.parse_endpoint(i.payload, writer=False)
        for p, _ in sent
        for _, i in rtps.parse_message(p)[1]
        if isinstance(i, Data)
    ]
    assert [(r.topic, r.qos.reliability, r.type_hash) for r in readers] == [
        ("rt/dex1/left/cmd", "best_effort", "")
    ]
    ((writer, is_writer),) = observer.endpoints.values()
    assert is_writer
    prefix = packets.CYCLONE_0_10_PUBLICATION[8:20]
    for fragments in ((1, b"ab"), (2, b"c")):
        body = b"\0\0\x1c\0" + b"\0\0\0\0" + writer.guid[12:] + (0).to_bytes(4, "little")
        body += (7).to_bytes(4, "little") + fragments[0].to_bytes(4, "little") + b"\1\0\2\0"
        body += (3).to_bytes(4, "little") + fragments[1]
        packet = rtps.message(prefix, b"\x16\x01" + len(body).to_bytes(2, "little") + body)
        assert isinstance(rtps.parse_message(packet)[1][0][1], DataFrag)
        assert observer.receive(packet, 0.2) == []
    assert samples == [("rt/dex1/left/cmd", 7, b"abc")]


def test_participants_of_other_domains_are_left_out() -> None:
    """The ports of a high domain are also those that sockets of other domains get."""
    packet = _addressed(packets.CYCLONE_0_10_PARTICIPANT)
    assert rtps.parse_participant(_only(packet, Data).payload).domain == 160
    for domain, known in ((160, 1), (None, 1), (7, 0)):
        observer = Observer(ME, PLACE, domain=domain)
        observer.receive(packet, 0.0)
        assert len(observer.participants) == known
        # and so can others
        (announced,) = (i for _, i in rtps.parse_message(observer.announcement())[1])
        assert isinstance(announced, Data)
        assert rtps.parse_participant(announced.payload).domain == domain


def test_final_heartbeat_is_not_answered() -> None:
    """Two that acknowledge each other's acknowledgements never stop."""
    observer = Observer(ME, PLACE)
    prefix = packets.CYCLONE_0_10_PARTICIPANT[8:20]
    observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), 0.0)
    beat = bytearray(rtps.build_heartbeat(rtps.SEDP_PUBLICATIONS, 1, 0, 1))
    (answer,) = observer.receive(rtps.message(prefix, bytes(beat)), 0.1)
    ((_, ack),) = rtps.parse_message(answer[0])[1]
    assert isinstance(ack, AckNack)
    assert ack.final
    assert ack.base == 1
    beat[1] |= 0x02  # final
    ((_, again),) = rtps.parse_message(rtps.message(prefix, bytes(beat)))[1]
    assert isinstance(again, Heartbeat)
    assert again.final
    assert observer.receive(rtps.message(prefix, bytes(beat)), 0.2) == []


_REAL = [
    packets.CYCLONE_0_10_PARTICIPANT,
    packets.CYCLONE_0_10_PUBLICATION,
    packets.CYCLONE_11_PUBLICATION,
]


@given(
    st.sampled_from(_REAL),
    st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), min_size=1, max_size=8),
    st.integers(0, 600),
)
def test_damaged_packet_is_ignored(
    packet: bytes, damage: list[tuple[int, int]], length: int
) -> None:
    observer = Observer(ME, PLACE, wanted=lambda topic, type_name: True)
    observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), 0.0)
    data = bytearray(_addressed(packet))
    for at, value in damage:
        data[at % len(data)] = value
    observer.receive(bytes(data[:length]), 0.1)
    observer.tick(1.0)


class Grammar:
    """What RTPS 8.3.7 and 9.4 demand of the packets of one participant; read on its own.

    CycloneDDS 0.10 calls a packet that breaks one of these rules malformed, and drops it.
    """

    def __init__(self) -> None:
        self.kinds: set[int] = set()
        self._counts: dict[tuple[int, bytes, bytes], int] = {}

    def check(self, packet: bytes) -> None:
        assert packet[:8] == b"RTPS\2\1\0\0"
        assert packet[8:20] == ME
        at, destination = 20, bytes(12)
        assert len(packet) > at
        while at < len(packet):
            kind, flags, length = (
                packet[at],
                packet[at + 1],
                struct.unpack_from("<H", packet, at + 2)[0],
            )
            body = packet[at + 4 : at + 4 + length]
            assert at % 4 == 0
            assert len(body) == length > 0
            assert length % 4 == 0
            at += 4 + length
            self.kinds.add(kind)
            if kind == 0x0E:
                assert length == 12
                assert flags == 1
                destination = body
                continue
            rule = {0x15: self._data, 0x07: self._heartbeat, 0x06: self._acknack}[kind]
            rule(flags, body, destination)

    def _increases(self, kind: int, body: bytes, destination: bytes, count: int) -> None:
        key = (kind, body[:8], destination)
        assert self._counts.get(key, 0) < count < 1 << 31
        self._counts[key] = count

    def _data(self, flags: int, body: bytes, destination: bytes) -> None:
        extra, to_qos, _, writer, high, low = struct.unpack_from("<HH4s4siI", body)
        assert (extra, to_qos) == (0, 16)
        assert high << 32 | low >= 1
        at = 20
        if flags == 0x0B:  # disposed and unregistered, the key alone
            assert writer == rtps.SPDP_WRITER
            assert body[at : at + 12] == bytes.fromhex("710004000000000301000000")
            at += 12
        else:
            assert flags == 0x05
        assert body[at : at + 4] == b"\0\3\0\0"  # a parameter list, little-endian
        at += 4
        while True:
            pid, length = struct.unpack_from("<HH", body, at)
            at += 4 + length
            assert length % 4 == 0
            if pid == 1:
                assert length == 0
                break
        assert at == len(body)

    def _heartbeat(self, flags: int, body: bytes, destination: bytes) -> None:
        assert len(body) == 28
        assert flags in (0x01, 0x03)
        high, low, last_high, last_low, count = struct.unpack("<8xiIiII", body)
        first, last = high << 32 | low, last_high << 32 | last_low
        assert first >= 1
        assert last >= first - 1
        self._increases(0x07, body, destination, count)

    def _acknack(self, flags: int, body: bytes, destination: bytes) -> None:
        assert flags in (0x01, 0x03)
        high, low, bits = struct.unpack_from("<8xiII", body)
        assert high << 32 | low >= 1
        assert bits <= 256
        words = (bits + 31) // 32
        assert len(body) == 24 + 4 * words
        bitmap = struct.unpack_from(f"<{words}I", body, 20)
        if bits % 32:
            assert not bitmap[-1] & ((1 << 32 - bits % 32) - 1)
        self._increases(0x06, body, destination, struct.unpack_from("<I", body, 20 + 4 * words)[0])


_WRITERS = st.sampled_from([rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS])
_NUMBERS = st.one_of(
    st.integers(-2, 6), st.sampled_from([257, 4096, 2**31, 2**32, 2**63 - 2, 2**63 - 1, -(2**63)])
)


def _gap(writer: bytes, start: int, base: int) -> bytes:
    body = rtps.detector_of(writer) + writer
    body += struct.pack("<iIiII", start >> 32, start & 0xFFFFFFFF, base >> 32, base & 0xFFFFFFFF, 0)
    return struct.pack("<BBH", 0x08, 1, len(body)) + body


_SUBMESSAGES = st.one_of(
    st.builds(rtps.build_heartbeat, _WRITERS, _NUMBERS, _NUMBERS, st.just(1)),
    st.builds(_gap, _WRITERS, _NUMBERS, _NUMBERS),
    st.builds(
        lambda base, offsets: rtps.build_acknack(
            rtps.SEDP_SUBSCRIPTIONS,
            base,
            [base + o for o in offsets],
            1,
            destination=ME,
            final=False,
        ),
        _NUMBERS.filter(lambda n: n < 2**62),
        st.lists(st.integers(0, 255), max_size=3),
    ),
)


@given(st.lists(st.one_of(_SUBMESSAGES, st.floats(0.0, 0.5), st.sampled_from(_REAL)), max_size=12))
def test_observer_sends_only_valid_packets_for_any_input(
    events: list[bytes | float],
) -> None:
    """It is run beside robots: no reply to any peer, right or wrong, may break the protocol."""
    grammar, now = Grammar(), 0.0
    observer = Observer(
        ME, PLACE, properties={"__ProcessName": "x"}, wanted=lambda topic, type_name: True
    )
    source = packets.CYCLONE_0_10_PARTICIPANT[8:20]
    grammar.check(observer.announcement())
    sent = observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), now)
    for event in events:
        if isinstance(event, float):
            now += event
            sent += observer.tick(now)
        elif event[:4] == b"RTPS":
            sent += observer.receive(_addressed(event), now)
        else:
            sent += observer.receive(rtps.message(source, event), now)
    for packet, _ in sent:
        grammar.check(packet)
    grammar.check(observer.withdrawal_packet())
    assert grammar.kinds >= {0x15, 0x0E, 0x06}
