"""The order of a bring-up: what moves, what is asked, and what follows; sans-IO.

:func:`script` is a generator of actions. A motion gives back how it ended and where, a question its
answer, a touch the sensor that felt it. What ``findings`` already has is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from dexkit.bringup.bench import JointChoice, Plan
from dexkit.bringup.findings import Findings, MotorFound, TravelFound
from dexkit.bringup.motion import End, Go
from dexkit.errors import HandFault

__all__ = ["AGAIN", "Action", "Locate", "Question", "Touch", "describe", "script"]

AGAIN = "again"
NOTHING = "nothing"
_NUDGE = 0.14
"""rad of the first motion: 8 degrees of a joint with the reference ratio, less with more gears."""
_MARGIN = (-0.05, 0.16)
"""rad by which the travel between the stops may differ from the model's range: stops are where the
limits are, or a few degrees beyond. Ratios of 189 and 214 differ by more."""
_INSIDE = 0.02
"""rad that limits keep from a stop."""


@dataclass(frozen=True)
class Question:
    """What the person is asked.

    :param key: names it in files of answers.
    :param choices: the answers that are possible.
    """

    key: str
    text: str
    choices: tuple[str, ...]


@dataclass(frozen=True)
class Locate:
    """Ask where a motor is now."""

    motor: str


@dataclass(frozen=True)
class Touch:
    """Wait until the person presses one place; ``known`` are the sensors of other places."""

    key: str
    place: str
    known: frozenset[str]


Action: TypeAlias = Go | Locate | Question | Touch
_Script: TypeAlias = Generator[Action, Any, None]


def describe(plan: Plan, motors: Sequence[str]) -> list[str]:
    """The plan in words, a line for each step."""
    n = len(motors) or len(plan.joints)
    which = ", ".join(motors) if motors else f"all {n}, in the order of their buses"
    lines = [
        f"for each motor ({which}): out by {math.degrees(_NUDGE):.0f} degrees and back, then two "
        "questions: which joint moved, and which way",
    ]
    if plan.travel:
        order = ", ".join(joint.name for joint in plan.joints)
        lines.append(
            f"for each joint ({order}): to one stop, to the other and to 0, then one question: "
            "free way? and one more: does it look as it should at 0?"
        )
    if plan.places:
        lines.append(f"no motion: press each of {', '.join(plan.places)}, or skip it")
    return lines


def script(plan: Plan, motors: Sequence[str], findings: Findings) -> _Script:
    """The bring-up of a hand; fills ``findings``.

    :raises HandFault: a motor that does not move, or moves and nobody sees it.
    """
    for motor in motors:
        if motor not in findings.motors:
            yield from _identify(plan, motor, findings)
    if plan.travel:
        for joint in plan.joints:
            if joint.name not in findings.travel:
                yield from _travel(plan, joint, findings)
    for place in plan.places:
        if place not in findings.sensors:
            known = frozenset(a for a in findings.sensors.values() if a)
            key = f"sensor {place}"
            findings.sensors[place] = yield Touch(key, place, known)


def _identify(plan: Plan, motor: str, findings: Findings) -> _Script:
    taken = {found.joint for found in findings.motors.values()}
    free = [joint for joint in plan.joints if joint.name not in taken]
    while True:
        way = yield from _nudge(motor)
        name = yield Question(
            f"motor {motor} joint",
            f"Which joint did motor {motor} move?",
            (*(joint.name for joint in free), NOTHING, AGAIN),
        )
        if name == NOTHING:
            raise HandFault(
                f"motor {motor} reports motion that nobody saw",
                hint="is this the hand that you look at? Its serial number is in the first lines",
            )
        if name == AGAIN:
            continue
        joint = next(j for j in free if j.name == name)
        seen = yield Question(
            f"motor {motor} way",
            f"Which way did {name} go from where it was (the larger motion, if there were two)?",
            (joint.rising, joint.falling, AGAIN),
        )
        if seen != AGAIN:
            break
    findings.motors[motor] = MotorFound(joint.name, way if seen == joint.rising else -way)


def _nudge(motor: str) -> Generator[Action, Any, int]:
    """Move a motor a little and back; return the direction in which it could move."""
    start: float = yield Locate(motor)
    for way in (1, -1):
        why = f"motor {motor}: a little {'up' if way > 0 else 'down'}"
        _, q = yield Go(motor, start + way * _NUDGE, why)
        moved = abs(q - start) > _NUDGE / 2
        yield Go(motor, start, f"motor {motor}: back")
        if moved:
            return way
    raise HandFault(
        f"motor {motor} moves neither way",
        hint="is its joint blocked? If not, more torque: --torque; or the frame is not obeyed: "
        "docs/bringup.md",
    )


def _travel(plan: Plan, joint: JointChoice, findings: Findings) -> _Script:
    motor = findings.motor_of(joint.name)
    sign = findings.motors[motor].sign
    # far beyond the stops, whatever the ratio
    reach = 1.5 * (joint.q_max - joint.q_min) * max(joint.ratios) / plan.reference
    while True:
        ends = {}
        for direction in (joint.first, -joint.first):
            seen = joint.rising if direction > 0 else joint.falling
            start: float = yield Locate(motor)
            target = start + direction * sign * reach
            end, ends[direction] = yield Go(motor, target, f"{joint.name}: {seen}, to its stop")
            if end is not End.STALLED:
                raise HandFault(f"{joint.name} meets no stop", hint="is it the right joint?")
        free = yield Question(
            f"{joint.name} way free",
            f"Did {joint.name} go from stop to stop, and touch nothing else?",
            ("yes", AGAIN),
        )
        if free == "yes":
            break
    ratio = _ratio(plan, joint, abs(ends[1] - ends[-1]))
    scale = plan.reference / ratio  # from motor radians to the joint's
    low, high = ends[-1] * scale, ends[1] * scale
    offset = (low + high) / 2 - sign * (joint.q_min + joint.q_max) / 2
    confirmed = True
    if joint.zero:
        yield Go(motor, offset / scale, f"{joint.name}: to 0")
        seen = yield Question(f"{joint.name} zero", f"Is {joint.name} {joint.zero}?", ("yes", "no"))
        confirmed = seen == "yes"
    findings.travel[joint.name] = TravelFound(
        ratio,
        round(offset, 4),
        round(max(joint.q_min, sign * (low - offset) + _INSIDE), 4),
        round(min(joint.q_max, sign * (high - offset) - _INSIDE), 4),
        confirmed,
    )


def _ratio(plan: Plan, joint: JointChoice, travel: float) -> float:
    """The gear ratio with which the travel is the joint's range.

    :raises HandFault: there is none.
    """
    stroke = joint.q_max - joint.q_min
    beyond = {r: travel * plan.reference / r - stroke for r in joint.ratios}
    fitting = [r for r, more in beyond.items() if _MARGIN[0] <= more <= _MARGIN[1]]
    if len(fitting) == 1:
        return fitting[0]
    found = ", ".join(
        f"{math.degrees(stroke + more):.0f}° with {r:g}" for r, more in beyond.items()
    )
    raise HandFault(
        f"{joint.name} travels {found} turns a turn; the model says {math.degrees(stroke):.0f}°",
        hint="did something stop it on its way, or was it another joint? Run the same command "
        "again, or begin anew with --restart",
    )
