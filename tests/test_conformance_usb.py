"""Test USB conformance: frame codec, wrong devices, and a run over USB/IP."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.conformance.faults import mutants
from dexkit.conformance.kit.backend_processes import Tool
from dexkit.conformance.kit.judge import judge_layer
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.kit.results import Load, Verdict
from dexkit.conformance.kit.run_queue import Watched
from dexkit.conformance.layers.usb import LAYER as USB
from dexkit.conformance.stimuli.usb import BUSES
from dexkit.conformance.usb import frames
from dexkit.conformance.usb.access import bulk_pair, open_device
from dexkit.conformance.usb.record import (
    SCHEMA,
    TIMED_OUT,
    Transfer,
    UsbRecord,
)
from dexkit.conformance.usb.recording import UsbRecording
from dexkit.conformance.usb.run import run
from dexkit.conformance.virtual.usb import ReferenceDevice
from dexkit.errors import ConformanceError, TraceUnsupported
from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.traces import open_trace
from dexkit.traces.recorder import Recorder
from dexkit.wire import dex3_usb
from tests.conformance_helpers import usb_run
from tests.each import each
from tests.patience import PATIENCE
from tests.reproduction_helpers import write_usb

BY_NAME = {m.name: m for m in mutants("usb")}
ACCEPTABLE = {Verdict.PASS, Verdict.NOT_APPLICABLE}


def usb() -> tuple[Requirement, ...]:
    return catalogue("dex3-1", "usb")


# --------------------------------------------------------------------- its reading of the wire


@each(
    ("data", "crc"),
    [
        (bytes(4), 0xC704DD7B),
        (b"\xff" * 4, 0x00000000),
        (b"12345678", 0xFEFC54F9),
        (bytes(range(16)), 0x081B46CA),
        (bytes(range(256)) * 4, 0x8ADA4578),
        (bytes(728), 0xEAC26C88),
        (bytes(1228), 0x3E3EEF37),
        (bytes(1264), 0x2768D24E),
    ],
)
def test_crc_matches_documented_vectors(data: bytes, crc: int) -> None:
    assert frames.crc(data) == crc


@each("size", [1234, 734])
def test_usb_commands_are_decoded_by_the_codec(size: int) -> None:
    joints = DEX3_1.joints[Side.LEFT]
    buses: dict[int, list[bytes]] = {}
    for i, (joint, (bus, number)) in enumerate(zip(joints, BUSES, strict=True)):
        motor = frames.Motor(1, q=0.1 * i - 0.2, dq=-0.5, tau=0.1, kp=1.5, kd=0.2, protect=i == 3)
        buses.setdefault(bus, []).append(frames.motor_packet(number, motor, joint))
    data = frames.pack_command(buses, size)
    theirs = [
        (bus, m.id, m.status, bool(m.timeout), m.tor_des, m.spd_des, m.pos_des, m.k_pos, m.k_spd)
        for bus, motors in enumerate(dex3_usb.parse_command(data).buses)
        for m in motors
        if isinstance(m, dex3_usb.MotorCmd)
    ]
    ours = [
        (bus, number, m.status, m.protect, m.tau, m.dq, m.q, m.kp, m.kd)
        for bus, number, m in frames.read_command(data) or ()
    ]
    assert len(ours) == 7
    assert ours == theirs


@given(st.binary(max_size=1400), st.booleans())
def test_reading_any_bytes_raises_no_exception(data: bytes, filled: bool) -> None:
    frame = ReferenceDevice(Side.LEFT).frame()
    reading = frames.read_state(data + frame[len(data) :] if filled else data)
    assert reading.length >= len(data)
    frames.read_command(data)


def test_damaged_packet_is_reported_and_others_are_read() -> None:
    frame = bytearray(ReferenceDevice(Side.LEFT).frame())
    frame[26 + 10] ^= 1  # in the first motor's position
    frame[26 + 240] ^= 1  # in the head of bus 1's first motor
    reading = frames.read_state(bytes(frame))
    assert not reading.crc_right
    assert [m.intact for m in reading.motors] == [False, True, True, False, True, True, True]
    assert len(reading.sensors) == 9


# -------------------------------------------------------------------------------- the record


@given(st.binary(max_size=100), st.integers(-200, 0), st.integers(0, 2**63))
def test_transfer_is_decoded_unchanged(data: bytes, status: int, when: int) -> None:
    transfer = Transfer(when, when + 5, 0x81, status, 4096, data)
    assert Transfer.from_payload(transfer.payload(), when, when + 5) == transfer
    with pytest.raises(TraceUnsupported):
        Transfer.from_payload(transfer.payload()[:-1] if data else b"", when, when)


def test_recording_from_file_gives_same_verdicts(tmp_path: Path) -> None:
    live = usb_run(ReferenceDevice(Side.RIGHT))
    (hand,) = live.sides.values()
    with Recorder(tmp_path / "run.mcap") as recorder:
        write_usb(hand, recorder)
    trace = open_trace(tmp_path / "run.mcap")
    assert trace.warnings == []
    assert trace.topics == ["usb/dex3/right/in", "usb/dex3/right/out"]
    read = UsbRecording.decode(trace)
    assert read is not None
    assert judge_layer(USB, read.since(live.origin_ns), usb()) == judge_layer(USB, live, usb())


@each(
    "record",
    [{}, {"version": "2"}, {"version": "1"}, {"version": "1", "stalls": "[]", "left": "{}"}],
)
def test_damaged_record_raises_trace_unsupported(record: dict[str, str]) -> None:
    with pytest.raises(TraceUnsupported):
        UsbRecord.from_metadata(record)


# ------------------------------------------------------------------------------------- teeth


def test_the_documented_schema_is_the_current_one() -> None:
    text = (Path(__file__).parent.parent / "docs" / "conformance-usb.md").read_text()
    schema = [line.split("#")[0].strip() for line in SCHEMA.splitlines()[1:]]
    assert all(line in text for line in schema)


@pytest.mark.parametrize("side", list(Side))
def test_reference_device_passes(side: Side) -> None:
    results = judge_layer(USB, usb_run(ReferenceDevice(side)), usb())
    assert [r.explain() for r in results if r.verdict is not Verdict.PASS] == []
    assert len(results) == len(usb())


def test_slow_rate_on_overloaded_machine_is_blocked() -> None:
    from dexkit.conformance.kit.stimulus_record import Beats

    recording = usb_run(BY_NAME["Slow"].made(Side.LEFT))
    hand = recording.sides[Side.LEFT]
    first = min(p.begin_ns for p in hand.phases("burst"))
    for late_us, verdict in ((5_000, Verdict.BLOCKED), (100, Verdict.WARN)):
        beats = Beats(first, list(range(0, 9_000_000, 10_000)), [late_us] * 900)
        results = judge_layer(USB, replace(recording, beats=beats), usb())
        (rate,) = [r for r in results if r.requirement.id == "DEX3USB-RATE-01"]
        assert rate.verdict is verdict
        assert ("too busy" in rate.reason) is (verdict is Verdict.BLOCKED)


def test_speed_is_not_judged_with_few_samples() -> None:
    recording = usb_run(ReferenceDevice(Side.LEFT))
    hand = recording.sides[Side.LEFT]
    gone = {
        t.done_ns
        for phase in hand.phases("move")
        for t in hand.during(phase)
        if 15e6 < t.submitted_ns - phase.begin_ns < 120e6
    }
    few = replace(hand, transfers=[t for t in hand.transfers if t.done_ns not in gone])
    results = judge_layer(USB, replace(recording, sides={Side.LEFT: few}), usb())
    (unit,) = [r for r in results if r.requirement.id == "DEX3USB-UNIT-01"]
    assert (unit.verdict, unit.reason) == (Verdict.NOT_APPLICABLE, "no motion to judge by")


# ------------------------------------------------------------------------------ on a real socket


@pytest.fixture(scope="module")
def emulator() -> Iterator[Tool]:
    with Tool("emulate", "dex3-usb", "--side", "both", "--link", "usbip://127.0.0.1:0") as tool:
        tool.wait_ready(threading.Event())
        yield tool


@pytest.fixture(scope="module")
def hands(emulator: Tool) -> str:
    return emulator.place


def test_emulated_hand_passes_and_faulty_hand_fails(emulator: Tool, tmp_path: Path) -> None:
    messages: list[str] = []
    words = ("--side", "right", "--link", "usbip://127.0.0.1:0", "--fault", "silent:id=3")
    with (
        Tool("emulate", "dex3-usb", *words) as faulty,
        Recorder(tmp_path / "run.mcap") as recorder,
    ):
        faulty.wait_ready(threading.Event())
        devices = {Side.LEFT: emulator.place, Side.RIGHT: faulty.place}
        # as in a live run: a device that waited for a processor is not blamed for it
        watched = [
            Watched("the device", tool.pid, (side,))
            for side, tool in ((Side.LEFT, emulator), (Side.RIGHT, faulty))
        ]
        assert run(devices, recorder, report=messages.append, processes=lambda: watched)
    recording = UsbRecording.decode(open_trace(tmp_path / "run.mcap"))
    assert recording is not None
    assert set(recording.sides) == set(Side)
    results = judge_layer(USB, recording, usb())
    # what a test machine may be too slow for is not judged, nor what is blocked by it
    timed = {r.requirement.id for r in results if r.requirement.realtime} - {"DEX3USB-PROT-02"}
    timed |= {r.requirement.id for r in results if r.disturbance.load is Load.TOO_BUSY}
    wrong = [
        r
        for r in results
        if r.verdict not in ACCEPTABLE and not timed & {r.requirement.id, r.blocked_by}
    ]
    assert [r.explain() for r in wrong if r.side == "left"] == []
    blamed = {r.requirement.id for r in wrong if r.verdict is not Verdict.BLOCKED}
    assert blamed == {"DEX3USB-PACK-02"}
    assert messages


def test_host_unlinks_transfer_after_timeout(hands: str) -> None:
    host = open_device(hands, Side.LEFT)
    try:
        for _ in range(3):
            assert host.read(0x81, 4096, 0.02) == (TIMED_OUT, b"")
        frame = frames.pack_command({})
        assert host.write(0x02, frame, PATIENCE) == 0
        status, data = host.read(0x81, 4096, PATIENCE)
        assert (status, len(data)) == (0, 1270)
        assert host.read(0x81, 4096, 0.02) == (TIMED_OUT, b"")
        host.reopen()
        assert host.descriptors.device[8:12] == b"\xb7\x34\x10\x10"
    finally:
        host.close()


def test_libusb_host_calls_pyusb_correctly(hands: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import usb.core
    import usbip_backend

    parts = urlsplit(hands)
    backend = usbip_backend.get_backend(parts.hostname, parts.port, PATIENCE)
    find = usb.core.find
    monkeypatch.setattr(usb.core, "find", lambda **what: find(backend=backend, **what))
    host = open_device("", Side.RIGHT)
    try:
        assert host.descriptors.strings[2] == "Dexthree RightHand"
        out, inward = bulk_pair(host.descriptors) or pytest.fail("no endpoints")
        for _ in range(2):
            assert host.write(out.address, frames.pack_command({}), PATIENCE) == 0
            status, data = host.read(inward.address, 4096, PATIENCE)
            assert (status, len(data)) == (0, 1270)
            host.reopen()
    finally:
        host.close()
        for connection in backend._conns.values():
            connection.close()


class _Watched:
    """A good device as a host sees it, until a motor is driven for the first time."""

    def __init__(self, driven: Callable[[], None]) -> None:
        self.device = ReferenceDevice(Side.LEFT)
        self.descriptors = self.device.descriptors()
        self.deaf = False
        self.sent: list[bytes] = []
        self._driven = driven

    def write(self, endpoint: int, data: bytes, timeout: float) -> int:
        self.sent.append(data)
        if any(motor.status for _, _, motor in frames.read_command(data) or ()):
            self._driven()
        if not self.deaf:
            self.device.write(data)
        return 0

    def read(self, endpoint: int, length: int, timeout: float) -> tuple[int, bytes]:
        return (TIMED_OUT, b"") if self.deaf else self.device.read(timeout)

    def reopen(self) -> None: ...
    def close(self) -> None: ...


@pytest.mark.parametrize("why", ["stopped", "deaf", "broken"])
def test_run_that_ends_early_leaves_no_motor_driven(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()

    def driven() -> None:
        if why == "stopped":
            stop.set()
        elif why == "deaf":
            host.deaf = True
        elif not stop.is_set():
            stop.set()
            raise RuntimeError("broken")

    host = _Watched(driven)
    monkeypatch.setattr("dexkit.conformance.usb.run.open_device", lambda where, side: host)
    with (
        Recorder(tmp_path / "run.mcap") as recorder,
        pytest.raises(RuntimeError) if why == "broken" else nullcontext(),
    ):
        assert run({Side.LEFT: ""}, recorder, stop=stop) == (why == "deaf")
    assert len(host.sent) > 200
    last = frames.read_command(host.sent[-1]) or []
    assert [(motor.status, motor.protect) for _, _, motor in last] == [(0, False)] * 7


@each(
    ("where", "expected"),
    [
        ("usbip://127.0.0.1:1", "127.0.0.1:1"),
        ("usbip://127.0.0.1:x", "127.0.0.1:x"),
    ],
)
def test_missing_device_is_a_clear_error(where: str, expected: str) -> None:
    with pytest.raises(ConformanceError, match=expected):
        open_device(where, Side.LEFT)


def test_device_in_use_is_an_error_and_connections_are_closed(
    hands: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = open_device(hands, Side.LEFT)
    connections = []
    connect = socket.create_connection

    def noting(*arguments: Any, **more: Any) -> socket.socket:
        connections.append(connect(*arguments, **more))
        return connections[-1]

    monkeypatch.setattr(socket, "create_connection", noting)
    try:
        with pytest.raises(ConformanceError, match="refused") as caught:
            open_device(hands, Side.LEFT)
    finally:
        host.close()
    assert "attached" in (caught.value.hint or "")
    assert [connection.fileno() for connection in connections] == [-1, -1]
