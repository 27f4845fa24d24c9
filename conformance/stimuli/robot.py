"""The stimulus for a robot; see :mod:`dexkit.conformance.stimuli`.

Commands come at xr_teleoperate's rate with its gains; a joint is moved by a ramp, toward the
middle of its range. All but the first two phases are about one joint, the right elbow.

============== =====================================================================================
listen         nothing is sent; state must flow, and nothing move
hold           every motor holds where it is
joint          each joint in turn by a fifth of a radian; its slot is ``params["slot"]``
stiffness      a quarter of the client's kp, and a torque against it
velocity       kp 0, a speed, kd
torque         kp and kd 0, a torque, until the joint has moved
limp           kp 0, and a q elsewhere
off            mode 0, and a command that asks to move
wrong-crc      commands that ask to move, with wrong CRCs; their kind is ``params["kind"]``
nan            commands that ask to move, with NaN or infinity somewhere; ``params["kind"]``
unused         a slot without a motor is driven
machine        commands for another machine (robots whose messages have ``mode_machine``)
foreign        commands of the other family's type
recover        a step, after all that
late-joiner    a new subscriber appears
pause          0.3 s without a command while the joint is driven by a speed
silence        more than a second likewise
resume         commands again: hold at first, then a step
restart        the client goes away, another comes, and makes a step
============== =====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from dexkit.command_age import PAUSE
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.robot import WRONG_CRCS, RobotMotorCodec
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.script import (
    Join,
    Leave,
    Part,
    Plan,
    Restart,
    Role,
    Script,
    Send,
    Steps,
)
from dexkit.hand import ROBOT, RobotSubject
from dexkit.robots import robot

__all__ = ["STEP", "RobotScript"]

STEP = 0.2
"""rad by which a joint is moved."""
_RAMP, _STAND = 0.2, 0.2  # s in which it is moved, and then held
_SPEED = 0.4  # rad/s
_TORQUE_PART = 0.1  # of the joint's largest torque
_MOVED = 0.1  # rad after which the torque is taken off
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
        self._robot = robot(plan.dialect.model)
        self._codec = RobotMotorCodec(plan.dialect)
        self._joints = {ROBOT: tuple(self._robot.joint(slot) for slot in self._robot.used)}
        self._period_ns = round(1e9 / self._robot.teleop_rate)
        self._slot = self._robot.slot(_JOINT)
        self._start: dict[int, float] = {}
        self._order: list[Motor] = [_NOTHING] * self._robot.slots
        self._sent: tuple[object, bytes] = (None, b"")
        self._dry = False

    def length(self) -> float:
        """Seconds that :meth:`run` takes with a robot that reaches its goals at once, as there."""
        self._dry = True
        return super().length()

    def run(self) -> Steps:
        """The whole script."""
        yield from self._do(Send([], 0))
        self._next_ns = self._obs.now_ns
        yield from self._listen()
        if ROBOT not in self._obs.q:
            yield from self._wake()
        if ROBOT not in self._obs.q:
            self._report("no state: the rest of the script is left out")
            return
        self._start = dict(zip(self._robot.used, self._obs.q[ROBOT], strict=True))
        self._goal = {ROBOT: self._obs.q[ROBOT]}
        for slot, q in self._start.items():
            self._order[slot] = self._holding(slot, q)
        phase = self._begin("hold", (ROBOT,))
        yield from self._keep(0.4)
        self._end(phase)
        yield from self._provoke()
        yield from self._keep(0.2)

    def _wake(self) -> Steps:
        """Send commands that only damp, for a robot that waits for some before it publishes."""
        for slot in self._robot.used:
            _, kd = self._robot.client_gains[slot]
            self._order[slot] = Motor(kp=0.0, kd=kd, mode=self._robot.enable[slot])
        yield from self._keep(0.3)

    def _provoke(self) -> Steps:
        """Every phase after the first two."""
        longer = self._robot.command_timeout + 0.6
        parts: dict[str, Callable[[], Steps]] = {
            "joint": self._every_joint,
            "stiffness": self._stiffness,
            "velocity": self._velocity,
            "torque": self._torque,
            "limp": lambda: self._refused("limp", kp=0.0),
            "off": lambda: self._refused("off", mode=0),
            "wrong-crc": self._wrong_crc,
            "nan": self._not_a_number,
            "unused": self._unused,
            "machine": self._machine,
            "foreign": self._foreign,
            "recover": lambda: self._step("recover"),
            "late-joiner": self._late_joiner,
            "pause": lambda: self._silence("pause", 0.3),
            "silence": lambda: self._silence("silence", longer),
            "resume": self._resume,
            "restart": self._restart,
        }
        yield from self._schedule([Part.of(name, play, back=True) for name, play in parts.items()])

    # -- orders -----------------------------------------------------------------------------

    def _holding(self, slot: int, q: float) -> Motor:
        kp, kd = self._robot.client_gains[slot]
        return Motor(q=q, kp=kp, kd=kd, mode=self._robot.enable[slot])

    def _here(self, slot: int) -> float:
        """The joint's position, rad."""
        pose = self._obs.q.get(ROBOT, tuple(self._start.values()))
        return pose[self._robot.used.index(slot)]

    def _inward(self, slot: int, by: float) -> float:
        """``by``, with the sign that leads to the middle of the joint's range."""
        joint = self._robot.joint(slot)
        return by if self._here(slot) < (joint.q_min + joint.q_max) / 2 else -by

    def _put(self, order: Motors, wrong_crc: str = "", machine: int | None = None) -> Steps:
        if self._dry:
            yield from self._send([])
            return
        own = self._obs.machine or self._robot.mode_machine or 0
        sent = own if machine is None else machine
        key = (tuple(order), sent, wrong_crc)
        if key != self._sent[0]:  # they are held for long, and encoded once
            self._sent = (key, self._codec.encode_low_command(order, sent, wrong_crc))
        yield from self._send([(self._robot.cmd_topic, self._sent[1])])

    def _keep(self, seconds: float) -> Steps:
        """Send the order as it is."""
        yield from self._repeat(seconds, lambda: self._put(self._order))

    def _with(self, **changes: float | int) -> list[Motor]:
        """The order with the joint's command changed."""
        order = list(self._order)
        order[self._slot] = replace(order[self._slot], **changes)  # type: ignore[arg-type]
        return order

    def _ramp(self, goals: dict[int, float], seconds: float) -> Steps:
        """Move joints to their goals by a ramp."""
        start = {slot: self._order[slot].q for slot in goals}
        seen, reached, part = self._obs.now_ns, 0.004, 0.0
        while part < 1.0:
            now = self._obs.now_ns
            # if the kit stood still, the ramp goes on from where it was: no jump
            reached, seen = reached + min((now - seen) * 1e-9, PAUSE), now
            part = min(1.0, reached / seconds)
            for slot, goal in goals.items():
                q = start[slot] + part * (goal - start[slot])
                self._order[slot] = replace(self._order[slot], q=q)
            yield from self._put(self._order)

    def _catch(self) -> None:
        """Hold the joint where it is from now on."""
        self._order[self._slot] = self._holding(self._slot, self._here(self._slot))

    def _back(self) -> Steps:
        """Move every joint back to its first position, not as a phase."""
        away = {s: q for s, q in self._start.items() if self._order[s].q != q}
        if away:
            yield from self._ramp(away, _RAMP)
        begin = self._obs.now_ns
        yield from self._keep(0.1)
        while self._fastest() > _STILL and self._obs.now_ns - begin < 1e9:
            yield from self._put(self._order)

    def _fastest(self) -> float:
        """The speed of the joint that moves most."""
        speeds = [abs(v) for v in self._obs.dq.get(ROBOT, ()) if math.isfinite(v)]
        return max(speeds, default=0.0)

    def _phase(self, name: str, **params: str) -> Phase:
        return self._begin(name, (ROBOT,), targets=None, slot=str(self._slot), **params)

    # -- motion -----------------------------------------------------------------------------

    def _step(self, name: str, slot: int | None = None, **params: str) -> Steps:
        slot = self._slot if slot is None else slot
        goal = self._order[slot].q + self._inward(slot, STEP)
        index = self._robot.used.index(slot)
        targets = {ROBOT: {index: goal}}
        phase = self._begin(name, (ROBOT,), targets=targets, slot=str(slot), **params)
        yield from self._ramp({slot: goal}, _RAMP)
        yield from self._keep(_STAND)
        self._end(phase)

    def _every_joint(self) -> Steps:
        self._report("moving one joint at a time by 0.2 rad")
        for slot in self._robot.used:
            yield from self._step("joint", slot)

    def _stiffness(self) -> Steps:
        self._report("a soft joint, a speed, a torque")
        kp, _ = self._robot.client_gains[self._slot]
        soft = kp / 4
        self._order = self._with(kp=soft)
        yield from self._keep(0.2)
        way = self._inward(self._slot, 0.1)
        phase = self._phase("stiffness", way=repr(way))
        self._order = self._with(tau=soft * way)
        yield from self._keep(0.6)
        self._end(phase)
        self._order = self._with(tau=0.0)
        yield from self._keep(0.2)
        self._order = self._with(kp=kp)

    def _velocity(self) -> Steps:
        speed = self._inward(self._slot, _SPEED)
        phase = self._phase("velocity", speed=repr(speed))
        self._order = self._with(kp=0.0, dq=speed)
        yield from self._keep(0.5)
        self._end(phase)
        self._catch()

    def _torque(self) -> Steps:
        torque = self._inward(self._slot, _TORQUE_PART * self._robot.joint(self._slot).tau_max)
        phase = self._phase("torque", torque=repr(torque))
        begin = self._here(self._slot)
        self._order = self._with(kp=0.0, kd=0.0, tau=torque)
        while self._elapsed(phase) < 0.4 and abs(self._here(self._slot) - begin) < _MOVED:
            yield from self._put(self._order)
        self._end(phase)
        self._catch()
        yield from self._keep(0.2)

    def _refused(self, name: str, **changes: float | int) -> Steps:
        """A command with a goal elsewhere that must have no effect, as a phase."""
        phase = self._phase(name)
        held = self._order
        goal = held[self._slot].q + self._inward(self._slot, STEP)
        self._order = self._with(q=goal, **changes)
        yield from self._keep(0.4)
        self._end(phase)
        self._order = held

    # -- bad commands -----------------------------------------------------------------------

    def _wish(self, **changes: float) -> list[Motor]:
        """The order with a goal elsewhere for the joint, for a command that must be ignored."""
        goal = self._order[self._slot].q + self._inward(self._slot, STEP)
        return self._with(**{"q": goal, **changes})

    def _bad(self, name: str, send: Callable[[], Steps], seconds: float, **params: str) -> Steps:
        phase = self._phase(name, **params)
        yield from self._through(phase, seconds, send)
        yield from self._keep(0.1)

    def _wrong_crc(self) -> Steps:
        self._report("commands that are wrong: nothing may move")
        for kind in WRONG_CRCS:
            order = self._wish()
            yield from self._bad("wrong-crc", partial(self._put, order, kind), 0.25, kind=kind)

    def _not_a_number(self) -> Steps:
        kinds = {"q": math.nan, "dq": math.inf, "tau": math.nan, "kp": math.inf, "kd": math.nan}
        for kind, value in kinds.items():
            order = self._wish(**{kind: value})
            yield from self._bad("nan", partial(self._put, order), 0.15, kind=kind)

    def _unused(self) -> Steps:
        order = list(self._order)
        for slot in set(range(self._robot.slots)) - set(self._robot.used):
            order[slot] = Motor(q=1.0, dq=0.0, tau=5.0, kp=100.0, kd=3.0, mode=1)
        yield from self._bad("unused", lambda: self._put(order), 0.3)

    def _machine(self) -> Steps:
        other = self._obs.machine % 255 + 1
        order = self._wish()
        yield from self._bad("machine", lambda: self._put(order, machine=other), 0.3)

    def _foreign(self) -> Steps:
        yield Join(Role.STRANGER)
        wish = list(self._order)  # of every joint: the families' slots are not the same
        for slot in self._robot.used:
            wish[slot] = replace(wish[slot], q=wish[slot].q + self._inward(slot, STEP))
        payload = self._codec.encode_foreign_command(wish)

        def send() -> Steps:
            self._next_ns += self._period_ns
            payloads = [(self._robot.cmd_topic, payload)]
            yield from self._do(Send(payloads, self._next_ns, by=Role.STRANGER))

        yield from self._keep(0.1)
        yield from self._bad("foreign", send, 0.3)
        yield Leave(Role.STRANGER)

    # -- silence and life cycle ----------------------------------------------------------------

    def _silence(self, name: str, seconds: float) -> Steps:
        self._report(
            "commands pause while a joint is driven: it may go on for a second, not longer"
        )
        speed = self._inward(self._slot, _SPEED)
        self._order = self._with(kp=0.0, dq=speed)
        yield from self._keep(0.3)
        phase = self._phase(name, speed=repr(speed))
        yield from self._through(phase, seconds, lambda: self._wait(0.02))
        self._catch()
        if name == "silence" and "resume" in self.plan.phases:
            yield from self._resume()

    def _resume(self) -> Steps:
        if any(p.name == "resume" for p in self.phases):
            return
        self._next_ns = self._obs.now_ns
        phase = self._phase("resume", what="hold")
        yield from self._keep(0.3)
        self._end(phase)
        yield from self._step("resume", what="step")

    def _late_joiner(self) -> Steps:
        phase = self._phase("late-joiner")
        yield Join()
        while self._elapsed(phase) < 2.0 and ROBOT not in self._obs.joined:
            yield from self._put(self._order)
        phase.observed[f"first_state_s_{ROBOT}"] = self._obs.joined.get(ROBOT)
        self._end(phase)
        yield Leave()

    def _restart(self) -> Steps:
        self._report("the commanding program is restarted: the new one must be obeyed")
        yield Restart()
        self._next_ns = self._obs.now_ns
        yield from self._keep(0.2)
        yield from self._step("restart")
