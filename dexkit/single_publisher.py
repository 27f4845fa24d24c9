"""Single publisher of a topic: of several programs that would publish it, exactly one goes on.

Two services of one side would mix the states of two hands on one topic; two sources of commands
would alternate on one hand. A program that must be alone on its topics uses a
:class:`SolePublisher`:

1. *search*: for :data:`LOOK` seconds it searches for other publishers. If there is one, it stops.
2. *settle*: it announces its writers with a claim (the time, and a random number) in their user
   data, and looks for :data:`SETTLE` seconds more. Of programs that announced at the same time the
   one with the smallest claim goes on and the others give way. A publisher without a claim (the
   vendor's) was not asked, so this program gives way.
3. *run*: what is discovered late is judged by the same order: the smaller claim stays. A publisher
   without a claim that comes later is told of, and only a program that ``yields`` gives way to it.

The order is the same for all who see it. So of any number that start at once, whatever the delays
of discovery, exactly one remains: the one with the smallest claim of all that were announced.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from dexkit.errors import TopicConflict

__all__ = ["LOOK", "SETTLE", "Claim", "Place", "SolePublisher"]

log = logging.getLogger("dexkit.single_publisher")

LOOK = 0.3
"""Seconds to look for others before the own writers are announced: participants find each other
within some tens of milliseconds on one machine."""
SETTLE = 0.15
"""Seconds from the announcement to the first sample: others have heard of it by then, for they
know the participant already. What is heard later is judged later."""

_MOST_SAID = 20  # warnings; the counter goes on
_PATTERN = re.compile(rb"dexkit-claim 1 ([0-9]{1,20}) ([0-9a-f]{16})")


@dataclass(frozen=True, order=True)
class Claim:
    """What a writer announces of itself; the smaller one stays.

    :param since: when it was announced, wall clock, ns. A wrong clock makes another one win, not
        two.
    :param token: random, so that no two are the same.
    """

    since: int
    token: int

    @classmethod
    def now(cls) -> Claim:
        """A new one."""
        return cls(time.time_ns(), secrets.randbits(64))

    def encode(self) -> bytes:
        """As a writer's user data."""
        return b"dexkit-claim 1 %d %016x" % (self.since, self.token)

    @classmethod
    def decode(cls, data: bytes) -> Claim | None:
        """Of another writer's user data; None where it has none."""
        found = _PATTERN.fullmatch(data)
        return cls(int(found[1]), int(found[2], 16)) if found else None


@dataclass(frozen=True)
class Place:
    """Topics on a node.

    :param node: a :class:`dexkit.dds.DdsNode`; one without ``discovery`` is only asked for its
        endpoints.
    :param counts: which writers without a claim are rivals; by default all.
    """

    node: Any
    topics: Collection[str]
    counts: Callable[[Any], bool] = lambda endpoint: True


class _Phase(Enum):
    LOOK = 0
    SETTLE = 1
    RUN = 2


