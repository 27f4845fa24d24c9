"""The ports to which LeRobot's ``unitree_g1`` connects in its hardware mode.

On a real G1 LeRobot's ``run_g1_server.py`` serves them: commands and states of the body as JSON
over ZeroMQ, pictures of a camera. :class:`LerobotPorts` serves the same ones for an emulated G1:
:mod:`~dexkit.emulators.lerobot.low_level_json` is the JSON,
:mod:`~dexkit.emulators.lerobot.freshness` decides which commands count,
:mod:`~dexkit.emulators.lerobot.camera` makes the pictures,
:mod:`~dexkit.emulators.lerobot.ports` has sockets and threads. See docs/lerobot.md.
"""

from __future__ import annotations

from dexkit.emulators.lerobot.ports import PORTS, Counters, LerobotPorts, Ports

__all__ = ["PORTS", "Counters", "LerobotPorts", "Ports"]
