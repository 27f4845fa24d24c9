"""Dex3-1 USB codec: against the same work in C (dex3_crc.c) and in Python with a table CRC."""

from __future__ import annotations

import ctypes
import math
import struct
import tempfile
import time
import timeit
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import Result
from benchmarks.native import compiled
from dexkit.hand import HandCommand, HandState, ImuState, Side, SupplyState
from dexkit.models import DEX3_1
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import DEFAULT_BUS_MAP, HandCodec, units
from dexkit.wire.ris import NUDGE

C_PEER = "C, table CRC (-O2)"
PYTHON_PEER = "Python, table CRC"
JOINTS = DEX3_1.joints[Side.LEFT]
ORDER = (units.TORQUE, units.VELOCITY, units.POSITION, units.STIFFNESS, units.DAMPING)

_TABLE = []
for _i in range(256):
    _c = _i << 24
    for _ in range(8):
        _c = (_c << 1 ^ 0x04C11DB7 if _c & 0x80000000 else _c << 1) & 0xFFFFFFFF
    _TABLE.append(_c)


def table_crc(data: bytes) -> int:
    """The manual's function, in Python."""
    crc = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", data):
        for shift in (24, 16, 8, 0):
            crc = (crc << 8 & 0xFFFFFFFF) ^ _TABLE[(crc >> 24) ^ (word >> shift & 0xFF)]
    return crc


def _seal(data: bytes, start: int) -> bytes:
    return data + table_crc(data[start:]).to_bytes(4, "little")


def plain_encode(rows: list[list[float]], factors: list[list[float]]) -> bytes:
    """A 1234-byte command frame with struct and a table CRC."""
    buses = [b""] * 5
    for (bus, number), values, scales in zip(DEFAULT_BUS_MAP.motors, rows, factors, strict=True):
        counts = [
            int(min(max(v * f, s.low), s.high))
            for v, f, s in zip(values, scales, ORDER, strict=True)
        ]
        buses[bus] += _seal(struct.pack("<2sBBhhihh", b"\xfe\xee", number | 0x90, 0, *counts), 0)
    sizes = struct.pack("<5I", *map(len, buses))
    buffers = b"".join(bus.ljust(240, b"\0") for bus in buses)
    return _seal(b"\xfe\xfd" + bytes(4) + sizes + buffers + bytes(4), 2)


