"""What a check is, and what the checks of several behaviours measure with.

A check is a function of a :class:`Context` that judges a recording for one requirement and one side
and returns an :class:`Outcome`. It never passes without evidence, and takes every limit from its
requirement's tolerances, so that hand models can share it. It is beside its requirement, in
:mod:`dexkit.conformance.behaviours`. Most checks yield figures: :mod:`~.figures`.

Here are steps of joints (:mod:`~.steps`), and whether a hand obeys (:mod:`~.obedience`); gaps and
rates (:mod:`~.timing`), goals (:mod:`~.goals`), silences (:mod:`~.silences`); members of a state
(:mod:`~.members`), and its velocities (:mod:`~.speeds`); contacts of grippers (:mod:`~.contacts`),
soft grips (:mod:`~.soft_grips`), torque pulses (:mod:`~.nudges`), the law of torque
(:mod:`~.torque_law`), and stands of position servos (:mod:`~.stands`); robots (:mod:`~.robot`);
parts of a requirement put together (:mod:`~.combined`).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.kit.measurement_error import Measure, Quantity
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.kit.recording import Commands, Recording, SideView, States
from dexkit.conformance.kit.requirements import Requirement
from dexkit.conformance.kit.results import Evidence
from dexkit.conformance.kit.row_selection import Selected, finite_rows
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.layers import layer
from dexkit.hand import Floats, JointSpec, Side, Subject
from dexkit.unseen import UNSEEN_S

__all__ = [
    "KEPT_ROWS",
    "REGISTRY",
    "ROUNDING",
    "BaseContext",
    "Check",
    "Context",
    "Late",
    "Outcome",
    "check",
    "check_of",
    "rate_measure",
]

ROUNDING = 1e-3
"""Relative excess over a limit that is allowed for a saturated value: a drive clamped at the limit
reports it as float32 and in its own counts, which round (docs/sources/unitree-dex.md#g: 15 N m are
1536 counts of 0.0098 N m, and come back as 15.000001). Used for limits at which the hand itself
clamps; other limits have their own tolerance."""
KEPT_ROWS = 2**21
"""Rows of a result with one for each state that are kept for all joints together: some 100 MB. A
recording of five minutes of a hand of seven joints has as many."""
STROKE_S = 1.0
"""Seconds for a full stroke under Unitree's client."""


Span = tuple[float, float]
"""Begin and end, seconds of the recording."""


def rate_measure(
    hertz: float,
    limit: float,
    seconds: float,
    *,
    at_most: bool = False,
    span: Span | None = None,
) -> Measure:
    """A measured rate, Hz, over a time of observation, seconds.

    Each end of that time has the kit's timing error, which changes the rate in proportion.
    """
    per_second = 2 * hertz / seconds if seconds > 0 else 0.0
    return Measure(
        float(hertz), float(limit), "Hz", Quantity.TIME, at_most, per_second=per_second, span=span
    )


@dataclass(frozen=True)
class Late:
    """Size of a failure: the delay of a conforming hand that would cause the same failure.

    :param seconds: at each of the failure's places, or one for all of them; infinite where no delay
        causes such a failure. For a missing motion, the seconds that a conforming hand takes for
        it: :data:`STROKE_S` for a stroke.
    :param how: ``total``: all delays at that place together; ``mean``: a repeated delay, as it
        lowers a rate; ``p99``: in one of a hundred.
    """

    seconds: tuple[float, ...]
    how: str = "total"


