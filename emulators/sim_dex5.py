"""``sim-dex5``: a Dex5-1 as simulated mechanics, with no device or wire around it.

See :mod:`dexkit.emulators.dex5_mechanics` for what is modelled, assumed and not there.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.dex5_mechanics import Dex5Mechanics
from dexkit.emulators.finger_mechanics import SETTINGS, STEP
from dexkit.emulators.simulated import SimulatedHand, number
from dexkit.hand import Side
from dexkit.models import DEX5_1

__all__ = ["SimDex5", "sim_dex5"]


class SimDex5(SimulatedHand):
    """A simulated Dex5-1.

    :param side: which hand.
    :param object_at: how far the fingers close until they touch an object, percent; None for no
        object.
    :param start: how far they are closed at ``open``, percent; None for a relaxed pose.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_at: float | None = None,
        start: float | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.mechanics = Dex5Mechanics(side, object_at=object_at, start=start)
        spec = DEX5_1.spec(side, io_rate=DEX5_1.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)


def _make(options: BackendOptions) -> SimDex5:
    return SimDex5(
        options.side, object_at=number(options, "object"), start=number(options, "start")
    )


sim_dex5 = Backend(
    summary="Simulated Dex5-1 hand: 20 joints, mechanics and heat, no device",
    model=DEX5_1.name,
    make=_make,
    settings=SETTINGS,
)
