"""The emulated Dex3-1's processor on a manual clock: frames, motors, time-outs, faults."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.emulators.dex3_mcu import Dex3Mcu, Firmware, Wiring
from dexkit.emulators.dex3_mcu.command import CommandReader
from dexkit.emulators.dex3_mechanics import Dex3Mechanics
from dexkit.emulators.faults import DEX3_FAULTS, grammar, parse_fault
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import (
    BROADCAST_ID,
    COMMAND_734,
    COMMAND_1234,
    N_BUSES,
    CommandFrame,
    CommandLayout,
    HandCodec,
    MotorCmd,
    StateFrame,
    pack_command,
    parse_state,
)
from tests.each import each

TRIPPED = MotorError.MOTOR_SAW_HOST_TIMEOUT
SIDES = list(Side)


class Bench:
    """A hand, the codec of a driver, and a clock moved by hand."""

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        firmware: Firmware | None = None,
        faults: Sequence[str] = (),
        object_at: float | None = None,
    ) -> None:
        self.side = side
        self.clock = ManualClock(100.0)
        self.mechanics = Dex3Mechanics(side, object_at=object_at)
        self.mcu = Dex3Mcu(
            side,
            mechanics=self.mechanics,
            clock=self.clock,
            firmware=firmware,
            faults=[parse_fault(spec, DEX3_FAULTS) for spec in faults],
        )
        self.codec = HandCodec(DEX3_1.joints[side])
        self.rest = np.array(DEX3_1.rest_q[side])

    def frame(self, q: Sequence[float], *, protect: bool = True, kp: float = 1.5) -> bytes:
        return self.codec.encode(HandCommand.position(q, kp=kp, kd=0.2), protect)

    def ask(self, frame: bytes) -> HandState:
        answer = self.mcu.exchange(frame)
        assert answer is not None
        return self.codec.decode(answer, self.clock.now())

    def run(self, seconds: float, frame: bytes, *, every: float = 0.01) -> HandState:
        """Exchange ``frame`` for some time."""
        for _ in range(round(seconds / every)):
            state = self.ask(frame)
            self.clock.advance(every)
        return state

    def away(self) -> np.ndarray:
        """A pose away from rest, within the limits."""
        return np.array(
            [(joint.q_min + joint.q_max) / 2 + 0.1 for joint in DEX3_1.joints[self.side]]
        )


def empty() -> bytes:
    return pack_command(CommandFrame())


def single(
    bus: int, *packets: MotorCmd, layout: CommandLayout = COMMAND_1234, bad: bool = False
) -> bytes:
    buses: list[list[MotorCmd]] = [[] for _ in range(N_BUSES)]
    buses[bus] = list(packets)
    data = bytearray(pack_command(CommandFrame(buses), layout))
    if bad:
        data[layout.bus_offset(bus) + 8] ^= 1
        seal(data)
    return bytes(data)


def seal(data: bytearray) -> None:
    data[-4:] = crc32_words(bytes(data[2:-4])).to_bytes(4, "little")


def packet(number: int, *, status: int = 1, timeout: bool = True, q: int = 0) -> MotorCmd:
    return MotorCmd(number, status, timeout, 0, 0, q, 164, 2194)


# --- frames


def test_hand_at_rest_reports_its_initial_state() -> None:
    bench = Bench()
    raw = bench.mcu.exchange(empty())
    assert raw is not None
    assert len(raw) == 1270
    frame: StateFrame = parse_state(raw)
    assert [[type(p).__name__ for p in bus] for bus in frame.buses] == [
        ["MotorState"] * 3 + ["SensorState"] * 2,
        ["MotorState"] * 2 + ["SensorState"] * 2,
        ["MotorState"] * 2 + ["SensorState"] * 2,
        ["SensorState"] * 3,
        [],
    ]
    assert (frame.model, frame.timeout, frame.error) == (0, 0, 0)
    state = bench.codec.decode(raw, 0.0)
    assert state.q == pytest.approx(bench.rest, abs=1e-5)
    assert state.mode.tolist() == [0] * 7
    assert state.supply is not None
    assert state.supply.power_v == pytest.approx(24.0, abs=0.01)
    assert 0.2 < state.supply.power_a < 1.0
    assert state.imu is not None
    assert state.imu.accelerometer == pytest.approx((0.0, 0.0, 9.81))
    assert state.pressure is not None
    assert np.isfinite(state.pressure).sum() == 33
    assert 100_990 < np.nanmin(state.pressure) < np.nanmax(state.pressure) < 103_310
    counts = np.array([s.pressure for _, s in frame.sensors])
    assert np.count_nonzero(counts == 3750) == 75  # docs/sources/unitree-dex.md#b4: 30000 Pa


@each("code", [3750, 30000])
def test_a_hand_may_mark_slots_without_an_element_in_pa_or_in_counts(code: int) -> None:
    bench = Bench(firmware=Firmware(no_value=code), object_at=40.0)
    raw = bench.mcu.exchange(bench.frame(bench.rest.tolist()))
    assert raw is not None
    counts = np.array([s.pressure for _, s in parse_state(raw).sensors])
    assert np.count_nonzero(counts == code) == 75
    state = bench.codec.decode(raw, 0.0)
    assert state.pressure is not None
    assert np.isfinite(state.pressure).sum() == 33
    with pytest.raises(UsageError, match="3750 or 30000"):
        Firmware(no_value=0)


@pytest.mark.parametrize("side", SIDES)
@given(
    poses=st.lists(st.tuples(*[st.floats(0.0, 1.0)] * 7).map(np.array), min_size=1, max_size=4),
    seconds=st.floats(0.0, 0.3),
)
def test_answers_are_those_of_the_codec(
    side: Side, poses: list[np.ndarray], seconds: float
) -> None:
    bench = Bench(side, object_at=30.0)
    joints = DEX3_1.joints[side]
    for part in poses:
        q = [j.q_min + p * (j.q_max - j.q_min) for j, p in zip(joints, part, strict=True)]
        bench.clock.advance(seconds)
        answer = bench.mcu.exchange(bench.frame(q))
        assert answer == bench.codec.encode_state(
            bench.mechanics.state(0.0), fans=bytes([bench.mechanics.fans] * 2)
        )


@given(
    q=st.tuples(*[st.floats(-3, 3)] * 7),
    kp=st.floats(0, 20),
    kd=st.floats(0, 2),
    tau=st.floats(-2, 2),
    dq=st.floats(-20, 20),
    mode=st.lists(st.integers(0, 7), min_size=7, max_size=7),
    protect=st.lists(st.booleans(), min_size=7, max_size=7),
    layout=st.sampled_from([COMMAND_1234, COMMAND_734]),
    wiring=st.sampled_from([Wiring.assumed(Side.RIGHT), Wiring.random(1)]),
)
def test_ordinary_commands_are_read_as_the_codec_reads_them(
    q: Sequence[float],
    kp: float,
    kd: float,
    tau: float,
    dq: float,
    mode: list[int],
    protect: list[bool],
    layout: CommandLayout,
    wiring: Wiring,
) -> None:
    joints = DEX3_1.joints[Side.RIGHT]
    codec = HandCodec(joints, wiring.bus_map, layout, mounting=wiring.mounting)
    command = HandCommand.position(q, kp=kp, kd=kd, tau=tau, dq=dq)
    command = dataclasses.replace(command, mode=np.array(mode, np.uint8))
    frame = codec.encode(command, np.array(protect))
    read = CommandReader(wiring).read(frame)
    assert read is not None
    read.sort()  # they come bus by bus
    expected = codec.decode_command(frame).command
    assert expected.timeout is not None
    assert [r[0] for r in read] == list(range(7))
    assert [r[1] for r in read] == expected.mode.tolist()
    assert [r[2] for r in read] == expected.timeout.tolist()
    for place, name in enumerate(("q", "dq", "tau", "kp", "kd"), start=3):
        assert [r[place] for r in read] == pytest.approx(getattr(expected, name).tolist())


# --- frames that are not right


def spoil_crc(frame: bytes) -> bytes:
    return frame[:-1] + bytes([frame[-1] ^ 1])


@each(
    ("spoil", "counter"),
    [
        (spoil_crc, "bad_crc"),
        (lambda f: f[:-1], "bad_size"),
        (lambda f: f + b"\0", "bad_size"),
        (lambda f: f[:734], "bad_crc"),  # the length of the other layout
        (lambda f: b"", "bad_size"),
        (lambda f: f * 3, "bad_size"),
    ],
)
def test_invalid_frame_is_answered_and_moves_nothing(
    spoil: Callable[[bytes], bytes], counter: str
) -> None:
    bench = Bench()
    state = bench.run(0.3, spoil(bench.frame(bench.away())))
    assert state.q == pytest.approx(bench.rest, abs=1e-5)
    assert state.mode.tolist() == [0] * 7
    assert getattr(bench.mcu.counters, counter) == 30
    assert f"30 {counter.replace('_', ' ')}" in bench.mcu.counters.summary()


def test_a_damaged_packet_leaves_its_motor_with_its_last_command() -> None:
    bench = Bench()
    bench.ask(single(0, packet(0), packet(1, q=56_000)))
    bench.ask(single(0, packet(0, status=0), packet(1, q=0), bad=True))
    bench.clock.advance(0.5)
    state = bench.ask(empty())
    assert state.mode.tolist() == [1, 1, 0, 0, 0, 0, 0]  # packet 0 was damaged: still FOC
    assert state.q[1] == pytest.approx(0.0, abs=0.05)  # packet 1 was taken
    assert bench.mcu.counters.damaged_packets == 1


_GOOD = HandCodec(DEX3_1.joints[Side.LEFT]).encode(
    HandCommand.position([0.5] * 7, kp=1.5, kd=0.2), True
)


@given(
    data=st.one_of(
        st.binary(max_size=3000),
        st.binary(min_size=1234, max_size=1234),
        st.integers(16, 8 * 1234 - 1).map(
            lambda bit: bytes(b ^ (1 << bit % 8) * (i == bit // 8) for i, b in enumerate(_GOOD))
        ),
        st.integers(0, 1233).map(lambda n: _GOOD[:n]),
    )
)
def test_invalid_input_moves_no_motor(data: bytes) -> None:
    bench = Bench()
    assert bench.mcu.exchange(data) is not None
    bench.clock.advance(0.02)
    state = bench.ask(empty())
    assert state.mode.tolist() == [0] * 7
    assert state.q == pytest.approx(bench.rest, abs=1e-5)


# --- modes


@each("status", [2, 5, 6, 7])
def test_undefined_status_brakes_or_is_ignored(status: int) -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.rest))
    assert bench.ask(single(0, packet(0, status=status))).mode[0] == 0
    bench = Bench(firmware=Firmware(other_status_brakes=False))
    bench.ask(bench.frame(bench.rest))
    assert bench.ask(single(0, packet(0, status=status))).mode[0] == 1
    assert bench.mcu.counters.ignored_packets == 1


# --- time-out protection


def test_protection_trips_after_a_second_and_is_cleared_by_bit_7() -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.rest))
    bench.clock.advance(0.999)
    bench.mcu.advance()
    assert bench.mcu.tripped == [False] * 7
    bench.clock.advance(0.002)
    raw = bench.mcu.exchange(empty())
    assert raw is not None
    frame = parse_state(raw)
    assert frame.timeout == 1
    assert all(motor.timeout for _, motor in frame.motors)
    state = bench.codec.decode(raw, 0.0)
    assert state.mode.tolist() == [0] * 7
    assert (state.fault == TRIPPED).all()
    assert bench.mcu.counters.trips == 7

    # a command with bit 7 = 1 does not wake it
    state = bench.run(0.3, bench.frame(bench.away()))
    assert (state.fault == TRIPPED).all()
    assert state.q == pytest.approx(bench.rest, abs=1e-3)

    # one with bit 7 = 0 does, and is obeyed
    state = bench.run(0.3, bench.frame(bench.away(), protect=False))
    assert not state.fault.any()
    assert state.mode.tolist() == [1] * 7
    assert np.abs(state.q - bench.rest).max() > 0.1


def test_timeout_protection_is_per_motor() -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.rest, protect=False))
    bench.ask(single(1, packet(0, timeout=True)))
    bench.clock.advance(5.0)
    state = bench.ask(empty())
    assert state.fault.tolist() == [0, 0, 0, TRIPPED, 0, 0, 0]
    assert state.mode.tolist() == [1, 1, 1, 0, 1, 1, 1]


def test_only_valid_packets_reset_the_timeout() -> None:
    bench = Bench()
    bench.ask(single(0, packet(0)))
    for _ in range(11):
        bench.clock.advance(0.1)
        bench.ask(single(0, packet(0), bad=True))
        bench.ask(spoil_crc(bench.frame(bench.rest)))
    assert bench.mcu.tripped == [True, *[False] * 6]


def test_timeout_trips_without_an_exchange() -> None:
    """What a motor did in a long pause is lived through in order: drive, trip, brake."""
    bench = Bench()
    goal = bench.rest.copy()
    goal[3] -= 0.5
    moving = dataclasses.replace(
        HandCommand.position(goal, kp=0.0, kd=0.05, dq=-0.3), mode=np.full(7, 1, np.uint8)
    )
    bench.ask(bench.codec.encode(moving, True))
    bench.clock.advance(4.0)
    state = bench.ask(empty())
    # some 0.3 rad/s for one second, not for four
    assert 0.05 < abs(state.q[3] - bench.rest[3]) < 0.4
    assert state.dq[3] == 0.0


def test_without_protection_the_command_stays_in_force() -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.away(), protect=False))
    bench.clock.advance(60.0)
    state = bench.ask(empty())
    assert state.mode.tolist() == [1] * 7
    assert state.q == pytest.approx(bench.away(), abs=0.02)


# --- broadcast, and who answers


def test_broadcast_commands_a_bus_and_is_not_answered() -> None:
    bench = Bench()
    state = bench.ask(single(0, packet(BROADCAST_ID)))
    assert bench.codec.missing_motors == (0, 1, 2)
    assert state.mode.tolist()[3:] == [0] * 4
    assert bench.mcu.counters.broadcasts == 1
    state = bench.ask(empty())
    assert bench.codec.missing_motors == ()
    assert state.mode.tolist() == [1, 1, 1, 0, 0, 0, 0]


# --- faults


def test_command_is_obeyed_although_its_answer_is_dropped() -> None:
    bench = Bench(faults=["drop@1s:for=1s"])
    assert bench.mcu.exchange(empty()) is not None
    bench.clock.advance(1.5)
    assert bench.mcu.exchange(bench.frame(bench.away())) is None
    bench.clock.advance(0.8)
    assert bench.ask(empty()).mode.tolist() == [1] * 7  # it was obeyed
    assert bench.mcu.counters.dropped == 1


def test_silent_motor_ignores_commands_and_times_out() -> None:
    bench = Bench(faults=["silent@1s:id=3,for=3s"])
    bench.run(1.0, bench.frame(bench.rest))
    state = bench.run(2.0, bench.frame(bench.away()))
    assert bench.codec.missing_motors == (3,)
    assert math.isnan(state.q[3])
    assert bench.mcu.tripped == [i == 3 for i in range(7)]
    assert bench.mechanics.q[3] == pytest.approx(bench.rest[3], abs=0.02)
    state = bench.run(2.0, bench.frame(bench.away()))
    assert bench.codec.missing_motors == ()
    assert state.fault.tolist() == [TRIPPED if i == 3 else 0 for i in range(7)]


@pytest.mark.parametrize(
    ("spec", "bits"),
    [
        ("overheat@1s:id=5,for=2s", MotorError.WINDING_OVERTEMPERATURE),
        ("overcurrent@1s:id=5,for=2s", MotorError.OVERCURRENT),
    ],
)
def test_a_motor_with_an_error_brakes_until_it_is_over(spec: str, bits: int) -> None:
    bench = Bench(faults=[spec])
    frame = bench.frame(bench.rest)
    assert not bench.run(1.0, frame).fault.any()
    state = bench.run(1.9, bench.frame(bench.away()))
    assert state.fault[5] & bits
    assert [bool(f) for f in state.fault] == [i == 5 for i in range(7)]
    assert state.mode.tolist() == [int(i != 5) for i in range(7)]
    assert state.q[5] == pytest.approx(bench.rest[5], abs=0.02)
    bench.clock.advance(0.2)
    bench.mcu.advance()
    assert bench.mechanics.mode[5] == 0  # not on the command of before
    state = bench.run(1.0, bench.frame(bench.away()))
    assert not state.fault.any()
    assert state.q == pytest.approx(bench.away(), abs=0.03)


def test_pulling_the_cable_stops_no_motor_but_their_protection_does() -> None:
    bench = Bench(faults=["unplug:for=3s"])
    bench.ask(bench.frame(bench.away()))
    bench.clock.advance(0.9)
    bench.mcu.advance()
    assert bench.mechanics.mode == [1] * 7
    bench.clock.advance(0.2)
    bench.mcu.advance()
    assert bench.mechanics.mode == [0] * 7


# --- the grammar of the family


@each(
    "text",
    ["overload", "silent:id=7", "drop:side=up", "stall:for=2s", "drop:id=1", "silent:c=3", "fire"],
)
def test_bad_faults_name_what_a_hand_can_have(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_fault(text, DEX3_FAULTS)
    assert caught.value.hint == grammar(DEX3_FAULTS)
    assert all(kind.name in caught.value.hint for kind in DEX3_FAULTS.kinds)
