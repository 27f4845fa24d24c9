"""Simulated hand of position servos, for any model."""

from __future__ import annotations

from typing import ClassVar, TypeVar

from dexkit.backends import BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.servo_mechanics import STEP, ServoMechanics
from dexkit.emulators.simulated_hand import SimulatedHand, configured, number
from dexkit.hand import Side
from dexkit.models import HandModel

__all__ = ["SimulatedServos", "make_servos"]


class SimulatedServos(SimulatedHand):
    """A simulated hand of position servos; its class names the model.

    :param side: which hand.
    :param object_at: how far the fingers close until they touch an object, percent; None for no
        object.
    :param start: how far they are closed at ``open``, percent; None for a relaxed pose.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a parameter is out of range.
    """

    model: ClassVar[HandModel]
    resolution: ClassVar[float]
    """Steps of q, in parts of the travel."""
    mechanics_type: ClassVar[type[ServoMechanics]] = ServoMechanics

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_at: float | None = None,
        start: float | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.mechanics = self.mechanics_type(
            self.model, side, object_at=object_at, start=start, resolution=self.resolution
        )
        spec = self.model.spec(side, io_rate=self.model.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)


Servos = TypeVar("Servos", bound=SimulatedServos)


def make_servos(kind: type[Servos], options: BackendOptions) -> Servos:
    """Make the hand from a backend's options.

    :raises UsageError: a setting is invalid.
    """
    hand = kind(options.side, object_at=number(options, "object"), start=number(options, "start"))
    return configured(hand, options)
