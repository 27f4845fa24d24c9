"""What each format has room for. The import and the judge of a recording both go by this table.

What the import of a format fills in is in no source, so it is never judged
(:mod:`dexkit.conformance.kit.provenance`). A single file may have less than its format has room
for: the import lists that by topic (:func:`~dexkit.traces.sessions.imported.absent_fields`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from dexkit.traces.sessions.streams import COMMAND, FIELDS, STATE

__all__ = ["FORMATS", "Format", "Times", "format_of"]


class Times(str, Enum):
    """Which times a format has."""

    SENT = "of sending and of reception of each message"
    RECEIVED = "of reception of each message"
    FRAMES = "of the frames, if the writer adds them"
    NONE = "none, only a rate for all topics"


@dataclass(frozen=True)
class Format:
    """What a format has room for.

    :param fields: by kind, those of :data:`~dexkit.traces.sessions.streams.FIELDS` of a joint.
    :param whole: its messages are those that were sent, with their type, mode bytes, gains,
        temperatures, pressures and all else, at their own rate for each topic. Frames have joints
        at one rate for all.
    :param beside: what it has beside the joints, which is not put into the messages of a hand.
    """

    fields: Mapping[str, tuple[str, ...]]
    times: Times
    whole: bool = False
    beside: tuple[str, ...] = ()


_FRAMES = {STATE: ("q", "dq", "tau"), COMMAND: ("q", "dq", "tau")}

FORMATS: Mapping[str, Format] = {
    "recording": Format(FIELDS, Times.SENT, whole=True),
    "tables": Format(FIELDS, Times.SENT, whole=True),
    "ROS 2 bag": Format(FIELDS, Times.RECEIVED, whole=True),
    "xr_teleoperate": Format(_FRAMES, Times.FRAMES, beside=("touch", "pictures", "audio", "task")),
    "JSON lines": Format(_FRAMES, Times.FRAMES, beside=("touch", "pictures", "audio", "task")),
    "LeRobot": Format(
        {STATE: ("q", "dq", "tau"), COMMAND: ("q",)},
        Times.NONE,
        beside=("touch", "pictures", "task"),
    ),
}
"""The formats, by the word that their name in the metadata of an import begins with."""


def format_of(name: str) -> Format:
    """The format of that name, with or without its version.

    One that is not known, of a later version of dexkit, has room for what frames can have.
    """
    found = (each for word, each in FORMATS.items() if name.startswith(word))
    return next(found, Format(_FRAMES, Times.FRAMES))
