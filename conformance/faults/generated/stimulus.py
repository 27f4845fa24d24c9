"""Commands to play open loop: those of a conformance run of the reference, and random ones."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

from dexkit.conformance.faults.trials import plan_for
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.conformance.stimuli import Plan
from dexkit.conformance.virtual import Service, run_virtual
from dexkit.conformance.virtual.topic_run import ORIGIN_NS
from dexkit.hand import Side
from dexkit.models import Dialect, model

__all__ = ["Event", "Segment", "Stretch", "conformance", "play_order", "random_segments"]


@dataclass(frozen=True)
class Event:
    """Something that happens to a service.

    :param at: seconds from the beginning.
    :param do: ``send``, ``foreign``, ``restart`` (of the service) or ``nothing``.
    :param client: which client sends.
    :param age_s: how old its source timestamp is.
    """

    at: float
    do: str
    topic: str = ""
    payload: bytes = b""
    client: int = 0
    age_s: float = 0.0


@dataclass(frozen=True)
class Stretch:
    """A named stretch of a stimulus, in seconds."""

    name: str
    begin: float
    end: float


@dataclass(frozen=True)
class Segment:
    """One piece of the random stimulus; its events count from its own beginning."""

    name: str
    seconds: float
    events: tuple[Event, ...]


def play_order(segments: Sequence[Segment]) -> tuple[tuple[Event, ...], tuple[Stretch, ...]]:
    """The segments one after the other."""
    events: list[Event] = []
    stretches = []
    begin = 0.0
    for segment in segments:
        events += [replace(e, at=begin + e.at) for e in segment.events]
        stretches.append(Stretch(segment.name, begin, begin + segment.seconds))
        begin += segment.seconds
    return (*events, Event(begin, "nothing")), tuple(stretches)


@cache
def conformance(
    dialect_name: str, sides: tuple[Side, ...]
) -> tuple[tuple[Event, ...], tuple[Stretch, ...]]:
    """The kit's commands to the reference in a run of every phase, and the phases."""
    plan = plan_for(dialect_name, sides=sides)
    events: list[Event] = []
    reference = under_test(plan.dialect.model).reference.load()

    def receive(self: Service, topic: str, payload: bytes, client: int) -> None:
        age = self.now - self.stamp
        events.append(Event(self.now, "send", topic, payload, client, age))
        reference.receive(self, topic, payload, client)

    def foreign(self: Service, topic: str, type_name: str, payload: bytes) -> None:
        events.append(Event(self.now, "foreign", topic, payload))
        reference.foreign(self, topic, type_name, payload)

    def begin(self: Service, now: float) -> None:
        events.append(Event(now, "restart"))
        reference.begin(self, now)

    recorder = type(
        "Recorded", (reference,), {"receive": receive, "foreign": foreign, "begin": begin}
    )
    trace = run_virtual(plan, recorder)
    stimulus = Stimulus.from_metadata(trace.metadata[RECORD])
    phases = tuple(
        Stretch(p.name, (p.begin_ns - ORIGIN_NS) / 1e9, (p.end_ns - ORIGIN_NS) / 1e9)
        for p in stimulus.phases
    )
    return (*events, Event(phases[-1].end, "nothing")), phases


