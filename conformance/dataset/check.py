"""What a check of an episode is: the data that it needs, and a function that looks at them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum

from dexkit.conformance.dataset.cameras import looked_at
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding

__all__ = ["Check", "Data", "Figure", "data_of"]


class Data(str, Enum):
    """What an episode can have, by its format."""

    STATE = "observed positions"
    ACTION = "commanded positions"
    VELOCITY = "observed velocities"
    TORQUE = "observed torques"
    TOUCH = "touch"
    STAMPS = "times of frames"
    TASK = "task texts"
    STATISTICS = "statistics"
    CAMERA = "cameras, with PyAV for videos and Pillow for pictures (the extra video)"


@dataclass(frozen=True)
class Figure:
    """Something that is measured in every episode, for the distributions of a set.

    :param name: with the unit: ``lag, s``.
    """

    name: str
    value: float


@dataclass(frozen=True)
class Check:
    """One check.

    :param name: by which findings call it: ``frozen``.
    :param title: what it looks for, for tables.
    :param needs: what an episode must have; without it the check is not judged and not counted.
    :param run: yields findings and figures; it must not change the episode.
    """

    name: str
    title: str
    needs: frozenset[Data]
    run: Callable[[Episode], Iterable[Finding | Figure]]


def data_of(episode: Episode) -> frozenset[Data]:
    """What an episode has. A format without task texts has none to miss."""
    tracks = episode.tracks
    there = {
        Data.STATE: any(t.state is not None for t in tracks),
        Data.ACTION: any(t.action is not None for t in tracks),
        Data.VELOCITY: any(t.dq is not None for t in tracks),
        Data.TORQUE: any(t.tau is not None for t in tracks),
        Data.TOUCH: any(t.touch is not None for t in tracks),
        Data.STAMPS: episode.stamps is not None or episode.measured,
        Data.TASK: episode.tasks is not None,
        Data.STATISTICS: bool(episode.stated),
        Data.CAMERA: bool(looked_at(episode)),
    }
    return frozenset(data for data, has in there.items() if has)
