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


@each("side", SIDES)
@each("layout", [COMMAND_1234, COMMAND_734])
def test_one_send_one_receive(side: Side, layout: CommandLayout) -> None:
    bench = Bench(side)
    bench.codec = HandCodec(DEX3_1.joints[side], layout=layout)
    goal = bench.away()
    state = bench.run(1.5, bench.frame(goal))
    assert state.q == pytest.approx(goal, abs=0.02)
    assert state.mode.tolist() == [1] * 7
    assert not state.fault.any()
    assert bench.mcu.counters.frames == bench.mcu.counters.answers == 150
    assert bench.codec.problems == []


def test_the_state_is_that_of_the_answer() -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.away()))
    bench.clock.advance(0.05)
    state = bench.ask(empty())
    assert state.q == pytest.approx(bench.mechanics.q, abs=1e-5)
    assert np.abs(state.q - bench.rest).max() > 0.01


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


def test_sensors_measure_an_object() -> None:
    bench = Bench(object_at=40.0)
    closed = [j.q_max if j.closing > 0 else j.q_min for j in DEX3_1.joints[Side.LEFT]]
    closed[0] = 0.0
    state = bench.run(1.5, bench.frame(closed))
    assert state.pressure is not None
    tips = [i for i, s in enumerate(DEX3_1.sensors) if s.place.endswith("tip")]
    assert all(np.nanmax(state.pressure[i]) > 150_000.0 for i in tips)
    assert np.isfinite(state.pressure).sum() == 33


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


def test_bad_frame_can_be_left_unanswered() -> None:
    bench = Bench(firmware=Firmware(answer_bad_frame=False))
    assert bench.mcu.exchange(spoil_crc(bench.frame(bench.rest))) is None
    assert bench.mcu.exchange(bench.frame(bench.rest)) is not None


def test_any_frame_header_is_accepted() -> None:
    bench = Bench()
    frame = bench.frame(bench.away())
    state = bench.run(0.2, b"\xeb\x90" + frame[2:])
    assert state.mode.tolist() == [1] * 7


def test_a_damaged_packet_leaves_its_motor_with_its_last_command() -> None:
    bench = Bench()
    bench.ask(single(0, packet(0), packet(1, q=56_000)))
    bench.ask(single(0, packet(0, status=0), packet(1, q=0), bad=True))
    bench.clock.advance(0.5)
    state = bench.ask(empty())
    assert state.mode.tolist() == [1, 1, 0, 0, 0, 0, 0]  # packet 0 was damaged: still FOC
    assert state.q[1] == pytest.approx(0.0, abs=0.05)  # packet 1 was taken
    assert bench.mcu.counters.damaged_packets == 1


def test_packets_for_motors_that_are_not_there_are_counted() -> None:
    bench = Bench()
    state = bench.ask(single(4, packet(0)))
    assert state.mode.tolist() == [0] * 7
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


