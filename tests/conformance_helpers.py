"""Recordings in memory, made by the kit's virtual hands, and how the suite is started."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

from dexkit.conformance.faults import plan_for
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Load, Result, RunResult, Verdict
from dexkit.conformance.kit.stimulus_record import RECORD, Beats, Stall, Stimulus
from dexkit.conformance.layers import layer
from dexkit.conformance.usb.recording import UsbRecording
from dexkit.conformance.virtual import MemoryTrace, run_virtual
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.conformance.virtual.usb import ReferenceDevice, run_virtual_usb
from dexkit.hand import Side

SUITE = (sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:hypothesispytest")
"""Starts the suite without what a user's environment lacks: Hypothesis would take a third of the
processor time of a start."""


@cache
def short_run() -> MemoryTrace:
    """A good left hand through listening, steps and silence."""
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step", "silence"}))
    return run_virtual(plan, ReferenceService)


def usb_run(device: ReferenceDevice) -> UsbRecording:
    """A virtual run of the USB script with a device, decoded."""
    recording = layer("usb").decode(run_virtual_usb(device), None, ())
    assert isinstance(recording, UsbRecording)
    return recording


def copy_of(trace: MemoryTrace) -> MemoryTrace:
    return MemoryTrace(
        endpoints=list(trace.endpoints),
        metadata={k: dict(v) for k, v in trace.metadata.items()},
        rows={k: list(v) for k, v in trace.rows.items()},
    )


def with_beats(
    trace: MemoryTrace,
    stalls: Sequence[int] = (),
    stall_s: float = 0.15,
    *,
    usual_us: int = 100,
    pressed: bool = False,
) -> Recording:
    """The recording, of a machine that stood still from these log times on.

    :param usual_us: by how much its timer was late otherwise.
    :param pressed: whether programs waited for a processor all the time.
    """
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    first = min(row[0] for rows in trace.rows.values() for row in rows)
    beats = dict.fromkeys(range(0, 20_000_000, 10_000), usual_us)
    for stall in stalls:
        begin, length = (stall - first) // 1000, round(stall_s * 1e6)
        beats = {t: x for t, x in beats.items() if not begin <= t < begin + length}
        beats[begin + length] = length
    stimulus.beats = Beats(first, sorted(beats), [beats[t] for t in sorted(beats)])
    stimulus.stalls = [Stall(first, first + 60 * 10**9)] if pressed else []
    trace.metadata[RECORD] = stimulus.to_metadata()
    return Recording.decode(trace)


def result_of(result: RunResult, requirement: str, side: str = "left") -> Result:
    return next(r for r in result.results if r.requirement.id == requirement and r.side == side)


def failed(result: RunResult) -> set[tuple[str, str]]:
    return {(r.requirement.id, r.side) for r in result.results if r.verdict is Verdict.FAIL}


def failed_or_excused(result: RunResult) -> set[tuple[str, str]]:
    """What failed, and what was left open because this machine was too busy."""
    excused = [r for r in result.results if r.disturbance.load is Load.TOO_BUSY]
    return failed(result) | {(r.requirement.id, r.side) for r in excused}
