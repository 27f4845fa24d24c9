"""A model of Unitree's teleoperation clients, and of the operator in front of them.

It closes the loop that a recording cannot: what xr_teleoperate commands depends on what the hand
reports. :mod:`~dexkit.teleop.client` is the client, :mod:`~dexkit.teleop.profiles` the operator,
:mod:`~dexkit.teleop.tracking` the figures, all sans-IO; :mod:`~dexkit.teleop.live` puts them on
DDS. See docs/teleop.md.
"""

from __future__ import annotations

from dexkit.teleop.client import (
    Dex1Client,
    FingerClient,
    Inputs,
    JointCommand,
    Pose,
    Release,
    StateReceiver,
    StickyFilter,
    TeleopClient,
)
from dexkit.teleop.hands import client_for, profile, profiles_for
from dexkit.teleop.profiles import Operator, Profile, recorded
from dexkit.teleop.tracking import TrackingFigures, tracking_figures

__all__ = [
    "Dex1Client",
    "FingerClient",
    "Inputs",
    "JointCommand",
    "Operator",
    "Pose",
    "Profile",
    "Release",
    "StateReceiver",
    "StickyFilter",
    "TeleopClient",
    "TrackingFigures",
    "client_for",
    "profile",
    "profiles_for",
    "recorded",
    "tracking_figures",
]
