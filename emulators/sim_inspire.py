"""``sim-inspire-dfx``: a simulated Inspire RH56DFX, six position servos, without device or bus.

:mod:`dexkit.emulators.servo_mechanics` has the mechanics. The full speed is the one of the device's
highest setting, and the steps of q its thousandths (docs/sources/unitree-dex.md#j2); how a motor
accelerates is assumed. Only q is measured, as on Unitree's topics.

Not modelled: the fingers' coupled links, that fingers and thumb meet each other, force limits and
how far a fast finger exceeds them, the errors that stop a joint until they are cleared, and the
latency of the serial line.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.servo_mechanics import SETTINGS, STEP, ServoMechanics
from dexkit.emulators.simulated import SimulatedHand, number
from dexkit.hand import HandCommand, HandState, Side
from dexkit.models import INSPIRE_DFX

__all__ = ["SimInspireDfx", "sim_inspire_dfx"]

_RESOLUTION = 1e-3


class SimInspireDfx(SimulatedHand):
    """A simulated RH56DFX.

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
        model = INSPIRE_DFX
        self.mechanics = ServoMechanics(
            model, side, object_at=object_at, start=start, resolution=_RESOLUTION
        )
        spec = model.spec(side, io_rate=model.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)

    def exchange(self, command: HandCommand) -> HandState:
        """Advance to now under the last command, apply this one, and return what is measured.

        :raises HandLost: the hand is not open.
        """
        state = super().exchange(command)
        return HandState.from_values(state.q, stamp=state.stamp, mode=state.mode.tolist())


def _make(options: BackendOptions) -> SimInspireDfx:
    return SimInspireDfx(
        options.side, object_at=number(options, "object"), start=number(options, "start")
    )


sim_inspire_dfx = Backend(
    summary="Simulated Inspire RH56DFX hand: 6 position servos, no device",
    model=INSPIRE_DFX.name,
    make=_make,
    settings=SETTINGS,
)
