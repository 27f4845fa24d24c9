"""Recognise what public programs put beside or on a hand's topics and is not that hand's protocol.

Sources: docs/sources/lerobot.md#a1 and docs/sources/mx64-ezgripper.md.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["TWO_FINGERS", "is_two_fingers", "other_interface"]

_SAKE = (
    "SAKE's own interface of the EZGripper (driver of 2026: JSON in a string, 0 closed to 100 % "
    "open); clients of a Dex1-1 use rt/dex1/{side}/cmd, which that driver has too"
)
_OTHERS = (
    (
        re.compile(
            r"rt/(gripper/(left|right)/(cmd_direct|state_direct|telemetry)"
            r"|gripper/debug/(left|right)|ezgripper/(left|right)/(admin|state))"
        ),
        _SAKE,
    ),
)

TWO_FINGERS = (
    "two finger motors in metres: LeRobot's simulation of a Dex1-1 (lerobot/unitree-g1-mujoco, "
    "end_effector dex1), which uses the topics and type of a Dex3-1"
)

_LEAST_GAIN = 100.0  # LeRobot's simulated fingers have kp 1000, its Dex3-1 1.5
_MOST_TRAVEL = 0.1  # m of a finger


def other_interface(topic: str) -> str:
    """What a topic is that belongs to a hand's driver and to no hand of the Dex family, or ""."""
    return next((what for pattern, what in _OTHERS if pattern.fullmatch(topic)), "")


def is_two_fingers(q: Sequence[float], kp: Sequence[float]) -> bool:
    """Whether a command on the topics of a Dex3-1 is for two fingers of a simulated gripper.

    :param q: of each motor of the message, as ``kp``.
    """
    return (
        len(kp) >= 2
        and min(kp[:2]) >= _LEAST_GAIN
        and not any(kp[2:])
        and all(abs(x) <= _MOST_TRAVEL for x in q[:2])
    )
