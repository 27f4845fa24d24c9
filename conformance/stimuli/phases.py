"""The phases of scripts, and their order.

A phase is a function of a script, which yields actions as the script does. It stands beside the
checks that judge by it, in a module of :mod:`dexkit.conformance.behaviours`, and says what comes
before it, where it begins and where it leaves the hand; see :func:`stimulus`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar

from dexkit.conformance.behaviours import CHECKS
from dexkit.conformance.kit.phased_script import PhasedScript

__all__ = ["Moment", "Part", "Place", "parts_of", "stimulus"]

AnyScript = PhasedScript[Any, Any, Any]
Play = Generator[Any, Any, None]
PlayT = TypeVar("PlayT", bound=Callable[[Any], Play])


class Moment(Enum):
    """When a phase is played."""

    ROUND = "after the first motion, once in each round"
    CLIENTS = "after the rounds: an operator, and other clients"
    NEW_CLIENT = "when a new client has made its first steps"
    SERVICE = "at the end, with the hands' services"
    STOPPING = "before the services are asked to end"
    STARTED = "when a hand has made its first steps after a restart of its service"
    NOT_STARTED = "at the end, where the kit cannot start the services"


class Place(Enum):
    """Where hands are before or after a part of a script."""

    HOME = "where any part can begin"
    AWAY = "elsewhere: they are moved back before a part that does not begin just anywhere"
    ANY = "wherever they are"


@dataclass(frozen=True)
class Part:
    """A part of a script: a phase, or some that follow from one another.

    :param phases: their names; it is played in a run that needs any of them, and asks the plan for
        the others. None: in every run.
    :param kind: the scripts that it is a part of.
    :param play: its steps.
    :param after: names of phases that come before it where a run has both.
    :param before: the same of phases that come after it.
    :param needs: where it begins: ``HOME`` or ``ANY``.
    :param leaves: where it leaves the hand: ``ANY`` is where it was.
    :param applies: whether it is about a plan's hands.
    """

    phases: frozenset[str]
    kind: type[AnyScript]
    play: Callable[[Any], Play]
    after: frozenset[str]
    before: frozenset[str]
    moment: Moment
    needs: Place
    leaves: Place
    applies: Callable[[Any], bool]

    def wanted(self, plan: Any) -> bool:
        """Whether a run with this plan has it."""
        return self.applies(plan) and (not self.phases or bool(self.phases & plan.phases))


_PARTS: list[Part] = []
"""The parts of all scripts, of those modules that have been imported."""


def stimulus(
    names: str,
    kind: Callable[..., AnyScript],
    *,
    after: str = "",
    before: str = "",
    moment: Moment = Moment.ROUND,
    needs: Place = Place.HOME,
    leaves: Place = Place.HOME,
    applies: Callable[[Any], bool] = lambda plan: True,
) -> Callable[[PlayT], PlayT]:
    """Make the decorated function a part of the scripts of a kind; see :class:`Part`.

    :param kind: their class, which may be abstract.
    :param names: of phases, with blanks between them; ``after`` and ``before`` likewise.
    """

    def register(play: PlayT) -> PlayT:
        lists = [frozenset(text.split()) for text in (names, after, before)]
        options = (moment, needs, leaves, applies)
        assert isinstance(kind, type)
        _PARTS.append(Part(lists[0], kind, play, lists[1], lists[2], *options))
        return play

    return register


@cache
def parts_of(script: type[AnyScript]) -> tuple[Part, ...]:
    """The parts of a script, in their order: each as soon as all that come before it are done."""
    for module in CHECKS:
        importlib.import_module(module)
    left = sorted(
        (part for part in _PARTS if issubclass(script, part.kind)),
        key=lambda part: (part.play.__module__, part.play.__qualname__),
    )
    found: list[Part] = []
    while left:
        free = [p for p in left if not any(_precedes(q, p) for q in left if q is not p)]
        assert free, f"{script.__name__}: phases that come before one another"
        found.append(free[0])
        left.remove(free[0])
    return tuple(found)


def _precedes(first: Part, then: Part) -> bool:
    """Whether the order of these is given, and so."""
    given = first.phases & then.after or first.before & then.phases
    return first.moment is then.moment and bool(given)
