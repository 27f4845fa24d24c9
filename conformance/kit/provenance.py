"""What a recording can hold, by where it comes from. What it cannot hold is not judged.

A check says what it rests on (:func:`~dexkit.conformance.checks.check`); a source, as data, what
it carries:

* a recorder of messages carries all that a message has, and the times of messages;
* an import of frames (an episode, a data set) carries the positions that the source has, and
  nothing that it writes itself: a frame has no time of the message that it was taken from;
* a file without source timestamps (a ROS 2 bag) has the times of reception in their place;
* a recording of chosen topics says nothing of the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from dexkit.traces.names import CUT, RECORDER, select_topics
from dexkit.traces.sessions.imported import RECORD as IMPORTED
from dexkit.traces.sessions.imported import absent_fields

__all__ = ["STATES", "TIMES", "Provenance"]

TIMES = "times"
"""What a check rests on that compares the times of messages, or speeds by them."""

STATES = "states"
"""What a check of the client rests on that compares its commands with the states."""

_POSITIONS = ("q", "dq", "tau")
_TOLD = {TIMES: "times of its messages"}


@dataclass(frozen=True)
class Provenance:
    """What a recording can hold.

    :param framed: by topic, what its messages have from frames; all else in them was filled in.
    :param chosen: lists of the topics that were asked for, patterns; each leaves out all others.
    """

    framed: Mapping[str, frozenset[str]] = field(default_factory=dict)
    chosen: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> Provenance:
        """Of a recording with these metadata records."""
        absent = absent_fields(metadata.get(IMPORTED, {}))
        framed = {
            # where both hands share the topic, what one of them lacks is lacking
            topic: frozenset(_POSITIONS) - {name.rpartition(".")[2] for name in names}
            for topic, names in absent.items()
        }
        lists = [metadata.get(name, {}).get("topics", "all") for name in (RECORDER, CUT)]
        return cls(framed, tuple(tuple(t.split()) for t in lists if t != "all"))

    def lacking(self, topic: str, rests_on: Iterable[str]) -> str:
        """Why a check that rests on this cannot judge the topic; empty if it can."""
        given = self.framed.get(topic)
        missing = [r for r in rests_on if given is not None and r not in (*given, STATES)]
        if not missing:
            return ""
        what = " and ".join(_TOLD.get(m, m) for m in missing)
        return f"{topic} was imported from frames, which have no {what}"

    def leaves_out(self, topic: str) -> bool:
        """Whether the topic was not asked for when the recording was made."""
        return any(select_topics([topic], wanted)[0] == [] for wanted in self.chosen)
