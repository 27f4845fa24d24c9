"""Recordings in memory, made by the kit's virtual hands."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from dexkit.conformance.mutants import plan_for
from dexkit.conformance.results import Result, RunResult, Verdict
from dexkit.conformance.virtual import MemoryTrace, run_virtual
from dexkit.conformance.virtual.gripper import ReferenceService
from dexkit.hand import Side


@cache
def short_run() -> MemoryTrace:
    """A good left hand through listening, steps and silence."""
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step", "silence"}))
    return run_virtual(plan, ReferenceService)


def copy_of(trace: MemoryTrace) -> MemoryTrace:
    return MemoryTrace(
        endpoints=list(trace.endpoints),
        metadata={k: dict(v) for k, v in trace.metadata.items()},
        rows={k: list(v) for k, v in trace.rows.items()},
    )


def of(result: RunResult, requirement: str, side: str = "left") -> Result:
    return next(r for r in result.results if r.requirement.id == requirement and r.side == side)


def failed(result: RunResult) -> set[tuple[str, str]]:
    return {(r.requirement.id, r.side) for r in result.results if r.verdict is Verdict.FAIL}
