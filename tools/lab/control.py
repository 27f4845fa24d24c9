"""What the guest asks of this machine and reports to it: lines of JSON over one TCP connection."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any

from dexkit.tcp_listener import listen
from tools.lab.devices import Devices
from tools.lab.report import Case

__all__ = ["Control"]


class Control:
    """Listens on the loopback address, which is 10.0.2.2 for the guest.

    :param devices: whose records the guest may read.
    :param on_case: called with each case that the guest has finished.

    :ivar port: the port taken.
    :ivar facts: what the guest has said about itself.
    :ivar finished: whether the guest has said that it has done everything.
    """

    def __init__(self, devices: Devices, on_case: Callable[[Case], object]) -> None:
        self._devices = devices
        self._on_case = on_case
        self.facts: dict[str, Any] = {}
        self.finished = False
        self._listener = listen("127.0.0.1", 0)
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, name="control", daemon=True).start()

    def _serve(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # closed before the guest came
            return
        with connection, connection.makefile("rw") as lines:
            for line in lines:
                answer = self._answer(json.loads(line))
                lines.write(json.dumps(answer) + "\n")
                lines.flush()

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        kind = message["do"]
        if kind == "case":
            self._on_case(Case(**message["case"]))
        elif kind == "fact":
            self.facts.update(message["facts"])
        elif kind == "finished":
            self.finished = True
        elif kind == "now":
            return self._devices.records[message["device"]].now()
        elif kind == "since":
            return self._devices.records[message["device"]].since(message["t"])
        elif kind == "stopped":
            return self._devices.records[message["device"]].stopped(message["t"])
        return {}

    def close(self) -> None:
        """Listen no more."""
        self._listener.close()
