"""Check the commands of a session before they reach a hand, and correct what options allow.

Each problem is a :class:`Finding` with a name. It is *refused*, unless an option cures it
(:class:`ReplayOptions`) or it is accepted by name. The result is a :class:`Plan`.

Rates, velocities and gaps are calculated at the chosen pace and in the dialect of the driven hand.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dexkit.command_age import PAUSE
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import Dialect, HandModel, dialect, model
from dexkit.traces.replay.commands import Flags, HandCommands, RecordedCommands, counted
from dexkit.traces.replay.frozen import frozen_joints
from dexkit.traces.sessions.finger_order import Order, finger_order, like_fingers
from dexkit.traces.sessions.resample import gap_of

__all__ = [
    "ACCEPTABLE",
    "GAINS",
    "INVALID",
    "JUMPS",
    "LIMIT",
    "Finding",
    "JointLimits",
    "Level",
    "Plan",
    "Prepared",
    "ReplayOptions",
    "Track",
    "joint_limits",
    "prepare",
]

Ints = NDArray[np.intp]

_TICK = 1e-6
"""Seconds between commands of the same time."""
_WINDOW = 0.05
"""Seconds over which a velocity is taken: genuine clients step by 0.18 rad in 5 ms."""
_FASTER = 1.1
"""Largest commanded speed, as a multiple of the joint's limit: a hand lags behind."""
_THIN = 0.4
"""Lowest command rate, as a part of the client's, before commands count as a staircase."""
_HIGH_GAINS = 2.0
"""Gains are too high from this multiple of the client's on."""
_BEYOND = 0.02
"""Excess over a limit that counts as rounding, as a part of the stroke, whatever the model."""
_MOVES = 0.02
"""Smallest commanded motion that counts as intended, as a part of the stroke."""
_MOST = 1_000_000
"""Most commands after resampling: more than an hour at 200 Hz."""
_TOLD = 5
"""Omissions of an import that are listed one by one."""
_FITS = 0.01
"""Largest share of commands outside the other hand's limits for these to count as fitting."""

GAINS = ("recorded", "model")
LIMIT = ("refuse", "clamp")
JUMPS = ("refuse", "stretch")
INVALID = ("refuse", "drop")
ACCEPTABLE = (
    "high-gains",
    "jumps",
    "limits",
    "locked",
    "pace",
    "side",
    "stale",
    "thin-rate",
    "zero-gains",
)
"""Findings that may be accepted by name."""


class Level(str, Enum):
    """Consequence of a finding for the replay."""

    NOTE = "note"
    CURED = "cured"
    ACCEPTED = "accepted"
    REFUSED = "refused"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Finding:
    """A property of a session that matters to a hand.

    :param name: e.g. ``thin-rate``.
    :param where: side and joint, or empty.
    :param text: what was found.
    :param option: the option that cures it, as it is given; empty where none does.
    :param advice: what to do beside that, or what options there are; may be empty.
    """

    name: str
    level: Level
    text: str
    where: str = ""
    option: str = ""
    advice: str = ""


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    :param sides: hands to drive; None for all that it commands.
    :param dialect: of the hands to be driven; None for that of the session.
    :param pace: 0.5 plays in twice the time.
    :param gains: those of the session, or none above those of the model's client.
    :param resample: commands a second, interpolated; None to send the recorded ones.
    :param limit: whether commands outside the limits are moved to them.
    :param jumps: whether time is stretched where joints would have to turn too fast.
    :param invalid: whether commands that cannot be sent are left out.
    :param states: play the recorded positions instead of the commands.
    :param swap_sides: play the left hand's commands on the right one, and the other way round.
    :param max_gap: longest pause, seconds of recorded time; None keeps all.
    :param accept: names of findings to accept.
    """

    sides: tuple[Side, ...] | None = None
    dialect: str | None = None
    pace: float = 1.0
    gains: str = "recorded"
    resample: float | None = None
    limit: str = "refuse"
    jumps: str = "refuse"
    invalid: str = "refuse"
    states: bool = False
    swap_sides: bool = False
    max_gap: float | None = None
    accept: Collection[str] = ()


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of a hand's joints as a dialect has them, arrays of shape (joints,).

    :param unit: of q, and of dq a second: that of the model.
    :param torque_unit: of tau.
    :param margin: excess over a limit of q that counts as rounding or calibration.
    """

    names: tuple[str, ...]
    low: Floats
    high: Floats
    dq: Floats
    tau: Floats
    unit: str
    torque_unit: str
    margin: Floats

    @property
    def stroke(self) -> Floats:
        """Widths of the ranges."""
        return self.high - self.low


