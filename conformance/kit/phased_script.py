"""A stimulus as a script without input and output, and the one loop that plays scripts.

A script's :meth:`~PhasedScript.run` is a generator. It yields actions, a player carries each out
and sends back what it observed. A live player does so on DDS or on USB, a virtual one with a hand
in memory on a virtual clock; the script is the same for both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from typing import Generic, Protocol, TypeVar

__all__ = ["PhasedScript", "play"]


class _Timed(Protocol):
    @property
    def now_ns(self) -> int: ...


class _Stretch(Protocol):
    begin_ns: int
    end_ns: int


A = TypeVar("A")
O = TypeVar("O", bound=_Timed)  # noqa: E741
P = TypeVar("P", bound=_Stretch)


class PhasedScript(ABC, Generic[A, O, P]):
    """A stimulus script that records its phases.

    :param start: what is known before the first action.
    :param report: called with progress messages for the user.
    :ivar phases: what was done when, on the recording's clock; kept with the recording.
    """

    def __init__(self, start: O, report: Callable[[str], None] = lambda text: None) -> None:
        self.phases: list[P] = []
        self.report = report
        self.obs = start
        self.next_ns = 0

    @abstractmethod
    def run(self) -> Generator[A, O, None]:
        """The whole script."""

    def do(self, action: A) -> Generator[A, O, O]:
        """Yield an action to the player; return the observation after it."""
        self.obs = yield action
        return self.obs

    def mark(self, phase: P) -> P:
        """Record that a phase begins."""
        self.phases.append(phase)
        return phase

    def end(self, phase: P) -> None:
        """End a phase now."""
        phase.end_ns = self.obs.now_ns

    def elapsed(self, phase: P) -> float:
        """Seconds since a phase began."""
        return (self.obs.now_ns - phase.begin_ns) / 1e9

    def repeat(
        self, seconds: float, step: Callable[[], Generator[A, O, None]]
    ) -> Generator[A, O, None]:
        """Repeat ``step`` for ``seconds``."""
        end = self.obs.now_ns + round(seconds * 1e9)
        while self.obs.now_ns < end:
            yield from step()

    def through(
        self, phase: P, seconds: float, step: Callable[[], Generator[A, O, None]]
    ) -> Generator[A, O, None]:
        """Repeat ``step`` until the phase is ``seconds`` long, and end it."""
        while self.elapsed(phase) < seconds:
            yield from step()
        self.end(phase)


def play(
    script: PhasedScript[A, O, P],
    carry_out: Callable[[A], O],
    stopped: Callable[[], bool] = lambda: False,
) -> bool:
    """Play a script to its end.

    :param carry_out: carries out an action, and returns what was observed after it.
    :param stopped: asked before each action.
    :returns: False when it was stopped.
    """
    steps = script.run()
    action = next(steps)
    while not stopped():
        observation = carry_out(action)
        try:
            action = steps.send(observation)
        except StopIteration:
            return True
    return False
