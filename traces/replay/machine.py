"""State machine that plays a plan on hands: states in, commands out, on the caller's clock.

::

    WAIT ──► RAMP ──► PLAY ──► LEAVE ──► END
     ▲         │        │        ▲
     └─ pause ─┴────────┘        └── fault, no state, distance, stop: from anywhere

* WAIT sends nothing until every hand has published a state that is newer than the start, or than
  the last pause, and that reports no fault.
* RAMP leads from the pose that the hand has *now* to the next one of the session, at a stated
  speed.
* PLAY sends the newest command that is due. Session time advances by at most :data:`HOLD` a cycle:
  after a delay of the caller the session continues where it was, and nothing is skipped. Where
  force returns to a joint that had none (a hand let go, a locked motor), the hand is led to the
  command from where it is now, as by RAMP.
* LEAVE commands the hand to stay where it is, its motors locked where the dialect has a mode byte,
  as the modelled teleoperation client does at its end. Joints without force at the end get none.

After a pause of the caller (:data:`~dexkit.command_age.PAUSE`) the machine starts over with WAIT:
the hand may have moved, and is led from there back to the session. When it is stopped before that,
LEAVE begins with the wait for fresh states, and a hand without one is not commanded any more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from dexkit.command_age import PAUSE, SETTLE
from dexkit.hand import JointMode, Side
from dexkit.models import ModeByte, model
from dexkit.teleop import JointCommand, client_for
from dexkit.traces.replay.prepare import Plan, Track, joint_limits
from dexkit.traces.replay.states import DecodedHand

__all__ = [
    "HOLD",
    "RAMP_SPEED",
    "Commands",
    "End",
    "Guards",
    "Phase",
    "Progress",
    "ReplayMachine",
]

HOLD = 0.02
"""Largest advance of session time in one cycle, seconds."""
RAMP_SPEED = 0.5
"""Speed on the way to the first pose, rad/s."""
_ARRIVE = 0.3
"""Seconds at the end of the ramp, for the hand to catch up."""
_PATIENCE = 2.0
"""Seconds to wait for states after a pause."""
_LEAVING = 0.25
"""Seconds of hold commands at the end, as the modelled teleoperation client sends."""
_REPEAT = 0.02
"""Seconds after which a command is sent again where none is due: far below any time-out."""
_FAR = 0.25
"""Default of the largest distance from the command, as a part of the joint's stroke."""

_NEAR = 0.05
"""Distance from its command up to which a joint gets force without a ramp, as a part of the
stroke."""

Commands = Mapping[Side, Sequence[JointCommand]]
Values = tuple[float, ...]


class Phase(str, Enum):
    """Phase of a replay."""

    WAIT = "waiting"
    RAMP = "ramp"
    PLAY = "playing"
    LEAVE = "leaving"
    END = "ended"

    def __str__(self) -> str:
        return self.value


class End(str, Enum):
    """Why a replay has ended."""

    DONE = "done"
    ASKED = "asked"
    FAULT = "fault"
    SILENT = "silent"
    DISTANCE = "distance"
    SUSPENDED = "suspended"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Guards:
    """Speeds and limits of a replay.

    :param ramp_speed: rad/s of the fastest joint on the way to the first pose.
    :param max_distance: rad that a joint may be away from its command; None for a quarter of its
        stroke.
    :param distance_time: seconds that it may be further away.
    :param stale: seconds without a state after which a hand counts as silent.
    :param loop: start over at the end.
    """

    ramp_speed: float = RAMP_SPEED
    max_distance: float | None = None
    distance_time: float = 1.0
    stale: float = PAUSE
    loop: bool = False


@dataclass
class Progress:
    """Counters of a replay.

    :ivar sent: commands, all hands together; ``passes``: complete passes over the session.
    :ivar held: seconds for which session time was held, pauses not included.
    :ivar farthest: by side, the largest distance of a joint from its command while playing, rad,
        with the joint's index and the session's time.
    """

    sent: int = 0
    passes: int = 0
    pauses: int = 0
    held: float = 0.0
    farthest: dict[Side, tuple[float, int, float]] = field(default_factory=dict)


