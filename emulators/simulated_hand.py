"""Implement :class:`dexkit.hand.Hand` on simulated mechanics, without a device protocol.

The command in force stays in force until the next one, as in a real motor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from dexkit.backends import BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.command_age import PAUSE
from dexkit.documents import read_bytes, write_file
from dexkit.emulators.joint_mechanics import FixedSteps
from dexkit.errors import HandLost, OutputError, UsageError
from dexkit.escaping import one_line
from dexkit.hand import HandCommand, HandSpec, HandState

__all__ = ["COMMON_SETTINGS", "Mechanics", "SimulatedHand", "configured", "number"]

COMMON_SETTINGS = {
    "pose": "a file that keeps the joints' positions from one start to the next, as a real hand "
    "does (default: none)",
}
"""The settings of every simulated hand."""

_LARGEST_POSE = 65_536
"""Largest pose file, bytes; more than the positions of any hand need."""


class Mechanics(Protocol):
    """Mechanics that advance in fixed steps."""

    def brake(self) -> None:
        """Brake every joint."""

    def stop(self) -> None:
        """Set all speeds to 0."""

    def step(self, n: int = 1) -> None:
        """Advance by ``n`` steps."""

    def apply(self, command: HandCommand) -> None:
        """Apply ``command`` until the next one."""

    def state(self, stamp: float) -> HandState:
        """The state, measured at ``stamp``."""

    def place(self, q: Sequence[float]) -> None:
        """Put the joints at ``q``, shape (n_joints,), at rest."""


class SimulatedHand:
    """A hand whose mechanics follow a clock.

    :param step: seconds of one step of the mechanics.
    :param clock: real time unless given; with a manual clock the hand is deterministic. After a
        pause of the caller of more than a quarter of a second the hand has braked since; of more
        than half a second only the end is simulated.
    """

    def __init__(
        self, spec: HandSpec, mechanics: Mechanics, step: float, clock: Clock | None = None
    ) -> None:
        self._spec = spec
        self._mechanics = mechanics
        self._clock: Clock = clock or RealClock()
        self._steps = FixedSteps(step, most=0.5)
        self._last = 0.0  # time of the last exchange
        self._open = False
        self._pose: Path | None = None

    def keep_pose(self, file: Path) -> None:
        """Keep the pose in ``file``: ``open`` starts with the pose of the last ``close``, if the
        file exists.

        :raises UsageError: the file is not one that :meth:`close` wrote for such a hand.
        """
        self._pose = file
        spec, name = self._spec, one_line(str(file), 200)
        try:
            if not file.exists():
                return
            data = read_bytes(file, _LARGEST_POSE)
            q = [float(value) for value in json.loads(data)]
        except (OSError, ValueError, TypeError, RecursionError) as error:
            why = one_line(str(error), 200)
            raise UsageError(f"pose: {name} is not readable: {why}") from error
        if len(q) != spec.n_joints or not all(map(math.isfinite, q)):
            raise UsageError(
                f"pose: {name} does not have the {spec.n_joints} positions of this hand",
                hint="remove the file, or give each hand its own",
            )
        self._mechanics.place(q)

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    def open(self) -> None:
        """Start the simulation; the hand brakes until the first command."""
        self._mechanics.brake()
        self._last = self._clock.now()
        self._steps.restart(self._last)
        self._open = True

    def close(self) -> None:
        """Stop the hand at its present position.

        :raises UsageError: the file of :meth:`keep_pose` cannot be written.
        """
        self._open = False
        self._mechanics.stop()
        if self._pose is not None:
            self._save_pose(self._pose)

    def _save_pose(self, file: Path) -> None:
        q = self._mechanics.state(self._last).q.tolist()
        try:
            write_file(file, json.dumps(q) + "\n")
        except OutputError as error:
            raise UsageError(f"pose: {one_line(error.message, 400)}") from error

    def exchange(self, command: HandCommand) -> HandState:
        """Advance to the present time under the last command, apply this one, and return the state.

        :raises HandLost: the hand is not open.
        """
        if not self._open:
            raise HandLost("the simulated hand is not connected", hint="call open() first")
        now = self._clock.now()
        if now - self._last > PAUSE:
            self._mechanics.brake()
        self._last = now
        self._mechanics.step(self._steps.due(now))
        self._mechanics.apply(command)
        return self._mechanics.state(now)


Simulated = TypeVar("Simulated", bound=SimulatedHand)


def configured(hand: Simulated, options: BackendOptions) -> Simulated:
    """The hand with the :data:`COMMON_SETTINGS` applied.

    :raises UsageError: a setting is not understood.
    """
    if file := options.settings.get("pose"):
        hand.keep_pose(Path(file))
    return hand


def number(options: BackendOptions, key: str) -> float | None:
    """Parse a numeric setting; None if it is not given.

    :raises UsageError: it is not a number.
    """
    text = options.settings.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{key}={text} is not a number") from None