def plain_decode(data: bytes) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Fields of the packets of a state frame, with struct and a table CRC; no units."""
    if table_crc(data[2:-4]) != int.from_bytes(data[-4:], "little"):
        raise ValueError("frame CRC")
    motors, sensors = [], []
    for bus, size in enumerate(struct.unpack_from("<5I", data, 6)):
        part = data[26 + bus * 240 : 26 + bus * 240 + size]
        while part:
            motor = part[:2] == b"\xfc\xee"
            length, start = (26, 2) if motor else (44, 0)
            packet, part = part[:length], part[length:]
            if table_crc(packet[start:-4]) != int.from_bytes(packet[-4:], "little"):
                raise ValueError("packet CRC")
            if motor:
                motors.append(struct.unpack("<2xBbBBhhiIHH4x", packet))
            else:
                sensors.append(struct.unpack("<2xBx12H12b4x", packet))
    return motors, sensors


def _best(*functions: Callable[[int], object]) -> list[float]:
    """Best time of one call of each, in µs; short runs in turn get past a busy machine."""
    numbers = []
    for function in functions:
        each = math.inf
        for _ in range(5):
            start = time.perf_counter()
            function(20)
            each = min(each, (time.perf_counter() - start) / 20)
        numbers.append(max(1, min(2000, int(2e-3 / each))))
    best = [math.inf] * len(functions)
    for _ in range(200):
        for i, (function, n) in enumerate(zip(functions, numbers, strict=True)):
            start = time.perf_counter()
            function(n)
            best[i] = min(best[i], (time.perf_counter() - start) / n * 1e6)
    return best


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def run() -> list[Result]:
    codec = HandCodec(JOINTS)
    command = HandCommand.position([0.1, 0.2, 0.5, -0.3, -0.6, -0.4, -0.8], kp=1.5, kd=0.2)
    rng = np.random.default_rng(1)
    pressure = np.full((9, 12), math.nan)
    for i, sensor in enumerate(DEX3_1.sensors):
        pressure[i, list(sensor.slots)] = 8.0 * rng.integers(0, 20000, len(sensor.slots))
    state = HandState.from_values(
        command.q,
        stamp=0.0,
        dq=rng.normal(0, 1, 7),
        tau_est=rng.normal(0, 0.3, 7),
        temperature=35.0,
        winding_temperature=np.full(7, 41.0),
        voltage=24.0,
        mode=1,
        pressure=pressure,
        sensor_temperature=np.full((9, 12), 28.0),
        imu=ImuState(accelerometer=(0.0, 0.0, 9.81)),
        supply=SupplyState(48.0, 1.0, 24.0, 24.0),
    )
    answer = codec.encode_state(state)
    fields = ("tau", "dq", "q", "kp", "kd")
    rows = np.array([[getattr(command, name)[i] for name in fields] for i in range(7)])
    factors = np.array([[s.factor(j.gear_ratio) * NUDGE for s in ORDER] for j in JOINTS])
    row_list, factor_list = rows.tolist(), factors.tolist()
    assert plain_encode(row_list, factor_list) == codec.encode(command, True)
    assert len(plain_decode(answer)[0]) == 7

    def loop(function: Callable[[], object]) -> Callable[[int], object]:
        return lambda n: timeit.timeit(function, number=n)

    ours = [
        loop(lambda: codec.encode(command, True)),
        loop(lambda: codec.decode(answer, 0.0)),
        loop(lambda: crc32_words(answer[2:-4])),
        loop(lambda: crc32_words(answer[:16])),
    ]
    plain = [
        loop(lambda: plain_encode(row_list, factor_list)),
        loop(lambda: plain_decode(answer)),
        loop(lambda: table_crc(answer[2:-4])),
        loop(lambda: table_crc(answer[:16])),
    ]
    names = [
        ("encode a command of 7 motors", "under 15 us", 15.0),
        ("decode a full state", "under 25 us", 25.0),
        ("CRC of a state frame, 1264 bytes", "", 0.0),
        ("CRC of a motor command, 16 bytes", "", 0.0),
    ]
    with tempfile.TemporaryDirectory() as folder:
        library = compiled("dex3_crc", folder)
        theirs = _c_loops(library, codec, command, state, answer, rows, factors) if library else []
        best = _best(*ours, *plain, *theirs)
    results = []
    for i, (name, target, bound) in enumerate(names):
        peers = [(PYTHON_PEER, best[4 + i])]
        if theirs:
            peers.insert(0, (C_PEER, best[8 + i]))
        for peer, value in peers:
            first = peer == peers[0][0]
            results.append(
                Result(
                    name=name,
                    value=best[i],
                    unit="us",
                    peer=peer,
                    peer_value=value,
                    ratio=value / best[i],
                    target=target if first else "",
                    met=best[i] < bound if first and bound else None,
                )
            )
    return results


def _c_loops(
    library: ctypes.CDLL,
    codec: HandCodec,
    command: HandCommand,
    state: HandState,
    answer: bytes,
    rows: NDArray[np.float64],
    factors: NDArray[np.float64],
) -> list[Callable[[int], object]]:
    """The C functions, checked against ours first."""
    out = np.zeros(1234, np.uint8)
    library.encode(_pointer(rows), _pointer(factors), 1, 1, _pointer(out))
    assert out.tobytes() == codec.encode(command, True)
    per_count = np.array(
        [
            [1 / s.factor(j.gear_ratio) for s in (units.POSITION, units.VELOCITY, units.TORQUE)]
            for j in JOINTS
        ]
    )
    motors, tail = np.zeros((7, 8)), np.zeros(10)
    pressures, heat = np.zeros((9, 12)), np.zeros((9, 12))
    data = np.frombuffer(answer, np.uint8).copy()
    arrays = (data, per_count, motors, pressures, heat, tail)
    assert library.decode(*map(_pointer, arrays)) == 16
    decoded = codec.decode(answer, 0.0)
    np.testing.assert_allclose(motors[:, 0], decoded.q, rtol=1e-12)
    np.testing.assert_array_equal(pressures, state.pressure)
    assert library.crc_words(_pointer(data[2:]), 316) == crc32_words(answer[2:-4])
    words = np.frombuffer(answer[2:-4], np.uint8).copy()

    def decode_many(n: int) -> None:
        if library.decode_many(n, *map(_pointer, arrays)) != 16 * n:
            raise AssertionError("packets that were right are not")

    return [
        lambda n: library.encode_many(n, _pointer(rows), _pointer(factors), _pointer(out)),
        decode_many,
        lambda n: library.crc_many(n, _pointer(words), 316),
        lambda n: library.crc_many(n, _pointer(words), 4),
    ]
