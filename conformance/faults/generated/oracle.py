"""Decide whether a generated hand is wrong by comparing it with the reference, without any check.

The hand and its reference get the same commands open loop: those of a conformance run, and a long
random stimulus. Compared is what an observer can tell: what comes over the wire, and the true
positions and forces at the fingers. Thresholds are of consequences for who uses the hand; each
constant says which.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.faults.generated import Generated
from dexkit.conformance.faults.generated.rig import Faulty, compose
from dexkit.conformance.faults.generated.stimulus import (
    Event,
    Segment,
    Stretch,
    conformance,
    play_order,
    random_segments,
)
from dexkit.conformance.faults.trials import plan_for
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.recording import States
from dexkit.conformance.stimuli import Plan
from dexkit.conformance.virtual import MemoryTrace
from dexkit.conformance.virtual.topic_run import log_time_ns
from dexkit.hand import Floats, Side
from dexkit.messages import message_type
from dexkit.models import Dialect, model

__all__ = ["Effect", "Opinion", "Severity", "examine", "shortest"]

Flags = NDArray[np.bool_]

FAR, FAR_S = 0.10, 0.15
"""Of the range, and seconds: 9 mm of a Dex1-1's jaw, or 10 degrees of a finger, for the time of an
operator's reaction. A grasp with this error misses or crushes the object."""
LATE_S = 0.25
"""Seconds by which a motion may be late and still be the commanded one: a human's reaction. Beyond
that an operator oversteers."""
OFF, OFF_S = 0.03, 0.10
"""3 mm of the jaw, at the time at which the reference is there: what an operator sees."""
LIES, LIES_S = 0.06, 0.05
"""Reported q against the true one. xr_teleoperate commands at most a thirtieth of the stroke ahead
of the state (docs/sources/unitree-dex.md#b3): twice that turns its commands round. 0.05 s is ten of
its cycles. The client of a position servo does not command from q: its target is the operator's
(docs/sources/unitree-dex.md#j1). There q may be as late and as far off as a motion."""
JUMPS, JUMPS_S = 0.15, 0.01
"""A jump for two cycles that is five times that lead."""
UNTRUE, UNTRUE_S = 0.025, 0.05
"""A reported q that is off by most of that lead."""
FROZEN, HELD = 0.05, 0.02
"""Of the range: how far the hand moves while the same q is reported. More than that lead, or most
of it."""
DEAD_S, GAP_S = 0.15, 0.05
"""Without state a client repeats its last command: for 30 cycles, in which a gripper crosses its
stroke halfway, and for 10."""
SLOW, SLOWISH = 0.5, 0.9
"""States for each cycle of the client, over a second: below half it acts on the same state twice
and more; below nine tenths now and then. Grave is no rate that the vendor's own service has, less a
fifth (``min_state_rate`` of the profile)."""
SPEED, SPEED_S = 0.2, 0.1
"""Of the range in a second: an error of dq that a client's filter or damping would act on."""
GRIP, GRIP_S = 0.5, 0.3
"""Of the torque of a soft grip (a twentieth of the range times kp), and seconds: a client that
closes until it feels the object closes on, or never closes."""
PRESS, PRESS_S = 0.5, 0.4
"""Of the force on an object: dropped, or crushed."""
PRESSED, PRESSED_S = 0.25, 0.2
"""A change of the force that a scale shows."""
POWER_S = 0.5
"""Seconds for which the motor is driven where the reference has braked: no client is there any
more, and a finger that is caught stays caught."""


class Severity(Enum):
    """Severity of a fault for the user of the hand."""

    EQUIVALENT = "equivalent"
    LESSER = "lesser"
    BREAKING = "must-breaking"


@dataclass(frozen=True)
class Effect:
    """A difference from the reference that an observer can tell.

    :param at: seconds from the beginning of its stimulus.
    :param stimulus: ``conformance`` or ``random``.
    :param stretch: the phase or segment in which it shows.
    :param index: of the stretch.
    """

    severity: Severity
    text: str
    at: float
    stimulus: str = ""
    stretch: str = ""
    index: int = -1