def joint_limits(spoken: Dialect, side: Side) -> JointLimits:
    """The limits of a side's joints."""
    hand = model(spoken.model)
    joints = hand.joints[side]
    scale = spoken.q_open / joints[0].q_max if spoken.is_gripper else 1.0

    def of_each(attribute: str, by: float) -> Floats:
        return np.array([getattr(j, attribute) for j in joints]) * by

    stroke = of_each("q_max", scale) - of_each("q_min", scale)
    return JointLimits(
        names=tuple(j.name for j in joints),
        low=of_each("q_min", scale),
        high=of_each("q_max", scale),
        dq=of_each("dq_max", scale),
        tau=of_each("tau_max", 1.0),
        unit=hand.unit,
        torque_unit=hand.torque_unit,
        margin=np.maximum(_BEYOND * stroke, hand.limit_margin * scale),
    )


@dataclass(frozen=True, eq=False)
class Track:
    """The commands to be sent to one hand; fields as in :class:`HandCommands`."""

    t: Floats
    q: Floats
    dq: Floats
    tau: Floats
    kp: Floats
    kd: Floats
    driven: Flags

    def __len__(self) -> int:
        return len(self.t)

    @property
    def follows(self) -> Flags:
        """Whether a command makes a motor with gains go to q, shape (n, joints)."""
        return np.logical_and(self.driven, self.kp > 0)

    @property
    def period(self) -> float:
        """The usual time between commands, seconds; 0 for a single one."""
        return float(np.median(np.diff(self.t))) if len(self) > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Plan:
    """The commands for the hands of a dialect; times in seconds from the first command."""

    name: str
    dialect: Dialect
    tracks: Mapping[Side, Track]

    @property
    def sides(self) -> tuple[Side, ...]:
        """The hands that are driven."""
        return tuple(self.tracks)

    @property
    def duration(self) -> float:
        """Seconds from the first command to the last."""
        return max(float(t.t[-1]) for t in self.tracks.values())

    @property
    def commands(self) -> int:
        """Number of commands, all hands together."""
        return sum(map(len, self.tracks.values()))


@dataclass(eq=False)
class Prepared:
    """The findings, in the order of the checks, and the resulting plan.

    :ivar plan: without any command: None.
    """

    findings: list[Finding] = field(default_factory=list)
    plan: Plan | None = None

    @property
    def refused(self) -> list[Finding]:
        """The findings that keep the session from being played."""
        return [f for f in self.findings if f.level is Level.REFUSED]

    @property
    def cures(self) -> list[str]:
        """The options that cure what is refused, each once."""
        return list(dict.fromkeys(f.option for f in self.refused if f.option))


def prepare(session: RecordedCommands, options: ReplayOptions = ReplayOptions()) -> Prepared:
    """Check a session, correct it as the options say, and make the plan.

    :raises SessionError: it has no hand that dexkit knows.
    :raises UsageError: the options contradict the session: a dialect of another model, or a missing
        side.
    """
    return _Preparation(session, options).run()


