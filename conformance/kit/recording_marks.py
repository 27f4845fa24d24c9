"""Moments of a conformance run's recording: phases of its stimulus, and what failed."""

from __future__ import annotations

from collections.abc import Iterator

from dexkit.conformance.kit.results import Result, RunResult, Verdict
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.traces import Trace
from dexkit.watch.marks import Mark

__all__ = ["phase_marks", "verdict_marks"]

_SHOWN = (Verdict.FAIL, Verdict.WARN)


def phase_marks(trace: Trace) -> list[Mark]:
    """The phases, in order of time; none in a recording that no run made.

    :raises TraceUnsupported: the stimulus record cannot be read.
    """
    if RECORD not in trace.metadata:
        return []
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    return [
        Mark(p.begin_ns, p.end_ns, "phase", f"{p.name} {', '.join(map(str, p.sides))}")
        for p in sorted(stimulus.phases, key=lambda p: p.begin_ns)
    ]


def verdict_marks(result: RunResult) -> list[Mark]:
    """A mark for each requirement that was not met, at the first moment that shows it.

    Failures come before warnings; those without a moment in the recording are left out.
    """
    found = list(_verdicts([*result.results, *result.client]))
    return sorted(found, key=lambda m: (m.kind != "fail", m.time_ns))


def _verdicts(results: list[Result]) -> Iterator[Mark]:
    for result in results:
        if result.verdict not in _SHOWN or not result.evidence:
            continue
        first = min(result.evidence, key=lambda e: e.log_time_ns)
        length = 0.0 if first.end_s is None else max(0.0, first.end_s - first.time_s)
        yield Mark(
            first.log_time_ns,
            first.log_time_ns + round(length * 1e9),
            str(result.verdict),
            f"{result.requirement.id} {result.requirement.title}, {result.side}",
            result.observed,
        )
