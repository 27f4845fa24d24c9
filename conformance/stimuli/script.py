"""What every script shares: actions and observations, sending at a steady rate, phases, waiting
until a hand has settled, and the stimuli that are the same for every hand.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from dexkit.conformance.motor_messages import Motor, Motors, Wire
from dexkit.conformance.recording import joints_of
from dexkit.conformance.stimuli.operator import OPERATOR, operate
from dexkit.conformance.stimuli.session import Session
from dexkit.conformance.stimulus_record import Phase
from dexkit.freshness import PAUSE
from dexkit.hand import JointSpec, Side
from dexkit.models import DEX1_1, DEX3_1, DEX5_1, Dialect, HandModel, model

__all__ = [
    "DEFAULT_OBJECTS",
    "NOT_FINITE",
    "Action",
    "Join",
    "Leave",
    "Observation",
    "Payloads",
    "Plan",
    "Pose",
    "Restart",
    "Role",
    "Script",
    "Send",
    "StartService",
    "Steps",
    "StopService",
    "default_objects",
    "object_places",
]

DEFAULT_OBJECTS = {
    DEX1_1.name: {Side.RIGHT: 37.0},
    DEX3_1.name: {Side.RIGHT: 60.0},
    DEX5_1.name: {Side.RIGHT: 60.0},
}
"""Where the hands of a pair that the kit starts feel an object. Percent of opening for a gripper:
2.0 rad, where the shipped session closes on one. Percent of closing for others: nearly as far as
the shipped session closes."""
SETTLED = 0.02
"""Part of a joint's range within which it counts as being where it should."""
PATIENCE = 6.0
"""Seconds that a slow hand is given to arrive, beyond those that a good one needs."""
NOT_FINITE = [
    (field, value)
    for field in ("q", "dq", "tau", "kp", "kd")
    for value in (math.nan, math.inf, -math.inf)
]
"""Field of a command and what it is in a bad one. Who tests field by field forgets some."""
FLOOD = 500
"""Commands of a burst."""
LOAD_RATE, LOAD_SECONDS = 400.0, 2.5
"""Commands a second under load, twice and more what official clients send, and for how long."""
_SERVICE_START_NS = 3_000_000_000
"""About what it takes to start a service: measured on two cores with emulated devices."""
Payloads = list[tuple[str, bytes]]
Pose = tuple[float, ...]
"""q of every joint of a hand, rad."""


class Role(Enum):
    """Who else is on the topics, beside the commanding client."""

    MONITOR = "a second listener"
    LAGGARD = "a reliable listener that looks only twice a second"
    RIVAL = "a second commanding client"
    STRANGER = "somebody who publishes another type on the command topics"


@dataclass(frozen=True)
class Observation:
    """What a runner tells the script.

    :param now_ns: the recording's clock.
    :param q: newest pose of each side that has published one; dq likewise.
    :param joined: of a :attr:`Role.MONITOR`, seconds until each side's first state arrived there.
    :param stopped: after :class:`StopService`: ``exit_s``, the seconds until the services had
        ended, and ``gone_s``, until their publishers had vanished from the domain after that;
        None is never. Nothing at all where the kit has not started the services.
    :param machine: ``mode_machine`` of a robot's newest state.
    """

    now_ns: int
    q: Mapping[Side, Pose] = field(default_factory=dict)
    dq: Mapping[Side, Pose] = field(default_factory=dict)
    joined: Mapping[Side, float] = field(default_factory=dict)
    stopped: Mapping[str, float | None] = field(default_factory=dict)
    machine: int = 0


@dataclass(frozen=True)
class Send:
    """Publish these (topic, payload), then wait until a time.

    :param by: who publishes them, if not the client.
    :param age_s: how long ago their source timestamps say that they were written.
    """

    payloads: Payloads
    until_ns: int
    by: Role | None = None
    age_s: float = 0.0


@dataclass(frozen=True)
class Join:
    """Somebody else comes."""

    role: Role = Role.MONITOR


@dataclass(frozen=True)
class Leave:
    """And goes."""

    role: Role = Role.MONITOR


@dataclass(frozen=True)
class Restart:
    """Remove the commanding client, and create a new one."""


@dataclass(frozen=True)
class StopService:
    """Ask the hands' services to end (SIGTERM), if the kit has started them."""


