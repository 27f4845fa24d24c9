"""The Dex1-1 on its serial line: exchanges a second, and the codec against C (m4010.c).

The motors are emulated in a process of their own, with the time that bytes take at 6 Mbaud and
nothing else: what the real motor and its adapter take on top is not known. Two motors share a line,
and one process drives both, as one service does.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import tempfile
import threading
import time
import timeit
from collections.abc import Callable

from benchmarks import Result
from benchmarks.native import compiled
from dexkit.drivers.dex1_serial import Dex1Serial, Dex1Settings
from dexkit.emulators.m4010 import Dex1Process
from dexkit.hand import HandCommand, Side
from dexkit.wire import m4010
from dexkit.wire.m4010 import MotorCmd, MotorData
from dexkit.wire.ris import NUDGE

_SECONDS = 3.0
_WANTED = 500.0
_C_PEER = "C, table CRC (-O2)"
_LINE_TIME = (m4010.COMMAND.size + m4010.DATA.size) * 10 / m4010.BAUD_RATE


def _rates(hands: list[Dex1Serial]) -> tuple[list[float], float]:
    """Exchanges a second of each, all at once; processor seconds of an exchange."""
    counts = [0] * len(hands)
    used = [0.0] * len(hands)
    start = time.perf_counter()

    def run(i: int) -> None:
        command = HandCommand.position(2.7)
        begin = time.thread_time()
        while time.perf_counter() - start < _SECONDS:
            hands[i].exchange(command)
            counts[i] += 1
        used[i] = time.thread_time() - begin

    threads = [threading.Thread(target=run, args=(i,)) for i in range(len(hands))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [count / _SECONDS for count in counts], sum(used) / max(1, sum(counts))


def _best(*functions: Callable[[int], object]) -> list[float]:
    """Best time of one call of each, µs; short runs in turn get past a busy machine."""
    best = [math.inf] * len(functions)
    for _ in range(300):
        for i, function in enumerate(functions):
            start = time.perf_counter()
            function(100)
            best[i] = min(best[i], (time.perf_counter() - start) / 100 * 1e6)
    return best


def _codec() -> list[Result]:
    values = (0.1, 1.0, 2.7, 5.0, 0.05)  # tau, dq, q, kp, kd
    tau, dq, q, kp, kd = values
    command = MotorCmd.setpoint(1, q=q, dq=dq, tau=tau, kp=kp, kd=kd, timeout=True).pack()
    data = MotorData.measured(1, 1, q=q, dq=dq, tau=tau, temperature=30, voltage=24).pack()

    def pack() -> None:
        MotorCmd.setpoint(1, q=q, dq=dq, tau=tau, kp=kp, kd=kd, timeout=True).pack()

    def parse() -> None:
        MotorData.parse(data).joint()

    ours: list[Callable[[int], object]] = [
        lambda n: timeit.timeit(pack, number=n),
        lambda n: timeit.timeit(parse, number=n),
    ]
    with tempfile.TemporaryDirectory() as folder:
        library = compiled("m4010", folder)
        if library is None:
            best = [*_best(*ours), math.nan, math.nan]
        else:
            scales = (m4010.TORQUE, m4010.VELOCITY, m4010.POSITION, m4010.STIFFNESS, m4010.DAMPING)
            factors = (ctypes.c_double * 5)(*(s.factor(m4010.GEAR_RATIO) * NUDGE for s in scales))
            given, out = (ctypes.c_double * 5)(*values), (ctypes.c_double * 3)()
            frame = (ctypes.c_uint8 * m4010.COMMAND.size)()
            library.pack(frame, 0x91, given, factors)
            assert bytes(frame) == command
            assert library.parse(data, factors, out) == 1
            assert math.isclose(out[0], MotorData.parse(data).joint().q)
            best = _best(
                *ours,
                lambda n: library.pack_many(n, frame, given, factors),
                lambda n: library.parse_many(n, data, factors, out),
            )
    return [
        Result(
            name=name,
            value=best[i],
            unit="us",
            peer=_C_PEER,
            peer_value=best[2 + i],
            ratio=best[2 + i] / best[i],
        )
        for i, name in enumerate(("M4010: pack a command", "M4010: parse data"))
    ]


def run() -> list[Result]:
    """Measure; about 10 seconds."""
    results = []
    limit = 1 / _LINE_TIME
    with contextlib.closing(Dex1Process(["--side=both"])) as motors:
        settings = Dex1Settings(device=motors.path, timeout=0.5)
        with Dex1Serial(Side.LEFT, settings) as left, Dex1Serial(Side.RIGHT, settings) as right:
            for name, hands in (("one motor", [left]), ("two motors on a line", [left, right])):
                rates, cost = _rates(hands)
                results.append(
                    Result(
                        name=f"Dex1-1 exchanges, {name}, each",
                        value=min(rates),
                        unit="1/s",
                        peer="limit of the line at 6 Mbaud",
                        peer_value=limit / len(hands),
                        ratio=min(rates) * len(hands) / limit,
                        target="at least 500 a second",
                        met=min(rates) >= _WANTED,
                        note=f"{1e6 * cost:.0f} us of processor time each; the emulated motor and "
                        "the driver share the machine",
                    )
                )
    return results + _codec()