class _Preparation:
    def __init__(self, session: RecordedCommands, options: ReplayOptions) -> None:
        self.session, self.options = session, options
        self.model: HandModel = session.model
        assert session.dialect is not None
        self.recorded = session.dialect
        self.spoken = dialect(options.dialect) if options.dialect else self.recorded
        self.found = Prepared()

    # -- findings

    def note(self, name: str, text: str, where: str = "", advice: str = "") -> None:
        self.found.findings.append(Finding(name, Level.NOTE, text, where, advice=advice))

    def judge(
        self,
        name: str,
        text: str,
        option: str = "",
        *,
        cured: bool,
        where: str = "",
        advice: str = "",
    ) -> None:
        """Add a finding that is cured, accepted or refused."""
        level = Level.REFUSED
        if cured:
            level = Level.CURED
        elif name in self.options.accept and name in ACCEPTABLE:
            level = Level.ACCEPTED
        if level is not Level.REFUSED:
            option = advice = ""
        self.found.findings.append(Finding(name, level, text, where, option, advice))

    def refuse(self, name: str, text: str, advice: str = "", where: str = "") -> None:
        """Add a finding that is always refused."""
        self.found.findings.append(Finding(name, Level.REFUSED, text, where, advice=advice))

    # -- the steps

    def run(self) -> Prepared:
        self._origin()
        self._order()
        if self.spoken.model != self.recorded.model:
            self.refuse(
                "model",
                f"the session is of a {self.model.title}, the dialect {self.spoken.name} of a "
                f"{model(self.spoken.model).title}",
                f"choose {' or '.join(d.name for d in self.model.dialects)}",
            )
            return self.found
        chosen = self._chosen()
        self._frozen()
        usable = {s: u for s, c in chosen.items() if (u := self._usable(s, c)) is not None}
        tracks = {s: self._translated(c) for s, c in usable.items()}
        if not tracks:
            if not self.found.refused:
                self.refuse("empty", "there is no command in it")
            return self.found
        exchanged = [s for s, t in tracks.items() if self._side(s, t)]
        tracks = {s: self._gains(s, t) for s, t in tracks.items()}
        tracks = {s: t if s in exchanged else self._limits(s, t) for s, t in tracks.items()}
        tracks = self._timed(tracks)
        if self.options.resample:
            tracks = {s: _resampled(t, self.options.resample) for s, t in tracks.items()}
        self.found.plan = Plan(self.session.name, self.spoken, tracks)
        return self.found

    def _origin(self) -> None:
        session = self.session
        for text in session.damage:
            self.note("damage", text)
        for text in session.corrections:
            self.note("corrected", text)
        for text in session.problems[:_TOLD]:
            self.note("left-out", text)
        if len(session.problems) > _TOLD:
            self.note("left-out", f"and {len(session.problems) - _TOLD} more things")
        if session.nominal_rate:
            self.note(
                "nominal-time",
                f"the source has no usable times: frames are played at {session.nominal_rate:g} a "
                "second, which is what was asked for when it was recorded, not what was measured",
                advice="'dexkit import --set rate=HZ' states another rate, --pace 0.5 is slower",
            )
        if session.others and session.dialect is not None:
            self.note("not-played", ", ".join(session.others))

    def _order(self) -> None:
        """Note fingers that moved for each other: played, the commands do that again."""
        fingers = like_fingers(self.model) if isinstance(self.model, HandModel) else None
        if fingers is None:
            return
        for side, c in self.session.commands.items():
            t, q = self.session.states.get(side, (np.zeros(0), np.zeros((0, c.q.shape[1]))))
            found = finger_order(fingers, c.t, c.q, t, q)
            if found.order is Order.EXCHANGED:
                self.note("order", found.text, str(side))

    def _chosen(self) -> dict[Side, HandCommands]:
        """The commands of the chosen hands, on the sides where they are to be played."""
        session, options = self.session, self.options
        commands = dict(session.commands)
        if options.states or not commands:
            self.judge(
                "only-states" if not commands else "states",
                "the session has positions of hands and no commands"
                if not commands
                else "its positions are played instead of its commands",
                "--set play=states",
                cured=options.states,
            )
            commands = {s: _from_states(t, q, self.model) for s, (t, q) in session.states.items()}
        if options.swap_sides:
            other = {Side.LEFT: Side.RIGHT, Side.RIGHT: Side.LEFT}
            commands = {other[s]: commands[s] for s in reversed(list(commands))}
            self.note("swapped", "each hand's commands are played on the other hand")
        sides = options.sides or tuple(commands)
        if missing := [str(s) for s in sides if s not in commands]:
            raise UsageError(
                f"{session.name} has nothing to play on the {' and '.join(missing)} hand",
                hint=f"it has the {' and '.join(map(str, commands)) or 'no'} hand: --side, or "
                "--set swap-sides=yes to play it on the other one",
            )
        return {s: commands[s] for s in Side if s in sides}

    def _frozen(self) -> None:
        """Check for states that stand still while their commands move."""
        for side, given in self.session.commands.items():
            if side not in self.session.states or side not in (self.options.sides or Side):
                continue
            limits = joint_limits(self.recorded, side)
            follows = given.driven & (given.kp > 0 if self.recorded.gains_are_used else True)
            found = frozen_joints(
                *self.session.states[side], given.t, given.q, follows, limits.stroke
            )
            if not found:
                continue
            which = np.isin(np.arange(len(limits.names)), list(found))
            begin, end = max(found.values(), key=lambda span: span[1] - span[0])
            text = (
                f"the states of {_joints(limits, which[None])} stand still from {begin:.2f} s to "
                f"{end:.2f} s, while the commands move"
            )
            if self.options.states:
                self.refuse("frozen-states", text, "leave out play=states", str(side))
            else:
                self.note("frozen-states", f"{text}; only the commands are played", str(side))

    def _usable(self, side: Side, given: HandCommands) -> HandCommands | None:
        """Drop commands that cannot be sent; None if nothing is left."""
        n = len(self.model.joints[side])
        shared = self.recorded.length > n
        odd = (given.counts < n) | ((given.counts > n) & (not shared))
        tables = np.concatenate([given.q, given.dq, given.tau, given.kp, given.kd], axis=1)
        broken = ~odd & ~np.isfinite(tables).all(axis=1)
        stale = ~odd & ~broken & (given.late > PAUSE)
        drop = self.options.invalid == "drop"
        out = odd | broken | given.backwards
        option = "--set invalid=drop"
        if odd.all() and len(given):
            self.refuse(
                "joints",
                f"{counted(given.counts)}, and a {self.model.title} has {n}: these are commands "
                "to another hand",
                where=str(side),
            )
            return None
        texts = {
            "joints": (odd, f"{int(odd.sum())} of {len(odd)} commands have not {n} motors"),
            "not-finite": (
                broken,
                f"{int(broken.sum())} of {len(odd)} commands hold NaN or infinity"
                + _at(given.t, broken),
            ),
            "backwards": (
                given.backwards,
                f"{int(given.backwards.sum())} of {len(odd)} commands were sent before one that "
                "was received earlier: time runs backwards" + _at(given.t, given.backwards),
            ),
        }
        for name, (rows, text) in texts.items():
            if rows.any():
                self.judge(name, text, option, cured=drop, where=str(side))
        if stale.any():
            self.judge(
                "stale",
                f"{int(stale.sum())} of {len(odd)} commands were received up to "
                f"{given.late[stale].max():.2f} s late, which no hand obeys" + _at(given.t, stale),
                option,
                cured=drop,
                where=str(side),
            )
            out |= stale & drop
        kept = given.rows(~out)
        return kept if len(kept) else None

    def _translated(self, given: HandCommands) -> Track:
        """Convert to the radians of the dialect and the chosen pace; leave out what does nothing.

        A motor without kp, or locked, takes no notice of q: a stop often has 0 there. To
        interpolate towards it, or to send it to a hand without gains, would move a joint that
        stayed.
        """
        scale = 1.0
        if self.spoken.name != self.recorded.name and self.spoken.is_gripper:
            scale = self.spoken.q_open / self.recorded.q_open
        track = Track(
            t=given.t / self.options.pace,
            q=given.q * scale,
            dq=given.dq * scale * self.options.pace,
            tau=given.tau,
            kp=given.kp,
            kd=given.kd,
            driven=given.driven,
        )
        if not self.recorded.gains_are_used:
            return track
        return replace(
            track,
            q=_held(track.q, track.follows),
            dq=np.where(track.driven & (track.kd != 0), track.dq, 0.0),
            tau=np.where(track.driven, track.tau, 0.0),
        )

    def _side(self, side: Side, track: Track) -> bool:
        """Check whether the commands fit the other hand instead of this one."""
        other = Side.RIGHT if side is Side.LEFT else Side.LEFT
        mine, its = (self._outside(track, s) for s in (side, other))
        if mine <= 0.5 or its > _FITS:
            return False
        self.judge(
            "side",
            f"{mine:.0%} of the commands are outside the limits of the {side} hand, and "
            f"within those of the {other} one",
            "" if self.options.swap_sides else "--set swap-sides=yes",
            cured=False,
            where=str(side),
            advice="leave out swap-sides=yes" if self.options.swap_sides else "",
        )
        return True

    def _outside(self, track: Track, side: Side) -> float:
        limits = joint_limits(self.spoken, side)
        outside = (track.q < limits.low - limits.margin) | (track.q > limits.high + limits.margin)
        return float(outside.any(axis=1).mean())

    def _gains(self, side: Side, track: Track) -> Track:
        """Check kp, kd and mode; with ``gains=model`` lower the gains to those of its client.

        A command without force gets none, whatever the options: the recorded hand did not obey it.
        """
        if not self.spoken.gains_are_used:
            return track
        limits = joint_limits(self.spoken, side)
        kp, kd = np.array(self.model.gains).T
        lowered = self.options.gains == "model"
        if lowered and not self.recorded.gains_are_used:  # the recorded hand obeyed without gains
            track = replace(
                track,
                kp=np.broadcast_to(kp, track.q.shape),
                kd=np.broadcast_to(kd, track.q.shape),
            )
        moves = np.ptp(track.q, axis=0) > _MOVES * limits.stroke
        self._idle(side, track, limits, moves)
        wrong = (track.kp > _HIGH_GAINS * kp) | (track.kd > _HIGH_GAINS * kd)
        wrong |= (track.kp < 0) | (track.kd < 0)
        high = track.driven & wrong
        if high.any():
            j = int(np.argmax(high.sum(axis=0)))
            ranges = [
                f"{name} {table[:, j].min():g}"
                + (f" to {table[:, j].max():g}" if np.ptp(table[:, j]) else "")
                for name, table in (("kp", track.kp), ("kd", track.kd))
            ]
            self.judge(
                "high-gains",
                f"loud motors: {' and '.join(ranges)} for {limits.names[j]}, where the model's "
                f"client sends {kp[j]:g} and {kd[j]:g}",
                "--set gains=model",
                cured=lowered,
                where=str(side),
            )
        if not moves.any():
            self.note("still", "its commands move no joint", str(side))
        if not lowered:
            return track
        return replace(track, kp=np.clip(track.kp, 0.0, kp), kd=np.clip(track.kd, 0.0, kd))

    def _idle(self, side: Side, track: Track, limits: JointLimits, moves: Flags) -> None:
        """Check for commands without force: a stop, a hand let go, or motion that never comes."""
        locked = ~track.driven
        pushed = (track.tau != 0) | ((track.dq != 0) & (track.kd > 0))
        limp = track.driven & (track.kp <= 0) & ~pushed
        idle_joints = ~track.follows.any(axis=0)
        dead = idle_joints & (moves | idle_joints.all())
        bare = not self.recorded.gains_are_used  # its hand went to q without gains
        for name, idle, what in (
            ("locked", locked, "the mode byte locks"),
            ("zero-gains", limp, "kp is 0 for"),
        ):
            rows = idle & dead
            if not rows.any():
                continue
            option = "--set gains=model" if bare else self._states_move(side)
            self.judge(
                name,
                f"no motion: {what} {_joints(limits, rows)} in "
                f"{rows.any(axis=1).mean():.0%} of the commands"
                + (", though the recorded hand moved" if self._states_move(side) else ""),
                option,
                cured=False,
                where=str(side),
                advice="" if option else f"--accept {name} plays it, without that motion",
            )
        still = (locked | limp) & ~dead
        forceless = (locked | limp).all(axis=1)
        last = 0 if forceless.all() else int(np.argmin(forceless[::-1]))
        if last:
            self.note(
                "stop",
                f"its last {last} command{'s have' if last > 1 else ' has'} no force: it is played "
                "as a stop",
                str(side),
            )
        if (earlier := still[: len(track) - last]).any():
            self.note(
                "limp",
                f"{_joints(limits, earlier)} without force in "
                f"{earlier.any(axis=1).mean():.0%} of the commands; where force returns, the hand "
                "is led slowly from where it is",
                str(side),
            )

    def _states_move(self, side: Side) -> str:
        """The option that plays what the recorded hand did, if it moved without such commands."""
        if self.options.swap_sides:
            side = Side.RIGHT if side is Side.LEFT else Side.LEFT
        _, q = self.session.states.get(side, (None, np.zeros((0, 1))))
        if not len(q):
            return ""
        way = np.ptp(q, axis=0) > _MOVES * joint_limits(self.recorded, side).stroke
        return "--set play=states" if way.any() else ""

    def _limits(self, side: Side, track: Track) -> Track:
        """Check position, feed-forward velocity and torque."""
        limits = joint_limits(self.spoken, side)
        margin = limits.margin
        clamp = self.options.limit == "clamp"
        clamped = replace(
            track,
            q=np.clip(track.q, limits.low, limits.high),
            dq=np.clip(track.dq, -limits.dq, limits.dq),
            tau=np.clip(track.tau, -limits.tau, limits.tau),
        )
        bounds = (
            ("q", limits.unit, limits.low - margin, limits.high + margin),
            ("dq", f"{limits.unit}/s", -limits.dq, limits.dq),
            ("tau", limits.torque_unit, -limits.tau, limits.tau),
        )
        # a position servo takes no notice of tau, and dq is the most that it may move with
        for name, unit, low, high in bounds[:1] if self.spoken.position_servo else bounds:
            table = getattr(track, name)
            beyond = np.maximum(low - table, table - high)
            if not (beyond > 0).any():
                continue
            j = int(np.argmax(beyond.max(axis=0)))
            worst = table[int(np.argmax(beyond[:, j])), j]
            self.judge(
                "limits",
                f"{name} of {_joints(limits, beyond > 0)} is outside the limits in "
                f"{(beyond > 0).any(axis=1).mean():.1%} of the commands: {limits.names[j]} "
                f"{worst:.3g} {unit}, limits "
                + (
                    f"{limits.low[j]:.3g} to {limits.high[j]:.3g}"
                    if name == "q"
                    else f"{high[j]:.3g}"
                ),
                "--set limit=clamp",
                cured=clamp,
                where=str(side),
            )
        # a small excess is rounding, and is always clamped
        return (
            clamped
            if clamp
            else replace(
                track, q=np.where(np.abs(clamped.q - track.q) <= margin, clamped.q, track.q)
            )
        )

    def _timed(self, tracks: dict[Side, Track]) -> dict[Side, Track]:
        """Check pace, gaps, jumps and rate; shorten gaps and stretch jumps."""
        options = self.options
        if options.pace > 1:
            self.judge(
                "pace",
                f"{options.pace:g} times as fast as it was recorded",
                "--accept pace",
                cured=False,
            )
        begin = min(float(t.t[0]) for t in tracks.values())
        tracks = {s: replace(t, t=_apart(t.t - begin)) for s, t in tracks.items()}
        if options.max_gap is not None:
            longest = options.max_gap / options.pace
            tracks = _warped(tracks, lambda middle, dt: np.minimum(dt, longest))
        tracks = {s: self._gaps(s, t) for s, t in tracks.items()}
        stretch = options.jumps == "stretch"
        jumping = [s for s, t in tracks.items() if self._jumps(s, t)]
        if jumping and stretch:
            tracks = self._stretched(tracks)
        for side, track in tracks.items():
            self._rate(side, track)
        return tracks

    def _gaps(self, side: Side, track: Track) -> Track:
        """Note pauses; the pose is held in them until a period before their end."""
        dt = np.diff(track.t)
        gaps = np.flatnonzero(dt > gap_of((track.t * 1e9).astype(np.int64)))
        if not len(gaps):
            return track
        self.note(
            "gaps",
            f"{len(gaps)} pauses of up to {dt[gaps].max():.2f} s; the pose is held in them",
            str(side),
            advice="--set max-gap=S shortens them",
        )
        return _inserted(track, gaps + 1, track.t[gaps + 1] - track.period, gaps)

    def _jumps(self, side: Side, track: Track) -> bool:
        """Check whether a joint would have to turn faster than it can."""
        if len(track) < 2 or not self.spoken.gains_are_used:
            return False  # a position servo goes to its goal at its own speed
        limits = joint_limits(self.spoken, side)
        window = max(_WINDOW, track.period)
        before = np.searchsorted(track.t, track.t - window, side="right") - 1
        before = np.clip(before, 0, np.maximum(np.arange(len(track)) - 1, 0))
        speed = np.abs(track.q - track.q[before]) / window
        loose = np.cumsum(~track.follows, axis=0)
        throughout = track.follows[before] & (loose == loose[before])
        over = (speed > _FASTER * limits.dq) & throughout
        if not over.any():
            return False
        i, j = np.unravel_index(int(np.argmax(np.where(over, speed / limits.dq, 0))), over.shape)
        way = abs(track.q[i, j] - track.q[before[i], j])
        self.judge(
            "jumps",
            f"{_joints(limits, over)} would have to turn faster than they can at "
            f"{_places(over)}: {limits.names[j]} by {way:.2f} {limits.unit} in "
            f"{window * 1e3:.0f} ms at "
            f"{track.t[i]:.2f} s, at most {limits.dq[j]:.3g} {limits.unit}/s",
            "--set jumps=stretch",
            cured=self.options.jumps == "stretch",
            where=str(side),
        )
        return True

    def _stretched(self, tracks: dict[Side, Track]) -> dict[Side, Track]:
        """Stretch time so that every joint can follow, and interpolate commands."""
        needed = {s: self._needed(s, t) for s, t in tracks.items() if len(t) > 1}

        def slower(middle: Floats, dt: Floats) -> Floats:
            factor = np.ones_like(dt)
            for side, need in needed.items():
                t = tracks[side].t
                i = np.searchsorted(t, middle, side="right") - 1
                inside = (i >= 0) & (i < len(need))
                own = np.maximum(need / np.diff(t), 1.0)
                factor[inside] = np.maximum(factor[inside], own[i[inside]])
            return dt * factor

        warped = _warped(tracks, slower)
        return {
            s: _filled(t, needed[s] > np.diff(tracks[s].t), 1.0 / self.model.command_rate)
            if s in needed
            else t
            for s, t in warped.items()
        }

    def _needed(self, side: Side, track: Track) -> Floats:
        """Seconds that the hand needs from each command to the next, within its limits."""
        limits = joint_limits(self.spoken, side)
        q = np.clip(track.q, limits.low, limits.high)
        follows = track.follows[1:] & track.follows[:-1]
        return np.asarray((np.abs(np.diff(q, axis=0)) * follows / limits.dq).max(axis=1))

    def _rate(self, side: Side, track: Track) -> None:
        """Check that the command rate is not too low (a staircase)."""
        if len(track) < 2:
            self.note("single", "there is a single command", str(side))
            return
        rate, least = 1.0 / track.period, _THIN * self.model.command_rate
        steps = np.abs(np.diff(track.q, axis=0))
        torque = steps * track.kp[1:] * track.driven[1:]
        # a position servo makes its own way from goal to goal
        if rate >= least or not (torque > 0).any():
            return
        i, j = np.unravel_index(int(np.argmax(torque)), torque.shape)
        wished = self.options.resample or 0.0
        self.judge(
            "thin-rate",
            f"loud motors: {rate:.3g} commands a second, where the model's client sends "
            f"{self.model.command_rate:g}; steps of up to {steps[i, j]:.3f} {self.model.unit} at "
            f"kp {track.kp[i + 1, j]:g} are torque steps of {torque[i, j]:.2f} "
            f"{self.model.torque_unit}",
            f"--set rate={self.model.command_rate:g}",
            cured=wished >= least,
            where=str(side),
        )


