"""``sim-inspire-dfx`` and ``sim-inspire-ftp``: simulated Inspire RH56DFX and RH56DFTP, six position
servos, without device or bus.

:mod:`dexkit.emulators.servo_mechanics` has the mechanics. The full speed is the one of the device's
highest setting, and the steps of q its thousandths (docs/sources/unitree-dex.md#j2); how a motor
accelerates is assumed. Of a DFX only q is measured, as on Unitree's topics; of an FTP the forces,
too, but not the pressures of its 17 tactile areas.

Not modelled: the fingers' coupled links, that fingers and thumb meet each other, force limits and
how far a fast finger exceeds them, the errors that stop a joint until they are cleared, and the
latency of the serial line.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.emulators.servo_mechanics import SETTINGS
from dexkit.emulators.simulated_servos import SimulatedServos, make_servos
from dexkit.emulators.wear import WEAR_SETTING
from dexkit.hand import HandCommand, HandState
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP

__all__ = ["SimInspireDfx", "SimInspireFtp", "sim_inspire_dfx", "sim_inspire_ftp"]


class SimInspireDfx(SimulatedServos):
    """A simulated RH56DFX."""

    model = INSPIRE_DFX
    resolution = 1e-3

    def exchange(self, command: HandCommand) -> HandState:
        """Advance to now under the last command, apply this one, and return what is measured.

        :raises HandLost: the hand is not open.
        """
        state = super().exchange(command)
        return HandState.from_values(state.q, stamp=state.stamp, mode=state.mode.tolist())


def _make(options: BackendOptions) -> SimInspireDfx:
    return make_servos(SimInspireDfx, options)


sim_inspire_dfx = Backend(
    summary="Simulated Inspire RH56DFX hand: 6 position servos, no device",
    model=INSPIRE_DFX.name,
    make=_make,
    settings={**SETTINGS, **WEAR_SETTING},
)


class SimInspireFtp(SimulatedServos):
    """A simulated RH56DFTP."""

    model = INSPIRE_FTP
    resolution = 1e-3


def _make_ftp(options: BackendOptions) -> SimInspireFtp:
    return make_servos(SimInspireFtp, options)


sim_inspire_ftp = Backend(
    summary="Simulated Inspire RH56DFTP hand: 6 position servos, no tactile areas, no device",
    model=INSPIRE_FTP.name,
    make=_make_ftp,
    settings={**SETTINGS, **WEAR_SETTING},
)
