"""Give the verdicts on one wrong hand or sample: those that are known, and the others by trying."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from dexkit.conformance.faults.matrix import with_key
from dexkit.conformance.faults.trials import run_of
from dexkit.conformance.kit.results import Result
from dexkit.traces.samples import sample_path
from tools.pins.recordings import pack
from tools.pins.store import Store
from tools.pins.verdicts import Verdicts, judge_sample, verdicts_of

__all__ = ["Done", "Task", "known", "same_again", "work"]


@dataclass(frozen=True)
class Task:
    """What is to be judged.

    :param name: of the pin.
    :param mutant: key of the wrong hand; None for a sample, which the name is of.
    :param recording: key of the recording.
    :param verdicts: key of each requirement's verdicts.
    :param cost: roughly how long it takes, for the order.
    """

    name: str
    mutant: tuple[str, str, str] | None
    recording: str
    verdicts: Mapping[str, str]
    folder: Path
    cost: float = 1.0


@dataclass(frozen=True)
class Done:
    """What was done for a task.

    :param judged: how many requirements were judged.
    :param played: whether the recording was made.
    """

    verdicts: Verdicts
    judged: int = 0
    played: bool = False


def known(task: Task) -> Verdicts:
    """The verdicts that are known, by requirement."""
    kept = Store(task.folder).verdicts(task.recording)
    return {name: kept[key] for name, key in task.verdicts.items() if key in kept}


def work(task: Task) -> Done:
    """Judge what is not known, playing the wrong hand if there is no recording of it."""
    found = dict(known(task))
    missing = [name for name in task.verdicts if name not in found]
    if not missing:
        return Done(found)
    results, played = _judged(task, missing)
    found |= verdicts_of(results, missing)
    keys = task.verdicts
    Store(task.folder).keep_verdicts(task.recording, {keys[name]: v for name, v in found.items()})
    return Done(found, len(missing), played)


def _judged(task: Task, only: Collection[str]) -> tuple[list[Result], bool]:
    """Results of some requirements, and whether the recording was made for them."""
    if task.mutant is None:
        return judge_sample(sample_path(task.name), only), False
    mutant = with_key(task.mutant)
    run = run_of(mutant)
    store = Store(task.folder)
    trace = store.recording(task.recording)
    if trace is not None:
        return run.judge(trace, run.about, only), False
    made = run.play(run.made, run.about)
    store.keep_recording(task.recording, pack(made))
    return run.judge(made, run.about, only), True


def same_again(task: Task) -> bool | None:
    """Whether a wrong hand plays what its kept recording holds; None if there is none."""
    kept = Store(task.folder).packed(task.recording)
    if task.mutant is None or kept is None:
        return None
    mutant = with_key(task.mutant)
    run = run_of(mutant)
    return pack(run.play(run.made, run.about)) == kept