@dataclass(frozen=True)
class Opinion:
    """The oracle's opinion of a hand.

    :param effects: the first effect of each kind, the gravest first.
    :param in_kit: the gravest severity under the kit's own stimulus.
    """

    severity: Severity
    effects: tuple[Effect, ...]
    in_kit: Severity


@dataclass
class _Observed:
    """Data that an observer of one side of a run records.

    :param t: seconds of every tick.
    :param q: true positions, shape (n, joints); dq, tau, contact and driven likewise.
    """

    t: Floats
    q: Floats
    dq: Floats
    tau: Floats
    contact: Floats
    driven: Flags
    states: States | None

    @cached_property
    def reach(self) -> tuple[Floats, Floats]:
        """The least and greatest q of the last :data:`LATE_S`, at every tick."""
        count = max(1, round(LATE_S / float(self.t[1] - self.t[0])))
        padded = np.concatenate((np.repeat(self.q[:1], count, axis=0), self.q))
        windows = np.lib.stride_tricks.sliding_window_view(padded, count + 1, axis=0)
        return windows.min(axis=-1), windows.max(axis=-1)


def _observe(
    service_class: type[Faulty], plan: Plan[Side], events: Sequence[Event]
) -> dict[Side, _Observed]:
    """Play events to a service; what is seen of each side."""
    service = service_class(plan.dialect, plan.sides, plan.objects)
    trace = MemoryTrace(endpoints=service.endpoints())
    codec = service.codec
    foreign = codec.foreign.name
    rows: dict[Side, list[tuple[Sequence[float], ...]]] = {s: [] for s in plan.sides}
    times: list[float] = []
    tick = service.tick
    now = 0.0

    for event in events:
        while now + 1e-9 < event.at:
            now += tick
            for x in service.advance(tick):
                trace.put(x.topic, x.type_name, log_time_ns(now), log_time_ns(x.sent), x.payload)
            times.append(now)
            for side, seen in rows.items():
                seen.append(service.seen(side))
        service.stamp = now - event.age_s
        if event.do == "send":
            service.receive(event.topic, event.payload, event.client)
        elif event.do == "foreign":
            service.foreign(event.topic, foreign, event.payload)
        elif event.do == "restart":
            service = service_class(plan.dialect, plan.sides, plan.objects)
            service.begin(now)
    recording = None
    if trace.rows:
        message_type(plan.dialect.state_type)
        recording = recording_of(trace, plan.dialect.name, plan.sides)
    found = {}
    for side in plan.sides:
        columns = [np.array(c) for c in zip(*rows[side], strict=True)]
        states = None
        if recording is not None:
            states = recording.sides[side].states
            first = recording.origin_ns
            states.t[:] += (first - log_time_ns(0.0)) / 1e9  # seconds of the stimulus
        q, dq, tau, contact, driven = columns
        found[side] = _Observed(np.array(times), q, dq, tau, contact, driven[:, 0] > 0.5, states)
    return found


def _first(mask: Flags, t: Floats, seconds: float) -> float | None:
    """Begin of the first stretch in which ``mask`` stays true for so long, or None."""
    if not mask.any():
        return None
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0]))))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if t[end - 1] - t[begin] >= seconds:
            return float(t[begin])
    return None


