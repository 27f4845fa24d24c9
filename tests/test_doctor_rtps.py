"""The observer's wire protocol, against packets of real participants and against damage."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.doctor import rtps
from dexkit.doctor.observer import Observer
from dexkit.doctor.rtps import AckNack, Data, DataFrag, Heartbeat, Locator
from dexkit.errors import WireError
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
def test_a_captured_participant(packet: bytes, version: str) -> None:
    found = rtps.parse_participant(_only(packet, Data).payload)
    assert rtps.vendor_name(found.vendor) == "CycloneDDS"
    assert found.version == version
    assert found.prefix == packet[8:20]
    assert found.properties["__ProcessName"] == "python"
    assert found.properties["__Hostname"] == "vm"
    assert found.properties["__Pid"].isdigit()
    assert [p.address for p in found.discovery] == ["127.0.0.1"]
    assert found.multicast


def test_a_captured_writer() -> None:
    item = _only(packets.CYCLONE_0_10_PUBLICATION, Data)
    assert item.writer == rtps.SEDP_PUBLICATIONS
    found = rtps.parse_endpoint(item.payload, writer=True)
    assert (found.topic, found.type_name) == ("rt/dex1/left/cmd", GO)
    assert found.qos == rtps.Policies("reliable", "volatile")
    # as dexkit.dds.type_hash has it, which test_doctor compares on a live domain
    assert found.type_hash == "2ea87a3ac222ec386596036ece43"


def test_the_two_versions_describe_one_type_differently() -> None:
    hashes = {
        rtps.parse_endpoint(_only(p, Data).payload, writer=True).type_hash
        for p in (packets.CYCLONE_0_10_PUBLICATION, packets.CYCLONE_11_PUBLICATION)
    }
    assert len(hashes) == 2
    assert all(len(text) == 28 for text in hashes)


def test_an_observer_asks_whom_it_finds_and_learns() -> None:
    wanted: list[tuple[str, str]] = []
    samples: list[tuple[str, int, bytes]] = []
    observer = Observer(
        ME,
        PLACE,
        wanted=lambda *reader: wanted.append(reader) is None,
        on_sample=lambda w, n, data, now: samples.append((w.topic, n, data)),
    )
    answers = observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), 0.0)
    asked = [i for p, _ in answers for _, i in rtps.parse_message(p)[1] if isinstance(i, AckNack)]
    assert {a.writer for a in asked} == {rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS}
    assert not any(a.final for a in asked)
    assert not observer.settled
    told = observer.receive(_addressed(packets.CYCLONE_0_10_PUBLICATION), 0.1)
    assert wanted == [("rt/dex1/left/cmd", GO)]
    # it announces a reader of that topic, best-effort and without a type object
    readers = [
        rtps.parse_endpoint(i.payload, writer=False)
        for p, _ in told
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


def test_what_is_addressed_to_others_is_none_of_its_business() -> None:
    observer = Observer(ME, PLACE)
    assert observer.receive(packets.CYCLONE_0_10_PARTICIPANT, 0.0) == []
    assert not observer.participants


def test_an_observer_does_not_answer_a_heartbeat_that_wants_no_answer() -> None:
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


@given(st.integers(1, 2**40), st.sets(st.integers(0, 255), max_size=40))
@settings(max_examples=60)
def test_an_acknowledgement_says_what_is_missing(base: int, offsets: set[int]) -> None:
    missing = sorted(base + o for o in offsets)
    packet = rtps.message(
        ME, rtps.build_acknack(b"\0\0\3\xc2", base, missing, 1, destination=ME, final=False)
    )
    ((to, ack),) = rtps.parse_message(packet)[1]
    assert to == ME
    assert ack == AckNack(ME, b"\0\0\3\xc2", base, tuple(missing), False)


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
@settings(max_examples=200)
def test_a_damaged_packet_harms_nothing(
    packet: bytes, damage: list[tuple[int, int]], length: int
) -> None:
    observer = Observer(ME, PLACE, wanted=lambda topic, type_name: True)
    observer.receive(_addressed(packets.CYCLONE_0_10_PARTICIPANT), 0.0)
    data = bytearray(_addressed(packet))
    for at, value in damage:
        data[at % len(data)] = value
    observer.receive(bytes(data[:length]), 0.1)
    observer.tick(1.0)


@given(st.binary(max_size=80))
def test_garbage_is_no_packet(data: bytes) -> None:
    try:
        rtps.parse_message(data)
    except WireError:
        return
    assert data[:4] == b"RTPS"
