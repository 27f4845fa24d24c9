"""The result of a self-test: its figures, judged by the model and against an earlier run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from dexkit import __version__, documents
from dexkit.conformance.result_file import validate
from dexkit.conformance.selftest.figure_limits import KINDS, Figure, Wear, judged
from dexkit.conformance.selftest.joint_motion import Series
from dexkit.conformance.selftest.procedure import ElementFound, JointFound, Procedure
from dexkit.conformance.selftest.supervision import End, SelfTest
from dexkit.errors import UsageError
from dexkit.escaping import one_line

__all__ = [
    "FORMAT",
    "SCHEMA",
    "VERSION",
    "Condition",
    "ElementResponse",
    "ElementResult",
    "JointResult",
    "SelfTestResult",
    "Verdict",
    "check_baseline",
    "read_result",
    "result_of",
]

FORMAT = "dexkit-selftest"
VERSION = 1
SCHEMA = "selftest.schema.json"
_POINTS = 160
"""Points of a curve in the file."""
_ALSO = ("low", "high", "stiffness", "temperature")
"""Data of a joint that are stored but not judged."""
_NOISIER = (2.0, 100.0)
"""Times and Pa by which an element's noise is worse than before."""


class Verdict(str, Enum):
    """Verdict on the hand."""

    GOOD = "good"
    INCOMPLETE = "incomplete"
    WORN = "worn"
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


@dataclass(frozen=True, eq=False)
class JointResult:
    """A joint.

    :param moves: names of the joints that moved when it was commanded.
    :param also: further figures by name; what was not measured is left out.
    :param before: its condition in the earlier run, or None.
    """

    name: str
    condition: Condition
    moves: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    also: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    curves: Mapping[str, Series] = field(default_factory=dict)
    before: Condition | None = None

    @property
    def faulty(self) -> list[str]:
        """Faults by the model's limits: ``condition``, or names of figures."""
        bad = self.condition not in (Condition.MOVES, Condition.UNTESTED)
        return ["condition"] * bad + [f.name for f in self.figures if not f.good]

    @property
    def worn(self) -> list[str]:
        """Figures that have become worse since the earlier run."""
        bad = self.before is Condition.MOVES and self.condition is not Condition.UNTESTED
        lost = bad and self.condition is not Condition.MOVES
        return ["condition"] * lost + [f.name for f in self.figures if f.wear is Wear.WORN]


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
    before: ElementResponse | None = None
    noisier: bool = False

    @property
    def faulty(self) -> bool:
        """Whether the element does not answer, or has no value."""
        return self.touch in (ElementResponse.DEAD, ElementResponse.NO_VALUE)

    @property
    def worn(self) -> bool:
        """Whether it has become worse since the earlier run."""
        return self.noisier or (self.faulty and self.before is ElementResponse.ANSWERS)


@dataclass(frozen=True, eq=False)
class SelfTestResult:
    """A self-test of one hand.

    :param hand: model, side, dialect, backend, device, name.
    :param options: what limits held: speed, lead, rate.
    :param ended: how it has ended, with the reason.
    :param spoiled: figures that pauses of the machine spoiled.
    :param baseline: the earlier run: file and recorded_at; empty for none.
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
    baseline: Mapping[str, str] = field(default_factory=dict)
    dexkit: str = __version__

    @property
    def verdict(self) -> Verdict:
        """Verdict on the hand; never good if a requested measurement is missing."""
        wrong = any(j.faulty for j in self.joints) or any(e.faulty for e in self.elements)
        if wrong or self.ended is End.FAULT:
            return Verdict.FAULTY
        if any(j.worn for j in self.joints) or any(e.worn for e in self.elements):
            return Verdict.WORN
        measured = any(not math.isnan(f.value) for j in self.joints for f in j.figures)
        untouched = self.touched and any(e.touch is ElementResponse.UNTESTED for e in self.elements)
        if self.ended is not End.DONE or self.spoiled or not measured or untouched:
            return Verdict.INCOMPLETE
        return Verdict.GOOD

    def as_dict(self) -> dict[str, Any]:
        """The document of the file."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "verdict": str(self.verdict),
            "hand": dict(self.hand),
            "options": dict(self.options),
            "recorded_at": self.recorded_at,
            "duration_s": round(self.duration_s, 3),
            "ended": str(self.ended),
            "reason": self.reason,
            "touched": self.touched,
            "spoiled": self.spoiled,
            "paused": self.paused,
            "dexkit": self.dexkit,
            "baseline": dict(self.baseline) or None,
            "joints": [_joint_dict(j) for j in self.joints],
            "elements": [_element_dict(e) for e in self.elements],
        }

    def write_json(self, path: Path) -> None:
        """Write the file."""
        text = json.dumps(self.as_dict(), ensure_ascii=False, allow_nan=False)
        documents.write_file(path, text + "\n")