@dataclass(frozen=True)
class StartService:
    """Start them again."""


Action = Send | Join | Leave | Restart | StopService | StartService
Steps = Generator[Action, Observation, None]


@dataclass(frozen=True)
class Plan:
    """What to do to whom.

    :param objects: where a side touches an object: in the dialect's radians for a hand of one
        joint, percent of closing for others.
    :param phases: names of the phases to go through; see
        :func:`dexkit.conformance.stimuli.phases_for`.
    """

    dialect: Dialect
    sides: tuple[Side, ...]
    objects: Mapping[Side, float] = field(default_factory=dict)
    session: Session | None = None
    phases: frozenset[str] = frozenset()


def object_places(dialect: Dialect, percents: Mapping[Side, float]) -> dict[Side, float]:
    """Percents as the script takes them: of opening in radians, of closing as they are."""
    if math.isnan(dialect.q_open):
        return dict(percents)
    return {s: pct / 100 * dialect.q_open for s, pct in percents.items()}


def default_objects(dialect: Dialect, sides: Sequence[Side]) -> dict[Side, float]:
    """The default objects of a pair of hands, as the script takes them."""
    percents = DEFAULT_OBJECTS[dialect.model]
    return object_places(dialect, {s: p for s, p in percents.items() if s in sides})


class Script(ABC):
    """The stimulus for one plan; each model's script says what is done in which order."""

    motion = "step"
    """The phase in which the hand moves, for requirements that need any motion."""

    def __init__(self, plan: Plan, say: Callable[[str], None] = lambda text: None) -> None:
        self.plan = plan
        self.phases: list[Phase] = []
        self._say = say
        self._wire = Wire(plan.dialect)
        self._model: HandModel = model(plan.dialect.model)
        self._joints: dict[Side, tuple[JointSpec, ...]] = {
            s: joints_of(plan.dialect, s) for s in Side
        }
        self._goal: dict[Side, Pose] = {}
        self._held: tuple[dict[Side, Pose], Payloads] = ({}, [])
        self._next_ns = 0
        self._age_s = 0.0
        self._period_ns = round(1e9 / self._model.command_rate)
        self._obs = Observation(0)

    def run(self) -> Steps:
        """The whole script."""
        self._obs = yield Send([], 0)
        self._next_ns = self._obs.now_ns
        yield from self._listen()
        yield from self._approach()
        if not self._obs.q:
            self._say("no state on any topic: nothing more can be asked of this hand")
            return
        yield from self._provoke()
        if OPERATOR in self.plan.phases:
            yield from operate(self)
            yield from self._everyone("center", {s: self._home(s) for s in self.plan.sides})
        if "two-writers" in self.plan.phases:
            yield from self._two_writers()
        if "restart" in self.plan.phases:
            self._say("the commanding program is restarted: the new one must be obeyed")
            yield Restart()
            yield from self._everyone("restart", self._other_place())
        yield from self._hold(0.2)
        if self.plan.phases & {"shutdown", "service-restart"}:
            yield from self._service_restart()

    def length(self) -> float:
        """Seconds that :meth:`run` takes with hands that are where they should at once."""
        now = 0
        stopped: dict[str, float | None] = {}
        steps = self.run()
        action = next(steps)
        still = {s: (0.0,) * len(self._joints[s]) for s in self.plan.sides}
        while True:
            if isinstance(action, Send):
                now = max(now, action.until_ns)
            elif isinstance(action, StopService):
                stopped = {"exit_s": 0.0, "gone_s": 0.0}
            elif isinstance(action, StartService):
                now += _SERVICE_START_NS
            joined = dict.fromkeys(self.plan.sides, 0.0)
            q = {**still, **self._goal}
            try:
                action = steps.send(Observation(now, q, still, joined, stopped))
            except StopIteration:
                return now / 1e9

    @abstractmethod
    def _provoke(self) -> Steps:
        """Everything between the first motion and the restart."""

    @abstractmethod
    def _home(self, side: Side) -> Pose:
        """Where the hand is brought at first: clear of stops and of the object."""

    @abstractmethod
    def _other_place(self) -> dict[Side, Pose]:
        """A pose worth moving to from here."""

    @abstractmethod
    def _motors(self, side: Side, pose: Pose) -> Motors:
        """The command to hold a pose, as the official client would send it."""

    # -- sending ----------------------------------------------------------------------------

    def _send(self, payloads: Payloads) -> Steps:
        """Send now, wait for the next tick of the client's rate."""
        late = self._obs.now_ns - self._next_ns
        if late > self._period_ns:
            self._next_ns += late
        self._next_ns += self._period_ns
        self._obs = yield Send(payloads, self._next_ns, age_s=self._age_s)

    def _command(self, motors: Mapping[Side, Motors] | None = None) -> Steps:
        """Everybody holds its goal, but for those named."""
        if motors:
            every = {s: motors.get(s) or self._motors(s, q) for s, q in self._goal.items()}
            yield from self._send(self._wire.encode({**every, **motors}))
            return
        if self._held[0] != self._goal:  # they are held for long, and encoded once
            hold = {s: self._motors(s, q) for s, q in self._goal.items()}
            self._held = (dict(self._goal), self._wire.encode(hold))
        yield from self._send(self._held[1])

    def _wait(self, seconds: float) -> Steps:
        """Send nothing."""
        self._next_ns = max(self._next_ns, self._obs.now_ns) + round(seconds * 1e9)
        self._obs = yield Send([], self._next_ns)

    def _elapsed(self, phase: Phase) -> float:
        return (self._obs.now_ns - phase.begin_ns) / 1e9

    def _begin(
        self,
        name: str,
        sides: Sequence[Side],
        *,
        targets: Mapping[Side, Mapping[int, float]] | None = None,
        **params: str,
    ) -> Phase:
        """Begin a phase; ``targets`` are its moving joints."""
        goals = {s: dict(joints) for s, joints in (targets or {}).items()}
        phase = Phase(name, tuple(sides), self._obs.now_ns, targets=goals, params=params)
        self.phases.append(phase)
        return phase

    def _end(self, phase: Phase) -> None:
        phase.end_ns = self._obs.now_ns

    def _hold(self, seconds: float, motors: Mapping[Side, Motors] | None = None) -> Steps:
        begin = self._obs.now_ns
        while self._obs.now_ns - begin < seconds * 1e9:
            yield from self._command(motors)

    def _until_settled(
        self, phase: Phase | None, sides: Sequence[Side], *, least: float, most: float
    ) -> Steps:
        """Hold the goals until the sides have stood near them for a while.

        :param most: seconds; a hand that still comes nearer then is slow, not wrong, and is given
            up to :data:`PATIENCE` more.
        """
        begin = nearer_at = self._obs.now_ns
        best = math.inf
        near_since: int | None = None
        low: dict[Side, Pose] = {}
        high: dict[Side, Pose] = {}
        while True:
            yield from self._command()
            now, q = self._obs.now_ns, self._obs.q
            if not all(s in q and self._near(s, q[s], self._goal[s]) for s in sides):
                near_since = None
            elif near_since is None:
                near_since = now
                low = {s: q[s] for s in sides}
                high = dict(low)
            else:
                low = {s: tuple(map(min, low[s], q[s])) for s in sides}
                high = {s: tuple(map(max, high[s], q[s])) for s in sides}
                if not all(self._near(s, low[s], high[s], 0.5) for s in sides):
                    near_since = None
            settled = near_since is not None and now - near_since >= self._settling * 1e9
            left = sum(self._left(s, q[s]) for s in sides if s in q)
            if left < best - 0.01:
                best, nearer_at = left, now
            elapsed = (now - begin) / 1e9
            comes = now - nearer_at < 0.3e9 and elapsed < most + PATIENCE
            if (settled and elapsed >= least) or (elapsed >= most and not comes):
                break
        if phase is not None:
            self._end(phase)

    _settling = 0.4
    """Seconds that a hand must stand near its goal."""

    def _left(self, side: Side, here: Pose) -> float:
        """How far a hand is from its goal, in parts of its joints' ranges."""
        there, joints = self._goal[side], self._joints[side]
        return sum(abs(a - b) / j.stroke for a, b, j in zip(here, there, joints, strict=True))

    def _near(self, side: Side, a: Pose, b: Pose, part: float = 1.0) -> bool:
        return all(
            abs(x - y) <= part * SETTLED * joint.stroke
            for x, y, joint in zip(a, b, self._joints[side], strict=True)
        )

    def _everyone(
        self,
        name: str,
        poses: Mapping[Side, Pose],
        *,
        least: float = 0.6,
        most: float = 2.5,
        **params: str,
    ) -> Steps:
        """A step of all sides at once, as a phase."""
        self._goal.update(poses)
        targets = {s: dict(enumerate(pose)) for s, pose in poses.items()}
        phase = self._begin(name, self.plan.sides, targets=targets, **params)
        yield from self._until_settled(phase, self.plan.sides, least=least, most=most)

    # -- the same for every hand --------------------------------------------------------------

    def _listen(self) -> Steps:
        self._say("listening: the hand must report its state before anybody commands it")
        phase = self._begin("listen", self.plan.sides)
        while self._elapsed(phase) < 1.2:
            yield from self._wait(0.05)
        self._end(phase)

    def _approach(self) -> Steps:
        """Slowly to the middle: the first motion of an unknown hand."""
        self._say("moving slowly to the middle")
        phase = self._begin("approach", self.plan.sides)
        home = {s: self._home(s) for s in self.plan.sides}
        start = {s: self._obs.q.get(s, home[s]) for s in self.plan.sides}
        reach, seen = 0.0, self._elapsed(phase)
        while True:
            now = self._elapsed(phase)
            # the hand must not be told to leap to where it would be if the kit had not stood still
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

    def _burst(
        self, name: str, bursts: Sequence[Payloads], seconds: float, *, each: float = 0.0
    ) -> Steps:
        """Bad commands, as a phase: in turn, or each for a while."""
        phase = self._begin(name, self.plan.sides)
        count = 0
        while self._elapsed(phase) < seconds:
            at = int(self._elapsed(phase) / each) if each else count
            count += 1
            yield from self._send(bursts[min(at, len(bursts) - 1) if each else at % len(bursts)])
        self._end(phase)

    def _replay(self, session: Session) -> Steps:
        sides = [s for s in self.plan.sides if s in session.sides]
        if not sides:
            return
        dialect = self.plan.dialect
        timeline = session.timeline(sides, dialect)
        newest = {s: session.first(s, dialect) for s in sides}
        self._goal.update({s: tuple(m.q for m in motors) for s, motors in newest.items()})
        reachable = [s for s in sides if self._reachable(s)]
        yield from self._until_settled(None, reachable, least=0.6, most=2.0)
        self._say(f"replaying {session.duration:.0f} s of the recorded session {session.name}")
        phase = self._begin("replay", sides, session=session.name)
        start = self._obs.now_ns
        for i, (at, motors) in enumerate(timeline):
            late = self._obs.now_ns - start - at
            if late > PAUSE * 1e9:  # sent at once, what fell due would be the hand's wild motion
                self._say(f"this program stood still for {late / 1e9:.2f} s; the session is held")
                start += late
            newest.update(motors)
            payloads = self._wire.encode(newest if self._wire.shared else motors)
            later = timeline[i + 1][0] if i + 1 < len(timeline) else at + self._period_ns
            self._obs = yield Send(payloads, start + later)
        self._end(phase)
        self._next_ns = self._obs.now_ns
        self._goal.update({s: tuple(m.q for m in newest[s]) for s in sides})

    def _reachable(self, side: Side) -> bool:
        """Whether nothing stands between a hand and its goal."""
        return True

    def _late_joiner(self) -> Steps:
        self._say("a second listener joins late: it must hear the hand at once")
        phase = self._begin("late-joiner", self.plan.sides)
        yield Join()
        while self._elapsed(phase) < 3.0:
            yield from self._command()
            if self._elapsed(phase) >= 0.3 and set(self.plan.sides) <= set(self._obs.joined):
                break
        phase.observed = {f"first_state_s_{s}": self._obs.joined.get(s) for s in self.plan.sides}
        self._end(phase)
        self._obs = yield Leave()

    def _foreign(self) -> Steps:
        """Somebody sends another type of the family on the command topics, with far targets."""
        self._say("another type on the command topics: it must not reach the hand")
        yield from self._hold(0.2)
        far = self._wire.encode_foreign(
            {s: self._motors(s, pose) for s, pose in self._other_place().items()}
        )
        self._obs = yield Join(Role.STRANGER)
        phase = self._begin("foreign", self.plan.sides)
        yield from self._beside(phase, far, Role.STRANGER, 0.5)
        self._end(phase)
        self._obs = yield Leave(Role.STRANGER)
        yield from self._everyone("recover", self._other_place(), most=1.5, after="foreign")

    def _flood(self) -> Steps:
        """Hundreds of commands at once to another place, the last of them back to this one."""
        self._say(f"{FLOOD} commands at once: only the last one counts")
        yield from self._hold(0.2)
        far = self._wire.encode(
            {s: self._motors(s, pose) for s, pose in self._other_place().items()}
        )
        phase = self._begin("burst", self.plan.sides)
        self._obs = yield Send(far * (FLOOD - 1), 0)
        phase.observed = {"sent_s": self._elapsed(phase)}
        yield from self._hold(0.8)
        self._end(phase)

    def _old_stamps(self) -> Steps:
        self._say("a client whose clock is an hour behind: it must be obeyed")
        self._age_s = 3600.0
        yield from self._everyone("old-stamps", self._other_place(), most=1.5)
        self._age_s = 0.0
        yield from self._everyone("center", {s: self._home(s) for s in self.plan.sides}, most=1.5)

    def _load(self) -> Steps:
        """Many commands, and a reliable subscriber that hardly ever reads."""
        self._say(f"{LOAD_RATE:g} commands a second and a slow reader: state must keep its rate")
        here, there = dict(self._goal), self._other_place()
        count = 40  # points of the way there and back
        parts = [0.3 * (1 - abs(2 * i / count - 1)) for i in range(count + 1)]
        points = [
            self._wire.encode(
                {
                    s: self._motors(
                        s, tuple(a + part * (b - a) for a, b in zip(here[s], there[s], strict=True))
                    )
                    for s in self.plan.sides
                }
            )
            for part in parts
        ]
        self._obs = yield Join(Role.LAGGARD)
        period, self._period_ns = self._period_ns, round(1e9 / LOAD_RATE)
        phase = self._begin("load", self.plan.sides)
        while (at := self._elapsed(phase) / LOAD_SECONDS) < 1.0:
            yield from self._send(points[int(at * count)])
        self._end(phase)
        self._period_ns = period
        self._obs = yield Leave(Role.LAGGARD)

    def _two_writers(self) -> Steps:
        self._say("a second client commands another place, and goes again")
        yield from self._hold(0.2)
        there = self._other_place()
        rival = self._wire.encode({s: self._motors(s, pose) for s, pose in there.items()})
        targets = {s: dict(enumerate(pose)) for s, pose in there.items()}
        self._obs = yield Join(Role.RIVAL)
        phase = self._begin("two-writers", self.plan.sides, targets=targets)
        yield from self._beside(phase, rival, Role.RIVAL, 0.6)
        self._end(phase)
        self._obs = yield Leave(Role.RIVAL)
        yield from self._everyone("recover", dict(self._goal), most=1.5, after="two-writers")

    def _beside(self, phase: Phase, payloads: Payloads, role: Role, seconds: float) -> Steps:
        """Somebody else sends between the client's commands, at the same rate."""
        period = self._period_ns
        self._period_ns = period // 2
        while self._elapsed(phase) < seconds:
            yield from self._command()
            self._next_ns += self._period_ns
            self._obs = yield Send(payloads, self._next_ns, by=role)
        self._period_ns = period

    def _service_restart(self) -> Steps:
        """End the service and start it again, where the kit can."""
        self._say("the service is told to end, and started again")
        phase = self._begin("shutdown", self.plan.sides)
        self._obs = yield StopService()
        if not self._obs.stopped:
            self.phases.remove(phase)
            self._say("it is not the kit's to restart: left out")
            return
        phase.observed = dict(self._obs.stopped)
        self._obs = yield StartService()
        self._end(phase)
        self._next_ns = self._obs.now_ns
        yield from self._everyone(
            "service-restart", {s: self._home(s) for s in self.plan.sides}, most=4.0
        )

    def _silence(self, name: str, seconds: float) -> Steps:
        """No command at all, as a phase."""
        phase = self._begin(name, self.plan.sides)
        while self._elapsed(phase) < seconds:
            yield from self._wait(0.05)
        self._end(phase)


def changed(motors: Motors, joint: int, motor: Motor) -> list[Motor]:
    """The same command with one motor replaced."""
    return [motor if i == joint else m for i, m in enumerate(motors)]
