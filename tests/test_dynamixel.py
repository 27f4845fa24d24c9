"""Protocol 2.0 framing against the manual's byte-exact packets
(docs/sources/mx64-ezgripper.md#a6).
"""

from __future__ import annotations

import pytest
from hypothesis import strategies as st

from dexkit.errors import (
    ChecksumError,
    EncodeError,
    OversizeError,
    TruncatedError,
    WireError,
)
from dexkit.wire import dynamixel as dxl
from dexkit.wire.dynamixel import ErrorNumber, Instruction, Packet, PacketParser
from tests.each import each

A = "FF FF FD 00 01 "  # the start of every packet to or from id 1


def h(text: str) -> bytes:
    return bytes.fromhex(text)


# from the e-Manual; the two whose CRC it misprints carry the right one
INSTRUCTIONS = [
    ("ping", 1, Instruction.PING, "", A + "03 00 01 19 4E"),
    ("ping all", 254, Instruction.PING, "", "FF FF FD 00 FE 03 00 01 31 42"),
    ("read", 1, Instruction.READ, "84 00 04 00", A + "07 00 02 84 00 04 00 1D 15"),
    ("write", 1, Instruction.WRITE, "74 00 00 02 00 00", A + "09 00 03 74 00 00 02 00 00 CA 89"),
    ("reg write", 1, 4, "68 00 C8 00 00 00", A + "09 00 04 68 00 C8 00 00 00 AE 8E"),
    ("action", 1, Instruction.ACTION, "", A + "03 00 05 02 CE"),
    ("factory reset", 1, Instruction.FACTORY_RESET, "01", A + "04 00 06 01 A1 E6"),
    ("factory reset all", 1, Instruction.FACTORY_RESET, "FF", A + "04 00 06 FF A6 64"),
    ("reboot", 1, Instruction.REBOOT, "", A + "03 00 08 2F 4E"),
    ("clear", 1, Instruction.CLEAR, "01 44 58 4C 22", A + "08 00 10 01 44 58 4C 22 B1 DC"),
    ("backup", 1, 0x20, "01 43 54 52 4C", A + "08 00 20 01 43 54 52 4C 16 F5"),
    ("restore", 1, 0x20, "02 43 54 52 4C", A + "08 00 20 02 43 54 52 4C 9E F5"),
    ("sync read", 254, 0x82, "84 00 04 00 01 02", "FFFFFD00FE 0900 82 84 00 04 00 01 02 CE FA"),
    (
        "sync write",
        254,
        0x83,
        "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (
        "fast sync read",
        254,
        0x8A,
        "84 00 04 00 03 07 04",
        "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
    ),
    (
        "bulk read",
        254,
        0x92,
        "01 90 00 02 00 02 92 00 01 00",
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    (
        "bulk write",
        254,
        0x93,
        "01 20 00 02 00 A0 00 02 1F 00 01 00 50",
        "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68",
    ),
    (
        "fast bulk read",
        254,
        0x9A,
        "03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00",
        "FF FF FD 00 FE 12 00 9A 03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00 DA 2D",
    ),
    ("read 126/10", 1, 2, "7E 00 0A 00", A + "07 00 02 7E 00 0A 00 36 F9"),
    ("sync read 126/21", 254, 0x82, "7E 00 15 00 01", "FFFFFD00FE 0800 82 7E 00 15 00 01 1A E7"),
    ("sync write 102", 254, 0x83, "66 00 02 00 01 40 01", "FFFFFD00FE0A0083660002000140 01161D"),
    (
        "sync write 116",
        254,
        0x83,
        "74 00 04 00 01 C2 0B 00 00",
        "FF FF FD 00 FE 0C 00 83 74 00 04 00 01 C2 0B 00 00 62 8B",
    ),
    ("write 102", 1, 3, "66 00 40 01", A + "07 00 03 66 00 40 01 4B 25"),
    ("write 116 negative", 1, 3, "74 00 20 D1 FF FF", A + "09 00 03 74 00 20 D1 FF FF B4 07"),
    (
        "write 116 stuffed",
        1,
        3,
        "74 00 FF FF FD 00",
        A + "0A 00 03 74 00 FF FF FD FD 00 21 E7",
    ),
    ("torque on", 1, 3, "40 00 01", A + "06 00 03 40 00 01 DB 66"),
    ("mode 5", 1, 3, "0B 00 05", A + "06 00 03 0B 00 05 5C E3"),
    ("return delay 0", 1, 3, "09 00 00", A + "06 00 03 09 00 00 69 63"),
    ("read 70/1", 1, 2, "46 00 01 00", A + "07 00 02 46 00 01 00 3C A3"),
]
STATUSES = [
    ("success", 1, 0, "", A + "04 00 55 00 A1 0C"),
    ("ping 1030 fw 38", 1, 0, "06 04 26", A + "07 00 55 00 06 04 26 65 5D"),
    ("ping from 2", 2, 0, "06 04 26", "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
    ("ping 311 fw 45", 1, 0, "37 01 2D", A + "07 00 55 00 37 01 2D 8B 40"),
    ("position 166", 1, 0, "A6 00 00 00", A + "08 00 55 00 A6 00 00 00 8C C0"),
    ("position 2079", 2, 0, "1F 08 00 00", "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE"),
    ("position 2048", 1, 0, "00 08 00 00", A + "08 00 55 00 00 08 00 00 1C 38"),
    ("voltage", 1, 0, "77 00", A + "06 00 55 00 77 00 C3 69"),
    ("temperature", 2, 0, "24", "FF FF FD 00 02 05 00 55 00 24 8B A9"),
    (
        "position -131073, stuffed",
        1,
        0,
        "FF FF FD FF",
        A + "09 00 55 00 FF FF FD FD FF DA 9E",
    ),
    (
        "current 59, velocity 0, position 3010",
        1,
        0,
        "3B 00 00 00 00 00 C2 0B 00 00",
        A + "0E 00 55 00 3B 00 00 00 00 00 C2 0B 00 00 4B 7B",
    ),
    (
        "current -1, velocity -3, stuffed",
        1,
        0,
        "FF FF FD FF FF FF 00 08 00 00",
        A + "0F 00 55 00 FF FF FD FD FF FF FF 00 08 00 00 49 F0",
    ),
    (
        "the whole block 126..146",
        1,
        0,
        "3B 00 00 00 00 00 C2 0B 00 00 00 00 00 00 C2 0B 00 00 78 00 24",
        A + "19 00 55 00 3B 00 00 00 00 00 C2 0B 00 00 00 00 00 00 C2 0B 00 00 78 00 24 78 03",
    ),
    ("no hardware error", 1, 0, "00", A + "05 00 55 00 00 53 21"),
    ("overload with alert", 1, 0x80, "20", A + "05 00 55 80 20 99 21"),
    *(
        (f"error 0x{error:02X}", 1, error, "", A + f"04 00 55 {error:02X} {crc}")
        for error, crc in (
            (1, "A4 8C"),
            (2, "AE 8C"),
            (3, "AB 0C"),
            (4, "BA 8C"),
            (5, "BF 0C"),
            (6, "B5 0C"),
            (7, "B0 8C"),
            (0x80, "A2 8F"),
            (0x87, "B3 0F"),
        )
    ),
]
FAST_STATUSES = [
    (
        "fast sync",
        [(3, 0, h("A6000000")), (7, 0, h("1F080000")), (4, 0, h("FF030000"))],
        "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA"
        " 00 04 FF 03 00 00 D1 9E",
    ),
    (
        "fast bulk",
        [(3, 0, h("A6000000")), (7, 0, h("A501")), (4, 0, h("1F"))],
        "FF FF FD 00 FE 14 00 55 00 03 A6 00 00 00 67 A4 00 07 A5 01 24 74 00 04 1F D9 C1",
    ),
]


def test_crc_check_value() -> None:
    assert dxl.crc16(b"123456789") == 0xFEE8


@each(
    ("packet_id", "code", "params", "wire"),
    [v[1:] for v in INSTRUCTIONS],
    ids=[v[0] for v in INSTRUCTIONS],
)
def test_instruction_vectors(packet_id: int, code: int, params: str, wire: str) -> None:
    assert dxl.encode(packet_id, code, h(params)) == h(wire)
    assert dxl.decode(h(wire)) == Packet(packet_id, code, h(params))


@each(
    ("packet_id", "error", "data", "wire"),
    [v[1:] for v in STATUSES],
    ids=[v[0] for v in STATUSES],
)
def test_status_vectors(packet_id: int, error: int, data: str, wire: str) -> None:
    assert dxl.status(packet_id, error, h(data)) == h(wire)
    packet = dxl.decode(h(wire))
    assert packet.is_status
    assert (packet.id, packet.error, packet.data) == (packet_id, error, h(data))
    assert packet.alert == bool(error & 0x80)
    assert packet.error_number == ErrorNumber(error & 0x7F)


@pytest.mark.parametrize(
    ("parts", "wire"), [v[1:] for v in FAST_STATUSES], ids=[v[0] for v in FAST_STATUSES]
)
def test_fast_status_vectors(parts: list[tuple[int, int, bytes]], wire: str) -> None:
    assert dxl.fast_status(parts) == h(wire)
    packet = dxl.decode(h(wire))
    assert dxl.split_fast_status(packet, [len(data) for _, _, data in parts]) == parts
    with pytest.raises(TruncatedError):
        dxl.split_fast_status(packet, [9])


def test_fast_status_is_not_stuffed() -> None:
    parts = [(3, 0, h("FFFFFD00"))]
    wire = dxl.fast_status(parts)
    assert wire.count(h("FFFFFDFD")) == 0
    assert dxl.split_fast_status(dxl.decode(wire), [4]) == parts


# --- properties

ids = st.one_of(st.integers(0, 252), st.just(254))
# bytes that provoke stuffing far more often than chance would
nasty = st.lists(
    st.one_of(
        st.sampled_from([b"\xff", b"\xff\xff", b"\xfd", b"\xff\xff\xfd", b"\0"]), st.binary()
    ),
    max_size=12,
).map(b"".join)


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    code = draw(st.sampled_from([*Instruction]))
    if code == Instruction.STATUS:
        return Packet(draw(st.integers(0, 252)), code, b"\0" + draw(nasty))
    return Packet(draw(ids), code, draw(nasty))


def test_wrong_length_loses_only_its_own_packet() -> None:
    good = h(A + "03 00 01 19 4E")
    parser = PacketParser()
    lie = dxl.HEADER + h("01 0A 00")  # claims ten bytes: swallows the good packet's first
    assert parser.feed(lie + good) == [Packet(1, 1)]
    assert parser.crc_errors == 1
    assert parser.skipped == len(lie)


@each("length", ["FF FF", "02 00", "00 00", "FA 03"])
def test_absurd_length_is_skipped_at_once(length: str) -> None:
    parser = PacketParser()
    assert parser.feed(h(A + length) + h(A + "03 00 01 19 4E")) == [Packet(1, 1)]
    assert parser.pending == 0


def test_half_packet_is_forgotten_on_reset() -> None:
    parser = PacketParser()
    assert parser.feed(h(A + "03 00")) == []
    parser.reset()
    assert parser.skipped == 7
    assert parser.feed(h(A + "03 00 01 19 4E")) == [Packet(1, 1)]


def test_bad_crc_is_reported_only_when_asked() -> None:
    bad = h(A + "03 00 01 19 4F")
    assert PacketParser().feed(bad) == []
    assert PacketParser(keep_bad=True).feed(bad) == [Packet(1, 1, b"", crc_ok=False)]


@each(
    ("wire", "error"),
    [
        ("", TruncatedError),
        (A + "03 00 01", TruncatedError),
        (A + "04 00 01 19 4E", TruncatedError),
        (A + "02 00 01 19 4E", TruncatedError),
        (A + "FF FF 01 19 4E", OversizeError),
        ("FF FF FE 00 01 03 00 01 19 4E", WireError),
        (A + "03 00 01 19 4E 00", WireError),
        (A + "03 00 01 19 4F", ChecksumError),
    ],
)
def test_invalid_bytes_raise_the_right_error(wire: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        dxl.decode(h(wire))


def test_invalid_packets_cannot_be_encoded() -> None:
    with pytest.raises(EncodeError):
        dxl.encode(253, Instruction.PING)
    with pytest.raises(EncodeError):
        dxl.encode(1, 256)
    with pytest.raises(EncodeError):
        dxl.status(1, 256)
    with pytest.raises(OversizeError):
        dxl.encode(1, Instruction.WRITE, bytes(1020))
    with pytest.raises(EncodeError):
        dxl.fast_status([])
    with pytest.raises(OversizeError):
        dxl.fast_status([(1, 0, bytes(1020))])
    with pytest.raises(WireError):
        _ = Packet(1, Instruction.PING).error
    with pytest.raises(TruncatedError):
        _ = Packet(1, Instruction.STATUS).error
