"""The faults of generated hands, each independent of place and time.

Sizes are those of plausible mistakes: a tenth of the range, a factor of the unit, a fraction of a
second. Whether one of them matters is not decided here but by
:mod:`~dexkit.conformance.faults.generated.oracle`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

from dexkit.conformance.faults.generated.rig import Motors, Report, What
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual import Sample
from dexkit.hand import Side

__all__ = ["FAULTS", "KINDS"]

W = TypeVar("W", bound=type[What])
_found: dict[str, type[What]] = {}

KINDS: Mapping[str, frozenset[str]] = {
    "position": frozenset(
        ("FIELD", "FRESH", "MOVE", "JOINT", "TRACK", "START", "SIDE", "OPER", "SAFE")
    ),
    "velocity and torque": frozenset(("FIELD", "FORCE", "SENS", "MODE")),
    "command": frozenset(
        (
            *("MOVE", "JOINT", "TRACK", "GAIN", "SAFE", "OPER", "WDOG", "LIFE", "ORDER", "MODE"),
            # the path of a motion, commands that are sent once, and what changes within a run
            *("FORCE", "PATH", "STILL", "CMD", "ABUSE"),
        )
    ),
    "state flow": frozenset(
        ("RATE", "FRESH", "ORDER", "LOAD", "WDOG", "LIFE", "START", "TOPIC", "OPER")
    ),
    # what a bad command has done may show in the next good ones
    "safety": frozenset(
        ("WDOG", "GUARD", "SAFE", "HOLD", "MODE", "GAIN", "MOVE", "PATH", "STILL", "SIDE", "ABUSE")
    ),
    "motion": frozenset(
        (
            *("MOVE", "JOINT", "SAFE", "SIDE", "WDOG", "START", "HOLD", "GAIN", "TRACK", "LIFE"),
            *("PATH", "STILL", "ABUSE"),
        )
    ),
    # a hand that does not let go disobeys after a silence in which it pressed
    "force": frozenset(("FORCE", "HOLD", "SENS", "TRACK", "MOVE", "WDOG", "OPER")),
    "sides": frozenset(
        (
            *("SIDE", "MOVE", "JOINT", "START", "FIELD", "TRACK", "FRESH", "WDOG"),
            *("PATH", "STILL", "ABUSE"),
        )
    ),
}
"""The classes of faults, and the requirement areas that are a right reason for each."""


def _fault(
    kind: str,
    title: str,
    summary: str,
    *,
    several: bool = False,
    both: bool = False,
    idle: str = "",
    needs: str = "",
    areas: tuple[str, ...] = (),
) -> Callable[[W], W]:
    """Register a class as a fault; its areas are those of its kind, and ``areas``."""

    def register(made: W) -> W:
        made.kind, made.title, made.summary = kind, title, summary
        made.areas = KINDS[kind].union(areas)
        made.several, made.both, made.idle = several, both or kind == "sides", idle
        made.needs = needs or made.needs
        _found[title] = made
        return made

    return register


def _on(
    base: type[What], hook: str, kind: str, title: str, **flags: Any
) -> Callable[[Callable[..., Any]], type[What]]:
    """Register a function as a fault: it is one hook, and its description the summary."""

    def register(function: Callable[..., Any]) -> type[What]:
        text = (function.__doc__ or "").removesuffix(".")
        made = type(function.__name__, (base,), {hook: function})
        return _fault(kind, title, text[:1].lower() + text[1:], **flags)(made)

    return register


def _variant(base: type[What], kind: str, title: str, summary: str, **values: object) -> None:
    """Register the same change with other figures."""
    flags = {k: values.pop(k) for k in ("several", "both", "idle") if k in values}
    made = type(base.__name__, (base,), values)
    _fault(kind, title, summary, **flags)(made)  # type: ignore[arg-type]


# -------------------------------------------------------------------------------- position


class _History(What):
    """Keeps the values of the last second."""

    def before(self, joint: int, values: Report, seconds: float) -> Report:
        """The values of so long ago, or the oldest that are known."""
        past = self.memory.setdefault(joint, deque())
        now = self.rig.now
        if past and now - past[-1][0] > 0.2:
            past.clear()  # the condition was false in between
        past.append((now, replace(values)))
        while len(past) > 1 and past[1][0] <= now - seconds:
            past.popleft()
        found: Report = past[0][1]
        return found


@_on(What, "report", "position", "q-echo")
def _echo(self: What, joint: int, values: Report) -> None:
    """Reports the commanded q."""
    values.q = self.rig.goal(self.side, joint)


@_on(What, "report", "position", "q-echo-slewed")
def _echo_slewed(self: What, joint: int, values: Report) -> None:
    """Reports the commanded q at the speed of a good hand."""
    now = self.rig.now
    then, q = self.memory.get(joint, (now, values.q))
    if now - then > 0.1:
        then, q = now, values.q
    step = 1.3 * self.span(joint) * (now - then)
    values.q = q + min(max(self.rig.goal(self.side, joint) - q, -step), step)
    self.memory[joint] = now, values.q


@_on(What, "report", "position", "q-echo-near")
def _echo_near(self: What, joint: int, values: Report) -> None:
    """Reports the commanded q when it is within a tenth of it."""
    goal = self.rig.goal(self.side, joint)
    if abs(goal - values.q) < 0.1 * self.span(joint):
        values.q = goal


@_fault("position", "q-offset", "reports q with an offset of 6 % of the range")
class _Offset(What):
    part = 0.06

    def report(self, joint: int, values: Report) -> None:
        values.q += self.part * self.span(joint)


_variant(
    _Offset, "position", "q-offset-small", "reports q with an offset of 3 % of the range", part=0.03
)


@_on(What, "report", "position", "q-scale")
def _scale(self: What, joint: int, values: Report) -> None:
    """Reports 88 % of q."""
    low, _ = self.rig.limits(self.side, joint)
    values.q = low + 0.88 * (values.q - low)


@_fault("position", "q-filter", "reports q through a low-pass filter of 0.15 s")
class _Filter(What):
    seconds = 0.15

    def report(self, joint: int, values: Report) -> None:
        now = self.rig.now
        then, q = self.memory.get(joint, (now, values.q))
        if now - then > 0.5:
            q = values.q
        q += (values.q - q) * min(1.0, (now - then) / self.seconds)
        self.memory[joint] = now, q
        values.q = q


@_on(What, "report", "position", "q-predict")
def _predict(self: What, joint: int, values: Report) -> None:
    """Reports where the joint would be in 0.1 s."""
    values.q += 0.1 * values.dq


@_on(What, "report", "position", "q-coarse")
def _coarse(self: What, joint: int, values: Report) -> None:
    """Reports q in steps of 5 % of the range."""
    step = 0.05 * self.span(joint)
    values.q = step * round(values.q / step)


@_fault("position", "q-stuck", "reports the q of when it began", idle="")
class _Stuck(What):
    def report(self, joint: int, values: Report) -> None:
        since, q = self.memory.get(joint, (None, values.q))
        if since != self.since:
            q = values.q
        self.memory[joint] = self.since, q
        values.q = q


@_on(What, "report", "position", "q-jump")
def _jump(self: What, joint: int, values: Report) -> None:
    """Reports q a quarter of the range off for 30 ms every 0.5 s."""
    if self.rig.now % 0.5 < 0.03:
        values.q += 0.25 * self.span(joint) * (1 if self.rig.now % 1.0 < 0.5 else -1)


@_on(What, "report", "position", "q-mirror")
def _mirror(self: What, joint: int, values: Report) -> None:
    """Reports q from the other end."""
    low, high = self.rig.limits(self.side, joint)
    values.q = low + high - values.q


@_on(What, "report", "position", "q-swap", several=True)
def _swap(self: What, joint: int, values: Report) -> None:
    """Reports the q of the next joint."""
    values.q = self.rig.positions(self.side)[self.neighbour(joint)]


@_fault("position", "q-slow", "measures q ten times a second")
class _Slow(What):
    period = 0.1

    def report(self, joint: int, values: Report) -> None:
        now = self.rig.now
        at, q = self.memory.get(joint, (-math.inf, values.q))
        if now - at >= self.period:
            at, q = now, values.q
        self.memory[joint] = at, q
        values.q = q


@_on(_History, "report", "position", "q-late")
def _late(self: _History, joint: int, values: Report) -> None:
    """Reports the values of 0.12 s before."""
    old = self.before(joint, values, 0.12)
    values.q, values.dq, values.tau = old.q, old.dq, old.tau


@_on(What, "report", "position", "q-nan")
def _nan(self: What, joint: int, values: Report) -> None:
    """Reports NaN as q twice a second."""
    if self.rig.now % 0.5 < self.rig.period:
        values.q = math.nan


# --------------------------------------------------------------------- velocity and torque


class _Factor(What):
    """Multiplies one of the values."""

    member = ""
    factor = 1.0

    def report(self, joint: int, values: Report) -> None:
        setattr(values, self.member, self.factor * getattr(values, self.member))


_SPEEDS = "velocity and torque"


class _Dq(_Factor):
    member = needs = "dq"


class _Tau(_Factor):
    member, needs = "tau", "tau_est"


class _Ddq(_Factor):
    member = needs = "ddq"


_variant(_Dq, _SPEEDS, "dq-sign", "reports dq with the wrong sign", factor=-1.0)
_variant(_Dq, _SPEEDS, "dq-degrees", "reports dq in degrees a second", factor=math.degrees(1))
_variant(_Dq, _SPEEDS, "dq-zero", "reports 0 as dq", factor=0.0)
_variant(_Dq, _SPEEDS, "dq-half", "reports half of dq", factor=0.5)
_variant(_Tau, _SPEEDS, "tau-sign", "reports tau_est with the wrong sign", factor=-1.0)
_variant(_Tau, _SPEEDS, "tau-milli", "reports tau_est in mN m", factor=1000.0)
_variant(_Tau, _SPEEDS, "tau-zero", "reports 0 as tau_est", factor=0.0)
_variant(_Tau, _SPEEDS, "tau-weak", "reports a fifth of tau_est", factor=0.2)
_variant(_Ddq, _SPEEDS, "ddq-sign", "reports ddq with the wrong sign", factor=-1.0)


@_on(_History, "report", _SPEEDS, "dq-late", needs="dq")
def _dq_late(self: _History, joint: int, values: Report) -> None:
    """Reports the dq of 0.2 s before."""
    values.dq = self.before(joint, values, 0.2).dq


@_on(_History, "report", _SPEEDS, "tau-late", needs="tau_est")
def _tau_late(self: _History, joint: int, values: Report) -> None:
    """Reports the tau_est of 0.4 s before."""
    values.tau = self.before(joint, values, 0.4).tau


@_on(What, "report", _SPEEDS, "dq-swap", several=True, needs="dq")
def _dq_swap(self: What, joint: int, values: Report) -> None:
    """Reports the dq of the next joint."""
    values.dq = self.rig.velocities(self.side)[self.neighbour(joint)]


@_on(What, "report", _SPEEDS, "tau-swap", several=True, needs="tau_est")
def _tau_swap(self: What, joint: int, values: Report) -> None:
    """Reports the tau_est of the next joint."""
    values.tau = self.rig.hand_of(self.side).tau[self.neighbour(joint)]


@_on(What, "report", _SPEEDS, "tau-offset", needs="tau_est")
def _tau_offset(self: What, joint: int, values: Report) -> None:
    """Reports tau_est with an offset."""
    values.tau += 0.5 * self.rig.strength(self.side, joint)


@_fault(_SPEEDS, "tau-stuck", "reports the tau_est of when it began", needs="tau_est")
class _TauStuck(_Stuck):
    def report(self, joint: int, values: Report) -> None:
        shadow = replace(values, q=values.tau)
        super().report(joint, shadow)
        values.tau = shadow.q


@_on(What, "report", _SPEEDS, "mode-off")
def _mode_off(self: What, joint: int, values: Report) -> None:
    """Reports that no joint is driven."""
    values.mode &= ~0x71 if values.mode > 1 else ~1


# --------------------------------------------------------------------------------- command


class _Commanded(What):
    """Keeps the newest command that it let through."""

    kept: Motors | None = None

    def instead(self, motors: Motors, old: Motors | None) -> Motors | None:
        """An older command for its joints; None where it would replace all of them by none."""
        if old is None or (self.whole and old is self.kept):
            return None if self.whole else self.replaced(motors, self._here)
        return self.replaced(motors, lambda i, m: old[i])

    def _here(self, joint: int, motor: Motor) -> Motor:
        return replace(motor, q=self.rig.positions(self.side)[joint])


class _Delays(_Commanded):
    seconds = 0.0

    def command(self, motors: Motors) -> Motors | None:
        now, queue = self.rig.now, self.memory.setdefault("queue", deque())
        queue.append((now, motors))
        while queue and queue[0][0] <= now - self.seconds:
            self.kept = queue.popleft()[1]
        kept = self.kept
        return None if kept is None else self.replaced(motors, lambda i, m: kept[i])


_variant(_Delays, "command", "cmd-late", "obeys each command 0.12 s late", seconds=0.12)
_variant(_Delays, "command", "cmd-very-late", "obeys each command 0.4 s late", seconds=0.4)


class _Thins(_Commanded):
    every = 1

    count = 0

    def command(self, motors: Motors) -> Motors | None:
        self.count += 1
        if self.count % self.every == 0 or self.kept is None:
            self.kept = motors
            return motors
        return self.instead(motors, self.kept)


_variant(_Thins, "command", "cmd-every-2nd", "obeys every second command", every=2)
_variant(_Thins, "command", "cmd-every-30th", "obeys every thirtieth command", every=30)


@_fault("command", "cmd-newest-lost", "obeys the command before the newest")
class _NewestLost(_Commanded):
    newest: Motors | None = None

    def command(self, motors: Motors) -> Motors | None:
        before, self.newest = self.newest, motors
        return None if before is None else self.replaced(motors, lambda i, m: before[i])


@_fault("command", "cmd-change-lost", "ignores the first command that is new after equal ones")
class _ChangeLost(_Commanded):
    newest: Motors | None = None
    equal = 0

    def command(self, motors: Motors) -> Motors | None:
        changed = motors != self.newest
        lost = changed and self.equal > 20
        self.equal = 0 if changed else self.equal + 1
        if lost:
            return self.instead(motors, self.newest)
        self.newest = self.kept = motors
        return motors


@_fault("command", "cmd-deaf", "ignores commands")
class _Deaf(_Commanded):
    def command(self, motors: Motors) -> Motors | None:
        return None if self.whole else self.replaced(motors, self._held)

    def _held(self, joint: int, motor: Motor) -> Motor:
        since, q = self.memory.get(joint, (None, 0.0))
        if since != self.since:
            q = self.rig.positions(self.side)[joint]
            self.memory[joint] = self.since, q
        return replace(motor, q=q, dq=0.0, tau=0.0)


class _Goals(What):
    """Changes the commanded q of its joints."""

    def command(self, motors: Motors) -> Motors | None:
        return self.replaced(motors, self._changed)

    def _changed(self, joint: int, motor: Motor) -> Motor:
        return replace(motor, q=self.q(joint, motor)) if math.isfinite(motor.q) else motor

    def q(self, joint: int, motor: Motor) -> float:
        """The q that is obeyed instead."""
        raise AssertionError  # overridden


@_on(_Goals, "q", "command", "cmd-offset")
def _goal_offset(self: _Goals, joint: int, motor: Motor) -> float:
    """Goes 7 % of the range beyond the commanded q."""
    return motor.q + 0.07 * self.span(joint)


@_on(_Goals, "q", "command", "cmd-scale")
def _goal_scale(self: _Goals, joint: int, motor: Motor) -> float:
    """Goes 88 % of the way from the lower end."""
    low, _ = self.rig.limits(self.side, joint)
    return low + 0.88 * (motor.q - low)


@_on(_Goals, "q", "command", "cmd-mirror")
def _goal_mirror(self: _Goals, joint: int, motor: Motor) -> float:
    """Obeys q from the other end."""
    low, high = self.rig.limits(self.side, joint)
    return low + high - motor.q


@_on(_Goals, "q", "command", "cmd-slew")
def _slew(self: _Goals, joint: int, motor: Motor) -> Any:
    """Moves its goal by half of the range in a second."""
    now = self.rig.now
    then, q = self.memory.get(joint, (-math.inf, 0.0))
    if now - then > 0.3:
        then, q = now, self.rig.positions(self.side)[joint]
    step = 0.5 * self.span(joint) * (now - then)
    q += min(max(motor.q - q, -step), step)
    self.memory[joint] = now, q
    return q


@_on(_Goals, "q", "command", "cmd-dead-band")
def _dead_band(self: _Goals, joint: int, motor: Motor) -> float:
    """Ignores changes of q below 5 % of the range."""
    old = self.memory.get(joint)
    if old is None or abs(motor.q - old) > 0.05 * self.span(joint):
        self.memory[joint] = old = motor.q
    return old


@_on(_Goals, "q", "command", "clamp-short")
def _clamp_short(self: _Goals, joint: int, motor: Motor) -> float:
    """Stays 8 % of the range away from the ends."""
    low, high = self.rig.limits(self.side, joint)
    margin = 0.08 * (high - low)
    return min(max(motor.q, low + margin), high - margin)


@_on(_Goals, "q", "command", "clamp-sticks")
def _clamp_sticks(self: _Goals, joint: int, motor: Motor) -> Any:
    """Keeps the goal of an end until the next is half the range off."""
    low, high = self.rig.limits(self.side, joint)
    if not low + 1e-3 < motor.q < high - 1e-3:
        self.memory[joint] = min(max(motor.q, low), high)
    kept = self.memory.get(joint)
    if kept is None or abs(motor.q - kept) > 0.5 * (high - low):
        self.memory.pop(joint, None)
        return motor.q
    return kept


@_on(_Goals, "q", "command", "limits-of-next", several=True)
def _other_limits(self: _Goals, joint: int, motor: Motor) -> float:
    """Has the limits of the next joint."""
    low, high = self.rig.limits(self.side, (joint + 1) % self.rig.codec.joints)
    return min(max(motor.q, low), high)


@_on(What, "command", "command", "cmd-swap", several=True)
def _goal_swap(self: What, motors: Motors) -> Motors | None:
    """Obeys the q of the next joint."""
    return self.replaced(motors, lambda i, m: replace(m, q=motors[(i + 1) % len(motors)].q))


class _Gains(What):
    """Changes the gains and feed-forward of its joints."""

    def command(self, motors: Motors) -> Motors | None:
        return self.replaced(motors, self.changed)

    def changed(self, joint: int, motor: Motor) -> Motor:
        """The motor's command that is obeyed instead."""
        raise AssertionError  # overridden


