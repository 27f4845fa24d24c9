"""Faults that are there on purpose: the campaign must find each of them."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from dexkit.errors import WireError
from tools.campaign.case import Batch, Case, Lane, Skip
from tools.campaign.fuzz import Difference, FuzzCase, Target
from tools.campaign.mutate import mutator
from tools.campaign.process import Program, traceback_in
from tools.campaign.soak import WatchedProcess

CORPUS = [b"head" + bytes(12)]


def _fuzz(name: str, run: object, hang: float = 2.0) -> FuzzCase:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        return Target(mutator(CORPUS, rng), run)  # type: ignore[arg-type]

    return FuzzCase(name, "a planted fault", prepare, hang=hang)


def _typed(data: bytes) -> None:
    if data[:4] != b"head":
        raise WireError("no head")


def _value_error(data: bytes) -> None:
    _typed(data)
    if len(data) > 7 and data[7] == 0x80:
        int("x")


def _differs(data: bytes) -> None:
    if data[-1:] == b"\xff":
        raise Difference("last byte")


def _for_ever(data: bytes) -> None:
    while data[4:5] == b"\xff":
        pass


def _greedy(data: bytes) -> None:
    if data[4:5] == b"\x01":
        bytearray(1 << 34)


def _crash(data: bytes) -> None:
    if data[5:6] == b"\xff":
        os.kill(os.getpid(), signal.SIGSEGV)


CLEAN = _fuzz("clean", _typed)
BROKEN = _fuzz("broken", _value_error)
DIFFERS = _fuzz("differs", _differs)
FOR_EVER = _fuzz("for-ever", _for_ever, hang=0.2)
GREEDY = _fuzz("greedy", _greedy)
CRASH = _fuzz("crash", _crash)


class _Live(Case):
    what = "a planted fault"
    unit = "runs"


class LeavesChild(_Live):
    """A program that ends and leaves a child running."""

    name = "leaves-child"

    def run(self, batch: Batch) -> None:
        program = Program(batch, ["tests.campaign_programs", "child"])
        program.wait_for("ready:")
        program.signal(signal.SIGTERM)
        program.wait()
        left = program.left_behind(timeout=0.2)
        if left:
            batch.found("child left behind", self.name, "\n".join(left))
        batch.units += 1


class LeavesUnseen(_Live):
    """A batch after which a process runs that nobody looked for."""

    name = "leaves-unseen"

    def run(self, batch: Batch) -> None:
        subprocess.Popen(["sleep", "60"], start_new_session=True)
        batch.units += 1


class DiesLoudly(_Live):
    """A program that answers SIGTERM with a traceback."""

    name = "dies-loudly"

    def run(self, batch: Batch) -> None:
        program = Program(batch, ["tests.campaign_programs", "traceback"])
        program.wait_for("ready:")
        program.signal(signal.SIGTERM)
        program.wait()
        told = traceback_in(program.output)
        if told is not None:
            batch.found("traceback", *told)
        batch.units += 1


class Leaks(_Live):
    """A program that grows by more each second than is allowed in an hour."""

    name = "leaks"

    def run(self, batch: Batch) -> None:
        program = Program(batch, ["tests.campaign_programs", "leak"])
        program.wait_for("ready:")
        watched = WatchedProcess("leaky", program.process.pid)
        for number in range(12):
            time.sleep(0.05)
            watched.measure(0.05 * number)
        program.end()
        for kind, text in watched.problems():
            batch.found(kind, self.name, text)
        batch.units += 1


class Hangs(_Live):
    """A batch that does not come to its end."""

    name = "hangs"
    limit = 0.0

    def run(self, batch: Batch) -> None:
        time.sleep(1000)


class Fails(_Live):
    """The campaign's own fault."""

    name = "fails"

    def run(self, batch: Batch) -> None:
        raise RuntimeError("the campaign is wrong here")


class Skipped(_Live):
    """Cannot be run here."""

    name = "skipped"

    def run(self, batch: Batch) -> None:
        raise Skip("not on this machine")


class Slow(_Live):
    """Clean, and runs programs for long."""

    name = "slow"
    lane = Lane.LIVE

    def run(self, batch: Batch) -> None:
        program = Program(batch, ["tests.campaign_programs", "child"])
        program.wait_for("ready:")
        (batch.scratch / "here").touch()
        print(f"scratch {batch.scratch}", file=sys.stderr, flush=True)
        time.sleep(1000)
