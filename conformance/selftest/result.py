"""The result of a self-test: its figures, judged by the model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum

import numpy as np

from dexkit.conformance.selftest.joint_motion import Series
from dexkit.conformance.selftest.procedure import ElementFound, JointFound, Procedure
from dexkit.conformance.selftest.supervision import End, SelfTest

__all__ = [
    "FIGURES",
    "Condition",
    "ElementResponse",
    "ElementResult",
    "Figure",
    "JointResult",
    "SelfTestResult",
    "Verdict",
    "result_of",
]

FIGURES = {"range": "range", "speed+": "speed, q rising", "speed-": "speed, q falling"}
"""Figures of a joint by name, with their titles. More is better."""
_RANGE = 0.95  # part of the stroke
_SPEED = 0.8  # part of the speed that was asked for
_POINTS = 160
"""Points of a curve on the page."""


class Verdict(str, Enum):
    """Verdict on the hand."""

    GOOD = "good"
    INCOMPLETE = "incomplete"
    FAULTY = "faulty"

    def __str__(self) -> str:
        return self.value


class Condition(str, Enum):
    """Response of a joint to a small command."""

    MOVES = "moves"
    DEAD = "dead"
    REVERSED = "reversed"
    OTHER = "moves another joint"
    UNTESTED = "not tested"

    def __str__(self) -> str:
        return self.value


class ElementResponse(str, Enum):
    """Response of a tactile element."""

    ANSWERS = "answers"
    DEAD = "dead"
    NO_VALUE = "no value"
    UNTESTED = "not tested"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Figure:
    """A figure of a joint.

    :param value: NaN where it was not measured.
    :param least: what the model demands.
    """

    name: str
    value: float
    least: float

    @property
    def good(self) -> bool:
        """Whether it is what the model demands; one that was not measured is."""
        return math.isnan(self.value) or self.value >= self.least


@dataclass(frozen=True, eq=False)
class JointResult:
    """A joint.

    :param moves: names of the joints that moved when it was commanded.
    """

    name: str
    condition: Condition
    moves: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    notes: tuple[str, ...] = ()
    curves: Mapping[str, Series] = field(default_factory=dict)

    @property
    def faulty(self) -> list[str]:
        """Faults: ``condition``, or names of figures."""
        bad = self.condition not in (Condition.MOVES, Condition.UNTESTED)
        return ["condition"] * bad + [f.name for f in self.figures if not f.good]


@dataclass(frozen=True)
class ElementResult:
    """A tactile element; Pa, NaN where it was not measured."""

    packet: int
    slot: int
    place: str
    touch: ElementResponse
    rest: float
    noise: float
    peak: float

    @property
    def faulty(self) -> bool:
        """Whether the element does not answer, or has no value."""
        return self.touch in (ElementResponse.DEAD, ElementResponse.NO_VALUE)


@dataclass(frozen=True, eq=False)
class SelfTestResult:
    """A self-test of one hand.

    :param hand: model, side, dialect, backend, device, name.
    :param options: what limits held: speed, lead, rate.
    :param ended: how it has ended, with the reason.
    :param spoiled: figures that pauses of the machine spoiled.
    """

    hand: Mapping[str, str]
    options: Mapping[str, float]
    recorded_at: str
    duration_s: float
    ended: End
    reason: str
    joints: tuple[JointResult, ...]
    elements: tuple[ElementResult, ...] = ()
    touched: bool = False
    spoiled: int = 0
    paused: int = 0

    @property
    def verdict(self) -> Verdict:
        """Verdict on the hand; never good if a requested measurement is missing."""
        wrong = any(j.faulty for j in self.joints) or any(e.faulty for e in self.elements)
        if wrong or self.ended is End.FAULT:
            return Verdict.FAULTY
        measured = any(not math.isnan(f.value) for j in self.joints for f in j.figures)
        untouched = self.touched and any(e.touch is ElementResponse.UNTESTED for e in self.elements)
        if self.ended is not End.DONE or self.spoiled or not measured or untouched:
            return Verdict.INCOMPLETE
        return Verdict.GOOD


def result_of(
    test: SelfTest, about: Mapping[str, str], *, now: datetime | None = None
) -> SelfTestResult:
    """Build the result of a finished self-test.

    :param about: backend, device and name of the hand; model, side and dialect are added.
    :param now: of the wall clock, for the file.
    """
    procedure = test.procedure
    setup, found = procedure.setup, procedure.found
    chosen = set(procedure.chosen)
    return SelfTestResult(
        hand={
            "model": setup.spec.model,
            "side": str(setup.spec.side),
            "dialect": setup.dialect.name,
            **about,
        },
        options={
            "speed": procedure.speed,
            "lead": setup.lead,
            "rate": round(1.0 / setup.period, 3),
        },
        recorded_at=(now or datetime.now(timezone.utc)).isoformat(timespec="seconds"),
        duration_s=test.now - test.begin,
        ended=test.end or End.STOPPED,
        reason=test.reason,
        joints=tuple(
            _judge_joint(procedure, j, joint, j in chosen) for j, joint in enumerate(found.joints)
        ),
        elements=tuple(map(_judge_element, found.elements)),
        touched=found.touched,
        spoiled=procedure.bench.spoiled,
        paused=test.paused,
    )


def _judge_joint(procedure: Procedure, j: int, joint: JointFound, chosen: bool) -> JointResult:
    down, up = procedure.found.asked_speed[j].tolist()
    least = {
        "range": _RANGE * float(procedure.setup.stroke[j]),
        "speed+": _SPEED * up,
        "speed-": _SPEED * down,
    }
    return JointResult(
        name=joint.name,
        condition=_condition(joint, chosen),
        moves=joint.moves,
        figures=tuple(
            Figure(name, joint.figures.get(name, math.nan), least[name]) for name in FIGURES
        ),
        notes=tuple(joint.notes),
        curves={name: _thinned(s) for name, s in joint.curves.items() if len(s.t)},
    )


def _condition(joint: JointFound, chosen: bool) -> Condition:
    if not chosen or not joint.nudged:
        return Condition.UNTESTED
    if joint.sign < 0:
        return Condition.REVERSED
    if any(name != joint.name for name in joint.moves):
        return Condition.OTHER
    return Condition.MOVES if joint.alive else Condition.DEAD


def _judge_element(element: ElementFound) -> ElementResult:
    if math.isnan(element.rest):
        touch = ElementResponse.NO_VALUE
    elif element.answered is None:
        touch = ElementResponse.UNTESTED
    else:
        touch = ElementResponse.ANSWERS if element.answered else ElementResponse.DEAD
    return ElementResult(
        packet=element.packet,
        slot=element.slot,
        place=element.place,
        touch=touch,
        rest=element.rest,
        noise=element.noise,
        peak=element.peak,
    )


def _thinned(s: Series) -> Series:
    """Evenly, with its first and last sample; seconds from its beginning."""
    keep: Sequence[int] = np.unique(
        np.linspace(0, len(s.t) - 1, min(len(s.t), _POINTS)).astype(int)
    ).tolist()
    return Series(s.t[keep] - s.t[0], s.command[keep], s.q[keep])