class _Client:
    """Writes the events of random segments: what any client might do to a hand."""

    def __init__(self, spoken: Dialect, sides: tuple[Side, ...], objects: Mapping[Side, float]):
        self.dialect, self.sides, self.objects = spoken, sides, objects
        self.codec = MotorCodec(spoken)
        self.model = model(spoken.model)
        self.joints = {s: joints_of(spoken, s) for s in sides}
        self.goal = {s: tuple(self._inside(s, 0.4)) for s in sides}
        self.client = 0
        self.at = 0.0
        self.events: list[Event] = []
        self.period = 1.0 / self.model.command_rate
        self.random = random.Random(0)

    def _inside(self, side: Side, part: float) -> list[float]:
        spans = [
            (0.0, self.dialect.q_open) if self.dialect.is_gripper else (j.q_min, j.q_max)
            for j in self.joints[side]
        ]
        return [low + part * (high - low) for low, high in spans]

    def anywhere(self, side: Side) -> tuple[float, ...]:
        """A random pose."""
        low, high = self._inside(side, 0.0), self._inside(side, 1.0)
        if self.dialect.is_gripper:
            return tuple(
                a + self.random.uniform(0.03, 0.97) * (b - a)
                for a, b in zip(low, high, strict=True)
            )
        bend = self.random.uniform(0.1, 0.6)
        return tuple(
            (b if j.closing >= 0 else a) * bend * self.random.uniform(0.7, 1.3)
            for a, b, j in zip(low, high, self.joints[side], strict=True)
        )

    def motors(
        self, side: Side, pose: Sequence[float] | None = None, **change: float
    ) -> list[Motor]:
        """The command to hold a pose with the usual gains."""
        return [
            replace(Motor(q, kp=kp, kd=kd, mode=self.codec.mode(i)), **change)  # type: ignore[arg-type]
            for i, (q, (kp, kd)) in enumerate(
                zip(pose or self.goal[side], self.model.gains, strict=True)
            )
        ]

    def send(self, hands: Mapping[Side, Sequence[Motor]], client: int | None = None) -> None:
        """Send commands now."""
        who = self.client if client is None else client
        for topic, payload in self.codec.encode(hands):
            self.events.append(Event(self.at, "send", topic, payload, who))

    def keep(
        self,
        seconds: float,
        hands: Callable[[float], Mapping[Side, Sequence[Motor]]] | None = None,
        rate: float = 0.0,
    ) -> None:
        """Send commands at the client's rate; ``hands`` are those that differ, by the time."""
        period = 1.0 / rate if rate else self.period
        for i in range(round(seconds / period)):
            every = {s: self.motors(s) for s in self.sides}
            self.send({**every, **(hands(i * period) if hands else {})})
            self.at += period


def _bad(c: _Client, seconds: float, make: Callable[[Side], Sequence[Motor]]) -> None:
    c.keep(seconds, lambda _: {s: make(s) for s in c.sides})
    c.keep(0.25)


def _go(c: _Client, sides: Sequence[Side], seconds: float) -> None:
    for s in sides:
        c.goal[s] = c.anywhere(s)
    c.keep(seconds)


def _step(c: _Client) -> None:
    _go(c, c.sides, 0.9)


def _step_of_one(c: _Client) -> None:
    _go(c, [c.random.choice(c.sides)], 0.9)


def _joint(c: _Client) -> None:
    for s in c.sides:
        there = c.anywhere(s)
        i = c.random.choice([0, len(there) - 1, c.random.randrange(len(there))])
        c.goal[s] = tuple(there[k] if k == i else q for k, q in enumerate(c.goal[s]))
    c.keep(0.7)


def _end(c: _Client) -> None:
    part = c.random.choice((0.0, 1.0))
    for s in c.sides:
        if c.dialect.is_gripper and (part or s not in c.objects):
            c.goal[s] = tuple(c._inside(s, part))
    c.keep(1.0)


def _towards(c: _Client, seconds: float) -> Callable[[float], dict[Side, Sequence[Motor]]]:
    """Commands for a straight way to a random pose, by the time since it began."""
    start, there = dict(c.goal), {s: c.anywhere(s) for s in c.sides}

    def pose(at: float) -> dict[Side, Sequence[Motor]]:
        part = min(at / seconds, 1.0)
        for s in c.sides:
            c.goal[s] = tuple(a + part * (b - a) for a, b in zip(start[s], there[s], strict=True))
        return {s: c.motors(s) for s in c.sides}

    return pose


def _ramp(c: _Client) -> None:
    c.keep(1.3, _towards(c, 1.0))


def _hold(c: _Client) -> None:
    c.keep(1.2)


def _press(c: _Client, seconds: float = 1.2) -> None:
    kept = dict(c.goal)
    for s in c.sides:
        touch = c.objects.get(s)
        if touch is None:
            continue
        if c.dialect.is_gripper:
            c.goal[s] = (touch - 0.05 * c.dialect.q_open,)
        else:
            c.goal[s] = tuple(
                (touch + 20) / 100 * (j.q_max if j.closing > 0 else j.q_min) if j.closing else q
                for j, q in zip(c.joints[s], c.goal[s], strict=True)
            )
    c.keep(seconds)
    c.goal.update(kept)
    c.keep(0.4)


