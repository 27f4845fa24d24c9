"""The stimulus for hands of several joints.

Both hands do the same at once, except where their independence is the subject. Poses are given by
how far the flexing joints are closed, in percent, as the object is. The phases of the mode byte's
id and time-out bit are for the Dex3-1 alone.

============== =====================================================================================
listen         no commands; state must flow
approach       slowly to nearly open
joint          one joint after the other closes; then every second one opens, and the others.
               Where there are many, all of them open together. Joints that share a motor are one.
step           one hand closes and opens again, the other holds
fingerprint    steps to compare the ``recover`` steps with
nan, out-of-   bad commands, each followed by ``recover``, a good step: not finite, far outside the
range, empty,  limits, no motors, one too few, one and more too many, two mode bytes with each
short, long,   other's id, negative gains; and a client of another type on the topic. Each kind
wrong-id,      stands for a while, on each side alone.
negative,
foreign
beside         a step of one side while the other one gets bad commands, or none
burst          hundreds of commands at once, of which the last one counts
stiff, soft,   a step with the client's gains, with a tenth of its stiffness and with a third of it
mild
limp           zero gains, with a q far towards closed
lock           the same with the client's gains and status 0 or mode 0
push, pull     a torque alone, without a position gain: towards closed, and towards open
replay         a recorded session, as recorded
single         commands that are sent once
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
silence        the commands stop for longer than the time-out; then on each side alone, while
               rejected commands arrive
resume         a step after the silence
operator       Unitree's client in a closed loop; see :mod:`~dexkit.conformance.stimuli.operator`
two-writers    a second client commands another place, and goes
company        a second client commands the same: steps of each side alone, and of both in
               opposite directions
restart        the client goes away, another comes, and makes such steps; each kind of bad
               commands again
shutdown       the service is stopped and started again
restarted      no commands
service-       such steps after that; silence again
restart
============== =====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.motor_messages import Motor, Motors
from dexkit.conformance.stimuli.hand import BETWEEN, HandScript
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
MILD = 1.0 / 3.0
"""The same of a step with the stiffness of Unitree's C++ example, 0.5 N m/rad where its grip has
1.5 (docs/sources/unitree-dex.md#b1)."""
_OPENED = 8
"""Motors of a hand up to which their opening is judged as their closing is."""
_PUSH, _PUSH_DAMPING, _PUSH_SECONDS = 0.3, 0.5, 0.3  # N m, N m s/rad, s
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
    _standing = 0.1
    _least = 0.5

    def _provoke(self) -> Steps:
        sides, phases = self.plan.sides, self.plan.phases
        if "joint" in phases:
            yield from self._one_by_one()
        if "step" in phases:
            for side in sides:
                yield from self._alone(side)
        if "fingerprint" in phases:
            for _ in range(2):
                yield from self._everyone("fingerprint", self._other_place(), most=1.5)
        for name in _BAD:
            if name in phases:
                yield from self._bad(name)
        if "foreign" in phases:
            yield from self._foreign()
        if "burst" in phases:
            yield from self._flood()
        if phases & {"stiff", "soft", "mild"}:
            yield from self._stiff_and_soft()
        for name in ("limp", "lock"):
            if name in phases:
                yield from self._unpulled(name)
        if "push" in phases:
            yield from self._pushes()
        if "replay" in phases and self.plan.session is not None:
            yield from self._replay(self.plan.session)
            yield from self._everyone("center", {s: self._home(s) for s in sides})
        if "single" in phases:
            yield from self._single()
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
        turns = [(joints, CLOSED) for joints in motors]
        few = len(motors) <= _OPENED
        if few:  # no two neighbours together: those are the ones that get mixed up
            turns += [(sum(motors[i::2], ()), OPEN) for i in (0, 1)]
        for joints, percent in turns:
            targets = {s: {joint: self._pose(s, percent)[joint] for joint in joints} for s in sides}
            for s, moved in targets.items():
                self._goal[s] = tuple(moved.get(i, q) for i, q in enumerate(self._goal[s]))
            phase = self._begin("joint", sides, targets=targets)
            yield from self._until_settled(phase, sides, least=0.6, most=1.5)
        if not few:
            yield from self._turn("center", {s: self._pose(s, OPEN) for s in sides}, least=0.5)

    def _alone(self, side: Side) -> Steps:
        self._report(f"the {side} hand alone; the other one must not move")
        for percent in (CLOSED - 5.0, OPEN):
            yield from self._turn("step", {side: self._pose(side, percent)}, least=0.6)

    def _bad(self, name: str) -> Steps:
        self._report(_BAD[name])
        yield from self._hold(0.1)
        if name == "nan":
            for side in self.plan.sides:
                kinds = [{side: motors} for motors in self._not_finite(side)]
                yield from self._bad_commands(name, (side,), kinds, 0.08)
        elif name == "out-of-range":
            far = [
                {s: self._at(s, [end] * len(self._joints[s])) for s in self.plan.sides}
                for end in (1000.0, -1000.0)
            ]
            for way in (0.3, -0.3):
                ends = {
                    s: [(j.q_max if way > 0 else j.q_min) + way * j.stroke for j in joints]
                    for s, joints in self._joints.items()
                }
                far.append({s: self._at(s, ends[s]) for s in self.plan.sides})
            yield from self._bad_commands(name, self.plan.sides, far, 0.3)
        else:
            for alone in self._each_alone():
                kinds_by_side = {s: self._malformed(name, s) for s in alone}
                for i in range(len(kinds_by_side[alone[0]])):
                    kind = {s: kinds_by_side[s][i] for s in alone}
                    yield from self._bad_commands(name, alone, [kind], 0.25)
        yield from self._everyone("recover", self._other_place(), most=1.5, after=name)

    def _at(self, side: Side, q: Sequence[float]) -> Motors:
        return [replace(m, q=x) for m, x in zip(self._motors(side, tuple(q)), q, strict=True)]

    def _malformed(self, name: str, side: Side) -> list[Motors]:
        """The bad commands of a phase to one side."""
        good = self._motors(side, self._goal[side])
        if name == "empty":
            return [[]]
        if name == "short":
            return [good[:-1]]
        if name == "long":
            return [[*good, *[replace(good[0], q=1.0)] * more] for more in (1, 13)]
        if name == "negative":
            near = self._motors(side, self._aside(side, 0.1))
            return [[replace(m, kp=-m.kp, kd=-m.kd) for m in near]]
        return [self._crossed(side, good)]

    def _not_finite(self, side: Side) -> list[Motors]:
        """One bad field in one joint each: the last, the first and a middle one in turn."""
        last = len(self._model.gains) - 1
        joints = (last, 0, last // 2)
        return [
            self._broken(side, joints[(i + i // 3) % 3], field, value)
            for i, (field, value) in enumerate(NOT_FINITE)
        ]

    def _broken(self, side: Side, joint: int, field: str, value: float) -> Motors:
        """One bad field in one joint; all joints have far goals, to show if one is obeyed."""
        motors = list(self._motors(side, self._other_place()[side]))
        motors[joint] = replace(motors[joint], **{field: value})  # type: ignore[arg-type]
        return motors

    def _again(self) -> Steps:
        self._report("bad commands of the new client: nothing may move")
        sides = self.plan.sides
        every = {s: self._not_finite(s) for s in sides}
        kinds = [{s: every[s][i] for s in sides} for i in range(0, len(NOT_FINITE), 2)]
        yield from self._bad_commands("nan", sides, kinds, 0.08)
        for name in ("empty", "short", "long", "negative"):
            if name in self.plan.phases:
                yield from self._hold(BETWEEN)
                bad = {s: self._malformed(name, s)[0] for s in sides}
                yield from self._bad_commands(name, sides, [bad], 0.15)
        yield from self._far_away(1000.0, 0.2)
        yield from self._everyone(
            "recover", self._other_place(), most=1.5, after=self._bad_phases_since_recovery
        )

    def _before_shutdown(self) -> Steps:
        """Move: what was commanded last must not be in force after the restart."""
        yield from self._to("center", OPEN)
        yield from self._drive("drive", self.plan.sides, {}, guard=False)

    def _silent_again(self) -> Steps:
        yield from self._to("center", OPEN)
        yield from self._drive("drive", self.plan.sides, {}, guard=False)
        yield from self._silence("silence", self._model.command_timeout + 0.7)
        yield from self._to("resume", CLOSED - 5.0)

    def _silent_alone(self, side: Side, rejected: Motors) -> Steps:
        """No command to one side but rejected ones, while it moves and the other is commanded."""
        self._report(f"no good commands to the {side} hand alone: nothing may be left driven")
        yield from self._drive("drive", (side,), {}, guard=False)
        yield from self._silence_alone("silence", side, {side: rejected})
        yield from self._everyone("resume", {s: self._home(s) for s in self.plan.sides}, most=1.5)

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
        steps = [("stiff", CLOSED - 5.0, 1.0), ("soft", OPEN, SOFTER)]
        if "mild" in self.plan.phases:
            steps.append(("mild", CLOSED - 5.0, MILD))
        for name, percent, part in steps:
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

    def _pushes(self) -> Steps:
        """Close and open all flexing joints by a torque alone."""
        self._report("a torque without a position gain: the joints must move with it")
        sides = self.plan.sides
        for name, way, percent in (("push", 1, 100.0), ("pull", -1, 0.0)):
            targets = {s: self._pose(s, percent) for s in sides}
            flexing = {s: [i for i, j in enumerate(self._joints[s]) if j.closing] for s in sides}
            phase = self._begin(
                name, sides, targets={s: {i: targets[s][i] for i in flexing[s]} for s in sides}
            )
            motors = {s: list(self._motors(s, self._goal[s])) for s in sides}
            for s in sides:
                for i in flexing[s]:
                    tau = way * math.copysign(_PUSH, self._joints[s][i].closing)
                    motors[s][i] = replace(motors[s][i], tau=tau, kp=0.0, kd=_PUSH_DAMPING)
            yield from self._hold(_PUSH_SECONDS, motors)
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
        yield from self._bad_at_once({s: self._not_finite(s)[-1] for s in sides})
        if len(sides) > 1 and "silence" in self.plan.phases:
            for side, bad in zip(sides, (math.nan, math.inf), strict=True):
                home = self._motors(side, self._home(side))
                yield from self._silent_alone(side, [replace(m, q=bad) for m in home])
