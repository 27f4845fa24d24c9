"""The verdict on each episode of data sets: the file ``episodes.json`` that ``dexkit audit`` writes
and ``dexkit export --drop`` reads.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import msgspec

from dexkit import records
from dexkit.documents import read_json
from dexkit.traces.sessions.typed import Count

__all__ = ["FORMAT", "VERSION", "EpisodeVerdict", "EpisodeVerdicts", "read_verdicts"]

FORMAT, VERSION = "dexkit-episodes", 1


class EpisodeVerdict(msgspec.Struct):
    """What is to be done with an episode.

    :ivar source: the dataset, task folder or recording, as it was named to the audit.
    :ivar place: its absolute path, or a URL.
    :ivar episode: the number in a LeRobot dataset; of xr_teleoperate, the path of the episode's
        folder in the task folder, or empty.
    :ivar reasons: why, a sentence each.
    """

    source: str
    place: str
    episode: Count | str
    verdict: Literal["keep", "review", "drop"]
    reasons: list[str] = []

    @property
    def where(self) -> Path | None:
        """The dataset, or the folder of the episode, links resolved; None if it is not on this
        machine.
        """
        episode = self.episode if isinstance(self.episode, str) else "."
        try:
            if os.path.isabs(self.place) and not os.path.isabs(episode):
                return Path(os.path.realpath(os.path.join(self.place, episode)))
        except (OSError, ValueError):  # a loop of links, a null character
            pass
        return None


class EpisodeVerdicts(msgspec.Struct):
    """The file."""

    format: Literal["dexkit-episodes"]
    version: Literal[1]
    episodes: list[EpisodeVerdict]


def read_verdicts(path: Path) -> list[EpisodeVerdict]:
    """The verdicts in a file.

    :raises UsageError: it cannot be read, or is of another form.
    """
    hint = "'dexkit audit' writes this file"
    found = records.to_record(read_json(path, hint=hint), EpisodeVerdicts, path, hint=hint)
    return found.episodes
