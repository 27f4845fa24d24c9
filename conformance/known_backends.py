"""The backends that the kit starts itself: simulated hands, emulated devices and robots."""

from __future__ import annotations

from dexkit.backends import Emulator, backend
from dexkit.models import MODELS
from dexkit.robots import ROBOTS

__all__ = ["EXTERNAL", "ROBOT_EMULATORS", "SIMULATED", "emulator_of", "has_usb_requirements"]

EXTERNAL = "external"
"""The backend's name for a service that the kit does not start."""

SIMULATED = tuple(m.simulator for m in MODELS.values() if m.simulator)
"""Backends without a device, which have a setting ``object``."""
ROBOT_EMULATORS = {f"sim-{name}": name for name in ROBOTS}
"""Backends that are emulated robots: the names of their emulators."""


def emulator_of(name: str) -> Emulator | None:
    """How the kit emulates the device of a backend; None where it cannot, or there is none.

    :raises BackendError: there is no such backend, or it cannot be loaded.
    """
    return None if _is_no_hand(name) else backend(name).emulator


def has_usb_requirements(name: str) -> bool:
    """Whether the device of a backend is judged on USB as well.

    :raises BackendError: there is no such backend, or it cannot be loaded.
    """
    return not _is_no_hand(name) and backend(name).usb_requirements


def _is_no_hand(name: str) -> bool:
    return name == EXTERNAL or name in ROBOT_EMULATORS
