"""Base of the scripts for hands: holding poses, waiting until a hand has settled, and phases common
to all hands.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from dexkit.command_age import PAUSE
from dexkit.conformance.kit.motor_messages import MotorCodec, Motors
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.operator import OPERATOR, operate
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.conformance.stimuli.script import (
    Join,
    Leave,
    Part,
    Payloads,
    Plan,
    Pose,
    Restart,
    Role,
    Script,
    Send,
    StartService,
    Steps,
    StopService,
)
from dexkit.conformance.stimuli.standing import Standing
from dexkit.hand import Side
from dexkit.models import HandModel, model

__all__ = ["HandScript"]

SETTLED = 0.02
"""Part of a joint's range within which it has reached its goal."""
PATIENCE = 6.0
"""Seconds that a slow hand is given to arrive, beyond those that a good one needs."""
FLOOD = 500
"""Commands of a burst."""
LOADS = ((400.0, 1.2, 1), (2500.0, 0.8, 10))
"""Loads: commands a second, seconds, and commands at a time. The first is twice what teleoperation
sends, the second what Unitree's C++ example sends (docs/sources/unitree-dex.md#b1)."""
ASIDE = 0.15
"""Part of a joint's range of a step that one side makes while the other gets bad commands."""
ASIDE_SECONDS = 0.95
"""Least time, s, in which a side is asked to make such a step."""
BETWEEN = 0.3
"""Seconds in which a hand that a bad command has moved returns, so that the next is not blamed."""
SINGLES, SINGLE_SECONDS = 5, 0.25
"""Commands that are sent once, and how long none follows, s: less than any time-out."""
LATE_SINGLE_SECONDS = 0.6
"""The same for hands with a control of their own: those of a real G1 answer 0.37 s late."""