class _Compare:
    """Compares one side of a run with the reference's."""

    def __init__(self, dialect: Dialect, side: Side, got: _Observed, ref: _Observed) -> None:
        self.dialect, self.got, self.ref = dialect, got, ref
        profile = model(dialect.model)
        joints = profile.joints[side]
        self.spans = np.array(
            [dialect.q_open] if dialect.is_gripper else [j.stroke for j in joints]
        )
        self.grip = 0.05 * self.spans * np.array([kp for kp, _ in profile.gains])
        self.measured = under_test(profile.name).reference.load().measured_members
        self.rate = profile.command_rate
        self.least_rate = min(SLOW * profile.command_rate, profile.min_state_rate)
        self.side = side
        self.effects: list[Effect] = []

    def note(
        self,
        severity: Severity,
        text: str,
        mask: Flags,
        t: Floats,
        seconds: float,
    ) -> None:
        """An effect, where the mask is true for long enough on a joint."""
        flat: Flags = mask if mask.ndim == 1 else np.asarray(mask.any(axis=1))
        at = _first(flat, t, seconds)
        if at is not None:
            self.effects.append(Effect(severity, f"{self.side}: {text}", at))

    def run(self) -> list[Effect]:
        """Every effect."""
        self._motion()
        self._force()
        self._flow()
        self._reports()
        return self.effects

    def _motion(self) -> None:
        got, ref = self.got, self.ref
        off = np.abs(got.q - ref.q) / self.spans
        low, high = ref.reach
        away = np.maximum(low - got.q, got.q - high) / self.spans
        self.note(Severity.BREAKING, "moves elsewhere than commanded", away > FAR, got.t, FAR_S)
        self.note(Severity.LESSER, "moves a little elsewhere", off > OFF, got.t, OFF_S)
        powered = got.driven & ~ref.driven
        self.note(Severity.BREAKING, "is driven without a client", powered, got.t, POWER_S)
        idle = ref.driven & ~got.driven
        self.note(Severity.LESSER, "is not driven while it is commanded", idle, got.t, OFF_S)

    def _force(self) -> None:
        got, ref = self.got, self.ref
        change = np.abs(got.contact - ref.contact)
        much = change > np.maximum(PRESS * np.abs(ref.contact), 0.5 * self.grip)
        self.note(Severity.BREAKING, "presses with another force", much, got.t, PRESS_S)
        some = change > np.maximum(PRESSED * np.abs(ref.contact), 0.25 * self.grip)
        self.note(Severity.LESSER, "presses with a different force", some, got.t, PRESSED_S)

    def _flow(self) -> None:
        got, ref = self.got, self.ref
        t = np.array([]) if got.states is None else np.asarray(got.states.t)
        end = float(got.t[-1])
        # where the reference is silent itself, its service has been restarted
        there = np.array([]) if ref.states is None else np.asarray(ref.states.t)
        edges = np.concatenate(([0.0], t, [end]))
        gaps = np.diff(edges)
        for severity, least in ((Severity.BREAKING, DEAD_S), (Severity.LESSER, GAP_S)):
            for i in np.flatnonzero(gaps > least):
                inside = there[(there > edges[i] + 1e-6) & (there < edges[i + 1] - 1e-6)]
                own = np.diff(np.concatenate(([edges[i]], inside, [edges[i + 1]]))).max()
                if gaps[i] - own > 0.5 * least:
                    text = f"publishes nothing for {gaps[i]:.2f} s"
                    self.effects.append(Effect(severity, f"{self.side}: {text}", float(edges[i])))
                    break
        starts = np.arange(0.5, end - 1.0, 0.25)

        def counts(times: Floats) -> Floats:
            return np.asarray(np.searchsorted(times, starts + 1.0) - np.searchsorted(times, starts))

        rates, good = counts(t), counts(there)
        for severity, least in (
            (Severity.BREAKING, self.least_rate),
            (Severity.LESSER, SLOWISH * self.rate),
        ):
            slow = np.flatnonzero((rates < least) & (good >= self.rate))
            if len(slow):
                text = f"publishes {rates[slow[0]]:.0f} states in a second"
                self.effects.append(
                    Effect(severity, f"{self.side}: {text}", float(starts[slow[0]]))
                )
        if got.states is not None and len(t) > 1:
            back = np.flatnonzero(np.diff(got.states.sent) < -1e-6)
            if len(back):
                self.effects.append(
                    Effect(
                        Severity.LESSER,
                        f"{self.side}: publishes an older state after a newer one",
                        float(t[back[0]]),
                    )
                )

    def _reports(self) -> None:
        got, states = self.got, self.got.states
        if states is None or not len(states):
            return
        t = np.asarray(states.t)
        tick = np.clip(np.searchsorted(got.t, t - 1e-6), 0, len(got.t) - 1)
        values = np.hstack((states.q, states.dq, states.tau))
        self.note(
            Severity.BREAKING,
            "reports what is not a finite number",
            np.asarray(~np.isfinite(values).all(axis=1)),
            t,
            0.0,
        )
        off = np.abs(states.q - got.q[tick]) / self.spans
        if self.dialect.position_servo:
            low, high = got.reach
            away = np.maximum(low[tick] - states.q, states.q - high[tick]) / self.spans
            grave, far, far_s = away, FAR, FAR_S
        else:
            grave, far, far_s = off, LIES, LIES_S
        self.note(Severity.BREAKING, "reports a q that is not true", grave > far, t, far_s)
        self.note(Severity.BREAKING, "reports a q that jumps", grave > JUMPS, t, JUMPS_S)
        self.note(Severity.LESSER, "reports a q that is not quite true", off > UNTRUE, t, UNTRUE_S)
        self._repeats(states, t, got.q[tick] / self.spans)
        if "dq" in self.measured:
            wrong = np.abs(states.dq - got.dq[tick]) / self.spans > SPEED
            self.note(Severity.LESSER, "reports a dq that is not true", wrong, t, SPEED_S)
        else:
            self._constant("dq", states.dq, t)
        if "tau_est" in self.measured:
            self._torque(states, t, got.tau[tick])
        else:
            self._constant("tau_est", states.tau, t)
        self._mode(states, t, tick)

    def _torque(self, states: States, t: Floats, true: Floats) -> None:
        if self.dialect.interface_specification:
            true = np.abs(true)
        # clients of a gripper close until they feel the object; of fingers they only show it
        severity = Severity.BREAKING if self.dialect.is_gripper else Severity.LESSER
        error = np.abs(states.tau - true)
        limit = np.maximum(GRIP * np.abs(true), GRIP * self.grip)
        self.note(severity, "reports a torque that is not true", error > limit, t, GRIP_S)
        self.note(
            Severity.LESSER,
            "reports a torque that is not quite true",
            error > 0.6 * limit,
            t,
            GRIP_S,
        )

    def _constant(self, member: str, values: Floats, t: Floats) -> None:
        """A member that the hand does not measure: nothing is true but what the reference has."""
        reference = self.ref.states
        if reference is None or not len(reference):
            return
        own = reference.dq if member == "dq" else reference.tau
        text = f"reports a {member} without a measurement"
        self.note(Severity.LESSER, text, np.asarray(values != own[0]), t, SPEED_S)

    def _repeats(self, states: States, t: Floats, true: Floats) -> None:
        """Measurements that are published again and again while the hand moves on."""
        for joint in range(true.shape[1]):
            new = np.flatnonzero(np.diff(states.q[:, joint]) != 0) + 1
            edges = np.concatenate(([0], new, [len(t)]))
            moved = np.abs(true[np.minimum(edges[1:], len(t)) - 1, joint] - true[edges[:-1], joint])
            grave = math.inf if self.dialect.position_servo else FROZEN  # it is away, see LIES
            for severity, least in ((Severity.BREAKING, grave), (Severity.LESSER, HELD)):
                late = np.flatnonzero(moved > least)
                if len(late):
                    text = f"{self.side}: repeats its q while it moves"
                    self.effects.append(Effect(severity, text, float(t[edges[late[0]]])))

    def _mode(self, states: States, t: Floats, tick: NDArray[np.intp]) -> None:
        reference = self.ref.states
        if reference is None or len(reference) != len(states):
            return
        same = self.got.driven[tick] == self.ref.driven[tick]
        differs = (states.mode != reference.mode).any(axis=1) & same
        self.note(Severity.LESSER, "reports another mode", differs, t, 0.3)


