"""Data and judgements that the checks of frames on USB share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import BaseContext, Outcome
from dexkit.conformance.kit.results import Evidence
from dexkit.conformance.usb.record import UsbPhase, topic
from dexkit.conformance.usb.recording import Answer, Exchange, Floats, UsbRecording, UsbSide

_ORDINARY = ("exchange", "burst", "move", "lock", "pause", "drive", "tripped", "clear")
"""Phases in which every command is valid and is followed by a wait for its answer."""


@dataclass(frozen=True)
class UsbContext(BaseContext[UsbRecording, UsbSide]):
    """One requirement to be judged for the USB transfers of one hand."""

    def tolerance(self, name: str) -> float:
        """A tolerance of the requirement."""
        return self.requirement.tolerance(name)

    def phases(self) -> list[UsbPhase]:
        """The phases that the requirement needs."""
        return self.hand.phases(self.requirement.phase or "")

    def at(self, seconds: float, end: float | None = None, *, inward: bool = True) -> Evidence:
        """A place in the recording."""
        return self.place(topic(self.hand.side, inward=inward), seconds, end)

    def over(self, phase: UsbPhase) -> Evidence:
        """The time of a phase, as a place in the recording."""
        return self.at(*self.hand.span(phase))


def ordinary(c: UsbContext) -> Iterator[Exchange]:
    """The exchanges of the phases in which every command is valid."""
    for phase in c.hand.record.phases:
        if phase.name in _ORDINARY:
            yield from c.hand.exchanges(phase)


def all_frames(
    c: UsbContext, good: Callable[[Answer], bool], what: str, answers: list[Answer] | None = None
) -> Outcome:
    """Fail unless every frame is good; ``what`` names the fault of the others."""
    answers = c.hand.answers if answers is None else answers
    if not answers:
        return c.skipped("no frame came")
    wrong = [a for a in answers if not good(a)]
    if not wrong:
        return c.passed(f"{len(answers)} frames")
    figure = f"{len(wrong)} of {len(answers)}"
    return c.failed(figure, f"{figure} frames have {what}", *(c.at(a.t) for a in wrong))


def part_of_way(hand: UsbSide, phase: UsbPhase, joint: int, begin: float, target: float) -> float:
    """Part of the way to its target that a joint went in a phase; NaN if it is not reported."""
    _, q = hand.positions(phase)
    known = q[np.isfinite(q[:, joint]), joint]
    return float((known[-1] - begin) / (target - begin)) if len(known) else math.nan


def travel_of(hand: UsbSide, phase: UsbPhase, *, before: bool = True) -> Floats:
    """The largest distance of each joint from its first position, rad; 0 if not reported."""
    _, q = hand.positions(phase, before=before)
    if len(q) < 2:
        return np.zeros(len(hand.joints))
    travel: Floats = np.nan_to_num(np.nanmax(np.abs(q - q[0]), axis=0))
    return travel


def quiet_motors(c: UsbContext, phases: list[UsbPhase], name: Callable[[UsbPhase], str]) -> Outcome:
    """Fail if a joint moved in any of the phases."""
    limit = c.tolerance("max_q")
    most = 0.0
    for phase in phases:
        if not c.hand.answers_in(phase):
            return c.skipped(f"no answer came {name(phase)}")
        travel = travel_of(c.hand, phase)
        most = max(most, float(travel.max()))
        if travel.max() > limit:
            joint = int(travel.argmax())
            observed = f"{named_joints(c, [joint])} moved by {travel.max():.2f} rad {name(phase)}"
            outcome = c.failed(
                f"{travel.max():.2f} rad", observed, c.over(phase), moved=travel.max()
            )
            return outcome.about(joint)
    return c.passed(f"{most:.3f} rad", moved=most)


def moves(c: UsbContext) -> Iterator[tuple[UsbPhase, int, float, float]]:
    """Each move of one joint: its phase, the joint, where it begins and its target, rad."""
    for phase in c.phases():
        yield phase, phase.params["joint"], phase.params["begin"], phase.params["target"]


def named_joints(c: UsbContext, joints: list[int]) -> str:
    """Names of joints."""
    return ", ".join(c.hand.joints[i].name for i in joints)
