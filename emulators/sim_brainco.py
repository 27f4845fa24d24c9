"""``sim-brainco``: a simulated BrainCo Revo2, six position servos, without device or bus.

:mod:`dexkit.emulators.servo_mechanics` has the mechanics. Full speeds are the SDK's defaults, and
the steps of q the thousandths in which the hand reports it (docs/sources/unitree-dex.md#j1); how a
motor accelerates, and which current it takes, is assumed.

Not modelled: fingers that meet each other, tactile sensors, the thumb's lock, and that the vendor's
service goes on with the last command for ever (docs/decisions.md).
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.servo_mechanics import SETTINGS, STEP, ServoMechanics
from dexkit.emulators.simulated import SimulatedHand, number, worn
from dexkit.emulators.wear import WEAR_SETTING
from dexkit.hand import Side
from dexkit.models import BRAINCO_REVO2

__all__ = ["SimBrainCo", "sim_brainco"]

_RESOLUTION = 1e-3


class SimBrainCo(SimulatedHand):
    """A simulated Revo2.

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
        model = BRAINCO_REVO2
        self.mechanics = ServoMechanics(
            model, side, object_at=object_at, start=start, resolution=_RESOLUTION
        )
        spec = model.spec(side, io_rate=model.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)


def _make(options: BackendOptions) -> SimBrainCo:
    hand = SimBrainCo(
        options.side, object_at=number(options, "object"), start=number(options, "start")
    )
    return worn(hand, options)


sim_brainco = Backend(
    summary="Simulated BrainCo Revo2 hand: 6 position servos, no device",
    model=BRAINCO_REVO2.name,
    make=_make,
    settings={**SETTINGS, **WEAR_SETTING},
)
