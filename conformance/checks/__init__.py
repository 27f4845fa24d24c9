"""The checks: each judges a recording for one requirement and one side.

A check is a function of a :class:`Context` that returns an :class:`Outcome`. It never passes on
missing evidence, and takes every limit from its requirement's tolerances, so that several hand
models share it. Modules, by subject: :mod:`~dexkit.conformance.checks.discovery`,
:mod:`~.timing`, :mod:`~.fields`, :mod:`~.members`, :mod:`~.consistency`, :mod:`~.velocity`,
:mod:`~.motion`, :mod:`~.force`, :mod:`~.drive`, :mod:`~.firmness`, :mod:`~.safety`,
:mod:`~.afterwards`, :mod:`~.uncommanded`, :mod:`~.lifecycle`, :mod:`~.tracking`, :mod:`~.fingers`,
:mod:`~.each_joint` and :mod:`~.pressure` for hands of several joints, :mod:`~.touch` for a topic of
tactile areas, :mod:`~.servos` for position servos, and :mod:`~.client` for the client that drives
them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

from dexkit.conformance.measure import Measure, Quantity
from dexkit.conformance.plots import Plot, PlotKind
from dexkit.conformance.recording import Commands, Recording, SideView, States
from dexkit.conformance.requirements import Requirement
from dexkit.conformance.results import Evidence
from dexkit.conformance.stimulus_record import Phase
from dexkit.hand import JointSpec, Side, Subject

__all__ = [
    "CHECK_MODULES",
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

_HAND = (
    *("discovery", "timing", "fields", "members", "motion", "force", "consistency", "velocity"),
    *("drive", "safety", "lifecycle", "tracking", "fingers", "each_joint", "pressure"),
    *("operator", "uncommanded", "servos", "touch", "firmness", "afterwards"),
)
CHECK_MODULES: Mapping[str, Sequence[str]] = {
    "dds": tuple(f"{__name__}.{name}" for name in _HAND),
    "robot": tuple(
        f"{__name__}.{n}" for n in ("robot", "discovery", "timing", "fields", "lifecycle")
    ),
    "usb": ("dexkit.conformance.usb.checks",),
    "client": (f"{__name__}.client",),
}
"""The modules that register the checks of each layer."""

ROUNDING = 1e-3
"""Part of a limit by which a saturated value may be above it: a drive that is clamped at the limit
reports it as float32 and in its own counts, which round (docs/sources/unitree-dex.md#g: 15 N m are
1536 counts of 0.0098 N m, and come back as 15.000001). Used where a limit is that of the hand's
own clamp; other limits have a tolerance of their own."""
STROKE_S = 1.0
"""Seconds that a hand driven by Unitree's client takes for a stroke."""


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
    """A rate, Hz, that was observed for that many seconds.

    Both ends of that time may be wrong by the kit's error, each of which changes the rate by its
    part of the time.
    """
    per_second = 2 * hertz / seconds if seconds > 0 else 0.0
    return Measure(
        float(hertz), float(limit), "Hz", Quantity.TIME, at_most, per_second=per_second, span=span
    )


