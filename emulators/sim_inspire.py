"""``sim-inspire-dfx`` and ``sim-inspire-ftp``: simulated Inspire RH56DFX and RH56DFTP, six position
servos, without device or bus.

:mod:`dexkit.emulators.servo_mechanics` has the mechanics. The full speed is the one of the device's
highest setting, and the steps of q its thousandths (docs/sources/unitree-dex.md#j2); how a motor
accelerates is assumed. A DFX reports only q, as on Unitree's topics; an FTP also forces and 17
tactile areas. A finger that presses on the object loads the two large areas of its last joints,
most in the middle of each, in proportion to its force; the counts of a real area are not known. The
small areas and the palm read 0.

Not modelled: coupled links, collisions of fingers and thumb, force limits and their overshoot at
speed, errors that stop a joint until they are cleared, and the latency of the serial line.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexkit.backends import Backend, BackendOptions
from dexkit.emulators.servo_mechanics import SETTINGS, ServoMechanics
from dexkit.emulators.simulated_hand import COMMON_SETTINGS
from dexkit.emulators.simulated_servos import SimulatedServos, make_servos
from dexkit.hand import Floats, HandCommand, HandState, Side
from dexkit.models import INSPIRE_DFX, INSPIRE_FTP

__all__ = ["FtpMechanics", "SimInspireDfx", "SimInspireFtp", "sim_inspire_dfx", "sim_inspire_ftp"]


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
    settings={**SETTINGS, **COMMON_SETTINGS},
)


_COUNTS = 1000.0  # counts in the middle of an area at full force; assumed
_WIDTH = 0.35  # half width of the pressed region, as a part of an area; assumed


def _bump(elements: int) -> Floats:
    """Pressure profile along a row of elements, as parts of the maximum in its middle."""
    away = (np.arange(elements) + 0.5) / elements - 0.5
    return np.exp(-0.5 * (away / _WIDTH) ** 2)


def _touch_shares() -> Floats:
    """Shape (n_areas, elements of the largest): counts at the full force; NaN for no element."""
    areas = INSPIRE_FTP.dialects[0].areas
    shares = np.full((len(areas), max(area.elements for area in areas)), np.nan)
    for row, area in zip(shares, areas, strict=True):
        pressed = area.place.partition(" ")[2] in ("top", "palm")
        pattern = np.outer(_bump(area.rows), _bump(area.columns)).ravel()
        row[: area.elements] = _COUNTS * pattern / pattern.max() if pressed else 0.0
    return shares


class FtpMechanics(ServoMechanics):
    """Position servos with tactile areas on the fingers."""

    _shares = _touch_shares()
    # the joints that press each area: those of its finger; none press the palm
    _joints = tuple(
        [
            i
            for i, joint in enumerate(INSPIRE_FTP.joints[Side.LEFT])
            if joint.name.partition("_")[0] == area.place.partition(" ")[0]
        ]
        for area in INSPIRE_FTP.dialects[0].areas
    )
    _felt: tuple[list[float], Floats] | None = None

    @property
    def pressure(self) -> Floats:
        """Counts, shape (n_areas, elements of the largest); NaN where there is no element."""
        contacts = self.contacts
        if self._felt is None or self._felt[0] != contacts:
            pressed = [max((contacts[i] for i in mine), default=0.0) for mine in self._joints]
            self._felt = contacts, self._shares * np.array(pressed)[:, None]
        return self._felt[1]

    def state(self, stamp: float) -> HandState:
        """The state of the hand at ``stamp``."""
        return replace(super().state(stamp), pressure=self.pressure)


class SimInspireFtp(SimulatedServos):
    """A simulated RH56DFTP."""

    model = INSPIRE_FTP
    resolution = 1e-3
    mechanics_type = FtpMechanics


def _make_ftp(options: BackendOptions) -> SimInspireFtp:
    return make_servos(SimInspireFtp, options)


sim_inspire_ftp = Backend(
    summary="Simulated Inspire RH56DFTP hand: 6 position servos, 17 tactile areas, no device",
    model=INSPIRE_FTP.name,
    make=_make_ftp,
    settings={**SETTINGS, **COMMON_SETTINGS},
)
