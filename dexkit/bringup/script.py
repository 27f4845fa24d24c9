"""The order of a bring-up: motions, questions and conclusions; sans-IO.

:func:`script` is a generator of actions. A motion gives back how it ended and where, a question its
answer, a touch the sensor that felt it. What ``findings`` already has is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from dexkit.bringup.bench import JointChoice, Plan, Zero
from dexkit.bringup.findings import Findings, MotorFound, TravelFound
from dexkit.bringup.motion import End, Go
from dexkit.errors import HandFault

__all__ = [
    "AGAIN",
    "Action",
    "Locate",
    "PressRequest",
    "Question",
    "describe",
    "script",
    "travel_key",
]

AGAIN = "again"
NOTHING = "nothing"
_MARGIN = (-0.05, 0.16)
"""rad by which the travel between the stops may differ from the model's range: stops are where the
limits are, or a few degrees beyond. Ratios of 189 and 214 differ by more."""
_INSIDE = 0.02
"""rad that limits keep from a stop."""
_SAME_RATIO = 0.01
"""A measured ratio that is so near the reference is the reference: stops give a little."""


@dataclass(frozen=True)
class Question:
    """A question to the person.

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
class PressRequest:
    """Wait until the person presses one place; ``known`` are the sensors of other places."""

    key: str
    place: str
    known: frozenset[str]


Action: TypeAlias = Go | Locate | Question | PressRequest
_Script: TypeAlias = Generator[Action, Any, None]


def describe(plan: Plan, motors: Sequence[str]) -> list[str]:
    """The plan in words, a line for each step."""
    which = ", ".join(motors) if motors else "all that answer, in the order of their addresses"
    lines = [
        f"for each motor ({which}): out by {math.degrees(plan.nudge):.0f} degrees and back, then "
        f"two questions: which {plan.part} moved, and which way",
    ]
    if plan.travel:
        order = ", ".join(joint.name for joint in plan.joints if joint.wanted)
        lines.append(
            f"for each {plan.part} ({order}): to one stop, to the other and to 0, then one "
            "question: free way? and one more: does it look as it should at 0?"
        )
    if plan.places:
        lines.append(f"no motion: press each of {', '.join(plan.places)}, or skip it")
    return lines


def script(plan: Plan, motors: Sequence[str], findings: Findings) -> _Script:
    """The bring-up of a hand; fills ``findings``.

    :raises HandFault: a motor that does not move, or moves and nobody sees it; or no motor moves
        what the hand needs.
    """
    for motor in motors:
        if motor not in findings.motors and _lacking(plan, findings, full=True):
            yield from _identify(plan, motor, findings)
    lacking = _lacking(plan, findings)
    if lacking:
        raise HandFault(
            f"none of the motors moves {', '.join(joint.name for joint in lacking)}",
            hint="is it the other side's hand, or is a motor not connected? An answer that was "
            "wrong is corrected with --restart",
        )
    if plan.travel:
        for joint in plan.joints:
            for motor in findings.motors_of(joint.name) if joint.wanted else ():
                if travel_key(joint, motor) not in findings.travel:
                    yield from _travel(plan, joint, motor, findings)
    for place in plan.places:
        if place not in findings.sensors:
            known = frozenset(a for a in findings.sensors.values() if a)
            key = f"sensor {place}"
            findings.sensors[place] = yield PressRequest(key, place, known)


def travel_key(joint: JointChoice, motor: str) -> str:
    """Key of a motor's travel in :attr:`Findings.travel`."""
    return joint.name if joint.motors == 1 else f"{joint.name} {motor}"


def _lacking(plan: Plan, findings: Findings, *, full: bool = False) -> list[JointChoice]:
    """Joints of the hand without a motor; ``full``: which may have one more."""
    return [
        joint
        for joint in plan.joints
        if joint.wanted and len(findings.motors_of(joint.name)) < (joint.motors if full else 1)
    ]


