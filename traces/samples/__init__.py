"""Find the recordings that ship with dexkit, and their labels.

README.md in this folder says which parts are genuine and which simulated.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from dexkit.errors import UsageError

__all__ = ["SAMPLES", "SampleEvent", "SampleLabels", "sample_labels", "sample_path"]

_FOLDER = resources.files(__name__)
SAMPLES: tuple[str, ...] = tuple(
    sorted(f.name[:-5] for f in _FOLDER.iterdir() if f.name.endswith(".mcap"))
)
"""Names of the shipped recordings: those in this folder."""


@dataclass(frozen=True)
class SampleEvent:
    """A deliberate event during the recording."""

    wall_ns: int
    seconds_from_first_message: float
    side: str
    event: str


@dataclass(frozen=True)
class SampleLabels:
    """Labels of a recording that its contents do not give.

    :param first_message_ns: log time of the first message, ns since the epoch.
    :param operator_zero_ns: the earliest instant of the operator's motion, ns since the epoch.
    """

    first_message_ns: int
    operator_zero_ns: int
    events: tuple[SampleEvent, ...]


def _check(name: str) -> str:
    stem = name.removesuffix(".mcap")
    if stem not in SAMPLES:
        raise UsageError(f"no sample recording {name!r}", hint=f"there are: {', '.join(SAMPLES)}")
    return stem


def sample_path(name: str) -> Path:
    """The file of a shipped recording, in a checkout as in an installed package.

    :raises UsageError: there is none of that name.
    """
    return Path(str(_FOLDER / f"{_check(name)}.mcap"))


def sample_labels(name: str) -> SampleLabels:
    """Labels of a shipped recording.

    :raises UsageError: there is none of that name.
    """
    stem = _check(name)
    text = (_FOLDER / "labels.json").read_text(encoding="utf-8")
    entry = json.loads(text)[f"{stem}.mcap"]
    return SampleLabels(
        first_message_ns=entry["first_message_ns"],
        operator_zero_ns=entry["operator_zero_ns"],
        events=tuple(SampleEvent(**event) for event in entry["events"]),
    )
