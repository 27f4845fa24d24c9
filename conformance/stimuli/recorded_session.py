"""A recorded session as commands to be replayed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.motor_messages import Motor, Motors
from dexkit.conformance.kit.recording import Commands, Recording
from dexkit.errors import ConformanceError, TraceError
from dexkit.hand import Side
from dexkit.models import DEX1_1, Dialect, model
from dexkit.traces import open_trace, sample_path

__all__ = ["DEFAULT_SECONDS", "CommandSession"]

DEFAULT_SECONDS = 2.9
_MOTION, _BEFORE_MOTION = 0.02, 0.3
"""A change of q that is a motion, rad, and seconds of a session before its first one."""


@dataclass(frozen=True, eq=False)
class CommandSession:
    """The commands of a recording, in its own dialect's radians."""

    name: str
    dialect: Dialect
    duration: float
    commands: dict[Side, Commands]

    @classmethod
    def load(
        cls, path: Path, *, seconds: float | None = None, motion: bool = False
    ) -> CommandSession:
        """The commands of a recording, from the first one on.

        :param seconds: no more than so much of it; None for all.
        :param motion: from shortly before the first motion on.
        :raises ConformanceError: it holds no commands to a hand of the family.
        :raises TraceError: it cannot be read.
        """
        trace = open_trace(path)
        recording = Recording.decode(trace)
        if trace.damage:
            raise TraceError(
                f"{path.name} is damaged, and not replayed: {trace.damage[0]}",
                hint="'dexkit info' names all of the damage",
            )
        found = {
            s: recording.sides[s].commands
            for s in Side
            if s in recording.sides and len(recording.sides[s].commands)
        }
        if not found:
            raise ConformanceError(
                f"{path.name} holds no commands to replay",
                hint="record a session with 'dexkit record' while it is commanded",
            )
        begin = min(float(c.t[0]) for c in found.values())
        if motion:
            moves = min(_first_motion(c) for c in found.values())
            begin = max(begin, moves - _BEFORE_MOTION) if math.isfinite(moves) else begin
        last = max(float(c.t[-1]) for c in found.values())
        end = last if seconds is None else min(last, begin + seconds)
        return cls(
            name=path.stem,
            dialect=recording.dialect,
            duration=end - begin,
            commands={s: _cut(c, begin, end) for s, c in found.items()},
        )

    @classmethod
    def default(cls, hand_model: str = DEX1_1.name) -> CommandSession:
        """The session of that model's profile, from its first motion on.

        :raises ConformanceError: it has none.
        """
        session = under_test(hand_model).session
        if not session:
            raise ConformanceError(
                f"there is no session of a {model(hand_model).title} to replay",
                hint="give one: --trace FILE.mcap",
            )
        path = session if isinstance(session, Path) else sample_path(session)
        return cls.load(path, seconds=DEFAULT_SECONDS, motion=True)

    def for_hand(self, target: Dialect) -> CommandSession:
        """The session itself, if a hand of that dialect can be asked to repeat it.

        :raises ConformanceError: it was recorded with another model.
        """
        if self.dialect.model == target.model:
            return self
        raise ConformanceError(
            f"the session {self.name} is of a {model(self.dialect.model).title}, the hand is a "
            f"{model(target.model).title}",
            hint="give a session of the same model: --trace FILE.mcap",
        )

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that it commands."""
        return tuple(self.commands)

    def first(self, side: Side, target: Dialect) -> Motors:
        """The first command to a side, in another dialect's radians."""
        return self._motors(side, 0, target)

    def timeline(
        self, sides: Sequence[Side], target: Dialect
    ) -> list[tuple[int, dict[Side, Motors]]]:
        """(ns from the beginning, command), in order of time, in another dialect's radians."""
        events = [
            (round(float(t) * 1e9), side, i)
            for side in sides
            for i, t in enumerate(self.commands[side].t)
            if np.isfinite(self.commands[side].q[i]).all()
        ]
        events.sort(key=lambda e: e[0])
        return [(at, {side: self._motors(side, i, target)}) for at, side, i in events]

    def _motors(self, side: Side, i: int, target: Dialect) -> Motors:
        c = self.commands[side]
        scale = 1.0 if target.name == self.dialect.name else target.q_open / self.dialect.q_open
        return [
            Motor(
                q=float(c.q[i, k]) * scale,
                dq=float(c.dq[i, k]) * scale,
                tau=float(c.tau[i, k]),
                kp=float(c.kp[i, k]),
                kd=float(c.kd[i, k]),
                mode=int(c.mode[i, k]),
            )
            for k in range(c.q.shape[1])
        ]


def _first_motion(c: Commands) -> float:
    """Time of the first command whose q is not that of the first one; infinite if none is."""
    away = np.flatnonzero((np.abs(c.q - c.q[0]) > _MOTION).any(axis=1))
    return float(c.t[away[0]]) if len(away) else math.inf


def _cut(c: Commands, begin: float, end: float) -> Commands:
    rows = slice(int(np.searchsorted(c.t, begin)), int(np.searchsorted(c.t, end, "right")))
    columns = {f.name: getattr(c, f.name)[rows] for f in fields(c) if f.name != "topic"}
    times = {"t": c.t[rows] - begin, "sent": c.sent[rows] - begin}
    return Commands(c.topic, **{**columns, **times})