# ---------------------------------------------------------------------------------------- the file


def _number(value: float, digits: int = 7) -> float | None:
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def _value(number: float | None) -> float:
    return math.nan if number is None else float(number)


def _joint_dict(joint: JointResult) -> dict[str, Any]:
    return {
        "name": joint.name,
        "condition": str(joint.condition),
        "before": None if joint.before is None else str(joint.before),
        "moves": list(joint.moves),
        "faulty": joint.faulty,
        "worn": joint.worn,
        "figures": {
            f.name: {
                "value": _number(f.value),
                "scale": _number(f.scale),
                "good": f.good,
                "before": _number(f.before),
                "wear": None if f.wear is None else str(f.wear),
            }
            for f in joint.figures
        },
        "also": {name: _number(value) for name, value in joint.also.items()},
        "notes": list(joint.notes),
        "curves": {
            name: {
                "t": [_number(v, 5) for v in s.t.tolist()],
                "command": [_number(v, 5) for v in s.command.tolist()],
                "q": [_number(v, 5) for v in s.q.tolist()],
                "tau": [_number(v, 4) for v in s.tau.tolist()],
            }
            for name, s in joint.curves.items()
        },
    }


def _element_dict(element: ElementResult) -> dict[str, Any]:
    return {
        "packet": element.packet,
        "slot": element.slot,
        "place": element.place,
        "touch": str(element.touch),
        "before": None if element.before is None else str(element.before),
        "rest": _number(element.rest),
        "noise": _number(element.noise),
        "peak": _number(element.peak),
        "noisier": element.noisier,
    }


def read_result(path: Path) -> SelfTestResult:
    """Read a file.

    :raises UsageError: it is none, its version is unknown, or it does not match its schema.
    """
    data = documents.read_json(path)
    about = data if isinstance(data, dict) else {}
    if about.get("format") != FORMAT:
        raise UsageError(
            f"{path} is not a self-test of dexkit", hint="'dexkit selftest --json FILE' writes one"
        )
    if about.get("version") != VERSION:
        raise UsageError(f"{path} is version {one_line(about.get('version'), 40)} of {FORMAT}")
    validate(data, path, SCHEMA, "docs/selftest.md")
    return SelfTestResult(
        hand=data["hand"],
        options=data["options"],
        recorded_at=data["recorded_at"],
        duration_s=data["duration_s"],
        ended=End(data["ended"]),
        reason=data["reason"],
        joints=tuple(_joint_of(j) for j in data["joints"]),
        elements=tuple(_element_of(e) for e in data["elements"]),
        touched=data["touched"],
        spoiled=data["spoiled"],
        paused=data["paused"],
        baseline=data["baseline"] or {},
        dexkit=data["dexkit"],
    )


def _joint_of(data: dict[str, Any]) -> JointResult:
    return JointResult(
        name=data["name"],
        condition=Condition(data["condition"]),
        moves=tuple(data["moves"]),
        figures=tuple(
            Figure(
                name=name,
                value=_value(f["value"]),
                scale=_value(f["scale"]),
                good=f["good"],
                before=_value(f["before"]),
                wear=None if f["wear"] is None else Wear(f["wear"]),
            )
            for name, f in data["figures"].items()
        ),
        also={name: _value(value) for name, value in data["also"].items()},
        notes=tuple(data["notes"]),
        curves={
            name: Series(
                *(np.array([_value(v) for v in s[k]]) for k in ("t", "command", "q", "tau"))
            )
            for name, s in data["curves"].items()
        },
        before=None if data["before"] is None else Condition(data["before"]),
    )


def _element_of(data: dict[str, Any]) -> ElementResult:
    return ElementResult(
        packet=data["packet"],
        slot=data["slot"],
        place=data["place"],
        touch=ElementResponse(data["touch"]),
        rest=_value(data["rest"]),
        noise=_value(data["noise"]),
        peak=_value(data["peak"]),
        before=None if data["before"] is None else ElementResponse(data["before"]),
        noisier=data["noisier"],
    )


