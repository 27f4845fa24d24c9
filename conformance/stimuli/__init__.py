"""What the kit does to a hand, sans-IO: a script that says what to send when.

:class:`Script` is a generator. It yields an :class:`Action`, its runner carries it out, and
sends back an :class:`Observation`. The live runner does so on DDS, the virtual one with a hand
in memory on a virtual clock; the script cannot tell them apart. What was done when is noted in
:attr:`Script.phases` and travels with the recording.

Order of the phases: what may disturb a hand comes after what needs it undisturbed.

============== =====================================================================================
listen         no commands; state must flow
approach       slowly to mid stroke
step           large steps of one side, the others hold
nan, out-of-   bad commands, each followed by ``recover``, a good step
range, empty
limp           zero gains, with a q far towards closed
replay         a recorded session, as recorded
late-joiner    a new subscriber appears
squeeze        close on the object, if there is one, by xr_teleoperate's lead
drive          velocity command (dq, kd) without position gain, so that the hand moves when ...
silence        ... the commands stop for two command time-outs
resume         a step after the silence
restart        the client goes away, another comes, and makes a step
============== =====================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from dexkit.conformance.phases import Phase
from dexkit.conformance.requirements import Requirement, catalogue
from dexkit.conformance.stimuli.session import Session
from dexkit.conformance.wire import Motor, Wire
from dexkit.hand import Side
from dexkit.models import DEX1_1, Dialect

__all__ = [
    "Action",
    "Join",
    "Leave",
    "Observation",
    "Plan",
    "Restart",
    "Script",
    "Send",
    "Session",
    "phases_for",
]

PERIOD_NS = round(1e9 / DEX1_1.command_rate)
LEAD = 0.18 / 5.4  # of the stroke: how far xr_teleoperate commands ahead (facts/unitree-dex B.3)
_SETTLED = 0.02  # of the stroke
_BAD = {
    "nan": "broken commands (NaN and infinity): nothing may move",
    "out-of-range": "commands far out of range: no harm may be done",
    "empty": "empty commands: nothing may move",
}
_Payloads = list[tuple[str, bytes]]


@dataclass(frozen=True)
class Observation:
    """What a runner tells the script.

    :param now_ns: the recording's clock.
    :param q: newest position of each side that has published one; dq likewise.
    :param joined: after :class:`Join`, seconds until each side's first state arrived there.
    """

    now_ns: int
    q: Mapping[Side, float] = field(default_factory=dict)
    dq: Mapping[Side, float] = field(default_factory=dict)
    joined: Mapping[Side, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Send:
    """Publish these (topic, payload), then wait until a time."""

    payloads: _Payloads
    until_ns: int


@dataclass(frozen=True)
class Join:
    """Create a second participant with a reader on every state topic."""


@dataclass(frozen=True)
class Leave:
    """Remove it."""


@dataclass(frozen=True)
class Restart:
    """Remove the commanding client, and create a new one."""


Action = Send | Join | Leave | Restart
Steps = Generator[Action, Observation, None]


@dataclass(frozen=True)
class Plan:
    """What to do to whom.

    :param objects: where a side touches an object, in the dialect's radians.
    :param phases: names of the phases to go through; see :func:`phases_for`.
    """

    dialect: Dialect
    sides: tuple[Side, ...]
    objects: Mapping[Side, float] = field(default_factory=dict)
    session: Session | None = None
    phases: frozenset[str] = frozenset()


def phases_for(requirements: Iterable[Requirement]) -> frozenset[str]:
    """The phases that ``requirements`` and what they depend on need."""
    by_id = {r.id: r for r in catalogue()}
    todo = list(requirements)
    names: set[str] = set()
    seen: set[str] = set()
    while todo:
        requirement = todo.pop()
        if requirement.id in seen:
            continue
        seen.add(requirement.id)
        todo += [by_id[before] for before in requirement.after]
        if requirement.phase:
            names.add(requirement.phase)
        if requirement.id.startswith("DEX1-TRACK"):
            names.add("replay")
        if requirement.needs == "motion":
            names.add("step")
    return frozenset(names)


class Script:
    """The stimulus for one plan."""

    def __init__(self, plan: Plan, say: Callable[[str], None] = lambda text: None) -> None:
        self.plan = plan
        self.phases: list[Phase] = []
        self._say = say
        self._wire = Wire(plan.dialect)
        self._stroke = plan.dialect.q_open
        self._goal: dict[Side, float] = {}
        self._next_ns = 0
        self._obs = Observation(0)
        # seed 000: in unitree_hg the gains, dq and tau of a command are not used
        self._gains_used = plan.dialect.name != "unitree_hg"

    def run(self) -> Steps:
        """The whole script."""
        self._obs = yield Send([], 0)
        self._next_ns = self._obs.now_ns
        yield from self._listen()
        yield from self._approach()
        if not self._obs.q:
            self._say("no state on any topic: nothing more can be asked of this hand")
            return
        sides = self.plan.sides
        if "step" in self.plan.phases:
            for side in sides:
                yield from self._steps(side)
        for name in ("nan", "out-of-range", "empty"):
            if name in self.plan.phases:
                yield from self._bad(name)
        if "limp" in self.plan.phases and self._gains_used:
            yield from self._limp()
        if "replay" in self.plan.phases and self.plan.session is not None:
            yield from self._replay(self.plan.session)
        if "late-joiner" in self.plan.phases:
            yield from self._late_joiner()
        if self.plan.phases & {"squeeze", "silence", "resume"}:
            yield from self._squeeze_and_silence()
        if "restart" in self.plan.phases:
            self._say("the commanding program is restarted: the new one must be obeyed")
            yield Restart()
            yield from self._everyone("restart", self._other_place())
        yield from self._hold(0.2)

    # -- places -----------------------------------------------------------------------------

    def _low(self, side: Side) -> float:
        """Nearly closed, clear of the object."""
        touch = self.plan.objects.get(side)
        return 0.1 * self._stroke if touch is None else touch + 0.1 * self._stroke

    def _middle(self, side: Side) -> float:
        return max(0.5 * self._stroke, self._low(side) + 0.02 * self._stroke)

    def _high(self) -> float:
        return 0.9 * self._stroke

    def _other_place(self) -> dict[Side, float]:
        """A place worth moving to: the middle or above it, whichever is farther from here."""
        places: dict[Side, float] = {}
        for side in self.plan.sides:
            here = self._obs.q.get(side, 0.0)
            above, middle = 0.7 * self._stroke, self._middle(side)
            places[side] = above if abs(above - here) > abs(middle - here) else middle
        return places

    # -- sending ----------------------------------------------------------------------------

    def _send(self, payloads: _Payloads) -> Generator[Action, Observation, None]:
        """Send now, wait for the next tick of 200 Hz."""
        late = self._obs.now_ns - self._next_ns
        if late > PERIOD_NS:
            self._next_ns += late
        self._next_ns += PERIOD_NS
        self._obs = yield Send(payloads, self._next_ns)

    def _command(self, motors: Mapping[Side, Motor] | None = None) -> Steps:
        """Everybody holds its goal, but for those named."""
        every = {s: Motor(q=q) for s, q in self._goal.items()}
        yield from self._send(self._wire.encode({**every, **(motors or {})}))

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
        targets: Mapping[Side, float] | None = None,
        **params: str,
    ) -> Phase:
        phase = Phase(
            name, tuple(sides), self._obs.now_ns, targets=dict(targets or {}), params=params
        )
        self.phases.append(phase)
        return phase

    def _end(self, phase: Phase) -> None:
        phase.end_ns = self._obs.now_ns

    def _hold(self, seconds: float) -> Steps:
        begin = self._obs.now_ns
        while self._obs.now_ns - begin < seconds * 1e9:
            yield from self._command()

    def _until_settled(
        self, phase: Phase | None, sides: Sequence[Side], *, least: float, most: float
    ) -> Steps:
        """Hold the goals until the sides have stood near them for a while."""
        begin = self._obs.now_ns
        near_since: int | None = None
        low: dict[Side, float] = {}
        high: dict[Side, float] = {}
        while True:
            yield from self._command()
            now = self._obs.now_ns
            q = self._obs.q
            near = all(
                s in q and abs(q[s] - self._goal[s]) <= _SETTLED * self._stroke for s in sides
            )
            if near and near_since is not None:
                low = {s: min(low[s], q[s]) for s in sides}
                high = {s: max(high[s], q[s]) for s in sides}
                if any(high[s] - low[s] > _SETTLED * self._stroke / 2 for s in sides):
                    near_since = None
            elif near:
                near_since = now
                low = {s: q[s] for s in sides}
                high = dict(low)
            else:
                near_since = None
            settled = near_since is not None and now - near_since >= 0.4e9
            elapsed = (now - begin) / 1e9
            if elapsed >= most or (settled and elapsed >= least):
                break
        if phase is not None:
            self._end(phase)

    def _everyone(self, name: str, targets: Mapping[Side, float], **params: str) -> Steps:
        """A step of all sides at once, as a phase."""
        self._goal.update(targets)
        phase = self._begin(name, self.plan.sides, targets=targets, **params)
        yield from self._until_settled(phase, self.plan.sides, least=0.6, most=2.5)

    # -- phases -----------------------------------------------------------------------------

    def _listen(self) -> Steps:
        self._say("listening: the hand must report its state before anybody commands it")
        phase = self._begin("listen", self.plan.sides)
        while self._elapsed(phase) < 1.2:
            yield from self._wait(0.05)
        self._end(phase)

    def _approach(self) -> Steps:
        """Slowly to mid stroke: the first motion of an unknown hand."""
        self._say("moving slowly to mid stroke")
        phase = self._begin("approach", self.plan.sides)
        start = {s: self._obs.q.get(s, self._middle(s)) for s in self.plan.sides}
        speed = 0.6 * self._stroke
        while True:
            reach = speed * self._elapsed(phase)
            self._goal = {
                s: q + max(-reach, min(reach, self._middle(s) - q)) for s, q in start.items()
            }
            if all(abs(self._goal[s] - self._middle(s)) < 1e-6 for s in start):
                break
            yield from self._command()
        yield from self._until_settled(phase, self.plan.sides, least=0.3, most=2.0)

    def _steps(self, side: Side) -> Steps:
        self._say(f"large steps of the {side} hand; the other one must not move")
        for target in (self._high(), self._low(side), self._middle(side)):
            self._goal[side] = target
            phase = self._begin("step", (side,), targets={side: target})
            yield from self._until_settled(phase, (side,), least=0.6, most=2.5)

    def _bad(self, name: str) -> Steps:
        self._say(_BAD[name])
        sides = self.plan.sides
        yield from self._hold(0.2)
        bursts: list[_Payloads] = []
        if name == "nan":
            bursts = [self._wire.encode(dict.fromkeys(sides, m)) for m in self._not_finite()]
        elif name == "out-of-range":
            far = (Motor(q=1000.0), Motor(q=-1000.0))
            bursts = [self._wire.encode(dict.fromkeys(sides, m)) for m in far]
        else:
            bursts = [self._wire.encode_empty(sides)]
        phase = self._begin(name, sides)
        seconds = 0.5 * len(bursts) if name == "out-of-range" else 0.5
        count = 0
        while self._elapsed(phase) < seconds:
            if name == "out-of-range":  # each for half a second
                burst = bursts[min(int(self._elapsed(phase) / 0.5), len(bursts) - 1)]
            else:  # in turn
                burst = bursts[count % len(bursts)]
            count += 1
            yield from self._send(burst)
        self._end(phase)
        yield from self._everyone("recover", self._other_place(), after=name)
        yield from self._everyone("center", {s: self._middle(s) for s in sides})

    def _not_finite(self) -> list[Motor]:
        """One bad field each; where it is not q, q is far away, to show whether it was taken."""
        far = self._high()
        bad = [Motor(q=math.nan), Motor(q=math.inf), Motor(q=-math.inf)]
        if self._gains_used:
            bad += [
                Motor(q=far, kp=math.nan),
                Motor(q=far, kd=math.inf),
                Motor(q=far, tau=math.nan),
                Motor(q=far, dq=-math.inf),
            ]
        return bad

    def _limp(self) -> Steps:
        self._say("commands without force (zero gains): the hand must not be pulled")
        sides = self.plan.sides
        yield from self._everyone("center", dict.fromkeys(sides, 0.8 * self._stroke))
        targets = {s: self._low(s) for s in sides}
        phase = self._begin("limp", sides, targets=targets)
        while self._elapsed(phase) < 0.5:
            yield from self._command({s: Motor(q=targets[s], kp=0.0, kd=0.0) for s in sides})
        self._end(phase)
        yield from self._everyone("center", {s: self._middle(s) for s in sides})

    def _replay(self, session: Session) -> Steps:
        sides = [s for s in self.plan.sides if s in session.sides]
        if not sides:
            return
        timeline = session.timeline(sides, self._stroke)
        self._goal.update({s: session.first(s, self._stroke).q for s in sides})
        reachable = [s for s in sides if self._goal[s] > self.plan.objects.get(s, -math.inf)]
        yield from self._until_settled(None, reachable, least=0.6, most=2.0)
        self._say(f"replaying {session.duration:.0f} s of the recorded session {session.name}")
        phase = self._begin("replay", sides, session=session.name)
        newest = {s: Motor(q=q) for s, q in self._goal.items()}
        start = self._obs.now_ns
        for i, (at, motors) in enumerate(timeline):
            newest.update(motors)
            payloads = self._wire.encode(newest if self._wire.shared else motors)
            later = timeline[i + 1][0] if i + 1 < len(timeline) else at + PERIOD_NS
            self._obs = yield Send(payloads, start + later)
        self._end(phase)
        self._next_ns = self._obs.now_ns
        self._goal.update({s: newest[s].q for s in sides})
        yield from self._everyone("center", {s: self._middle(s) for s in self.plan.sides})

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

    def _squeeze_and_silence(self) -> Steps:
        sides = self.plan.sides
        pressing = [s for s in sides if s in self.plan.objects]
        free = [s for s in sides if s not in pressing]
        if free:
            targets = dict.fromkeys(free, 0.15 * self._stroke)
            yield from self._everyone("center", {**self._goal, **targets})
        squeeze = {s: Motor(q=self.plan.objects[s] - 1.5 * LEAD * self._stroke) for s in pressing}
        if pressing:
            self._say("squeezing the object")
            phase = self._begin("squeeze", pressing, targets={s: m.q for s, m in squeeze.items()})
            while self._elapsed(phase) < 1.5:
                yield from self._command(squeeze)
            self._end(phase)
        if not self.plan.phases & {"silence", "resume"}:
            return
        if free and self._gains_used:
            yield from self._drive(free, squeeze)
        self._say("... silence: after a second the hand must brake")
        phase = self._begin("silence", sides)
        while self._elapsed(phase) < 2 * DEX1_1.command_timeout + 0.1:
            yield from self._wait(0.05)
        self._end(phase)
        yield from self._everyone("resume", self._other_place())

    def _drive(self, sides: Sequence[Side], others: Mapping[Side, Motor]) -> Steps:
        """Open at a steady low speed by velocity feedback alone, whatever the friction."""
        self._say("slow motion, and then ...")
        phase = self._begin("drive", sides)
        slow = 0.16 * self._stroke  # rad/s: far from the stop even after a whole time-out
        wanted = dict.fromkeys(sides, slow)
        while self._elapsed(phase) < 0.8:
            for s in sides:
                if self._obs.dq.get(s, 0.0) < slow:
                    wanted[s] = min(wanted[s] * 1.02, 10 * slow)
            yield from self._command(
                {
                    **others,
                    **{s: Motor(q=self._goal[s], dq=wanted[s], kp=0.0, kd=0.5) for s in sides},
                }
            )
        self._end(phase)
