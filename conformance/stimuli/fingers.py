"""The stimulus for hands of several joints.

Both hands do the same at once, except where their independence is the subject. Poses are given by
how far the flexing joints are closed, in percent, as the object is. The phases of the mode byte's
id and time-out bit are for the Dex3-1 alone.

============== =====================================================================================
listen         no commands; state must flow
approach       slowly to nearly open
joint          one joint after the other closes; then every second one opens, and the others.
               Where there are many, all of them open together. Joints that share a motor are one.
step           one hand closes, the other holds; one opens while the other closes; that one opens
fingerprint    steps to compare the ``recover`` steps with
nan, out-of-   bad commands, followed by ``recover``, a good step: not finite; far outside the
range,         limits; a client of another type on the topic, no motors, one too few, one and more
foreign,       too many, negative gains, unknown statuses, and two mode bytes with each other's id.
empty, short,  Each kind stands for a while, on each side alone where it has a topic of its own.
long,
negative,
status,
wrong-id
beside         a step of one side while the other one gets bad commands, or none
burst          hundreds of commands at once, of which the last one counts
stiff, soft,   a step with the client's gains, with a tenth of its stiffness and with a third of it;
mild           then steps in which only some joints are soft, three times with other joints
limp           zero gains, with a q far towards closed, and then with one towards open
lock           the first with the client's gains and status 0 or mode 0; again for a later client
mixed          a step in which some joints are locked under way, by their mode byte, and the others
               go on: three times, with other joints
speeds         position servos: each joint with another speed, and one with none; again with others;
               and all that for a new client
ends           one finger after the other to both ends of its range, with the thumb out of the way;
               position servos also after the restart of the service
push, pull     a torque alone, without a position gain: some joints towards closed and the others
               towards open, and the other way round
replay         a recorded session, as recorded
single         commands that are sent once
load           many commands a second, and a reader that is slow
old-stamps     commands whose source timestamps are an hour old
late-joiner    a new subscriber appears
touch          one finger alone presses on the object, if there is one
firmer         all fingers hold it softly, and one after the other presses firmly
squeeze        all fingers close on it, for seconds; position servos also on, after a silence, and
               after each restart
beside-grip    a step of a hand without an object meanwhile
regrip         all fingers close on it once more, at the end: not of position servos
guarded-step   some joints of each hand have time-out protection from here on (bit 7 of the mode
               byte); a step, and back
guarded        meanwhile a hand without an object holds its pose
guard-drive    some joints are driven by a velocity or a torque and others move slowly to a
               position, when ...
guard          ... the commands stop for seconds; a second time after a restart of the service
guard-latch    commands to elsewhere, in which the same joints still have bit 7 set
guard-clear    the same without it: a hand that held an object lets go of it
drive          without protection: as guard-drive
silence        the commands stop for longer than the time-out; then on each side alone, while
               rejected commands arrive
resume         a step after the silence
operator       Unitree's client in a closed loop; see :mod:`~dexkit.conformance.stimuli.operator`
two-writers    a second client commands another place, and goes
company        a second client commands the same: steps of each side alone, and of both in
               opposite directions
restart        the client goes away, another comes, and makes such steps; position servos stand
               where it has sent them; each kind of bad commands again
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
from functools import partial

from dexkit.conformance.hands import JointRoles, under_test
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.hand import ASIDE_SECONDS, BETWEEN, HandScript
from dexkit.conformance.stimuli.script import NOT_FINITE, Part, Payloads, Pose, Steps
from dexkit.hand import JointMode, Side

__all__ = ["FingerScript"]


OPEN, CLOSED = 15.0, 50.0
"""Percent of closing between which the hand moves freely."""
_FARTHER = 15.0
"""Percent of closing by which a hand is farther closed than the other, where both are alike."""
_FAR = 80.0
"""Percent of closing that is far from both."""
BEYOND = 25.0
"""Percent of closing by which an object is squeezed."""
SOFTER = 0.1
"""Stiffness of a soft step as a part of the client's."""
MILD = 1.0 / 3.0
"""The same of a step with the stiffness of Unitree's C++ example, 0.5 N m/rad where its grip has
1.5 (docs/sources/unitree-dex.md#b1)."""
_OPENED = 8
"""Motors of a hand up to which their opening is judged as their closing is."""
_PUSH, _PUSH_DAMPING, _PUSH_SECONDS = 0.3, 0.5, 0.25  # N m, N m s/rad, s
_SPEED, _DAMPING = 0.35, 0.5  # rad/s and N m s/rad of joints that are driven by a velocity
# of joints that move slowly, N m/rad and N m s/rad: still under way five seconds later
_SLOW_GAINS = (0.2, 0.8)
_SLOW_PART = 0.08
"""The same of position servos: part of their full speed."""
_SPLITS = ((1, 2, 3, 6), (1, 2, 4, 5), (0, 2, 4, 6))
"""Joints with another mode byte than the rest of the hand, in three commands: each joint is among
them and not, and no two joints are treated alike three times. Where there are many, k counts these
commands, and every joint without bit 0 of its index is among them, then those with bit 1 and 2."""
_SOFT_HOLD, _SOFT_HOLD_SECONDS, _FIRM_SECONDS = 0.5, 0.3, 0.12
"""A soft hold: its stiffness as a part of the client's, and seconds; seconds of a firm one."""
_RAMP, _RAMP_SECONDS = 10, 0.2
"""Steps in which a soft hold becomes a firm one, and seconds for all of them."""
_TOUCH_SECONDS = 0.22
"""Seconds in which a finger presses on the object alone."""
_TOUCH_STANDS, _TOUCH_MORE = 0.1, 12
"""Seconds in which it stands then, and how often it is waited for that."""
_STATUSES = range(2, 8)
"""Values of the three status bits without a meaning in a command to a hand. A status
of 6 calibrates a motor only with a certain torque, which these commands do not have
(docs/sources/unitree-dex.md#g)."""
_AT_SHUTDOWN = (30.0, 45.0)
"""Percent of closing from which hands move when their service ends: far enough from both ends and
from the object that it is seen if one opens or closes then. Two hands stand at different ones: a
service that sends both to the same place moves at least one of them."""
_STAYS = 3.0
"""Seconds after the time-out in which a hand must do what its protection says: a client that has
died is started again within them, and its operator relies on what the hand holds."""
_WIDE = (CLOSED + 5.0, 5.0)
"""Percent of closing between which joints are locked under way."""
_UNDER_WAY = 0.08
"""Seconds after which a joint moves fast in a step with the client's gains."""
_APART = 7.0
"""Percent of closing by which goals of position servos differ, where they tell joints apart: more
than a good one may be off, and less than what makes it another step."""
_SPEEDS = ((0.0, 0.1, 0.2, 0.3, 0.4, 0.15), (0.2, 0.4, -0.2, 0.15, 0.1, 0.3))
"""Speeds of the joints of position servos in two turns, parts of the full one."""
_SPEEDS_SECONDS = 0.5
"""Seconds of each turn with them."""
_GRIP_SECONDS, _REGRIP_SECONDS = 1.1, 0.6
"""Seconds of a grip after a restart of position servos, and of hands with gains: these touch the
object after 0.2 s."""
_BETWEEN_PLACES, _NEW_CLIENT_SECONDS = 30.0, 2.0
"""Percent of closing at which position servos stand for a new client, between the places of other
clients' commands, and for how many seconds."""
_GRIP_ON_SECONDS = 1.5
"""Seconds for which position servos grip on after a silence, which they need not let go in: five
seconds of contact, in which a force that fades within six is down to a sixth."""
_BAD = {
    "nan": "broken commands (NaN and infinity): nothing may move",
    "out-of-range": "commands far out of range: no harm may be done",
    "empty": "empty commands: nothing may move",
    "short": "commands for a motor too few: nothing may move",
    "long": "commands for more motors than there are: nothing may move",
    "negative": "negative gains: no joint may run away",
    "status": "mode bytes with an unknown status: nothing may move",
    "wrong-id": "mode bytes with each other's id: the wrong joint must not move",
}


