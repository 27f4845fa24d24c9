"""The file of a self-test: its form, and how it is written.

Its JSON schema is made of these classes (``make docs``).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

import msgspec

from dexkit import __version__
from dexkit.conformance.selftest.result import (
    Condition,
    ElementResponse,
    ElementResult,
    JointResult,
    SelfTestResult,
    Verdict,
)
from dexkit.conformance.selftest.supervision import End
from dexkit.documents import write_file
from dexkit.records import as_plain

__all__ = ["SelfTestFile", "as_document", "write_json"]


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """A part of the file; every member must be there, and no other."""


class FigureRecord(_Record):
    """A figure of a joint; null where it was not measured.

    :param least: what the model demands.
    """

    value: float | None
    least: float | None
    good: bool


class JointRecord(_Record):
    """A joint.

    :param moves: joints that moved when this one was commanded.
    :param faulty: ``condition``, or names of figures.
    """

    name: str
    condition: Condition
    moves: tuple[str, ...]
    faulty: tuple[str, ...]
    figures: dict[str, FigureRecord]
    notes: tuple[str, ...]


class ElementRecord(_Record):
    """A tactile element; Pa, null where it was not measured."""

    packet: int
    slot: int
    place: str
    touch: ElementResponse
    rest: float | None
    noise: float | None
    peak: float | None


class SelfTestFile(_Record):
    """What the joints and tactile elements of one hand do; docs/selftest.md describes it.

    :param verdict: faulty: outside what the model says; incomplete: something could not be
        measured.
    :param hand: model, side, dialect; backend, device and name as they were given.
    :param options: limits of the test: part of the full speed, lead of a command, exchanges a
        second.
    :param touched: somebody was asked to press the tactile elements.
    :param spoiled: measurements that pauses of the testing machine spoiled.
    :param paused: pauses of a quarter of a second and more.
    """

    format: Literal["dexkit-selftest"]
    version: Literal[1]
    verdict: Verdict
    hand: dict[str, str]
    options: dict[str, float]
    recorded_at: str
    duration_s: float
    ended: End
    reason: str
    touched: bool
    spoiled: int
    paused: int
    dexkit: str
    joints: tuple[JointRecord, ...]
    elements: tuple[ElementRecord, ...]


def as_document(result: SelfTestResult) -> dict[str, Any]:
    """The content of the result's file, as plain data."""
    record = SelfTestFile(
        format="dexkit-selftest",
        version=1,
        verdict=result.verdict,
        hand=dict(result.hand),
        options=dict(result.options),
        recorded_at=result.recorded_at,
        duration_s=round(result.duration_s, 3),
        ended=result.ended,
        reason=result.reason,
        touched=result.touched,
        spoiled=result.spoiled,
        paused=result.paused,
        dexkit=__version__,
        joints=tuple(_joint(each) for each in result.joints),
        elements=tuple(_element(each) for each in result.elements),
    )
    found: dict[str, Any] = as_plain(record)
    return found


def write_json(result: SelfTestResult, path: Path) -> None:
    """Write the file."""
    text = json.dumps(as_document(result), ensure_ascii=False, allow_nan=False)
    write_file(path, text + "\n")


def _joint(joint: JointResult) -> JointRecord:
    figures = {
        f.name: FigureRecord(_number(f.value), _number(f.least), f.good) for f in joint.figures
    }
    return JointRecord(
        joint.name, joint.condition, joint.moves, tuple(joint.faulty), figures, joint.notes
    )


def _element(element: ElementResult) -> ElementRecord:
    pascals = (_number(each) for each in (element.rest, element.noise, element.peak))
    return ElementRecord(element.packet, element.slot, element.place, element.touch, *pascals)


def _number(value: float) -> float | None:
    return float(f"{value:.7g}") if math.isfinite(value) else None