def _long_press(c: _Client) -> None:
    _press(c, 3.5)


def _limp(c: _Client) -> None:
    far = {s: c.anywhere(s) for s in c.sides}
    _bad(c, 0.5, lambda s: c.motors(s, far[s], kp=0.0, kd=0.0))


def _soft(c: _Client) -> None:
    for s in c.sides:
        c.goal[s] = c.anywhere(s)
    part = c.random.choice((0.2, 0.5, 2.0))
    _bad(c, 0.8, lambda s: [replace(m, kp=part * m.kp) for m in c.motors(s)])


def _drive(c: _Client) -> None:
    def driven(side: Side) -> list[Motor]:
        return [
            replace(m, dq=0.15 * j.stroke * (j.closing or 1) * -1, kp=0.0, kd=max(m.kd, 0.3))
            for m, j in zip(c.motors(side), c.joints[side], strict=True)
        ]

    c.keep(0.4, lambda _: {s: driven(s) for s in c.sides})
    c.at += 1.0 + c.model.command_timeout
    c.keep(0.6)


def _torque(c: _Client) -> None:
    def pushed(side: Side) -> list[Motor]:
        return [
            replace(m, tau=0.04 * j.stroke * m.kp)
            for m, j in zip(c.motors(side), c.joints[side], strict=True)
        ]

    _bad(c, 0.4, pushed)


def _nan(c: _Client) -> None:
    far = {s: c.anywhere(s) for s in c.sides}
    name = c.random.choice(("q", "dq", "tau", "kp", "kd"))
    joint = c.random.choice((0, -1))
    value = c.random.choice((float("nan"), float("inf"), float("-inf")))

    def broken(side: Side) -> list[Motor]:
        motors = c.motors(side, far[side])
        motors[joint] = replace(motors[joint], **{name: value})  # type: ignore[arg-type]
        return motors

    _bad(c, 0.4, broken)


def _nan_for_long(c: _Client) -> None:
    def broken(side: Side) -> list[Motor]:
        return [replace(m, q=float("nan")) for m in c.motors(side)]

    _bad(c, c.model.command_timeout + 0.7, broken)


def _length(c: _Client) -> None:
    # lists of integers have bounds, and one that is longer cannot be sent
    more = c.random.choice((-1, 1, 3)) if c.codec.holds_nan else -1

    def wrong(side: Side) -> list[Motor]:
        motors = c.motors(side, c.anywhere(side))
        return motors[:more] if more < 0 else motors + motors[:1] * more

    if c.codec.shared:
        for _ in range(40):
            if more < 0:
                sent = c.codec.encode_empty(c.sides)
            else:
                sent = c.codec.encode_longer(
                    {s: c.motors(s) for s in c.sides}, [Motor(q=1.0)] * more
                )
            c.events += [Event(c.at, "send", t, p, c.client) for t, p in sent]
            c.at += c.period
        c.keep(0.3)
    else:
        _bad(c, 0.3, wrong)


def _far(c: _Client) -> None:
    value = c.random.choice((1000.0, -1000.0, 50.0, -50.0))
    _bad(c, 0.5, lambda s: c.motors(s, [value] * len(c.joints[s])))


def _negative(c: _Client) -> None:
    for s in c.sides:
        c.goal[s] = c.anywhere(s)
    _bad(c, 0.3, lambda s: [replace(m, kp=-m.kp, kd=-m.kd) for m in c.motors(s)])


def _foreign(c: _Client) -> None:
    far = c.codec.encode_foreign({s: c.motors(s, c.anywhere(s)) for s in c.sides})
    for _ in range(40):
        c.events += [Event(c.at, "foreign", topic, payload) for topic, payload in far]
        c.keep(c.period)


def _silence(c: _Client) -> None:
    c.at += c.model.command_timeout + c.random.uniform(0.3, 1.2)
    _go(c, c.sides, 0.8)


def _short_silence(c: _Client) -> None:
    for s in c.sides:
        c.goal[s] = c.anywhere(s)
    c.keep(0.06)
    c.at += 0.6 * c.model.command_timeout
    c.keep(0.5)


