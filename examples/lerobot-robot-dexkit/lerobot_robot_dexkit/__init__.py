"""Any hand of dexkit as a robot of LeRobot: ``--robot.type=dexkit``."""

from __future__ import annotations

from lerobot_robot_dexkit.config_dexkit_robot import DexkitRobotConfig
from lerobot_robot_dexkit.dexkit_robot import DexkitRobot
from lerobot_robot_dexkit.errors import (
    ActionRefused,
    AlreadyConnected,
    ConfigRefused,
    DexkitRobotError,
    NotConnected,
    NotMeasured,
)

__all__ = [
    "ActionRefused",
    "AlreadyConnected",
    "ConfigRefused",
    "DexkitRobot",
    "DexkitRobotConfig",
    "DexkitRobotError",
    "NotConnected",
    "NotMeasured",
]
