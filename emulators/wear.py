"""Wear of an emulated hand: friction, play, slow and dead joints, dead tactile elements.

Use it to test programs that detect wear: ``--set
wear=friction@index_0=3,play@index_1=0.04,dead@thumb_2``. How real products wear is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.hand import Floats, HandSpec, HandState

__all__ = ["WEAR_SETTING", "JointWear", "Wear", "Worn", "parse_wear"]

SLOTS = 12
"""Values of a packet of tactile elements."""
_NUMBERS = {"friction": (0, 1000), "speed": (0.01, 1), "play": (0, 10)}
"""Kinds of wear with a value, and the range of the value."""
WEAR_SETTING = {
    "wear": "friction=FACTOR, speed=PART, play=RAD, dead, each of all joints or @JOINT; "
    "element=PACKET.SLOT (dead); e.g. friction@index_0=3,dead@index_1"
}
"""The setting of backends whose hand supports wear."""


@dataclass(frozen=True)
class JointWear:
    """Wear of one joint.

    :param friction: factor of its Coulomb friction.
    :param speed: remaining part of its top speed.
    :param play: play between the motor and the reported q; unit of q.
    :param dead: its motor has no power.
    """

    friction: float = 1.0
    speed: float = 1.0
    play: float = 0.0
    dead: bool = False

    def __post_init__(self) -> None:
        for name, (low, high) in _NUMBERS.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"wear: {name} must be {low} to {high}")


@dataclass(frozen=True)
class Wear:
    """Wear of a hand.

    :param joints: by index.
    :param elements: dead tactile elements: (packet, slot).
    """

    joints: Mapping[int, JointWear] = field(default_factory=dict)
    elements: frozenset[tuple[int, int]] = frozenset()


def parse_wear(text: str, spec: HandSpec) -> Wear:
    """Read the setting ``wear``.

    :raises UsageError: the text has another form than :data:`WEAR_SETTING` shows.
    """
    names = [joint.name for joint in spec.joints]
    joints: dict[int, JointWear] = {}
    elements = set()
    for item in filter(None, (part.strip() for part in text.split(","))):
        what, _, value = item.partition("=")
        kind, at, name = what.partition("@")
        if at and name not in names:
            raise UsageError(f"wear: no joint {one_line(name)!r}", hint=", ".join(names))
        if kind == "element":
            elements.add(_element(value, spec))
            continue
        if kind == "dead" and not value:
            given: dict[str, float | bool] = {"dead": True}
        elif kind in _NUMBERS:
            given = {kind: _number(value)}
        else:
            raise UsageError(
                f"wear: {one_line(item, 60)} is not understood", hint=WEAR_SETTING["wear"]
            )
        for index in [names.index(name)] if at else range(len(names)):
            joints[index] = JointWear(**{**vars(joints.get(index, JointWear())), **given})
    return Wear(joints, frozenset(elements))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"wear: {one_line(text, 60)!r} is not a number") from None


def _element(text: str, spec: HandSpec) -> tuple[int, int]:
    """(packet, slot) of a tactile element."""
    for packet in range(spec.n_sensors):
        for slot in range(SLOTS):
            if text == f"{packet}.{slot}":
                return packet, slot
    raise UsageError(f"wear: {one_line(text, 60)!r} is not PACKET.SLOT of this hand")


class Worn:
    """Adds play and dead tactile elements to the states of a hand.

    With play, the reported q follows the motor only after the motor has crossed the play.
    """

    def __init__(self, wear: Wear, n_joints: int) -> None:
        self._half = np.array([wear.joints.get(i, JointWear()).play / 2 for i in range(n_joints)])
        self._elements = sorted(wear.elements)
        self._q: Floats | None = None
        self._dead: Floats | None = None

    def __call__(self, state: HandState) -> HandState:
        """The state as the worn hand reports it."""
        if self._q is None:
            self._q = state.q.copy()
        self._q = np.clip(self._q, state.q - self._half, state.q + self._half)
        pressure = state.pressure
        if pressure is not None and self._elements:
            if self._dead is None:
                self._dead = pressure.copy()  # what they read first, they read for ever
            pressure = pressure.copy()
            for packet, slot in self._elements:
                pressure[packet, slot] = self._dead[packet, slot]
        return replace(state, q=self._q, pressure=pressure)