@dataclass(frozen=True)
class Outcome:
    """Result of a check.

    :param met: whether the requirement is met; None when it could not be judged.
    :param cause: the cause, where the check can determine it.
    :param late: the delay of a conforming hand that would cause this failure, where the check can
        determine it; else the duration of the failure.
    :param absent: nothing in the recording fills this unit: a failure if the vendor claims the
        unit, whatever ``met`` is otherwise. What merely cannot be judged of a hand is not absent.
    :param tolerable: not met, but no more than a warning, whatever the level, which spoils nothing
        else: real hands do it, what depends on it works all the same, or the part that is not met
        rests on less than the rest of the requirement.
    :param unless_claimed: tolerable only where the vendor does not claim the requirement's unit.
    :param joints: indices of the joints concerned, the most important first; empty if none in
        particular.
    :param plots: the plots that show it, if they differ from the requirement's.
    :param retry: another run may give another outcome.
    :param measures: the measured values with limits behind it, one for each place; may be empty.
    """

    met: bool | None
    figure: str = ""
    observed: str = ""
    reason: str = ""
    evidence: tuple[Evidence, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    cause: str = ""
    late: Late | None = None
    absent: bool = False
    tolerable: bool = False
    unless_claimed: bool = False
    joints: tuple[int, ...] = ()
    plots: tuple[Plot, ...] = ()
    retry: bool = False
    measures: tuple[Measure, ...] = ()

    def about(self, *joints: int) -> Outcome:
        """Return a copy with the joints concerned (indices)."""
        return replace(self, joints=tuple(int(joint) for joint in joints))

    def shown_by(self, *plots: PlotKind | Plot) -> Outcome:
        """Return a copy with these plots instead of the requirement's."""
        chosen = tuple(Plot(p) if isinstance(p, PlotKind) else p for p in plots)
        return replace(self, plots=chosen)

    def tolerated(self) -> Outcome:
        """Return a copy that is at most a warning."""
        return replace(self, tolerable=True)

    def because(self, cause: str) -> Outcome:
        """Return a copy with a cause determined by the check."""
        return replace(self, cause=cause)

    def resting_on(self, *measures: Measure) -> Outcome:
        """Return a copy with the measures behind it."""
        return replace(self, measures=measures)

    def timed(
        self, seconds: float, limit: float, *, at_least: bool = False, span: Span | None = None
    ) -> Outcome:
        """Return a copy with a measured time, seconds.

        :param at_least: the limit is a minimum.
        :param span: begin and end of its place; None for the outcome's first one.
        """
        measure = Measure(float(seconds), float(limit), larger_is_worse=not at_least, span=span)
        return self.resting_on(measure)

    def rated(
        self, hertz: float, limit: float, seconds: float, *, at_most: bool = False
    ) -> Outcome:
        """Return a copy with a measured rate, Hz.

        :param seconds: time of observation.
        :param at_most: the limit is a maximum.
        """
        return self.resting_on(rate_measure(hertz, limit, seconds, at_most=at_most))

    def placed(self, rad: float, limit: float, *, at_least: bool = False) -> Outcome:
        """Return a copy with a measured distance, rad."""
        measure = Measure(float(rad), float(limit), "rad", Quantity.POSITION, not at_least)
        return self.resting_on(measure)

    def pressed(self, torque: float, limit: float, *, at_least: bool = False) -> Outcome:
        """Return a copy with a measured torque, N m."""
        measure = Measure(float(torque), float(limit), "N m", Quantity.TORQUE, not at_least)
        return self.resting_on(measure)

    def if_late(self, *seconds: float, how: str = "total") -> Outcome:
        """Return a copy with the size of the failure; see :class:`Late`."""
        sizes = tuple(max(0.0, float(s)) for s in seconds)
        return replace(self, late=Late(sizes, how))


class Located(Protocol):
    """A recording whose seconds can be turned into log times."""

    def log_time(self, seconds: float) -> int:
        """The log time, nanoseconds, of a second of the recording."""
        ...


RecordingT = TypeVar("RecordingT", bound=Located, covariant=True)
ViewT = TypeVar("ViewT", covariant=True)
T = TypeVar("T")


@dataclass(frozen=True)
class BaseContext(Generic[RecordingT, ViewT]):
    """One requirement to be judged for one subject; each layer adds access to its data.

    :param recording: the layer's recording, decoded.
    :param hand: the data of the subject in it.
    """

    recording: RecordingT
    hand: ViewT
    requirement: Requirement

    def place(self, topic: str, seconds: float, end: float | None = None) -> Evidence:
        """A point in time, or an interval, on a topic of the recording (seconds)."""
        return Evidence(
            topic=topic,
            time_s=round(seconds, 4),
            log_time_ns=self.recording.log_time(seconds),
            end_s=None if end is None else round(end, 4),
        )

    def passed(self, figure: str, observed: str = "", **values: float) -> Outcome:
        """Return the outcome "met"."""
        return Outcome(True, figure, observed, values=_plain(values))

    def failed(self, figure: str, observed: str, *places: Evidence, **values: float) -> Outcome:
        """Return the outcome "not met"."""
        return Outcome(False, figure, observed, evidence=places, values=_plain(values))

    def skipped(self, reason: str) -> Outcome:
        """Return an outcome that cannot be judged with this recording."""
        return Outcome(None, reason=reason)

    def in_unit(self, outcome: Outcome) -> Outcome:
        """Replace "rad" in an outcome by the subject's unit of q."""
        return outcome

    def absent(self, reason: str) -> Outcome:
        """Return the outcome of a hand of which nothing fills this unit: not judged, or failed if
        the vendor claims the unit.
        """
        return Outcome(None, reason=reason, absent=True)


def _plain(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


@dataclass(frozen=True)
class Context(BaseContext[Recording, SideView]):
    """One requirement to be judged for one side of a recording of DDS topics."""

    @property
    def side(self) -> Subject:
        """The side to be judged."""
        return self.hand.side

    @property
    def other(self) -> Side:
        """The other side."""
        return Side.RIGHT if self.side is Side.LEFT else Side.LEFT

    @property
    def states(self) -> States:
        """The states of this side."""
        return self.hand.states

    @property
    def commands(self) -> Commands:
        """The commands to this side."""
        return self.hand.commands

    @property
    def joints(self) -> tuple[JointSpec, ...]:
        """The hand's joints, in the dialect's radians."""
        return self.hand.joints

    @property
    def unit(self) -> str:
        """The unit of q, and of what is derived from it."""
        return self.recording.unit

    def in_unit(self, outcome: Outcome) -> Outcome:
        """Replace "rad" in an outcome by the subject's unit of q."""
        if self.unit == "rad":
            return outcome
        short = self.unit.rpartition(" ")[2]
        return replace(
            outcome,
            measures=tuple(
                replace(m, unit=self.unit) if m.unit == "rad" else m for m in outcome.measures
            ),
            values={name.replace("rad", short): v for name, v in outcome.values.items()},
        )

    def once(self, name: object, work_out: Callable[[], T]) -> T:
        """Return a result cached under a name for this hand, computing it at first use.

        :param name: must include everything that the result depends on, except for the recording.
        """
        known = self.hand.known
        if name not in known:
            known[name] = work_out()
        found: T = known[name]
        return found

    def once_of_joint(self, name: str, joint: int, work_out: Callable[[], T]) -> T:
        """As :meth:`once`, for what has a row for each state: of a long recording only the first
        joints' is kept, and the newest.
        """
        key = (name, joint)
        kept = self.once((name, "kept"), list[tuple[str, int]])
        if key not in self.hand.known:
            if kept and (len(kept) + 1) * len(self.states) > KEPT_ROWS:
                # joints are gone through in order: an older one is asked for again sooner
                del self.hand.known[kept.pop()]
            kept.append(key)
        return self.once(key, work_out)

    def known_states(self, joint: int, *members: str) -> Selected:
        """The states in which these members (``q``, ``dq``) of a joint are numbers."""
        states = self.states
        return self.once(
            ("known states", joint, members),
            lambda: finite_rows(*(getattr(states, m)[:, joint] for m in members)),
        )

    def tolerance(self, name: str, joint: int = 0) -> float:
        """A tolerance of the requirement; ``NAME_stroke`` in radians of that joint."""
        value = self.requirement.tolerance(name)
        return value * self.joints[joint].stroke if name.endswith("_stroke") else value

    def named(self, text: str, joint: int) -> str:
        """Prefix ``text`` with the joint's name, if the hand has several joints."""
        return text if len(self.joints) == 1 else f"{self.joints[joint].name}: {text}"

    def phases(self, name: str | None = None) -> list[Phase]:
        """The phases of this side, by default those that the requirement needs."""
        names = (name,) if name else self.requirement.phases
        return [p for each in names for p in self.recording.phases(each, self.side)]

    def only(self, phase: str) -> Context:
        """For the part of a requirement that is judged in this one of its phases."""
        return replace(self, requirement=replace(self.requirement, needs=f"phase:{phase}"))

    def span(self, phase: Phase) -> tuple[float, float]:
        """Begin and end of a phase, seconds."""
        return self.recording.seconds(phase.begin_ns), self.recording.seconds(phase.end_ns)

    def seen(self, begin: float, end: float, longest: float = UNSEEN_S) -> bool:
        """Whether states show what the hand did in [begin, end], without a gap in them.

        :param longest: seconds that may be without a state, also at the ends.
        """
        inside = self.states.t[self.states.between(begin, end)]
        return float(np.diff(inside, prepend=begin, append=end).max()) <= longest

    def q(self, begin: float, end: float) -> Floats:
        """The positions in [begin, end], shape (n, n_joints)."""
        return self.states.q[self.states.between(begin, end)]

    def tau(self, begin: float, end: float) -> Floats:
        """The torques in [begin, end], shape (n, n_joints)."""
        return self.states.tau[self.states.between(begin, end)]

    def given(self, begin: float, end: float) -> NDArray[np.bool_]:
        """Which commands were given in [begin, end]."""
        return np.asarray((self.commands.t >= begin) & (self.commands.t <= end))

    @property
    def object_at(self) -> float | None:
        """The q at which this side touches its object, or None if unknown."""
        return self.recording.stimulus.objects.get(self.side) if self.recording.stimulus else None

    @property
    def touch(self) -> float:
        """The same, of a side that has an object."""
        assert self.object_at is not None, "only hands with an object are judged"
        return self.object_at

    @property
    def contact_unknown(self) -> Outcome | None:
        """Why a judgement that needs to know what the hand touches cannot be made: only a run of
        the kit says that. None if it can be made.
        """
        if self.recording.stimulus is not None:
            return None
        return self.skipped("the recording does not say what the hand touched")

    def at(self, topic: str, seconds: float, end: float | None = None) -> Evidence:
        """A place in the recording."""
        return self.place(topic, seconds, end)


Check = Callable[[Any], Outcome]
"""A function of the context of its layer; see :mod:`dexkit.conformance.layers`."""
CheckT = TypeVar("CheckT", bound=Check)
REGISTRY: dict[str, Check] = {}
"""Checks by requirement id, of those modules that have been imported."""


_RESTS_ON: dict[Check, tuple[str, ...]] = {}
_EXPLAINED_BY: dict[Check, tuple[str, ...]] = {}


def check(
    *requirement_ids: str, rests_on: Sequence[str] = (), explained_by: Sequence[str] = ()
) -> Callable[[CheckT], CheckT]:
    """Register the decorated function as the check of these requirements, of any layer.

    :param rests_on: what it judges beside positions: members of a motor, and what
        :mod:`~dexkit.conformance.kit.provenance` names. Where the source of a recording does not
        carry it, the requirement is not applicable.
    :param explained_by: members of a motor that can excuse a failure: gains that are 0, a torque at
        an object. Where the source does not carry them, a failure is a warning.
    """

    def register(function: CheckT) -> CheckT:
        for name in requirement_ids:
            assert name not in REGISTRY, f"{name} has two checks"
            REGISTRY[name] = function
        _RESTS_ON[function] = tuple(rests_on)
        _EXPLAINED_BY[function] = tuple(explained_by)
        return function

    return register


def rests_on(requirement: Requirement) -> tuple[str, ...]:
    """What the check of a requirement rests on beside positions."""
    return _RESTS_ON.get(check_of(requirement), ())


def explained_by(requirement: Requirement) -> tuple[str, ...]:
    """The members of a motor that can excuse a failure of a requirement."""
    return _EXPLAINED_BY.get(check_of(requirement), ())


def check_of(requirement: Requirement) -> Check:
    """The check registered for a requirement, else for the nearest requirement in its chain of
    ``like``.

    The layer's modules of checks are imported in order until one registers it.

    :raises KeyError: there is none.
    """
    modules = layer(requirement.layer).checks
    for name in (requirement.id, *requirement.lineage):
        for module in modules:
            if name in REGISTRY:
                return REGISTRY[name]
            importlib.import_module(module)
        if name in REGISTRY:
            return REGISTRY[name]
    raise KeyError(requirement.id)
