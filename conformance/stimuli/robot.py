"""The stimulus for a robot; see :mod:`dexkit.conformance.stimuli`.

Commands come at xr_teleoperate's rate with its gains; a joint is moved by a ramp, toward the
middle of its range. Most phases are about one joint, the right elbow; after each, every joint is
moved back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from dexkit.command_age import PAUSE
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.robot import RobotMotorCodec
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.phases import Moment
from dexkit.conformance.stimuli.script import Plan, Script, Send, Steps
from dexkit.hand import ROBOT, RobotSubject
from dexkit.robots import robot

__all__ = ["STEP", "RobotScript"]

STEP = 0.2
"""rad by which a joint is moved."""
_RAMP, _STAND = 0.2, 0.2  # s in which it is moved, and then held
SPEED = 0.4  # rad/s
_STILL = 0.02  # rad/s
_JOINT = "right_elbow"
_NOTHING = Motor(kp=0.0, kd=0.0)


class RobotScript(Script[RobotSubject]):
    """The stimulus for one robot."""

    motion = "joint"

    def __init__(
        self, plan: Plan[RobotSubject], report: Callable[[str], None] = lambda text: None
    ) -> None:
        super().__init__(plan, report)
        self.robot = robot(plan.dialect.model)
        self.codec = RobotMotorCodec(plan.dialect)
        self.joints = {ROBOT: tuple(self.robot.joint(slot) for slot in self.robot.used)}
        self.period_ns = round(1e9 / self.robot.teleop_rate)
        self.slot = self.robot.slot(_JOINT)
        self.start: dict[int, float] = {}
        self.order: list[Motor] = [_NOTHING] * self.robot.slots
        self._sent: tuple[object, bytes] = (None, b"")
        self._dry = False

    def length(self) -> float:
        """Seconds that :meth:`run` takes with a robot that reaches its goals at once, as there."""
        self._dry = True
        return super().length()

    def run(self) -> Steps:
        """The whole script."""
        yield from self.do(Send([], 0))
        self.next_ns = self.obs.now_ns
        yield from self.listen()
        if ROBOT not in self.obs.q:
            yield from self.wake()
        if ROBOT not in self.obs.q:
            self.report("no state: the rest of the script is left out")
            return
        self.start = dict(zip(self.robot.used, self.obs.q[ROBOT], strict=True))
        self.goal = {ROBOT: self.obs.q[ROBOT]}
        for slot, q in self.start.items():
            self.order[slot] = self.holding(slot, q)
        phase = self.begin("hold", (ROBOT,))
        yield from self.keep(0.4)
        self.end(phase)
        yield from self.schedule(Moment.ROUND)
        yield from self.keep(0.2)

    def wake(self) -> Steps:
        """Send commands that only damp, for a robot that waits for some before it publishes."""
        for slot in self.robot.used:
            _, kd = self.robot.client_gains[slot]
            self.order[slot] = Motor(kp=0.0, kd=kd, mode=self.robot.enable[slot])
        yield from self.keep(0.3)

    # -- orders -----------------------------------------------------------------------------

    def holding(self, slot: int, q: float) -> Motor:
        """The client's command to hold a joint."""
        kp, kd = self.robot.client_gains[slot]
        return Motor(q=q, kp=kp, kd=kd, mode=self.robot.enable[slot])

    def here(self, slot: int) -> float:
        """The joint's position, rad."""
        pose = self.obs.q.get(ROBOT, tuple(self.start.values()))
        return pose[self.robot.used.index(slot)]

    def inward(self, slot: int, by: float) -> float:
        """``by``, with the sign that leads to the middle of the joint's range."""
        joint = self.robot.joint(slot)
        return by if self.here(slot) < (joint.q_min + joint.q_max) / 2 else -by

    def put(self, order: Motors, wrong_crc: str = "", machine: int | None = None) -> Steps:
        """Send an order once."""
        if self._dry:
            yield from self.send([])
            return
        own = self.obs.machine or self.robot.mode_machine or 0
        sent = own if machine is None else machine
        key = (tuple(order), sent, wrong_crc)
        if key != self._sent[0]:  # they are held for long, and encoded once
            self._sent = (key, self.codec.encode_low_command(order, sent, wrong_crc))
        yield from self.send([(self.robot.cmd_topic, self._sent[1])])

    def keep(self, seconds: float) -> Steps:
        """Send the order as it is."""
        yield from self.repeat(seconds, lambda: self.put(self.order))

    def changed(self, **changes: float | int) -> list[Motor]:
        """The order with the joint's command changed."""
        order = list(self.order)
        order[self.slot] = replace(order[self.slot], **changes)  # type: ignore[arg-type]
        return order

    def ramp(self, goals: dict[int, float], seconds: float) -> Steps:
        """Move joints to their goals by a ramp."""
        start = {slot: self.order[slot].q for slot in goals}
        seen, reached, part = self.obs.now_ns, 0.004, 0.0
        while part < 1.0:
            now = self.obs.now_ns
            # if the kit stood still, the ramp goes on from where it was: no jump
            reached, seen = reached + min((now - seen) * 1e-9, PAUSE), now
            part = min(1.0, reached / seconds)
            for slot, goal in goals.items():
                q = start[slot] + part * (goal - start[slot])
                self.order[slot] = replace(self.order[slot], q=q)
            yield from self.put(self.order)

    def catch(self) -> None:
        """Hold the joint where it is from now on."""
        self.order[self.slot] = self.holding(self.slot, self.here(self.slot))

    def back(self) -> Steps:
        """Move every joint back to its first position, not as a phase."""
        away = {s: q for s, q in self.start.items() if self.order[s].q != q}
        if away:
            yield from self.ramp(away, _RAMP)
        begin = self.obs.now_ns
        yield from self.keep(0.1)
        while self.fastest() > _STILL and self.obs.now_ns - begin < 1e9:
            yield from self.put(self.order)

    def fastest(self) -> float:
        """The speed of the joint that moves most."""
        speeds = [abs(v) for v in self.obs.dq.get(ROBOT, ()) if math.isfinite(v)]
        return max(speeds, default=0.0)

    def phase(self, name: str, **params: str) -> Phase:
        """Begin a phase about the joint."""
        return self.begin(name, (ROBOT,), targets=None, slot=str(self.slot), **params)

    # -- motion -----------------------------------------------------------------------------

    def step(self, name: str, slot: int | None = None, **params: str) -> Steps:
        """Move a joint by a fifth of a radian, as a phase; by default the phases' own."""
        slot = self.slot if slot is None else slot
        goal = self.order[slot].q + self.inward(slot, STEP)
        index = self.robot.used.index(slot)
        targets = {ROBOT: {index: goal}}
        phase = self.begin(name, (ROBOT,), targets=targets, slot=str(slot), **params)
        yield from self.ramp({slot: goal}, _RAMP)
        yield from self.keep(_STAND)
        self.end(phase)

    def refused(self, name: str, **changes: float | int) -> Steps:
        """A command with a goal elsewhere that must have no effect, as a phase."""
        phase = self.phase(name)
        held = self.order
        goal = held[self.slot].q + self.inward(self.slot, STEP)
        self.order = self.changed(q=goal, **changes)
        yield from self.keep(0.4)
        self.end(phase)
        self.order = held

    # -- bad commands -----------------------------------------------------------------------

    def wish(self, **changes: float) -> list[Motor]:
        """The order with a goal elsewhere for the joint, for a command that must be ignored."""
        goal = self.order[self.slot].q + self.inward(self.slot, STEP)
        return self.changed(**{"q": goal, **changes})

    def bad(self, name: str, send: Callable[[], Steps], seconds: float, **params: str) -> Steps:
        """Commands that must be ignored, as a phase."""
        phase = self.phase(name, **params)
        yield from self.through(phase, seconds, send)
        yield from self.keep(0.1)
