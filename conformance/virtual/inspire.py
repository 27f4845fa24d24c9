"""Inspire's DFX and FTP hands that meet every requirement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dexkit.conformance.virtual.fingers import GO_MOTOR, FingerHand
from dexkit.conformance.virtual.service import Sample
from dexkit.conformance.virtual.servos import ServoHand, ServoService
from dexkit.hand import Floats, Side
from dexkit.messages import message_type
from dexkit.messages.integer_lists import IntegerLists
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP
from dexkit.traces import TraceEndpoint

__all__ = ["FtpHand", "FtpService", "InspireService"]


class InspireHand(ServoHand):
    """Six joints that go to q at full speed (docs/sources/unitree-dex.md#j2)."""

    model = INSPIRE_DFX
    speed_is_used = False


class InspireService(ServoService):
    """Both hands in one message."""

    hand = InspireHand
    tick = period = 0.003
    measured_members = frozenset(("q",))

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """Fill in q, the only member that is measured.

        The others are 0: what a fault has written into the state before does not stay there.
        """
        motors["mode"], motors["values"] = 0, 0.0
        motors["q"] = hand.q[: len(motors)]


_AREAS = INSPIRE_FTP.dialects[0].areas
_MOST = max(area.elements for area in _AREAS)
_JOINTS = tuple(joint.name.partition("_")[0] for joint in INSPIRE_FTP.joints[Side.LEFT])
_COUNTS = 800.0  # at the full force, in each element of a finger's top area
_LENGTHS = {area.member: area.elements for area in _AREAS}


class FtpHand(InspireHand):
    """The same joints, with measured forces and tactile areas."""

    model = INSPIRE_FTP

    def pressures(self) -> Floats:
        """Shape (n_areas, elements of the largest): counts of the tactile areas."""
        pressure = self.untouched()
        if not self.touches:
            return pressure
        # the object is on the way to closed, which is toward 0
        pressed = np.maximum(self.contact, 0.0) / self.most
        for row, area in zip(pressure, _AREAS, strict=True):
            finger, _, part = area.place.partition(" ")
            if part == "top":
                mine = [p for p, name in zip(pressed, _JOINTS, strict=True) if name == finger]
                row[: area.elements] = _COUNTS * max(mine)
        return pressure

    def untouched(self) -> Floats:
        """The same of a hand that nothing touches: its areas were set to zero."""
        return np.zeros((len(_AREAS), _MOST))


class FtpService(ServoService):
    """Each hand on its own topics, in lists of integers."""

    hand = FtpHand
    measured_members = frozenset(("q", "tau_est"))
    touch_period = 0.04
    """Seconds from one touch message to the next."""
    touch_lengths: Mapping[str, int] = _LENGTHS
    touch_due = 0.0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._touched: dict[Side, tuple[int, bytes]] = {}
        self._lists = IntegerLists(message_type(self.dialect.touch_type), self.touch_lengths)
        self._there = np.concatenate(
            [
                i * _MOST + np.arange(self.touch_lengths[area.member])
                for i, area in enumerate(_AREAS)
            ]
        )

    def endpoints(self) -> list[TraceEndpoint]:
        """Its endpoints, as discovery reports them."""
        kind = self.dialect.touch_type
        touch = [
            TraceEndpoint(self.touch_topic(s), "writer", "reliable", "Volatile", "", kind)
            for s in self.sides
        ]
        return super().endpoints() + touch

    def touch_topic(self, side: Side) -> str:
        """Topic of a side's tactile areas."""
        return self.dialect.touch_topic_of(side)

    def publish(self) -> list[Sample]:
        """One state of every hand, and at its own rate the touch message."""
        samples = super().publish()
        if self.now + 1e-9 < self.touch_due:
            return samples
        self.touch_due = self.now + self.touch_period
        return samples + self.touch()

    def touch(self) -> list[Sample]:
        """Messages with the readings of every hand's areas."""
        kind = self.dialect.touch_type
        return [Sample(self.touch_topic(s), kind, self.touched(s), self.now) for s in self.sides]

    def touched(self, side: Side) -> bytes:
        """A hand's tactile readings as a message."""
        hand = self.hands[side]
        if self._touched.get(side, (-1, b""))[0] != hand.version:
            pressure = self.pressures(hand)
            self._touched[side] = hand.version, self._lists.encode(pressure.ravel()[self._there])
        return self._touched[side][1]

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        """The state of a hand on the wire."""
        (side,) = sides
        count = self.dialect.length if length is None else length
        key = (self.hands[side].version, count)
        if self._sent.get(sides, (None, b""))[0] == key:
            return self._sent[sides][1]
        motors = np.zeros(count, GO_MOTOR)
        mine = motors[: len(self.hands[side].q)]
        if len(mine):
            self.fill(mine, self.hands[side])
        self._sent[sides] = (key, self.codec.state_lists(motors))
        return self._sent[sides][1]