class ReplayMachine:
    """One replay.

    :ivar phase: present phase.
    :ivar at: seconds of the session that have been played.
    :ivar end: why it has ended, or is about to; None before.
    :ivar reason: the same as a sentence.
    """

    def __init__(self, plan: Plan, guards: Guards = Guards()) -> None:
        self.plan, self.guards = plan, guards
        self.phase = Phase.WAIT
        self.at = 0.0
        self.end: End | None = None
        self.reason = ""
        self.progress = Progress()
        self._hand = model(plan.dialect.model)
        self._client = client_for(plan.dialect, plan.sides)
        self._shared = len({plan.dialect.topics(s) for s in plan.sides}) < len(plan.sides)
        self._limits = {s: joint_limits(plan.dialect, s) for s in plan.sides}
        self._far = {
            s: tuple(
                guards.max_distance if guards.max_distance is not None else _FAR * stroke
                for stroke in limits.stroke.tolist()
            )
            for s, limits in self._limits.items()
        }
        self._near = {s: _NEAR * limits.stroke for s, limits in self._limits.items()}
        self._rows = {s: _Rows(plan, t) for s, t in plan.tracks.items()}
        self._times: dict[Side, list[float]] = {s: t.t.tolist() for s, t in plan.tracks.items()}
        self._next = dict.fromkeys(plan.sides, 0)
        """Index of each hand's first command that is not yet due."""
        self._seen: dict[Side, tuple[float, DecodedHand]] = {}
        self._sent: dict[Side, tuple[float, Sequence[JointCommand]]] = {}
        self._far_since: dict[tuple[Side, int], float] = {}
        self._not_before = -math.inf
        self._stale = False
        """Whether nothing has been sent since a pause: what was sent last is old."""
        self._last: float | None = None
        self._since = 0.0
        """Seconds of the phase so far."""
        self._from: dict[Side, Values] = {}
        self._ramp = 0.0

    def names(self, side: Side) -> tuple[str, ...]:
        """The joints of a hand."""
        return self._limits[side].names

    def unit(self, side: Side) -> str:
        """The unit of a hand's q."""
        return self._limits[side].unit

    def farthest_allowed(self, side: Side) -> Values:
        """How far each joint, in its unit, may be away from its command."""
        return self._far[side]

    # -- inputs

    def receive(self, now: float, side: Side, seen: DecodedHand) -> None:
        """Note a state. A state that is not finite is ignored."""
        if side in self._rows and now >= self._not_before and all(map(math.isfinite, seen.q)):
            self._seen[side] = (now, seen)

    def stop(self, end: End, reason: str) -> None:
        """Stop; a hand that was commanded is brought to rest first."""
        if self.phase in (Phase.LEAVE, Phase.END):
            return
        self.end, self.reason = end, reason
        self._enter(Phase.LEAVE if self._sent else Phase.END)

    def abandon(self, end: End, reason: str) -> None:
        """End at once: another program commands the hands now."""
        self.end, self.reason = self.end or end, self.reason or reason
        self._enter(Phase.END)

    def pause(self, now: float) -> None:
        """The caller was paused: wait for fresh states, and ramp again.

        States count only from :data:`~dexkit.command_age.SETTLE` seconds later on: earlier ones may
        have waited in a queue.
        """
        self._not_before = now + SETTLE
        self._seen.clear()
        self._far_since.clear()
        self._stale = True
        self.progress.pauses += 1
        self._last = now
        if self.phase in (Phase.RAMP, Phase.PLAY):
            self._enter(Phase.WAIT)
        elif self.phase is Phase.LEAVE:
            self._enter(Phase.END)  # the last poses are stale: no further commands

    # -- outputs

    @property
    def missing(self) -> tuple[Side, ...]:
        """The hands whose state is waited for."""
        return tuple(s for s in self.plan.sides if not self._usable(s))

    def wakes_at(self, now: float) -> float:
        """Time at which :meth:`step` should be called next."""
        if self.phase is Phase.PLAY:
            due = [
                times[self._next[s]] - self.at
                for s, times in self._times.items()
                if self._next[s] < len(times)
            ]
            return now + min([_REPEAT / 2, *(max(d, 0.0) for d in due)])
        return now + min(1.0 / self._hand.command_rate, _REPEAT / 2)

    def step(self, now: float) -> Commands:
        """Run one cycle; return the commands to send now, if any are due.

        :param now: seconds on a monotonic clock; not before the last call.
        """
        away = 0.0 if self._last is None else now - self._last
        if away > PAUSE:
            self.pause(now)
            return {}
        self._last = now
        part = min(away, HOLD)
        self._since += part
        if self.phase in (Phase.RAMP, Phase.PLAY):
            self.progress.held += away - part
            self._guard(now)
        if self.phase is Phase.WAIT:
            self._wait(now)
            return {}
        if self.phase is Phase.RAMP:
            return self._note(now, self._ramped())
        if self.phase is Phase.PLAY:
            return self._play(now, part)
        if self.phase is Phase.LEAVE:
            return self._leave()
        return {}

    # -- phases

    def _enter(self, phase: Phase) -> None:
        self.phase, self._since = phase, 0.0

    def _usable(self, side: Side) -> bool:
        """Whether a hand has published a state that clients accept."""
        if side not in self._seen:
            return False
        q = self._seen[side][1].q
        return any(q) or not self.plan.dialect.zero_is_no_state

    def _wait(self, now: float) -> None:
        fresh = all(
            self._usable(s) and now - self._seen[s][0] <= self.guards.stale for s in self.plan.sides
        )
        if not fresh:
            if self._sent and self._since > _PATIENCE:
                missing = " and ".join(map(str, self.missing))
                self.stop(End.SILENT, f"{missing} hand: no state after a pause of this program")
            return
        if self._faulty():
            return
        self._from = {s: self._seen[s][1].q for s in self.plan.sides}
        # an accepted goal beyond a joint's range counts as the end of the range: a ramp takes no
        # longer than a stroke
        way = max(
            abs(min(max(c.q, low), high) - q) if self._drives(c, j) else 0.0
            for s, start in self._from.items()
            for j, (c, q, low, high) in enumerate(
                zip(
                    self._goal(s),
                    start,
                    self._limits[s].low.tolist(),
                    self._limits[s].high.tolist(),
                    strict=True,
                )
            )
        )
        self._ramp = way / self.guards.ramp_speed
        self._far_since.clear()
        self._enter(Phase.RAMP)

    def _goal(self, side: Side) -> Sequence[JointCommand]:
        """The command at which the session continues."""
        return self._rows[side][max(self._next[side] - 1, 0)]

    def _ramped(self) -> Commands:
        """Commands on the way to the goal, with its gains and without feed-forward."""
        part = min(self._since / self._ramp, 1.0) if self._ramp > 0 else 1.0
        found = {
            s: tuple(
                c._replace(q=q + part * (c.q - q), dq=0.0, tau=0.0)
                for c, q in zip(self._goal(s), start, strict=True)
            )
            for s, start in self._from.items()
        }
        if self._since >= self._ramp + _ARRIVE:
            self._enter(Phase.PLAY)
        return found

    def _play(self, now: float, part: float) -> Commands:
        self.at += part
        found: dict[Side, Sequence[JointCommand]] = {}
        far = False
        for side, times in self._times.items():
            k = self._next[side]
            while k < len(times) and times[k] <= self.at + 1e-9:
                k += 1
            far |= self._is_caught_far(side, k)
            if k > self._next[side] or now - self._sent[side][0] >= _REPEAT:
                found[side] = self._rows[side][max(k - 1, 0)]
            self._next[side] = k
        if far:
            self._enter(Phase.WAIT)
            return {}
        if all(self._next[s] == len(times) for s, times in self._times.items()):
            self.progress.passes += 1
            if self.guards.loop:
                self._next, self.at = dict.fromkeys(self.plan.sides, 0), 0.0
                self._enter(Phase.WAIT)
            else:
                self.stop(End.DONE, "played to the end")
        return self._note(now, found)

    def _is_caught_far(self, side: Side, k: int) -> bool:
        """Whether the newest of ``k`` commands gives force to a joint that had none, far from it.

        A ramp leads to a command; so the one before counts, and not what was sent.
        """
        if k <= self._next[side]:
            return False
        rows = self._rows[side]
        caught = rows.follows[k - 1] & ~rows.follows[max(self._next[side] - 1, 0) : k - 1].all(
            axis=0
        )
        away = np.abs(rows.q[k - 1] - np.array(self._seen[side][1].q))
        return bool((caught & (away > self._near[side])).any())

    def _leave(self) -> Commands:
        if self._stale and any(s not in self._seen for s in self._sent):
            if self.end is End.SILENT or self._since >= _PATIENCE:
                self._enter(Phase.END)
            return {}
        if self._stale:
            self._stale, self._since = False, 0.0
        if self._since >= _LEAVING:
            self._enter(Phase.END)
            return {}
        return {s: self._parting(s) for s in self._sent}

    def _parting(self, side: Side) -> Sequence[JointCommand]:
        """Command to stay. The position of a silent hand is unknown: it is damped only."""
        known = side in self._seen and self.end is not End.SILENT
        pose = self._seen[side][1].q if known else tuple(c.q for c in self._sent[side][1])
        found = tuple(
            c if self._drives(sent, j) else sent._replace(q=c.q, dq=0.0, tau=0.0)
            for j, (c, sent) in enumerate(
                zip(self._client.final_command(pose), self._sent[side][1], strict=True)
            )
        )
        return found if known else tuple(c._replace(kp=0.0) for c in found)

    def _note(self, now: float, commands: Commands) -> Commands:
        # one message for all hands: a hand that is missing in it goes limp
        if commands and self._shared:
            commands = {**{s: motors for s, (_, motors) in self._sent.items()}, **commands}
        for side, motors in commands.items():
            self._sent[side] = (now, motors)
            self._stale = False
        self.progress.sent += len(commands)
        return commands

    # -- supervision

    def _faulty(self) -> bool:
        for side, (_, seen) in self._seen.items():
            if problem := seen.problem(self._limits[side].names):
                self.stop(End.FAULT, f"{side} hand: {problem}")
                return True
        return False

    def _guard(self, now: float) -> None:
        """Stop at a fault, without states, or too far from the commands."""
        for side in self.plan.sides:
            silent = now - self._seen[side][0]
            if silent > self.guards.stale:
                self.stop(End.SILENT, f"{side} hand: no state for {silent:.2f} s")
                return
        if self._faulty():
            return
        for side in self.plan.sides:
            if side in self._sent:
                self._measure(now, side)

    def _measure(self, now: float, side: Side) -> None:
        seen, motors = self._seen[side][1], self._sent[side][1]
        for j, (command, q, far) in enumerate(zip(motors, seen.q, self._far[side], strict=True)):
            away = abs(command.q - q)
            if self.phase is Phase.PLAY and away > self.progress.farthest.get(side, (0.0,))[0]:
                self.progress.farthest[side] = (away, j, self.at)
            if away <= far or not self._drives(command, j):
                self._far_since.pop((side, j), None)
                continue
            since = self._far_since.setdefault((side, j), now)
            if now - since >= self.guards.distance_time:
                self.stop(
                    End.DISTANCE,
                    f"{side} hand: {self._limits[side].names[j]} has been more than {far:.2f} "
                    f"{self._limits[side].unit} from its command for {now - since:.1f} s: "
                    f"at {q:.2f} instead of {command.q:.2f}",
                )
                return

    def _drives(self, command: JointCommand, index: int) -> bool:
        """Whether a command makes its motor follow q."""
        if not self.plan.dialect.gains_are_used:
            return True
        return command.mode == _mode(self.plan, index, JointMode.FOC) and command.kp > 0


def _mode(plan: Plan, index: int, status: int) -> int:
    """The mode byte of a motor."""
    byte = plan.dialect.mode_byte
    if byte is ModeByte.RIS:
        return index | status << 4
    return status if byte is ModeByte.STATUS else 0


class _Rows:
    """The commands of a track as sent, created on demand; torques in the dialect's units."""

    def __init__(self, plan: Plan, track: Track) -> None:
        n = track.q.shape[1]
        units = np.array(plan.dialect.torque_units or (1.0,) * n)
        self.q, self.follows = track.q, track.follows
        self._tables = (track.q, track.dq, track.tau / units, track.kp, track.kd)
        self._driven = track.driven
        self._modes = [
            [_mode(plan, j, status) for status in (JointMode.BRAKE, JointMode.FOC)]
            for j in range(n)
        ]

    def __getitem__(self, k: int) -> tuple[JointCommand, ...]:
        modes = [m[d] for m, d in zip(self._modes, self._driven[k].tolist(), strict=True)]
        columns = [table[k].tolist() for table in self._tables]
        return tuple(map(JointCommand, modes, *columns))
