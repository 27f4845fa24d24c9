"""Base of the scripts for hands: holding poses, steps, and waiting until a hand has settled."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

from dexkit.command_age import PAUSE
from dexkit.conformance.kit.motor_messages import MotorCodec, Motors
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.phases import Moment
from dexkit.conformance.stimuli.script import Payloads, Plan, Pose, Role, Script, Send, Steps
from dexkit.conformance.stimuli.standing import Standing
from dexkit.hand import Side
from dexkit.models import HandModel, model

__all__ = ["HandScript"]

SETTLED = 0.02
"""Part of a joint's range within which it has reached its goal."""
PATIENCE = 6.0
"""Seconds that a slow hand is given to arrive, beyond those that a good one needs."""
ASIDE = 0.15
"""Part of a joint's range of a step that one side makes while the other gets bad commands."""
ASIDE_SECONDS = 0.75
"""Least time, s, in which a side is asked to make such a step."""


class HandScript(Script[Side]):
    """The stimulus for hands; subclasses have the poses and commands of their kinds."""

    settling = 0.4
    """Seconds that a hand must stand near its goal in a step whose end is judged for ripple."""
    standing = 0.2
    """The same in every other step."""
    least = 0.5
    """Least duration of such a step, s."""
    step_most = 2.5
    """Seconds of a step of all sides; see :meth:`until_settled`."""
    beside_s = 0.6
    """Seconds in which a side makes a step while the other one is silent."""
    all_turns = False
    """Whether the second side makes a step alone whenever each does in turn."""
    between_bad = 0.15
    """Seconds in which a hand that a bad command has moved returns, so that the next is not
    blamed."""

    def __init__(self, plan: Plan[Side], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(plan, report)
        self.codec = MotorCodec(plan.dialect)
        self.model: HandModel = model(plan.dialect.model)
        self.joints = {s: joints_of(plan.dialect, s) for s in Side}
        self.strokes = {s: [j.stroke for j in joints] for s, joints in self.joints.items()}
        self._held: tuple[dict[Side, Pose], Payloads] = ({}, [])
        self.patient = False
        """Whether to wait for what takes a minute: once in a thorough run."""
        self.echoed = False
        """Whether a second client sends each command as well."""
        self.divided = False
        """Whether a second client commands all sides but the first, and the first client none of
        them."""
        self.period_ns = round(1e9 / self.model.command_rate)
        session = plan.session if "replay" in plan.phases else None
        sides = [s for s in plan.sides if session and s in session.sides]
        # before the run: it takes long enough to hold up the kit's reception of states
        self.timeline = session.timeline(sides, plan.dialect) if session and sides else []

    def run(self) -> Steps:
        """The whole script."""
        yield from self.do(Send([], 0))
        self.next_ns = self.obs.now_ns
        yield from self.listen()
        yield from self.approach()
        if not self.obs.q:
            self.report("no state on any topic: the rest of the script is left out")
            return
        for done in range(self.plan.rounds):
            if self.plan.rounds > 1:
                self.report(f"round {done + 1} of {self.plan.rounds}")
            self.patient = self.plan.rounds > 1 and done == 0
            yield from self.schedule(Moment.ROUND)
        yield from self.schedule(Moment.CLIENTS)
        yield from self.hold(0.1)
        yield from self.schedule(Moment.SERVICE)

    @abstractmethod
    def home(self, side: Side) -> Pose:
        """First pose of the hand: clear of stops and of the object."""

    def after_shutdown(self) -> dict[Side, Pose]:
        """Goal of the hand after a restart of its service."""
        return self.other_place()

    def homes(self) -> dict[Side, Pose]:
        """The first pose of each."""
        return {s: self.home(s) for s in self.plan.sides}

    @abstractmethod
    def other_place(self) -> dict[Side, Pose]:
        """A pose worth moving to from here."""

    def apart(self, places: Mapping[Side, Pose]) -> dict[Side, Pose]:
        """These places, or such near them that tell whose joint's goal another one has."""
        return dict(places)

    @abstractmethod
    def motors(self, side: Side, pose: Pose) -> Motors:
        """The command to hold a pose, as the official client would send it."""

    def command(self, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Every side holds its goal, but for those named."""
        if motors:
            every = {s: motors.get(s) or self.motors(s, q) for s, q in self.goal.items()}
            yield from self.send(self.codec.encode({**every, **motors}))
            return
        if self._held[0] != self.goal:  # they are held for long, and encoded once
            hold = {s: self.motors(s, q) for s, q in self.goal.items()}
            self._held = (dict(self.goal), self.codec.encode(hold))
        if self.divided:
            first, *others = self.plan.sides
            mine, theirs = (
                self.codec.encode({s: self.motors(s, self.goal[s]) for s in sides})
                for sides in ([first], others)
            )
            yield from self.send(mine)
            self.next_ns += self.period_ns
            yield from self.do(Send(theirs, self.next_ns, by=Role.RIVAL))
            return
        yield from self.send(self._held[1])
        if self.echoed:
            self.next_ns += self.period_ns
            yield from self.do(Send(self._held[1], self.next_ns, by=Role.RIVAL))

    def hold(self, seconds: float, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Every side holds its goal for so long, but for those with other commands."""
        yield from self.repeat(seconds, lambda: self.command(motors))

    def hold_as(
        self,
        name: str,
        sides: Sequence[Side],
        seconds: float,
        motors: Mapping[Side, Motors] | None = None,
        *,
        targets: Mapping[Side, Mapping[int, float] | Pose] | None = None,
    ) -> Steps:
        """The same as a phase of these sides."""
        phase = self.begin(name, sides, targets=targets)
        yield from self.hold(seconds, motors)
        self.end(phase)

    def until_settled(
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
        begin = nearer_at = self.obs.now_ns
        stand = self.settling if stand is None else stand
        best = math.inf
        still = Standing([0.5 * SETTLED * stroke for s in sides for stroke in self.strokes[s]])
        while True:
            yield from self.command()
            now, q = self.obs.now_ns, self.obs.q
            if all(s in q and self.near(s, q[s], self.goal[s]) for s in sides):
                still.add(now, [x for s in sides for x in q[s]])
            else:
                still.restart()
            settled = still.lasts(now) >= stand
            left = sum(self.left(s, q[s]) for s in sides if s in q)
            if left < best - 0.01:
                best, nearer_at = left, now
            elapsed = (now - begin) / 1e9
            comes = now - nearer_at < 0.3e9 and elapsed < most + PATIENCE
            if (settled and elapsed >= least) or (elapsed >= most and not comes):
                break
        if phase is not None:
            self.end(phase)

    def left(self, side: Side, here: Pose) -> float:
        """Distance of a hand from its goal, as parts of its joints' ranges."""
        strokes = self.strokes[side]
        return sum(abs(a - b) / s for a, b, s in zip(here, self.goal[side], strokes, strict=True))

    def near(self, side: Side, a: Pose, b: Pose) -> bool:
        """Whether two poses are alike."""
        for x, y, stroke in zip(a, b, self.strokes[side], strict=True):
            if not abs(x - y) <= SETTLED * stroke:
                return False
        return True

    def everyone(
        self,
        name: str,
        poses: Mapping[Side, Pose],
        *,
        most: float = 2.5,
        **params: str,
    ) -> Steps:
        """A step of all sides at once, as a phase."""
        # a center is no step to be judged: a hand that is there already is not held
        least = self.standing + 0.1 if name == "center" else self.least
        self.goal.update(poses)
        phase = self.begin(name, self.plan.sides, targets=poses, **params)
        yield from self.until_settled(
            phase, self.plan.sides, least=least, most=most, stand=self.standing
        )

    def in_turn(
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
        :param stand: see :meth:`until_settled`; None where ripple is not judged.
        :param divided: another client commands the other side in the last step of both.
        """
        home, away = dict(self.goal), away or self.apart(self.other_place())
        stand = self.standing if stand is None else stand
        first, *others = self.plan.sides
        turns = [{first: away[first]}, {first: home[first]}]
        for side in others:
            turns[-1][side] = away[side]
            turns.append({side: home[side]})
        if others and not self.all_turns:
            turns.pop()
        for goals in turns:
            self.divided = divided and len(goals) > 1
            yield from self.turn(name, goals, least=0.5, stand=stand)

    def turn(
        self,
        name: str,
        goals: Mapping[Side, Pose],
        *,
        least: float,
        stand: float | None = None,
    ) -> Steps:
        """A step of some sides while the others rest, as a phase."""
        self.goal.update(goals)
        phase = self.begin(name, tuple(goals), targets=goals)
        yield from self.until_settled(phase, tuple(goals), least=least, most=1.5, stand=stand)

    def approach(self) -> Steps:
        """Slowly to the middle: the first motion of an unknown hand."""
        self.report("moving slowly to the middle")
        phase = self.begin("approach", self.plan.sides)
        home = {s: self.home(s) for s in self.plan.sides}
        start = {s: self.obs.q.get(s, home[s]) for s in self.plan.sides}
        reach, seen = 0.0, self.elapsed(phase)
        while True:
            now = self.elapsed(phase)
            # if the kit stood still, the goal goes on from where it was: the hand must not jump
            reach, seen = reach + 0.6 * min(now - seen, PAUSE), now
            self.goal = {
                s: tuple(
                    q + max(-reach * j.stroke, min(reach * j.stroke, end - q))
                    for q, end, j in zip(pose, home[s], self.joints[s], strict=True)
                )
                for s, pose in start.items()
            }
            if all(
                abs(q - end) < 1e-6
                for s in start
                for q, end in zip(self.goal[s], home[s], strict=True)
            ):
                break
            yield from self.command()
        yield from self.until_settled(phase, self.plan.sides, least=0.3, most=2.0)

    def beside_others(self, sides: Sequence[Side], seconds: float) -> list[Phase]:
        """Begin a step of the sides that are not among these, where that takes no longer."""
        others = [s for s in self.plan.sides if s not in sides]
        if not others or self.codec.shared or seconds < ASIDE_SECONDS:
            return []
        self.goal.update({s: self.aside(s) for s in others})
        return [self.begin("beside", (s,), targets={s: self.goal[s]}) for s in others]

    def aside(self, side: Side, part: float = ASIDE) -> Pose:
        """A part of each joint's range from its goal, away from the nearer end."""
        return tuple(
            q + math.copysign(part * j.stroke, 0.5 * (j.q_min + j.q_max) - q)
            for q, j in zip(self.goal[side], self.joints[side], strict=True)
        )

    def reachable(self, side: Side) -> bool:
        """Whether nothing stands between a hand and its goal."""
        return True

    def beside(
        self, phase: Phase, payloads: Payloads, role: Role, seconds: float, turns: int = 1
    ) -> Steps:
        """Another client sends between this one's commands, so many times as often."""
        period = self.period_ns
        self.period_ns = period // 2
        while self.elapsed(phase) < seconds:
            yield from self.command()
            for _ in range(turns):
                self.next_ns += self.period_ns
                yield from self.do(Send(payloads, self.next_ns, by=role))
        self.period_ns = period

    def silence(self, name: str, seconds: float) -> Steps:
        """No command at all, as a phase."""
        phase = self.begin(name, self.plan.sides)
        yield from self.through(phase, seconds, lambda: self.wait(0.05))
