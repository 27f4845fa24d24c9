"""A client on Unitree's Python SDK and the cyclonedds wheel 0.10.2, in an environment of its own.

Reads the states of a left Dex1-1, sends commands until the gripper is where they say, and prints
what it saw as JSON. It imports nothing of dexkit::

    python peer.py DOMAIN
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from importlib import metadata
from types import ModuleType
from typing import Any

TARGET = 2.7  # rad, half of the stroke
_CLOSE = 0.05  # rad
_PATIENCE = 30.0  # seconds
_PERIOD = 0.005  # seconds, as the SDK's clients


def main(domain: int) -> int:
    """Talk to the gripper; 0 if it came to where it was sent."""
    # the SDK's wheel does not import without it, and its log has one fixed name for all users
    sys.modules.setdefault("unitree_sdk2py.b2", ModuleType("unitree_sdk2py.b2"))
    channel: Any = importlib.import_module("unitree_sdk2py.core.channel")
    channel.ChannelConfigHasInterface = channel.ChannelConfigHasInterface.replace(
        "/tmp/cdds.LOG", os.devnull
    )
    types: Any = importlib.import_module("unitree_sdk2py.idl.unitree_go.msg.dds_")
    channel.ChannelFactoryInitialize(domain, "lo")
    seen: list[float] = []
    states = channel.ChannelSubscriber("rt/dex1/left/state", types.MotorStates_)
    states.Init(lambda message: seen.append(message.states[0].q), 10)
    commands = channel.ChannelPublisher("rt/dex1/left/cmd", types.MotorCmds_)
    commands.Init()
    motor = types.MotorCmd_(1, TARGET, 0.0, 0.0, 5.0, 0.05, [0, 0, 0])
    end = time.monotonic() + _PATIENCE
    arrived = False
    while not arrived and time.monotonic() < end:
        if seen:  # what comes first is where it was before any command
            commands.Write(types.MotorCmds_([motor]))
            arrived = abs(seen[-1] - TARGET) < _CLOSE
        time.sleep(_PERIOD)
    result = {
        "dds": f"cyclonedds {metadata.version('cyclonedds')}",
        "python": sys.version.split()[0],
        "states": len(seen),
        "first": seen[0] if seen else None,
        "last": seen[-1] if seen else None,
        "target": TARGET,
    }
    print(json.dumps(result), flush=True)
    # the SDK's threads have no end
    os._exit(0 if arrived else 1)


if __name__ == "__main__":
    main(int(sys.argv[1]))
