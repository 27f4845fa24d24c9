"""Write data sets again without the episodes that are to be dropped: LeRobot datasets,
task folders of xr_teleoperate, and folders of these.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.errors import SessionError, UsageError
from dexkit.escaping import one_line
from dexkit.staging import whole_folder
from dexkit.traces.sessions.episodes import DATA, Options
from dexkit.traces.sessions.lerobot_cleaned import write_cleaned
from dexkit.traces.sessions.lerobot_in import Dataset, is_dataset
from dexkit.traces.sessions.plain_files import OF_DOWNLOADS, copy_file, plain_files
from dexkit.traces.sessions.verdicts import EpisodeVerdict

__all__ = ["Cleaned", "Dropped", "by_number", "by_verdict", "export_cleaned", "is_set"]

_NAMED = 10  # names in a message


@dataclass(frozen=True)
class Dropped:
    """An episode that is left out.

    :ivar episode: its number in the dataset, or its folder, as it is called below the source.
    """

    episode: str
    reasons: tuple[str, ...] = ()


@dataclass
class Cleaned:
    """Result of an export.

    :ivar kept: episodes that are in the copy.
    :ivar notes: what is as it should be.
    :ivar problems: what is missing, or wrong in the source.
    """

    kept: int = 0
    dropped: list[Dropped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


Place = tuple[Path, int]
"""An episode: its dataset and number, or its folder and -1."""


class _Sets:
    """The data sets in a folder.

    :raises SessionError: there is none, one cannot be read, or there is a link.
    """

    def __init__(self, source: Path) -> None:
        self.root = Path(os.path.realpath(source))
        self.datasets: dict[Path, Dataset] = {}
        self.folders: list[Path] = []
        for folder, names, files in os.walk(self.root):
            names.sort()
            place = Path(folder)
            if is_dataset(place):
                # its rate is not used, and may be missing
                self.datasets[place] = Dataset(place, Options(rate=1.0))
                names.clear()
            elif DATA in files:
                self.folders.append(place)
                names.clear()
        if not self.datasets and not self.folders:
            raise SessionError(
                f"{source} holds no LeRobot dataset and no episode of xr_teleoperate",
                hint="an episode has a data.json, a LeRobot dataset meta/info.json",
            )

    @property
    def episodes(self) -> list[Place]:
        """All episodes."""
        numbered = [(place, n) for place, d in self.datasets.items() for n in d.episodes]
        return numbered + [(folder, -1) for folder in self.folders]

    def name(self, place: Place) -> str:
        """What an episode is called."""
        folder, number = place
        path = folder.relative_to(self.root).as_posix()
        if number < 0:
            return folder.name if path == "." else path
        return str(number) if path == "." else f"{path}, episode {number}"

    def has(self, place: Place) -> bool:
        """Whether there is something of that name that can be left out: an episode, or what is no
        set and has none in it, such as a recording or a folder without its ``data.json``.
        """
        folder, number = place
        if number >= 0:
            return folder in self.datasets and number in self.datasets[folder].episodes
        sets = (*self.datasets, *self.folders)
        near = any(s.is_relative_to(folder) or folder.is_relative_to(s) for s in sets)
        return folder in self.folders or (folder.exists() and not near)


Choice = Mapping[Place, tuple[str, ...]]
"""The episodes that are dropped, with the reasons."""


def is_set(source: Path) -> bool:
    """Whether it is a dataset or an episode, or a folder of these at most two levels deep, and
    holds no recording.
    """
    if not source.is_dir() or any(source.glob("*.mcap")):
        return False
    places = (source, *source.glob("*/"), *source.glob("*/*/"))
    return any(is_dataset(place) or (place / DATA).is_file() for place in places)


def by_number(source: Path, numbers: Sequence[int]) -> Choice:
    """Choose episodes of a LeRobot dataset by their numbers."""
    root = Path(os.path.realpath(source))
    if not is_dataset(root):
        raise UsageError(
            f"{source} is no LeRobot dataset, whose episodes have numbers",
            hint="name the file of dexkit audit: --drop episodes.json",
        )
    return {(root, number): () for number in numbers}


def by_verdict(
    source: Path, origin: Path, verdicts: Sequence[EpisodeVerdict], also: Collection[str] = ()
) -> tuple[Choice, set[Place]]:
    """Choose the episodes to be dropped from a file of verdicts.

    :param origin: that file.
    :param also: verdicts to be dropped beside ``drop``.
    :returns: (the chosen ones, all episodes of the source that the file names).
    :raises UsageError: it names none of the source, or one twice.
    """
    root = Path(os.path.realpath(source))
    chosen: dict[Place, tuple[str, ...]] = {}
    named: dict[Place, str] = {}
    for verdict in verdicts:
        where = verdict.where
        if where is None or not where.is_relative_to(root):
            continue
        place = where, verdict.episode if isinstance(verdict.episode, int) else -1
        if named.setdefault(place, verdict.verdict) != verdict.verdict:
            what = f"{verdict.place}, episode {verdict.episode}"
            raise UsageError(f"{origin} has two verdicts on {one_line(what, 200)}")
        if verdict.verdict == "drop" or verdict.verdict in also:
            chosen[place] = tuple(verdict.reasons)
    if not named:
        others = list(dict.fromkeys(f"{v.source} ({v.place})" for v in verdicts))
        shown = ", ".join(one_line(text, 200) for text in others[:_NAMED]) or "nothing"
        raise UsageError(
            f"{origin} has no verdict on an episode of {source}",
            hint=f"it is about {shown}" + (" and others" if len(others) > _NAMED else ""),
        )
    return chosen, set(named)


def export_cleaned(
    source: Path, out: Path, choice: Choice, named: Collection[Place] | None = None
) -> Cleaned:
    """Write a data set, or a folder of these, without some episodes.

    :param named: the episodes that were judged; None for all.
    :raises ExtraMissing: pyarrow is not installed, and there is a LeRobot dataset.
    :raises UsageError: the source lacks an episode that was chosen or judged, or ``out`` is in it.
    :raises SessionError: no episode would be left, ``out`` exists or cannot be written, or the
        source cannot be read or has links in it.
    """
    sets = _Sets(source)
    if Path(os.path.realpath(out)).is_relative_to(sets.root):
        raise UsageError(f"{out} lies in {source}", hint="name a folder outside it")
    judged = {*choice, *(named or ())}
    if unknown := sorted(p for p in judged if not sets.has(p)):
        names = ", ".join(one_line(sets.name(p), 100) for p in unknown[:_NAMED])
        raise UsageError(
            f"{source} has no {'' if unknown[0][1] < 0 else 'episode '}{names}",
            hint=f"it has {len(sets.episodes)} episodes; has it changed since it was judged?",
        )
    known = {*sets.episodes}
    result = Cleaned(len((known | judged) - choice.keys()))
    if not known - choice.keys():
        raise SessionError(f"no episode of {source} would be left")
    result.dropped = [Dropped(sets.name(p), reasons) for p, reasons in sorted(choice.items())]
    if named is not None and (rest := len(known - judged)):
        result.notes.append(f"{rest} episodes that were not judged are kept")
    with whole_folder(out, error=SessionError) as new:
        new.mkdir()
        _write(sets, choice, new, result)
    return result


def _write(sets: _Sets, choice: Choice, new: Path, result: Cleaned) -> None:
    by_dataset: defaultdict[Path, set[int]] = defaultdict(set)
    for folder, number in choice:
        by_dataset[folder].add(number)
    for folder, dataset in sets.datasets.items():
        path = folder.relative_to(sets.root)
        if dataset.episodes and by_dataset[folder] >= {*dataset.episodes}:
            result.notes.append(f"{path}: no episode of it is left, and it is left out")
            continue
        remarks = write_cleaned(dataset, by_dataset[folder], new / path)
        about = "" if folder == sets.root else f"{path}: "
        result.notes += [f"{about}{text}" for text in remarks.notes]
        result.problems += [f"{about}{text}" for text in remarks.problems]
    if sets.root in sets.datasets:
        return
    gone = {place for place, number in choice if number < 0}
    without = {f.relative_to(sets.root).as_posix() for f in (*gone, *sets.datasets)}
    if skipped := sorted(name for name in OF_DOWNLOADS if (sets.root / name).is_dir()):
        result.notes.append(f"left out, as it is of the original: {', '.join(skipped)}")
    for name, is_folder in plain_files(sets.root, {*without, *OF_DOWNLOADS}):
        if is_folder:
            (new / name).mkdir(exist_ok=True)
        else:
            copy_file(sets.root / name, new / name)
    if any(folder in gone for folder in sets.folders):
        result.notes.append("the folders that are kept have their names, with gaps in the numbers")