def _from_states(t: Floats, q: Floats, hand: HandModel) -> HandCommands:
    """Positions as commands, with the gains of the model's client."""
    kp, kd = np.array(hand.gains).T
    zero = np.zeros_like(q)
    n = len(t)
    return HandCommands(
        t=t,
        q=q,
        dq=zero,
        tau=zero,
        kp=np.broadcast_to(kp, q.shape),
        kd=np.broadcast_to(kd, q.shape),
        driven=np.ones(q.shape, dtype=np.bool_),
        counts=np.full(n, q.shape[1]),
        late=np.zeros(n),
        backwards=np.zeros(n, dtype=np.bool_),
    )


def _held(q: Floats, follows: Flags) -> Floats:
    """Goals with each one that a motor does not follow replaced by its last one, or its first.

    A joint that never follows keeps what was sent.
    """
    index = np.arange(len(q))[:, None]
    last = np.maximum.accumulate(np.where(follows, index, -1), axis=0)
    first = np.where(follows.any(axis=0), np.argmax(follows, axis=0), index)
    return np.asarray(np.take_along_axis(q, np.where(last < 0, first, last), axis=0))


def _apart(t: Floats) -> Floats:
    """Make times strictly ascending, by microseconds."""
    return np.asarray(
        np.maximum.accumulate(t - _TICK * np.arange(len(t))) + _TICK * np.arange(len(t))
    )


