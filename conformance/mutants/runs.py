"""The two halves of a trial: to play a wrong hand on the virtual clock, and to judge the recording.

Each is a function of its arguments alone, and names nothing that the other half needs: what is
known of one half stays true while the other one is changed (``make pins``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from dexkit.conformance.judge import deciding, judge_layer, results_of
from dexkit.conformance.layers import layer, recording_of
from dexkit.conformance.recording import TraceLike
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.results import Result
from dexkit.conformance.stimuli import Plan
from dexkit.conformance.virtual.client import run_client
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.topic_run import run_virtual
from dexkit.conformance.virtual.usb import run_virtual_usb
from dexkit.hand import Side, Subject
from dexkit.models import DEX3_1, Dialect

__all__ = [
    "Run",
    "judge_client",
    "judge_topics",
    "judge_usb",
    "play_client",
    "play_topics",
    "play_usb",
]


@dataclass(frozen=True)
class Run:
    """A run of a wrong hand, and how it is judged.

    :param made: the wrong hand.
    :param about: what is played and judged besides: a plan, a side or a dialect.
    :param play: makes a recording of both.
    :param judge: judges it by every requirement of the layer, and a client's by the hands' too; or
        by those with some ids alone, and those that decide about them.
    """

    made: type[Any]
    about: Any
    play: Callable[[type[Any], Any], MemoryTrace]
    judge: Callable[[TraceLike, Any, Collection[str] | None], list[Result]]


def play_topics(made: type[Any], plan: Plan[Subject]) -> MemoryTrace:
    """Record a service of hands, or a robot, going through the phases of a plan."""
    return run_virtual(plan, made)


def judge_topics(
    trace: TraceLike, plan: Plan[Subject], only: Collection[str] | None
) -> list[Result]:
    """Judge the recording of a service; for ``only`` see :class:`Run`."""
    recording = recording_of(trace, plan.dialect.name, plan.sides)
    client, results = results_of(recording, only=only)
    return [*client, *results]


def play_usb(made: type[Any], side: Side) -> MemoryTrace:
    """Record a USB device."""
    return run_virtual_usb(made(side))


def judge_usb(trace: TraceLike, side: Side, only: Collection[str] | None) -> list[Result]:
    """Judge the recording of a USB device."""
    usb, model = layer("usb"), DEX3_1.name
    every = catalogue(model, "usb")
    if only is not None:
        chosen = {r.id for name in only for r in deciding(model, name)}
        every = tuple(r for r in every if r.id in chosen)
    return judge_layer(usb, usb.decode(trace, None, ()), every)


def play_client(made: type[Any], spoken: Dialect) -> MemoryTrace:
    """Record a client in a session with good hands."""
    return run_client(made, spoken)


def judge_client(trace: TraceLike, spoken: Dialect, only: Collection[str] | None) -> list[Result]:
    """Judge the recording of a client's session: the client and the hands."""
    recording = layer("client").decode(trace, spoken.name, ())
    assert recording is not None, "only USB may be missing from a recording"
    client, results = results_of(recording, only=only)
    return [*client, *results]
