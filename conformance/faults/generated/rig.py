"""Put faults into a model's reference service: the hooks at which a fault changes what it does.

A :class:`What` sees commands before the reference does, changes the motor's torque in the
mechanics, the values of a joint in the state, and the samples that are published. :func:`compose`
mixes this into the reference of any model whose service is a
:class:`~dexkit.conformance.virtual.gripper.ReferenceService` or a
:class:`~dexkit.conformance.virtual.fingers.FingerService`.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.virtual import Sample, Service
from dexkit.conformance.virtual.fingers import FingerHand, FingerService
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.errors import ModelBroken
from dexkit.hand import Side, Subject
from dexkit.models import Dialect, model

__all__ = ["Faulty", "Part", "Report", "Track", "What", "When", "compose"]

Motors = tuple[Motor, ...]

_MOVES = 0.02
"""Parts of a joint's range in a second above which it moves."""
_MOTION = 0.1
"""Parts of a joint's range by which its goal must change to count as another motion."""
SILENCE = 0.5
"""Seconds without a command that count as a silence: a hundred commands of a client."""


@dataclass
class Report:
    """The values of one joint in a state: rad, rad/s, rad/s², N·m."""

    q: float
    dq: float
    ddq: float
    tau: float
    mode: int


@dataclass
class Track:
    """History of one side since its service began: the data of every :class:`When`.

    :ivar motors: the newest command with finite values, as it was sent.
    :ivar raw: the newest command of the right length.
    """

    began: float = -1.0
    motors: Motors | None = None
    raw: Motors | None = None
    heard: float = -math.inf
    commands: int = 0
    arrivals: list[float] = field(default_factory=list)
    first_client: int | None = None
    client: int | None = None
    client_heard: dict[int, float] = field(default_factory=dict)
    motions: int = 0
    motion_at: float = -math.inf
    goal: tuple[float, ...] | None = None
    not_finite: int = 0
    malformed: int = 0
    far: int = 0
    negative: int = 0
    limp: int = 0
    foreign: int = 0
    size: int = 0
    silences: int = 0
    silence_ended: float = -math.inf
    brakes: int = 0
    was_driven: bool = False
    moving: bool = False
    rest_since: float = 0.0
    moved: float = 0.0


class What:
    """Base class of faults. One object acts on the joints of one side in one run.

    Subclasses override the hooks that they need.

    :param rig: the service that it is in.
    :param side: the side that it acts on.
    :param joints: the indices of the joints that it acts on.
    :cvar title: its name in a generated hand's name.
    :cvar summary: what it does wrong.
    :cvar kind: the class in which its score is counted.
    :cvar areas: the requirement areas, the second word of an id (``MOVE`` of ``DEX1-MOVE-02``),
        that are a right reason to fail it.
    :cvar good: whether a hand that does this is still a good one.
    :cvar several: whether it needs a hand of several joints.
    :cvar both: whether it needs both sides in the run.
    :cvar idle: why it has no effect under ``always``; empty where it has one.
    :cvar one_joint: whether it needs a hand of one joint.
    :cvar position_servo: whether it needs a hand of position servos.
    :cvar control_law: whether it needs a hand that obeys the gains of commands.
    :cvar needs: the member of a motor's state that the reference must measure; empty for none.
    :cvar has: the attribute that the reference must have; empty for none.
    :cvar not_of: models whose hands cannot have it.
    :cvar warned: ids of requirements that may warn of a good hand that does this.
    :cvar lacks: units that a hand with this does not have, and does not claim.
    :cvar claims: whether its maker claims the units that it has, or none; None without a file.
    :cvar served: the sides that are served; empty for those that any such hand has.
    :cvar turn: its place among the deviations of a good hand: below 0 before the others, above 0
        after them.
    """

    title = ""
    summary = ""
    kind = ""
    areas: frozenset[str] = frozenset()
    good = False
    several = False
    both = False
    idle = ""
    one_joint = False
    position_servo = False
    control_law = False
    needs = ""
    has = ""
    not_of: frozenset[str] = frozenset()
    warned: frozenset[str] = frozenset()
    lacks: frozenset[str] = frozenset()
    claims: bool | None = None
    served: tuple[Side, ...] = ()
    turn = 0

    def __init__(self, rig: Faulty, side: Side, joints: tuple[int, ...]) -> None:
        self.rig, self.side, self.joints = rig, side, joints
        self.random = random.Random(f"{self.title} {side}")
        self.since: float | None = None
        """When its condition became true, or None while it is not."""
        self.memory: dict[Any, Any] = {}
        """What it has to remember."""

    @property
    def whole(self) -> bool:
        """Whether it acts on every joint of its side."""
        return len(self.joints) == self.rig.codec.joints

    def span(self, joint: int) -> float:
        """The joint's range, rad."""
        return self.rig.spans[self.side][joint]

    def neighbour(self, joint: int) -> int:
        """The next joint."""
        return (joint + 1) % self.rig.codec.joints

    @property
    def active_s(self) -> float:
        """Seconds since its condition became true."""
        return 0.0 if self.since is None else self.rig.now - self.since

    def command(self, motors: Motors) -> Motors | None:
        """The command that is obeyed instead of this one; None if it is dropped."""
        return motors

    def torque(self, joint: int, tau: float, dt: float) -> float:
        """The motor's torque on a joint instead of ``tau``, N·m."""
        return tau

    def report(self, joint: int, values: Report) -> None:
        """Change the values of a joint in the state."""

    def publish(self, samples: list[Sample]) -> list[Sample]:
        """The samples of this side's state that are published instead of these."""
        return samples

    def tick(self, dt: float, active: bool) -> None:
        """Advance the time, whether its condition is true or not."""

    def replaced(self, motors: Motors, change: Callable[[int, Motor], Motor]) -> Motors:
        """The command with the motors of its joints changed."""
        mine = set(self.joints)
        return tuple(change(i, m) if i in mine else m for i, m in enumerate(motors))