def _warped(
    tracks: Mapping[Side, Track], change: Callable[[Floats, Floats], Floats]
) -> dict[Side, Track]:
    """Apply one change of time to all tracks.

    :param change: takes the midpoints and the lengths of the intervals between commands, and
        returns the new lengths.
    """
    grid = np.unique(np.concatenate([t.t for t in tracks.values()]))
    lengths = change((grid[1:] + grid[:-1]) / 2, np.diff(grid))
    new = np.concatenate([grid[:1], grid[0] + np.cumsum(lengths)])
    return {s: replace(t, t=np.interp(t.t, grid, new)) for s, t in tracks.items()}


def _inserted(track: Track, at: Ints, times: Floats, rows: Ints) -> Track:
    """Insert copies of the commands ``rows`` at places and times."""
    tables = {name: np.insert(v, at, v[rows], axis=0) for name, v in vars(track).items()}
    return Track(**{**tables, "t": np.insert(track.t, at, times)})


def _at_times(track: Track, times: Floats) -> Track:
    """The commands at other times: positions interpolated linearly, gains and mode held."""
    before = np.clip(np.searchsorted(track.t, times, side="right") - 1, 0, len(track) - 1)

    def line(table: Floats) -> Floats:
        columns = [np.interp(times, track.t, column) for column in table.T]
        return np.stack(columns, axis=1)

    return Track(
        t=times,
        q=line(track.q),
        dq=line(track.dq),
        tau=line(track.tau),
        kp=track.kp[before],
        kd=track.kd[before],
        driven=track.driven[before],
    )


