"""Measure publish jitter at 500 Hz and the latency from a command to the serial line.

Two emulated EZGrippers, each in its own process, served by two more processes through the real
driver. The emulators stand in for hardware with processors of its own, so they run at a lower
priority than the services. It is measured with real-time priority where this user may have it,
as the service asks for by default, and without. Delays are taken by a subscriber, from the
source timestamps of the samples: how long after its deadline each was written. The peer, a loop
that does nothing but keep the same deadlines, runs at the same time with the same priority, so
that both see the same machine.

For latency a tap sits between a service and its gripper and notes when the bytes of each goal
arrive. The peer is one period: a command that comes while an exchange is under way waits for it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import select
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import Result
from dexkit.child_processes import Tool
from dexkit.clock import Rate
from dexkit.dds import DdsNode, Qos
from dexkit.drivers.ezgripper import EZGripper
from dexkit.emulators.mx64 import EmulatedProcess, emulated_ezgripper
from dexkit.hand import Side
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_
from dexkit.models import DEX1_1, dialect
from dexkit.service.realtime import precise_timers
from dexkit.service.realtime import real_time as real_time_priority
from dexkit.wire.dynamixel import Instruction, PacketParser

_GO = dialect("unitree_go")
_PERIOD = 1.0 / DEX1_1.state_rate
_WARM_UP = 1.0
_SECONDS = 6.0
_COMMANDS = 150
_TARGET = 0.5  # ms
_ZERO = "zero=1510"  # of the emulated gripper
_GOAL_SIZE = 4  # bytes of Goal Position, the last of what the driver writes

_spawn = multiprocessing.get_context("spawn")


@contextlib.contextmanager
def serving(side: Side, device: str, domain: int, *, real_time: bool) -> Iterator[None]:
    with Tool(
        *("serve", "ezgripper", "--quiet", "--side", side, "--device", device, "--set", _ZERO),
        *("--domain", str(domain), "--real-time" if real_time else "--no-real-time"),
    ) as tool:
        tool.wait_ready(threading.Event())
        yield


def bare_loop(seconds: float, real_time: bool, out: Connection) -> None:
    """Deadlines and nothing else; sends its wall-clock times."""
    precise_timers()
    times = []
    with real_time_priority() if real_time else contextlib.nullcontext():
        rate = Rate(1 / _PERIOD, spin=150e-6)
        for _ in range(round(seconds / _PERIOD)):
            rate.wait()
            times.append(time.time_ns())
    out.send(times)


def delays(times: list[int], slope: float) -> tuple[NDArray[np.float64], int]:
    """(how long after its deadline each came, ms; periods without a sample).

    The deadlines are the grid of 2 ms on which most samples lie; being early is impossible.

    :param slope: wall-clock seconds in a monotonic second.
    """
    period = 1e3 * _PERIOD
    t = (np.array(times) - times[0]) / 1e6 / slope
    phase = t % period
    counts, edges = np.histogram(phase, bins=200, range=(0.0, period))
    t -= edges[int(np.argmax(counts))] - 0.02 * period
    k = np.floor(t / period)
    return t - k * period - 0.02 * period, int(k[-1] - k[0] + 1 - len(np.unique(k)))


def jitter(domain: int, devices: dict[Side, str], *, real_time: bool) -> list[Result]:
    with contextlib.ExitStack() as stack:
        for side, device in devices.items():
            stack.enter_context(serving(side, device, domain, real_time=real_time))
        node = stack.enter_context(DdsNode(domain))
        keep = Qos("best_effort", depth=10_000)
        readers = [node.reader(_GO.topics(s)[1], _GO.state_type, qos=keep) for s in devices]
        time.sleep(_WARM_UP)
        for reader in readers:
            reader.take()
        ours, theirs = _spawn.Pipe(duplex=False)
        bare = _spawn.Process(target=bare_loop, args=(_SECONDS, real_time, theirs))
        began = time.time(), time.monotonic()
        bare.start()
        bare_times = ours.recv()
        slope = (time.time() - began[0]) / (time.monotonic() - began[1])
        bare.join()
        times = [[s.source_timestamp_ns for s in r.take()][-len(bare_times) :] for r in readers]
    bare_late, bare_missed = delays(bare_times, slope)
    late, missed = zip(*(delays(t, slope) for t in times), strict=True)
    priority = "real-time" if real_time else "ordinary priority"
    results = []
    for q in (50.0, 99.0, 99.9):
        value = max(float(np.percentile(x, q)) for x in late)
        peer = float(np.percentile(bare_late, q))
        is_target = q == 99.0
        results.append(
            Result(
                name=f"publish delay p{q:g}, the worse of two grippers, {priority}",
                value=value,
                unit="ms",
                peer="bare deadline loop beside it",
                peer_value=peer,
                ratio=peer / value,
                target=f"< {_TARGET} ms" if is_target else "",
                met=value < _TARGET if is_target else None,
                note=f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}" if is_target else "",
            )
        )
    per_thousand = [1e3 * m / len(t) for m, t in zip(missed, times, strict=True)]
    bare_rate = 1e3 * bare_missed / len(bare_times)
    results.append(
        Result(
            name=f"periods without a sample, the worse of two grippers, {priority}",
            value=max(per_thousand),
            unit="per 1000",
            peer="bare deadline loop beside it",
            peer_value=bare_rate,
            ratio=(bare_rate + 1) / (max(per_thousand) + 1),
        )
    )
    return results


def tap(device: str, link: str, pipe: Connection) -> None:
    """Pass bytes both ways and keep the time of each piece from the driver."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.symlink(os.ttyname(slave), link)
    gripper = os.open(device, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(gripper)
    pieces: list[tuple[int, bytes]] = []
    pipe.send("ready")
    while True:
        ready, _, _ = select.select([master, gripper, pipe.fileno()], [], [])
        if master in ready:
            data = os.read(master, 4096)
            pieces.append((time.time_ns(), data))
            os.write(gripper, data)
        if gripper in ready:
            os.write(master, os.read(gripper, 4096))
        if pipe.fileno() in ready:
            pipe.recv()
            pipe.send(pieces)
            return


def goals(pieces: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """(time, goal position) of each packet that carries another goal than the one before."""
    parser = PacketParser()
    found: list[tuple[int, bytes]] = []
    for stamp, data in pieces:
        for packet in parser.feed(data):
            if packet.instruction == Instruction.SYNC_WRITE:
                goal = packet.params[-_GOAL_SIZE:]
                if not found or found[-1][1] != goal:
                    found.append((stamp, goal))
    return found


def latency(domain: int, device: str) -> list[Result]:
    cmd_topic, state_topic = _GO.topics(Side.LEFT)
    chance = random.Random(1)
    with tempfile.TemporaryDirectory(prefix="dexkit-bench-") as folder:
        link = str(Path(folder) / "tap")
        ours, theirs = _spawn.Pipe()
        tapping = _spawn.Process(target=tap, args=(device, link, theirs), daemon=True)
        tapping.start()
        ours.recv()
        with serving(Side.LEFT, link, domain, real_time=True), DdsNode(domain) as node:
            writer = node.writer(cmd_topic, _GO.cmd_type)
            states = node.reader(state_topic, _GO.state_type)
            writer.wait_matched(5)
            states.wait(5)
            sent = []
            for i in range(_COMMANDS):
                # small steps to and fro, at moments that know nothing of the exchanges
                message = MotorCmds_([MotorCmd_(q=2.7 + 0.05 * (i % 2), kp=5.0, kd=0.05)])
                sent.append(time.time_ns())
                writer.write(message)
                time.sleep(chance.uniform(0.02, 0.04))
            ours.send("stop")
            seen = goals(ours.recv())
        tapping.join(5)
    sent_ns = np.array(sent)
    taken: dict[int, float] = {}
    for stamp, _ in seen:
        i = int(np.searchsorted(sent_ns, stamp)) - 1
        if i >= 0:
            taken.setdefault(i, (stamp - sent[i]) / 1e6)
    ms = np.array(list(taken.values())[10:])  # the first ones switch the motor on
    bound = 1e3 / EZGripper(device).spec.io_rate
    return [
        Result(
            name=f"DDS command to serial byte, p{q:g}",
            value=float(np.percentile(ms, q)),
            unit="ms",
            peer="one period of the exchanges",
            peer_value=bound,
            ratio=bound / float(np.percentile(ms, q)),
            note=f"{len(ms)} of {_COMMANDS} commands, a tap on the line" if q == 50 else "",
        )
        for q in (50, 99)
    ]


@contextlib.contextmanager
def gripper() -> Iterator[str]:
    """Path of an emulated gripper in a process that gives way to those measured."""
    with emulated_ezgripper(process=True, check_baudrate=False) as emulated:
        assert isinstance(emulated, EmulatedProcess)
        for thread in Path(f"/proc/{emulated.process.pid}/task").iterdir():
            os.setpriority(os.PRIO_PROCESS, int(thread.name), 5)
        yield emulated.path


def run() -> list[Result]:
    domain = random.randrange(201, 230)
    with gripper() as left, gripper() as right:
        devices = {Side.LEFT: left, Side.RIGHT: right}
        results = []
        with real_time_priority() as permitted:
            pass
        if permitted:
            results = jitter(domain, devices, real_time=True)
        results += jitter(domain, devices, real_time=False)
    with gripper() as left:
        return results + latency(domain, left)
