"""How a parser is fuzzed: the loop, its watchdog, and the memory limit."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import resource
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from dexkit.errors import DexkitError
from tools.campaign.case import Batch, Case, Lane

__all__ = ["Difference", "FuzzCase", "Hang", "Inputs", "SeededCase", "Target"]

HANG = 2.0
"""Seconds of processor time that one input may take; wall time would blame a busy machine."""
_HANGS = 3
"""Inputs of a batch that may take too long before it is given up."""
MEMORY = 2 << 30
"""Bytes of address space that a fuzzer may have on top of what it had before."""


class Difference(Exception):
    """Two readings of one input do not agree."""


class Hang(BaseException):
    """An input takes too long; not an Exception, so that no handler of the code under test catches
    it.
    """


@dataclass
class Target:
    """One parser, ready to be fed.

    :param make: the next input.
    :param run: parses one; raises what is a finding, or one of ``allowed``.
    :param allowed: errors that reject an invalid input.
    """

    make: Callable[[], Any]
    run: Callable[[Any], object]
    allowed: tuple[type[BaseException], ...] = (DexkitError,)
    close: Callable[[], object] = lambda: None


Prepare = Callable[[random.Random, Path], Target]


class FuzzCase(Case):
    """A parser, fed for some seconds.

    :param prepare: makes the target, given the source of chance and a scratch folder.
    :param hang: seconds of processor time that one input may take.
    """

    unit = "inputs"
    lane = Lane.COMPUTE
    limit = 120.0

    def __init__(self, name: str, what: str, prepare: Prepare, *, hang: float = HANG) -> None:
        self.name = f"fuzz:{name}"
        self.hang = hang
        self.what = what
        self._prepare = prepare

    def run(self, batch: Batch) -> None:  # noqa: D102
        target = self._prepare(batch.random, batch.scratch)
        end = time.monotonic() + batch.seconds
        with _limited(self.hang) as watch:
            try:
                self._feed(batch, target, end, watch)
            finally:
                target.close()

    def _feed(self, batch: Batch, target: Target, end: float, watch: _Watch) -> None:
        make, run, allowed, now = target.make, target.run, target.allowed, time.monotonic
        number, hangs, over = -1, 0, False
        while not over:
            data: Any = None
            try:
                # the loop is inside the try: entering one for each input would cost a tenth
                while not over:
                    number += 1
                    batch.index.value = watch.index = number
                    data = None
                    data = make()
                    try:
                        run(data)
                    except allowed:
                        pass
                    over = now() > end if batch.only is None else number == batch.only
            except (Exception, Hang) as error:
                watch.index = -1
                if data is None:
                    raise  # there is no input yet: it is the campaign that is wrong
                batch.failed(error, index=number, data=as_bytes(data))
                hangs += isinstance(error, Hang)
                over = hangs == _HANGS or number == batch.only
        watch.index = -1
        batch.units += number + 1

    def repeat(self, batch: Batch, data: bytes) -> None:
        """Try one input; text targets take UTF-8."""
        target = self._prepare(batch.random, batch.scratch)
        given: Any = data
        if isinstance(target.make(), str):
            given = data.decode(errors="surrogatepass")
        with _limited(self.hang) as watch:
            try:
                watch.index = 0
                target.run(given)
            except target.allowed:
                pass
            except (Exception, Hang) as error:
                watch.index = -1
                batch.failed(error, data=data)
            finally:
                watch.index = -1
                target.close()
        batch.units += 1


_EDGES: tuple[int, ...] = (
    *range(6), 127, 128, 255, 256, 512, 660, 661, 1016, 1017, 1024, 32767, 32768, 65534, 65535,
    2**31 - 1, 2**31, 2**32 - 1,
)  # fmt: skip


class Inputs:
    """Random inputs to a device or driver that keeps its state between them.

    :ivar random: the only source of chance.
    :ivar number: inputs so far.
    :ivar data: the last input.
    """

    def __init__(self, rng: random.Random, watch: _Watch | None = None) -> None:
        self.random, self.number, self.data = rng, 0, b""
        self._watch = watch

    def begin(self, data: bytes = b"") -> None:
        """What follows is the next input: whatever it raises is a finding."""
        self.data = data
        self.number += 1
        if self._watch is not None:
            self._watch.index = self.number

    def number_of(self, size: int) -> int:
        """An unsigned integer of ``size`` bytes, half of the time at a limit of something."""
        most = 1 << 8 * size
        if self.random.random() < 0.5:
            return self.random.choice(_EDGES) % most
        return self.random.randrange(most)

    def spoil(self, data: bytes) -> bytes:
        """``data``, in one of five inputs damaged, cut, doubled, or behind noise."""
        rnd = self.random
        chance = rnd.random()
        if chance < 0.8 or not data:
            return data
        if chance < 0.86:
            spoilt = bytearray(data)
            spoilt[rnd.randrange(len(spoilt))] ^= 1 << rnd.randrange(8)
            return bytes(spoilt)
        if chance < 0.9:
            return data[: rnd.randrange(len(data))]
        if chance < 0.94:
            return data + data
        if chance < 0.98:
            return rnd.randbytes(rnd.randrange(40)) + data
        return rnd.randbytes(rnd.choice((1, 10, 300, 4096)))


class SeededCase(Case):
    """A fuzzer whose inputs depend on what came before: a batch is repeated as a whole.

    :param feed: makes and tries so many inputs, with :meth:`Inputs.begin` before each.
    :param size: inputs in a batch; some half a second of them.
    """

    unit = "inputs"
    lane = Lane.COMPUTE
    limit = 120.0

    def __init__(
        self, name: str, what: str, feed: Callable[[Inputs, int], None], *, size: int
    ) -> None:
        self.name = f"fuzz:{name}"
        self.what = what
        self.size = size
        self._feed = feed

    def run(self, batch: Batch) -> None:  # noqa: D102
        size = max(1, self.size // 20) if batch.sample else self.size
        with _limited(HANG) as watch:
            inputs = Inputs(batch.random, watch)
            try:
                self._feed(inputs, size)
            except (Exception, Hang) as error:
                watch.index = -1
                batch.failed(error, index=inputs.number, data=inputs.data)
            watch.index = -1
        batch.units += size


def as_bytes(data: Any) -> bytes:
    """An input as it is kept."""
    if isinstance(data, str):
        return data.encode(errors="surrogatepass")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    return b"".join(data) if isinstance(data, list) else repr(data).encode()


class _Watch:
    """Interrupts an input that takes ``limit`` seconds of processor time."""

    def __init__(self, limit: float) -> None:
        self.index = -1
        self._limit = limit
        self._last = (-1, 0)

    def tick(self, signum: int, frame: FrameType | None) -> None:
        """Half of that time has passed."""
        index, ticks = self._last
        if self.index < 0 or self.index != index:
            self._last = (self.index, 0)
            return
        self._last = (index, ticks + 1)
        if ticks + 1 >= 2:
            self._last = (-1, 0)
            raise Hang(f"more than {self._limit:g} s of processor time for one input")


@contextlib.contextmanager
def _limited(hang: float) -> Iterator[_Watch]:
    watch = _Watch(hang)
    quiet = logging.root.manager.disable
    before = signal.signal(signal.SIGPROF, watch.tick)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, hard))
    signal.setitimer(signal.ITIMER_PROF, hang / 2, hang / 2)
    logging.disable()
    try:
        yield watch
    finally:
        logging.disable(quiet)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
