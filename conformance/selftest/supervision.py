"""A self-test under supervision: states in, commands out, at rest at the end whatever happens."""

from __future__ import annotations

from collections.abc import Generator
from enum import Enum

import numpy as np

from dexkit.command_age import PAUSE
from dexkit.conformance.selftest.procedure import Procedure
from dexkit.hand import HandCommand, HandState, MotorError

__all__ = ["End", "SelfTest"]

_HOT = 80.0
"""°C from which on no motor is driven on: five below the limit of Unitree's motors' cases."""
_LEAVING = 0.25
"""Seconds of commands to stay where it is, at the end; then the hand brakes."""
_NONSENSE = 20
"""States without a finite q, one after the other, that end the test."""


class End(str, Enum):
    """Reason for the end of a self-test."""

    DONE = "done"
    STOPPED = "stopped"
    FAULT = "fault"

    def __str__(self) -> str:
        return self.value


class SelfTest:
    """Sends a procedure the states of a hand, and supervises both.

    :ivar end: how it has ended, or is about to; None before. ``reason`` says why.
    :ivar finished: the hand is at rest; no more commands.
    """

    def __init__(self, procedure: Procedure) -> None:
        self.procedure = procedure
        self.end: End | None = None
        self.reason = ""
        self.finished = False
        self.paused = 0
        self._run: Generator[HandCommand, HandState, None] = procedure.run()
        self._next = next(self._run)
        self._leaving: float | None = None
        self._last: float | None = None
        self._nonsense = 0
        self.begin = self.now = 0.0

    @property
    def command(self) -> HandCommand:
        """The command of the next exchange."""
        return self._next

    def stop(self, end: End, reason: str) -> None:
        """End the tests; the hand is left at rest first."""
        if self.end is None:
            self.end, self.reason = end, reason
            self._run.close()

    def abandon(self, reason: str) -> None:
        """End at once: the hand cannot be commanded any more."""
        self.stop(End.FAULT, reason)
        self.finished = True

    def step(self, state: HandState) -> None:
        """Take the state of an exchange, and make the next command."""
        if self._last is None:
            self.begin = state.stamp
        elif state.stamp - self._last > PAUSE:
            self.paused += 1
        self._last = self.now = state.stamp
        if not np.isfinite(state.q).all():
            self._nonsense += 1
            if self._nonsense >= _NONSENSE:
                self.abandon("the hand reports no positions")
            return
        self._nonsense = 0
        if self.end is None and (problem := self._problem(state)):
            self.stop(End.FAULT, problem)
        if self.end is None:
            try:
                self._next = self._run.send(state)
                return
            except StopIteration:
                self.end, self.reason = End.DONE, "every test was done"
        self._leave(state)

    def _leave(self, state: HandState) -> None:
        bench = self.procedure.bench
        if bench.state is None or self.end is End.FAULT:
            self._next, self._leaving = bench.rest(), self._leaving or state.stamp
            self.finished = state.stamp - self._leaving >= _LEAVING
            return
        if self._leaving is None:
            self._leaving = state.stamp
            bench.state = state
            self._next = bench.hold()
        elif state.stamp - self._leaving >= _LEAVING:
            bench.state = state
            self._next = bench.rest()
            self.finished = state.stamp - self._leaving >= 2 * _LEAVING

    def _problem(self, state: HandState) -> str:
        names = [joint.name for joint in self.procedure.setup.spec.joints]
        for name, bits in zip(names, state.fault.tolist(), strict=True):
            if bits:
                known = [str(e.name).lower() for e in MotorError if e and bits & e]
                return f"{name} reports {', '.join(known) or hex(bits)}"
        for name, celsius in zip(names, state.temperature.tolist(), strict=True):
            if celsius >= _HOT:
                return f"{name} is at {celsius:.0f} degrees Celsius"
        return f"the hand reports error {state.error:#x}" if state.error else ""
