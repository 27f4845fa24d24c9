"""On which DDS domains hands and robots are, for commands that were not told one.

A device is served on domain 0, a simulated hand on 1. A command that only listens goes where
something is; one that publishes keeps to its default, and says where a hand is instead.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from dexkit.doctor.awaited_topics import AWAITED
from dexkit.doctor.dds import observe_domains
from dexkit.errors import DdsSetupError
from dexkit.threads import Worker
from dexkit.topics import roles, split_prefix

if TYPE_CHECKING:
    from dexkit.dds import DdsNode

__all__ = ["DEFAULT_DOMAIN", "HandsElsewhere", "elsewhere_hint", "listening_domain", "states_on"]

DEFAULT_DOMAIN = 1
"""Of simulations (docs/sources/unitree-dex.md, conflict 25)."""


class _Endpoint(Protocol):
    """What an endpoint of the observer and of a node have in common."""

    @property
    def topic(self) -> str: ...
    @property
    def type_name(self) -> str: ...


_CUSTOMARY = (0, 1)
_NAMED = 3  # topics in a message
_PATIENCE = 3.0  # seconds of silence before a look at the other domains, and between two looks


def states_on(domains: Sequence[int], interface: str) -> dict[int, tuple[str, ...]]:
    """State topics of hands and robots that somebody publishes, by domain; without the empty ones.

    Takes 0.7 s, and writes no topic.

    :raises DdsSetupError: the interface is not there or has no address.
    """
    from dexkit.interface_names import named_peers

    views = observe_domains(domains, (interface,), seconds=0.0, peers=named_peers())
    found = {}
    for view in views:
        topics = {e.topic for e in view.endpoints if e.kind == "writer" and _is_state(e)}
        if topics:
            found[view.number] = tuple(sorted(topics))
    return found


def _is_state(endpoint: _Endpoint) -> bool:
    """Whether an endpoint's topic is the state of a hand or robot."""
    topic, type_name = endpoint.topic, endpoint.type_name
    return topic in AWAITED or any(
        r.kind != "cmd" for r in roles(split_prefix(topic)[1], type_name)
    )


def listening_domain(domain: int | None, interface: str) -> tuple[int, str]:
    """The domain that a listener uses, and a remark on the choice.

    :param domain: as asked for; None looks at the robot's and the simulation's.
    """
    if domain is not None:
        return domain, ""
    found = states_on(_CUSTOMARY, interface)
    if not found:
        return DEFAULT_DOMAIN, (
            f"no hand or robot is on domain 0 or 1, {interface}, yet; --domain chooses another "
            f"than {DEFAULT_DOMAIN}"
        )
    chosen = DEFAULT_DOMAIN if DEFAULT_DOMAIN in found else min(found)
    rest = {number: topics for number, topics in found.items() if number != chosen}
    return chosen, _described(rest)


def _described(found: dict[int, tuple[str, ...]]) -> str:
    """Where hands are, and the option for it; empty where there are none."""
    if not found:
        return ""
    number, topics = next(iter(sorted(found.items())))
    more = f" and {len(topics) - _NAMED} more" if len(topics) > _NAMED else ""
    return f"{', '.join(topics[:_NAMED])}{more} on domain {number}: --domain {number}"


def elsewhere_hint(node: DdsNode) -> str:
    """The hands of the other customary domain, as the hint of an error.

    Empty where there are none, or the node sees one itself: then the domain is right.
    """
    if any(e.kind == "writer" and not e.own and _is_state(e) for e in node.endpoints()):
        return ""
    found = HandsElsewhere(node.domain, node.interface).now()
    return f"there is {found}" if found else ""


class HandsElsewhere:
    """Looks at the other customary domain, in the background, while nothing comes on this one.

    :ivar found: where a hand is and the option for it, once there is one; else empty.
    """

    def __init__(self, domain: int, interface: str) -> None:
        self._others = tuple(d for d in _CUSTOMARY if d != domain)
        self._interface = interface
        self._looking: Worker | None = None
        self._next = time.monotonic() + _PATIENCE
        self._told = False
        self.found = ""

    def look(self) -> str:
        """Report that nothing has come yet; returns :attr:`found` once, as soon as it is known."""
        if self.found:
            told, self._told = self._told, True
            return "" if told else self.found
        busy = self._looking is not None and self._looking.is_alive()
        if not busy and time.monotonic() >= self._next:
            self._next = time.monotonic() + _PATIENCE
            self._looking = Worker("hands elsewhere", self._look)
            self._looking.start()
        return ""

    def now(self) -> str:
        """Look at once, and return :attr:`found`."""
        if not self.found:
            self._look()
        return self.found

    def _look(self) -> None:
        try:
            self.found = _described(states_on(self._others, self._interface))
        except DdsSetupError:  # the interface went; who listens on it says so
            return
