"""The stimulus for hands of several joints.

Both hands do the same at once, except where their independence is the subject. Poses are given by
how far the flexing joints are closed, in percent, as the object is. The phases of the mode byte's
id and time-out bit are for the Dex3-1 alone.

============== =====================================================================================
listen         no commands; state must flow
approach       slowly to nearly open
joint          one joint after the other closes and opens again; where there are many, all of
               them open together at the end. Joints that share a motor are one.
step           one hand closes and opens again, the other holds
nan, out-of-   bad commands, each followed by ``recover``, a good step: not finite, far outside the
range, empty,  limits, no motors, one too few, one and more too many, two mode bytes with each
short, long,   other's id, negative gains; and a client of another type on the topic
wrong-id,
negative,
foreign
burst          hundreds of commands at once, of which the last one counts
stiff, soft    the same step with the client's gains and with a tenth of its stiffness
limp           zero gains, with a q far towards closed
lock           the same with the client's gains and status 0 or mode 0
replay         a recorded session, as recorded
load           many commands a second, and a reader that is slow
old-stamps     commands whose source timestamps are an hour old
late-joiner    a new subscriber appears
guard-drive    with time-out protection (bit 7 of the mode byte) some joints are driven by a
               velocity and others move slowly to a position, when ...
guard          ... the commands stop
guard-latch    commands to elsewhere that still have bit 7 set
guard-clear    the same without it
squeeze        close on the object, if there is one
drive          without protection: as guard-drive
silence        the commands stop for longer than the time-out
resume         a step after the silence
operator       Unitree's client in a closed loop; see :mod:`~dexkit.conformance.stimuli.operator`
two-writers    a second client commands as well, and goes
restart        the client goes away, another comes, and makes a step
shutdown       the service is stopped and started again
service-       a step after that
restart
============== =====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.motor_messages import Motor, Motors
from dexkit.conformance.stimuli.hand import HandScript
from dexkit.conformance.stimuli.script import NOT_FINITE, Pose, Steps
from dexkit.hand import JointMode, Side
from dexkit.models import JointRoles

__all__ = ["FingerScript"]


OPEN, CLOSED = 15.0, 50.0
"""Percent of closing between which the hand moves freely."""
BEYOND = 25.0
"""Percent of closing by which an object is squeezed."""
SOFTER = 0.1
"""Stiffness of a soft step as a part of the client's."""
_BOTH_WAYS = 8
"""Motors of a hand up to which each of them closes and opens alone."""
_SPEED, _DAMPING = 0.35, 0.5  # rad/s and N m s/rad of the former
# of the latter, N m/rad and N m s/rad: still under way two seconds later
_SLOW_GAINS = (0.2, 0.4)
_BAD = {
    "nan": "broken commands (NaN and infinity): nothing may move",
    "out-of-range": "commands far out of range: no harm may be done",
    "empty": "empty commands: nothing may move",
    "short": "commands for a motor too few: nothing may move",
    "long": "commands for more motors than there are: nothing may move",
    "wrong-id": "mode bytes with each other's id: the wrong joint must not move",
    "negative": "negative gains: no joint may run away",
}