@dataclass(frozen=True)
class When:
    """When a fault is there.

    :param title: its name in a generated hand's name.
    :param summary: in words, after the fault's.
    :param test: whether it is there now, from the service and the side.
    :param areas: requirement areas that are a right reason to fail a hand with this condition.
    :param both: whether it needs both sides in the run.
    """

    title: str
    summary: str
    test: Callable[[Faulty, Side], bool]
    areas: frozenset[str] = frozenset()
    both: bool = False


@dataclass(frozen=True)
class Part:
    """One fault: what, where and when.

    :param sides: the sides that it is on.
    :param joint: index of the only joint that it is on; None for all.
    :param whens: the conditions that must hold together.
    """

    what: type[What]
    sides: tuple[Side, ...]
    joint: int | None
    whens: tuple[When, ...]


def _overrides(what: What, hook: str) -> bool:
    return getattr(type(what), hook) is not getattr(What, hook)


class Faulty(Service):
    """The hooks, as a class to be mixed into a reference service.

    :cvar parts: the faults.
    """

    parts: tuple[Part, ...] = ()
    ended = False
    """Whether the service is at its end."""

    def __init__(
        self, dialect: Dialect, sides: Iterable[Side], touch: Mapping[Subject, float]
    ) -> None:
        super().__init__(dialect, sides, touch)
        count = self.codec.joints
        self.model = model(dialect.model)
        self.joints = {s: joints_of(dialect, s) for s in self.sides}
        self.spans = {s: tuple(j.stroke for j in self.joints[s]) for s in self.sides}
        self.tracks = {s: Track() for s in self.sides}
        self.client = 0
        self.whats: dict[Side, list[tuple[What, tuple[When, ...]]]] = {s: [] for s in self.sides}
        for part in self.parts:
            for side in part.sides:
                if side in self.whats:
                    joints = tuple(range(count)) if part.joint is None else (part.joint,)
                    self.whats[side].append((part.what(self, side, joints), part.whens))
        self._hooked = {
            hook: {s: [w for w, _ in ws if _overrides(w, hook)] for s, ws in self.whats.items()}
            for hook in ("command", "torque", "report", "publish", "tick")
        }
        low_rate = dialect.low_rate_topic
        self._low_rate = (
            {low_rate.format(side=s): self.codec.state_topics[s] for s in self.sides}
            if low_rate
            else {}
        )
        self._published: dict[str, Sample] = {}
        self._adopt()

    # -- what a fault can ask ------------------------------------------------------------------

    def driven(self, side: Side) -> bool:
        """Whether a command is in force on a side."""
        raise AssertionError  # overridden

    def touching(self, side: Side) -> bool:
        """Whether a side presses on an object or a stop."""
        raise AssertionError  # overridden

    def hand_of(self, side: Side) -> Any:
        """The mechanics of a side."""
        return self.hands[side]  # type: ignore[attr-defined]

    def velocities(self, side: Side) -> tuple[float, ...]:
        """The velocity of every joint, rad/s."""
        raise AssertionError  # overridden

    def seen(self, side: Side) -> tuple[Sequence[float], ...]:
        """True values at the fingers: q, dq, motor torques and contact torques of every joint, and
        1 if the side is driven.
        """
        raise AssertionError  # overridden

    def limits(self, side: Side, joint: int) -> tuple[float, float]:
        """The joint's limits in the dialect's q, rad."""
        spec = self.joints[side][joint]
        return spec.q_min, spec.q_max

    def gains(self, joint: int) -> tuple[float, float]:
        """The gains of the model's client for a joint: kp and kd."""
        return self.model.gains[joint]

    def strength(self, side: Side, joint: int) -> float:
        """N·m with which a client's gains pull at a twentieth of the joint's range."""
        return 0.05 * self.spans[side][joint] * self.gains(joint)[0]

    def goal(self, side: Side, joint: int) -> float:
        """The commanded q within the limits; the present one before any command."""
        motors = self.tracks[side].motors
        if motors is None:
            return self.positions(side)[joint]
        low, high = self.limits(side, joint)
        return min(max(motors[joint].q, low), high)

    def other(self, side: Side) -> Side | None:
        """The other side, if it is in the run."""
        there = [s for s in self.sides if s is not side]
        return there[0] if there else None

    # -- hooks ---------------------------------------------------------------------------------

    def _adopt(self) -> None:
        """Connect the mechanics with the hooks."""
        raise AssertionError  # overridden

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message; note whose it is and whether it has the usual length."""
        self.client = client
        for side in self.sides:
            if self.codec.command_topics[side] == topic:
                track = self.tracks[side]
                if track.size and len(payload) != track.size:
                    track.malformed += 1
                elif not track.size:
                    track.size = len(payload)
        super().receive(topic, payload, client)

    def foreign(self, topic: str, type_name: str, payload: bytes) -> None:
        """Note that another type is on the topic; the reference ignores it."""
        for side in self.sides:
            if self.codec.command_topics[side] == topic:
                self.tracks[side].foreign += 1
        super().foreign(topic, type_name, payload)

    def motors(self, side: Side, motors: Motors) -> None:
        """Take a command as the faults let it through."""
        self._note(side, motors)
        self.obey(side, motors)

    def obey(self, side: Side, motors: Motors) -> None:
        """Put a command through the side's faults, and in force."""
        self._refresh(side)
        given: Motors | None = motors
        for what in self._hooked["command"][side]:
            if given is not None and what.since is not None:
                given = what.command(given)
        if given is not None:
            super().motors(side, given)

    def brake(self) -> None:
        """Brake: the service ends."""
        self.ended = True
        super().brake()

    def live(self, dt: float) -> None:
        """Advance conditions and mechanics."""
        for side, track in self.tracks.items():
            if track.began < 0:
                track.began = self.now
            moves = self._moves(side)
            if moves:
                track.moved += dt
                track.rest_since = self.now
            track.moving = moves
            driven = self.driven(side)
            track.brakes += track.was_driven and not driven
            track.was_driven = driven
            self._refresh(side)
            for what in self._hooked["tick"][side]:
                what.tick(dt, what.since is not None)
            for what in self._hooked["torque"][side]:
                if what.since is not None:
                    self._awaken(side)
        super().live(dt)

    def publish(self) -> list[Sample]:
        """The states as the faults let them through."""
        samples = super().publish()
        for side in self.sides:
            topic = self.codec.state_topics[side]
            for what in self._hooked["publish"][side]:
                if what.since is not None:
                    mine = [x for x in samples if x.topic == topic]
                    rest = [x for x in samples if x.topic != topic]
                    samples = what.publish(mine) + rest
        return self._with_copies(samples) if self._low_rate else samples

    def _with_copies(self, samples: list[Sample]) -> list[Sample]:
        """The samples, those of a low-rate topic with the state that was last published."""
        found: list[Sample] = []
        for sample in samples:
            of = self._low_rate.get(sample.topic)
            if of is None:
                self._published[sample.topic] = sample
                found.append(sample)
            elif of in self._published:
                found.append(replace(self._published[of], topic=sample.topic, sent=sample.sent))
        return found

    def _moves(self, side: Side) -> bool:
        """Whether a joint of a side moves."""
        spans = self.spans[side]
        found = self.velocities(side)
        return any(abs(v) > _MOVES * span for v, span in zip(found, spans, strict=True))

    def _awaken(self, side: Side) -> None:
        """Compute the mechanics of a side even where it was at rest."""

    def _refresh(self, side: Side) -> None:
        """Ask the conditions of a side's faults."""
        for what, whens in self.whats[side]:
            if all(w.test(self, side) for w in whens):
                if what.since is None:
                    what.since = self.now
            else:
                what.since = None

    def _torque(self, side: Side, joint: int, tau: float, dt: float) -> float:
        for what in self._hooked["torque"][side]:
            if what.since is not None and joint in what.joints:
                tau = what.torque(joint, tau, dt)
        return tau

    def _reporters(self, side: Side) -> list[What]:
        """The faults in force that change what a side reports."""
        return [w for w in self._hooked["report"][side] if w.since is not None]

    def _note(self, side: Side, motors: Motors) -> None:
        track = self.tracks[side]
        now = self.now
        if track.commands and now - track.heard > SILENCE:
            track.silences += 1
            track.silence_ended = now
        track.commands += 1
        track.heard = now
        track.arrivals = [*track.arrivals[-31:], now]
        if track.first_client is None:
            track.first_client = self.client
        track.client = self.client
        track.client_heard[self.client] = now
        if motors is track.raw:
            return
        track.raw = motors
        if not all(math.isfinite(x) for m in motors for x in (m.q, m.dq, m.tau, m.kp, m.kd)):
            track.not_finite += 1
            return
        track.motors = motors
        spans = self.spans[side]
        for joint, m in enumerate(motors):
            low, high = self.limits(side, joint)
            track.far += not low - spans[joint] <= m.q <= high + spans[joint]
            track.negative += m.kp < 0
        track.limp += all(m.kp == 0 and m.kd == 0 for m in motors)
        goal = tuple(m.q for m in motors)
        if track.goal is None or any(
            abs(a - b) > _MOTION * span for a, b, span in zip(goal, track.goal, spans, strict=True)
        ):
            if track.goal is not None:
                track.motions += 1
                track.motion_at = now
            track.goal = goal


