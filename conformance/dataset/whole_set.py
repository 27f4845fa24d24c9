"""What the metadata of a dataset say of all of its episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dexkit.errors import SessionError
from dexkit.hand import Floats
from dexkit.traces.sessions.lerobot_in import Dataset

__all__ = ["WholeSet"]


@dataclass(frozen=True, eq=False)
class WholeSet:
    """A dataset as its metadata describe it.

    :param name: how its rows call it.
    :param form: the format with its version.
    :param episodes: numbers of those that are listed; ``refused`` could not be read.
    :param stated: statistics of all frames, by feature and name; empty without.
    :param problems: what could not be read, as sentences.
    """

    name: str
    form: str
    fps: float
    episodes: tuple[int, ...]
    refused: int = 0
    stated: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    @classmethod
    def of(cls, dataset: Dataset, name: str) -> WholeSet:
        """What an opened dataset says."""
        problems: tuple[str, ...] = ()
        stated: Mapping[str, Mapping[str, Floats]] = {}
        try:
            stated = dataset.statistics_of_all()
        except SessionError as error:
            problems = (error.message,)
        return cls(
            name,
            f"LeRobot {dataset.version}",
            dataset.fps,
            tuple(dataset.episodes),
            len(dataset.refused),
            stated,
            problems,
        )