@_on(_Gains, "changed", "command", "gains-fixed")
def _gains_fixed(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Uses the client's usual gains whatever is sent."""
    kp, kd = self.rig.gains(joint)
    return replace(motor, kp=kp, kd=kd)


@_on(What, "command", "command", "gains-of-next", several=True)
def _gains_of_next(self: What, motors: Motors) -> Motors | None:
    """Uses the gains of the next joint."""

    def changed(joint: int, motor: Motor) -> Motor:
        other = motors[(joint + 1) % len(motors)]
        return replace(motor, kp=other.kp, kd=other.kd)

    return self.replaced(motors, changed)


@_on(_Gains, "changed", "command", "gains-soft")
def _gains_soft(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Has an eighth of the stiffness."""
    return replace(motor, kp=0.125 * motor.kp)


@_on(_Gains, "changed", "command", "gains-stiff")
def _gains_stiff(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Has eight times the stiffness."""
    return replace(motor, kp=8.0 * motor.kp)


@_on(_Gains, "changed", "command", "limp-pulls")
def _limp_pulls(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Takes zero gains for the usual ones."""
    if motor.kp != 0 or motor.kd != 0:
        return motor
    kp, kd = self.rig.gains(joint)
    return replace(motor, kp=kp, kd=kd)


@_on(_Gains, "changed", "command", "full-limps")
def _full_limps(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Takes the usual gains for zero."""
    usual = motor.kp >= 0.9 * self.rig.gains(joint)[0]
    return replace(motor, kp=0.0, kd=0.0) if usual else motor


@_on(_Gains, "changed", "command", "dq-ignored")
def _dq_ignored(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Ignores the commanded velocity."""
    return replace(motor, dq=0.0) if math.isfinite(motor.dq) else motor


@_on(_Gains, "changed", "command", "tau-ignored")
def _tau_ignored(self: _Gains, joint: int, motor: Motor) -> Motor:
    """Ignores the commanded torque."""
    return replace(motor, tau=0.0) if math.isfinite(motor.tau) else motor


# ------------------------------------------------------------------------------ state flow


class _Holds(What):
    """Publishes only from time to time."""

    period = 0.0
    due = -math.inf

    def publish(self, samples: list[Sample]) -> list[Sample]:
        if not samples or self.rig.now < self.due:
            return []
        self.due = max(self.due, self.rig.now - self.period) + self.period
        return samples


_variant(_Holds, "state flow", "rate-60", "publishes 60 states a second", period=1 / 60)
_variant(_Holds, "state flow", "rate-20", "publishes 20 states a second", period=1 / 20)


@_on(What, "publish", "state flow", "bursts")
def _bursts(self: What, samples: list[Sample]) -> list[Sample]:
    """Publishes what it has every 80 ms."""
    held: list[Sample] = [*self.memory.pop("held", []), *samples]
    if held and self.rig.now - held[0].sent < 0.08:
        self.memory["held"] = held
        return []
    return held


class _Gaps(What):
    every, length = 1.0, 0.25

    def publish(self, samples: list[Sample]) -> list[Sample]:
        return [] if self.rig.now % self.every < self.length else samples


_variant(
    _Gaps, "state flow", "gaps", "publishes nothing for 0.25 s every second", every=1.0, length=0.25
)
_variant(
    _Gaps,
    "state flow",
    "gap-rare",
    "publishes nothing for 0.3 s every 20 s",
    every=20.0,
    length=0.3,
)


@_on(What, "publish", "state flow", "silent")
def _silent(self: What, samples: list[Sample]) -> list[Sample]:
    """Publishes nothing."""
    return []


class _Stale(What):
    seconds = 0.1
    fresh = False

    def publish(self, samples: list[Sample]) -> list[Sample]:
        now, queue = self.rig.now, self.memory.setdefault("queue", deque())
        queue.extend(samples)
        out = []
        while queue and queue[0].sent <= now - self.seconds:
            sample = queue.popleft()
            out.append(replace(sample, sent=now) if self.fresh else sample)
        return out[-1:] if self.fresh else out


_variant(_Stale, "state flow", "stale", "publishes states 0.1 s late", seconds=0.1)
_variant(
    _Stale,
    "state flow",
    "stale-restamped",
    "publishes states of 0.1 s ago with a new timestamp",
    seconds=0.1,
    fresh=True,
)


@_fault("state flow", "repeats", "publishes each measurement for 60 ms")
class _Repeats(What):
    until = -math.inf

    def publish(self, samples: list[Sample]) -> list[Sample]:
        now = self.rig.now
        if not samples:
            return samples
        if now >= self.until:
            self.until = now + 0.06
            self.memory = {x.topic: x for x in samples}
        return [replace(self.memory.get(x.topic, x), sent=now) for x in samples]


@_fault("state flow", "disorder", "publishes states in pairs, the newer one first")
class _Disorder(What):
    held: list[Sample] | None = None

    def publish(self, samples: list[Sample]) -> list[Sample]:
        if not samples:
            return samples
        if self.held is None:
            self.held = samples
            return []
        out, self.held = samples + self.held, None
        return out


# ---------------------------------------------------------------------------------- safety


class _Timeout(What):
    """Has another time-out."""

    factor = 1.0
    own: float | None = None

    def tick(self, dt: float, active: bool) -> None:
        hand = self.rig.hand_of(self.side)
        if self.own is None:
            self.own = hand.timeout
        hand.timeout = self.factor * self.own if active else self.own


_variant(_Timeout, "safety", "guard-none", "has no time-out", factor=math.inf)
_variant(_Timeout, "safety", "guard-late", "has a time-out of 1.7 times the right one", factor=1.7)
_variant(_Timeout, "safety", "guard-early", "has a quarter of the right time-out", factor=0.25)


class _Feeds(What):
    """Renews the time-out by what should not renew it."""

    seen = 0

    def events(self) -> int:
        """Counts them."""
        raise AssertionError  # overridden

    def tick(self, dt: float, active: bool) -> None:
        count = self.events()
        if active and count != self.seen:
            hand = self.rig.hand_of(self.side)
            if math.isfinite(hand.heard):
                hand.heard = self.rig.now
        self.seen = count


@_on(_Feeds, "events", "safety", "guard-fed-by-rejected", idle="needs rejected commands alone")
def _fed_by_rejected(self: _Feeds) -> int:
    """Takes rejected commands as a sign of life."""
    track = self.rig.tracks[self.side]
    return track.not_finite + track.malformed + track.foreign


@_on(
    _Feeds,
    "events",
    "safety",
    "guard-fed-by-other",
    both=True,
    idle="needs silence on one side alone",
)
def _fed_by_other(self: _Feeds) -> int:
    """Takes the other hand's commands as a sign of life."""
    other = self.rig.other(self.side)
    return 0 if other is None else self.rig.tracks[other].commands


@_on(What, "tick", "safety", "guard-resumes")
def _resumes(self: What, dt: float, active: bool) -> None:
    """Takes up the last command 0.6 s after the time-out."""
    track = self.rig.tracks[self.side]
    timeout = self.rig.model.command_timeout
    if active and track.motors is not None and self.rig.now - track.heard > timeout + 0.6:
        hand = self.rig.hand_of(self.side)
        motors = track.motors
        hand.command(motors if self.rig.codec.joints > 1 else motors[0])


@_on(What, "torque", "safety", "gives-way")
def _gives_way(self: What, joint: int, tau: float, dt: float) -> float:
    """Pushes open after the time-out."""
    silent = self.rig.now - self.rig.tracks[self.side].heard > self.rig.model.command_timeout
    closing = self.rig.joints[self.side][joint].closing
    away = -closing if closing else 1
    commanded = self.rig.tracks[self.side].commands
    return away * self.rig.strength(self.side, joint) if silent and commanded else tau


class _Finite(What):
    """Obeys what is not finite."""

    def command(self, motors: Motors) -> Motors | None:
        if all(math.isfinite(x) for m in motors for x in (m.q, m.dq, m.tau, m.kp, m.kd)):
            self.last = motors
            return motors
        return tuple(self.repaired(i, m) for i, m in enumerate(motors))

    last: Motors | None = None

    def repaired(self, joint: int, motor: Motor) -> Motor:
        """A motor's command without what is not finite."""
        values = (motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        if all(map(math.isfinite, values)) or joint not in self.joints:
            return motor
        return self.made(joint, motor)

    def made(self, joint: int, motor: Motor) -> Motor:
        """The same, of a motor that has such a value."""
        raise AssertionError  # overridden


@_on(_Finite, "made", "safety", "nan-is-zero")
def _nan_is_zero(self: _Finite, joint: int, motor: Motor) -> Motor:
    """Takes what is not finite for 0."""

    def zero(x: float) -> float:
        return x if math.isfinite(x) else 0.0

    q, dq, tau = zero(motor.q), zero(motor.dq), zero(motor.tau)
    return Motor(q, dq, tau, zero(motor.kp), zero(motor.kd), motor.mode)


@_on(_Finite, "made", "safety", "nan-is-last")
def _nan_is_last(self: _Finite, joint: int, motor: Motor) -> Motor:
    """Replaces a joint's bad command by its last one."""
    return motor if self.last is None else self.last[joint]


@_on(_Finite, "made", "safety", "nan-is-high")
def _nan_is_high(self: _Finite, joint: int, motor: Motor) -> Motor:
    """Takes what is not finite for the upper limit, with usual gains."""
    kp, kd = self.rig.gains(joint)
    q = motor.q if math.isfinite(motor.q) else self.rig.limits(self.side, joint)[1]
    return Motor(q, 0.0, 0.0, kp, kd, motor.mode)


@_on(What, "command", "safety", "nan-brakes")
def _nan_brakes(self: What, motors: Motors) -> Motors | None:
    """Brakes at a value that is not finite, until the next restart."""
    return None if self.rig.tracks[self.side].not_finite else motors


@_fault("safety", "length-brakes", "hears nothing for 2 s after a command of another length")
class _LengthBrakes(What):
    seen, until = 0, -math.inf

    def command(self, motors: Motors) -> Motors | None:
        count = self.rig.tracks[self.side].malformed
        if count != self.seen:
            self.seen, self.until = count, self.rig.now + 2.0
        return None if self.rig.now < self.until else motors


@_on(What, "torque", "safety", "negative-gains")
def _negative_gains(self: What, joint: int, tau: float, dt: float) -> float:
    """Applies negative gains."""
    motors = self.rig.tracks[self.side].raw
    if motors is None or not self.rig.driven(self.side) or not motors[joint].kp < 0:
        return tau
    q = self.rig.positions(self.side)[joint]
    dq = self.rig.velocities(self.side)[joint]
    return motors[joint].kp * (motors[joint].q - q) - motors[joint].kd * (motors[joint].dq - dq)


@_on(_Goals, "q", "safety", "far-wraps")
def _far_wraps(self: _Goals, joint: int, motor: Motor) -> float:
    """Takes a q far out of range modulo the range."""
    low, high = self.rig.limits(self.side, joint)
    span = high - low
    if low - span <= motor.q <= high + span:
        return motor.q
    return low + (motor.q - low) % span


@_fault("safety", "far-is-deaf", "ignores all commands for 1.5 s after one far out of range")
class _FarDeaf(What):
    seen, until = 0, -math.inf

    def command(self, motors: Motors) -> Motors | None:
        count = self.rig.tracks[self.side].far
        if count != self.seen:
            self.seen, self.until = count, self.rig.now + 1.5
        return None if self.rig.now < self.until else motors


# ---------------------------------------------------------------------------------- motion


class _Moves(What):
    """Drives its joints to a place of its own, whatever is commanded."""

    def place(self, joint: int) -> float | None:
        """The goal of its own motion, rad; None while it obeys."""
        raise AssertionError  # overridden

    def torque(self, joint: int, tau: float, dt: float) -> float:
        place = self.place(joint)
        if place is None:
            return tau
        kp, kd = self.rig.gains(joint)
        q = self.rig.positions(self.side)[joint]
        limit = 2.0 * self.rig.strength(self.side, joint)
        return (
            min(max(kp * (place - q), -limit), limit) - kd * self.rig.velocities(self.side)[joint]
        )


@_on(_Moves, "place", "motion", "homes")
def _homes(self: _Moves, joint: int) -> float | None:
    """Goes to its lower end for a second when it begins."""
    return self.rig.limits(self.side, joint)[0] if self.active_s < 1.0 else None


@_on(_Moves, "place", "motion", "snaps")
def _snaps(self: _Moves, joint: int) -> float | None:
    """Goes to its upper end for 0.25 s when it begins."""
    return self.rig.limits(self.side, joint)[1] if self.active_s < 0.25 else None


@_fault("motion", "drifts", "drifts by 4 % of the range in a second from where it is")
class _Drifts(_Moves):
    def place(self, joint: int) -> float | None:
        since, q = self.memory.get(joint, (None, 0.0))
        if since != self.since:
            q = self.rig.positions(self.side)[joint]
            self.memory[joint] = self.since, q
        span = self.span(joint)
        # obeys again for a fifth of the time, so that it moves from elsewhere next
        if self.active_s % 5.0 > 4.0:
            self.memory.pop(joint, None)
            return None
        return q + 0.04 * span * (self.active_s % 5.0) if self._still(joint) else None

    def _still(self, joint: int) -> bool:
        return abs(self.rig.goal(self.side, joint) - self.rig.positions(self.side)[joint]) < (
            0.25 * self.span(joint)
        )


class _Pushes(What):
    """Adds a torque of its own."""

    def torque(self, joint: int, tau: float, dt: float) -> float:
        return tau + self.push() * self.rig.strength(self.side, joint)

    def push(self) -> float:
        """The torque, in the joint's strengths."""
        raise AssertionError  # overridden


@_on(_Pushes, "push", "motion", "kicks")
def _kicks(self: _Pushes) -> float:
    """Kicks for 60 ms every 3 s."""
    return 2.0 if self.rig.now % 3.0 < 0.06 else 0.0


@_on(_Pushes, "push", "motion", "kicks-once")
def _kicks_once(self: _Pushes) -> float:
    """Kicks for 0.1 s when it begins."""
    return 2.0 if self.active_s < 0.1 else 0.0


@_on(_Pushes, "push", "motion", "shakes")
def _shakes(self: _Pushes) -> float:
    """Shakes 8 times a second."""
    return 0.6 * math.sin(2 * math.pi * 8.0 * self.rig.now)


@_on(_Pushes, "push", "motion", "pulls")
def _pulls(self: _Pushes) -> float:
    """Is pulled towards its lower end."""
    return -0.8


@_on(_Goals, "q", "motion", "goal-sags")
def _goal_sags(self: _Goals, joint: int, motor: Motor) -> Any:
    """Lets its goal go by 3 % of the range in a second while it holds."""
    q, at = self.memory.get(joint, (math.inf, 0.0))
    if abs(motor.q - q) > 1e-4:
        q, at = motor.q, self.rig.now
    self.memory[joint] = q, at
    return motor.q - 0.03 * self.span(joint) * min(self.rig.now - at, 5.0)


# ----------------------------------------------------------------------------------- force


class _Forces(What):
    """Changes the torque in contact."""

    contact_since: float | None = None

    def tick(self, dt: float, active: bool) -> None:
        if not self.rig.touching(self.side):
            self.contact_since = None
        elif self.contact_since is None:
            self.contact_since = self.rig.now

    @property
    def pressed_s(self) -> float:
        """Seconds of the present contact."""
        return 0.0 if self.contact_since is None else self.rig.now - self.contact_since


@_fault("force", "force-fades", "loses its force within a second of contact")
class _Fades(_Forces):
    seconds = 1.0

    def torque(self, joint: int, tau: float, dt: float) -> float:
        return tau * max(0.1, 1.0 - self.pressed_s / self.seconds)


_variant(
    _Fades, "force", "force-fades-slowly", "loses its force within 6 s of contact", seconds=6.0
)


@_on(_Forces, "torque", "force", "force-slams")
def _slams(self: _Forces, joint: int, tau: float, dt: float) -> float:
    """Closes with three times the force on contact."""
    return 3.0 * tau if 0 < self.pressed_s < 0.4 else tau


@_on(_Forces, "torque", "force", "force-strong")
def _strong(self: _Forces, joint: int, tau: float, dt: float) -> float:
    """Presses with twice the force."""
    return 2.0 * tau if self.pressed_s > 0 else tau


@_on(_Forces, "torque", "force", "force-weak")
def _weak(self: _Forces, joint: int, tau: float, dt: float) -> float:
    """Presses with a quarter of the force."""
    return 0.25 * tau if self.pressed_s > 0 else tau


@_on(_Forces, "torque", "force", "force-releases")
def _releases(self: _Forces, joint: int, tau: float, dt: float) -> float:
    """Lets go after 0.5 s of contact, until it is elsewhere."""
    return 0.0 if self.pressed_s > 0.5 else tau


@_fault("force", "force-locks", "does not let go for 3 s after contact")
class _Locks(_Forces):
    until = -math.inf
    sign = 0.0

    def torque(self, joint: int, tau: float, dt: float) -> float:
        if self.pressed_s > 0.3 and abs(tau) > 0.3 * self.rig.strength(self.side, joint):
            if self.rig.now > self.until:
                self.sign = math.copysign(1.0, tau)
            if math.copysign(1.0, tau) == self.sign:
                self.until = self.rig.now + 3.0
        if self.rig.now < self.until and tau * self.sign < 0:
            return self.sign * 0.3 * self.rig.strength(self.side, joint)
        return tau


# ----------------------------------------------------------------------------------- sides


class _Other(What):
    """Has to do with the other side."""

    def other_side(self) -> Side | None:
        """The other side, if it is in the run."""
        return self.rig.other(self.side)


@_on(_Other, "command", "sides", "side-cmd-other")
def _cmd_other(self: _Other, motors: Motors) -> Motors | None:
    """Obeys the other hand's commands."""
    other = self.other_side()
    newest = None if other is None else self.rig.tracks[other].raw
    return motors if newest is None else self.replaced(motors, lambda i, m: newest[i])


@_fault("sides", "side-cmd-both", "obeys the other hand's changes of q as well")
class _CmdBoth(_Other, _Goals):
    seen: Motors | None = None
    theirs = False

    def command(self, motors: Motors) -> Motors | None:
        other = self.other_side()
        newest = None if other is None else self.rig.tracks[other].motors
        if newest is None:
            return motors
        if newest is not self.seen:
            self.theirs, self.seen = self.seen is not None, newest
            self.mine = motors
        if self.theirs and motors == self.mine:
            return self.replaced(motors, lambda i, m: replace(m, q=newest[i].q))
        self.theirs = False
        return motors

    mine: Motors | None = None


@_fault("sides", "side-leak", "adds 8 % of the other hand's goal to its own")
class _Leak(_Other, _Goals):
    def q(self, joint: int, motor: Motor) -> float:
        other = self.other_side()
        if other is None:
            return motor.q
        low, high = self.rig.limits(other, joint)
        return motor.q + 0.08 * (self.rig.goal(other, joint) - 0.5 * (low + high))


@_on(_Other, "report", "sides", "side-state-other")
def _state_other(self: _Other, joint: int, values: Report) -> None:
    """Reports the other hand's q."""
    other = self.other_side()
    if other is not None:
        values.q = self.rig.positions(other)[joint]


@_on(_Other, "report", "sides", "side-tau-other", needs="tau_est", areas=("FORCE",))
def _tau_other(self: _Other, joint: int, values: Report) -> None:
    """Reports the other hand's dq and tau_est."""
    other = self.other_side()
    if other is None:
        return
    if "dq" in self.rig.measured_members:
        values.dq = self.rig.velocities(other)[joint]
    tau = self.rig.hand_of(other).tau
    values.tau = tau if isinstance(tau, float) else tau[joint]


@_on(_Other, "torque", "sides", "side-push")
def _side_push(self: _Other, joint: int, tau: float, dt: float) -> float:
    """Is pushed by the other hand's motion."""
    other = self.other_side()
    if other is None:
        return tau
    speed = self.rig.velocities(other)[joint] / self.rig.spans[other][joint]
    return tau + min(max(speed, -1.0), 1.0) * self.rig.strength(self.side, joint)


@_on(_Other, "command", "sides", "side-waits")
def _side_waits(self: _Other, motors: Motors) -> Motors | None:
    """Obeys only while the other hand is commanded at rest."""
    other = self.other_side()
    return None if other is not None and self.rig.tracks[other].moving else motors


FAULTS: Mapping[str, type[What]] = _found
"""Every fault, by name."""
