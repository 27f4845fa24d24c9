"""Keep a topic to a single publisher: of several programs that start, exactly one goes on.

Two services of one side would mix the states of two hands on one topic; two sources of commands
would alternate on one hand. A program that must be alone on its topics uses a
:class:`SolePublisher`:

1. *search*: for :data:`SEARCH` seconds it searches for other publishers. If there is one, it stops.
2. *settle*: it announces its writers with a claim (the time, and a random number) in their user
   data, and looks for :data:`SETTLE` seconds more. Of programs that announced at the same time the
   one with the smallest claim goes on and the others give way. A publisher without a claim (the
   vendor's) was not asked, so this program gives way.
3. *run*: what is discovered late is judged by the same order: the smaller claim stays. A publisher
   without a claim that comes later is logged, and only a program that ``yields`` gives way to it.

The order is the same for all who see it. So of any number that start at once, whatever the delays
of discovery, exactly one remains: the one with the smallest claim of all that were announced.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from dexkit.errors import TopicConflict

__all__ = ["SEARCH", "SETTLE", "Claim", "NodeTopics", "SolePublisher"]

log = logging.getLogger("dexkit.single_publisher")

SEARCH = 0.3
"""Seconds to look for others before the own writers are announced: participants find each other
within some tens of milliseconds on one machine."""
SETTLE = 0.15
"""Seconds from the announcement to the first sample: others have discovered it by then, for
they know the participant already. What is discovered later is judged later."""

_MAX_WARNINGS = 20  # warnings; the counter goes on
_PATTERN = re.compile(rb"dexkit-claim 1 ([0-9]{1,20}) ([0-9a-f]{16})")


@dataclass(frozen=True, order=True)
class Claim:
    """Publisher claim, announced in a writer's USER_DATA; the publisher with the smaller one stays.

    :param since: when it was announced, wall clock, ns. A wrong clock makes another one win, not
        two.
    :param token: random, so that no two are the same.
    """

    since: int
    token: int

    @classmethod
    def now(cls) -> Claim:
        """A claim of the present time."""
        return cls(time.time_ns(), int.from_bytes(os.urandom(8), "big"))

    def encode(self) -> bytes:
        """The claim as a writer's USER_DATA."""
        return b"dexkit-claim 1 %d %016x" % (self.since, self.token)

    @classmethod
    def decode(cls, data: bytes) -> Claim | None:
        """The claim in another writer's USER_DATA; None where it has none."""
        found = _PATTERN.fullmatch(data)
        return cls(int(found[1]), int(found[2], 16)) if found else None


@dataclass(frozen=True)
class NodeTopics:
    """Topics of a DDS node that one program publishes alone.

    :param node: a :class:`dexkit.dds.DdsNode`; one without ``discovery`` is only asked for its
        endpoints.
    :param counts: which writers without a claim are rivals; by default all.
    """

    node: Any
    topics: Collection[str]
    counts: Callable[[Any], bool] = lambda endpoint: True


class _Phase(Enum):
    SEARCH = 0
    SETTLE = 1
    RUN = 2


