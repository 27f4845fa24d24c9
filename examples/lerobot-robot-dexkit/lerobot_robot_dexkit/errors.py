"""Errors of the robot; they are dexkit's and LeRobot's or Python's at once.

::

    dexkit.errors.DexkitError
    ├── DexkitRobotError
    │   ├── NotConnected (LeRobot's DeviceNotConnectedError)
    │   ├── AlreadyConnected (LeRobot's DeviceAlreadyConnectedError)
    │   ├── ConfigRefused (ValueError)     a side, device or observation that there is not
    │   ├── ActionRefused (ValueError)     a joint is missing, unknown, or its target no number
    │   └── NotMeasured                    the hand does not measure what is to be observed
    └── HandError                          of the hand itself, passed on as they are:
        ├── HandNotFound, HandRefused          at connect, for example without a calibration
        ├── HandLost (ConnectionError)         its cable or supply has gone
        ├── HandTimeout (TimeoutError)         it does not answer
        └── HandFault                          it reports a hardware error
"""

from __future__ import annotations

from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from dexkit.errors import DexkitError

__all__ = [
    "ActionRefused",
    "AlreadyConnected",
    "ConfigRefused",
    "DexkitRobotError",
    "NotConnected",
    "NotMeasured",
]


class DexkitRobotError(DexkitError):
    """Base of the errors of this package."""


class NotConnected(DexkitRobotError, DeviceNotConnectedError):
    """The robot was not connected, or was disconnected."""


class AlreadyConnected(DexkitRobotError, DeviceAlreadyConnectedError):
    """The robot is connected."""


class ConfigRefused(DexkitRobotError, ValueError):
    """The configuration names something that there is not."""


class ActionRefused(DexkitRobotError, ValueError):
    """An action that is not one finite number for each joint; nothing was sent."""


class NotMeasured(DexkitRobotError):
    """The hand does not measure what the configuration wants to observe."""
