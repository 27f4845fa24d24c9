"""Measure one wrong hand, and keep what was measured for the next time."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import msgspec
import platformdirs

from dexkit.conformance.faults import Mutant, mutants
from dexkit.conformance.faults.matrix import with_key
from dexkit.conformance.kit.requirements import Level, catalogue
from dexkit.conformance.layers import layer
from dexkit.documents import write_file
from dexkit.hand import Side
from dexkit.models import MODELS, Dialect, dialect, model
from tools.consequences.sessions import measure
from tools.consequences.stage import Figure
from tools.pins.keys import run_key

__all__ = ["Task", "default_folder", "known", "musts", "tasks", "work"]

Key = tuple[str, str, str]
"""Of a wrong hand; of a reference, with the dialect in place of the class."""
_WITHOUT = {
    "dexkit.conformance.stimuli": "of the scripts, only a recorded session and an object are used",
}
_REFERENCE = "reference"


def default_folder() -> Path:
    """Where figures are kept if nothing else is said."""
    return Path(platformdirs.user_cache_path("dexkit")) / "consequences"


@dataclass(frozen=True)
class Task:
    """A wrong hand, or a reference, that is to be measured.

    :param name: of the wrong hand's pin; of a reference, its place.
    :param mutant: key of the wrong hand; None for the reference.
    :param sides: the hands that are there, and the dialect.
    :param file: keeps the figures.
    """

    name: str
    mutant: Key | None
    model: str
    dialect: str
    sides: tuple[Side, ...]
    file: Path


def musts() -> frozenset[str]:
    """Ids of the requirements that a hand on DDS must meet."""
    return frozenset(r.id for r in catalogue(None, "dds") if r.level is Level.MUST)


def tasks(folder: Path, only: tuple[str, ...]) -> list[Task]:
    """The wrong hands whose name has one of the texts, and the references that they need.

    First is one hand of each MUST, then a second one, and so on, and last those that fail none: a
    run that is stopped knows something of all of them.
    """
    every = musts()
    found = [m for m in mutants("dds") if m.model in MODELS]
    found = [m for m in found if not only or any(text in m.pin for text in only)]
    turns: dict[str, int] = {}

    def order(mutant: Mutant) -> tuple[bool, bool, int]:
        turns[mutant.kills] = turn = turns.get(mutant.kills, 0) + 1
        fails_none = every.isdisjoint((mutant.pinned or frozenset()) | {mutant.kills})
        return fails_none, mutant.kills not in every, turn

    hands = [_task(m, folder) for m in sorted(found, key=order)]
    references = {(t.model, t.dialect, t.sides): _reference(t, folder) for t in hands}
    return [*references.values(), *hands]


def _task(mutant: Mutant, folder: Path) -> Task:
    spoken = _spoken(mutant.model, mutant.dialect)
    sides = tuple(s for s in mutant.sides if isinstance(s, Side))
    if spoken.commands_both:
        sides = tuple(Side)
    key = run_key(mutant.made, mutant.model, measure, (*mutant.key, str(sides)), _WITHOUT)
    return Task(mutant.pin, mutant.key, mutant.model, spoken.name, sides, folder / f"{key}.json")


def _reference(task: Task, folder: Path) -> Task:
    made = layer("dds").reference(task.model)
    about = (_REFERENCE, task.model, task.dialect, str(task.sides))
    key = run_key(made, task.model, measure, about, _WITHOUT)
    name = f"{_REFERENCE} {task.dialect} {'+'.join(task.sides)}"
    return Task(name, None, task.model, task.dialect, task.sides, folder / f"{key}.json")


def _spoken(model_name: str, name: str) -> Dialect:
    return dialect(name) if name else model(model_name).dialects[0]


def known(task: Task) -> dict[Figure, float] | None:
    """The figures of a task that are kept; None if there are none."""
    try:
        return _read(task.file)
    except (OSError, msgspec.MsgspecError):
        return None


@functools.lru_cache(32)
def _read(file: Path) -> dict[Figure, float]:
    rows = msgspec.msgpack.decode(file.read_bytes(), type=list[tuple[Figure, float]])
    return dict(rows)


def work(task: Task) -> str:
    """Measure a hand, and keep its figures; what went wrong, or ""."""
    made = layer("dds").reference(task.model) if task.mutant is None else with_key(task.mutant).made
    try:
        figures = measure(made, _spoken(task.model, task.dialect), task.sides)
    except Exception as error:  # a wrong hand may break the rig: the others are measured
        return f"{task.name}: {type(error).__name__}: {error}"
    task.file.parent.mkdir(parents=True, exist_ok=True)
    write_file(task.file, msgspec.msgpack.encode(list(figures.items())))
    return ""
