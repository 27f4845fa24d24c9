"""Recorded sessions of hands, damaged: as an audit judges them, and as a replay reads them.

Half of them hold wrong numbers, lengths and times under checksums that are right, so that they
reach every check; the others are damaged as files. A finding is an error that is not dexkit's own,
a row of an audit that blames dexkit, or an input that takes too long.
"""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType

from dexkit.conformance.audit.examine import Task, examine
from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.units import Unit
from dexkit.conformance.virtual.rehearsal import rehearse
from dexkit.traces.replay.commands import read_session
from dexkit.traces.replay.machine import Guards
from dexkit.traces.replay.prepare import (
    ACCEPTABLE,
    GAINS,
    INVALID,
    JUMPS,
    LIMIT,
    ReplayOptions,
    prepare,
)
from tools.campaign.fuzz.case import Difference, FuzzCase, Target
from tools.campaign.fuzz.recordings import damage
from tools.generate_archive import Session as Generated
from tools.generate_archive import Topic, load

__all__ = ["cases"]

_HANG = 30.0
"""Seconds of processor time for one session: the checks are loaded with the first one."""
_REHEARSED = 5.0
"""Seconds of the longest plan that is rehearsed."""
_NUMBERS = (0.0, -0.0, 1e-40, 1e30, -1e30, 3.4e38, np.nan, np.inf, -np.inf, 1.0)
_TIMES = (-(10**9), -(10**6), 10**6, 10**9, 10**14)


def _spoiled(rng: random.Random, base: Generated, seconds: float) -> bytes:
    """A recording with wrong numbers, lengths and times, and right checksums."""
    begin = rng.choice((0, 1_790_000_000_000_000_000))
    topics = {}
    for name, topic in base.topics.items():
        rows = slice(0, int(np.searchsorted(topic.log, int(seconds * 1e9))))
        topics[name] = replace(
            topic,
            log=topic.log[rows] + begin,
            publish=np.maximum(topic.publish[rows] + begin, 0),
            payloads=topic.payloads[rows].copy(),
            cut={},
        )
    for topic in rng.sample(list(topics.values()), rng.randrange(1, len(topics) + 1)):
        for _ in range(rng.choice((1, 1, 3))):
            if len(topic.log):
                _spoil(rng, topic)
    if rng.random() < 0.1:
        del topics[rng.choice(list(topics))]
    kinds = (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD)
    return Generated(base.model, topics).write(rng.choice(kinds), {"robot": "r"})


def _spoil(rng: random.Random, topic: Topic) -> None:
    n, size = topic.payloads.shape
    first = rng.randrange(n)
    rows = slice(first, rng.choice((first + 1, first + 20, n)))
    kind = rng.randrange(7)
    if kind == 0:  # any bytes
        for _ in range(rng.choice((1, 4, 40))):
            topic.payloads[rows, rng.randrange(size)] = rng.randrange(256)
    elif kind == 1:  # a number, wherever it is
        at = rng.randrange(4, size - 3) // 4 * 4
        topic.payloads[rows, at : at + 4] = np.array([rng.choice(_NUMBERS)], "<f4").view(np.uint8)
    elif kind == 2:
        for row in range(first, min(n, first + rng.choice((1, 30)))):
            data = topic.payloads[row].tobytes()
            topic.cut[row] = data[: rng.randrange(size)] or b"\0"
    elif kind == 3:
        topic.log[rows] = np.maximum(topic.log[rows] + rng.choice(_TIMES), 0)
    elif kind == 4:
        topic.publish[rows] = rng.choice((0, 1, 2**62, 2**63 - 1))
    elif kind == 5:
        topic.publish[rows] = np.maximum(topic.publish[rows] + rng.choice(_TIMES), 0)
    else:
        kept = rng.choice((1, 2, 3, 12))
        topic.log, topic.publish = topic.log[:kept], topic.publish[:kept]
        topic.payloads, topic.cut = topic.payloads[:kept], {}


def _maker(rng: random.Random, seconds: float) -> Target:
    """Sessions; what is done with them is left open."""
    bases = [load(name, 0.0) for name in ("dex1_pick_place", "dex3_pinch")]

    def make() -> bytes:
        data = _spoiled(rng, rng.choice(bases), rng.choice((0.3, seconds)))
        return data if rng.random() < 0.5 else damage(rng, data)

    return Target(make, lambda data: None)


def _audited(rng: random.Random, scratch: Path) -> Target:
    path = scratch / "x.mcap"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        (record,) = examine(Task((Unit("x", str(path), len(data), ""),)))
        if record.state is State.FAILED:
            raise Difference(record.error)
        if EpisodeRecord.of_line(record.as_line()).as_line() != record.as_line():
            raise Difference("the journal does not give the record back")

    return replace(_maker(rng, 3.0), run=run)


def _replayed(rng: random.Random, scratch: Path) -> Target:
    path = scratch / "x.mcap"

    def options() -> ReplayOptions:
        return ReplayOptions(
            pace=rng.choice((0.5, 1.0, 3.0)),
            gains=rng.choice(GAINS),
            resample=rng.choice((None, 30.0, 200.0)),
            limit=rng.choice(LIMIT),
            jumps=rng.choice(JUMPS),
            invalid=rng.choice(INVALID),
            states=rng.random() < 0.1,
            swap_sides=rng.random() < 0.1,
            max_gap=rng.choice((None, 0.5)),
            accept=rng.sample(ACCEPTABLE, rng.randrange(len(ACCEPTABLE))),
        )

    def run(data: bytes) -> None:
        path.write_bytes(data)
        plan = prepare(read_session(path), options()).plan
        if plan is not None and plan.duration <= _REHEARSED:  # what is refused is rehearsed, too
            rehearse(plan, Guards(ramp_speed=3.0))

    return replace(_maker(rng, 0.5), run=run)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    return [
        FuzzCase(
            "audit",
            "damaged sessions, as an audit judges them",
            _audited,
            hang=_HANG,
        ),
        FuzzCase(
            "replay",
            "damaged sessions, as a replay reads and rehearses them",
            _replayed,
            hang=_HANG,
        ),
    ]
