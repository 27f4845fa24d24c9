"""Declare wrong hands.

A wrong hand is a small change of a reference that meets every requirement: of a service that
publishes hands on DDS, of a robot, of a USB device, or of a client that drives good hands. It is

* a function that is called in place of one method of the reference (:func:`changes`), or that
  changes the states which a hand publishes (:func:`reports`);
* a class with several changes, of a reference or of the mechanics of its hands
  (:func:`wrong_hand`).

Each names the requirement that must find the fault. It holds for every model whose catalogue has
that requirement, or one that is ``like`` it: the fault is mixed into the reference of each of them.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.layers import layer
from dexkit.conformance.virtual.dex5 import Dex5Hand, Dex5Service
from dexkit.conformance.virtual.fingers import (
    Dex3Hand,
    Dex3Service,
    FingerHand,
    FingerService,
    Ints,
)
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.conformance.virtual.inspire import FtpHand, FtpService
from dexkit.conformance.virtual.service import Service
from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.hand import Floats, Side, Subject
from dexkit.messages import message_type
from dexkit.models import HandModel, model

__all__ = [
    "BOTH",
    "DQ",
    "KD",
    "KP",
    "LEFT",
    "TAU",
    "Call",
    "Motors",
    "Mutant",
    "Q",
    "changes",
    "commands",
    "expand",
    "has_speeds",
    "mix",
    "obeys_gains",
    "reports",
    "takes_floats",
    "wrong_hand",
]

LEFT = (Side.LEFT,)
BOTH = (Side.LEFT, Side.RIGHT)

C = TypeVar("C", bound=type[Any])
Call: TypeAlias = Callable[..., Any]
Motors: TypeAlias = tuple[Motor, ...]
Q, DQ, TAU, KP, KD = range(5)
"""Rows of a command to several joints."""
_SERVICES: Mapping[type[Any], type[Service]] = {
    ReferenceHand: ReferenceService,
    FingerHand: FingerService,
    Dex3Hand: Dex3Service,
    Dex5Hand: Dex5Service,
    ServoHand: ServoService,
    FtpHand: FtpService,
}
"""By the mechanics of a hand, the service of such hands."""


@dataclass(frozen=True)
class Mutant:
    """One wrong hand, robot, USB device or client.

    :param layer: of its requirement, one of :data:`~dexkit.conformance.layers.LAYERS`.
    :param made: the reference of the model with the fault in it.
    :param kills: the requirement that must fail or warn.
    :param sides: the hands that are needed to see the fault.
    :param dialect: where the fault is in one dialect only; empty for the model's first.
    :param brief: apply only the phases that its requirements need.
    :param whole: never leave out phases: a short run does not show the fault reliably.
    """

    layer: str
    model: str
    made: type[Any]
    kills: str
    sides: tuple[Subject, ...] = BOTH
    dialect: str = ""
    brief: bool = False
    whole: bool = False

    @property
    def name(self) -> str:
        """The name of its class."""
        return self.made.__name__

    @property
    def key(self) -> tuple[str, str, str]:
        """Layer, model and name: unique, and the same in every process."""
        return self.layer, self.model, self.name

    @property
    def pin(self) -> str:
        """The name under which ``make pins`` keeps what it fails."""
        return f"{self.layer} {self.model} {self.name} ({self.kills})"

    @property
    def pinned(self) -> frozenset[str] | None:
        """Ids of the requirements that fail or warn, and no others; None of other packages' hands:
        of them, only that ``kills`` must is known.
        """
        found = _pins().get(self.pin)
        return None if found is None else frozenset(found)

    @property
    def summary(self) -> str:
        """Its fault: the first line of its class's docstring."""
        return (self.made.__doc__ or "").strip().splitlines()[0]


@functools.cache
def _pins() -> Mapping[str, Sequence[str]]:
    file = Path(__file__).resolve().parents[2] / "tests" / "pinned" / "blamed.json"
    found: dict[str, list[str]] = json.loads(file.read_text(encoding="utf-8"))
    return found


@dataclass(frozen=True)
class _Declaration:
    """The declaration of one decorator."""

    made: type[Any]
    kills: tuple[str, ...]
    sides: tuple[Side, ...] | None
    dialect: str
    brief: bool
    whole: bool
    where: Callable[[HandModel], bool] | None


