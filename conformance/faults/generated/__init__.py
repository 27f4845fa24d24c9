"""Generate wrong and good hands: a fault has a kind, a place and conditions.

A hand has a name that says all of it, so that it can be made again::

    dex1-1/unitree_go:q-offset@left,joint0,after-brake
    dex3-1/dex3:cmd-late@both,all,moving&warm+gaps@left,all,always

Before the colon are model and dialect. Each fault is its name, the side, the joint and the
conditions that must hold together. A good hand's deviations are written in the same way, without a
place.
"""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.conformance.faults.generated.choices import DEVIATIONS, GROUPS
from dexkit.conformance.faults.generated.faults import FAULTS, KINDS
from dexkit.conformance.faults.generated.rig import Faulty, Part, What, When, compose
from dexkit.conformance.faults.generated.times import WHENS
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.requirements import CAPABILITIES
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.models import MODELS, Dialect, HandModel, dialect, model

__all__ = ["Fault", "Generated", "dialects", "parse", "sample", "sample_good"]

_SIDES = {"left": (Side.LEFT,), "right": (Side.RIGHT,), "both": tuple(Side)}
_SECOND = 0.2
"""Part of a sample that has two faults, or one with two conditions."""
_LAST = "latency"
"""The group whose deviation is drawn last."""


@dataclass(frozen=True)
class Fault:
    """One fault of a hand, by names.

    :param side: ``left``, ``right`` or ``both``.
    :param joint: ``joint0`` and so on, or ``all``.
    :param whens: names of the conditions that must hold together.
    """

    what: str
    side: str = "both"
    joint: str = "all"
    whens: tuple[str, ...] = ("always",)

    def __str__(self) -> str:
        if self.what in DEVIATIONS:
            return self.what
        return f"{self.what}@{self.side},{self.joint},{'&'.join(self.whens)}"

    @property
    def made(self) -> type[What]:
        """The class of the fault."""
        return FAULTS.get(self.what) or DEVIATIONS[self.what]

    @property
    def conditions(self) -> tuple[When, ...]:
        """The conditions."""
        return tuple(WHENS[w] for w in self.whens)

    @property
    def summary(self) -> str:
        """What, where and when, in words."""
        where = "" if self.joint == "all" else f", {self.joint}"
        when = " and ".join(w.summary for w in self.conditions)
        return f"{self.made.summary} ({self.side}{where}; {when})"

    def part(self) -> Part:
        """The fault itself."""
        joint = None if self.joint == "all" else int(self.joint.removeprefix("joint"))
        return Part(self.made, _SIDES[self.side], joint, self.conditions)


@dataclass(frozen=True)
class Generated:
    """A hand that was put together from the reference of a model and some faults."""

    dialect: Dialect
    faults: tuple[Fault, ...]

    @property
    def name(self) -> str:
        """Its name, from which :func:`parse` makes it again."""
        faults = "+".join(map(str, self.faults))
        return f"{self.dialect.model}/{self.dialect.name}:{faults}"

    @property
    def good(self) -> bool:
        """Whether it is a good hand."""
        return all(f.made.good for f in self.faults)

    @property
    def kind(self) -> str:
        """The class in which its score is counted."""
        kinds = dict.fromkeys(f.made.kind for f in self.faults)
        return next(iter(kinds)) if len(self.faults) == 1 else "good" if self.good else "two faults"

    @property
    def summary(self) -> str:
        """Description of the hand."""
        if self.good:
            return "; ".join(f.made.summary for f in self.faults)
        return "; ".join(f.summary for f in self.faults)

    @property
    def areas(self) -> frozenset[str]:
        """The requirement areas that are a right reason to fail it."""
        parts = [f.made.areas for f in self.faults]
        parts += [w.areas for f in self.faults for w in f.conditions]
        return frozenset().union(*parts)

    @property
    def sides(self) -> tuple[Side, ...]:
        """The hands of a run that shows it. Hands of many joints take long: only those needed."""
        for fault in self.faults:
            if fault.made.served:
                return fault.made.served
        if self.dialect.is_gripper or self.good:
            return tuple(Side) if self.dialect.is_gripper else (Side.RIGHT,)
        needs_both = any(f.made.both or any(w.both for w in f.conditions) for f in self.faults)
        named = {s for f in self.faults for s in _SIDES[f.side]}
        return tuple(s for s in Side if needs_both or s in named)

    @property
    def permitted(self) -> frozenset[str]:
        """Requirements that may warn of it, if it is good."""
        return frozenset().union(*(f.made.warned for f in self.faults))

    @property
    def claims(self) -> Claims:
        """What its maker claims of it."""
        said = [f.made.claims for f in self.faults if f.made.claims is not None]
        if not said:
            return Claims()
        lacking = frozenset().union(*(f.made.lacks for f in self.faults))
        has = units_of(self.dialect) - lacking if said[0] else frozenset()
        return Claims({unit: unit in has for unit in CAPABILITIES})

    def service(self) -> type[Faulty]:
        """Its service.

        :raises ModelBroken: the model's reference has no place for faults.
        """
        reference = under_test(self.dialect.model).reference.load()
        name = re.sub(r"\W+", "_", self.name)
        return compose(name, self.summary, reference, [f.part() for f in self.faults])