@given(bit=st.integers(0, 8 * 20 - 1), sizes=st.lists(st.integers(0, 300), min_size=5, max_size=5))
def test_damage_inside_a_good_frame_reaches_no_motor(bit: int, sizes: list[int]) -> None:
    bench = Bench()
    data = bytearray(_GOOD)
    data[26 + bit // 8] ^= 1 << bit % 8  # motor 0 of bus 0
    seal(data)
    state = bench.ask(bytes(data))
    assert state.mode.tolist() == [0, 1, 1, 1, 1, 1, 1]
    for bus, size in enumerate(sizes):
        data[6 + 4 * bus : 10 + 4 * bus] = size.to_bytes(4, "little")
    seal(data)
    assert bench.mcu.exchange(bytes(data)) is not None
    assert bench.mcu.exchange(bytes(26) + b"\xff" * 1200 + bytes(8)) is not None


# --- modes


def test_lock_status_brakes_and_foc_status_drives() -> None:
    bench = Bench()
    goal = bench.away()
    locked = dataclasses.replace(
        HandCommand.position(goal, kp=1.5, kd=0.2), mode=np.zeros(7, np.uint8)
    )
    assert bench.run(0.3, bench.codec.encode(locked, True)).q == pytest.approx(bench.rest, abs=1e-4)
    assert np.abs(bench.run(0.3, bench.frame(goal)).q - bench.rest).max() > 0.1


@each("status", [2, 5, 6, 7])
def test_undefined_status_brakes_or_is_ignored(status: int) -> None:
    bench = Bench()
    bench.ask(bench.frame(bench.rest))
    assert bench.ask(single(0, packet(0, status=status))).mode[0] == 0
    bench = Bench(firmware=Firmware(other_status_brakes=False))
    bench.ask(bench.frame(bench.rest))
    assert bench.ask(single(0, packet(0, status=status))).mode[0] == 1
    assert bench.mcu.counters.ignored_packets == 1


def test_gains_change_the_motion() -> None:
    bench = Bench()
    soft = bench.run(0.1, bench.frame(bench.away(), kp=0.2)).q
    bench = Bench()
    stiff = bench.run(0.1, bench.frame(bench.away(), kp=3.0)).q
    assert (np.abs(stiff - bench.rest) > np.abs(soft - bench.rest)).all()


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


def test_a_tripped_motor_can_go_limp_instead() -> None:
    bench = Bench(firmware=Firmware(tripped_brakes=False))
    bench.ask(bench.frame(bench.rest))
    bench.clock.advance(1.1)
    state = bench.ask(empty())
    assert (state.fault == TRIPPED).all()
    assert state.mode.tolist() == [1] * 7
    assert not state.tau_est.any()


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


def test_a_motor_that_is_also_addressed_alone_answers() -> None:
    bench = Bench()
    bench.ask(single(0, packet(BROADCAST_ID), packet(2, status=0)))
    assert bench.codec.missing_motors == (0, 1)
    assert bench.ask(empty()).mode.tolist() == [1, 1, 0, 0, 0, 0, 0]


def test_broadcast_arms_the_protection() -> None:
    bench = Bench()
    bench.ask(single(0, packet(BROADCAST_ID)))
    bench.clock.advance(1.5)
    bench.mcu.advance()
    assert bench.mcu.tripped == [True] * 3 + [False] * 4


def test_motors_that_were_not_addressed_may_be_silent() -> None:
    bench = Bench(firmware=Firmware(unaddressed_motors_answer=False))
    bench.ask(single(0, packet(1)))
    assert bench.codec.missing_motors == (0, 2, 3, 4, 5, 6)


# --- faults


def test_command_is_obeyed_although_its_answer_is_dropped() -> None:
    bench = Bench(faults=["drop@1s:for=1s"])
    assert bench.mcu.exchange(empty()) is not None
    bench.clock.advance(1.5)
    assert bench.mcu.exchange(bench.frame(bench.away())) is None
    bench.clock.advance(0.8)
    assert bench.ask(empty()).mode.tolist() == [1] * 7  # it was obeyed
    assert bench.mcu.counters.dropped == 1


def test_corrupted_answers_have_one_bit_flipped() -> None:
    bench = Bench(faults=["corrupt:for=1s"])
    good = bench.mcu.state()
    bad = bench.mcu.exchange(empty())
    assert bad is not None
    assert len(bad) == len(good)
    assert sum(bin(a ^ b).count("1") for a, b in zip(good, bad, strict=True)) == 1
    assert bench.mcu.counters.corrupted == 1


def test_delayed_answers_carry_their_delay() -> None:
    bench = Bench(faults=["delay:ms=30,for=1s"], firmware=Firmware(answer_time=0.001))
    bench.mcu.exchange(empty())
    assert bench.mcu.late == pytest.approx(0.031)
    bench.clock.advance(1.5)
    bench.mcu.exchange(empty())
    assert bench.mcu.late == pytest.approx(0.001)
    assert bench.mcu.counters.delayed == 1


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


def test_overheat_fault_below_the_limit_only_warms() -> None:
    bench = Bench(faults=["overheat:id=2,c=60"])
    state = bench.run(0.5, bench.frame(bench.rest))
    assert state.winding_temperature is not None
    assert state.winding_temperature[2] == pytest.approx(60.0, abs=1.0)
    assert not state.fault.any()


def test_a_stuck_joint_does_not_move() -> None:
    bench = Bench(faults=["stuck:id=4,for=1s"])
    state = bench.run(0.9, bench.frame(bench.away()))
    assert state.q[4] == pytest.approx(bench.rest[4], abs=1e-4)
    state = bench.run(1.5, bench.frame(bench.away()))
    assert state.q[4] == pytest.approx(bench.away()[4], abs=0.03)


def test_fault_for_the_other_side_is_ignored() -> None:
    for side in Side:
        bench = Bench(side, faults=["drop:side=left"])
        assert (bench.mcu.exchange(empty()) is None) == (side is Side.LEFT)


def test_unplugging_and_stalling_are_reported() -> None:
    bench = Bench(faults=["unplug@1s:for=2s", "stall@4s", "stall-out@5s"])
    halted: list[str] = []
    bench.mcu.on_stall = halted.append
    bench.mcu.advance()
    assert bench.mcu.plugged
    assert bench.mcu.next_time == 101.0
    bench.clock.advance(1.5)
    bench.mcu.advance()
    assert not bench.mcu.plugged
    bench.clock.advance(2.0)
    bench.mcu.advance()
    assert bench.mcu.plugged
    bench.clock.advance(2.0)
    bench.mcu.advance()
    assert halted == ["in", "out"]
    assert bench.mcu.next_time is None


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


def test_sides_are_for_hands_only() -> None:
    assert parse_fault("drop:side=right", DEX3_FAULTS).side is Side.RIGHT
    with pytest.raises(UsageError, match="no key 'side'"):
        parse_fault("drop:side=right")


@each(
    "wrong",
    [{"queue": 0}, {"command_timeout": 0.0}, {"answer_time": -1.0}, {"model_code": 256}],
)
def test_invalid_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        Firmware(**wrong)  # type: ignore[arg-type]


def test_the_same_seed_gives_the_same_run() -> None:
    def run() -> list[bytes | None]:
        bench = Bench(faults=["drop:p=0.3", "corrupt:p=0.3", "delay:p=0.5"])
        answers = []
        for _ in range(50):
            answers.append(bench.mcu.exchange(bench.frame(bench.away())))
            bench.clock.advance(0.01)
        return answers

    assert run() == run()
    assert None in run()
