"""The layer ``dds``: hands, judged by what a recording holds of their DDS topics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dexkit.conformance.behaviours import CHECKS
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.layers import Layer
from dexkit.conformance.layers.preconditions import claimed, not_blocked, not_spoiled
from dexkit.errors import UsageError
from dexkit.hand import Side, Subject
from dexkit.lazy import Lazy

if TYPE_CHECKING:
    from dexkit.conformance.checks import Context, Outcome
    from dexkit.conformance.kit.recording import Recording, SideView, TraceLike
    from dexkit.conformance.kit.results import Result
    from dexkit.conformance.kit.verdicts import Judgement

__all__ = [
    "LAYER",
    "applies_to_dialect",
    "one_by_one",
    "recorded",
    "subjects",
    "whole",
    "with_format",
    "with_silence",
]

_SILENT = 0.5
"""Seconds without state, at the end of a failure's place, that are no mere gap."""
_NOT_OURS = (
    "the kit ends and starts only a service that it has started itself (not --backend external)"
)
_REMEDY = {
    "squeeze": "put something between the fingers, and say where it is felt (--object {side}=PCT)",
    "shutdown": _NOT_OURS,
    "service-restart": _NOT_OURS,
}
"""Advice or reason if a stimulus was not applied."""


def _decode(trace: TraceLike, dialect_name: str | None, sides: Sequence[Subject]) -> Recording:
    from dexkit.conformance.kit.recording import Recording

    hands = tuple(s for s in sides if isinstance(s, Side))
    if len(hands) < len(sides):
        raise UsageError("a hand is on the left or the right side", hint="give --side")
    return Recording.decode(trace, dialect_name=dialect_name, sides=hands)


def subjects(recording: Recording) -> Iterable[tuple[Subject, SideView]]:
    """The subjects to be judged, each with its part of the recording."""
    return [(subject, recording.sides[subject]) for subject in recording.judged]


def one_by_one(recording: Recording) -> Iterator[tuple[Subject, SideView]]:
    """The same; what checks have worked out of a subject is dropped before the next one."""
    for subject, view in subjects(recording):
        yield subject, view
        view.known.clear()


def whole(recording: Recording) -> tuple[float, float]:
    """Begin and end of the recording, seconds."""
    return 0.0, recording.duration


def applies_to_dialect(judgement: Judgement, context: Context) -> Result | None:
    """A precondition: the requirement is about the recording's dialect."""
    dialect = context.recording.dialect.name
    if dialect in judgement.requirement.dialects:
        return None
    return judgement.not_applicable(f"does not apply to the dialect {dialect}")


_SAY_NOTHING = (
    "every number in every state is 0, temperatures and all: nothing shows that there is a hand "
    "(is it powered, and has it started?)"
)
_UNIT_OF_TORQUE = frozenset(("DEX1-FORCE-04", "DEX3-FORCE-02"))
"""The requirements that say that tau_est is in raw counts, and what others are like."""
_MOVED = 0.1
"""Part of a joint's stroke by which commands move a goal."""
_NOT_ALL_ZERO = "-START-01"
"""How the ids end of what a hand that says nothing fails by itself, if zeros are no state."""


def says_something(judgement: Judgement, context: Context) -> Result | None:
    """A precondition: some number in some state is not 0.

    A hand that failed to start may publish valid messages of zeros at full rate. They meet most of
    what is asked of a hand at rest, and show nothing of it. One that is commanded to move fails by
    what it does.
    """
    requirement = judgement.requirement
    fails = context.recording.dialect.zero_is_no_state and requirement.id.endswith(_NOT_ALL_ZERO)
    if fails or requirement.needs in ("nothing", "endpoints"):
        return None
    if context.recording.stimulus is not None or not context.states.say_nothing:
        return None
    return None if _asked_to_move(context) else judgement.no_hand(_SAY_NOTHING)


def _asked_to_move(context: Context) -> bool:
    """Whether commands move the goal of a joint that they drive."""
    commands = context.commands
    for joint, spec in enumerate(context.joints):
        driven = commands.kp[:, joint] > 0
        if not context.recording.dialect.gains_are_used:
            driven |= True
        q = commands.q[driven, joint]
        low, high = np.nanmin(q, initial=np.inf), np.nanmax(q, initial=-np.inf)
        if high - low > _MOVED * spec.stroke:
            return True
    return False


