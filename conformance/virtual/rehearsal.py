"""A replay rehearsed: the same machine and messages, with a reference hand on a virtual clock."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dexkit.conformance.hands import under_test
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import Dialect, model
from dexkit.teleop.client_codec import ClientCodec
from dexkit.traces.replay.machine import Guards, Phase, ReplayMachine
from dexkit.traces.replay.prepare import Plan, joint_limits
from dexkit.traces.replay.states import DecodedHand, HandStateCodec

__all__ = ["JointFigures", "Rehearsal", "Rehearsed", "rehearse"]

_DEFAULT = Guards()
_SETTLED = 0.5
"""Seconds of hand before the replay begins and after it ends."""
_LONGEST = 3600.0
_RIPPLE = 0.1
"""Seconds of the mean that a ripple is about: three steps of 30 Hz."""
_SATURATED = 0.98
"""Part of its largest torque from which on a motor counts as at its limit."""


@dataclass(frozen=True)
class JointFigures:
    """Figures of a joint during the replay.

    :param moved: rad that it was commanded over, and that it moved over.
    :param rms: of the distance from its command, rad; ``worst`` the largest, ``at`` when.
    :param speed: largest, rad/s; ``torque`` largest, N·m.
    :param ripple: rms of the torque's difference from its mean over 0.1 s, N·m: what makes motors
        loud.
    :param limit: part of the time that its motor gave its largest torque.
    """

    name: str
    commanded: float
    moved: float
    rms: float
    worst: float
    at: float
    speed: float
    torque: float
    ripple: float
    limit: float


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """One hand: commands and states in seconds from the start, shape (n,) and (n, joints).

    :param command: q as last sent, rad; NaN before the first one.
    """

    side: Side
    names: tuple[str, ...]
    t: Floats
    command: Floats
    q: Floats
    tau: Floats
    playing: Floats
    """1 while the session is played, else 0."""

    def figures(self, tau_max: Floats) -> list[JointFigures]:
        """The figures of each joint; none if the session was not played."""
        played = self.playing > 0
        if played.sum() < 2:
            return []
        t, command, q, tau = self.t[played], self.command[played], self.q[played], self.tau[played]
        away = np.abs(command - q)
        speed = np.abs(np.diff(q, axis=0)) / np.diff(t)[:, None]
        worst = np.argmax(away, axis=0)
        return [
            JointFigures(
                name=name,
                commanded=float(np.ptp(command[:, j])),
                moved=float(np.ptp(q[:, j])),
                rms=float(np.sqrt(np.mean(away[:, j] ** 2))),
                worst=float(away[worst[j], j]),
                at=float(t[worst[j]]),
                speed=float(speed[:, j].max()),
                torque=float(np.abs(tau[:, j]).max()),
                ripple=_ripple(t, tau[:, j]),
                limit=float((np.abs(tau[:, j]) >= _SATURATED * tau_max[j]).mean()),
            )
            for j, name in enumerate(self.names)
        ]


def _ripple(t: Floats, tau: Floats) -> float:
    """Rms of the difference from the mean over a window."""
    width = max(3, round(_RIPPLE / float(np.median(np.diff(t)))))
    if len(tau) <= width:
        return 0.0
    mean = np.convolve(tau, np.full(width, 1.0 / width), mode="valid")
    begin = width // 2
    return float(np.sqrt(np.mean((tau[begin : begin + len(mean)] - mean) ** 2)))


@dataclass(eq=False)
class Rehearsal:
    """Result of a rehearsal.

    :param machine: at its end: why it ended, and what it sent.
    :param phases: (phase, begin, end) in seconds from the start.
    """

    plan: Plan
    machine: ReplayMachine
    hands: dict[Side, Rehearsed]
    phases: list[tuple[Phase, float, float]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Its length."""
        return max((float(h.t[-1]) for h in self.hands.values() if len(h.t)), default=0.0)

    @property
    def units(self) -> tuple[str, str]:
        """Units of q and of tau_est."""
        hand = model(self.plan.dialect.model)
        return hand.unit, hand.torque_unit

    def figures(self) -> Mapping[Side, list[JointFigures]]:
        """Figures of each joint, by side."""
        return {s: h.figures(joint_limits(self.plan.dialect, s).tau) for s, h in self.hands.items()}


class _Log:
    """Rows of one hand, packed: an hour of it has millions of states."""

    def __init__(self, joints: int) -> None:
        self.t = array("d")
        self.rows = array("d")
        self.playing = array("d")
        self.command: tuple[float, ...] = (float("nan"),) * joints

    def note(self, now: float, seen: DecodedHand, *, playing: bool) -> None:
        """Record a state, and the last command before it."""
        self.t.append(now)
        for values in (self.command, seen.q, seen.tau):
            self.rows.extend(values)
        self.playing.append(float(playing))


def rehearse(plan: Plan, guards: Guards = _DEFAULT) -> Rehearsal:
    """Play a plan to the reference hands of its model, which obey the law of their motors.

    :param guards: as for the hand; a session that is looped is played once.
    :raises UsageError: it takes more than an hour.
    """
    if plan.duration > _LONGEST:
        raise UsageError(
            f"the session takes {plan.duration:,.0f} s, too long to be rehearsed",
            hint="shorten pauses with --set max-gap=S, or cut the session: dexkit cut",
        )
    machine = ReplayMachine(plan, Guards(**{**vars(guards), "loop": False}))
    spoken: Dialect = plan.dialect
    service = under_test(spoken.model).reference.load()(spoken, plan.sides, {})
    encode, states = ClientCodec(spoken), HandStateCodec(spoken)
    topics = {states.topics[s] for s in plan.sides}
    joints = len(model(spoken.model).joints[Side.LEFT])
    logs = {s: _Log(joints) for s in plan.sides}
    result = Rehearsal(plan, machine, {})
    now, due, ended = 0.0, _SETTLED, 0.0
    while not ended or now < ended + _SETTLED:
        now += service.tick
        if now > plan.duration + _LONGEST:
            raise UsageError(
                f"the hand is not where the session begins after {_LONGEST:,.0f} s",
                hint="--set ramp-speed=RAD/S says how fast it goes there",
            )
        for sample in service.advance(service.tick):
            if sample.topic not in topics:
                continue
            for side, seen in states.seen(sample.topic, sample.payload).items():
                if side in logs:
                    machine.receive(now, side, seen)
                    logs[side].note(now, seen, playing=machine.phase is Phase.PLAY)
        if now + 1e-9 < due:
            continue
        if not ended:
            _turn(result, now)
            commands = machine.step(now)
            for topic, payload in encode.encode(commands):
                service.receive(topic, payload, 0)
            for side, motors in commands.items():
                logs[side].command = tuple(m.q for m in motors)
            due = machine.wakes_at(now)
            if machine.phase is Phase.END:
                ended = now
        else:
            due = now + 0.01
    _turn(result, now)
    for side, log in logs.items():
        table = np.asarray(log.rows).reshape(len(log.t), 3, joints)
        result.hands[side] = Rehearsed(
            side=side,
            names=joint_limits(spoken, side).names,
            t=np.asarray(log.t),
            command=table[:, 0],
            q=table[:, 1],
            tau=table[:, 2],
            playing=np.asarray(log.playing),
        )
    return result


def _turn(result: Rehearsal, now: float) -> None:
    """Record the replay's phase at ``now``, seconds."""
    phase = result.machine.phase
    if result.phases and result.phases[-1][0] is phase:
        result.phases[-1] = (phase, result.phases[-1][1], now)
    else:
        if result.phases:
            result.phases[-1] = (*result.phases[-1][:2], now)
        result.phases.append((phase, now, now))
