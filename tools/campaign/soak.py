"""A service, a recorder, a bridge and a client at full rate, for as long as the campaign lasts.

Resident memory, descriptors and threads of each are sampled; a slope above the stated bound is a
finding. The first part of the run, in which everything is loaded for the first time, does not
count.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import time
from dataclasses import dataclass, field
from functools import partial

from dexkit.models import DEX1_1
from tools.campaign.case import Batch, Case, Lane
from tools.campaign.devices import Bench, command
from tools.campaign.process import Program
from tools.campaign.programs import Client
from tools.campaign.waiting import WaitTimeout

__all__ = ["GROWTH", "WatchedProcess", "cases", "slope"]

GROWTH = 4.0
"""MiB an hour that a program may grow; a slope below the noise of a short run does not count."""
NOISE = 1.5
"""MiB of growth within a run that are taken for noise of the allocator."""
WARM_UP = 0.25
"""Part of a run, at most five minutes, that does not count."""
_PERIOD = 10.0


@dataclass
class WatchedProcess:
    """One process."""

    name: str
    pid: int
    times: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    files: list[int] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)

    def measure(self, now: float) -> None:
        """Take one sample; none when it is gone."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            with open(f"/proc/{self.pid}/statm") as file:
                memory = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
            files = len(os.listdir(f"/proc/{self.pid}/fd"))
            threads = len(os.listdir(f"/proc/{self.pid}/task"))
            self.times.append(now)
            self.memory.append(memory)
            self.files.append(files)
            self.threads.append(threads)

    def problems(self) -> list[tuple[str, str]]:
        """What grows: kind and figures."""
        first = next(
            (i for i, t in enumerate(self.times) if t >= min(300.0, WARM_UP * self.times[-1])), 0
        )
        times, memory = self.times[first:], self.memory[first:]
        if len(times) < 3:
            return []
        found = []
        hourly = slope(times, memory) * 3600
        grown = hourly * (times[-1] - times[0]) / 3600
        if hourly > GROWTH and grown > NOISE:
            found.append(
                ("memory grows", f"{hourly:.1f} MiB an hour, {memory[0]:.1f} to {memory[-1]:.1f}")
            )
        for what, values in (("descriptors", self.files), ("threads", self.threads)):
            third = (len(values) - first) // 3
            if min(values[-third:]) > max(values[first : first + third]):
                found.append((f"{what} grow", f"{values[first]} to {values[-1]}"))
        return found


def slope(x: list[float], y: list[float]) -> float:
    """Least squares, per unit of ``x``."""
    n = len(x)
    mx, my = sum(x) / n, sum(y) / n
    spread = sum((a - mx) ** 2 for a in x)
    return sum((a - mx) * (b - my) for a, b in zip(x, y, strict=True)) / spread if spread else 0.0


class SoakCase(Case):
    """The whole chain, for long."""

    name = "soak"
    what = "service, recorder, bridge and client at full rate"
    unit = "seconds of soak"
    lane = Lane.LONG
    limit = 300.0

    def run(self, batch: Batch) -> None:
        logging.disable()
        domain, beside = str(batch.domain), str(batch.domain + 1)
        target, _, source = DEX1_1.dialects
        commands = {
            "serve": ["serve", "sim-dex1", "--side", "left", "--domain", domain],
            "record": ["record", str(batch.scratch / "soak.mcap"), "--domain", domain],
            "bridge": ["bridge", source.name, target.name, "--side",
                       "left", "--domain", beside, "--to-domain", domain],
        }  # fmt: skip
        programs: dict[str, Program] = {}
        client: Client | None = None
        try:
            for name, words in commands.items():
                programs[name] = Program(batch, ["dexkit", *words])
                programs[name].wait_for("ready:")
            client = Client(batch.domain + 1, source, partial(command, source))
            client.goal = Bench.low
            client.wait_states()
            watched = [WatchedProcess(name, p.process.pid) for name, p in programs.items()]
            began = looked = time.monotonic()
            while batch.left > 0 and all(p.running for p in programs.values()):
                time.sleep(0.5)
                now = time.monotonic()
                if int(now - began) % 4 == 0:
                    client.goal = Bench.low + Bench.high - client.goal
                if now - looked >= (1.0 if batch.sample else _PERIOD):
                    looked = now
                    for one in watched:
                        one.measure(now - began)
            batch.units += int(time.monotonic() - began)
            for one in watched:
                for kind, text in one.problems():
                    batch.found(kind, one.name, text)
                if one.memory:
                    batch.notes.append(
                        f"{one.name} {one.memory[0]:.0f} to {one.memory[-1]:.0f} MiB, "
                        f"{slope(one.times, one.memory) * 3600:+.1f} an hour"
                    )
            client.wait_states()
        except WaitTimeout as error:
            batch.found("not working", "soak", str(error))
        finally:
            if client is not None:
                client.close()
            for name, program in reversed(programs.items()):
                if not program.running:
                    code = program.process.returncode
                    batch.found("ended", name, f"{code}: {program.output[-2000:]}")
                program.signal(signal.SIGTERM)
                if program.wait() is None:
                    batch.found("does not end", name, program.output[-2000:])
                program.check_output(batch)
                program.end()


def cases() -> list[Case]:
    """The one case."""
    return [SoakCase()]
