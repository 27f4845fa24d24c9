"""What a recording can hold, by where it comes from. What it cannot hold is not judged.

A check says what it rests on (:func:`~dexkit.conformance.checks.check`); a source, as data, what
it carries (:mod:`dexkit.traces.sessions.carried`):

* a recorder of messages carries all that a message has, and the times of messages;
* an import of frames (an episode, a data set) carries the fields of joints that the source has,
  and nothing that it writes itself: a frame has no time of the message that it was taken from;
* a file without source timestamps (a ROS 2 bag) has the times of reception in their place;
* a recording of chosen topics says nothing of the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from dexkit.topics import roles
from dexkit.traces.names import CUT, RECORDER, select_topics
from dexkit.traces.sessions.carried import format_of
from dexkit.traces.sessions.imported import NOMINAL, absent_of, import_records
from dexkit.traces.sessions.streams import COMMAND, STATE

__all__ = ["MESSAGES", "STATES", "TIMES", "Frames", "Provenance"]

TIMES = "times"
"""What a check rests on that compares the times of messages, or speeds by them."""

MESSAGES = "messages"
"""What a check rests on that judges the messages themselves: their type, and how many motors they
have, and that their numbers are finite. Those of an import are the importer's."""

STATES = "states"
"""What a check of the client rests on that compares its commands with the states."""

_TOLD = {
    TIMES: "times of its messages",
    MESSAGES: "messages as they were sent",
    "kp": "gains",
    "mode": "mode bytes",
}


@dataclass(frozen=True)
class Frames:
    """The frames from which the messages of a topic were made.

    :param form: the format, with its version.
    :param fields: what they have; all else in the messages was filled in.
    """

    form: str
    fields: frozenset[str]


@dataclass(frozen=True)
class Provenance:
    """What a recording can hold.

    :param framed: by topic, what its messages were made from, where that is frames.
    :param chosen: lists of the topics that were asked for, patterns; each leaves out all others.
    :param nominal: nobody measured when its frames were; times are their number by a rate.
    """

    framed: Mapping[str, Frames] = field(default_factory=dict)
    chosen: tuple[tuple[str, ...], ...] = ()
    nominal: bool = False

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> Provenance:
        """Of a recording with these metadata records."""
        framed: dict[str, Frames] = {}
        imports = import_records(metadata)
        for record in imports:
            form = record.get("format", "frames")
            for topic, absent in absent_of(record).items():
                kind = COMMAND if any(r.kind == "cmd" for r in roles(topic)) else STATE
                # where both hands share the topic, what one of them lacks is lacking
                lacking = {name.rpartition(".")[2] for name in absent}
                there = frozenset(format_of(form).fields[kind]) - lacking
                if topic in framed:  # merged of several imports
                    there &= framed[topic].fields
                framed[topic] = Frames(form, there)
        lists = [metadata.get(name, {}).get("topics", "all") for name in (RECORDER, CUT)]
        return cls(
            framed,
            tuple(tuple(t.split()) for t in lists if t != "all"),
            any(record.get("clock") == NOMINAL for record in imports),
        )

    def lacking(self, topic: str, rests_on: Iterable[str]) -> str:
        """Why a check that rests on this cannot judge the topic; empty if it can."""
        frames = self.framed.get(topic)
        if frames is None:
            return ""
        missing = [r for r in rests_on if r not in (*frames.fields, STATES)]
        if not missing:
            return ""
        what = " and ".join(_TOLD.get(m, m) for m in missing)
        return f"{topic} was imported from {frames.form}, whose frames have no {what}"

    def note(self) -> str:
        """A remark on a recording that was made from frames; empty otherwise."""
        forms = sorted({frames.form for frames in self.framed.values()})
        if not forms:
            return ""
        times = "; its times are frame numbers by a rate that nobody measured" * self.nominal
        return (
            f"an imported session: its messages were made from frames ({', '.join(forms)}), and "
            f"what these do not have is not judged{times}"
        )

    def leaves_out(self, topic: str) -> bool:
        """Whether the topic was not asked for when the recording was made."""
        return any(select_topics([topic], wanted)[0] == [] for wanted in self.chosen)
