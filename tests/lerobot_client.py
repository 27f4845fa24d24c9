"""LeRobot's side of the ports: the sockets, options and JSON of its ``unitree_sdk2_socket``.

Written from docs/sources/lerobot.md, for machines without LeRobot. ``tests/test_lerobot_soak.py``
uses LeRobot's own.
"""

from __future__ import annotations

import json
from types import TracebackType
from typing import Any

import zmq

from dexkit.robots import G1
from tests.patience import PATIENCE

__all__ = ["LerobotClient", "command_json"]


def command_json(q: dict[int, float], *, machine: int = 0, **more: Any) -> bytes:
    """A command with gains for the slots of ``q``; the others keep mode 0, as LeRobot's."""
    motors = []
    for slot in range(G1.slots):
        kp, kd = G1.client_gains[slot] if slot in q else (0.0, 0.0)
        goal = q.get(slot, 0.0)
        mode = int(slot in q)
        motors.append({"mode": mode, "q": goal, "dq": 0.0, "kp": kp, "kd": kd, "tau": 0.0})
    data = {"mode_pr": 0, "mode_machine": machine, "motor_cmd": motors, **more}
    return json.dumps({"topic": "rt/lowcmd", "data": data}).encode()


class LerobotClient:
    """Sockets that keep the newest message only, both ways."""

    def __init__(self, commands: int, states: int = 0) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.push = self._socket(zmq.PUSH, commands)
        self.sub = self._socket(zmq.SUB, states) if states else None

    def _socket(self, kind: int, port: int) -> zmq.Socket[bytes]:
        made = self.context.socket(kind)
        made.setsockopt(zmq.CONFLATE, 1)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.RCVTIMEO, int(PATIENCE * 1000))
        made.connect(f"tcp://127.0.0.1:{port}")
        if kind == zmq.SUB:
            made.setsockopt(zmq.SUBSCRIBE, b"")
        return made

    def send(self, payload: bytes) -> None:
        self.push.send(payload)

    def state(self) -> Any:
        """The next state's data."""
        assert self.sub is not None
        message = json.loads(self.sub.recv())
        assert message["topic"] == "rt/lowstate"
        return message["data"]

    def close(self) -> None:
        self.context.destroy(linger=0)

    def __enter__(self) -> LerobotClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