class _GripperHand(ReferenceHand):
    """A gripper's mechanics with the hooks."""

    alter: Callable[[float], float] | None = None
    shape: Callable[[dict[str, float]], dict[str, float]] | None = None

    def motor_torque(self) -> float:
        """The motor's torque with the faults, N m."""
        tau = super().motor_torque()
        return tau if self.alter is None else self.alter(tau)

    def fields(self) -> dict[str, float]:
        """The state's fields, as the faults report them."""
        found = super().fields()
        return found if self.shape is None else self.shape(found)


class _FaultyGripper(Faulty, ReferenceService):
    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if not issubclass(cls.hand, _GripperHand):
            cls.hand = type(cls.hand.__name__, (_GripperHand, cls.hand), {})

    def _adopt(self) -> None:
        for side, hand in self.hands.items():
            assert isinstance(hand, _GripperHand)
            if self._hooked["torque"][side]:
                hand.alter = partial(self._altered, side)
            if self._hooked["report"][side]:
                hand.shape = partial(self._shape, side)

    def _altered(self, side: Side, tau: float) -> float:
        return self._torque(side, 0, tau, self.tick)

    def _moves(self, side: Side) -> bool:
        return abs(self.hands[side].dq) > _MOVES * self.dialect.q_open

    def _shape(self, side: Side, found: dict[str, float]) -> dict[str, float]:
        reporters = self._reporters(side)
        if not reporters:
            return found
        values = Report(found["q"], found["dq"], found["ddq"], found["tau_est"], int(found["mode"]))
        for what in reporters:
            if 0 in what.joints:
                what.report(0, values)
        return {
            **found,
            "mode": values.mode,
            "q": values.q,
            "dq": values.dq,
            "ddq": values.ddq,
            "tau_est": values.tau,
        }

    def driven(self, side: Side) -> bool:
        return not self.hands[side].braking

    def seen(self, side: Side) -> tuple[Sequence[float], ...]:
        hand = self.hands[side]
        return (hand.q,), (hand.dq,), (hand.tau,), (hand.contact(),), (not hand.braking,)

    def touching(self, side: Side) -> bool:
        return self.hands[side].contact() != 0.0

    def velocities(self, side: Side) -> tuple[float, ...]:
        return (self.hands[side].dq,)

    def limits(self, side: Side, joint: int) -> tuple[float, float]:
        return 0.0, self.dialect.q_open


