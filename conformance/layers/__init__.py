"""The layers of judging: a hand's DDS topics, a robot's DDS topics, a hand's USB, and the client.

A :class:`Layer` is the data by which the kit goes from a device to verdicts: how a recording is
decoded (:func:`recording_of`), what is judged by which checks (:mod:`dexkit.conformance.judge`),
and which script is played to which reference. Each layer is in a module of its own:

* :mod:`~dexkit.conformance.layers.hand`: ``dds``, the DDS topics of hands;
* :mod:`~dexkit.conformance.layers.usb`: ``usb``, the USB transfers of Dex3-1 hands;
* :mod:`~dexkit.conformance.layers.robot`: ``robot``, the low-level DDS topics of robots;
* :mod:`~dexkit.conformance.layers.client`: ``client``, the commands that a client sends to hands.

These modules are imported with the requirements, and load checks, decoders, scripts and references
on first use.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from dexkit.conformance.plots import Plot
from dexkit.lazy import Lazy
from dexkit.robots import ROBOTS
from dexkit.topics import HAND_TOPICS, prefixes_of

if TYPE_CHECKING:
    from dexkit.conformance.checks import BaseContext, Outcome
    from dexkit.conformance.recording import Recording, TraceLike
    from dexkit.conformance.requirements import Requirement
    from dexkit.conformance.results import Result
    from dexkit.conformance.verdicts import Judgement
    from dexkit.hand import Subject

__all__ = [
    "LAYERS",
    "Layer",
    "Precondition",
    "claimed",
    "layer",
    "layer_of_model",
    "not_blocked",
    "not_spoiled",
    "recording_of",
]


RecordingT = TypeVar("RecordingT")
ViewT = TypeVar("ViewT")
ContextT = TypeVar("ContextT", bound="BaseContext[Any, Any]")

Precondition = Callable[["Judgement", ContextT], "Result | None"]
"""The result, where a requirement is not to be checked at all."""
Decode = Callable[["TraceLike", "str | None", "Sequence[Subject]"], "RecordingT | None"]


@dataclass(frozen=True)
class Layer(Generic[RecordingT, ViewT, ContextT]):
    """The data by which one layer is judged.

    :param name: one of :data:`LAYERS`; it selects the catalogue
        (:func:`dexkit.conformance.requirements.catalogue`).
    :param checks: the modules that register its checks.
    :param plots: what shows a failure where neither the catalogue nor the check names a plot.
    :param decode: a recording's part that is about the layer; None where there is none. It takes
        the recording, the dialect's name (None for the one that the topics show) and the
        subjects to be judged (none for all that are there).
    :param subjects: each subject to be judged, and the recording's part that is about it.
    :param context: what a check of the layer gets.
    :param preconditions: what is asked before the check, in this order; the first that has a
        result decides.
    :param refine: adds to an outcome what the recording says beside the check.
    :param whole: begin and end of the recording, seconds, as the place of failures that have
        none; None where such a failure cannot be excused by a busy machine.
    :param script: the stimulus script of a model, by the model's name.
    :param reference: the simulated device or client of a model that meets every requirement,
        likewise.
    """

    name: str
    checks: Sequence[str]
    plots: tuple[Plot, ...]
    decode: Decode[RecordingT]
    subjects: Callable[[RecordingT], Iterable[tuple[Subject, ViewT]]]
    context: Lazy[Callable[[RecordingT, ViewT, Requirement], ContextT]]
    preconditions: Sequence[Precondition[ContextT]]
    refine: Callable[[ContextT, Outcome], Outcome]
    whole: Callable[[RecordingT], tuple[float, float] | None]
    script: Callable[[str], type[Any]]
    reference: Callable[[str], type[Any]]


_MODULES = {"dds": "hand", "usb": "usb", "robot": "robot", "client": "client"}
LAYERS = tuple(_MODULES)
"""The names of the layers."""


def layer(name: str) -> Layer[Any, Any, Any]:
    """The layer of that name, one of :data:`LAYERS`."""
    module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    found: Layer[Any, Any, Any] = module.LAYER
    return found


def layer_of_model(model_name: str) -> Layer[Any, Any, Any]:
    """The layer of a hand's or robot's DDS topics."""
    return layer("robot" if model_name in ROBOTS else "dds")


def recording_of(
    trace: TraceLike,
    dialect_name: str | None,
    sides: Sequence[Subject],
    prefix: str = "",
) -> Recording:
    """Decode the DDS part of a recording: hands or a robot.

    :param dialect_name: None to take what the run record says, else what the topics show: hands,
        if there are any.
    :param sides: none to take those of the run record, else those that have a topic.
    :param prefix: of the hands' topics; empty for hands without one, or the only one there is.
    :raises ConformanceError: it has none of their topics.
    :raises UsageError: sides of a robot; no hand has the prefix, or there are several to choose
        from.
    :raises TraceUnsupported: its stimulus record cannot be read.
    """
    from dexkit.conformance import run_record
    from dexkit.conformance.recording import Recording
    from dexkit.conformance.robot import robot_in
    from dexkit.conformance.unprefixed import Unprefixed, choose_prefix

    everything = {c.topic for c in trace.channels} | {e.topic for e in trace.endpoints}
    chosen = choose_prefix(everything, prefix)
    trace = Unprefixed(trace, chosen) if chosen else trace
    run = trace.metadata.get(run_record.RECORD, {})
    recorded = run_record.recorded_dialect(run)
    name = dialect_name or recorded
    if name is None:
        topics = {c.topic for c in trace.channels} | {e.topic for e in trace.endpoints}
        found = None if topics & HAND_TOPICS else robot_in(trace)
        name = found.name if found else None
    if not sides and name == recorded:
        sides = run_record.recorded_subjects(run)
    recording = layer_of_model(name or "").decode(trace, name, sides)
    assert isinstance(recording, Recording), "only USB may be missing from a recording"
    others = [each or "none" for each in prefixes_of(everything) if each != chosen]
    notes = [f"the topics are under the prefix {chosen}: rt/{chosen}/..."] if chosen else []
    if others:
        notes.append(f"hands under other prefixes are not judged: {', '.join(others)} (--prefix)")
    return replace(recording, notes=[*recording.notes, *notes]) if notes else recording


def claimed(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: the vendor does not disclaim the unit that the requirement is about."""
    return judgement.not_claimed()


def not_blocked(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: nothing has failed that the requirement depends on."""
    return judgement.blocked()


def not_spoiled(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: the client's commands allow to judge it."""
    return judgement.spoiled()
