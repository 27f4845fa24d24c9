"""The backends that the kit starts itself: simulated hands, emulated devices and robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.hand import Side
from dexkit.models import MODELS
from dexkit.robots import ROBOTS

__all__ = ["EMULATED", "EXTERNAL", "ON_USB", "ROBOT_EMULATORS", "SIMULATED", "Emulation"]

EXTERNAL = "external"
"""The backend's name for a service that the kit does not start."""


@dataclass(frozen=True)
class Emulation:
    """How to emulate a backend's device: one process a hand.

    :param arguments: of ``dexkit emulate``, without object; ``{side}`` is the hand's.
    :param linked: whether its path is given by ``--link``. Otherwise it prints its address as the
        first word after ``ready:``, and gets ``--side``.
    :param settings: that the backend needs to go with it.
    """

    arguments: tuple[str, ...]
    linked: bool
    settings: Mapping[str, str] = field(default_factory=dict)

    def command(self, side: Side, path: Path) -> tuple[str, ...]:
        """The arguments for one hand."""
        place = ("--link", str(path)) if self.linked else ("--side", str(side))
        arguments = [argument.format(side=side) for argument in self.arguments]
        return ("emulate", *arguments, *place)


_CLOSED_AT = "1510"  # encoder tick of the zero, given to emulator and driver: no calibration run
EMULATED: dict[str, Emulation] = {
    # an emulated servo or motor shares the machine with all other processes, and may answer late
    "ezgripper": Emulation(
        ("mx64", "--closed-at", _CLOSED_AT), True, {"timeout": "0.3", "zero": _CLOSED_AT}
    ),
    "dex1-serial": Emulation(("dex1-motor", "--side", "{side}"), True, {"timeout": "0.3"}),
    "dex3-usb": Emulation(("dex3-usb", "--port", "0"), False),
    "inspire-serial": Emulation(("rh56", "--side", "{side}"), True, {"timeout": "0.3"}),
    "inspire-modbus": Emulation(("rh56", "--modbus-tcp", "0"), False, {"timeout": "0.3"}),
    "inspire-ftp-modbus": Emulation(
        ("rh56", "--modbus-tcp", "0", "--tactile"), False, {"timeout": "0.3"}
    ),
    "revo2-serial": Emulation(("revo2", "--side", "{side}"), True, {"timeout": "0.3"}),
}
"""Backends whose device the kit can start itself."""

ON_USB = ("dex3-usb",)
"""Backends whose device is judged on USB as well."""
SIMULATED = tuple(m.simulator for m in MODELS.values() if m.simulator)
"""Backends without a device, which have a setting ``object``."""
ROBOT_EMULATORS = {f"sim-{name}": name for name in ROBOTS}
"""Backends that are emulated robots: the names of their emulators."""
