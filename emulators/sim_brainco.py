"""``sim-brainco``: a simulated BrainCo Revo2, six position servos, without device or bus.

:mod:`dexkit.emulators.servo_mechanics` has the mechanics. Full speeds are the SDK's defaults, and
the steps of q the thousandths in which the hand reports it (docs/sources/unitree-dex.md#j1); how a
motor accelerates, and which current it takes, is assumed.

Not modelled: collisions of fingers, tactile sensors, the thumb's lock, and that the vendor's
service repeats the last command without end (docs/decisions.md).
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.emulators.servo_mechanics import SETTINGS
from dexkit.emulators.simulated_hand import COMMON_SETTINGS
from dexkit.emulators.simulated_servos import SimulatedServos, make_servos
from dexkit.models import BRAINCO_REVO2

__all__ = ["SimBrainCo", "sim_brainco"]


class SimBrainCo(SimulatedServos):
    """A simulated Revo2."""

    model = BRAINCO_REVO2
    resolution = 1e-3


def _make(options: BackendOptions) -> SimBrainCo:
    return make_servos(SimBrainCo, options)


sim_brainco = Backend(
    summary="Simulated BrainCo Revo2 hand: 6 position servos, no device",
    model=BRAINCO_REVO2.name,
    make=_make,
    settings={**SETTINGS, **COMMON_SETTINGS},
)