def parse(name: str) -> Generated:
    """The hand of that name.

    :raises UsageError: the name says no hand, and why.
    """
    match = re.fullmatch(r"([^/:]+)/([^/:]+):(.+)", name)
    if not match:
        raise UsageError(
            f"{name!r} names no generated hand",
            hint="MODEL/DIALECT:WHAT@SIDE,JOINT,WHEN, as --list prints it",
        )
    of = model(match[1])
    spoken = dialect(match[2])
    if spoken not in of.dialects:
        raise UsageError(f"{of.name} has no dialect {spoken.name}")
    return Generated(spoken, tuple(_fault(text, of) for text in match[3].split("+")))


def _fault(text: str, of: HandModel) -> Fault:
    what, at, where = text.partition("@")
    if not at:
        if what not in DEVIATIONS:
            raise UsageError(f"{what!r} is no deviation of a good hand", hint=", ".join(DEVIATIONS))
        suitable = [w for w, made in DEVIATIONS.items() if _suits(made, of)]
        if what not in suitable:
            raise UsageError(f"{of.name} cannot have {what!r}", hint=", ".join(suitable))
        return Fault(what)
    side, _, rest = where.partition(",")
    joint, _, whens = rest.partition(",")
    fault = Fault(what, side, joint, tuple(whens.split("&")))
    count = len(of.joints[Side.LEFT])
    known: list[tuple[str, Sequence[str]]] = [
        (what, tuple(FAULTS)),
        (side, tuple(_SIDES)),
        (joint, ("all", *(f"joint{i}" for i in range(count)))),
        *((w, tuple(WHENS)) for w in fault.whens),
    ]
    for given, allowed in known:
        if given not in allowed:
            raise UsageError(f"{given!r} in {text!r} is not known", hint=", ".join(allowed))
    suitable = [w for w, made in FAULTS.items() if _suits(made, of)]
    if what not in suitable:
        raise UsageError(f"{of.name} cannot have {what!r}", hint=", ".join(suitable))
    return fault


def dialects(model_name: str | None = None, dialect_name: str | None = None) -> tuple[Dialect, ...]:
    """The dialects of a model, one of them, or those of all models.

    :raises UsageError: there is none of that name, or it is not one of the model.
    """
    of = [model(model_name)] if model_name else list(MODELS.values())
    found = tuple(
        d for m in of for d in m.dialects if dialect_name is None or d.name == dialect_name
    )
    if not found:
        raise UsageError(
            f"{model_name or 'no model'} has no dialect {dialect_name}",
            hint=", ".join(d.name for m in of for d in m.dialects),
        )
    return found