class FingerScript(HandScript):
    """The script of a hand of several joints."""

    motion = "joint"
    _settling = 0.2

    def _provoke(self) -> Steps:
        sides, phases = self.plan.sides, self.plan.phases
        if "joint" in phases:
            yield from self._one_by_one()
        if "step" in phases:
            for side in sides:
                yield from self._alone(side)
        for name in _BAD:
            if name in phases:
                yield from self._bad(name)
        if "foreign" in phases:
            yield from self._foreign()
        if "burst" in phases:
            yield from self._flood()
        if phases & {"stiff", "soft"}:
            yield from self._stiff_and_soft()
        for name in ("limp", "lock"):
            if name in phases:
                yield from self._unpulled(name)
        if "replay" in phases and self.plan.session is not None:
            yield from self._replay(self.plan.session)
            yield from self._everyone("center", {s: self._home(s) for s in sides})
        if "load" in phases:
            yield from self._load()
        if "old-stamps" in phases:
            yield from self._old_stamps()
        if "late-joiner" in phases:
            yield from self._late_joiner()
        if phases & {"guard", "guard-latch", "guard-clear"}:
            yield from self._guard()
        if phases & {"squeeze", "silence", "resume"}:
            yield from self._squeeze_and_silence()

    @property
    def _roles(self) -> JointRoles:
        assert self._model.roles is not None  # a profile of several joints has them
        return self._model.roles

    # -- places -----------------------------------------------------------------------------

    def _pose(self, side: Side, percent: float) -> Pose:
        """Every joint so far closed; the thumb's sideways joint swings along."""
        return tuple(
            percent / 100 * (j.q_max if j.closing > 0 else j.q_min)
            if j.closing
            else (percent - 30) / 70 * j.q_max
            for j in self._joints[side]
        )

    def _home(self, side: Side) -> Pose:
        return self._pose(side, OPEN)

    def _other_place(self) -> dict[Side, Pose]:
        """Nearly open or half closed, whichever is farther from here."""
        places = {}
        for side in self.plan.sides:
            here = self._obs.q.get(side, self._home(side))
            places[side] = max(
                (self._pose(side, percent) for percent in (OPEN, CLOSED - 5.0)),
                key=lambda pose: sum(abs(a - b) for a, b in zip(pose, here, strict=True)),
            )
        return places

    def _reachable(self, side: Side) -> bool:
        return side not in self.plan.objects

    def _motors(self, side: Side, pose: Pose) -> Motors:
        return [
            Motor(q=q, kp=kp, kd=kd, mode=self._codec.mode(i))
            for i, (q, (kp, kd)) in enumerate(zip(pose, self._model.gains, strict=True))
        ]

    def _all(self, percent: float, **change: float) -> dict[Side, Motors]:
        """Every hand so far closed, with something else in every motor."""
        return {
            s: [replace(m, **change) for m in self._motors(s, self._pose(s, percent))]  # type: ignore[arg-type]
            for s in self.plan.sides
        }

    # -- phases -----------------------------------------------------------------------------

    def _to(self, name: str, percent: float) -> Steps:
        poses = {s: self._pose(s, percent) for s in self.plan.sides}
        yield from self._everyone(name, poses, most=1.5)

    def _one_by_one(self) -> Steps:
        self._report("one joint after the other: no other joint may move")
        sides = self.plan.sides
        motors = self._model.motors
        ways = (CLOSED, OPEN) if len(motors) <= _BOTH_WAYS else (CLOSED,)
        for joints in motors:
            for percent in ways:
                targets = {
                    s: {joint: self._pose(s, percent)[joint] for joint in joints} for s in sides
                }
                for s, moved in targets.items():
                    self._goal[s] = tuple(moved.get(i, q) for i, q in enumerate(self._goal[s]))
                phase = self._begin("joint", sides, targets=targets)
                yield from self._until_settled(phase, sides, least=0.6, most=1.5)
        if OPEN not in ways:
            yield from self._to("center", OPEN)

    def _alone(self, side: Side) -> Steps:
        self._report(f"the {side} hand alone; the other one must not move")
        for percent in (CLOSED - 5.0, OPEN):
            self._goal[side] = self._pose(side, percent)
            phase = self._begin("step", (side,), targets={side: dict(enumerate(self._goal[side]))})
            yield from self._until_settled(phase, (side,), least=0.6, most=1.5)

    def _bad(self, name: str) -> Steps:
        self._report(_BAD[name])
        yield from self._hold(0.1)
        good = {s: self._motors(s, pose) for s, pose in self._goal.items()}
        bursts: list[dict[Side, Motors]]
        if name == "nan":
            last = len(self._model.gains) - 1
            bursts = [self._broken(i, *bad) for bad in NOT_FINITE for i in (last, 0, last // 2)]
        elif name == "out-of-range":
            bursts = [self._all(OPEN, q=q) for q in (1000.0, -1000.0)]
        elif name == "empty":
            bursts = [{s: [] for s in good}]
        elif name == "short":
            bursts = [{s: motors[:-1] for s, motors in good.items()}]
        elif name == "long":
            bursts = [
                {s: [*motors, *[replace(motors[0], q=1.0)] * more] for s, motors in good.items()}
                for more in (1, 13)
            ]
        elif name == "negative":
            near = {s: self._motors(s, self._aside(s)) for s in good}
            bursts = [
                {s: [replace(m, kp=-m.kp, kd=-m.kd) for m in motors] for s, motors in near.items()}
            ]
        else:
            bursts = [{s: self._crossed(s, motors) for s, motors in good.items()}]
        payloads = [self._codec.encode(hands) for hands in bursts]
        if name == "out-of-range":
            yield from self._burst(name, payloads, 0.8, each=0.4)
        else:
            yield from self._burst(name, payloads, 0.4)
        places = self._other_place()
        yield from self._everyone("recover", places, most=1.5, after=name)

    def _aside(self, side: Side) -> Pose:
        """A tenth of each joint's range from its goal, away from the nearer end."""
        return tuple(
            q + math.copysign(0.1 * j.stroke, 0.5 * (j.q_min + j.q_max) - q)
            for q, j in zip(self._goal[side], self._joints[side], strict=True)
        )

    def _broken(self, joint: int, field: str, value: float) -> dict[Side, Motors]:
        """One bad field in one joint; all joints have far goals, to show if one is obeyed."""
        far = self._other_place()
        hands: dict[Side, Motors] = {}
        for s, pose in far.items():
            motors = list(self._motors(s, pose))
            motors[joint] = replace(motors[joint], **{field: value})  # type: ignore[arg-type]
            hands[s] = motors
        return hands

    def _crossed(self, side: Side, motors: Motors) -> Motors:
        """Two motors with each other's id, and a goal elsewhere for the first."""
        first, other = self._roles.crossed
        target = self._other_place()[side][first]
        crossed = list(motors)
        crossed[first] = replace(motors[first], q=target, mode=self._codec.mode(other))
        crossed[other] = replace(motors[other], mode=self._codec.mode(first))
        return crossed

    def _stiff_and_soft(self) -> Steps:
        self._report("a stiff step and a soft one: the gains must make a difference")
        yield from self._to("center", OPEN)
        for name, percent, part in (("stiff", CLOSED - 5.0, 1.0), ("soft", OPEN, SOFTER)):
            poses = {s: self._pose(s, percent) for s in self.plan.sides}
            targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
            phase = self._begin(name, self.plan.sides, targets=targets)
            motors = {
                s: [replace(m, kp=part * m.kp) for m in self._motors(s, pose)]
                for s, pose in poses.items()
            }
            yield from self._hold(0.6, motors)
            self._end(phase)
            self._goal.update(poses)
        yield from self._to("center", OPEN)

    def _unpulled(self, name: str) -> Steps:
        self._report(
            "commands without force (zero gains): the hand must not be pulled"
            if name == "limp"
            else "locked motors: they must not follow their q"
        )
        sides = self.plan.sides
        yield from self._hold(0.1)
        targets = {s: dict(enumerate(self._pose(s, CLOSED))) for s in sides}
        phase = self._begin(name, sides, targets=targets)
        if name == "limp":
            motors = self._all(CLOSED, kp=0.0, kd=0.0)
        else:
            motors = {
                s: [
                    replace(m, mode=self._codec.mode(i, JointMode.BRAKE))
                    for i, m in enumerate(every)
                ]
                for s, every in self._all(CLOSED).items()
            }
        yield from self._hold(0.5, motors)
        self._end(phase)
        yield from self._to("center", OPEN)

    def _drive(
        self, name: str, sides: Sequence[Side], others: Mapping[Side, Motors], *, guard: bool
    ) -> Steps:
        """Some joints by velocity, others slowly to a position: both are under way for long."""
        hands = dict(others)
        targets: dict[Side, dict[int, float]] = {}
        for s in sides:
            motors = [
                replace(m, mode=self._codec.mode(i, timeout=guard))
                for i, m in enumerate(self._motors(s, self._goal[s]))
            ]
            far = self._pose(s, CLOSED)
            for i in self._roles.driven:
                speed = math.copysign(_SPEED, self._joints[s][i].closing)
                motors[i] = replace(motors[i], dq=speed, kp=0.0, kd=_DAMPING)
            for i in self._roles.slow:
                motors[i] = replace(motors[i], q=far[i], kp=_SLOW_GAINS[0], kd=_SLOW_GAINS[1])
            hands[s] = motors
            targets[s] = {i: far[i] for i in self._roles.slow}
        phase = self._begin(name, sides, targets=targets)
        yield from self._hold(0.3, hands)
        self._end(phase)

    def _guard(self) -> Steps:
        sides = self.plan.sides
        timeout = self._model.command_timeout
        self._report("moving with time-out protection, and then ...")
        yield from self._drive("guard-drive", sides, {}, guard=True)
        self._report("... silence: after a second the motors must brake, and say so")
        yield from self._silence("guard", timeout + 0.7)
        self._report("they stay braked until the protection is cleared")
        poses = {s: self._pose(s, CLOSED - 5.0) for s in sides}
        targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
        phase = self._begin("guard-latch", sides, targets=targets)
        guarded = {
            s: [replace(m, mode=self._codec.mode(i, timeout=True)) for i, m in enumerate(motors)]
            for s, motors in self._all(CLOSED - 5.0).items()
        }
        yield from self._hold(0.4, guarded)
        self._end(phase)
        yield from self._everyone("guard-clear", poses, most=1.5)
        yield from self._to("center", OPEN)

    def _squeeze_and_silence(self) -> Steps:
        sides = self.plan.sides
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        squeeze = {
            s: self._motors(s, self._pose(s, self.plan.objects[s] + BEYOND)) for s in pressing
        }
        if pressing:
            self._report("squeezing the object")
            targets = {
                s: {i: m.q for i, m in enumerate(squeeze[s]) if self._joints[s][i].closing}
                for s in pressing
            }
            phase = self._begin("squeeze", pressing, targets=targets)
            yield from self._hold(1.0, squeeze)
            self._end(phase)
        if self.plan.phases & {"silence", "resume"}:
            self._report("slow motion without protection, and then ...")
            yield from self._drive("drive", free, squeeze, guard=False)
            self._report("... silence: nothing may be left driven by a velocity, a grip is kept")
            yield from self._silence("silence", self._model.command_timeout + 0.7)
        yield from self._everyone("resume", {s: self._home(s) for s in sides}, most=1.5)