# ------------------------------------------------------------------------------------- the judging


def result_of(
    test: SelfTest,
    about: Mapping[str, str],
    *,
    baseline: SelfTestResult | None = None,
    baseline_name: str = "",
    now: datetime | None = None,
) -> SelfTestResult:
    """Build the result of a finished self-test.

    :param about: backend, device and name of the hand; model, side and dialect are added.
    :param baseline: an earlier run of the same hand.
    :param now: of the wall clock, for the file.
    """
    procedure = test.procedure
    setup, found = procedure.setup, procedure.found
    old_joints = {j.name: j for j in baseline.joints} if baseline else {}
    old_elements = {(e.packet, e.slot): e for e in baseline.elements} if baseline else {}
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
            _judge_joint(procedure, j, joint, j in chosen, old_joints.get(joint.name))
            for j, joint in enumerate(found.joints)
        ),
        elements=tuple(
            _judge_element(e, old_elements.get((e.packet, e.slot))) for e in found.elements
        ),
        touched=found.touched,
        spoiled=procedure.bench.spoiled,
        paused=test.paused,
        baseline={"file": baseline_name, "recorded_at": baseline.recorded_at} if baseline else {},
    )


def check_baseline(baseline: SelfTestResult, about: Mapping[str, str], path: Path) -> None:
    """Refuse a baseline of another hand.

    :param about: model, side and name of the hand that is to be tested.
    :raises UsageError: model, side or name differ.
    """
    for key in ("model", "side", "name"):
        mine, its = about.get(key, ""), baseline.hand.get(key, "")
        if mine and its and mine != its:
            raise UsageError(
                f"{path} belongs to another hand: its {key} is {one_line(its)}, not "
                f"{one_line(mine)}",
                hint="compare a hand with an earlier run of itself",
            )


def _judge_joint(
    procedure: Procedure, j: int, joint: JointFound, chosen: bool, old: JointResult | None
) -> JointResult:
    setup = procedure.setup
    before = {f.name: f for f in old.figures} if old else {}
    figures = []
    for kind in KINDS:
        value = joint.figures.get(kind.name, math.nan)
        column = 1 if kind.name.endswith("+") else 0
        asked = float(procedure.found.asked_speed[j, column])
        scale = kind.scale(setup, j, asked)
        was = before.get(kind.name)
        same = was is not None and math.isclose(was.scale, scale, rel_tol=1e-4)
        figures.append(judged(kind, value, scale, was.value if was and same else math.nan))
    return JointResult(
        name=joint.name,
        condition=_condition(joint, chosen),
        moves=joint.moves,
        figures=tuple(figures),
        also={k: joint.figures[k] for k in _ALSO if math.isfinite(joint.figures.get(k, math.nan))},
        notes=tuple(joint.notes),
        curves={name: _thinned(s) for name, s in joint.curves.items() if len(s.t)},
        before=old.condition if old else None,
    )


def _condition(joint: JointFound, chosen: bool) -> Condition:
    if not chosen or not joint.nudged:
        return Condition.UNTESTED
    if joint.sign < 0:
        return Condition.REVERSED
    if any(name != joint.name for name in joint.moves):
        return Condition.OTHER
    return Condition.MOVES if joint.alive else Condition.DEAD


def _judge_element(element: ElementFound, old: ElementResult | None) -> ElementResult:
    if math.isnan(element.rest):
        touch = ElementResponse.NO_VALUE
    elif element.answered is None:
        touch = ElementResponse.UNTESTED
    else:
        touch = ElementResponse.ANSWERS if element.answered else ElementResponse.DEAD
    times, more = _NOISIER
    return ElementResult(
        packet=element.packet,
        slot=element.slot,
        place=element.place,
        touch=touch,
        rest=element.rest,
        noise=element.noise,
        peak=element.peak,
        before=old.touch if old else None,
        noisier=old is not None and element.noise > times * old.noise + more,
    )


def _thinned(s: Series) -> Series:
    """Evenly, with its first and last sample; seconds from its beginning."""
    keep: Sequence[int] = np.unique(
        np.linspace(0, len(s.t) - 1, min(len(s.t), _POINTS)).astype(int)
    ).tolist()
    return Series(s.t[keep] - s.t[0], s.command[keep], s.q[keep], s.tau[keep])
