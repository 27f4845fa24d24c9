"""A client on DDS in the guest: commands at a rate, and what the states say."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

from dexkit.dds import DdsNode
from dexkit.hand import JointMode, Side
from dexkit.messages import message_type
from dexkit.models import dialect
from tools.lab.guest.bench import Failed, wait_for

__all__ = ["DOMAIN", "Client"]

DOMAIN = 1
_RATE = 20.0  # fewer than a robot's client sends: the guest's processor has to encode them
_LINK_DOWN = 1 << 31


class Client:
    """Commands one hand, and watches its states.

    :param language: the dialect.
    :param kp: gains of each command, N m/rad and N m s/rad.

    :ivar states: how many have come.
    """

    def __init__(self, node: DdsNode, language: str, side: Side, kp: float, kd: float) -> None:
        self._dialect = dialect(language)
        self._gains = kp, kd
        command, state = self._dialect.topics(side)
        self._writer = node.writer(command, self._dialect.cmd_type)
        self._reader = node.reader(state, self._dialect.state_type, on_data=self._take)
        self._target: list[float] | None = None
        self._newest: Any = None
        self.states = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()
        try:
            wait_for(lambda: self.states, f"no state on {state}")
            if not self._writer.wait_matched(30):
                raise Failed(f"nobody reads {command}")
        except BaseException:
            self.close()
            raise

    def _take(self) -> None:
        for sample in self._reader.take():
            self._newest = sample.message
            self.states += 1

    def _send(self) -> None:
        while not self._stop.wait(1 / _RATE):
            target = self._target
            if target is not None:
                self._writer.write(self._message(target))

    def _message(self, target: Sequence[float]) -> Any:
        kp, kd = self._gains
        kind = message_type(self._dialect.cmd_type)
        modes = [self._dialect.mode(i, JointMode.FOC) for i in range(len(target))]
        motor = kind.motor_type.cls
        return kind.of_motors(
            [motor(mode=m, q=q, kp=kp, kd=kd) for m, q in zip(modes, target, strict=True)]
        )

    def go(self, target: Sequence[float]) -> None:
        """Command ``target`` (rad), from now on."""
        self._target = list(target)

    def silent(self) -> None:
        """Command nothing any more."""
        self._target = None

    @property
    def motors(self) -> list[Any]:
        """The motors of the newest state."""
        return message_type(self._dialect.state_type).motors(self._newest)

    @property
    def q(self) -> list[float]:
        """Positions of the newest state, rad."""
        return [float(motor.q) for motor in self.motors]

    @property
    def linked(self) -> bool:
        """Whether the newest state says that the device is there."""
        motor = self.motors[0]
        word = motor.motorstate if hasattr(motor, "motorstate") else motor.reserve[0]
        return not word & _LINK_DOWN

    def arrived(self, target: Sequence[float], within: float) -> bool:
        """Whether every joint is near ``target``."""
        return all(abs(q - t) < within for q, t in zip(self.q, target, strict=True))

    def rate(self, seconds: float) -> float:
        """States a second."""
        before, started = self.states, time.monotonic()
        time.sleep(seconds)
        return (self.states - before) / (time.monotonic() - started)

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        self._thread.join()
        self._reader.close()
        self._writer.close()