_Place = tuple[str, str]  # layer and model
_References = Mapping[_Place, type[Any]]
_declared: list[_Declaration] = []


def wrong_hand(
    *kills: str,
    sides: tuple[Side, ...] | None = None,
    dialect: str = "",
    brief: bool = False,
    whole: bool = False,
    where: Callable[[HandModel], bool] | None = None,
) -> Callable[[type[Any]], type[Any]]:
    """Declare a class to be a wrong hand, robot, USB device or client.

    Of a class of mechanics, the service with such hands becomes the wrong hand.

    A second decorator on the same class is for another model. For a model that is like several of
    those that are named, the nearest one counts.

    :param kills: the id of the requirement that must find the fault; where catalogues number it
        differently, one id for each. Requirements that are ``like`` it are meant as well.
    :param sides: the hands that are needed to see the fault; by default those that the
        reference's ``fault_sides`` names.
    :param dialect: see :class:`Mutant`; ``brief`` and ``whole`` likewise. With several ids, all
        but the first are brief: every phase has been applied to the fault with the first.
    :param where: the hands that can have the fault; None for all.
    """

    def declare(made: type[Any]) -> type[Any]:
        service = next((_SERVICES[c] for c in made.__mro__ if c in _SERVICES), None)
        if service is not None:
            name = "hand" if issubclass(made, ReferenceHand) else "hand_fault"
            made = _class(made, service, {name: made})
        _declared.append(_Declaration(made, kills, sides, dialect, brief, whole, where))
        return made

    return declare


def _class(like: Any, base: type[Any], members: Mapping[str, object]) -> type[Any]:
    """A class with the name and the description of something else."""
    about = {n: getattr(like, n) for n in ("__doc__", "__module__", "__qualname__")}
    return type(like.__name__, (base,), {**about, **members})


def changes(
    base: type[Any], method: str, *kills: str, **options: Any
) -> Callable[[Call], type[Any]]:
    """Declare a function to be a wrong hand, robot, USB device or client.

    It is called in place of a method, with the object, the method itself, and its arguments. The
    object has a dictionary ``memory`` for what the fault has to remember.

    :param base: the class that has the method: a reference, or the mechanics of its hands.
    :param kills: as of :func:`wrong_hand`; ``options`` are its others.
    """
    assert hasattr(base, method), f"{base.__name__} has no {method}"

    def declare(function: Call) -> type[Any]:
        def begin(self: Any, *args: Any) -> None:
            self.memory = {}
            super(made, self).__init__(*args)

        def changed(self: Any, *args: Any) -> Any:
            return function(self, getattr(super(made, self), method), *args)

        made = _class(function, base, {"__init__": begin, method: changed})
        return wrong_hand(*kills, **options)(made)

    return declare


def commands(base: type[FingerHand], *kills: str, **options: Any) -> Callable[[Call], type[Any]]:
    """Declare a function that changes the commands which a hand puts in force to be a wrong hand.

    It is called with the mechanics, and with an array of q, dq, tau, kp and kd (``rows[KP]``), with
    a number for each joint; it writes in place. For ``memory`` see :func:`changes`.

    :param base: the mechanics.
    :param kills: as of :func:`wrong_hand`; ``options`` are its others.
    """

    def declare(function: Call) -> type[Any]:
        def take(hand: Any, take: Call, rows: Floats, mode: Ints) -> None:
            own = rows.copy()
            function(hand, own)
            take(own, mode)

        named = functools.update_wrapper(take, function)
        return changes(base, "take", *kills, **options)(named)

    return declare


