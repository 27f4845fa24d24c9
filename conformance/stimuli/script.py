"""Scripts for hands and robots on DDS topics: actions, observations, and sending at a steady
rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.phased_script import PhasedScript, play
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.hand import JointSpec, Side, Subject
from dexkit.models import Dialect

__all__ = [
    "NOT_FINITE",
    "Action",
    "Join",
    "Leave",
    "Observation",
    "Part",
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

NOT_FINITE = [
    (field, value)
    for field in ("q", "dq", "tau", "kp", "kd")
    for value in (math.nan, math.inf, -math.inf)
]
"""Each field of a command with each value that is not finite."""
_SERVICE_START_NS = 3_000_000_000
"""About what it takes to start a service: measured on two cores with emulated devices."""
Payloads = list[tuple[str, bytes]]
Pose = tuple[float, ...]
"""q of every joint of a hand, rad."""


class Role(Enum):
    """Other participants on the topics, beside the commanding client."""

    MONITOR = "a second listener"
    LAGGARD = "a reliable listener that reads only twice a second"
    RIVAL = "a second commanding client"
    STRANGER = "a publisher of another type on the command topics"


@dataclass(frozen=True)
class Observation:
    """Observations of the player after an action.

    :param now_ns: the recording's clock.
    :param q: newest pose of each side that has published one; dq likewise.
    :param joined: of a :attr:`Role.MONITOR`, seconds until each side's first state arrived there.
    :param stopped: after :class:`StopService`: ``exit_s``, the seconds until the services had
        ended, and ``gone_s``, until their publishers had vanished from the domain after that;
        None is never. Nothing at all where the kit has not started the services.
    :param machine: ``mode_machine`` of a robot's newest state.
    """

    now_ns: int
    q: Mapping[Subject, Pose] = field(default_factory=dict)
    dq: Mapping[Subject, Pose] = field(default_factory=dict)
    joined: Mapping[Subject, float] = field(default_factory=dict)
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
    """Another participant joins the domain."""

    role: Role = Role.MONITOR


@dataclass(frozen=True)
class Leave:
    """The participant that joined leaves the domain."""

    role: Role = Role.MONITOR


@dataclass(frozen=True)
class Restart:
    """Remove the commanding client, and create a new one."""


@dataclass(frozen=True)
class StopService:
    """Ask the hands' services to end (SIGTERM), if the kit has started them."""


@dataclass(frozen=True)
class StartService:
    """Start the hands' services again."""


Action = Send | Join | Leave | Restart | StopService | StartService
Steps = Generator[Action, Observation, None]
"""Part of a script."""


@dataclass(frozen=True)
class Part:
    """A part of a script: a phase, or some that follow from one another.

    :param phases: their names; it is played in a run that needs any of them, and asks the plan for
        the others. None: in every run.
    :param play: its steps, from wherever the hand is.
    :param back: it leaves the hand elsewhere, and the script moves it back to its first pose.
    :param applies: whether the dialect has what it is about.
    """

    phases: frozenset[str]
    play: Callable[[], Steps]
    back: bool = False
    applies: bool = True

    @classmethod
    def of(
        cls, phases: str, play: Callable[[], Steps], *, back: bool = False, applies: bool = True
    ) -> Part:
        """A part by the names of its phases, with blanks between them."""
        return cls(frozenset(phases.split()), play, back, applies)


S = TypeVar("S", bound=Subject)
S_co = TypeVar("S_co", bound=Subject, covariant=True)


@dataclass(frozen=True)
class Plan(Generic[S_co]):
    """The hands or robot of a run, and its phases.

    :param objects: where a side touches an object: in the dialect's radians for a hand of one
        joint, percent of closing for others.
    :param phases: names of the phases to go through; see
        :func:`dexkit.conformance.stimuli.phases_for`.
    :param rounds: how often a hand goes through those between the first motion and the operator.
    """

    dialect: Dialect
    sides: tuple[S_co, ...]
    objects: Mapping[Subject, float] = field(default_factory=dict)
    session: CommandSession | None = None
    phases: frozenset[str] = frozenset()
    rounds: int = 1


def object_places(dialect: Dialect, percents: Mapping[Side, float]) -> dict[Subject, float]:
    """Percents as the script takes them: of opening in radians, of closing as they are."""
    if not dialect.is_gripper:
        return dict(percents.items())
    return {s: pct / 100 * dialect.q_open for s, pct in percents.items()}


def default_objects(dialect: Dialect, sides: Sequence[Subject]) -> dict[Subject, float]:
    """The default objects of a pair of hands, as the script takes them."""
    percents = under_test(dialect.model).objects
    return object_places(dialect, {s: p for s, p in percents.items() if s in sides})


class Script(PhasedScript[Action, Observation, Phase], Generic[S]):
    """The stimulus for one plan; each model's script has its phases, in its order."""

    motion = "step"
    """The phase in which the hand moves, for requirements that need any motion."""

    def __init__(self, plan: Plan[S], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(Observation(0), report)
        self.plan = plan
        self._joints: dict[S, tuple[JointSpec, ...]] = {}
        self._goal: dict[S, Pose] = {}
        self._age_s = 0.0
        self._period_ns = 0

    def length(self) -> float:
        """Seconds that :meth:`run` takes with hands that reach their goals at once."""
        now = 0
        stopped: dict[str, float | None] = {}
        still: dict[Subject, Pose] = {s: (0.0,) * len(self._joints[s]) for s in self.plan.sides}
        joined: dict[Subject, float] = dict.fromkeys(self.plan.sides, 0.0)

        def carry_out(action: Action) -> Observation:
            nonlocal now, stopped
            if isinstance(action, Send):
                now = max(now, action.until_ns)
            elif isinstance(action, StopService):
                stopped = {"exit_s": 0.0, "gone_s": 0.0}
            elif isinstance(action, StartService):
                now += _SERVICE_START_NS
            return Observation(now, still | dict(self._goal.items()), still, joined, stopped)

        play(self, carry_out, lambda: False)
        return now / 1e9

    def _schedule(self, parts: Sequence[Part]) -> Steps:
        """Those of the parts that the run needs, in turn."""
        for part in parts:
            wanted = not part.phases or part.phases & self.plan.phases
            if part.applies and wanted:
                yield from part.play()
                if part.back:
                    yield from self._back()

    def _back(self) -> Steps:
        """Back to the first pose."""
        yield from ()

    def _send(self, payloads: Payloads) -> Steps:
        """Send now, wait for the next tick of the client's rate."""
        late = self._obs.now_ns - self._next_ns
        if late > self._period_ns:
            self._next_ns += late
        self._next_ns += self._period_ns
        yield from self._do(Send(payloads, self._next_ns, age_s=self._age_s))

    def _wait(self, seconds: float) -> Steps:
        """Send nothing."""
        self._next_ns = max(self._next_ns, self._obs.now_ns) + round(seconds * 1e9)
        yield from self._do(Send([], self._next_ns))

    def _begin(
        self,
        name: str,
        sides: Sequence[S],
        *,
        targets: Mapping[S, Mapping[int, float]] | None = None,
        **params: str,
    ) -> Phase:
        """Begin a phase; ``targets`` are its moving joints."""
        goals: dict[Subject, dict[int, float]] = {
            s: dict(joints) for s, joints in (targets or {}).items()
        }
        begin_ns = self._obs.now_ns
        return self._mark(Phase(name, tuple(sides), begin_ns, targets=goals, params=params))

    def _listen(self) -> Steps:
        self._report("listening: the state must flow before the first command")
        phase = self._begin("listen", self.plan.sides)
        yield from self._through(phase, 1.2, lambda: self._wait(0.05))
