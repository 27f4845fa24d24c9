"""Emulated robots, H1 and G1, on Unitree's low-level topics; see docs/robots.md."""

from dexkit.emulators.robot.mechanics import Counters, RobotMechanics
from dexkit.emulators.robot.motion_switcher import MotionSwitcher
from dexkit.emulators.robot.run import EmulatedRobot, run_robot
from dexkit.emulators.robot.settings import Remote, Settings

__all__ = [
    "Counters",
    "EmulatedRobot",
    "MotionSwitcher",
    "Remote",
    "RobotMechanics",
    "Settings",
    "run_robot",
]