def reports(
    base: type[Service], *kills: str, at_rest: bool = False, **options: Any
) -> Callable[[Call], type[Any]]:
    """Declare a function that changes the states of a hand to be a wrong hand.

    It is called with the service, the members of the state by name, and the mechanics. Each member
    is a number of a gripper, and an array with a number for each joint of others; the function
    writes in place. For ``memory`` see :func:`changes`.

    :param base: a reference, or ``Service`` for all.
    :param kills: as of :func:`wrong_hand`; ``options`` are its others.
    :param at_rest: the state of a hand of several joints can change while it rests.
    """

    def declare(function: Call) -> type[Any]:
        def begin(self: Any, *args: Any) -> None:
            self.memory = {}
            super(made, self).__init__(*args)

        def fields(self: Any, side: Side) -> Any:
            found = super(made, self).fields(side)
            function(self, found, self.hands[side])
            return found

        def fill(self: Any, motors: Any, hand: Any) -> None:
            super(made, self).fill(motors, hand)
            function(self, motors, hand)

        def live(self: Any, dt: float) -> None:
            super(made, self).live(dt)
            for hand in self.hands.values():
                hand.changed()

        members = {"__init__": begin, "fields": fields, "fill": fill}
        made = _class(function, base, {**members, **({"live": live} if at_rest else {})})
        return wrong_hand(*kills, **options)(made)

    return declare


def obeys_gains(hand: HandModel) -> bool:
    """Whether a hand's commands have gains: a place for ``where``."""
    return hand.dialects[0].gains_are_used


def has_speeds(hand: HandModel) -> bool:
    """Whether the dq of a hand's commands limits its speed: a place for ``where``."""
    return bool(hand.dialects[0].speed_units)


def takes_floats(hand: HandModel) -> bool:
    """Whether a hand's messages hold NaN, far values and sequences of any length: a place for
    ``where``.
    """
    return not message_type(hand.dialects[0].cmd_type).layout.fields[0].is_numbers


def mix(fault: type[Any], reference: type[C]) -> type[C]:
    """Mix a fault into the reference; return a class that already has the reference as its base."""
    if issubclass(fault, reference):
        return fault
    return type(fault.__name__, (fault, reference), {"__doc__": fault.__doc__})


def expand() -> tuple[Mutant, ...]:
    """Every wrong hand that has been declared, in the order of the requirements' catalogues."""
    every = catalogue(None, None)
    places = dict.fromkeys((r.layer, r.model) for r in every)
    references = {(name, model): layer(name).reference(model) for name, model in places}
    index = _Index(every)
    found = [m for d in _declared for m in _mutants(d, index, references)]
    order = {r.id: i for i, r in enumerate(every)}
    return tuple(sorted(found, key=lambda m: order[m.kills]))


def _mutants(declared: _Declaration, index: _Index, references: _References) -> Iterator[Mutant]:
    base = _base(declared.made, references)
    names = [name for other in _declared if other.made is declared.made for name in other.kills]
    for i, name in enumerate(declared.kills):
        for requirement, steps in index.like(name):
            place = requirement.layer, requirement.model
            # the id of a model, or of one that it is more like, has precedence
            if len(names) > 1 and steps > index.nearest(names, place):
                continue
            if declared.where and not declared.where(model(requirement.model)):
                continue
            reference = references[place]
            if not issubclass(reference, base):
                continue
            yield Mutant(
                *place,
                mix(declared.made, reference),
                requirement.id,
                declared.sides or reference.fault_sides,
                declared.dialect,
                not declared.whole and (declared.brief or i > 0),
                declared.whole,
            )


class _Index:
    """Requirements by each id that they have or are ``like``, with the steps of ``like`` to it."""

    def __init__(self, every: Iterable[Requirement]) -> None:
        self._found: dict[tuple[str, _Place | None], list[tuple[Requirement, int]]] = {}
        for requirement in every:
            place = requirement.layer, requirement.model
            for steps, name in enumerate((requirement.id, *requirement.lineage)):
                for key in ((name, None), (name, place)):
                    self._found.setdefault(key, []).append((requirement, steps))

    def like(self, name: str, place: _Place | None = None) -> Sequence[tuple[Requirement, int]]:
        """Those of a layer and model, or all, in the order of the catalogues."""
        return self._found.get((name, place), ())

    def nearest(self, names: Iterable[str], place: _Place) -> float:
        """The least number of steps from one of a model's requirements to one of these ids."""
        steps = (steps for name in names for _, steps in self.like(name, place))
        return min(steps, default=math.inf)


def _base(made: type[Any], references: _References) -> type[Any]:
    """The class under a fault that references are made of, too."""
    return next(c for c in made.__mro__ if any(issubclass(r, c) for r in references.values()))