@dataclass(frozen=True)
class Late:
    """The delay of a conforming hand that would cause the same failure: the failure's size.

    :param seconds: at each of the failure's places, or one for all of them; infinite where no
        delay causes such a failure. For a missing motion, the seconds that a conforming hand
        takes for it: :data:`STROKE_S` for a stroke.
    :param how: ``total``: once, at that place; ``mean``: again and again, as a rate suffers;
        ``p99``: one time in a hundred.
    :param best: the same for the best quarter of repeated events; 0 if not known.
    """

    seconds: tuple[float, ...]
    how: str = "total"
    best: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What a check found.

    :param met: whether the requirement is met; None when it could not be judged.
    :param cause: the likely cause, where the check can determine it; else the requirement's.
    :param late: the delay of a conforming hand that would cause this failure, where the check can
        determine it; else the length of the failure's place.
    :param absent: the hand lacks this unit: a failure if the vendor claims the unit, whatever
        ``met`` is otherwise.
    :param joints: indices of the joints that it is about, the most important first; empty if it is
        about no particular joint.
    :param plots: the plots that show it, where they differ from the requirement's.
    :param retry: another run may give another outcome.
    :param measures: the figures with a limit that it rests on, one for each place; empty if it
        rests on none.
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
    joints: tuple[int, ...] = ()
    plots: tuple[Plot, ...] = ()
    retry: bool = False
    measures: tuple[Measure, ...] = ()

    def about(self, *joints: int) -> Outcome:
        """Return a copy that is about these joints (indices)."""
        return replace(self, joints=tuple(int(joint) for joint in joints))

    def shown_by(self, *plots: PlotKind | Plot) -> Outcome:
        """Return a copy with these plots instead of the requirement's."""
        chosen = tuple(Plot(p) if isinstance(p, PlotKind) else p for p in plots)
        return replace(self, plots=chosen)

    def because(self, cause: str) -> Outcome:
        """Return a copy with a cause that the check has determined."""
        return replace(self, cause=cause)

    def resting_on(self, *measures: Measure) -> Outcome:
        """Return a copy with the figures that it rests on."""
        return replace(self, measures=measures)

    def timed(
        self, seconds: float, limit: float, *, at_least: bool = False, span: Span | None = None
    ) -> Outcome:
        """Return a copy that rests on a time, seconds.

        :param at_least: the limit is the least that is asked for.
        :param span: begin and end of its place; None for the outcome's first one.
        """
        measure = Measure(float(seconds), float(limit), larger_is_worse=not at_least, span=span)
        return self.resting_on(measure)

    def rated(
        self, hertz: float, limit: float, seconds: float, *, at_most: bool = False
    ) -> Outcome:
        """Return a copy that rests on a rate, Hz.

        :param seconds: how long it was observed.
        :param at_most: the limit is the most that is allowed.
        """
        return self.resting_on(rate_measure(hertz, limit, seconds, at_most=at_most))

    def placed(self, rad: float, limit: float, *, at_least: bool = False) -> Outcome:
        """Return a copy that rests on a distance, rad."""
        measure = Measure(float(rad), float(limit), "rad", Quantity.POSITION, not at_least)
        return self.resting_on(measure)

    def pressed(self, torque: float, limit: float, *, at_least: bool = False) -> Outcome:
        """Return a copy that rests on a torque, N m."""
        measure = Measure(float(torque), float(limit), "N m", Quantity.TORQUE, not at_least)
        return self.resting_on(measure)

    def if_late(self, *seconds: float, how: str = "total", best: float = 0.0) -> Outcome:
        """Return a copy with the size of the failure; see :class:`Late`."""
        sizes = tuple(max(0.0, float(s)) for s in seconds)
        return replace(self, late=Late(sizes, how, max(0.0, float(best))))


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
    :param hand: the part of it that is about the subject.
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
        """The requirement is met."""
        return Outcome(True, figure, observed, values=_plain(values))

    def failed(self, figure: str, observed: str, *places: Evidence, **values: float) -> Outcome:
        """It is not met."""
        return Outcome(False, figure, observed, evidence=places, values=_plain(values))

    def skipped(self, reason: str) -> Outcome:
        """It cannot be judged with this recording."""
        return Outcome(None, reason=reason)

    def in_unit(self, outcome: Outcome) -> Outcome:
        """An outcome of a check with the subject's unit of q where the check says rad."""
        return outcome

    def absent(self, reason: str) -> Outcome:
        """Not judged: the hand lacks this unit; a failure only where the vendor claims it."""
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
        """An outcome of a check with the subject's unit of q where the check says rad."""
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
        """What another check of this hand has worked out under that name, else do it now.

        :param name: with all that the result depends on, except for the recording.
        """
        known = self.hand.known
        if name not in known:
            known[name] = work_out()
        found: T = known[name]
        return found

    def tolerance(self, name: str, joint: int = 0) -> float:
        """A tolerance of the requirement; ``NAME_stroke`` in radians of that joint."""
        value = self.requirement.tolerance(name)
        return value * self.joints[joint].stroke if name.endswith("_stroke") else value

    def named(self, text: str, joint: int) -> str:
        """``text`` with the joint's name before it, where the hand has several."""
        return text if len(self.joints) == 1 else f"{self.joints[joint].name}: {text}"

    def phases(self, name: str | None = None) -> list[Phase]:
        """The phases of this side, by default those that the requirement needs."""
        return self.recording.phases(name or self.requirement.phase or "", self.side)

    def span(self, phase: Phase) -> tuple[float, float]:
        """Begin and end of a phase, seconds."""
        return self.recording.seconds(phase.begin_ns), self.recording.seconds(phase.end_ns)

    @property
    def object_at(self) -> float | None:
        """The q at which this side touches its object, or None if not known."""
        return self.recording.stimulus.objects.get(self.side) if self.recording.stimulus else None

    def at(self, topic: str, seconds: float, end: float | None = None) -> Evidence:
        """A place in the recording."""
        return self.place(topic, seconds, end)


Check = Callable[[Any], Outcome]
"""A function of the context of its layer; see :mod:`dexkit.conformance.layers`."""
CheckT = TypeVar("CheckT", bound=Check)
REGISTRY: dict[str, Check] = {}
"""Checks by requirement id, of those modules that have been imported."""


def check(*requirement_ids: str) -> Callable[[CheckT], CheckT]:
    """Register the decorated function as the check of these requirements, of any layer."""

    def register(function: CheckT) -> CheckT:
        for name in requirement_ids:
            assert name not in REGISTRY, f"{name} has two checks"
            REGISTRY[name] = function
        return function

    return register


def check_of(requirement: Requirement) -> Check:
    """The check that is registered for a requirement, else for the nearest that it is ``like``.

    Modules of checks are imported one after the other until one registers it.

    :raises KeyError: there is none.
    """
    modules = CHECK_MODULES[requirement.layer]
    for name in (requirement.id, *requirement.lineage):
        for module in modules:
            if name in REGISTRY:
                return REGISTRY[name]
            importlib.import_module(module)
        if name in REGISTRY:
            return REGISTRY[name]
    raise KeyError(requirement.id)
