"""What hands, robots and their clients must do: one file for each behaviour, for all models, and
beside it a module with the phases that show it and the checks that judge it.

:mod:`dexkit.conformance.kit.requirements` reads them and explains their keys.
"""

from __future__ import annotations

__all__ = ["AREAS", "BEHAVIOURS", "CHECKS"]

BEHAVIOURS = (
    "discovery",
    "start_up",
    "order",
    "rate",
    "freshness",
    "fields",
    "position",
    "velocity",
    "usb_descriptors",
    "usb_exchange",
    "usb_frames",
    "checksums",
    "robot_state",
    "motion",
    "sides",
    "gains",
    "stillness",
    "speed",
    "mode_byte",
    "touch",
    "pressure",
    "attitude",
    "force",
    "grip",
    "bad_commands",
    "watchdog",
    "two_clients",
    "timeout_protection",
    "damaged_frames",
    "load",
    "life_cycle",
    "tracking",
    "operator",
    "client",
)
"""The behaviours, in the order in which requirements of one area are listed."""

CHECKS = tuple(f"{__name__}.{name}" for name in BEHAVIOURS)
"""The modules with their phases and checks, one beside each file."""

AREAS = (
    "Discovery",
    "Start-up",
    "Integrity",
    "Rate",
    "Fields",
    "Motion",
    "Mode byte",
    "Force",
    "Sensors",
    "Safety",
    "Time-out protection",
    "Watchdog",
    "Load",
    "Life cycle",
    "Tracking",
    "Operator",
    "The client",
    "USB: descriptors",
    "USB: exchange",
    "USB: frames",
    "USB: motion",
    "USB: time-out protection",
    "USB: damaged frames",
    "USB: connection",
)
"""Headings under which reports group requirements, in their order."""
