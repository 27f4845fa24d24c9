"""The configuration: which hand, by which backend of dexkit."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig

__all__ = ["DexkitRobotConfig"]


@RobotConfig.register_subclass("dexkit")
@dataclass
class DexkitRobotConfig(RobotConfig):
    """One or two hands.

    :param backend: a name from ``dexkit backends``, or ``package.module:Object``.
    :param side: ``left``, ``right`` or ``both``.
    :param devices: path or serial number of each device, by side, where the backend needs one.
    :param settings: the backend's settings; ``left.KEY`` is for one hand.
    :param observe: of each joint: ``pos``, and where the hand measures them ``vel``, ``torque``.
    """

    backend: str
    side: str = "both"
    devices: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)
    observe: list[str] = field(default_factory=lambda: ["pos"])