_TOGETHER = (
    "nan",
    "out-of-range",
    "foreign empty short long negative status wrong-id",
)
"""Bad commands with one step after them, to save time. Each group begins at rest."""


class FingerScript(HandScript):
    """The script of a hand of several joints."""

    motion = "joint"
    _settling = 0.2
    _standing = 0.1
    _least = 0.5
    _step_most = 1.5
    _beside_s = 0.6

    _turn_of_splits = 0
    """Number of times that joints got different treatment."""
    _turn_of_places = 0
    """Number of times that joints got goals that tell them apart."""
    _drives = 0
    """Number of times that joints have been set in motion."""

    def _provocations(self) -> list[Part]:
        guards = "guard guard-latch guard-clear"
        guarded = bool(self.plan.phases & set(guards.split()))
        return [
            Part.of("joint", self._one_by_one),
            Part.of("step", self._each_hand),
            Part.of("fingerprint", self._fingerprint),
            *(Part.of(kinds, partial(self._bad_together, kinds.split())) for kinds in _TOGETHER),
            Part.of("burst", self._flood),
            Part.of("stiff soft mild", self._stiff_and_soft, back=True),
            Part.of("limp", self._limp, back=True),
            Part.of("lock", self._all_locked, back=True),
            Part.of("mixed", self._locks_some, back=True),
            Part.of("push", self._pushes, back=True),
            Part.of("replay", self._session),
            Part.of("single", self._single),
            Part.of("speeds", self._speeds, back=True),
            Part.of("ends", self._to_the_ends),
            Part.of("load", self._load),
            Part.of("old-stamps", self._old_stamps),
            Part.of("late-joiner", self._late_joiner_on_the_way),
            Part.of("old-stamps", self._back),
            Part.of("touch", self._touches),
            Part.of("firmer", self._firmer),
            Part.of(guards, self._squeeze_and_guard),
            Part.of(
                "squeeze beside-grip silence resume",
                self._squeeze_and_silence,
                applies=not guarded,
            ),
            Part.of("silence resume", self._each_silent),
        ]

    def _back(self) -> Steps:
        yield from self._to("center", OPEN)

    def _each_hand(self) -> Steps:
        self._report("each hand alone; the other one must not move")
        away = {s: self._pose(s, CLOSED - 5.0) for s in self.plan.sides}
        yield from self._in_turn("step", away=away, stand=self._settling)

    def _late_joiner_on_the_way(self) -> Steps:
        self._goal.update(self._homes())
        yield from self._late_joiner()

    @property
    def _roles(self) -> JointRoles:
        roles = under_test(self._model.name).roles
        assert roles is not None  # every hand of several joints has them
        return roles

    # -- places -----------------------------------------------------------------------------

    def _pose(self, side: Side, percent: float) -> Pose:
        """Every joint so far closed; the thumb's sideways joint swings along."""
        return tuple(
            j.closed_by(percent / 100) if j.closing else (percent - 30) / 70 * j.q_max
            for j in self._joints[side]
        )

    def _home(self, side: Side) -> Pose:
        return self._pose(side, OPEN)

    def _other_place(self) -> dict[Side, Pose]:
        """Nearly open or half closed, whichever is farther from here.

        Of hands that are not mirrored, one goes farther, so that commands to the wrong side show.
        Position servos get a place for each joint (:meth:`_apart`).
        """
        places = {}
        farther = self._farther_side()
        for side in self.plan.sides:
            here = self._obs.q.get(side, self._home(side))
            more = _FARTHER if side is farther else 0.0
            places[side] = max(
                (self._pose(side, percent + more) for percent in (OPEN, CLOSED - 5.0)),
                key=lambda pose: sum(abs(a - b) for a, b in zip(pose, here, strict=True)),
            )
        return places

    def _farther_side(self) -> Side | None:
        """The side that closes farther than the other, without an object; None where their joints
        are mirrored, or told apart by their goals.
        """
        sides = [s for s in self.plan.sides if s not in self.plan.objects]
        if self.plan.dialect.position_servo or len(self.plan.sides) < 2 or not sides:
            return None
        ways = zip(*(self._joints[s] for s in self.plan.sides), strict=True)
        mirrored = sum(a.closing != b.closing for a, b in ways)
        return sides[0] if 2 * mirrored < len(self._joints[sides[0]]) else None

    def _apart(self, places: Mapping[Side, Pose]) -> dict[Side, Pose]:
        """The places of position servos, in which no two joints have the same goal twice.

        Where all joints have the same one, it cannot be seen that they have been mixed up.
        """
        if not self.plan.dialect.position_servo:
            return dict(places)
        turn = self._turn_of_places
        self._turn_of_places += 1
        found = {}
        for s, pose in places.items():
            by_thirds = (turn + (s is Side.RIGHT)) % 2 == 0
            found[s] = tuple(
                q + ((i % 3 if by_thirds else i // 2) - 1) * _APART / 100 * j.stroke * j.closing
                for i, (q, j) in enumerate(zip(pose, self._joints[s], strict=True))
            )
        return found

    def _after_silence(self, poses: Mapping[Side, Pose]) -> Steps:
        yield from self._everyone("resume", self._apart(poses), most=1.5)

    def _reachable(self, side: Side) -> bool:
        return side not in self.plan.objects

    def _motors(self, side: Side, pose: Pose) -> Motors:
        return [
            Motor(q=q, dq=self._model.client_command.dq, kp=kp, kd=kd, mode=self._codec.mode(i))
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
            yield from self._until_settled(phase, sides, least=0.5, most=1.5)
        if not few:
            yield from self._turn("center", {s: self._pose(s, OPEN) for s in sides}, least=0.5)

    def _bad(self, name: str) -> Steps:
        self._report(_BAD[name])
        yield from self._hold(0.1)
        if name == "nan":
            for side in self.plan.sides:
                kinds = [{side: motors} for motors in self._not_finite(side)]
                # long enough for a step of the other side beside them
                each = max(0.065, ASIDE_SECONDS / len(kinds))
                yield from self._bad_commands(name, (side,), kinds, each)
        elif name == "status":
            kinds = [
                {s: self._with_status(s, first) for s in self.plan.sides} for first in _STATUSES
            ]
            yield from self._bad_commands(name, self.plan.sides, kinds, 0.1)
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
            # long enough for the fastest joint to leave its range from anywhere
            travel = min(j.stroke / j.dq_max for joints in self._joints.values() for j in joints)
            each = max(0.2, 0.7 * travel)
            yield from self._beyond_each_end(name, far, each, most=1.5)
        else:
            for alone in self._each_alone():
                wrong = self._malformed(name, alone)
                for malformed in wrong:
                    each = 0.18 if name != "negative" else 0.25 / len(wrong)
                    yield from self._bad_commands(name, alone, [malformed], each)

    def _at(self, side: Side, q: Sequence[float]) -> Motors:
        return [replace(m, q=x) for m, x in zip(self._motors(side, tuple(q)), q, strict=True)]

    def _malformed(
        self, name: str, sides: Sequence[Side]
    ) -> Sequence[Mapping[Side, Motors] | Payloads]:
        """The bad commands of a phase to these sides, whole messages where they share one."""
        good = {s: self._motors(s, self._goal[s]) for s in sides}
        surplus = replace(good[sides[0]][0], q=1.0)
        if self._codec.shared and name == "empty":
            return [self._codec.encode_empty(sides)]
        if self._codec.shared and name == "short":
            return [self._codec.encode_shorter(good)]
        if self._codec.shared and name == "long":
            return [self._codec.encode_longer(good, [surplus] * more) for more in (1, 13)]
        if name == "empty":
            return [{s: [] for s in sides}]
        if name == "short":
            return [{s: motors[:-1] for s, motors in good.items()}]
        if name == "long":
            return [
                {s: [*m, *[replace(m[0], q=1.0)] * more] for s, m in good.items()}
                for more in (1, 13)
            ]
        if name == "negative":
            near = {s: self._motors(s, self._aside(s, 0.1)) for s in sides}
            # kp alone, in all but the first joint: that one may be checked for all
            return [
                {s: [replace(m, kp=-m.kp, kd=-m.kd) for m in motors] for s, motors in near.items()},
                {
                    s: [good[s][0], *(replace(m, kp=-m.kp, kd=0.1 * m.kd) for m in motors[1:])]
                    for s, motors in near.items()
                },
            ]
        return [{s: self._crossed(s, motors) for s, motors in good.items()}]

    def _with_status(self, side: Side, first: int) -> Motors:
        """Far goals with statuses that have no meaning, another one in each joint."""
        count = len(_STATUSES)
        return [
            replace(m, mode=self._codec.mode(i, _STATUSES[(first + i) % count]))
            for i, m in enumerate(self._motors(side, self._other_place()[side]))
        ]

    def _not_finite(self, side: Side) -> list[Motors]:
        """One bad field in one joint each: the last, the first and a middle one in turn."""
        last = len(self._model.gains) - 1
        joints = (last, 0, last // 2)
        return [
            self._broken(side, joints[(i + i // 3) % 3], field, value)
            for i, (field, value) in enumerate(NOT_FINITE)
            if field in self.plan.dialect.command_fields
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
        kinds = [dict(zip(sides, each, strict=True)) for each in zip(*every.values(), strict=True)]
        kinds = kinds[::2]
        yield from self._bad_commands("nan", sides, kinds, 0.07)
        for name in ("empty", "short", "long", "negative"):
            if name in self.plan.phases:
                yield from self._hold(BETWEEN)
                bad = self._malformed(name, sides)[0]
                yield from self._bad_commands(name, sides, [bad], 0.15)
        yield from self._far_away((1000.0, -1000.0), 0.2)
        yield from self._everyone(
            "recover", self._other_place(), most=1.5, after=self._bad_phases_since_recovery
        )
        if "lock" in self.plan.phases:
            yield from self._lock(_FAR, 0.25)

    def _before_shutdown(self) -> Steps:
        """Move: what was commanded last must not be in force after the restart."""
        sides, (less, more) = self.plan.sides, _AT_SHUTDOWN
        free = [s for s in sides if s not in self.plan.objects]
        closed_more = free[-1] if free and len(sides) > 1 else None
        poses = {s: self._pose(s, more if s is closed_more else less) for s in sides}
        yield from self._everyone("center", poses, most=1.5)
        yield from self._drive("drive", sides, {})

    def _silent_again(self) -> Steps:
        yield from self._to("center", OPEN)
        sides = self.plan.sides
        if "guard" in self.plan.phases:
            splits = self._next_splits()
            yield from self._drive("guard-drive", sides, {}, guarded=splits)
            yield from self._silence("guard", self._model.command_timeout + 0.3)
            yield from self._latch_and_clear(splits)
        else:
            yield from self._silent_by_motion({})
        pressing = [s for s in sides if s in self.plan.objects]
        if pressing and "squeeze" in self.plan.phases and not self.plan.dialect.position_servo:
            self._report("squeezing the object again")
            yield from self._squeeze(pressing, _REGRIP_SECONDS, "regrip")

    def _silent_by_motion(self, guarded: Mapping[Side, frozenset[int]]) -> Steps:
        """No commands to moving hands, then a step.

        :param guarded: the joints with time-out protection.
        """
        yield from self._drive("drive", self.plan.sides, {}, guarded=guarded)
        yield from self._silence("silence", self._model.command_timeout + 0.7)
        yield from self._after_silence({s: self._pose(s, CLOSED - 5.0) for s in self.plan.sides})

    def _silent_alone(
        self, side: Side, rejected: Motors, guarded: Mapping[Side, frozenset[int]]
    ) -> Steps:
        """No command to one side but rejected ones, while it moves and the other is commanded.

        The first step afterwards closes that hand, away from where a hand that begins at 0 would
        go.

        :param guarded: the joints with time-out protection.
        """
        self._report(f"no good commands to the {side} hand alone: nothing may be left driven")
        yield from self._drive("drive", (side,), {}, guarded=guarded)
        yield from self._silence_alone("silence", side, {side: rejected} if rejected else {})
        yield from self._after_silence(
            {s: self._pose(s, CLOSED - 5.0 if s is side else OPEN) for s in self.plan.sides}
        )

    def _once_more(self) -> dict[Side, frozenset[int]]:
        """The joints with time-out protection in a further silence."""
        return self._next_splits() if "guard" in self.plan.phases else {}

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
        if "soft" in self.plan.phases:
            yield from self._uneven()

    def _uneven(self) -> Steps:
        """Steps in which some joints are soft and the others are not, three times with others."""
        self._report("some joints soft, the others not: each by its own gains")
        sides = self.plan.sides
        for percent in (OPEN, CLOSED - 5.0, OPEN):
            splits = self._next_splits()
            poses = {s: self._pose(s, percent) for s in sides}
            targets = {s: {i: poses[s][i] for i in sorted(splits[s])} for s in sides}
            phase = self._begin("soft", sides, targets=targets)
            motors = {
                s: [
                    replace(m, kp=SOFTER * m.kp) if i in splits[s] else m
                    for i, m in enumerate(self._motors(s, pose))
                ]
                for s, pose in poses.items()
            }
            yield from self._hold(0.5, motors)
            self._end(phase)
            self._goal.update(poses)

    def _limp(self) -> Steps:
        self._report("commands without force (zero gains): the hand must not be pulled")
        sides = self.plan.sides
        yield from self._hold(0.1)
        # what moves by its weight moves the same way whatever q is
        for percent in (CLOSED, 0.0):
            targets = {s: dict(enumerate(self._pose(s, percent))) for s in sides}
            phase = self._begin("limp", sides, targets=targets)
            yield from self._hold(0.2, self._all(percent, kp=0.0, kd=0.0))
            self._end(phase)

    def _all_locked(self) -> Steps:
        self._report("locked motors: they must not follow their q")
        yield from self._hold(0.1)
        yield from self._lock(CLOSED, 0.3)

    def _lock(self, percent: float, seconds: float) -> Steps:
        """All motors locked, with a q that is so far closed."""
        sides = self.plan.sides
        targets = {s: dict(enumerate(self._pose(s, percent))) for s in sides}
        phase = self._begin("lock", sides, targets=targets)
        every = {s: frozenset(range(len(self._joints[s]))) for s in sides}
        yield from self._hold(seconds, self._locked(self._all(percent), every))
        self._end(phase)

    def _locked(
        self, hands: Mapping[Side, Motors], joints: Mapping[Side, frozenset[int]]
    ) -> dict[Side, Motors]:
        """The commands with status 0 for some joints."""
        return {
            s: [
                replace(m, mode=self._codec.mode(i, JointMode.BRAKE)) if i in joints[s] else m
                for i, m in enumerate(motors)
            ]
            for s, motors in hands.items()
        }

    def _next_splits(self) -> dict[Side, frozenset[int]]:
        """The joints of each side that are treated differently next; others on each side."""
        turn = self._turn_of_splits
        self._turn_of_splits += 1
        found = {}
        for s in self.plan.sides:
            k, count = (turn + (s is Side.RIGHT)) % len(_SPLITS), len(self._joints[s])
            many = (i for i in range(count) if (i >> k & 1) == (k > 0))
            found[s] = frozenset(_SPLITS[k] if count <= _OPENED else many)
        return found

    def _locks_some(self) -> Steps:
        self._report("some joints are locked under way: they must stop, and the others go on")
        sides = self.plan.sides
        for turn in range(len(_SPLITS)):
            percent = _WIDE[turn % 2]  # wide: a joint that is not braked must have room to run
            poses = {s: self._pose(s, percent) for s in sides}
            hands = self._all(percent)
            splits = self._next_splits()
            yield from self._hold(_UNDER_WAY, hands)
            phase = self._begin(
                "mixed", sides, targets={s: dict(enumerate(poses[s])) for s in sides}
            )
            yield from self._hold(0.35, self._locked(hands, splits))
            self._end(phase)
            self._goal.update(poses)

    def _speeds(self) -> Steps:
        """Each joint closes with another speed, and one with none."""
        self._report("a speed for each joint: each must move with its own, and with 0 not at all")
        sides = self.plan.sides
        for speeds in _SPEEDS:
            yield from self._to("center", OPEN)
            poses = {s: self._pose(s, CLOSED) for s in sides}
            targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
            hands = {
                s: [
                    replace(m, dq=speeds[(i + 3 * (s is Side.RIGHT)) % len(speeds)])
                    for i, m in enumerate(self._motors(s, pose))
                ]
                for s, pose in poses.items()
            }
            phase = self._begin("speeds", sides, targets=targets)
            yield from self._hold(_SPEEDS_SECONDS, hands)
            self._end(phase)

    def _to_the_ends(self) -> Steps:
        self._report("to both ends of each joint's range, fingers and thumb in turn")
        sides = self.plan.sides
        for thumb in (False, True):
            poses = {s: self._end_pose(s, thumb=thumb) for s in sides}
            targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
            self._goal.update(poses)
            phase = self._begin("ends", sides, targets=targets)
            free = [s for s in sides if self._reachable(s)]
            # an object holds some joints back until the end
            yield from self._until_settled(
                phase, free, least=self._least if free else 1.0, most=1.5, stand=self._standing
            )
        if "load" not in self.plan.phases:  # that is made from anywhere
            yield from self._to("center", OPEN)

    def _end_pose(self, side: Side, *, thumb: bool) -> Pose:
        """The thumb closed and the fingers open, or the other way round, to the ends."""
        pose = []
        for j in self._joints[side]:
            closes = j.name.startswith("thumb") is thumb
            towards = (1 if closes else -1) * (j.closing or 1)
            pose.append(j.q_max if towards > 0 else j.q_min)
        return tuple(pose)

    def _pushes(self) -> Steps:
        """Close and open each flexing joint by a torque alone, while others are driven the other
        way: a torque of another joint or side shows.
        """
        self._report("a torque without a position gain: the joints must move with it")
        sides = self.plan.sides
        for first in (True, False):
            pushed = {s: self._pushed(s, first) for s in sides}
            phases = []
            for name, way, percent in (("push", 1, 100.0), ("pull", -1, 0.0)):
                targets = {
                    s: {i: self._pose(s, percent)[i] for i, w in pushed[s].items() if w == way}
                    for s in sides
                }
                phases.append(self._begin(name, sides, targets=targets))
            motors = {s: list(self._motors(s, self._goal[s])) for s in sides}
            for s in sides:
                for i, way in pushed[s].items():
                    tau = way * math.copysign(_PUSH, self._joints[s][i].closing)
                    motors[s][i] = replace(motors[s][i], tau=tau, kp=0.0, kd=_PUSH_DAMPING)
            yield from self._hold(_PUSH_SECONDS, motors)
            for phase in phases:
                self._end(phase)

    def _pushed(self, side: Side, first: bool) -> dict[int, int]:
        """The flexing joints with 1 where they close and -1 where they open, first or afterwards.

        Joints of one motor go the same way. On the left no motor goes as the next one does for
        long, and neither do those of one place in two fingers; the right hand has another order.
        """
        flexing = [[i for i in m if self._joints[side][i].closing] for m in self._model.motors]
        bit = 1 if side is Side.LEFT else 2
        return {
            i: 1 if bool((n ^ n >> bit) & 1) is not first else -1
            for n, joints in enumerate(filter(None, flexing))
            for i in joints
        }

    def _drive(
        self,
        name: str,
        sides: Sequence[Side],
        others: Mapping[Side, Motors],
        *,
        guarded: Mapping[Side, frozenset[int]] | None = None,
    ) -> Steps:
        """Some joints by a velocity or a torque, others slowly to a position: both are under way
        for long.

        :param guarded: the joints with time-out protection.
        """
        hands = dict(others)
        targets: dict[Side, dict[int, float]] = {}
        by_torque = self._by_torque()
        for s in sides:
            motors = self._guarded(self._motors(s, self._goal[s]), s, guarded or {})
            # to the farther place, so that it lasts
            far = max(
                (self._pose(s, percent) for percent in (CLOSED, OPEN)),
                key=lambda pose: sum(abs(pose[i] - self._goal[s][i]) for i in self._roles.slow),
            )
            for i in self._roles.driven:
                speed = math.copysign(_SPEED, self._joints[s][i].closing)
                dq, tau = (0.0, _DAMPING * speed) if i == by_torque else (speed, 0.0)
                motors[i] = replace(motors[i], dq=dq, tau=tau, kp=0.0, kd=_DAMPING)
            for i in self._roles.slow:
                motors[i] = self._slowly(motors[i], far[i])
            hands[s] = motors
            targets[s] = {i: far[i] for i in self._roles.slow}
        phase = self._begin(name, sides, targets=targets)
        yield from self._hold(0.3, hands)
        self._end(phase)

    def _slowly(self, motor: Motor, q: float) -> Motor:
        """The command to a motor to go to q for seconds, where the dialect has a way to say so."""
        if self.plan.dialect.position_servo:
            return replace(motor, q=q, dq=_SLOW_PART)
        return replace(motor, q=q, kp=_SLOW_GAINS[0], kd=_SLOW_GAINS[1])

    def _by_torque(self) -> int | None:
        """The joint that is driven by a torque this time, where protection is for each joint."""
        self._drives += 1
        if "guard" not in self.plan.phases:
            return None
        return self._roles.driven[self._drives % len(self._roles.driven)]

    def _guarded(
        self, motors: Motors, side: Side, guarded: Mapping[Side, frozenset[int]]
    ) -> list[Motor]:
        """The command with time-out protection for some joints."""
        mine = guarded.get(side, frozenset())
        return [
            replace(m, mode=self._codec.mode(i, timeout=True)) if i in mine else m
            for i, m in enumerate(motors)
        ]

    def _latch_and_clear(self, guarded: Mapping[Side, frozenset[int]]) -> Steps:
        """Commands to elsewhere with the same joints protected, and then with none."""
        sides = self.plan.sides
        poses = {s: self._pose(s, CLOSED - 5.0) for s in sides}
        targets = {s: {i: poses[s][i] for i in sorted(guarded[s])} for s in sides}
        phase = self._begin("guard-latch", sides, targets=targets)
        hands = {s: self._guarded(self._motors(s, poses[s]), s, guarded) for s in sides}
        yield from self._hold(0.35, hands)
        self._end(phase)
        yield from self._everyone("guard-clear", poses, most=1.5)

    def _touches(self) -> Steps:
        """One finger after the other presses on the object."""
        pressing = [s for s in self.plan.sides if s in self.plan.objects]
        if not pressing:
            return
        self._report("touching the object with one finger after the other")
        for finger in dict.fromkeys(j.name.partition("_")[0] for j in self._joints[pressing[0]]):
            targets: dict[Side, dict[int, float]] = {}
            hands: dict[Side, Motors] = {}
            for s in pressing:
                far = self._pose(s, self.plan.objects[s] + BEYOND)
                targets[s] = {
                    i: far[i]
                    for i, j in enumerate(self._joints[s])
                    if j.closing and j.name.startswith(finger)
                }
                pose = [targets[s].get(i, q) for i, q in enumerate(self._home(s))]
                hands[s] = self._motors(s, tuple(pose))
            phase = self._begin("touch", pressing, targets=targets, finger=finger)
            yield from self._hold(_TOUCH_SECONDS + self._travel(targets), hands)
            # a slow finger is still on its way
            for _ in range(_TOUCH_MORE):
                before = {s: self._obs.q.get(s, self._home(s)) for s in pressing}
                yield from self._hold(_TOUCH_STANDS, hands)
                if all(self._near(s, before[s], self._obs.q.get(s, before[s])) for s in pressing):
                    break
            self._end(phase)

    def _travel(self, targets: Mapping[Side, Mapping[int, float]]) -> float:
        """Seconds that position servos need from home; others are there at once."""
        if not self.plan.dialect.position_servo:
            return 0.0
        return max(
            abs(q - self._home(s)[i]) / self._joints[s][i].dq_max
            for s, mine in targets.items()
            for i, q in mine.items()
        )

    def _firmer(self) -> Steps:
        """All fingers hold the object softly; each presses firmly in turn, and softly again."""
        pressing = [s for s in self.plan.sides if s in self.plan.objects]
        if not pressing:
            return
        self._report("holding the object softly, with one finger after the other firmly")
        firm = self._squeezes(pressing, {})
        soft: dict[Side, Motors] = {}
        for s in pressing:
            near = self._pose(s, self.plan.objects[s] + BEYOND)
            soft[s] = [
                replace(m, q=near[i], kp=_SOFT_HOLD * m.kp) if self._joints[s][i].closing else m
                for i, m in enumerate(firm[s])
            ]
        yield from self._hold(_SOFT_HOLD_SECONDS, soft)
        fingers = dict.fromkeys(j.name.partition("_")[0] for j in self._joints[pressing[0]])
        before = soft
        for finger in (*fingers, ""):  # in the end all softly again
            hands: dict[Side, Motors] = {
                s: [
                    firm[s][i] if finger and self._joints[s][i].name.startswith(finger) else m
                    for i, m in enumerate(soft[s])
                ]
                for s in pressing
            }
            phase = self._begin("firmer", pressing, finger=finger)
            # slowly: what is seen must not be seen by the motion that a step makes
            for i in range(1, _RAMP + 1):
                between = {s: _between(before[s], hands[s], i / _RAMP) for s in pressing}
                yield from self._hold(_RAMP_SECONDS / _RAMP, between)
            yield from self._hold(_FIRM_SECONDS, hands)
            self._end(phase)
            before = hands

    def _squeeze_and_guard(self) -> Steps:
        """Close on the object, with some joints protected; then no commands."""
        sides = self.plan.sides
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        splits = self._next_splits()
        for percent in (CLOSED - 5.0, OPEN):
            yield from self._protected_step(percent, splits)
        squeeze = self._squeezes(pressing, splits)
        phases: list[Phase] = []
        if pressing:
            self._report("squeezing the object")
            targets = {
                s: {i: m.q for i, m in enumerate(squeeze[s]) if self._joints[s][i].closing}
                for s in pressing
            }
            phases.append(self._begin("squeeze", pressing, targets=targets))
        if free:
            phases.append(self._begin("guarded", tuple(free)))
        still = {s: self._guarded(self._motors(s, self._goal[s]), s, splits) for s in free}
        yield from self._hold(1.6 - ASIDE_SECONDS, {**squeeze, **still})
        phases += self._beside_grip(pressing)
        moved = {s: self._guarded(self._motors(s, self._goal[s]), s, splits) for s in free}
        yield from self._hold(ASIDE_SECONDS, {**squeeze, **moved})
        for phase in phases:
            self._end(phase)
        self._report("some joints have time-out protection, some of them move, and then ...")
        yield from self._drive("guard-drive", free, squeeze, guarded=splits)
        self._report("... silence: the protected ones must brake and say so, the others go on")
        yield from self._silence("guard", self._model.command_timeout + _STAYS)
        self._report("they stay braked until the protection is cleared")
        yield from self._latch_and_clear(splits)

    def _protected_step(self, percent: float, guarded: Mapping[Side, frozenset[int]]) -> Steps:
        """A step in which some joints have time-out protection: it changes nothing until then."""
        sides = self.plan.sides
        poses = {s: self._pose(s, percent) for s in sides}
        targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
        phase = self._begin("guarded-step", sides, targets=targets)
        hands = {s: self._guarded(self._motors(s, pose), s, guarded) for s, pose in poses.items()}
        yield from self._hold(0.45, hands)
        self._end(phase)
        self._goal.update(poses)

    def _ends_again(self) -> Steps:
        """A device that calibrates itself at its start may come back with other ends. Runs of hands
        with gains have no time for it.
        """
        if "ends" in self.plan.phases and self.plan.dialect.position_servo:
            yield from self._to_the_ends()

    def _grips_again(self) -> Steps:
        """A position servo's limits of force are its own: what a restart does to them is seen by a
        grip.
        """
        pressing = [s for s in self.plan.sides if s in self.plan.objects]
        if (
            not pressing
            or "squeeze" not in self.plan.phases
            or not self.plan.dialect.position_servo
        ):
            return
        self._report("squeezing the object again")
        yield from self._squeeze(pressing, _GRIP_SECONDS)
        yield from self._to("center", OPEN)

    def _new_client(self) -> Steps:
        """A position servo stands for a while where no other client has sent it, so that it is seen
        if the goals of one are still in force; and gets speeds again. Runs of hands with gains have
        no time for it.
        """
        if not self.plan.dialect.position_servo:
            return
        yield from self._to("center", _BETWEEN_PLACES)
        yield from self._hold(_NEW_CLIENT_SECONDS)
        if "speeds" in self.plan.phases:
            yield from self._speeds()
        yield from self._back()

    def _squeeze(
        self, sides: Sequence[Side], seconds: float, name: str = "squeeze", *, beside: bool = False
    ) -> Steps:
        """All fingers close on the object, as a phase.

        :param beside: the other hands make a step in the last part of it.
        """
        squeeze = self._squeezes(sides, {})
        targets = {
            s: {i: m.q for i, m in enumerate(squeeze[s]) if self._joints[s][i].closing}
            for s in sides
        }
        phases = [self._begin(name, sides, targets=targets)]
        if beside:
            yield from self._hold(seconds - ASIDE_SECONDS, squeeze)
            phases += self._beside_grip(sides)
            seconds = ASIDE_SECONDS
        yield from self._hold(seconds, squeeze)
        for phase in phases:
            self._end(phase)

    def _beside_grip(self, pressing: Sequence[Side]) -> list[Phase]:
        """Begin a step of the hands that do not press, while others do."""
        free = [s for s in self.plan.sides if s not in pressing]
        if not (free and pressing and "beside-grip" in self.plan.phases):
            return []
        self._goal.update({s: self._pose(s, CLOSED - 5.0) for s in free})
        targets = {s: dict(enumerate(self._goal[s])) for s in free}
        return [self._begin("beside-grip", free, targets=targets)]

    def _squeezes(
        self, sides: Sequence[Side], guarded: Mapping[Side, frozenset[int]]
    ) -> dict[Side, Motors]:
        """The command to press on the object: as far as a client can, where force is judged."""
        most = 100.0 if guarded else 0.0
        return {
            s: self._guarded(
                self._motors(s, self._pose(s, max(most, self.plan.objects[s] + BEYOND))), s, guarded
            )
            for s in sides
        }

    def _squeeze_and_silence(self) -> Steps:
        """Close on the object, and no commands, where no joint has protection."""
        sides = self.plan.sides
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        squeeze = self._squeezes(pressing, {})
        if pressing:
            self._report("squeezing the object")
            yield from self._squeeze(pressing, 2.0, beside=True)
        if self.plan.phases & {"silence", "resume"}:
            self._report("slow motion without protection, and then ...")
            yield from self._drive("drive", free, squeeze)
            self._report("... silence: nothing may be left driven by a velocity, a grip is kept")
            yield from self._silence("silence", self._model.command_timeout + 0.7)
            if pressing and self.plan.dialect.position_servo:
                self._report("squeezing the object on: its force must not fade")
                yield from self._squeeze(pressing, _GRIP_ON_SECONDS)
        yield from self._everyone("resume", {s: self._home(s) for s in sides}, most=1.5)

    def _each_silent(self) -> Steps:
        """No commands to each hand alone.

        Some joints have time-out protection, which must trip more than once; and once none has, as
        a hand may latch only then. A hand that is alone gets both silences, of two hands each gets
        one: a service rarely has a fault of time in one hand alone.
        """
        sides = self.plan.sides
        if len(sides) == 1 and "guard" in self.plan.phases:
            yield from self._silent_by_motion(self._once_more())
            yield from self._silent_by_motion({})
        if len(sides) > 1 and "silence" in self.plan.phases:
            for side, bad in zip(sides, (math.nan, math.inf), strict=True):
                home = self._motors(side, self._home(side))
                rejected = [replace(m, q=bad) for m in home] if self._codec.holds_nan else []
                guarded = self._once_more() if side is sides[0] else {}
                yield from self._silent_alone(side, rejected, guarded)
        yield from self._bad_at_once({s: self._not_finite(s)[-1] for s in sides})


def _between(a: Motors, b: Motors, part: float) -> list[Motor]:
    """Commands on the way from one hand's to another's."""
    return [
        replace(n, q=m.q + part * (n.q - m.q), kp=m.kp + part * (n.kp - m.kp))
        for m, n in zip(a, b, strict=True)
    ]