def has_torque(judgement: Judgement, context: Context) -> Result | None:
    """A precondition: tau_est is a torque, where the requirement is about it."""
    requirement = judgement.requirement
    about_it = requirement.area == "Force" or requirement.capability == "force"
    says_so = not _UNIT_OF_TORQUE.isdisjoint((requirement.id, *requirement.lineage))
    if says_so or not about_it or not context.hand.has_raw_torque:
        return None
    return judgement.not_applicable("tau_est is in raw counts, and not in a unit of force")


def recorded(judgement: Judgement, context: Context) -> Result | None:
    """A precondition: the recording has the stimulus, endpoints or commands that are needed."""
    missing = _missing(context)
    return judgement.not_applicable(missing) if missing else None


def _missing(context: Context) -> str:
    """Text that names what the recording lacks for this requirement; empty if nothing."""
    requirement, recording = context.requirement, context.recording
    if requirement.phase:
        stimulus = " or ".join(f"'{name}'" for name in requirement.phases)
        if recording.stimulus is None:
            return f"needs the stimulus {stimulus}, which only a live run applies"
        why = _REMEDY.get(requirement.phase, "")
        why = f": {why.format(side=context.side)}" if why else ""
        if not any(recording.phases(name) for name in requirement.phases):
            return f"the stimulus {stimulus} was not applied in this run{why}"
        if not requirement.moves_other_side and not context.phases():
            return f"the stimulus {stimulus} was not applied to the {context.side} hand{why}"
    if requirement.needs_discovery and not recording.endpoints:
        return "the recording does not say who published and subscribed (record dds_endpoints)"
    if requirement.needs_commands and not len(context.commands):
        return "no commands to this hand in the recording"
    return ""


def carried(judgement: Judgement, context: Context) -> Result | None:
    """A precondition: the source of the recording carries what the check rests on."""
    from dexkit.conformance.checks import rests_on
    from dexkit.conformance.kit.provenance import STATES

    requirement, recording = context.requirement, context.recording
    wanted, states = rests_on(requirement), context.states.topic
    topic = context.commands.topic if requirement.layer == "client" else states
    why = recording.provenance.lacking(topic, wanted)
    about_states = requirement.layer != "client" and not requirement.needs_discovery
    if (about_states or STATES in wanted) and all(c.topic != states for c in recording.channels):
        if recording.provenance.leaves_out(states):
            why = f"the recording is of chosen topics, without {states}"
        elif recording.stimulus is None and not recording.endpoints:
            why = f"the recording has no {states}, and does not say who published"
    return judgement.not_applicable(why) if why else None


def with_format(context: Context, outcome: Outcome) -> Outcome:
    """Make a failure a warning where the source of the recording has not what could excuse it."""
    from dexkit.conformance.checks import explained_by

    wanted = explained_by(context.requirement)
    if outcome.met is not False or not wanted:
        return outcome
    provenance = context.recording.provenance
    of_commands = [w for w in wanted if w in ("kp", "mode")]
    why = provenance.lacking(context.commands.topic, of_commands)
    why = why or provenance.lacking(context.states.topic, set(wanted) - set(of_commands))
    if not why:
        return outcome
    text = f"{why}: the hand may not have been driven, or an object may have held it."
    return outcome.tolerated().because(f"{outcome.cause} {text[0].upper()}{text[1:]}".strip())


def with_silence(context: Context, outcome: Outcome) -> Outcome:
    """Name the end of all states as the cause of a failure after it."""
    states, commands = context.states, context.commands
    ends = [e.end_s for e in outcome.evidence if e.end_s is not None]
    if not ends and len(commands):  # without states the failure has no place in time
        ends = [float(commands.t[-1])]
    if outcome.met is not False or not len(states) or not ends:
        return outcome
    last = float(states.t[-1])
    if max(ends) < last + _SILENT:
        return outcome
    return replace(
        outcome,
        cause=f"The hand fell silent for good at {last:.1f} s: has its service ended, or does it "
        "hang? Its own log may say why.",
    )


LAYER: Layer[Recording, SideView, Context] = Layer(
    name="dds",
    checks=CHECKS,
    plots=(Plot(PlotKind.POSITION),),
    decode=_decode,
    subjects=one_by_one,
    context=Lazy("dexkit.conformance.checks:Context"),
    preconditions=(
        *(applies_to_dialect, claimed, recorded, carried, has_torque),
        *(says_something, not_spoiled, not_blocked),
    ),
    refine=lambda context, outcome: with_silence(context, with_format(context, outcome)),
    whole=whole,
    script=lambda name: under_test(name).script.load(),
    reference=lambda name: under_test(name).reference.load(),
)