def _press_and_silence(c: _Client) -> None:
    kept = dict(c.goal)
    events = len(c.events)
    _press(c, 0.8)
    # drop what came after the pressing
    end = c.events[events].at + 0.8
    c.events = [e for e in c.events if e.at < end - 1e-9]
    c.at = end + c.model.command_timeout + 1.2
    c.goal.update(kept)
    c.keep(0.8)


def _silence_of_one(c: _Client) -> None:
    quiet = c.random.choice(c.sides)
    others = [s for s in c.sides if s is not quiet]
    for s in c.sides:
        c.goal[s] = c.anywhere(s)
    if not others or c.codec.shared:
        _silence(c)
        return
    for _ in range(round((c.model.command_timeout + 0.8) / c.period)):
        c.send({s: c.motors(s) for s in others})
        c.at += c.period
    c.keep(0.6)


def _next_client(c: _Client) -> None:
    c.client += 1
    c.at += 0.3
    _go(c, c.sides, 0.8)


def _two_clients(c: _Client) -> None:
    there = {s: c.anywhere(s) for s in c.sides}
    for _ in range(round(0.5 / c.period)):
        c.send({s: c.motors(s) for s in c.sides})
        c.at += 0.5 * c.period
        c.send({s: c.motors(s, there[s]) for s in c.sides}, client=c.client + 500)
        c.at += 0.5 * c.period
    c.keep(0.5)


def _flood(c: _Client) -> None:
    there = {s: c.anywhere(s) for s in c.sides}
    for _ in range(100):
        c.send({s: c.motors(s, there[s]) for s in c.sides})
    c.keep(0.5)


def _load(c: _Client) -> None:
    c.keep(0.8, _towards(c, 0.6), rate=600.0)


def _restart(c: _Client) -> None:
    c.at += 0.2
    c.events.append(Event(c.at, "restart"))
    c.at += 0.5
    c.client += 1
    _go(c, c.sides, 0.9)


def _before(c: _Client) -> None:
    c.at += 0.6
    c.keep(0.9)


_SEGMENTS: Mapping[str, tuple[Callable[[_Client], None], int]] = {
    "step": (_step, 3),
    "step of one hand": (_step_of_one, 3),
    "step of one joint": (_joint, 2),
    "step to an end": (_end, 3),
    "ramp": (_ramp, 2),
    "hold": (_hold, 2),
    "press on the object": (_press, 2),
    "press for long": (_long_press, 1),
    "zero gains": (_limp, 2),
    "other gains": (_soft, 2),
    "velocity, then silence": (_drive, 2),
    "torque": (_torque, 1),
    "not finite": (_nan, 3),
    "not finite for long": (_nan_for_long, 1),
    "another length": (_length, 3),
    "far out of range": (_far, 2),
    "negative gains": (_negative, 1),
    "another type": (_foreign, 1),
    "silence": (_silence, 2),
    "silence in a motion": (_short_silence, 1),
    "press, then silence": (_press_and_silence, 1),
    "silence to one hand": (_silence_of_one, 2),
    "next client": (_next_client, 2),
    "two clients": (_two_clients, 1),
    "many at once": (_flood, 1),
    "load": (_load, 1),
}
"""Actions of a client, and their frequency in the random stimulus."""


def random_segments(plan: Plan[Side], seed: int) -> tuple[Segment, ...]:
    """A long random stimulus: every kind of segment, most of them more than once, and a restart of
    the service before the last steps.
    """
    draw = random.Random(seed)
    names = [name for name, (_, times) in _SEGMENTS.items() for _ in range(times)]
    draw.shuffle(names)
    client = _Client(
        plan.dialect, plan.sides, {s: v for s, v in plan.objects.items() if isinstance(s, Side)}
    )
    found: list[Segment] = []

    def add(name: str, do: Callable[[_Client], None]) -> None:
        client.random = random.Random(draw.random())
        client.at, client.events = 0.0, []
        do(client)
        found.append(Segment(name, client.at, tuple(client.events)))

    add("start", _before)
    for name in names:
        add(name, _SEGMENTS[name][0])
    add("restart of the service", _restart)
    for name in ("step", "step of one hand", "ramp"):
        add(name, _SEGMENTS[name][0])
    return tuple(found)
