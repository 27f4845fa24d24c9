"""The stimulus for hands of several joints.

Both hands do the same at once, except where their independence is the subject. Poses are given by
how far the flexing joints are closed, in percent, as the object is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dexkit.conformance.hands import JointRoles, under_test
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.script import Pose, Steps
from dexkit.hand import Side

__all__ = ["FingerScript"]


OPEN, CLOSED = 15.0, 50.0
"""Percent of closing between which the hand moves freely."""
_FARTHER = 15.0
"""Percent of closing by which a hand is farther closed than the other, where both are alike."""
BEYOND = 25.0
"""Percent of closing by which an object is squeezed."""
FEW_MOTORS = 8
"""Motors of a hand up to which their opening is judged as their closing is."""
SPLITS = ((1, 2, 3, 6), (1, 2, 4, 5), (0, 2, 4, 6))
"""Joints with another mode byte than the rest of the hand, in three commands: each joint is among
them and not, and no two joints are treated alike three times. Where there are many, k counts these
commands, and every joint without bit 0 of its index is among them, then those with bit 1 and 2."""
_APART = 7.0
"""Percent of closing by which goals of position servos differ, where they tell joints apart: more
than a good one may be off, and less than what makes it another step."""


class FingerScript(HandScript):
    """The script of a hand of several joints."""

    motion = "joint"
    settling = 0.2
    standing = 0.1
    least = 0.5
    step_most = 1.5
    all_turns = True
    between_bad = 0.4

    turn_of_splits = 0
    """Number of times that joints got different treatment."""
    turn_of_places = 0
    """Number of times that joints got goals that tell them apart."""
    drives = 0
    """Number of times that joints have been set in motion."""

    def back(self) -> Steps:
        """Nearly open."""
        yield from self.to("center", OPEN)

    @property
    def roles(self) -> JointRoles:
        """The joints that phases treat each in its own way."""
        roles = under_test(self.model.name).roles
        assert roles is not None  # every hand of several joints has them
        return roles

    # -- places -----------------------------------------------------------------------------

    def pose(self, side: Side, percent: float) -> Pose:
        """Every joint so far closed; the thumb's sideways joint swings along."""
        return tuple(
            j.closed_by(percent / 100) if j.closing else (percent - 30) / 70 * j.q_max
            for j in self.joints[side]
        )

    def home(self, side: Side) -> Pose:
        """Nearly open."""
        return self.pose(side, OPEN)

    def other_place(self) -> dict[Side, Pose]:
        """Nearly open or half closed, whichever is farther from here.

        Of hands that are not mirrored, one goes farther, so that commands to the wrong side show.
        Position servos get a place for each joint (:meth:`apart`).
        """
        places = {}
        farther = self.farther_side()
        for side in self.plan.sides:
            here = self.obs.q.get(side, self.home(side))
            more = _FARTHER if side is farther else 0.0
            places[side] = max(
                (self.pose(side, percent + more) for percent in (OPEN, CLOSED - 5.0)),
                key=lambda pose: sum(abs(a - b) for a, b in zip(pose, here, strict=True)),
            )
        return places

    def farther_side(self) -> Side | None:
        """The side that closes farther than the other, without an object; None where their joints
        are mirrored, or told apart by their goals.
        """
        sides = [s for s in self.plan.sides if s not in self.plan.objects]
        if self.plan.dialect.position_servo or len(self.plan.sides) < 2 or not sides:
            return None
        ways = zip(*(self.joints[s] for s in self.plan.sides), strict=True)
        mirrored = sum(a.closing != b.closing for a, b in ways)
        return sides[0] if 2 * mirrored < len(self.joints[sides[0]]) else None

    def apart(self, places: Mapping[Side, Pose]) -> dict[Side, Pose]:
        """The places of position servos, in which no two joints have the same goal twice.

        Where all joints have the same one, it cannot be seen that they have been mixed up.
        """
        if not self.plan.dialect.position_servo:
            return dict(places)
        turn = self.turn_of_places
        self.turn_of_places += 1
        found = {}
        for s, pose in places.items():
            by_thirds = (turn + (s is Side.RIGHT)) % 2 == 0
            found[s] = tuple(
                q + ((i % 3 if by_thirds else i // 2) - 1) * _APART / 100 * j.stroke * j.closing
                for i, (q, j) in enumerate(zip(pose, self.joints[s], strict=True))
            )
        return found

    def reachable(self, side: Side) -> bool:
        """Whether it has no object."""
        return side not in self.plan.objects

    def motors(self, side: Side, pose: Pose) -> Motors:
        """The command to hold a pose, with the client's gains."""
        return [
            Motor(q=q, dq=self.model.client_command.dq, kp=kp, kd=kd, mode=self.codec.mode(i))
            for i, (q, (kp, kd)) in enumerate(zip(pose, self.model.gains, strict=True))
        ]

    def all(self, percent: float, **change: float) -> dict[Side, Motors]:
        """Every hand so far closed, with something else in every motor."""
        return {
            s: [replace(m, **change) for m in self.motors(s, self.pose(s, percent))]  # type: ignore[arg-type]
            for s in self.plan.sides
        }

    def to(self, name: str, percent: float) -> Steps:
        """All hands so far closed, as a phase."""
        poses = {s: self.pose(s, percent) for s in self.plan.sides}
        yield from self.everyone(name, poses, most=1.5)

    def next_splits(self) -> dict[Side, frozenset[int]]:
        """The joints of each side that are treated differently next; others on each side."""
        turn = self.turn_of_splits
        self.turn_of_splits += 1
        found = {}
        for s in self.plan.sides:
            k, count = (turn + (s is Side.RIGHT)) % len(SPLITS), len(self.joints[s])
            many = (i for i in range(count) if (i >> k & 1) == (k > 0))
            found[s] = frozenset(SPLITS[k] if count <= FEW_MOTORS else many)
        return found

    def guarded(
        self, motors: Motors, side: Side, guarded: Mapping[Side, frozenset[int]]
    ) -> list[Motor]:
        """The command with time-out protection for some joints."""
        mine = guarded.get(side, frozenset())
        return [
            replace(m, mode=self.codec.mode(i, timeout=True)) if i in mine else m
            for i, m in enumerate(motors)
        ]
