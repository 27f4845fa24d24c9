"""Scripts for hands and robots on DDS topics: actions, observations, and sending at a steady
rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, TypeVar

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.phased_script import PhasedScript, play
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.phases import Moment, Place, parts_of
from dexkit.conformance.stimuli.recorded_session import CommandSession
from dexkit.hand import JointSpec, Side, Subject
from dexkit.models import Dialect

__all__ = [
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
    "of_position_servos",
    "with_gains",
    "without_gains",
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

    @property
    def pressing(self) -> tuple[S_co, ...]:
        """The sides with an object."""
        return tuple(s for s in self.sides if s in self.objects)

    @property
    def free(self) -> tuple[S_co, ...]:
        """The sides without one."""
        return tuple(s for s in self.sides if s not in self.objects)


def with_gains(plan: Plan[Any]) -> bool:
    """Whether the hands go by the gains of commands."""
    return plan.dialect.gains_are_used


def without_gains(plan: Plan[Any]) -> bool:
    """Whether they do not."""
    return not plan.dialect.gains_are_used


def of_position_servos(plan: Plan[Any]) -> bool:
    """Whether the hands are position servos."""
    return plan.dialect.position_servo


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
    """The stimulus for one plan: the phases of its kind of hand that the plan needs, in turn."""

    motion = "step"
    """The phase in which the hand moves, for requirements that need any motion."""

    def __init__(self, plan: Plan[S], report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(Observation(0), report)
        self.plan = plan
        self.joints: dict[S, tuple[JointSpec, ...]] = {}
        self.goal: dict[S, Pose] = {}
        self.age_s = 0.0
        self.period_ns = 0

    def length(self) -> float:
        """Seconds that :meth:`run` takes with hands that reach their goals at once."""
        now = 0
        stopped: dict[str, float | None] = {}
        still: dict[Subject, Pose] = {s: (0.0,) * len(self.joints[s]) for s in self.plan.sides}
        joined: dict[Subject, float] = dict.fromkeys(self.plan.sides, 0.0)

        def carry_out(action: Action) -> Observation:
            nonlocal now, stopped
            if isinstance(action, Send):
                now = max(now, action.until_ns)
            elif isinstance(action, StopService):
                stopped = {"exit_s": 0.0, "gone_s": 0.0}
            elif isinstance(action, StartService):
                now += _SERVICE_START_NS
            return Observation(now, still | dict(self.goal.items()), still, joined, stopped)

        play(self, carry_out, lambda: False)
        return now / 1e9

    def schedule(self, moment: Moment) -> Steps:
        """The parts that the run needs at a moment, and the moves between them."""
        place = Place.HOME
        for part in parts_of(type(self)):
            if part.moment is moment and part.wanted(self.plan):
                if place is Place.AWAY and part.needs is Place.HOME:
                    yield from self.back()
                    place = Place.HOME
                yield from part.play(self)
                if part.leaves is not Place.ANY:
                    place = part.leaves
        if place is Place.AWAY:
            yield from self.back()

    def back(self) -> Steps:
        """Back to the first pose."""
        yield from ()

    def send(self, payloads: Payloads) -> Steps:
        """Send now, wait for the next tick of the client's rate."""
        late = self.obs.now_ns - self.next_ns
        if late > self.period_ns:
            self.next_ns += late
        self.next_ns += self.period_ns
        yield from self.do(Send(payloads, self.next_ns, age_s=self.age_s))

    def wait(self, seconds: float) -> Steps:
        """Send nothing."""
        self.next_ns = max(self.next_ns, self.obs.now_ns) + round(seconds * 1e9)
        yield from self.do(Send([], self.next_ns))

    def begin(
        self,
        name: str,
        sides: Sequence[S],
        *,
        targets: Mapping[S, Mapping[int, float] | Pose] | None = None,
        **params: str,
    ) -> Phase:
        """Begin a phase.

        :param targets: q of the joints that move, by their index, or of all joints.
        """
        goals: dict[Subject, dict[int, float]] = {
            s: dict(q if isinstance(q, Mapping) else enumerate(q))
            for s, q in (targets or {}).items()
        }
        begin_ns = self.obs.now_ns
        return self.mark(Phase(name, tuple(sides), begin_ns, targets=goals, params=params))

    def listen(self) -> Steps:
        """No commands: the state must flow."""
        self.report("listening: the state must flow before the first command")
        phase = self.begin("listen", self.plan.sides)
        yield from self.through(phase, 1.0, lambda: self.wait(0.05))
