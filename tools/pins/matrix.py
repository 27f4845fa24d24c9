"""All wrong hands and samples, and the verdicts on them: known ones first, then those of trials."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from dexkit.conformance.faults import mutants
from dexkit.conformance.faults.matrix import in_processes
from dexkit.conformance.faults.trials import cost
from dexkit.conformance.kit.recording import detect_dialect
from dexkit.errors import UsageError
from dexkit.traces import open_trace
from dexkit.traces.samples import SAMPLES, sample_path
from tools.pins.keys import recording_key, sample_key, verdict_keys
from tools.pins.pinned import Pins, blamed_of, figures_of
from tools.pins.trial import Done, Task, known, work
from tools.pins.verdicts import Verdicts

__all__ = ["found_pins", "tasks", "tried"]

_LAYERS = {"client": ("client", "dds")}
"""The layers that a recording of a layer is judged by, if more than that one."""
_OF_SAMPLE = ("client", "dds", "usb")


def tasks(folder: Path, only: Collection[str] = ()) -> list[Task]:
    """A task for each wrong hand and each sample.

    :param only: parts of the names, or patterns with ``*``, of those that are wanted; none for all.
    :raises UsageError: one of them fits no name.
    """
    hands = {m.pin: m for m in mutants()}
    chosen = _chosen([*hands, *SAMPLES], only)
    found = []
    for name in chosen:
        if name in hands:
            m = hands[name]
            keys = verdict_keys(m.model, _LAYERS.get(m.layer, (m.layer,)))
            found.append(Task(name, m.key, recording_key(m), keys, folder, cost(m)))
        else:
            path = sample_path(name)
            keys = verdict_keys(detect_dialect(open_trace(path)).model, _OF_SAMPLE)
            found.append(Task(name, None, sample_key(path), keys, folder))
    return found


def _chosen(names: Sequence[str], only: Collection[str]) -> list[str]:
    wanted: set[str] = set()
    for text in only:
        # with hyphens, as the names of tests
        fits = [
            n
            for n in names
            if fnmatch.fnmatchcase(n.replace(" ", "-"), f"*{text}*".replace(" ", "-"))
        ]
        if not fits:
            raise UsageError(
                f"no wrong hand and no sample is called {text!r}",
                hint="'python -m dexkit.conformance.faults --list' and 'dexkit samples' name them",
            )
        wanted.update(fits)
    return [name for name in names if name in wanted or not only]


def tried(
    given: Sequence[Task], stop: object = None, jobs: int | None = None
) -> Iterator[tuple[Task, Done]]:
    """Each task with what was done for it; first those whose verdicts are known.

    :param stop: ends it early when it becomes true.
    :param jobs: processes; one per processor by default.
    """
    left = []
    for task in given:
        verdicts = known(task)
        if len(verdicts) == len(task.verdicts):
            yield task, Done(verdicts)
        else:
            left.append(task)
    if left and not stop:
        yield from in_processes(work, sorted(left, key=lambda t: -t.cost), stop, jobs)


def found_pins(given: Sequence[Task], verdicts: dict[str, Verdicts]) -> Pins:
    """The pins that those verdicts make, in the order of the tasks."""
    found = Pins()
    for task in given:
        if task.mutant is None:
            found.samples[task.name] = figures_of(verdicts[task.name])
        else:
            found.hands[task.name] = blamed_of(verdicts[task.name])
    return found
