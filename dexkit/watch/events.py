"""Find changes from one picture to the next, for people and logs, without I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from dexkit.watch.collector import Collector, Picture, SubjectView, TopicView
from dexkit.watch.number_format import seconds, subject_name

__all__ = ["Event", "Events"]

_KEPT = 500


@dataclass(frozen=True)
class Event:
    """Something that happened.

    :param at: seconds since the first sample.
    :param kind: ``info``, ``warn`` or ``bad``.
    """

    at: float
    kind: str
    text: str


@dataclass
class _Known:
    """The last reported condition of a hand or robot."""

    faults: frozenset[str] = frozenset()
    stale: bool = True
    seen: bool = False
    commanded: bool = False


class Events:
    """Compares each picture with the one before: faults, silence, gaps, publishers.

    :ivar recent: the last events, oldest first.
    """

    def __init__(self, collector: Collector) -> None:
        self.recent: deque[Event] = deque(maxlen=_KEPT)
        self._collector = collector
        self._subjects: dict[str, _Known] = {}
        self._publishers: dict[str, tuple[str, ...]] = {}
        self._counted: dict[str, tuple[int, int, int]] = {}

    def update(self, picture: Picture) -> list[Event]:
        """Events since the last call, which are also kept in :attr:`recent`."""
        found = [
            Event(picture.at, kind, text)
            for view in picture.topics
            for kind, text in self._topic(view)
        ] + [
            Event(picture.at, kind, text)
            for view in picture.subjects
            for kind, text in self._subject(view)
        ]
        self.recent.extend(found)
        return found

    def _topic(self, view: TopicView) -> Iterator[tuple[str, str]]:
        before = self._publishers.get(view.name)
        self._publishers[view.name] = view.publishers
        if before is None and view.publishers:
            yield "info", f"{view.name}: published by {_names(view.publishers)}"
        elif before is not None and before != view.publishers:
            if not view.publishers:
                yield "warn", f"{view.name}: nobody publishes it any more"
            else:
                kind = "warn" if len(view.publishers) > 1 else "info"
                yield kind, f"{view.name}: published by {_names(view.publishers)}"
        key = f"{view.name} {view.type_name}"
        gaps, missed, bad = self._counted.get(key, (0, 0, 0))
        self._counted[key] = (view.gaps, view.missed, view.undecodable)
        if view.gaps > gaps:
            times = "a gap" if view.gaps == gaps + 1 else f"{view.gaps - gaps} gaps"
            longest = max((g[1] for g in self._collector.gaps(view.name)[gaps - view.gaps :]),
                          default=view.longest)  # fmt: skip
            yield (
                "warn",
                (
                    f"{view.name}: {times} of up to {seconds(longest)}, "
                    f"{view.missed - missed} cycles missed"
                ),
            )
        if view.undecodable > bad:
            yield "bad", f"{view.name}: {view.undecodable - bad} messages cannot be decoded"

    def _subject(self, view: SubjectView) -> Iterator[tuple[str, str]]:
        name = subject_name(view)
        known = self._subjects.setdefault(f"{view.prefix} {view.dialect} {view.subject}", _Known())
        if not view.stale and known.stale:
            yield "info", f"{name}: states {'again' if known.seen else 'come'}"
            known.seen = True
        elif view.stale and not known.stale:
            yield "bad", f"{name}: no state for {seconds(view.age)}"
        known.stale = view.stale
        faults = frozenset(view.faults)
        for text in sorted(faults - known.faults):
            yield "bad", f"{name}: {text}"
        for text in sorted(known.faults - faults):
            yield "info", f"{name}: {text} is over"
        known.faults = faults
        commanded = view.command_age <= view.command_timeout
        if commanded and not known.commanded:
            who = f"commanded by {_names(view.commanders)}" if view.commanders else "commands come"
            yield "info", f"{name}: {who}"
        elif known.commanded and not commanded:
            yield "info", f"{name}: no command for {seconds(view.command_age)}"
        known.commanded = commanded


def _names(processes: tuple[str, ...]) -> str:
    known = sorted({p for p in processes if p != "?"})
    unknown = sum(p == "?" for p in processes)
    if unknown:
        known.append("a process without a name" if unknown == 1 else f"{unknown} without a name")
    return ", ".join(known)
