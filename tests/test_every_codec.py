"""What holds for every frame of a serial line, USB or TCP, and for every parser of a stream.

The bytes of each frame, as their sources have them, are in the test of the protocol.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import WireError
from dexkit.wire import dex3_usb, dynamixel, m4010, modbus, rh56
from dexkit.wire.modbus import Adu, Function, Request


class Parser(Protocol):
    """What each parser of a stream has."""

    skipped: int

    @property
    def pending(self) -> int: ...

    def feed(self, data: bytes) -> Sequence[Any]: ...


@dataclasses.dataclass(frozen=True)
class Codec:
    """A kind of frame.

    :ivar messages: a strategy for what a frame holds.
    :ivar read: frame to message; nothing where only a stream can be read.
    :ivar parser: makes a parser of a stream; nothing where frames come whole.
    :ivar largest: bytes that the parser may keep.
    :ivar unchecked: bytes at the start that may be anything.
    :ivar has_checksum: any flipped bit shows.
    :ivar has_length: the frame itself says how long it is.
    :ivar finds_frames: the parser goes on after bytes that are no frame.
    """

    name: str
    messages: st.SearchStrategy[Any]
    pack: Callable[[Any], bytes]
    read: Callable[[bytes], Any] | None = None
    parser: Callable[[], Parser] | None = None
    largest: int = 0
    unchecked: int = 0
    has_checksum: bool = True
    has_length: bool = True
    finds_frames: bool = True


# bytes that look like the heads of frames, far more often than by chance
nasty = st.lists(
    st.one_of(
        st.sampled_from(
            [b"\xff\xff\xfd", b"\0", b"\xfc\xee", b"\xfe\xee", b"\x7e\xe7", b"\xeb\x90"]
        ),
        st.binary(max_size=20),
    ),
    max_size=6,
).map(b"".join)
words = st.integers(0, 0xFFFF)


@st.composite
def dynamixel_packets(draw: st.DrawFn) -> dynamixel.Packet:
    code = draw(st.sampled_from([*dynamixel.Instruction]))
    if code == dynamixel.Instruction.STATUS:
        return dynamixel.Packet(draw(st.integers(0, 252)), code, b"\0" + draw(nasty))
    return dynamixel.Packet(draw(st.integers(0, 252) | st.just(254)), code, draw(nasty))


def packets(kind: type, structure: Any, *names: str) -> st.SearchStrategy[Any]:
    """Packets of a motor: id, mode and time-out bit, then the fields of these names."""
    fields = [structure.field(name) for name in names]
    return st.builds(
        kind,
        st.integers(0, 15),
        st.integers(0, 7),
        st.booleans(),
        *(st.integers(field.low, field.high) for field in fields),
    )


COMMAND_FIELDS = ("tor_des", "spd_des", "pos_des", "k_pos", "k_spd", "res")
STATE_FIELDS = (
    *("temp", "sensor", "vol", "torque", "speed", "pos"),
    *("MError", "ExSensor1", "ExSensor2"),
)
motor_cmds = packets(dex3_usb.MotorCmd, dex3_usb.MOTOR_CMD, *COMMAND_FIELDS)
motor_states = packets(dex3_usb.MotorState, dex3_usb.MOTOR_STATE, *STATE_FIELDS)
sensor_states = st.builds(
    dex3_usb.SensorState,
    st.integers(0, 15),
    st.integers(0, 15),
    st.tuples(*[words] * 12),
    st.tuples(*[st.integers(-128, 127)] * 12),
    st.integers(0, 255),
)
command_frames = st.builds(
    dex3_usb.CommandFrame,
    st.lists(st.lists(motor_cmds, max_size=7), min_size=5, max_size=5),
    st.binary(min_size=2, max_size=2),
    st.binary(min_size=4, max_size=4),
    st.integers(0, 2**32 - 1),
    st.sampled_from(dex3_usb.COMMAND_LAYOUTS),
)
state_frames = st.builds(
    dex3_usb.StateFrame,
    st.lists(st.lists(motor_states | sensor_states, max_size=3), min_size=5, max_size=5),
    model=st.integers(0, 255),
    timeout=st.integers(0, 255),
    pin_v=words,
    imu=st.tuples(*[st.integers(-0x8000, 0x7FFF)] * 6),
    error=st.integers(0, 2**32 - 1),
)
m4010_commands = st.builds(
    m4010.MotorCmd,
    id=st.integers(0, 15),
    status=st.integers(0, 7),
    timeout=st.booleans(),
    tor_des=st.integers(-0x8000, 0x7FFF),
    pos_des=st.integers(-(2**31), 2**31 - 1),
    k_pos=words,
    res=st.integers(0, 255),
)
m4010_data = st.builds(
    m4010.MotorData,
    id=st.integers(0, 15),
    status=st.integers(0, 7),
    temp=st.integers(-128, 127),
    speed=st.integers(-0x8000, 0x7FFF),
    pos=st.integers(-(2**31), 2**31 - 1),
    merror=st.integers(0, 2**32 - 1),
    ex_sensor2=words,
)
requests = st.one_of(
    st.builds(
        Request,
        st.sampled_from([Function.READ_HOLDING, Function.READ_INPUT]),
        words,
        st.integers(1, modbus.MOST_READ),
    ),
    st.builds(Request.write, words, st.lists(words, min_size=1, max_size=modbus.MOST_WRITTEN)),
    st.builds(lambda at, value: Request(Function.WRITE_ONE, at, 1, (value,)), words, words),
)
answers = requests.map(lambda r: modbus.answer(r, [7] * r.count if r.function in (3, 4) else ()))


def adus(pdus: st.SearchStrategy[bytes], *number: st.SearchStrategy[int]) -> Any:
    return st.builds(Adu, st.integers(0, 255), pdus, *number)


def rh56_frames(answer: bool) -> Any:
    return st.builds(
        rh56.Frame,
        st.integers(0, 255),
        st.sampled_from(rh56.Operation),
        words,
        st.binary(max_size=40),
        st.just(answer),
    )


def pack(message: Any) -> bytes:
    packed: bytes = message.pack()
    return packed


CODECS = [
    Codec(
        "dynamixel",
        dynamixel_packets(),
        lambda p: dynamixel.encode(p.id, p.instruction, p.params),
        dynamixel.decode,
        dynamixel.PacketParser,
        dynamixel.MAX_PACKET,
    ),
    Codec("m4010 command", m4010_commands, pack, m4010.MotorCmd.parse),
    Codec(
        "m4010 data",
        m4010_data,
        pack,
        m4010.MotorData.parse,
        m4010.FrameParser,
        m4010.DATA.size - 1,
    ),
    Codec("dex3 motor command", motor_cmds, pack, dex3_usb.MotorCmd.parse),
    Codec("dex3 motor state", motor_states, pack, dex3_usb.MotorState.parse),
    Codec("dex3 sensor state", sensor_states, pack, dex3_usb.SensorState.parse),
    Codec(
        "dex3 command frame",
        command_frames,
        dex3_usb.pack_command,
        dex3_usb.parse_command,
        unchecked=2,
    ),
    Codec("dex3 state frame", state_frames, dex3_usb.pack_state, dex3_usb.parse_state),
    Codec(
        "rh56 command",
        rh56_frames(False),
        pack,
        rh56.Frame.parse,
        lambda: rh56.FrameParser(answers=False),
        300,
    ),
    Codec(
        "rh56 answer",
        rh56_frames(True),
        pack,
        rh56.Frame.parse,
        lambda: rh56.FrameParser(answers=True),
        300,
    ),
    Codec(
        "modbus rtu request",
        adus(requests.map(pack)),
        Adu.pack_rtu,
        Adu.parse_rtu,
        lambda: modbus.RtuParser(answers=False),
        256,
        has_length=False,
    ),
    Codec(
        "modbus rtu answer",
        adus(answers),
        Adu.pack_rtu,
        Adu.parse_rtu,
        lambda: modbus.RtuParser(answers=True),
        260,
        has_length=False,
    ),
    Codec("modbus request", requests, pack, modbus.parse_request, has_checksum=False),
    Codec(
        "modbus tcp",
        adus(requests.map(pack) | answers, words),
        Adu.pack_tcp,
        parser=modbus.TcpParser,
        largest=260,
        finds_frames=False,
    ),
]


def every(codecs: Sequence[Codec]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("codec", codecs, ids=[codec.name for codec in codecs])


every_frame = every([codec for codec in CODECS if codec.read])
every_stream = every([codec for codec in CODECS if codec.parser])


def read(codec: Codec, data: bytes) -> Any:
    assert codec.read is not None
    return codec.read(data)


def parser_of(codec: Codec) -> Parser:
    assert codec.parser is not None
    return codec.parser()


@every_frame
@given(data=st.data())
def test_what_was_packed_is_read(codec: Codec, data: st.DataObject) -> None:
    message = data.draw(codec.messages)
    frame = codec.pack(message)
    assert read(codec, frame) == message
    assert codec.pack(read(codec, frame)) == frame


@every([codec for codec in CODECS if codec.read and codec.has_checksum])
@settings(max_examples=4)
@given(data=st.data())
def test_every_flipped_bit_is_noticed(codec: Codec, data: st.DataObject) -> None:
    frame = bytearray(codec.pack(data.draw(codec.messages)))
    bits = range(8 * codec.unchecked, 8 * len(frame))
    for bit in bits if len(frame) < 300 else bits[:: data.draw(st.integers(3, 11))]:
        frame[bit // 8] ^= 1 << bit % 8
        with pytest.raises(WireError):
            read(codec, bytes(frame))
        frame[bit // 8] ^= 1 << bit % 8


@every([codec for codec in CODECS if codec.read and codec.has_length])
@settings(max_examples=4)
@given(data=st.data())
def test_every_other_length_is_refused(codec: Codec, data: st.DataObject) -> None:
    frame = codec.pack(data.draw(codec.messages))
    for length in range(len(frame)):
        with pytest.raises(WireError):
            read(codec, frame[:length])
    for more in (b"\0", frame):
        with pytest.raises(WireError):
            read(codec, frame + more)


@every_frame
@given(noise=st.binary(max_size=100) | nasty)
def test_any_bytes_are_read_or_a_typed_error(codec: Codec, noise: bytes) -> None:
    try:
        read(codec, noise)
    except WireError:
        pass


@every_stream
@given(data=st.data())
def test_a_parser_does_not_care_how_bytes_are_cut(codec: Codec, data: st.DataObject) -> None:
    sent = data.draw(st.lists(codec.messages, max_size=4))
    stream = b"".join(map(codec.pack, sent))
    parser = parser_of(codec)
    got: list[Any] = []
    while stream:
        n = data.draw(st.integers(1, len(stream)))
        got += parser.feed(stream[:n])
        stream = stream[n:]
    assert got == sent
    assert (parser.skipped, parser.pending) == (0, 0)


@every_stream
@given(pieces=st.lists(st.binary(max_size=400) | nasty, max_size=8))
def test_a_parser_survives_anything_within_bounds(codec: Codec, pieces: list[bytes]) -> None:
    parser = parser_of(codec)
    for piece in pieces:
        found = parser.feed(piece)
        assert parser.pending <= codec.largest
        assert len(found) <= codec.largest + len(piece)
    assert parser.skipped + parser.pending <= sum(map(len, pieces))


@every([codec for codec in CODECS if codec.parser and codec.finds_frames])
@given(noise=nasty, data=st.data())
def test_a_frame_is_found_behind_garbage(codec: Codec, noise: bytes, data: st.DataObject) -> None:
    """False heads can hide a frame only until the bytes that they claim have come."""
    message = data.draw(codec.messages)
    parser = parser_of(codec)
    got = list(parser.feed(noise + codec.pack(message)))
    for _ in range(2 * codec.largest // 64 + 2):
        if message in got:
            return
        got += parser.feed(bytes(64))
    assert message in got
