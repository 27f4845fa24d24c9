"""Measure the latency that the bridge adds to a message.

Two processes stand between this one's two domains: ``dexkit bridge``, and as the peer a bare echo
that does nothing but write the bytes of each sample again, with the same readers, writers and
thread. Both are asked in turns with the same message, so that they see the same machine; each
figure is the time from the write here to the arrival here, two hops of DDS included.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks import Result
from dexkit.child_processes import Tool
from dexkit.dds import DdsNode, Writer
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.messages import encode
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from dexkit.models import dialect
from dexkit.service.realtime import precise_timers, prepare_process, real_time

_ACTUATOR, _GO = dialect("unitree_actuator"), dialect("unitree_go")
_ROUNDS = 600
_GAP = 0.004  # seconds between two questions
_PATIENCE = 1.0  # seconds for an answer
_ECHO = "rt/bench/echo"

_spawn = multiprocessing.get_context("spawn")


def echo(source: int, target: int, type_name: str, topic: str) -> None:
    """The peer: read, write, nothing else."""
    prepare_process()
    with real_time(), DdsNode(source) as near, DdsNode(target) as far:
        arrived = threading.Event()
        writer = far.writer(f"{topic}/out", type_name)
        reader = near.reader(f"{topic}/in", type_name, on_data=arrived.set)
        precise_timers()
        while True:
            arrived.wait()
            arrived.clear()
            for sample in reader.take():
                writer.write_raw(sample.data)


@contextlib.contextmanager
def echoing(source: int, target: int, type_name: str, topic: str) -> Iterator[None]:
    process = _spawn.Process(target=echo, args=(source, target, type_name, topic), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


@contextlib.contextmanager
def bridging(near: int, far: int) -> Iterator[None]:
    # this process is client and gripper at once, which looks like a bridge back: --force
    with Tool(
        *("bridge", _ACTUATOR.name, _GO.name, "--force"),
        *("--domain", str(near), "--to-domain", str(far)),
    ) as tool:
        tool.wait_ready(threading.Event())
        yield


@dataclass
class Route:
    """A message that goes out here and comes back there."""

    ask: Callable[[], object]
    answered: threading.Event
    arrival: list[float]

    def time(self) -> float:
        """Milliseconds from question to answer; NaN when none came."""
        self.answered.clear()
        self.arrival.clear()
        asked = time.perf_counter()
        self.ask()
        if not self.answered.wait(_PATIENCE):
            return float("nan")
        return 1e3 * (self.arrival[0] - asked)


def route(node: DdsNode, topic: str, type_name: str, writers: list[Writer], data: bytes) -> Route:
    answered, arrival = threading.Event(), list[float]()

    def arrive() -> None:
        arrival.append(time.perf_counter())
        reader.take()
        answered.set()

    reader = node.reader(topic, type_name, on_data=arrive)

    def ask() -> None:
        for writer in writers:
            writer.write_raw(data)

    for writer in writers:
        if not writer.wait_matched(10):
            raise DexkitError(f"no process reads {writer.topic}")
    if not reader.wait_matched(10):
        raise DexkitError(f"no process writes {topic}")
    return Route(ask, answered, arrival)


def compare(what: str, ours: Route, peer: Route) -> list[Result]:
    chance = random.Random(1)
    times: tuple[list[float], list[float]] = ([], [])
    for i in range(_ROUNDS):
        for which in (0, 1) if i % 2 else (1, 0):
            times[which].append((ours, peer)[which].time())
            time.sleep(chance.uniform(0.5, 1.5) * _GAP)
    bridge, bare = (np.array(t[20:]) for t in times)
    lost = int(np.isnan(bridge).sum())
    results = []
    for q in (50, 99):
        value, other = (float(np.nanpercentile(t, q)) for t in (bridge, bare))
        results.append(
            Result(
                name=f"{what}, p{q}",
                value=value,
                unit="ms",
                peer="bare echo of the same bytes",
                peer_value=other,
                ratio=other / value,
                target="adds < 1 ms" if q == 50 else "",
                met=value - other < 1.0 if q == 50 else None,
                note=f"adds {value - other:.3f} ms"
                + (
                    f"; {len(bridge)} messages, {lost} lost, {os.cpu_count()} cores, "
                    f"load {os.getloadavg()[0]:.1f}"
                    if q == 50
                    else ""
                ),
            )
        )
    return results


def run() -> list[Result]:
    near, far = random.sample(range(201, 230), 2)
    cmd, state = _ACTUATOR.cmd_type, _ACTUATOR.state_type
    command = encode(MotorCmds_([MotorCmd_(q=q, kp=5.0, kd=0.05) for q in (2.7, 1.3)]))
    one = encode(MotorStates_([MotorState_(q=2.7)]))
    with (
        bridging(near, far),
        echoing(near, far, cmd, f"{_ECHO}/cmd"),
        echoing(far, near, state, f"{_ECHO}/state"),
        DdsNode(near) as client,
        DdsNode(far) as gripper,
    ):
        legacy = client.writer(_ACTUATOR.cmd_topic, cmd)
        echoed = client.writer(f"{_ECHO}/cmd/in", cmd)
        # the bridge writes right after left: the right's arrival is the end of it
        results = compare(
            "legacy command to the second gripper's topic",
            route(gripper, _GO.topics(Side.RIGHT)[0], cmd, [legacy], command),
            route(gripper, f"{_ECHO}/cmd/out", cmd, [echoed], command),
        )
        states = [gripper.writer(_GO.topics(side)[1], state) for side in Side]
        back = gripper.writer(f"{_ECHO}/state/in", state)
        results += compare(
            "states of two grippers to the legacy topic",
            route(client, _ACTUATOR.state_topic, state, states, one),
            route(client, f"{_ECHO}/state/out", state, [back], one),
        )
    return results