class HandScript(Script[Side]):
    """The stimulus for hands; subclasses have the phases of their models."""

    _settling = 0.4
    """Seconds that a hand must stand near its goal in a step whose end is judged for ripple."""
    _standing = 0.2
    """The same in every other step."""
    _least = 0.5
    """Least duration of such a step, s."""
    _step_most = 2.5
    """Seconds of a step of all sides; see :meth:`_until_settled`."""
    _beside_s = ASIDE_SECONDS
    """Seconds in which a side makes a step while the other one is silent."""

    def __init__(self, plan: Plan[Side], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(plan, report)
        self._codec = MotorCodec(plan.dialect)
        self._model: HandModel = model(plan.dialect.model)
        self._joints = {s: joints_of(plan.dialect, s) for s in Side}
        self._strokes = {s: [j.stroke for j in joints] for s, joints in self._joints.items()}
        self._held: tuple[dict[Side, Pose], Payloads] = ({}, [])
        self._patient = False
        """Whether to wait for what takes a minute: once in a thorough run."""
        self._echoed = False
        """Whether a second client sends each command as well."""
        self._divided = False
        """Whether a second client commands all sides but the first, and the first client none of
        them."""
        self._period_ns = round(1e9 / self._model.command_rate)
        session = plan.session if "replay" in plan.phases else None
        sides = [s for s in plan.sides if session and s in session.sides]
        # before the run: it takes long enough to hold up the kit's reception of states
        self._timeline = session.timeline(sides, plan.dialect) if session and sides else []

    def run(self) -> Steps:
        """The whole script."""
        yield from self._do(Send([], 0))
        self._next_ns = self._obs.now_ns
        yield from self._listen()
        yield from self._approach()
        if not self._obs.q:
            self._report("no state on any topic: the rest of the script is left out")
            return
        for done in range(self.plan.rounds):
            if self.plan.rounds > 1:
                self._report(f"round {done + 1} of {self.plan.rounds}")
            self._patient = self.plan.rounds > 1 and done == 0
            yield from self._schedule(self._provocations())
        yield from self._schedule(
            [
                Part.of(OPERATOR, self._operator),
                Part.of("two-writers restart", self._two_writers),
                Part.of("company", self._company),
                Part.of("restart", self._client_restart),
                Part.of("", partial(self._hold, 0.1)),
                Part.of("shutdown restarted service-restart", self._service_restart),
            ]
        )

    @abstractmethod
    def _provocations(self) -> list[Part]:
        """Every part between the first motion and the operator, in order."""

    @abstractmethod
    def _bad(self, name: str) -> Steps:
        """Bad commands of one kind, on each side."""

    @abstractmethod
    def _again(self) -> Steps:
        """Bad commands of every kind once more, of another client."""

    @abstractmethod
    def _at(self, side: Side, q: Sequence[float]) -> Motors:
        """The command to go to q of every joint, rad, which may be out of range."""

    @abstractmethod
    def _silent_again(self) -> Steps:
        """Missing commands once more, after a restart of the service."""

    def _grips_again(self) -> Steps:
        """A short grip after a restart of the client or the service."""
        yield from ()

    def _new_client(self) -> Steps:
        """What a new client does besides the steps and grips."""
        yield from ()

    def _ends_again(self) -> Steps:
        """To the ends of each joint after a restart of the service."""
        yield from ()

    def _before_shutdown(self) -> Steps:
        """Commands to the hand before its service is stopped."""
        yield from ()

    def _not_restarted(self) -> Steps:
        """Steps if the kit cannot restart the service."""
        yield from ()

    def _after_shutdown(self) -> dict[Side, Pose]:
        """Goal of the hand after a restart of its service."""
        return self._other_place()

    @abstractmethod
    def _home(self, side: Side) -> Pose:
        """First pose of the hand: clear of stops and of the object."""

    def _homes(self) -> dict[Side, Pose]:
        return {s: self._home(s) for s in self.plan.sides}

    def _fingerprint(self) -> Steps:
        """Steps to compare the ``recover`` steps with."""
        for _ in range(2):
            yield from self._everyone("fingerprint", self._other_place(), most=self._step_most)

    @abstractmethod
    def _other_place(self) -> dict[Side, Pose]:
        """A pose worth moving to from here."""

    def _apart(self, places: Mapping[Side, Pose]) -> dict[Side, Pose]:
        """These places, or such near them that tell whose joint's goal another one has."""
        return dict(places)

    @abstractmethod
    def _motors(self, side: Side, pose: Pose) -> Motors:
        """The command to hold a pose, as the official client would send it."""

    def _command(self, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Every side holds its goal, but for those named."""
        if motors:
            every = {s: motors.get(s) or self._motors(s, q) for s, q in self._goal.items()}
            yield from self._send(self._codec.encode({**every, **motors}))
            return
        if self._held[0] != self._goal:  # they are held for long, and encoded once
            hold = {s: self._motors(s, q) for s, q in self._goal.items()}
            self._held = (dict(self._goal), self._codec.encode(hold))
        if self._divided:
            first, *others = self.plan.sides
            mine, theirs = (
                self._codec.encode({s: self._motors(s, self._goal[s]) for s in sides})
                for sides in ([first], others)
            )
            yield from self._send(mine)
            self._next_ns += self._period_ns
            yield from self._do(Send(theirs, self._next_ns, by=Role.RIVAL))
            return
        yield from self._send(self._held[1])
        if self._echoed:
            self._next_ns += self._period_ns
            yield from self._do(Send(self._held[1], self._next_ns, by=Role.RIVAL))

    def _hold(self, seconds: float, motors: Mapping[Side, Motors] | None = None) -> Steps:
        yield from self._repeat(seconds, lambda: self._command(motors))

    def _until_settled(
        self,
        phase: Phase | None,
        sides: Sequence[Side],
        *,
        least: float,
        most: float,
        stand: float | None = None,
    ) -> Steps:
        """Hold the goals until the sides have stood near them for a while.

        :param stand: seconds; None for those of a step whose end is judged for ripple.
        :param most: seconds; a hand that still comes nearer then is slow, not wrong, and is given
            up to :data:`PATIENCE` more.
        """
        begin = nearer_at = self._obs.now_ns
        stand = self._settling if stand is None else stand
        best = math.inf
        still = Standing([0.5 * SETTLED * stroke for s in sides for stroke in self._strokes[s]])
        while True:
            yield from self._command()
            now, q = self._obs.now_ns, self._obs.q
            if all(s in q and self._near(s, q[s], self._goal[s]) for s in sides):
                still.add(now, [x for s in sides for x in q[s]])
            else:
                still.restart()
            settled = still.lasts(now) >= stand
            left = sum(self._left(s, q[s]) for s in sides if s in q)
            if left < best - 0.01:
                best, nearer_at = left, now
            elapsed = (now - begin) / 1e9
            comes = now - nearer_at < 0.3e9 and elapsed < most + PATIENCE
            if (settled and elapsed >= least) or (elapsed >= most and not comes):
                break
        if phase is not None:
            self._end(phase)

    def _left(self, side: Side, here: Pose) -> float:
        """Distance of a hand from its goal, as parts of its joints' ranges."""
        strokes = self._strokes[side]
        return sum(abs(a - b) / s for a, b, s in zip(here, self._goal[side], strokes, strict=True))

    def _near(self, side: Side, a: Pose, b: Pose) -> bool:
        for x, y, stroke in zip(a, b, self._strokes[side], strict=True):
            if not abs(x - y) <= SETTLED * stroke:
                return False
        return True

    def _everyone(
        self,
        name: str,
        poses: Mapping[Side, Pose],
        *,
        most: float = 2.5,
        **params: str,
    ) -> Steps:
        """A step of all sides at once, as a phase."""
        # a center is no step to be judged: a hand that is there already is not held
        least = self._standing + 0.1 if name == "center" else self._least
        self._goal.update(poses)
        targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
        phase = self._begin(name, self.plan.sides, targets=targets, **params)
        yield from self._until_settled(
            phase, self.plan.sides, least=least, most=most, stand=self._standing
        )

    def _in_turn(
        self,
        name: str,
        *,
        away: Mapping[Side, Pose] | None = None,
        stand: float | None = None,
        divided: bool = False,
    ) -> Steps:
        """Steps of one side while the other rests, and of both in opposite directions, as phases
        of that name.

        :param away: where they go from here; None for another place than this one.
        :param stand: see :meth:`_until_settled`; None where ripple is not judged.
        :param divided: another client commands the other side in the last of them.
        """
        home, away = dict(self._goal), away or self._apart(self._other_place())
        stand = self._standing if stand is None else stand
        first, *others = self.plan.sides
        turns = [{first: away[first]}, {first: home[first]}]
        for side in others:
            turns[-1][side] = away[side]
            turns.append({side: home[side]})
        for goals in turns:
            self._divided = divided and goals is turns[-1]
            yield from self._turn(name, goals, least=0.5, stand=stand)

    def _turn(
        self,
        name: str,
        goals: Mapping[Side, Pose],
        *,
        least: float,
        stand: float | None = None,
    ) -> Steps:
        """A step of some sides while the others rest, as a phase."""
        self._goal.update(goals)
        targets = {s: dict(enumerate(pose)) for s, pose in goals.items()}
        phase = self._begin(name, tuple(goals), targets=targets)
        yield from self._until_settled(phase, tuple(goals), least=least, most=1.5, stand=stand)

    def _approach(self) -> Steps:
        """Slowly to the middle: the first motion of an unknown hand."""
        self._report("moving slowly to the middle")
        phase = self._begin("approach", self.plan.sides)
        home = {s: self._home(s) for s in self.plan.sides}
        start = {s: self._obs.q.get(s, home[s]) for s in self.plan.sides}
        reach, seen = 0.0, self._elapsed(phase)
        while True:
            now = self._elapsed(phase)
            # if the kit stood still, the goal goes on from where it was: the hand must not jump
            reach, seen = reach + 0.6 * min(now - seen, PAUSE), now
            self._goal = {
                s: tuple(
                    q + max(-reach * j.stroke, min(reach * j.stroke, end - q))
                    for q, end, j in zip(pose, home[s], self._joints[s], strict=True)
                )
                for s, pose in start.items()
            }
            if all(
                abs(q - end) < 1e-6
                for s in start
                for q, end in zip(self._goal[s], home[s], strict=True)
            ):
                break
            yield from self._command()
        yield from self._until_settled(phase, self.plan.sides, least=0.3, most=2.0)

    def _bad_commands(
        self,
        name: str,
        sides: Sequence[Side],
        kinds: Sequence[Mapping[Side, Motors] | Payloads],
        each: float,
    ) -> Steps:
        """Bad commands to some sides, as a phase: each kind long enough to show what it does.

        The other sides go on being commanded; where there is time, they make a step.

        :param kinds: motors of each of these sides, or whole messages.
        :param each: seconds of each kind.
        """
        beside = self._beside_others(sides, len(kinds) * each)
        good = {s: self._motors(s, q) for s, q in self._goal.items() if s not in sides}
        phase = self._begin(name, sides)
        for kind in kinds:
            bad = kind if isinstance(kind, list) else self._codec.encode({**good, **kind})
            yield from self._repeat(each, lambda bad=bad: self._send(bad))  # type: ignore[misc]
            yield from self._command()  # or it would brake, as it must without good commands
        self._end(phase)
        for other in beside:
            self._end(other)

    def _beyond_each_end(
        self, name: str, far: Sequence[Mapping[Side, Motors]], each: float, most: float = 2.5
    ) -> Steps:
        """Goals beyond the ends to all sides, each way from inside of the range.

        At an end, a hand that goes there in any case cannot be told from one that ignores them.

        :param far: in turn beyond the one end and the other.
        :param each: seconds of each.
        :param most: seconds to come back inside in between.
        """
        for way in range(2):
            if way:
                yield from self._everyone("center", self._other_place(), most=most)
            yield from self._bad_commands(name, self.plan.sides, far[way::2], each)

    def _beside_others(self, sides: Sequence[Side], seconds: float) -> list[Phase]:
        """Begin a step of the sides that are not among these, where that takes no longer."""
        others = [s for s in self.plan.sides if s not in sides]
        if not others or self._codec.shared or seconds < ASIDE_SECONDS:
            return []
        self._goal.update({s: self._aside(s) for s in others})
        return [
            self._begin("beside", (s,), targets={s: dict(enumerate(self._goal[s]))}) for s in others
        ]

    def _aside(self, side: Side, part: float = ASIDE) -> Pose:
        """A part of each joint's range from its goal, away from the nearer end."""
        return tuple(
            q + math.copysign(part * j.stroke, 0.5 * (j.q_min + j.q_max) - q)
            for q, j in zip(self._goal[side], self._joints[side], strict=True)
        )

    def _bad_at_once(self, broken: Mapping[Side, Motors]) -> Steps:
        """Commands that are not finite, and such that are far out of range, soon after a pause."""
        if "nan" in self.plan.phases:
            yield from self._bad_commands("nan", self.plan.sides, [broken], 0.1)
        # taken modulo a turn, 11 rad leads to the wrong end, and 1000 rad to the right one
        yield from self._far_away((11.0, -1000.0), 0.15)
        if self.plan.phases & {"nan", "out-of-range"}:
            yield from self._everyone(
                "recover", self._other_place(), after=self._bad_phases_since_recovery
            )

    def _bad_together(self, names: Sequence[str], *, most: float | None = None) -> Steps:
        """Bad commands of these kinds, and a good step after all of them.

        :param most: seconds of the step, if not as of every other one.
        """
        most = self._step_most if most is None else most
        these = [name for name in names if name in self.plan.phases]
        for name in these:
            if name != these[0]:
                yield from self._hold(BETWEEN)
            yield from self._foreign() if name == "foreign" else self._bad(name)
        if these:
            yield from self._everyone(
                "recover", self._other_place(), most=most, after=" ".join(these)
            )

    def _far_away(self, goals: Sequence[float], each: float) -> Steps:
        """Commands far beyond both ends, to all sides at once.

        :param goals: q of every joint, rad, one after the other.
        :param each: seconds of each.
        """
        sides = self.plan.sides
        if "out-of-range" in self.plan.phases:
            joints = len(self._joints[sides[0]])
            kinds = [{s: self._at(s, [q] * joints) for s in sides} for q in goals]
            yield from self._bad_commands("out-of-range", sides, kinds, each)

    @property
    def _bad_phases_since_recovery(self) -> str:
        """The phases of bad commands since the last step that a hand can recover by."""
        names = [p.name for p in self.phases]
        last = max(i for i, name in enumerate(names) if name in ("restart", "resume", "recover"))
        return " ".join(dict.fromkeys(names[last + 1 :]))

    def _each_alone(self) -> list[tuple[Side, ...]]:
        """Each side by itself; both where they share a message."""
        if self._codec.shared:
            return [self.plan.sides]
        return [(s,) for s in self.plan.sides]

    def _single(self) -> Steps:
        """Commands that are not repeated: every one counts, and the newest most of all."""
        self._report("commands that are sent once: each must be obeyed")
        if self._goal != {s: self._home(s) for s in self.plan.sides}:
            yield from self._everyone("center", {s: self._home(s) for s in self.plan.sides})
        home = dict(self._goal)
        away = {s: self._aside(s, 0.4 * ASIDE) for s in home}
        decoy = {s: self._aside(s, -0.2 * ASIDE) for s in home}
        encode = self._codec.encode
        seconds = SINGLE_SECONDS if self.plan.dialect.gains_are_used else LATE_SINGLE_SECONDS
        for i in range(SINGLES):
            goal = home if i % 2 else away
            if i % 3 == 2:  # a newer command replaces one that has just arrived
                yield from self._send(encode({s: self._motors(s, q) for s, q in decoy.items()}))
            self._goal.update(goal)
            targets = {s: dict(enumerate(pose)) for s, pose in goal.items()}
            phase = self._begin("single", self.plan.sides, targets=targets)
            yield from self._command()
            yield from self._through(phase, seconds, lambda: self._wait(0.01))

    def _silence_alone(self, name: str, side: Side, rejected: Mapping[Side, Motors]) -> Steps:
        """No good command to one side, as a phase; the others make a step after the time-out.

        :param name: of the phase.
        :param rejected: what the side gets instead: it must not count as a command.
        """
        phase = self._begin(name, (side,))
        beside: list[Phase] = []
        for seconds in (self._model.command_timeout + 0.1, self._beside_s):
            good = {s: self._motors(s, q) for s, q in self._goal.items() if s != side}
            payloads = self._codec.encode({**good, **rejected})
            yield from self._repeat(
                seconds,
                lambda payloads=payloads: self._send(payloads),  # type: ignore[misc]
            )
            if not beside:
                beside = self._beside_others((side,), ASIDE_SECONDS)
        for ended in (phase, *beside):
            self._end(ended)

    def _operator(self) -> Steps:
        """Unitree's client in a closed loop, and back to the middle."""
        yield from operate(self, self._codec)
        yield from self._everyone("center", self._homes())

    def _session(self) -> Steps:
        """The recorded session, if there is one, and back to the middle."""
        if self.plan.session is not None:
            yield from self._replay(self.plan.session)
            yield from self._everyone("center", self._homes())

    def _replay(self, session: CommandSession) -> Steps:
        sides = [s for s in self.plan.sides if s in session.sides]
        if not sides:
            return
        dialect = self.plan.dialect
        timeline = self._timeline
        newest = {s: session.first(s, dialect) for s in sides}
        self._goal.update({s: tuple(m.q for m in motors) for s, motors in newest.items()})
        reachable = [s for s in sides if self._reachable(s)]
        yield from self._until_settled(None, reachable, least=0.4, most=2.0)
        self._report(f"replaying {session.duration:.0f} s of the recorded session {session.name}")
        phase = self._begin("replay", sides, session=session.name)
        start = self._obs.now_ns
        for i, (at, motors) in enumerate(timeline):
            late = self._obs.now_ns - start - at
            if late > PAUSE * 1e9:  # all that fell due, sent at once, would move the hand wildly
                self._report(
                    f"this program stood still for {late / 1e9:.2f} s; the session is held"
                )
                start += late
            newest.update(motors)
            payloads = self._codec.encode(newest if self._codec.shared else motors)
            later = timeline[i + 1][0] if i + 1 < len(timeline) else at + self._period_ns
            yield from self._do(Send(payloads, start + later))
        self._end(phase)
        self._next_ns = self._obs.now_ns
        self._goal.update({s: tuple(m.q for m in newest[s]) for s in sides})

    def _reachable(self, side: Side) -> bool:
        """Whether nothing stands between a hand and its goal."""
        return True

    def _late_joiner(self) -> Steps:
        self._report("a second subscriber joins late: it must get the state at once")
        phase = self._begin("late-joiner", self.plan.sides)
        yield Join()
        while self._elapsed(phase) < 3.0:
            yield from self._command()
            if self._elapsed(phase) >= 0.3 and set(self.plan.sides) <= set(self._obs.joined):
                break
        phase.observed = {f"first_state_s_{s}": self._obs.joined.get(s) for s in self.plan.sides}
        self._end(phase)
        yield from self._do(Leave())

    def _foreign(self) -> Steps:
        """Another participant publishes another type on the command topics, with far targets."""
        self._report("another type on the command topics: it must not reach the hand")
        yield from self._hold(0.1)
        far = self._codec.encode_foreign(
            {s: self._motors(s, pose) for s, pose in self._other_place().items()}
        )
        yield from self._do(Join(Role.STRANGER))
        phase = self._begin("foreign", self.plan.sides)
        # two goals in turn cancel out in a servo whose speed does not depend on the distance
        turns = 3 if self.plan.dialect.position_servo else 1
        yield from self._beside(phase, far, Role.STRANGER, 0.4, turns)
        self._end(phase)
        yield from self._do(Leave(Role.STRANGER))

    def _flood(self) -> Steps:
        """Hundreds of commands at once to another place, the last of them back to this one."""
        self._report(f"{FLOOD} commands at once: only the last one counts")
        yield from self._hold(0.1)
        far = self._codec.encode(
            {s: self._motors(s, pose) for s, pose in self._other_place().items()}
        )
        phase = self._begin("burst", self.plan.sides)
        yield from self._do(Send(far * (FLOOD - 1), 0))
        phase.observed = {"sent_s": self._elapsed(phase)}
        yield from self._hold(0.6)
        self._end(phase)

    def _old_stamps(self) -> Steps:
        self._report("a client whose clock is an hour behind: it must be obeyed")
        self._age_s = 3600.0
        yield from self._everyone("old-stamps", self._other_place(), most=1.5)
        self._age_s = 0.0

    def _load(self) -> Steps:
        """Many commands, and a reliable subscriber that hardly ever reads."""
        here, there = dict(self._goal), self._other_place()
        count = 40  # points of the way there and back
        parts = [0.3 * (1 - abs(2 * i / count - 1)) for i in range(count + 1)]
        points = [
            self._codec.encode(
                {
                    s: self._motors(
                        s, tuple(a + part * (b - a) for a, b in zip(here[s], there[s], strict=True))
                    )
                    for s in self.plan.sides
                }
            )
            for part in parts
        ]
        yield from self._do(Join(Role.LAGGARD))
        period = self._period_ns
        for rate, seconds, at_a_time in LOADS:
            self._report(f"{rate:g} commands a second and a slow reader: state must keep its rate")
            self._period_ns = round(at_a_time * 1e9 / rate)
            phase = self._begin("load", self.plan.sides)
            while (at := self._elapsed(phase) / seconds) < 1.0:
                yield from self._send(points[int(at * count)] * at_a_time)
            self._end(phase)
        self._period_ns = period
        yield from self._do(Leave(Role.LAGGARD))

    def _two_writers(self) -> Steps:
        self._report("a second client commands another place, and goes again")
        yield from self._hold(0.1)
        there = self._other_place()
        rival = self._codec.encode({s: self._motors(s, pose) for s, pose in there.items()})
        targets = {s: dict(enumerate(pose)) for s, pose in there.items()}
        yield from self._do(Join(Role.RIVAL))
        phase = self._begin("two-writers", self.plan.sides, targets=targets)
        yield from self._beside(phase, rival, Role.RIVAL, 0.5)
        self._end(phase)
        yield from self._do(Leave(Role.RIVAL))
        yield from self._everyone("recover", dict(self._goal), most=1.5, after="two-writers")

    def _company(self) -> Steps:
        """A second client sends each command as well, or commands the other hand."""
        self._report("a second client commands the same: it must make no difference")
        yield from self._do(Join(Role.RIVAL))
        period = self._period_ns
        self._period_ns, self._echoed = period // 2, True
        several = len(self.plan.sides) > 1 and not self._codec.shared
        yield from self._in_turn("company", divided=several)
        self._period_ns, self._echoed, self._divided = period, False, False
        yield from self._do(Leave(Role.RIVAL))

    def _beside(
        self, phase: Phase, payloads: Payloads, role: Role, seconds: float, turns: int = 1
    ) -> Steps:
        """Another client sends between this one's commands, so many times as often."""
        period = self._period_ns
        self._period_ns = period // 2
        while self._elapsed(phase) < seconds:
            yield from self._command()
            for _ in range(turns):
                self._next_ns += self._period_ns
                yield from self._do(Send(payloads, self._next_ns, by=role))
        self._period_ns = period

    def _client_restart(self) -> Steps:
        """The commanding program goes away, and another one comes."""
        self._report("the commanding program is restarted: the new one must be obeyed")
        yield Restart()
        yield from self._in_turn("restart")
        yield from self._grips_again()
        yield from self._new_client()
        if "nan" in self.plan.phases:
            yield from self._again()

    def _service_restart(self) -> Steps:
        """End the service and start it again, where the kit can."""
        self._report("the service is stopped and started again")
        yield from self._before_shutdown()
        phase = self._begin("shutdown", self.plan.sides)
        yield from self._do(StopService())
        if not self._obs.stopped:
            self.phases.remove(phase)
            self._report("the kit has not started the service, so it does not restart it")
            yield from self._not_restarted()
            return
        phase.observed = dict(self._obs.stopped)
        yield from self._do(StartService())
        self._end(phase)
        self._next_ns = self._obs.now_ns
        # longer than a state may take, so that it must come without a command
        yield from self._silence("restarted", 1.3)
        yield from self._everyone("service-restart", self._after_shutdown(), most=4.0)
        yield from self._in_turn("service-restart")
        yield from self._grips_again()
        yield from self._ends_again()
        if "silence" in self.plan.phases:
            yield from self._silent_again()

    def _silence(self, name: str, seconds: float) -> Steps:
        """No command at all, as a phase."""
        phase = self._begin(name, self.plan.sides)
        yield from self._through(phase, seconds, lambda: self._wait(0.05))