def _joints(spoken: Dialect) -> tuple[str, ...]:
    """Joints of a side that a fault can affect: the first, the last, or all."""
    count = len(model(spoken.model).joints[Side.LEFT])
    return ("joint0",) if count == 1 else ("joint0", f"joint{count - 1}", "all")


def _whats(spoken: Dialect, kind: str) -> list[str]:
    of = model(spoken.model)
    return [name for name, w in FAULTS.items() if w.kind == kind and _suits(w, of)]


def sample(count: int, seed: int, spoken: Sequence[Dialect]) -> list[Generated]:
    """``count`` different wrong hands, over all classes of faults and dialects in turn.

    A fifth of them has two faults, or one fault with two conditions.
    """
    draw = random.Random(seed)
    kinds = list(KINDS)
    found: dict[str, Generated] = {}
    turn = 0
    while len(found) < count and turn < 20 * count + 100:
        d = spoken[turn % len(spoken)]
        kind = kinds[(turn // len(spoken)) % len(kinds)]
        turn += 1
        fault = _drawn(draw, d, kind)
        faults: tuple[Fault, ...] = (fault,)
        if draw.random() < _SECOND:
            other = _drawn(draw, d, draw.choice(kinds))
            if draw.random() < 0.5 and other.whens != fault.whens:
                whens = tuple(w for w in (*fault.whens, *other.whens) if w != "always")
                faults = (Fault(fault.what, fault.side, fault.joint, whens),)
            elif other.what != fault.what:
                faults = (fault, other)
        hand = Generated(d, faults)
        found.setdefault(hand.name, hand)
    return list(found.values())


def _drawn(draw: random.Random, spoken: Dialect, kind: str) -> Fault:
    return Fault(
        draw.choice(_whats(spoken, kind)),
        draw.choice(list(_SIDES)),
        draw.choice(_joints(spoken)),
        (draw.choice(list(WHENS)),),
    )


def units_of(spoken: Dialect) -> frozenset[str]:
    """The units that the reference of a dialect's model has."""
    reference = under_test(spoken.model).reference.load()
    members = {"tau_est": "force", "dq": "velocity", "ddq": "acceleration"}
    found = {unit for member, unit in members.items() if member in reference.measured_members}
    found |= {"pressure"} if getattr(reference, "sensors", 0) else set()
    found |= {"imu"} if any(getattr(reference, "attitude", ())) else set()
    found |= {"low_rate"} if spoken.low_rate_topic else set()
    return frozenset(found)


def _suits(what: type[What], of: HandModel) -> bool:
    """Whether a hand of a model can have a fault, or a deviation."""
    several = len(of.joints[Side.LEFT]) > 1
    if (what.one_joint and several) or (what.several and not several) or of.name in what.not_of:
        return False
    servo = any(d.position_servo for d in of.dialects)
    if (what.position_servo and not servo) or (what.control_law and servo):
        return False
    reference = under_test(of.name).reference.load()
    if what.has and not getattr(reference, what.has, None):
        return False
    return not what.needs or what.needs in reference.measured_members


def sample_good(count: int, seed: int, spoken: Sequence[Dialect]) -> list[Generated]:
    """``count`` different good hands, with one to four deviations of different groups."""
    draw = random.Random(seed)
    found: dict[str, Generated] = {}
    turn = 0
    while len(found) < count and turn < 20 * count + 100:
        d = spoken[turn % len(spoken)]
        turn += 1
        groups = draw.sample(list(GROUPS), draw.choice((1, 2, 3, 4)))
        chosen = [draw.choice(GROUPS[g]) for g in sorted(groups, key=lambda g: (g == _LAST, g))]
        chosen.sort(key=lambda w: DEVIATIONS[w].turn)
        faults = [Fault(w) for w in chosen if _suits(DEVIATIONS[w], model(d.model))]
        if faults:
            hand = Generated(d, tuple(faults))
            found.setdefault(hand.name, hand)
    return list(found.values())
