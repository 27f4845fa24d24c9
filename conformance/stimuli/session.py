"""A recorded session as commands to be replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexkit.conformance.view import Commands, Recording
from dexkit.conformance.wire import Motor
from dexkit.errors import ConformanceError
from dexkit.hand import Side
from dexkit.traces import open_trace, sample_path

__all__ = ["DEFAULT_SECONDS", "DEFAULT_SESSION", "Session"]

DEFAULT_SESSION = "dex1_pick_place"
DEFAULT_SECONDS = 10.0


@dataclass(frozen=True, eq=False)
class Session:
    """The commands of a recording, in its own dialect's radians.

    :param stroke: full stroke of that dialect.
    """

    name: str
    stroke: float
    duration: float
    commands: dict[Side, Commands]

    @classmethod
    def load(cls, path: Path, *, seconds: float | None = None) -> Session:
        """The commands of a recording, from the first one on.

        :param seconds: no more than so much of it; None for all.
        :raises ConformanceError: it holds no commands to a hand of this model.
        :raises TraceError: it cannot be read.
        """
        recording = Recording.of(open_trace(path))
        found = {s: v.commands for s, v in recording.sides.items() if len(v.commands)}
        if not found:
            raise ConformanceError(
                f"{path.name} holds no commands to replay",
                hint="record a session with 'dexkit record' while it is commanded",
            )
        begin = min(float(c.t[0]) for c in found.values())
        last = max(float(c.t[-1]) for c in found.values())
        end = last if seconds is None else min(last, begin + seconds)
        return cls(
            name=path.stem,
            stroke=recording.dialect.q_open,
            duration=end - begin,
            commands={s: _cut(c, begin, end) for s, c in found.items()},
        )

    @classmethod
    def default(cls) -> Session:
        """The session that ships with dexkit."""
        return cls.load(sample_path(DEFAULT_SESSION), seconds=DEFAULT_SECONDS)

    def first_seconds(self, seconds: float) -> Session:
        """Only the beginning of it."""
        return Session(
            self.name,
            self.stroke,
            min(seconds, self.duration),
            {s: _cut(c, 0.0, seconds) for s, c in self.commands.items()},
        )

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that it commands."""
        return tuple(self.commands)

    def first(self, side: Side, stroke: float) -> Motor:
        """The first command to a side, for a hand of that stroke."""
        return self._motor(side, 0, stroke)

    def timeline(self, sides: Sequence[Side], stroke: float) -> list[tuple[int, dict[Side, Motor]]]:
        """(ns from the beginning, command), in order of time, for hands of that stroke."""
        events = [
            (round(float(t) * 1e9), side, i)
            for side in sides
            for i, t in enumerate(self.commands[side].t)
            if np.isfinite(self.commands[side].q[i])
        ]
        events.sort(key=lambda e: e[0])
        return [(at, {side: self._motor(side, i, stroke)}) for at, side, i in events]

    def _motor(self, side: Side, i: int, stroke: float) -> Motor:
        c = self.commands[side]
        scale = stroke / self.stroke
        return Motor(
            q=float(c.q[i]) * scale,
            dq=float(c.dq[i]) * scale,
            tau=float(c.tau[i]),
            kp=float(c.kp[i]),
            kd=float(c.kd[i]),
        )


def _cut(c: Commands, begin: float, end: float) -> Commands:
    rows = slice(int(np.searchsorted(c.t, begin)), int(np.searchsorted(c.t, end, "right")))
    return Commands(
        c.topic,
        c.t[rows] - begin,
        c.length[rows],
        c.q[rows],
        c.dq[rows],
        c.tau[rows],
        c.kp[rows],
        c.kd[rows],
    )
