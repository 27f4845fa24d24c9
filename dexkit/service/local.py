"""Drive a hand from this process, without DDS, with the rules of the service.

    with LocalHand(backend("sim-dex3").create(BackendOptions(Side.LEFT))) as hand:
        hand.move_to(goal)
        print(hand.state().q)

Commands go through the same :class:`~dexkit.service.hand_core.HandCore` as those of a client on
DDS: limits, time-out, slow first motion of a real hand, brake after a pause, a fault or a
reconnection.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dexkit.clock import Clock
from dexkit.errors import DexkitError, HandFault, HandLost, HandTimeout
from dexkit.hand import CommandGate, Floats, Hand, HandCommand, HandState, MotorError
from dexkit.models import HandModel, model
from dexkit.service.hand_core import HandCore
from dexkit.service.publisher import Publisher
from dexkit.service.service import HandService

__all__ = ["LocalHand", "NoTopics"]

_RATE = 20.0  # Hz; nothing is published, but the service looks for its own pauses at this rate
_LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


class LocalHand:
    """One hand, driven by this process; a context manager.

    :param hand: as a backend makes it.
    :param clock: real time unless given.

    A hand whose process ends without :meth:`stop` is stopped at the end of the interpreter; a
    process that is killed leaves it to the device's own time-out.
    """

    def __init__(self, hand: Hand, *, clock: Clock | None = None) -> None:
        self.model: HandModel = model(hand.spec.model)
        self._service = HandService(
            hand, node=NoTopics(), publisher=Publisher(_RATE, clock), clock=clock
        )
        self._core: HandCore = self._service.cores[hand.spec.side]
        self._gate = CommandGate(hand.spec)
        self._running = False

    @property
    def running(self) -> bool:
        """Whether it was started and not stopped."""
        return self._running

    @property
    def core(self) -> HandCore:
        """Counters and the present command."""
        return self._core

    def start(self) -> None:
        """Open the hand; it brakes until the first command. A stopped one cannot start again.

        :raises HandError: it cannot be opened.
        """
        self._service.start()
        self._running = True
        atexit.register(self.stop)

    def stop(self) -> None:
        """Brake and release the hand. May be called twice."""
        self._running = False
        atexit.unregister(self.stop)
        self._service.stop()

    def __enter__(self) -> LocalHand:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def move_to(self, q: ArrayLike) -> Floats:
        """Command a position of every joint, with the gains of Unitree's client.

        The command is in force until the next one, at most for the model's command time-out; then
        the hand brakes.

        :param q: shape (n_joints,), in the model's unit.
        :returns: the position commanded, within the limits.
        :raises CommandRejected: ``q`` is not finite, or of another shape; nothing is sent.
        :raises HandError: as :meth:`state`.
        """
        self.state()
        command = self._gate.admit(position_command(self.model, q))
        self._core.submit(command)
        return command.q

    def state(self) -> HandState:
        """The newest state.

        :raises HandLost: the device has gone, or the hand was not started; it is being opened
            again.
        :raises HandTimeout: the device has not answered for a quarter of a second or more.
        :raises HandFault: the device reports a hardware error and does not exchange.
        :raises DexkitError: a thread has died.
        """
        spec = self._core.spec
        failure = self._service.failure
        if failure is not None:
            raise DexkitError(f"the {spec.side} hand is no longer driven: {failure}")
        view = self._core.view() if self._running else None
        if view is None or not self._core.connected:
            raise HandLost(
                f"the {spec.side} {spec.model} is not connected",
                hint="check its cable and supply; it is opened again automatically",
            )
        bits = [fault & ~_LINK for fault in view.fault]
        if view.missed and any(bits):
            names = [f"{joint.name}: {MotorError(b)!r}" for joint, b in
                     zip(spec.joints, bits, strict=True) if b]  # fmt: skip
            raise HandFault(
                f"the {spec.side} {spec.model} reports a fault: {', '.join(names)}", bits=bits
            )
        if any(fault & _LINK for fault in view.fault):
            raise HandTimeout(f"the {spec.side} {spec.model} does not answer")
        return view.state


def position_command(hand: HandModel, q: ArrayLike) -> HandCommand:
    """The command for a position with the gains, or the speed, that Unitree's client sends.

    :param q: shape (n_joints,), in the model's unit.
    """
    goal = np.array(q, dtype=np.float64, ndmin=1)
    joints = next(iter(hand.joints.values()))
    kp, kd = np.array(hand.gains).T
    servo = hand.dialects[0].position_servo
    speed = [joint.dq_max for joint in joints] if servo else 0.0
    return HandCommand(
        q=goal,
        dq=np.full(len(joints), speed),
        tau=np.zeros(len(joints)),
        kp=kp,
        kd=kd,
        mode=np.ones(len(joints), dtype=np.uint8),
    )


class NoTopics:
    """A :class:`~dexkit.service.service.Node` without other participants."""

    def writer(self, topic: str, type_name: str, *, user_data: bytes = b"") -> _Nobody:
        """A writer without readers."""
        return _Nobody()

    def reader(
        self, topic: str, type_name: str, *, on_data: Callable[[], object] | None = None
    ) -> _Nobody:
        """A reader without writers."""
        return _Nobody()

    def endpoints(self) -> Sequence[Any]:
        """None."""
        return ()

    def close(self) -> None:
        """Nothing is open."""


class _Nobody:
    matched = 0

    def take(self) -> Sequence[Any]:
        return ()

    def write_raw(self, data: bytes, source_timestamp_ns: int | None = None) -> bool:
        return True

    def close(self) -> None:
        return
