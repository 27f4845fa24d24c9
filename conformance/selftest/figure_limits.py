"""Meaning of a self-test's figures: limits by the model, and limits of wear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from dexkit.conformance.selftest.joint_motion import Setup

__all__ = ["BY_NAME", "KINDS", "Figure", "Kind", "Unit", "Wear", "judged"]


class Unit(str, Enum):
    """Unit of a figure; limits are parts of the scale."""

    Q = "q"
    TORQUE = "torque"
    SPEED = "speed"
    SECONDS = "s"
    KELVIN = "K"

    def __str__(self) -> str:
        return self.value


class Wear(str, Enum):
    """A figure beside that of an earlier run."""

    SAME = "same"
    WORN = "worn"
    BETTER = "better"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Kind:
    """A figure of a joint.

    :param worse: the sign of a change for the worse; 0: any.
    :param limit: by the model, in scales; NaN for none.
    :param part: of the earlier figure by which a worn one is worse ...
    :param least: ... and in scales; both together.
    :param help: how it is measured, for readers.
    """

    name: str
    title: str
    unit: Unit
    worse: int
    limit: float
    part: float
    least: float
    help: str

    def scale(self, setup: Setup, joint: int, asked: float) -> float:
        """The scale of limits: the stroke, the torque bound, or the commanded speed."""
        if self.unit is Unit.Q:
            return float(setup.stroke[joint])
        if self.unit is Unit.TORQUE:
            bound = float(setup.kp[joint]) * setup.lead
            return setup.spec.joints[joint].tau_max if setup.servo else bound
        return asked if self.unit is Unit.SPEED else 1.0

    def keeps(self, value: float, scale: float) -> bool:
        """Whether a value is within the model's limit."""
        if math.isnan(self.limit):
            return True
        limit = self.limit * scale
        return value >= limit if self.worse < 0 else abs(value) <= limit

    def beside(self, value: float, before: float, scale: float) -> Wear:
        """A value beside that of an earlier run."""
        change = value - before
        if abs(change) <= self.part * abs(before) + self.least * scale:
            return Wear.SAME
        return Wear.WORN if self.worse == 0 or change * self.worse > 0 else Wear.BETTER


KINDS = (
    Kind("range", "range", Unit.Q, -1, 0.95, 0.0, 0.03, "from end to end, led there slowly"),
    Kind("zero", "zero", Unit.Q, 0, 0.05, 0.0, 0.02, "what is missing at the lower end, less that "
         "at the upper one: q is off by so much if it is not 0"),
    Kind("start+", "torque to start, q rising", Unit.TORQUE, 1, 0.5, 0.3, 0.01,
         "highest before the joint moved under a command that creeps away, in mid range"),
    Kind("start-", "torque to start, q falling", Unit.TORQUE, 1, 0.5, 0.3, 0.01, "likewise"),
    Kind("repeatability", "repeatability", Unit.Q, 1, 0.01, 0.5, 0.003,
         "largest difference of three places of rest for one command, from the same direction"),
    Kind("play", "play", Unit.Q, 1, 0.02, 0.5, 0.004, "how far apart it rests when it comes from "
         "below and from above, without what friction explains"),
    Kind("lag", "lag", Unit.SECONDS, 1, 0.1, 0.3, 0.02, "from a small step of the command until "
         "the state shows a twentieth of it"),
    Kind("speed+", "speed, q rising", Unit.SPEED, -1, 0.8, 0.1, 0.0, "reached in mid range"),
    Kind("speed-", "speed, q falling", Unit.SPEED, -1, 0.8, 0.1, 0.0, "likewise"),
    Kind("noise", "noise", Unit.Q, 1, 0.005, 1.0, 0.001, "standard deviation of q at rest"),
    Kind("rise", "temperature rise", Unit.KELVIN, 1, 20.0, 0.5, 5.0,
         "of the hotter of case and winding, from the beginning of the test to its end"),
)  # fmt: skip
"""Every figure that is judged, in the order of the page."""
BY_NAME = {kind.name: kind for kind in KINDS}


@dataclass(frozen=True)
class Figure:
    """A figure of a joint, judged.

    :param value: NaN where it was not measured.
    :param scale: of its limits.
    :param good: within the model's limit.
    :param before: of the earlier run; NaN where there is none to compare with.
    :param wear: None where there is none to compare with.
    """

    name: str
    value: float
    scale: float
    good: bool
    before: float = math.nan
    wear: Wear | None = None


def judged(kind: Kind, value: float, scale: float, before: float = math.nan) -> Figure:
    """A figure, judged; one that was not measured is good and compares with nothing."""
    if math.isnan(value):
        return Figure(kind.name, value, scale, good=True, before=before)
    wear = None if math.isnan(before) else kind.beside(value, before, scale)
    return Figure(kind.name, value, scale, kind.keeps(value, scale), before, wear)
