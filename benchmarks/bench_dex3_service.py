"""Two simulated Dex3-1 at 1000 Hz in one process: rate, jitter, processor time; and the encoder.

``dexkit serve sim-dex3 --side both`` in a process of its own, a subscriber here. The peer of the
jitter is a loop that keeps the same deadlines and does nothing else, run afterwards; that of the
processor time the simulation without a service; that of the encoder the message codec of
:mod:`dexkit.messages`, which gets a message that is already filled.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
import timeit
from pathlib import Path

import numpy as np

from benchmarks import Result
from dexkit.clock import Rate
from dexkit.dds import DdsNode, Qos
from dexkit.emulators.sim_dex3 import SimDex3
from dexkit.errors import DexkitError
from dexkit.hand import Floats, HandCommand, Side
from dexkit.messages import message_type
from dexkit.models import DEX3_1, dialect
from dexkit.service.finger_state import FingerStateEncoder
from dexkit.service.realtime import precise_timers, real_time

_DEX3 = dialect("dex3")
_WARM_UP = 1.0
_SECONDS = 5.0


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _lateness(times_ns: list[int]) -> Floats:
    """How far each pause between samples is from the period, ms."""
    return np.abs(np.diff(np.array(times_ns)) / 1e6 - 1e3 / DEX3_1.state_rate)


def _bare_loop() -> list[int]:
    times = []

    def run() -> None:
        precise_timers()
        rate = Rate(DEX3_1.state_rate)
        for _ in range(round(2.0 * DEX3_1.state_rate)):
            rate.wait()
            times.append(time.time_ns())

    with real_time():  # as the service asks for by default
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
    return times


def _simulation_share() -> float:
    """Percent of a core that two simulated hands need at their rate, without a service."""
    hands = [SimDex3(side) for side in Side]
    brake = HandCommand.brake(hands[0].spec.n_joints)
    for hand in hands:
        hand.open()
    rate = Rate(DEX3_1.state_rate)
    spent = 0.0
    count = 1000
    for _ in range(count):
        rate.wait()
        began = time.thread_time()
        for hand in hands:
            hand.exchange(brake)
        spent += time.thread_time() - began
    return 100 * spent / count * DEX3_1.state_rate


def _service() -> list[Result]:
    domain = random.randrange(201, 230)
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "dexkit", "serve", "sim-dex3", "--quiet"),
            *("--side", "both", "--domain", str(domain)),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        if not process.stdout.readline().startswith("ready: "):
            raise DexkitError(f"the service did not start: {process.communicate()[1].strip()}")
        with DdsNode(domain) as node:
            keep = Qos("best_effort", depth=20_000)
            readers = [
                node.reader(_DEX3.topics(side)[1], _DEX3.state_type, qos=keep) for side in Side
            ]
            time.sleep(_WARM_UP)
            for reader in readers:
                reader.take()
            began = time.monotonic(), _processor_seconds(process.pid)
            time.sleep(_SECONDS)
            spent = _processor_seconds(process.pid) - began[1]
            elapsed = time.monotonic() - began[0]
            times = [[s.source_timestamp_ns for s in reader.take()] for reader in readers]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(15)
    rate = min(1e9 * (len(t) - 1) / (t[-1] - t[0]) for t in times)
    late = max(float(np.percentile(_lateness(t), 99)) for t in times)
    bare = _bare_loop()
    peer_late = float(np.percentile(_lateness(bare), 99))
    peer_rate = 1e9 * (len(bare) - 1) / (bare[-1] - bare[0])
    load = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    return [
        Result(
            name="states a second, the slower of two Dex3-1 in one process",
            value=rate,
            unit="Hz",
            peer="bare deadline loop",
            peer_value=peer_rate,
            ratio=rate / peer_rate,
            target="> 990 Hz",
            met=rate > 990.0,
            note=load,
        ),
        Result(
            name="pause between states, p99 off its millisecond, the worse of two Dex3-1",
            value=late,
            unit="ms",
            peer="bare deadline loop",
            peer_value=peer_late,
            ratio=peer_late / late,
            target="< 1 ms",
            met=late < 1.0,
        ),
        Result(
            name="processor time of the process, two Dex3-1 and their simulation",
            value=100 * spent / elapsed,
            unit="% of a core",
            peer="the simulation alone",
            peer_value=(alone := _simulation_share()),
            ratio=alone / (100 * spent / elapsed),
            target="< 100 %",
            met=spent < elapsed,
        ),
    ]


def _encoder() -> list[Result]:
    hand = SimDex3(Side.LEFT)
    hand.open()
    state = hand.exchange(HandCommand.brake(hand.spec.n_joints))
    encoder = FingerStateEncoder(hand.spec)
    kind = message_type(_DEX3.state_type)
    fault = (0,) * hand.spec.n_joints
    message = kind.decode(encoder.encode(state, fault))

    def best(call: object) -> float:
        return 1e3 * min(timeit.repeat(call, number=1000, repeat=7))  # type: ignore[arg-type]

    ours = best(lambda: encoder.encode(state, fault))
    theirs = best(lambda: kind.encode(message))
    return [
        Result(
            name="a hand's state to the bytes of a HandState_",
            value=ours,
            unit="µs",
            peer="codec, of a message already filled",
            peer_value=theirs,
            ratio=theirs / ours,
        )
    ]


def run() -> list[Result]:
    return _encoder() + _service()