@cache
def _random(dialect_name: str, sides: tuple[Side, ...], seed: int) -> tuple[Segment, ...]:
    return random_segments(_plan(dialect_name, sides), seed)


def _plan(dialect_name: str, sides: tuple[Side, ...]) -> Plan[Side]:
    return plan_for(dialect_name, sides=sides)  # type: ignore[return-value]


@cache
def _reference(dialect_name: str, sides: tuple[Side, ...]) -> type[Faulty]:
    plan = _plan(dialect_name, sides)
    return compose(
        "Reference", "The reference.", under_test(plan.dialect.model).reference.load(), ()
    )


@cache
def _reference_run(
    dialect_name: str, sides: tuple[Side, ...], seed: int | None
) -> dict[Side, _Observed]:
    events, _ = _stimulus(dialect_name, sides, seed)
    return _observe(_reference(dialect_name, sides), _plan(dialect_name, sides), events)


@cache
def _stimulus(
    dialect_name: str, sides: tuple[Side, ...], seed: int | None
) -> tuple[tuple[Event, ...], tuple[Stretch, ...]]:
    if seed is None:
        return conformance(dialect_name, sides)
    return play_order(_random(dialect_name, sides, seed))


def _compare(
    dialect: Dialect, got: dict[Side, _Observed], ref: dict[Side, _Observed]
) -> list[Effect]:
    return [e for s in got for e in _Compare(dialect, s, got[s], ref[s]).run()]