class SolePublisher:
    """Makes sure that this program alone publishes its topics.

    :param node_topics: all topics that it is to be alone on.
    :param verb: what others do there, for messages: "publishes", "commands".
    :param hint: of the error.
    :param force: never give way, only log.
    :param yields: give way also to publishers without a claim that come later.

    :ivar rivals: other publishers seen since it runs, beside which it went on.
    :ivar lost: it has to give way.
    :ivar check_due: something has been discovered since the last :meth:`check`.
    """

    def __init__(
        self,
        node_topics: Sequence[NodeTopics],
        *,
        hint: str,
        verb: str = "publishes",
        force: bool = False,
        yields: bool = False,
    ) -> None:
        self._node_topics = list(node_topics)
        self._verb, self._hint = verb, hint
        self._force, self._yields = force, yields
        self._phase = _Phase.SEARCH
        self._heard = ""
        self._claim: Claim | None = None
        self._known_rivals: set[str] = set()
        self._logged: set[str] = set()
        self._unsubscribe: list[Callable[[], None]] = []
        self.rivals = 0
        self.lost = False
        self.check_due = False

    # -- start and stop

    def search(self, heard: Callable[[], str] = lambda: "") -> None:
        """Look for other publishers, before the own writers are made.

        :param heard: asked at the end: a topic on which samples of another program have arrived,
            or an empty text. Every writer of it counts then, and one that is not discovered, too.
        :raises TopicConflict: another program publishes there.
        """
        self._wait(SEARCH)
        if not self._force and (topic := heard()):
            self._heard = topic
            self.check()
            self.lost = True  # it has gone meanwhile, or is not discovered
            node = next(t.node for t in self._node_topics if topic in t.topics)
            raise TopicConflict(self._sentence("", topic, node), hint=self._hint)

    def announce(self) -> bytes:
        """User data for the own writers: the claim, made at the first call."""
        if self._claim is None:
            self._claim = Claim.now()
            self._phase = _Phase.SETTLE
        return self._claim.encode()

    def settle(self, wake: Callable[[], object] = lambda: None) -> None:
        """After the own writers were made, before the first sample.

        :param wake: called, in a thread that must not be kept, when :meth:`poll` should be.
        :raises TopicConflict: another program announced itself first.
        """
        self._wait(SETTLE)
        self.begin(wake)

    def begin(self, wake: Callable[[], object] = lambda: None) -> None:
        """End of :meth:`settle`: from now on :meth:`poll` judges discovered publishers."""
        self._phase = _Phase.RUN
        for topics in self._node_topics:
            discovery = getattr(topics.node, "discovery", None)
            if discovery is not None:
                self._unsubscribe.append(
                    discovery.subscribe(
                        lambda event, topics=topics: self._on_discovery(event, topics, wake)
                    )
                )
        self.check_due = True

    def poll(self) -> None:
        """Check if something was discovered, else do nothing. Raises as :meth:`check`."""
        if self.check_due:
            self.check()

    def check(self) -> None:
        """Judge all publishers that are known now, by the rules of the phase.

        :raises TopicConflict: this program must give way.
        """
        self.check_due = False
        present: set[str] = set()
        for topics, other in self._other_writers():
            if self._gives_way_to(other) and not self._force:
                self.lost = True
                raise TopicConflict(self._describe(topics, other), hint=self._hint)
            if self._phase is not _Phase.RUN:
                continue
            present.add(other.key)
            if other.key not in self._known_rivals:
                self.rivals += 1
                text = self._describe(topics, other)
                if text not in self._logged and len(self._logged) < _MAX_WARNINGS:
                    self._logged.add(text)
                    log.warning("%s; their samples mix", text)
        self._known_rivals = present

    def close(self) -> None:
        """Unsubscribe from discovery. May be called twice."""
        while self._unsubscribe:
            self._unsubscribe.pop()()

    # -- details

    def describe_rival(self) -> str | None:
        """Another publisher of one of the topics, as a sentence; None if there is none."""
        return next((self._describe(*found) for found in self._other_writers()), None)

    def _describe(self, topics: NodeTopics, other: Any) -> str:
        return self._sentence(other.process, other.topic, topics.node)

    def _sentence(self, process: str, topic: str, node: Any) -> str:
        who = process or "another program"
        domain = getattr(node, "domain", None)
        where = "" if domain is None else f" on domain {domain}"
        if self._phase is _Phase.RUN:
            return f"{who} {self._verb} {topic}{where}, too"
        return f"{who} already {self._verb} {topic}{where}"

    def _other_writers(self) -> Iterable[tuple[NodeTopics, Any]]:
        for topics in self._node_topics:
            for e in topics.node.endpoints():
                if e.kind != "writer" or e.own or e.topic not in topics.topics:
                    continue
                claim = Claim.decode(e.user_data)
                if claim is None:
                    counts = e.topic == self._heard or topics.counts(e)
                else:
                    counts = claim != self._claim
                if counts:
                    yield topics, e

    def _gives_way_to(self, other: Any) -> bool:
        if self._phase is _Phase.SEARCH:
            return True
        claim = Claim.decode(other.user_data)
        if claim is None:
            return self._phase is _Phase.SETTLE or self._yields
        assert self._claim is not None
        return claim < self._claim

    def _on_discovery(self, event: Any, topics: NodeTopics, wake: Callable[[], object]) -> None:
        endpoint = event.endpoint
        if event.appeared and not endpoint.own and endpoint.topic in topics.topics:
            self.check_due = True
            wake()

    def _wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        for node in {id(topics.node): topics.node for topics in self._node_topics}.values():
            discovery = getattr(node, "discovery", None)
            if discovery is not None and not self._force:
                discovery.wait(lambda _: self._must_give_way(), max(0.0, end - time.monotonic()))
        self.check()

    def _must_give_way(self) -> bool:
        return any(self._gives_way_to(other) for _, other in self._other_writers())
