"""A hand that another program serves on DDS, as a :class:`~dexkit.hand.Hand`.

Its states are those of the topic, stamped when they were received; its joints are the model's. It
gives way to any other client of the hand.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dexkit.clock import Clock, RealClock
from dexkit.errors import DdsError, HandTimeout, UsageError, WireError
from dexkit.hand import Floats, HandCommand, HandSpec, HandState, JointMode, Side
from dexkit.messages import message_type
from dexkit.models import Dialect, ModeByte, model
from dexkit.pressure import NO_VALUE
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.teleop.client import JointCommand
from dexkit.teleop.client_codec import ClientCodec

if TYPE_CHECKING:
    import threading

    from dexkit.dds import DdsNode, Reader

__all__ = ["ExternalHand", "ExternalHandCodec"]

_NAP = 0.05
_RATE_TIME = 0.5
"""Seconds in which the rate of the states is counted."""
_SLOWEST = 5.0
_SILENT = 1.0


class ExternalHandCodec:
    """Commands to one side of a dialect, and its states, in the model's units.

    :raises UsageError: a command of this dialect moves both hands.
    """

    def __init__(self, spoken: Dialect, side: Side) -> None:
        if spoken.commands_both:
            raise UsageError(
                f"a command of {spoken.name} moves both hands, but a self-test drives one",
                hint="test it where it is driven: dexkit selftest BACKEND",
            )
        self.dialect, self.side = spoken, side
        profile = model(spoken.model)
        self._joints = profile.joints[side]
        n = len(self._joints)
        self._client = ClientCodec(spoken)
        self._state = message_type(spoken.state_type)
        self.command_topic, self.state_topic = spoken.topics(side)
        self._torque = np.array(spoken.torque_units or (1.0,) * n)
        self._speed = np.array(spoken.speed_units or (1.0,) * n)
        self._scale = spoken.q_open / self._joints[0].q_max if spoken.is_gripper else 1.0
        self._slots = tuple(sensor.slots for sensor in profile.sensors)
        self._first = spoken.index[side]

    def encode(self, command: HandCommand, q: Floats) -> bytes:
        """A command on the wire. A joint that brakes is commanded to stay at ``q``, without
        gains.
        """
        rows = []
        for j, mode in enumerate(command.mode.tolist()):
            if mode == JointMode.BRAKE:
                rows.append(
                    JointCommand(self._mode(j, mode), float(q[j]) * self._scale, *(0.0,) * 4)
                )
                continue
            rows.append(
                JointCommand(
                    self._mode(j, mode),
                    float(command.q[j]) * self._scale,
                    float(command.dq[j] / self._speed[j]) * self._scale,
                    float(command.tau[j] / self._torque[j]),
                    float(command.kp[j]),
                    float(command.kd[j]),
                )
            )
        ((_, payload),) = self._client.encode({self.side: rows})
        return payload

    def _mode(self, index: int, status: int) -> int:
        byte = self.dialect.mode_byte
        if byte is ModeByte.RIS:
            return index | status << 4
        return status if byte is ModeByte.STATUS else 0

    def decode(self, data: bytes, stamp: float) -> HandState | None:
        """The hand in a state message; None if it is too short for it.

        :raises WireError: it is not of the dialect's state type.
        """
        message = self._state.decode(data)
        every = self._state.motors(message)
        motors = every[self._first : self._first + len(self._joints)]
        if len(motors) < len(self._joints):
            return None
        full = hasattr(motors[0], "motorstate")
        temperature = np.array([_celsius(m.temperature) for m in motors]).T
        return HandState.from_values(
            [m.q / self._scale for m in motors],
            stamp=stamp,
            dq=np.array([m.dq / self._scale for m in motors]) * self._speed,
            tau_est=np.array([m.tau_est for m in motors]) * self._torque,
            temperature=temperature[0],
            winding_temperature=temperature[1],
            fault=[int(m.motorstate if full else m.reserve[0]) for m in motors],
            mode=[(m.mode >> 4) & 7 if self.dialect.mode_byte is ModeByte.RIS else m.mode & 1
                  for m in motors],
            pressure=self._pressure(getattr(message, "press_sensor_state", ())),
        )  # fmt: skip

    def _pressure(self, packets: Sequence[Any]) -> Floats | None:
        if not self._slots or len(packets) < len(self._slots):
            return None
        found = np.full((len(self._slots), 12), math.nan)
        for row, packet, slots in zip(found, packets, self._slots, strict=False):
            for slot in slots:
                value = float(packet.pressure[slot])
                row[slot] = math.nan if value == NO_VALUE else value
        return found


def _celsius(value: Any) -> tuple[float, float]:
    """(case, winding); 0 stands for unknown on the wire."""
    pair = value if isinstance(value, tuple | list) else (value, value)
    return float(pair[0] or math.nan), float(pair[1] or math.nan)


class ExternalHand:
    """A served hand.

    :param node: where it is; stays open.
    :param stop: ends the wait for the hand.
    :param waiting: called with the seconds waited so far; may raise.
    :param force: command beside other clients.
    """

    def __init__(
        self,
        node: DdsNode,
        spoken: Dialect,
        side: Side,
        *,
        stop: threading.Event,
        waiting: Callable[[float], object] = lambda seconds: None,
        force: bool = False,
        clock: Clock | None = None,
    ) -> None:
        profile = model(spoken.model)
        self._node, self._wire = node, ExternalHandCodec(spoken, side)
        self._stop, self._waiting, self._force = stop, waiting, force
        self._clock = clock or RealClock()
        self._spec = profile.spec(side, io_rate=profile.state_rate)
        self._last: HandState | None = None

    @property
    def spec(self) -> HandSpec:
        """The model's joints, at the model's rate."""
        return self._spec

    def open(self) -> None:
        """Wait for the hand to listen and to publish; sends nothing.

        :raises TopicConflict: another program commands it.
        :raises DdsError: stopped meanwhile.
        """
        from dexkit.dds import Qos

        wire, node = self._wire, self._node
        self._sole = SolePublisher(
            [NodeTopics(node, [wire.command_topic])],
            verb="commands",
            hint="stop that client, or go on with --force",
            force=self._force,
            yields=True,
        )
        self._sole.search()
        claim = self._sole.announce()
        self._writer = node.writer(
            wire.command_topic, wire.dialect.cmd_type, qos=Qos.writer_default(), user_data=claim
        )
        self._sole.settle()
        self._reader: Reader = node.reader(
            wire.state_topic, wire.dialect.state_type, qos=Qos.reader_default()
        )
        begin = time.monotonic()
        while not self._stop.is_set():
            self._sole.poll()
            self._read()
            if self._writer.matched and self._last is not None:
                self._measure_rate()
                return
            self._waiting(time.monotonic() - begin)
            self._stop.wait(_NAP)
        raise DdsError("stopped while waiting for the hand")

    def _measure_rate(self) -> None:
        """Exchange no faster than states come."""
        begin, states = self._clock.now(), 0
        while self._clock.now() < begin + _RATE_TIME:
            states += self._read()
            self._clock.sleep_until(self._clock.now() + 1e-3)
        rate = max(states / (self._clock.now() - begin), _SLOWEST)
        self._spec = replace(self._spec, io_rate=min(rate, self._spec.io_rate))

    def close(self) -> None:
        """Nothing more is sent: the service's time-out brakes moving joints."""

    def exchange(self, command: HandCommand) -> HandState:
        """Publish a command, and return the newest state.

        :raises HandTimeout: no state for a second: hand and test share a machine that may pause.
        :raises TopicConflict: another program commands the hand now.
        """
        self._sole.poll()
        assert self._last is not None
        asked, fresh = self._clock.now(), self._read()
        # stamped first: a command that a stop holds back here is old, and is seen to be
        now_ns = time.time_ns()
        self._writer.write_raw(self._wire.encode(command, self._last.q), now_ns)
        # by when it was read: a stop of this program since then is no silence of the hand
        silent = asked - self._last.stamp
        if not fresh and silent > _SILENT:
            raise HandTimeout(f"no state of the hand for {silent:.1f} s")
        return self._last

    def _read(self) -> int:
        """Take new states; returns their number."""
        now = self._clock.now()
        samples = self._reader.take()
        for sample in samples[-1:]:
            with contextlib.suppress(WireError):
                state = self._wire.decode(sample.data, now)
                if state is not None:
                    self._last = state
        return len(samples)