def _identify(plan: Plan, motor: str, findings: Findings) -> _Script:
    free = [j for j in plan.joints if len(findings.motors_of(j.name)) < j.motors]
    while True:
        way = yield from _nudge(motor, plan.nudge)
        name = yield Question(
            f"motor {motor} {plan.part}",
            f"Which {plan.part} did motor {motor} move?",
            (*(joint.name for joint in free), NOTHING, AGAIN),
        )
        if name == NOTHING:
            raise HandFault(
                f"motor {motor} reports motion, but the operator saw none",
                hint="is this the hand in front of you? Its serial number is in the first lines",
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


def _nudge(motor: str, nudge: float) -> Generator[Action, Any, int]:
    """Move a motor a little and back; return the direction in which it could move."""
    start: float = yield Locate(motor)
    for way in (1, -1):
        why = f"motor {motor}: a little {'up' if way > 0 else 'down'}"
        _, q = yield Go(motor, start + way * nudge, why)
        moved = abs(q - start) > nudge / 2
        yield Go(motor, start, f"motor {motor}: back")
        if moved:
            return way
    raise HandFault(
        f"motor {motor} moves in neither direction",
        hint="is its joint blocked? If not, more torque: --torque; or the frame is not obeyed: "
        "docs/bringup.md",
    )


def _travel(plan: Plan, joint: JointChoice, motor: str, findings: Findings) -> _Script:
    sign = findings.motors[motor].sign
    key = travel_key(joint, motor)
    stops = joint.stops or (joint.q_min, joint.q_max)
    # far beyond the stops, whatever the ratio
    reach = 1.5 * (stops[1] - stops[0]) * max(joint.ratios) / plan.reference
    while True:
        ends = {}
        for direction in (joint.first, -joint.first):
            seen = joint.rising if direction > 0 else joint.falling
            start: float = yield Locate(motor)
            last = direction == -joint.first
            far = reach if joint.most_travel is None or not last else joint.most_travel
            target = start + direction * sign * far
            end, ends[direction] = yield Go(motor, target, f"{key}: {seen}, to its stop")
            if end is not End.STALLED and (joint.most_travel is None or not last):
                raise HandFault(
                    f"{key} turned further than its joint can, and met no stop",
                    hint=f"is the motor coupled to its joint, and is this the {plan.part} that the "
                    "command names? Then run the same command again",
                )
            if end is not End.STALLED:
                ends[direction] = ends[joint.first] + direction * sign * (stops[1] - stops[0])
        free = yield Question(
            f"{key} way free",
            f"Did {key} go from stop to stop, and touch nothing else?",
            ("yes", AGAIN),
        )
        if free == "yes":
            break
    ratio = _ratio(plan, joint, stops, abs(ends[1] - ends[-1]))
    scale = plan.reference / ratio  # from motor radians to the joint's
    low, high = ends[-1] * scale, ends[1] * scale
    if joint.zero_from is Zero.LOW_STOP:
        offset = low - sign * stops[0]
        limits = joint.q_min, sign * (high - offset) - _INSIDE
    else:
        offset = (low + high) / 2 - sign * (joint.q_min + joint.q_max) / 2
        limits = sign * (low - offset) + _INSIDE, sign * (high - offset) - _INSIDE
    confirmed = True
    if joint.zero:
        yield Go(motor, offset / scale, f"{key}: to 0")
        seen = yield Question(f"{key} zero", f"Is {key} {joint.zero}?", ("yes", "no"))
        confirmed = seen == "yes"
    findings.travel[key] = TravelFound(
        ratio,
        round(offset, 4),
        round(max(joint.q_min, limits[0]), 4),
        round(min(joint.q_max, limits[1]), 4),
        confirmed,
    )


def _ratio(plan: Plan, joint: JointChoice, stops: tuple[float, float], travel: float) -> float:
    """The gear ratio with which the travel is the joint's range.

    :raises HandFault: there is none.
    """
    stroke = stops[1] - stops[0]
    if joint.measured:
        ratio = travel / stroke * plan.reference
        if abs(ratio / plan.reference - 1) <= _SAME_RATIO:
            return plan.reference
        if min(joint.ratios) <= ratio <= max(joint.ratios):
            return round(ratio, 3)
        raise HandFault(
            f"{joint.name} travels {travel / stroke:.0%} of what its documents say",
            hint="did something stop it on its way? Run the same command again, or begin anew with "
            "--restart",
        )
    beyond = {r: travel * plan.reference / r - stroke for r in joint.ratios}
    fitting = [r for r, more in beyond.items() if _MARGIN[0] <= more <= _MARGIN[1]]
    if len(fitting) == 1:
        return fitting[0]
    found = ", ".join(
        f"{math.degrees(stroke + more):.0f}° with a gear ratio of {r:g}"
        for r, more in beyond.items()
    )
    raise HandFault(
        f"no gear ratio fits {joint.name}: its travel is {found}; by the model it is "
        f"{math.degrees(stroke):.0f}°",
        hint="did something stop it on its way, or was it another joint? Run the same command "
        "again, or begin anew with --restart",
    )