def _filled(track: Track, where: Flags, period: float) -> Track:
    """Insert linearly interpolated commands into some of the intervals."""
    times = [track.t]
    for i in np.flatnonzero(where):
        a, b = track.t[i], track.t[i + 1]
        pieces = int(np.ceil((b - a) / period))
        times.append(np.linspace(a, b, pieces + 1)[1:-1])
    return _at_times(track, np.unique(np.concatenate(times)))


def _resampled(track: Track, rate: float) -> Track:
    if len(track) < 2:
        return track
    count = int((track.t[-1] - track.t[0]) * rate)
    if count > _MOST:
        raise UsageError(
            f"{rate:g} commands a second are {count:,} in all, more than {_MOST:,}",
            hint="shorten pauses with --set max-gap=S, or cut the session: dexkit cut",
        )
    times = np.append(track.t[0] + np.arange(count + 1) / rate, track.t[-1])
    return _at_times(track, np.unique(times))


def _joints(limits: JointLimits, which: Flags) -> str:
    """The joints with a mark in any row."""
    marks = np.asarray(which.any(axis=0)).tolist()
    names = [n for n, marked in zip(limits.names, marks, strict=True) if marked]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _places(which: Flags) -> str:
    rows = which.any(axis=1)
    begins = int((np.diff(rows.astype(np.int8), prepend=0) == 1).sum())
    return f"{begins} place{'' if begins == 1 else 's'}"


def _at(t: Floats, rows: Flags) -> str:
    return f", first {t[int(np.argmax(rows))]:.2f} s after the first" if rows.any() else ""
