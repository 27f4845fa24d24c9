"""The stimulus for a gripper of one joint, the Dex1-1.

Order of the phases: what may disturb a hand comes after what needs it undisturbed.

============== =====================================================================================
listen         no commands; state must flow
approach       slowly to mid stroke
step           large steps of one side, the others hold
ends           fully open, and fully closed where there is no object
grip           (first) close on the object before anything has disturbed the hand
stiffness      a torque pushes a hand that is held by kp without contact: before anything has
               disturbed it, after the bad commands and at the end
dead-zone      where a dialect has them (``unitree_hg``): the inner limits of the zones that mean
               fully open and fully closed
fingerprint    steps to compare the ``recover`` steps with
nan, out-of-   bad commands, followed by ``recover``, a good step: not finite; far outside the
range, empty,  stroke; no motor, and motors too many; negative gains; and a client of another type
long,          on the topic. Each kind stands for a while, on each side alone.
negative,
foreign
beside         a step of one side while the other one gets bad commands, or none
burst          hundreds of commands at once, of which the last one counts
limp           zero gains of one side after the other, with a q far towards closed and then open
unlike         steps of the other side meanwhile
pull, push     a torque alone, without a position gain: towards closed, and towards open; one side
               is pulled while the other one is pushed
fed            a step to the middle whose commands have a velocity and a torque, too
replay         a recorded session, as recorded
single         commands that are sent once
load           many commands a second, and a reader that is slow
old-stamps     commands whose source timestamps are an hour old
late-joiner    a new subscriber appears
grip           close on the object, if there is one, by xr_teleoperate's lead: equal commands for
               long, 30 a second; meanwhile the other side is held without contact, and pushed by a
               torque at first and at last (nudge)
squeeze        the same after it has opened, by half as much again
release        zero gains at the q of the squeeze
soft-grip      grips of less stiffness
drive          velocity command (dq, kd) without position gain, so that the hand moves when ...
silence        ... the commands stop for longer than counters of 8 bits last
rejected       only commands that are not finite
resume         a step after the silence, also away from where the hand was going
soft           a step of less stiffness
operator       Unitree's client in a closed loop; see :mod:`~dexkit.conformance.stimuli.operator`
two-writers    a second client commands another place, and goes
company        a second client commands the same: steps of each side alone, and of both in
               opposite directions
restart        the client goes away, another comes, and makes such steps; each kind of bad
               commands again
regrip         a grip after all of this
shutdown       the service is stopped and started again while the hand grips or moves
restarted      no commands
service-       such steps after that; silence again
restart
============== =====================================================================================
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.stimuli.hand import ASIDE, ASIDE_SECONDS, BETWEEN, HandScript
from dexkit.conformance.stimuli.script import NOT_FINITE, Part, Payloads, Plan, Pose, Steps
from dexkit.hand import Side
from dexkit.models import ModeByte

__all__ = ["GripperScript"]

# of the stroke: how far xr_teleoperate commands ahead (docs/sources/unitree-dex.md#b3)
LEAD = 0.18 / 5.4
_CLOSES, _OPENS = 0.09, 6.02
"""rad, just within the zones that mean fully closed and open in the gripper's DDS interface
specification: their limits, 0.1 and 6.0, are no exact numbers in a message."""
_PUSH = (0.25, 1.0)
"""Least and greatest torque of a push, N m: the greatest is that of a grip by the client's lead."""
_LATE = "grip nudge squeeze release soft-grip soft silence resume rejected"
"""Phases that come one after the other, as each begins where the one before it ends."""
_NEARLY = 0.15
"""Part of the stroke to which a free hand is closed before it is driven open."""
_BACK = 0.13
"""Part of the stroke by which a free hand is commanded back after a restart of its service."""
_FIRST_GRIP = 1.8
"""Seconds of the first grip: until a driver has lowered its effort (DEX1-FORCE-10), and a little
more."""
_GRIP, _LONG_GRIP = 3.0, 30.0
"""Seconds of equal commands between two pushes; those of a thorough run."""
_SQUEEZE = 1.3
"""Seconds of a squeeze: contact takes 0.3 s on an idle machine, and twice that after a pause."""
_SILENCE, _LONG_SILENCE = 3.8, 67.0
"""Seconds without a command: longer than counters of 8 bits in steps of 10 ms last; in a thorough
run, than those of 16 bits in milliseconds."""
_CAMERA_HZ = 30.0
"""Commands a second of a client that sends one for each picture of a camera."""
_NUDGE, _NUDGE_SECONDS = 0.6, 0.3
"""A torque that pushes a hand that is held by kp, N m, and for how long, s."""
_BACK_SECONDS = 0.15
"""Seconds in which it comes back from there."""
_LIMP_SECONDS = 0.25
"""Seconds of zero gains with one q; the other side makes a step meanwhile, as in ``single``."""
_SOFT_GRIPS = ((1.9, 0.3), (0.8, 0.6), (8.0, 0.2))
"""kp, N m/rad, and how far they are commanded into the object, rad: 0.5 to 1.6 N m each. The last
is beyond what a byte holds in steps of 1/32, and about the lead of xr_teleoperate."""
_SOFT_SECONDS = 0.5
_VENDORS_MODE = 1
"""Mode byte of the vendor's test programs; teleoperation sends 0
(docs/sources/unitree-dex.md#b1)."""
_ALONE_SECONDS = 0.35
"""Seconds in which the first command after a silence is the only one: a hand that has received it
has begun to move by then (DEX1-MOVE-09)."""
_BEYOND, _BEYOND_TAU, _BEYOND_AFTER = 0.05, 0.7, 0.3
"""A grip by a q below the closed end: by which part of the stroke, its torque, N m, and how much
longer than a time-out it lasts, s: a command that is clamped is in force as any other."""
_RELEASE = 0.3
"""Seconds of zero gains at the q of a squeeze."""
_SLOWEST_HZ, _FASTEST_HZ = 30.0, 1000.0
"""Commands a second before a silence: the time-out counts seconds, whatever the client's rate."""
_SOFTEST, _SOFT_STEP = 0.8, 0.3
"""kp, N m/rad, and size, in parts of the stroke, of a soft step."""
_PUSH_SPEED, _PUSH_DAMPING, _PUSH_SECONDS = 0.1, 0.3, 0.35  # strokes/s, N m s/rad, s
_FED_DQ, _FED_TAU, _FED_SECONDS = -0.5, 0.1, 0.6
"""A feed-forward towards closed and a torque towards open, rad/s and N m, and for how long, s: with
the client's gains they move the end of a step by less than 0.02 rad. A hand that takes them for
limits makes a quarter of the step."""
_BAD = {
    "nan": "broken commands (NaN and infinity): nothing may move",
    "out-of-range": "commands far out of range: no harm may be done",
    "empty": "empty commands: nothing may move",
    "long": "commands for more motors than there are: nothing may move",
    "negative": "negative gains: the hand must not run away",
}