def _placed(effect: Effect, stimulus: str, stretches: Sequence[Stretch]) -> Effect:
    index = max((i for i, x in enumerate(stretches) if x.begin <= effect.at), default=0)
    return Effect(effect.severity, effect.text, effect.at, stimulus, stretches[index].name, index)


_ORDER = (Severity.BREAKING, Severity.LESSER, Severity.EQUIVALENT)


def _gravest(effects: Sequence[Effect]) -> Severity:
    return min((e.severity for e in effects), key=_ORDER.index, default=Severity.EQUIVALENT)


def examine(
    service: type[Faulty], dialect: Dialect, sides: tuple[Side, ...], seed: int = 1
) -> Opinion:
    """Compare a service with its reference under both stimuli."""
    plan = _plan(dialect.name, sides)
    effects: list[Effect] = []
    in_kit = Severity.EQUIVALENT
    for name, each in (("conformance", None), ("random", seed)):
        events, stretches = _stimulus(dialect.name, sides, each)
        got = _observe(service, plan, events)
        found = _compare(dialect, got, _reference_run(dialect.name, sides, each))
        effects += [_placed(e, name, stretches) for e in found]
        if each is None:
            in_kit = _gravest(found)
            if in_kit is Severity.BREAKING:
                break  # nothing can be graver
    effects.sort(key=lambda e: (_ORDER.index(e.severity), e.stimulus != "conformance", e.at))
    return Opinion(_gravest(effects), tuple(effects), in_kit)


_LAST = (3, 7, 15)


def shortest(hand: Generated, opinion: Opinion, seed: int = 1) -> str:
    """The shortest stimulus that is known to show the gravest effect, in words.

    A phase of the conformance run where it shows there. Else one segment of the random stimulus,
    two, or the last four, eight or sixteen, if they show it by themselves; else the segment in
    which it shows.
    """
    if not opinion.effects:
        return ""
    worst = opinion.effects[0]
    if worst.stimulus == "conformance":
        return f"phase {worst.stretch} of the run, at {worst.at:.1f} s"
    plan = _plan(hand.dialect.name, hand.sides)
    segments = _random(hand.dialect.name, hand.sides, seed)
    last = segments[worst.index]
    earlier = list(segments[1 : worst.index])[::-1]
    by_name = {s.name: s for s in reversed(earlier)}
    options: list[tuple[Segment, ...]] = [(segments[0], last)]
    options += [(segments[0], s, last) for s in by_name.values()]
    options += [(segments[0], *segments[max(1, worst.index - n) : worst.index + 1]) for n in _LAST]
    service = hand.service()
    reference = _reference(hand.dialect.name, hand.sides)
    for chosen in options:
        events, _ = play_order(chosen)
        effects = _compare(
            hand.dialect,
            _observe(service, plan, events),
            _observe(reference, plan, events),
        )
        if any(e.severity is worst.severity for e in effects):
            return f"random: {', then '.join(s.name for s in chosen)}"
    return f"random: {last.name} at {worst.at:.1f} s, after all that comes before"
