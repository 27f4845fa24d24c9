"""The script of grippers of one joint, such as the Dex1-1."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.script import Plan, Pose, Steps
from dexkit.hand import Side
from dexkit.models import ModeByte

__all__ = ["GripperScript"]

NEARLY = 0.15
"""Part of the stroke to which a free hand is closed before it is driven open."""
_BACK = 0.13
"""Part of the stroke by which a free hand is commanded back after a restart of its service."""


class GripperScript(HandScript):
    """The script of a gripper."""

    def __init__(self, plan: Plan[Side], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(plan, report)
        self.stroke = plan.dialect.q_open
        # the interface specification: in unitree_hg the gains, dq and tau of a command are not used
        self.gains_used = plan.dialect.gains_are_used
        self.gainless = False
        """Whether commands have no gains: clients of a dialect that does not use them send none."""
        self.mode = 0
        """The mode byte of position commands, in dialects that do not use it."""
        self.grip: dict[Side, Motors] = {}
        """Commands to a side instead of its goal; no commands if empty."""

    # -- places -----------------------------------------------------------------------------

    def low(self, side: Side) -> float:
        """Nearly closed, clear of the object."""
        touch = self.plan.objects.get(side)
        return 0.1 * self.stroke if touch is None else touch + 0.1 * self.stroke

    def middle(self, side: Side) -> float:
        """Half open, clear of the object."""
        return max(0.5 * self.stroke, self.low(side) + 0.02 * self.stroke)

    def high(self) -> float:
        """Nearly open."""
        return 0.9 * self.stroke

    def home(self, side: Side) -> Pose:
        """Half open."""
        return (self.middle(side),)

    def other_place(self) -> dict[Side, Pose]:
        """The middle or above it, whichever is farther from here; of the second side a little more
        open, so that commands to the wrong side show.
        """
        places: dict[Side, Pose] = {}
        for i, side in enumerate(self.plan.sides):
            here = self.obs.q.get(side, (0.0,))[0]
            above = (0.7 if i == 0 else 0.85) * self.stroke
            middle = max(self.middle(side), (0.5 if i == 0 else 0.6) * self.stroke)
            places[side] = (above if abs(above - here) > abs(middle - here) else middle,)
        return places

    def nearly_closed(self) -> dict[Side, Pose]:
        """Where the sides without an object are before they are driven open."""
        free = (s for s in self.plan.sides if s not in self.plan.objects)
        return dict.fromkeys(free, (NEARLY * self.stroke,))

    def reachable(self, side: Side) -> bool:
        """Whether the goal is clear of the object."""
        return self.goal[side][0] > self.plan.objects.get(side, -math.inf)

    def motors(self, side: Side, pose: Pose) -> Motors:
        """The command to hold a pose, with the client's gains or with none."""
        kept = self.plan.dialect.mode_byte is not ModeByte.UNUSED
        motor = Motor(q=pose[0], mode=0 if kept else self.mode)
        return (replace(motor, kp=0.0, kd=0.0) if self.gainless else motor,)

    def command(self, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Every side holds its goal, but for those named and those that grip."""
        if not self.grip:
            yield from super().command(motors)
            return
        chosen = {**self.grip, **(motors or {})}
        every = {s: chosen[s] if s in chosen else self.motors(s, q) for s, q in self.goal.items()}
        yield from self.send(self.codec.encode({s: m for s, m in every.items() if m}))

    def back(self) -> Steps:
        """To the middle."""
        yield from self.everyone("center", self.homes())

    def after_shutdown(self) -> dict[Side, Pose]:
        """A little back from where a free hand was going."""
        self.grip = {}
        places = self.other_place()
        for s in self.plan.sides:
            if s not in self.plan.objects and s in self.obs.q:
                # back from where it was going, but not to the end
                back = self.obs.q[s][0] - _BACK * self.stroke
                places[s] = (max(back, self.low(s)),)
        return places
