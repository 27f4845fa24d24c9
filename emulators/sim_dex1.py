"""``sim-dex1``: a simulated Dex1-1 gripper, mechanics only, without a device protocol.

The command in force stays in force until the next one, as in the real motor. Temperature, voltage
and noise of the product are unknown and stay NaN.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.dex1_mechanics import STEP, Dex1Mechanics
from dexkit.emulators.simulated_hand import COMMON_SETTINGS, SimulatedHand, configured, number
from dexkit.hand import Side
from dexkit.models import DEX1_1

__all__ = ["STEP", "SimHand", "sim_dex1"]


class SimHand(SimulatedHand):
    """A simulated Dex1-1.

    :param side: which hand.
    :param object_pct: opening at which the jaws touch an object, percent of 5.4 rad; None for
        no object.
    :param start_pct: opening at ``open``. Not 0 by default: some clients wait for a position
        that is not exactly zero.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a percentage is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_pct: float | None = None,
        start_pct: float = 20.0,
        clock: Clock | None = None,
    ) -> None:
        self.mechanics = Dex1Mechanics(object_pct=object_pct, start_pct=start_pct)
        self.joint = self.mechanics.joint
        spec = DEX1_1.spec(side, io_rate=1000.0, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)


def _make(options: BackendOptions) -> SimHand:
    start = number(options, "start")
    hand = SimHand(
        options.side,
        object_pct=number(options, "object"),
        start_pct=20.0 if start is None else start,
    )
    return configured(hand, options)


sim_dex1 = Backend(
    summary="Simulated Dex1-1 gripper: mechanics only, no device",
    model=DEX1_1.name,
    make=_make,
    settings={
        "object": "percent of opening at which an object is touched (default: no object)",
        "start": "percent of opening at first (default: 20)",
        **COMMON_SETTINGS,
    },
)
