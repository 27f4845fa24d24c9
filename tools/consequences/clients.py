"""Models of the genuine clients: which states they wait for, what they send, how often.

All of them read q alone: xr_teleoperate and what unitree_lerobot takes from it record no other
member of a hand's state (docs/sources/sessions.md#a1), and LeRobot's data sets hold q as well. The
pressure of a Dex3-1 is read by Unitree's example and by clients of two other projects
(docs/sources/real-hands.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.virtual.client import motors_of
from dexkit.hand import Side
from dexkit.models import Dialect, model
from dexkit.teleop import Pose, client_for
from dexkit.teleop.client import PINCH_MAX, PINCH_MIN
from tools.consequences.stage import Client

__all__ = ["Example", "Script", "Teleoperation", "closed"]

FPS = 30.0
"""Rate of the operator's input, and of data sets (docs/sources/sessions.md#a2)."""


def closed(spoken: Dialect, side: Side, parts: Sequence[float]) -> Pose:
    """The pose of a hand whose joints are closed by these parts, 0 open to 1 closed.

    One part counts for all joints. A joint that neither opens nor closes swings about its middle.
    """
    joints = joints_of(spoken, side)
    each = list(parts) * len(joints) if len(parts) == 1 else parts
    if spoken.is_gripper:
        return (spoken.q_open * (1.0 - each[0]),)
    return tuple(
        j.closed_by(part) if j.closing else j.q_min + (0.2 + 0.6 * part) * j.stroke
        for part, j in zip(each, joints, strict=True)
    )


class Teleoperation(Client):
    """xr_teleoperate's controller, and what gives it the operator's goals 30 times a second.

    unitree_lerobot drives hands by the same controllers, with the actions of a data set or of a
    policy.
    """

    def __init__(self, spoken: Dialect, sides: Sequence[Side], number: int = 0) -> None:
        super().__init__(number)
        self.dialect, self.sides = spoken, tuple(sides)
        self.client = client_for(spoken, sides)
        self.period = self.client.period
        self._input = (-1, self.goals)
        self._sent: tuple[object, Mapping[Side, Sequence[Motor]]] = (None, {})

    def receive(self, now: float, states: Mapping[Side, Sequence[float]]) -> None:
        """Take a state: reads of both sides take turns."""
        self.client.receive(now, states)

    def commands(self, now: float) -> Mapping[Side, Sequence[Motor]]:
        """A turn of its control loop."""
        frame = math.floor(now * FPS)
        if frame != self._input[0]:
            self._input = frame, self.wanted(now)
        wanted = self._input[1]
        inputs: dict[Side, Pose | None] = {s: self._tracked(q) for s, q in wanted.items()}
        commands = self.client.step(now, {}, inputs)
        if commands != self._sent[0]:
            self._sent = commands, motors_of(commands, self.dialect)
        return self._sent[1]

    def _tracked(self, q: Pose) -> Pose:
        """What hand tracking gives for this goal: of a gripper, a pinch."""
        if not self.dialect.is_gripper:
            return q
        return (PINCH_MIN + (PINCH_MAX - PINCH_MIN) * q[0] / self.dialect.q_open,)


class Script(Client):
    """A user's own program: sends goals with the client's gains at its rate, and waits for nothing.

    :param sides: the only ones that it commands.
    """

    def __init__(self, spoken: Dialect, sides: Sequence[Side], number: int = 0) -> None:
        super().__init__(number)
        self.dialect, self.sides = spoken, tuple(sides)
        self.model = model(spoken.model)
        self.period = 1.0 / self.model.command_rate
        self.codec = MotorCodec(spoken)

    def commands(self, now: float) -> Mapping[Side, Sequence[Motor]]:
        """The goals as they are."""
        return {s: self.motors(s, q) for s, q in self.wanted(now).items()}

    def motors(self, side: Side, q: Sequence[float]) -> list[Motor]:
        """A command with the client's gains."""
        dq = self.model.client_command.dq
        gains = self.model.gains if self.dialect.gains_are_used else ((0.0, 0.0),) * len(q)
        return [
            Motor(value, dq, 0.0, kp, kd, self.codec.mode(i))
            for i, (value, (kp, kd)) in enumerate(zip(q, gains, strict=True))
        ]


class Example(Script):
    """Unitree's example program of the Dex3-1 and test program of the Dex1-1's service.

    That of the Dex3-1 commands one hand: while it turns the joints, as often as it can, with soft
    gains; while it grips and when it stops, once a second, and bit 7 of the mode is what was in
    memory (docs/sources/unitree-dex.md#b1). That of the Dex1-1 sends 200 commands a second.
    """

    TURN, GRIP, STOP = (0.5, 0.1), (1.5, 0.1), (0.0, 0.0)
    MODELS = ("dex1-1", "dex3-1")
    """Those that it was written for."""
    fast = 0.0005
    """Seconds between commands of a loop without a pause, as far as a computer comes."""

    def __init__(self, spoken: Dialect, sides: Sequence[Side], number: int = 0) -> None:
        super().__init__(spoken, sides, number)
        self.gains: tuple[float, float] | None = None
        self.status = 1
        self.timeout = False

    def motors(self, side: Side, q: Sequence[float]) -> list[Motor]:
        """A command with the example's gains and mode."""
        made = super().motors(side, q)
        if self.gains is not None:
            kp, kd = self.gains
            made = [replace(m, kp=kp, kd=kd) for m in made]
        if self.dialect.is_gripper:
            return [replace(m, mode=1) for m in made]
        modes = (self.codec.mode(i, self.status, self.timeout) for i in range(len(made)))
        return [replace(m, mode=mode) for m, mode in zip(made, modes, strict=True)]
