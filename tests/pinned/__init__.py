"""Verdicts that a change of structure must not change: data, and how to record it again.

``python -m tests.pinned`` writes the two files anew, from every sample recording and the whole
matrix of wrong hands (about five minutes on two cores). A difference is either a mistake or a
change of what the kit demands; the commit that makes it says which.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from dexkit.conformance.judge import judge
from dexkit.conformance.layers import recording_of
from dexkit.conformance.mutants import Mutant
from dexkit.conformance.mutants.matrix import WrongHandResult
from dexkit.traces import open_trace
from dexkit.traces.samples import SAMPLES, sample_path

FOLDER = Path(__file__).parent
SAMPLE_VERDICTS = FOLDER / "samples.json"
BLAMED = FOLDER / "blamed.json"

Verdicts = dict[str, str]


def verdicts_of(name: str) -> Verdicts:
    """Requirement and side of everything judged in a sample, its client included, with verdict and
    figure.
    """
    result = judge(recording_of(open_trace(sample_path(name)), None, ()))
    every = [*result.results, *result.client]
    return {f"{r.requirement.id} {r.side}": f"{r.verdict}: {r.figure}" for r in every}


def sample_verdicts() -> dict[str, Verdicts]:
    """:func:`verdicts_of` every sample."""
    return {name: verdicts_of(name) for name in SAMPLES}


def key(mutant: Mutant) -> str:
    """The name of a wrong hand in the file."""
    return f"{mutant.layer} {mutant.model} {mutant.name} ({mutant.kills})"


def blamed(outcome: WrongHandResult) -> list[str]:
    """The requirements that find fault with a wrong hand."""
    due = {outcome.mutant.kills, *outcome.mutant.also}
    return sorted(due - set(outcome.missed) | set(outcome.wrongly))


def blamed_sets(outcomes: Iterable[WrongHandResult]) -> dict[str, list[str]]:
    """:func:`blamed` of each wrong hand."""
    return {key(o.mutant): blamed(o) for o in sorted(outcomes, key=lambda o: key(o.mutant))}


def load(path: Path) -> dict[str, object]:
    """One of the two files."""
    found: dict[str, object] = json.loads(path.read_text(encoding="utf-8"))
    return found


def save(path: Path, data: object) -> None:
    """Write one of the two files."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