class _FingersHand(FingerHand):
    """The mechanics of several joints with the hooks."""

    alter: Callable[[float, list[float]], list[float]] | None = None

    def move(self, dt: float, pull: list[float]) -> None:
        super().move(dt, pull if self.alter is None else self.alter(dt, pull))


class _FaultyFingers(Faulty, FingerService):
    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        hand = getattr(cls, "hand", None)
        if hand is not None and not issubclass(hand, _FingersHand):
            cls.hand = type(hand.__name__, (_FingersHand, hand), {})

    def _adopt(self) -> None:
        for side, hand in self.hands.items():
            assert isinstance(hand, _FingersHand)
            if self._hooked["torque"][side]:
                hand.alter = partial(self._altered, side)

    def _altered(self, side: Side, dt: float, pull: list[float]) -> list[float]:
        return [self._torque(side, i, tau, dt) for i, tau in enumerate(pull)]

    def _moves(self, side: Side) -> bool:
        return not self.hands[side].rests and super()._moves(side)

    def driven(self, side: Side) -> bool:
        return bool(self.hands[side].driven.any())

    def seen(self, side: Side) -> tuple[Sequence[float], ...]:
        hand = self.hands[side]
        return hand.q, hand.dq, hand.tau, hand.contact, (self.driven(side),)

    def touching(self, side: Side) -> bool:
        return any(self.hands[side].contact)

    def velocities(self, side: Side) -> tuple[float, ...]:
        return tuple(self.hands[side].dq)

    def _awaken(self, side: Side) -> None:
        self.hands[side].rests = False

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        if any(self._hooked["report"][s] for s in sides):
            self._sent.clear()  # the faults can change a state of a hand at rest
        return super().payload(sides, length)

    def fill(self, motors: Any, hand: FingerHand) -> None:
        super().fill(motors, hand)
        reporters = self._reporters(hand.side)
        if not reporters:
            return
        reported, modes = motors["values"].tolist(), motors["mode"].tolist()
        for joint, (q, dq, ddq, tau) in enumerate(reported):
            values = Report(q, dq, ddq, tau, modes[joint])
            for what in reporters:
                if joint in what.joints:
                    what.report(joint, values)
            reported[joint] = values.q, values.dq, values.ddq, values.tau
            modes[joint] = values.mode & 0xFF
        motors["values"], motors["mode"] = reported, modes


def compose(
    name: str, summary: str, reference: type[Service], parts: Sequence[Part]
) -> type[Faulty]:
    """The reference service with these faults in it.

    :raises ModelBroken: the reference has neither the mechanics of a gripper nor those of fingers.
    """
    base: type[Faulty]
    if issubclass(reference, ReferenceService):
        base = _FaultyGripper
    elif issubclass(reference, FingerService):
        base = _FaultyFingers
    else:
        raise ModelBroken(
            f"{reference.__name__} is no ReferenceService and no FingerService",
            hint="faults are put into the mechanics of these; see docs/mutants.md",
        )
    made: type[Faulty] = type(name, (base, reference), {"__doc__": summary, "parts": tuple(parts)})
    return made
