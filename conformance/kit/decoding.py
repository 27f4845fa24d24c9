"""Decode what a recording holds of hands or of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dexkit.conformance.kit import run_record
from dexkit.conformance.kit.recording import Recording, TraceLike
from dexkit.conformance.kit.robot import robot_in
from dexkit.conformance.kit.unprefixed import Unprefixed, choose_prefix
from dexkit.conformance.layers import layer_of_model
from dexkit.hand import Subject
from dexkit.topics import HAND_TOPICS, prefixes_of

__all__ = ["recording_of"]


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