class SolePublisher:
    """One program's claim to its topics.

    :param places: all topics that it is to be alone on.
    :param verb: what others do there, for messages: "publishes", "commands".
    :param hint: of the error.
    :param force: never give way, only tell.
    :param yields: give way also to publishers without a claim that come later.

    :ivar rivals: other publishers seen since it runs, beside which it went on.
    :ivar lost: it was told to give way.
    :ivar stirred: something has been discovered since the last :meth:`check`.
    """

    def __init__(
        self,
        places: Sequence[Place],
        *,
        hint: str,
        verb: str = "publishes",
        force: bool = False,
        yields: bool = False,
    ) -> None:
        self._places = list(places)
        self._verb, self._hint = verb, hint
        self._force, self._yields = force, yields
        self._phase = _Phase.LOOK
        self._claim: Claim | None = None
        self._told: set[str] = set()
        self._said: set[str] = set()
        self._unsubscribe: list[Callable[[], None]] = []
        self.rivals = 0
        self.lost = False
        self.stirred = False

    # -- life

    def search(self) -> None:
        """Look for other publishers, before the own writers are made.

        :raises TopicConflict: somebody else publishes there.
        """
        self._wait(LOOK)

    def announce(self) -> bytes:
        """User data for the own writers: the claim, made at the first call."""
        if self._claim is None:
            self._claim = Claim.now()
            self._phase = _Phase.SETTLE
        return self._claim.encode()

    def settle(self, wake: Callable[[], object] = lambda: None) -> None:
        """After the own writers were made, before the first sample.

        :param wake: called, in a thread that must not be kept, when :meth:`poll` should be.
        :raises TopicConflict: somebody else announced itself first.
        """
        self._wait(SETTLE)
        self.begin(wake)

    def begin(self, wake: Callable[[], object] = lambda: None) -> None:
        """End of :meth:`settle`: from now on :meth:`poll` judges what is discovered."""
        self._phase = _Phase.RUN
        for place in self._places:
            discovery = getattr(place.node, "discovery", None)
            if discovery is not None:
                self._unsubscribe.append(
                    discovery.subscribe(lambda event, place=place: self._stir(event, place, wake))
                )
        self.stirred = True

    def poll(self) -> None:
        """Call it often: costs nothing unless something was discovered. Raises as :meth:`check`."""
        if self.stirred:
            self.check()

    def check(self) -> None:
        """Judge all publishers that are known now, by the rules of the phase.

        :raises TopicConflict: this program must give way.
        """
        self.stirred = False
        present: set[str] = set()
        for place, other in self._others():
            if self._gives_way_to(other) and not self._force:
                self.lost = True
                raise TopicConflict(self._sentence(place, other), hint=self._hint)
            if self._phase is not _Phase.RUN:
                continue
            present.add(other.key)
            if other.key not in self._told:
                self.rivals += 1
                text = self._sentence(place, other)
                if text not in self._said and len(self._said) < _MOST_SAID:
                    self._said.add(text)
                    log.warning("%s; the two fight", text)
        self._told = present

    def close(self) -> None:
        """Watch no longer. May be called twice."""
        while self._unsubscribe:
            self._unsubscribe.pop()()

    # -- details

    def company(self) -> str | None:
        """Who else publishes there now, in a sentence; None: nobody."""
        return next((self._sentence(*found) for found in self._others()), None)

    def _sentence(self, place: Place, other: Any) -> str:
        who = other.process or "somebody"
        domain = getattr(place.node, "domain", None)
        where = "" if domain is None else f" on domain {domain}"
        if self._phase is _Phase.RUN:
            return f"{who} {self._verb} {other.topic}{where}, too"
        return f"{who} already {self._verb} {other.topic}{where}"

    def _others(self) -> Iterable[tuple[Place, Any]]:
        for place in self._places:
            for e in place.node.endpoints():
                if e.kind != "writer" or e.own or e.topic not in place.topics:
                    continue
                claim = Claim.decode(e.user_data)
                if place.counts(e) if claim is None else claim != self._claim:
                    yield place, e

    def _gives_way_to(self, other: Any) -> bool:
        if self._phase is _Phase.LOOK:
            return True
        claim = Claim.decode(other.user_data)
        if claim is None:
            return self._phase is _Phase.SETTLE or self._yields
        assert self._claim is not None
        return claim < self._claim

    def _stir(self, event: Any, place: Place, wake: Callable[[], object]) -> None:
        endpoint = event.endpoint
        if event.appeared and not endpoint.own and endpoint.topic in place.topics:
            self.stirred = True
            wake()

    def _wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        for node in {id(place.node): place.node for place in self._places}.values():
            discovery = getattr(node, "discovery", None)
            if discovery is not None and not self._force:
                discovery.wait(lambda _: self._must_go(), max(0.0, end - time.monotonic()))
        self.check()

    def _must_go(self) -> bool:
        return any(self._gives_way_to(other) for _, other in self._others())
