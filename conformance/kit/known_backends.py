"""The backends that the kit starts itself: simulated hands, emulated devices and robots."""

from __future__ import annotations

from dexkit.backends import Backend, Emulator, backend, simulators
from dexkit.robots import ROBOTS

__all__ = ["EXTERNAL", "ROBOT_EMULATORS", "SIMULATED", "emulator_of", "has_usb_requirements"]

EXTERNAL = "external"
"""The backend's name for a service that the kit does not start."""

SIMULATED = tuple(simulators().values())
"""Backends without a device, which have a setting ``object``."""
ROBOT_EMULATORS = {f"sim-{name}": name for name in ROBOTS}
"""Backends that are emulated robots: the names of their emulators."""


def emulator_of(name: str) -> Emulator | None:
    """How the kit emulates the device of a backend; None where it cannot, or there is none.

    :raises BackendError: there is no such backend, or it cannot be loaded.
    """
    found = _hand(name)
    return None if found is None else found.emulator


def has_usb_requirements(name: str) -> bool:
    """Whether the device of a backend is judged on USB as well.

    :raises BackendError: there is no such backend, or it cannot be loaded.
    """
    found = _hand(name)
    return found is not None and found.usb_requirements


def _hand(name: str) -> Backend | None:
    """The backend of that name; None where the kit starts none, or it is a robot."""
    if name == EXTERNAL or name in ROBOT_EMULATORS:
        return None
    return backend(name)