class GripperScript(HandScript):
    """The script of a gripper."""

    def __init__(self, plan: Plan[Side], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(plan, report)
        self._stroke = plan.dialect.q_open
        # the interface specification: in unitree_hg the gains, dq and tau of a command are not used
        self._gains_used = plan.dialect.gains_are_used
        self._gainless = False
        """Whether commands have no gains: clients of a dialect that does not use them send none."""
        self._mode = 0
        """The mode byte of position commands, in dialects that do not use it."""
        self._grip: dict[Side, Motors] = {}
        """Commands to a side instead of its goal; no commands if empty."""

    def _provocations(self) -> list[Part]:
        gains, zones = self._gains_used, self.plan.dialect.interface_specification
        bad = self._bad_together
        return [
            Part.of("step", self._each_hand),
            Part.of("ends", self._ends, back=True),
            Part.of("grip stiffness", self._at_first),
            Part.of("dead-zone", self._dead_zones, back=True, applies=zones),
            Part.of("fingerprint", self._fingerprint),
            Part.of("nan", partial(bad, ["nan"])),
            Part.of("out-of-range", partial(bad, ["out-of-range"])),
            Part.of("empty long", partial(bad, ["empty", "long"])),
            Part.of("negative", partial(bad, ["negative"]), applies=gains),
            Part.of("foreign", partial(bad, ["foreign"], most=1.5)),
            Part.of("stiffness", partial(self._stiffness, self.plan.sides)),
            Part.of("burst", self._flood),
            Part.of("limp unlike push drive fed", self._undriven, back=True, applies=gains),
            Part.of("", self._without_gains, applies=not gains),
            Part.of("replay", self._session),
            Part.of("single", self._single),
            Part.of("load", self._load),
            Part.of("old-stamps", self._old_stamps),
            Part.of("late-joiner", self._late_joiner_on_the_way),
            Part.of(_LATE, self._squeeze_and_silence),
        ]

    # -- places -----------------------------------------------------------------------------

    def _low(self, side: Side) -> float:
        """Nearly closed, clear of the object."""
        touch = self.plan.objects.get(side)
        return 0.1 * self._stroke if touch is None else touch + 0.1 * self._stroke

    def _middle(self, side: Side) -> float:
        return max(0.5 * self._stroke, self._low(side) + 0.02 * self._stroke)

    def _high(self) -> float:
        return 0.9 * self._stroke

    def _home(self, side: Side) -> Pose:
        return (self._middle(side),)

    def _other_place(self) -> dict[Side, Pose]:
        """The middle or above it, whichever is farther from here; of the second side a little more
        open, so that commands to the wrong side show.
        """
        places: dict[Side, Pose] = {}
        for i, side in enumerate(self.plan.sides):
            here = self._obs.q.get(side, (0.0,))[0]
            above = (0.7 if i == 0 else 0.85) * self._stroke
            middle = max(self._middle(side), (0.5 if i == 0 else 0.6) * self._stroke)
            places[side] = (above if abs(above - here) > abs(middle - here) else middle,)
        return places

    def _nearly_closed(self) -> dict[Side, Pose]:
        """Where the sides without an object are before they are driven open."""
        free = (s for s in self.plan.sides if s not in self.plan.objects)
        return dict.fromkeys(free, (_NEARLY * self._stroke,))

    def _reachable(self, side: Side) -> bool:
        return self._goal[side][0] > self.plan.objects.get(side, -math.inf)

    def _motors(self, side: Side, pose: Pose) -> Motors:
        kept = self.plan.dialect.mode_byte is not ModeByte.UNUSED
        motor = Motor(q=pose[0], mode=0 if kept else self._mode)
        return (replace(motor, kp=0.0, kd=0.0) if self._gainless else motor,)

    def _command(self, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Every side holds its goal, but for those named and those that grip."""
        if not self._grip:
            yield from super()._command(motors)
            return
        chosen = {**self._grip, **(motors or {})}
        every = {s: chosen[s] if s in chosen else self._motors(s, q) for s, q in self._goal.items()}
        yield from self._send(self._codec.encode({s: m for s, m in every.items() if m}))

    # -- phases -----------------------------------------------------------------------------

    def _back(self) -> Steps:
        yield from self._everyone("center", self._homes())

    def _without_gains(self) -> Steps:
        """From here on, as clients of such a dialect send none."""
        self._gainless = True
        yield from ()

    def _late_joiner_on_the_way(self) -> Steps:
        self._goal.update(self._nearly_closed())
        yield from self._late_joiner()

    def _each_hand(self) -> Steps:
        for side in self.plan.sides:
            yield from self._steps(side)

    def _steps(self, side: Side) -> Steps:
        self._report(f"large steps of the {side} hand; the other one must not move")
        places = (self._high(), 0), (self._low(side), _VENDORS_MODE), (self._middle(side), 0)
        for target, self._mode in places:
            self._goal[side] = (target,)
            phase = self._begin("step", (side,), targets={side: {0: target}})
            yield from self._until_settled(phase, (side,), least=0.6, most=2.5)

    def _ends(self) -> Steps:
        self._report("fully open and fully closed")
        sides = self.plan.sides
        yield from self._everyone("ends", dict.fromkeys(sides, (self._stroke,)), most=1.5)
        free = [s for s in sides if s not in self.plan.objects]
        if free:
            self._goal.update(dict.fromkeys(free, (0.0,)))
            phase = self._begin("ends", free, targets={s: {0: 0.0} for s in free})
            yield from self._until_settled(phase, free, least=0.6, most=2.8)

    def _at_first(self) -> Steps:
        """Grip and hold stiffness before any disturbance."""
        sides = self.plan.sides
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        if pressing:
            self._report("a first grip")
            self._grip = self._by_the_lead(pressing)
            beyond = {s: {0: motors[0].q} for s, motors in self._grip.items()}
            phase = self._begin("grip", pressing, targets=beyond)
            yield from self._hold(0.3)
            yield from self._stiffness(free)
            while self._elapsed(phase) < _FIRST_GRIP:
                yield from self._command()
            self._end(phase)
            self._grip = {}
            yield from self._turn(
                "center", {s: self._home(s) for s in pressing}, least=0.5, stand=self._standing
            )
        else:
            yield from self._stiffness(free)

    def _stiffness(self, sides: Sequence[Side]) -> Steps:
        """Push hands that are held without contact by a torque."""
        if not sides or not self._gains_used or "stiffness" not in self.plan.phases:
            return
        phase = self._begin("stiffness", sides)
        yield from self._hold(_NUDGE_SECONDS, self._pushed(sides))
        self._end(phase)
        yield from self._hold(_BACK_SECONDS)

    def _pushed(self, sides: Sequence[Side]) -> dict[Side, Motors]:
        return {s: (replace(self._motors(s, self._goal[s])[0], tau=_NUDGE),) for s in sides}

    def _by_the_lead(self, sides: Sequence[Side]) -> dict[Side, Motors]:
        """Commands into the objects of these sides by xr_teleoperate's lead."""
        lead = LEAD * self._stroke
        return {s: (Motor(q=max(self.plan.objects[s] - lead, 0.0)),) for s in sides}

    def _dead_zones(self) -> Steps:
        self._report("the zones that mean fully open and fully closed")
        sides = self.plan.sides
        free = [s for s in sides if s not in self.plan.objects]
        for q, end, chosen in ((_OPENS, self._stroke, sides), (_CLOSES, 0.0, free)):
            if chosen:
                self._goal.update(dict.fromkeys(chosen, (q,)))
                phase = self._begin("dead-zone", chosen, targets={s: {0: end} for s in chosen})
                yield from self._until_settled(phase, chosen, least=0.6, most=2.8)

    def _bad(self, name: str) -> Steps:
        self._report(_BAD[name])
        sides = self.plan.sides
        yield from self._hold(0.1)
        if name == "nan":
            for side in sides:
                kinds = [{side: (m,)} for m in self._not_finite(side)]
                yield from self._bad_commands(
                    name, (side,), kinds, max(0.065, ASIDE_SECONDS / len(kinds))
                )
        elif name == "out-of-range":
            places = (1000.0, -1000.0, 1.3 * self._stroke, -0.3 * self._stroke)
            far = [dict.fromkeys(sides, (Motor(q=q),)) for q in places]
            yield from self._beyond_each_end(name, far, 0.3)
        elif name == "long":
            good = {s: self._motors(s, pose) for s, pose in self._goal.items()}
            for alone in self._each_alone():
                mine = {s: good[s] for s in alone}
                others = {s: m for s, m in good.items() if s not in alone}
                rest = self._codec.encode(others) if others else []
                longer = [
                    self._codec.encode_longer(mine, [Motor(q=self._far(alone[0]))] * more) + rest
                    for more in (1, 19)
                ]
                yield from self._bad_commands(name, alone, longer, 0.15)
        elif name == "negative":
            kp, kd = self._model.gains[0]
            for alone in self._each_alone():
                near = {s: self._aside(s, 0.1)[0] for s in alone}
                for damping in (-kd, kd):
                    wrong = {s: (Motor(q=q, kp=-kp, kd=damping),) for s, q in near.items()}
                    yield from self._bad_commands(name, alone, [wrong], 0.15)
        else:
            for alone in self._each_alone():
                yield from self._bad_commands(name, alone, [self._empty(alone)], 0.25)

    def _empty(self, sides: Sequence[Side]) -> Mapping[Side, Motors] | Payloads:
        if self._codec.shared:
            return self._codec.encode_empty(sides)
        return dict.fromkeys(sides, ())

    def _at(self, side: Side, q: Sequence[float]) -> Motors:
        return (Motor(q=q[0]),)

    def _far(self, side: Side) -> float:
        """A q far from the goal."""
        return self._low(side) if self._goal[side][0] > 0.6 * self._stroke else self._high()

    def _not_finite(self, side: Side) -> list[Motor]:
        """One bad field each; where it is not q, q is far away, to show whether it was taken."""
        far = self._far(side)
        return [
            replace(Motor(q=far), **{field: value})  # type: ignore[arg-type]
            for field, value in NOT_FINITE
            if field == "q" or self._gains_used
        ]

    def _again(self) -> Steps:
        self._report("bad commands of the new client: nothing may move")
        sides, phases = self.plan.sides, self.plan.phases
        every = {s: self._not_finite(s) for s in sides}
        kinds = [{s: (every[s][i],) for s in sides} for i in range(0, len(every[sides[0]]), 2)]
        yield from self._bad_commands("nan", sides, kinds, 0.1)
        good = {s: self._motors(s, pose) for s, pose in self._goal.items()}
        if "empty" in phases:
            yield from self._hold(BETWEEN)
            yield from self._bad_commands("empty", sides, [self._empty(sides)], 0.15)
        if "long" in phases:
            yield from self._hold(BETWEEN)
            longer = self._codec.encode_longer(good, [Motor(q=self._far(sides[0]))])
            yield from self._bad_commands("long", sides, [longer], 0.15)
        if "negative" in phases and self._gains_used:
            yield from self._hold(BETWEEN)
            kp, kd = self._model.gains[0]
            wrong = {s: (Motor(q=self._aside(s, 0.1)[0], kp=-kp, kd=-kd),) for s in sides}
            yield from self._bad_commands("negative", sides, [wrong], 0.15)
        yield from self._far_away((1e6, -1e6), 0.2)
        yield from self._everyone(
            "recover", self._other_place(), after=self._bad_phases_since_recovery
        )

    def _before_shutdown(self) -> Steps:
        """Grip and move: what was commanded last must not be in force after the restart."""
        sides = self.plan.sides
        yield from self._stiffness(sides)
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        self._grip = dict(self._squeeze(pressing))
        regrip = self._begin("regrip", pressing) if pressing else None
        if free:
            yield from self._turn("center", self._nearly_closed(), least=0.5, stand=self._standing)
        if free and self._gains_used:
            yield from self._drive(free, 0.16)
        elif pressing:
            # on its own the last grip has to come from the open, and to be felt
            yield from self._hold(0.5 if free else 1.5)
        if regrip is not None:
            self._end(regrip)

    def _grips_again(self) -> Steps:
        """A grip after the restart of the service.

        Not in dialects with gains: there the steps after a restart show a loss of torque.
        """
        pressing = [s for s in self.plan.sides if s in self.plan.objects]
        if self._gains_used or not pressing or "grip" not in self.plan.phases:
            return
        self._report("squeezing the object again")
        self._grip = dict(self._squeeze(pressing))
        phase = self._begin("regrip", pressing)
        yield from self._hold(_SQUEEZE)
        self._end(phase)
        self._grip = {}
        yield from self._turn("center", {s: (self._high(),) for s in pressing}, least=0.5)

    def _not_restarted(self) -> Steps:
        self._grip = {}
        if self.plan.phases & {"silence", "rejected"}:
            yield from self._silent_again()

    def _after_shutdown(self) -> dict[Side, Pose]:
        self._grip = {}
        places = self._other_place()
        for s in self.plan.sides:
            if s not in self.plan.objects and s in self._obs.q:
                # back from where it was going, but not to the end
                back = self._obs.q[s][0] - _BACK * self._stroke
                places[s] = (max(back, self._low(s)),)
        return places

    def _silent_again(self) -> Steps:
        if not self._gains_used:
            return
        sides = self.plan.sides
        if "push" in self.plan.phases:
            yield from self._pushes(dict.fromkeys(sides, "push"))
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        # a free hand is elsewhere in this silence: one that goes to a fixed position shows then
        starts = {s: (self._low(s) if s in pressing else self._middle(s),) for s in sides}
        yield from self._everyone("center", starts)
        self._grip = dict(self._squeeze(pressing))
        yield from self._drive(free, 0.16, last_hz=_SLOWEST_HZ)
        first, *rest = sides
        if rest and not self._codec.shared and "rejected" in self.plan.phases:
            silent = self._begin("silence", (first,))
            rejected = self._begin("rejected", rest)
            self._grip = {first: (), **dict.fromkeys(rest, (Motor(q=math.inf),))}
            yield from self._hold(self._model.command_timeout + 0.6)
            self._end(silent)
            self._end(rejected)
        else:
            yield from self._silence("silence", self._model.command_timeout + 0.6)
        self._grip = {}
        yield from self._resume(self._other_place())

    def _undriven(self) -> Steps:
        """Commands without a position gain."""
        sides = self.plan.sides
        yield from self._everyone("center", dict.fromkeys(sides, (0.8 * self._stroke,)))
        if self.plan.phases & {"limp", "unlike"}:
            self._report("commands without force (zero gains): the hand must not be pulled")
            for side in sides:
                yield from self._limp(side)
        if "push" in self.plan.phases:
            # in opposite directions, so that a torque of the other side's shows
            for names in (("pull", "push"), ("push", "pull")):
                yield from self._pushes(dict(zip(sides, names, strict=False)))
        if "drive" in self.plan.phases:
            yield from self._drive(sides, 0.16, seconds=0.35)
        if "fed" in self.plan.phases:
            yield from self._fed(sides)

    def _fed(self, sides: Sequence[Side]) -> Steps:
        """The way back to the middle, with a feed-forward that hardly changes it."""
        self._report("a velocity and a torque beside a position: it must be reached all the same")
        goals = {s: self._home(s) for s in sides}
        phase = self._begin("fed", sides, targets={s: {0: q} for s, (q,) in goals.items()})
        fed = {s: (Motor(q=q, dq=_FED_DQ, tau=_FED_TAU),) for s, (q,) in goals.items()}
        yield from self._hold(_FED_SECONDS, fed)
        self._end(phase)
        self._goal.update(goals)

    def _limp(self, side: Side) -> Steps:
        """Zero gains of one side, with a q on either side of the hand, as a weight pulls the same
        way at both; the others make steps by their own gains.
        """
        others = [s for s in self.plan.sides if s != side]
        for q in (self._low(side), self._stroke):
            phase = self._begin("limp", (side,), targets={side: {0: q}})
            ends = [phase]
            if others:
                self._goal.update({s: self._aside(s, 0.4 * ASIDE) for s in others})
                targets = {s: dict(enumerate(self._goal[s])) for s in others}
                ends.append(self._begin("unlike", others, targets=targets))
            yield from self._hold(_LIMP_SECONDS, {side: (Motor(q=q, kp=0.0, kd=0.0),)})
            for ended in ends:
                self._end(ended)

    def _pushes(self, names: Mapping[Side, str]) -> Steps:
        """Close or open each side by a torque alone, which grows until the hand moves.

        :param names: ``pull`` or ``push`` for each side.
        """
        self._report("a torque without a position gain: the hand must move with it")
        ways = {s: -1 if name == "pull" else 1 for s, name in names.items()}
        phases = []
        for name in dict.fromkeys(names.values()):
            mine = [s for s in names if names[s] == name]
            end = 0.0 if name == "pull" else self._stroke
            phases.append(self._begin(name, mine, targets={s: {0: end} for s in mine}))
        torque = dict.fromkeys(names, _PUSH[0])
        while self._elapsed(phases[0]) < _PUSH_SECONDS:
            for s, way in ways.items():
                if way * self._obs.dq.get(s, (0.0,))[0] < _PUSH_SPEED * self._stroke:
                    torque[s] = min(torque[s] * 1.02, _PUSH[1])
            yield from self._command(
                {
                    s: (Motor(self._goal[s][0], tau=way * torque[s], kp=0.0, kd=_PUSH_DAMPING),)
                    for s, way in ways.items()
                }
            )
        for phase in phases:
            self._end(phase)

    def _squeeze(self, sides: Sequence[Side]) -> dict[Side, Motors]:
        """Commands into the objects of these sides."""
        depth = 1.5 * LEAD * self._stroke
        return {s: (Motor(q=self.plan.objects[s] - depth),) for s in sides}

    def _squeeze_and_silence(self) -> Steps:
        sides, phases = self.plan.sides, self.plan.phases
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        if free:
            yield from self._everyone("center", {**self._goal, **self._nearly_closed()})
        if phases & {"grip", "nudge"}:
            yield from self._hold_long(pressing, free)
        if pressing:
            if phases & {"grip", "nudge"}:  # each grip counts as the first one
                self._grip = {}
                opened = {s: (self._low(s),) for s in pressing}
                yield from self._turn("center", opened, least=0.4, stand=self._standing)
            self._report("squeezing the object")
            self._grip = dict(self._squeeze(pressing))
            beyond = {s: {0: motors[0].q} for s, motors in self._grip.items()}
            phase = self._begin("squeeze", pressing, targets=beyond)
            yield from self._hold(_SQUEEZE)
            self._end(phase)
            if self._gains_used and "release" in phases:
                phase = self._begin("release", pressing)
                grip = dict(self._grip)
                self._grip = {s: (replace(m[0], kp=0.0, kd=0.0),) for s, m in grip.items()}
                yield from self._hold(_RELEASE)
                self._end(phase)
                self._grip = grip
        if phases & {"silence", "resume", "rejected"}:
            yield from self._silences(pressing, free)
        elif phases & {"soft", "soft-grip"}:
            yield from self._soft_grips(pressing, {})
            self._grip = {}
            yield from self._soft_step(sides)

    def _hold_long(self, pressing: Sequence[Side], free: Sequence[Side]) -> Steps:
        """Equal commands for long: a grip by the client's lead, and a hand held without contact.

        They come at the rate of a camera, so that one command to the wrong side would be in force
        long enough to show. A torque pushes the free hand at first and at last.
        """
        self._report("the same commands for long: they must stay in force")
        self._grip = self._by_the_lead(pressing)
        period, self._period_ns = self._period_ns, round(1e9 / _CAMERA_HZ)
        beyond = {s: {0: motors[0].q} for s, motors in self._grip.items()}
        gripping = [self._begin("grip", pressing, targets=beyond)] if pressing else []
        pushed = self._pushed(free)
        nudged = free and self._gains_used
        yield from self._hold(_NUDGE_SECONDS)
        for seconds in (_LONG_GRIP if self._patient else _GRIP, 0.1):
            if nudged:
                phase = self._begin("nudge", free)
                yield from self._hold(_NUDGE_SECONDS, pushed)
                self._end(phase)
            yield from self._hold(seconds)
        for phase in gripping:
            self._end(phase)
        self._period_ns = period

    def _silences(self, pressing: Sequence[Side], free: Sequence[Side]) -> Steps:
        """No commands for long: to each side alone where they have topics of their own."""
        sides = self.plan.sides
        timeout = self._model.command_timeout
        long = _LONG_SILENCE if self._patient else _SILENCE
        first = free[0] if free else sides[0]
        rest = [s for s in sides if s != first]
        alone = bool(rest) and not self._codec.shared and "rejected" in self.plan.phases
        if not alone:
            yield from self._soft_grips(pressing, {})
            self._grip = dict(self._squeeze(pressing))
            if free and self._gains_used:
                yield from self._drive(free, 0.16, last_hz=_FASTEST_HZ)
            self._report("... silence: after a second the hand must brake")
            yield from self._silence("silence", long)
            self._grip = {}
            yield from self._resume(self._other_place())
            yield from self._soft_step(sides)
        else:
            self._grip.pop(first, None)
            if self._gains_used:
                if not free:
                    yield from self._turn("center", {first: (self._low(first),)}, least=0.5)
                yield from self._drive((first,), 0.16, last_hz=_FASTEST_HZ)
            self._report(f"... silence on the {first} side: after a second it must brake")
            yield from self._silent_beside(first, [s for s in rest if s in pressing], long)
            # away from where it was going before the silence
            yield from self._resume({first: (_NEARLY * self._stroke,)})
            if self._gains_used:
                low = {s: (self._low(s),) for s in (first,) if s in pressing}
                if low:
                    yield from self._turn("center", low, least=0.5)
                gain = self._model.gains[0][1]
                yield from self._drive([s for s in sides if s not in self._grip], 0.07, kd=gain)
            self._report("... silence on both sides, and broken commands to one: both must brake")
            yield from self._silent_and_rejected(first, rest, timeout)
            self._grip = {}
            yield from self._resume(self._other_place())
        yield from self._bad_at_once({s: (self._not_finite(s)[-1],) for s in sides})

    def _resume(self, goals: Mapping[Side, Pose]) -> Steps:
        """A step after a silence, whose first command is alone for a while: it counts as it is."""
        self._goal.update(goals)
        targets = {s: dict(enumerate(pose)) for s, pose in goals.items()}
        phase = self._begin("resume", tuple(goals), targets=targets)
        yield from self._command()
        yield from self._through(phase, _ALONE_SECONDS, lambda: self._wait(0.01))
        yield from self._until_settled(
            phase, tuple(goals), least=0.6 - _ALONE_SECONDS, most=2.5, stand=self._standing
        )

    def _silent_beside(self, side: Side, pressing: Sequence[Side], seconds: float) -> Steps:
        """No command to one side, while the others grip softly, hold, and make a step."""
        phase = self._begin("silence", (side,))
        self._grip[side] = ()
        yield from self._soft_grips(pressing, {})
        yield from self._hold(max(0.2, seconds - 4.9))
        grip, self._grip = self._grip, {side: ()}
        beside = self._beside_others((side,), ASIDE_SECONDS)
        yield from self._hold(0.8)
        for ended in beside:
            self._end(ended)
        self._grip = {**grip, **self._squeeze(pressing)}
        while self._elapsed(phase) < seconds:
            yield from self._command()
        self._end(phase)
        del self._grip[side]

    def _silent_and_rejected(self, first: Side, rest: Sequence[Side], timeout: float) -> Steps:
        """No commands, then only rejected ones to one side; the others stay silent longer."""
        both, long = self._begin("silence", (first,)), self._begin("silence", rest)
        self._grip = dict.fromkeys((first, *rest), ())
        yield from self._hold(timeout + 0.6)
        self._end(both)
        # they must not wake it, either
        rejected = self._begin("rejected", (first,))
        self._grip[first] = (Motor(q=math.nan),)
        yield from self._hold(0.8 * timeout)
        self._end(rejected)
        del self._grip[first]
        yield from self._resume({first: self._other_place()[first]})
        yield from self._soft_step((first,))
        beside = self._beside_others(rest, ASIDE_SECONDS)
        yield from self._hold(0.6)
        for ended in (*beside, long):
            self._end(ended)

    def _soft_grips(self, pressing: Sequence[Side], others: Mapping[Side, Motors]) -> Steps:
        """Grips of less stiffness than the client's."""
        if not self._gains_used or "soft-grip" not in self.plan.phases or not pressing:
            return
        touch = self.plan.objects
        grips = [
            ({s: Motor(q=max(touch[s] - depth, 0.0), kp=kp) for s in pressing}, _SOFT_SECONDS)
            for kp, depth in _SOFT_GRIPS
        ]
        below = {s: Motor(q=-_BEYOND * self._stroke, kp=_BEYOND_TAU / touch[s]) for s in pressing}
        grips.append((below, self._model.command_timeout + _BEYOND_AFTER))
        for soft, seconds in grips:
            targets = {s: {0: motor.q} for s, motor in soft.items()}
            phase = self._begin("soft-grip", pressing, targets=targets)
            self._grip.update({s: (motor,) for s, motor in soft.items()})
            yield from self._hold(seconds, others)
            self._end(phase)

    def _soft_step(self, sides: Sequence[Side]) -> Steps:
        """A step without contact with the least stiffness."""
        if not self._gains_used or "soft" not in self.plan.phases:
            return
        goals = {s: self._aside(s, _SOFT_STEP) for s in sides}
        phase = self._begin("soft", sides, targets={s: {0: q} for s, (q,) in goals.items()})
        yield from self._hold(0.8, {s: (Motor(q=q, kp=_SOFTEST),) for s, (q,) in goals.items()})
        self._end(phase)
        self._goal.update(goals)

    def _drive(
        self,
        sides: Sequence[Side],
        part: float,
        kd: float = 0.5,
        *,
        seconds: float = 0.8,
        last_hz: float = 0.0,
    ) -> Steps:
        """Open at a steady low speed by velocity feedback alone, whatever the friction.

        :param part: of the stroke in a second: far from the stop even after a whole time-out.
        :param last_hz: rate of the last few commands; 0: as the others.
        """
        self._report("slow motion")
        if not sides:
            return
        phase = self._begin("drive", sides)
        slow = part * self._stroke
        wanted = dict.fromkeys(sides, slow)
        # by q, as dq may be wrong: over as many commands as are visible as motion
        seen: deque[tuple[int, Mapping[Side, float]]] = deque(maxlen=8)
        motors: dict[Side, Motors] = {}
        while self._elapsed(phase) < seconds:
            here = {s: self._obs.q[s][0] for s in sides if s in self._obs.q}
            seen.append((self._obs.now_ns, here))
            then, before = seen[0]
            took = max((self._obs.now_ns - then) / 1e9, 1e-3)
            for s in sides:
                if (here.get(s, 0.0) - before.get(s, 0.0)) / took < slow:
                    wanted[s] = min(wanted[s] * 1.03, 20 * slow)
            motors = {s: (Motor(self._goal[s][0], wanted[s], kp=0.0, kd=kd),) for s in sides}
            yield from self._command(motors)
        if last_hz:
            period, self._period_ns = self._period_ns, round(1e9 / last_hz)
            yield from self._hold(max(0.05, 5 / last_hz), motors)
            self._period_ns = period
        self._end(phase)
