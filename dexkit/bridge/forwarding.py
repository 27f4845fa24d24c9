"""Translate the messages of a bridge: forward, merge two topics into one, and drop what is unsafe.

No threads, no DDS: a :class:`Direction` gets each sample with its time, and returns what is to be
sent. The rules, in both directions:

* A message is sent only because one arrived. So a client that stops is silence for the gripper,
  whose watchdog acts, and a gripper that stops is silence for the client.
* NaN or infinity in a number that a peer acts upon drops that gripper's part (counted).
* Where two topics become one message, the newest parts of both sides go out together: at once
  when the other side's has come too, otherwise ``PATIENCE`` later; a side that kept the other
  waiting in vain is not waited for again until it comes.
* Nothing from before a pause of the bridge (:meth:`Direction.paused`) is sent after it.

That one message has a place for a side of which nothing new is known. :class:`Commands` and
:class:`States` define what is put there.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from dexkit.bridge.translate import PartCodec, Reachable, loses_gains, translator
from dexkit.errors import WireError
from dexkit.hand import JointMode, MotorError, Side
from dexkit.messages import unitree_go
from dexkit.models import Dialect, model

__all__ = ["PATIENCE", "SILENT", "Commands", "Counts", "Direction", "Outgoing", "States"]

PATIENCE = 0.001
"""Seconds that one side's part waits for the other's: half a period of the vendor's state, and
five times what lies between the two commands of a client that writes them back to back."""

SILENT = 0.1
"""Seconds without a state after which a side counts as silent, as DEX1-RATE-03 has it."""

_LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
_U32 = 0xFFFFFFFF


class Outgoing(NamedTuple):
    """A message to be sent."""

    topic: str
    payload: bytes


@dataclass
class Counts:
    """Counts of one direction.

    :ivar received: samples that arrived.
    :ivar undecodable: of those, samples that are not the message that they claim to be.
    :ivar short: samples with too few motors for a side that is bridged.
    :ivar overlong: samples with more motors than the dialect has; the surplus is ignored.
    :ivar stale: samples that were old, or may have been sent before a pause of the bridge ended.
    :ivar pauses: times that the bridge was paused for more than a quarter of a second.
    :ivar rejected: parts with NaN or infinity.
    :ivar blank: parts of a gripper that is not there: all 0, and never anything else before.
    :ivar sent: messages sent.
    :ivar filled: of those, messages with a part that did not come from a fresh one.
    :ivar held: messages not sent, since a position that they need is not known (yet).
    """

    received: int = 0
    undecodable: int = 0
    short: int = 0
    overlong: int = 0
    stale: int = 0
    pauses: int = 0
    rejected: int = 0
    blank: int = 0
    sent: int = 0
    filled: int = 0
    held: int = 0

    def snapshot(self) -> dict[str, int]:
        """The counts now."""
        return asdict(self)


class _Newest(NamedTuple):
    part: Any  # in the target's dialect
    came: float


class Direction(ABC):
    """One way of a bridge.

    :param source: the dialect of what arrives.
    :param target: the dialect of what is sent.
    :param kind: ``"cmd"`` or ``"state"``.
    :param sides: the grippers that are bridged.
    :ivar inputs: sides by topic that is read; ``outputs``: by topic that is written.
    :ivar read: type of what is read; ``written``: of what is written.
    """

    def __init__(self, source: Dialect, target: Dialect, kind: str, sides: Iterable[Side]) -> None:
        which = 0 if kind == "cmd" else 1
        self.sides = tuple(sides)
        self.counts = Counts()
        self.parts = dict.fromkeys(self.sides, 0)  #: parts forwarded, by side
        self.inputs = _by_topic(source, which, self.sides)
        self.outputs = _by_topic(target, which, self.sides)
        self._in, self._out = PartCodec(source, kind), PartCodec(target, kind)
        self._translate = translator(source, target, kind)
        self.read, self.written = self._in.type.name, self._out.type.name
        # both sides share what is written, whether or not both are bridged
        self._shared = target.length > 1
        self._newest: dict[Side, _Newest] = {}
        # sides with a part that has not gone out, and since when the first of them waits; sides
        # that had none when something went out, and are not waited for until they come again
        self._pending: set[Side] = set()
        self._absent: set[Side] = set()
        self._waits_since: float | None = None

    def receive(self, topic: str, payload: bytes, now: float) -> list[Outgoing]:
        """Take a sample; return the messages to be sent for it.

        :param now: seconds on the clock that :attr:`due` is on, too.
        """
        self.counts.received += 1
        try:
            message = self._in.type.decode(payload)
        except WireError:
            self.counts.undecodable += 1
            return []
        self.counts.overlong += self._in.count(message) > self._in.length
        fresh = [side for side in self._sides_in(topic) if self._accept(message, side, now)]
        return self._forward([side for side in fresh if side in self.sides], now)

    @property
    def due(self) -> float | None:
        """When :meth:`flush` must be called at the latest; None while nothing waits."""
        return None if self._waits_since is None else self._waits_since + PATIENCE

    def flush(self, now: float) -> list[Outgoing]:
        """Return the messages whose wait for the other side is over."""
        due = self.due
        return self._send_shared(now) if due is not None and now >= due else []

    def paused(self) -> None:
        """A pause of the bridge has ended: drop all that came before."""
        self.counts.pauses += 1
        self._pending.clear()
        self._waits_since = None
        self._newest = {s: newest._replace(came=-math.inf) for s, newest in self._newest.items()}

    # -- what differs -----------------------------------------------------------------------

    def _sides_in(self, topic: str) -> Sequence[Side]:
        """The sides whose parts are read from a topic."""
        return self.inputs[topic]

    def _is_blank(self, part: Any, side: Side) -> bool:
        """Whether a part is that of a gripper that is not there."""
        return False

    def _translate_part(self, part: Any, side: Side, now: float) -> Any | None:
        """A part in the target's dialect; None where that dialect cannot express it."""
        return self._translate(part)

    @abstractmethod
    def _is_live(self, side: Side, now: float) -> bool:
        """Whether a side's newest part still holds."""

    @abstractmethod
    def _fill_in(self, side: Side, now: float) -> Any | None:
        """The part for a side that is not live; None holds the message back."""

    # -- the rest ---------------------------------------------------------------------------

    def _accept(self, message: Any, side: Side, now: float) -> bool:
        part = self._in.take(message, side)
        if part is None:
            self.counts.short += side in self.sides
            return False
        if not self._in.is_finite(part):
            self.counts.rejected += side in self.sides
            return False
        if side not in self._newest and self._is_blank(part, side):
            self.counts.blank += side in self.sides
            return False
        translated = self._translate_part(part, side, now)
        if translated is None:
            self.counts.held += 1
            return False
        self._newest[side] = _Newest(translated, now)
        return True

    def _forward(self, fresh: Sequence[Side], now: float) -> list[Outgoing]:
        for side in fresh:
            self.parts[side] += 1
        if not self._shared:
            topics = {s: t for t, sides in self.outputs.items() for s in sides}
            return [self._encode(topics[s], {s: self._newest[s].part}) for s in fresh]
        if not fresh:
            return []
        if self._waits_since is None:
            self._waits_since = now
        self._pending.update(fresh)
        self._absent.difference_update(fresh)
        if not self._pending | self._absent >= set(self.sides):
            return self.flush(now)
        return self._send_shared(now)

    def _send_shared(self, now: float) -> list[Outgoing]:
        self._waits_since = None
        self._absent = set(self.sides) - self._pending
        places, filled = {}, False
        for side in Side:
            if self._is_live(side, now):
                places[side] = self._newest[side].part
                continue
            part = self._fill_in(side, now)
            if part is None:
                self.counts.held += 1
                return []
            places[side], filled = part, True
        self._pending.clear()
        self.counts.filled += filled
        (topic,) = self.outputs
        return [self._encode(topic, places)]

    def _encode(self, topic: str, parts: dict[Side, Any]) -> Outgoing:
        self.counts.sent += 1
        return Outgoing(topic, self._out.type.encode(self._out.put(parts)))


class States(Direction):
    """From the grippers to the client: ``source`` is the grippers' dialect.

    In a message for both sides (``unitree_actuator``), the place of a side that is

    * not bridged stays all 0, as a service of one gripper leaves it;
    * bridged, but no state received yet: no message is sent at all. The client of that generation
      starts at any q that is not 0, takes the 0 of a gripper that is not there yet for its
      position, and commands it there;
    * silent for longer than ``SILENT``: its last state, marked as ``dexkit serve`` marks it:
      bit 31 of ``reserve[0]``, and ``lost`` counts the messages that have gone out without it.

    From such a message, a part in which every field is 0 and that has never been anything else is
    that of a gripper that is not there, and is not forwarded.
    """

    def __init__(self, source: Dialect, target: Dialect, sides: Iterable[Side]) -> None:
        super().__init__(source, target, "state", sides)
        self._together = source.length > 1
        self._blank = self._in.blank() if self._together else None
        self._repeated = dict.fromkeys(Side, 0)  # messages since a side's newest part
        self._positions: dict[Side, float] = {}  # in the source's dialect

    def missing(self) -> list[Side]:
        """The bridged sides of which no state has come."""
        return [side for side in self.sides if side not in self._newest]

    def silent(self, now: float) -> list[Side]:
        """The bridged sides whose states came once and have stopped."""
        return [s for s in self.sides if s in self._newest and not self._is_live(s, now)]

    def position(self, side: Side) -> float | None:
        """The last known position of a gripper, rad of its own dialect, bridged or not."""
        return self._positions.get(side)

    def forget_positions(self) -> None:
        """Forget the positions of the grippers until their next state."""
        self._positions.clear()

    def paused(self) -> None:
        """As of any direction; also forget the positions of the grippers."""
        super().paused()
        self.forget_positions()

    def _sides_in(self, topic: str) -> Sequence[Side]:
        return tuple(Side) if self._together else super()._sides_in(topic)

    def _accept(self, message: Any, side: Side, now: float) -> bool:
        part = self._in.take(message, side)
        if part is not None and self._in.is_finite(part):
            self._positions[side] = self._in.motor(part).q
            self._repeated[side] = 0
        return super()._accept(message, side, now)

    def _is_blank(self, part: Any, side: Side) -> bool:
        return self._together and part == self._blank

    def _is_live(self, side: Side, now: float) -> bool:
        newest = self._newest.get(side)
        return side in self.sides and newest is not None and now - newest.came <= SILENT

    def _fill_in(self, side: Side, now: float) -> Any | None:
        if side not in self.sides:
            return self._out.blank()
        if side not in self._newest:
            return None
        last: unitree_go.MotorState_ = self._newest[side].part
        self._repeated[side] += 1
        lost = min(last.lost + self._repeated[side], _U32)
        return replace(last, lost=lost, reserve=(last.reserve[0] | _LINK, last.reserve[1]))


class Commands(Direction):
    """From the client to the grippers: ``target`` is the grippers' dialect.

    In a message for both sides (``unitree_actuator``), a side that is not commanded cannot be
    left out. Its newest command is repeated with the other side's for as long as a gripper's
    watchdog would have let it hold; then, and for a side that was never commanded or is not
    bridged, its place is filled with *stay, without torque*: q where the gripper was seen last when
    that began, no gain on the position, xr_teleoperate's damping, mode 0. A gripper that obeys the
    gains goes limp but for the damping, a simulated one that looks at q only stays where it is.
    Where no position is known, nothing is sent.

    To a dialect without gains (``unitree_hg``), a command that does not pull towards its q goes
    out with the q where the gripper is, and one that is out of reach with one that is not
    (:mod:`~dexkit.bridge.translate`).

    :param states: the other direction, which knows where the grippers are.
    """

    def __init__(
        self, source: Dialect, target: Dialect, sides: Iterable[Side], states: States
    ) -> None:
        super().__init__(source, target, "cmd", sides)
        self._states = states
        hand = model(target.model)
        self._timeout = hand.command_timeout
        self._damping = hand.gains[0][1]
        self._resting: dict[Side, unitree_go.MotorCmd_] = {}
        # what a position of the grippers is multiplied by to be one of the client's
        self._scale = source.q_open / target.q_open
        self._loses_gains = loses_gains(source, target)
        self._reachable = {side: Reachable() for side in self.sides}

    def paused(self) -> None:
        """As of any direction; also forget the positions at which grippers would be held."""
        super().paused()
        self._resting.clear()
        self._states.forget_positions()  # the other direction may not have noticed yet

    def _translate_part(self, part: Any, side: Side, now: float) -> Any | None:
        if not self._loses_gains:
            return super()._translate_part(part, side, now)
        position = self._states.position(side)
        if part.kp <= 0:
            if position is None:
                return None
            part = replace(part, q=position * self._scale)
        message = super()._translate_part(part, side, now)
        motor = self._out.motor(message)
        motor.q = self._reachable[side](motor.q, position, now)
        return message

    def _accept(self, message: Any, side: Side, now: float) -> bool:
        accepted = super()._accept(message, side, now)
        if accepted:
            self._resting.pop(side, None)
        return accepted

    def _is_live(self, side: Side, now: float) -> bool:
        newest = self._newest.get(side)
        return newest is not None and now - newest.came < self._timeout

    def _fill_in(self, side: Side, now: float) -> Any | None:
        if side not in self._resting:
            q = self._states.position(side)
            if q is None:
                return None
            self._resting[side] = unitree_go.MotorCmd_(mode=JointMode.BRAKE, q=q, kd=self._damping)
        return self._resting[side]


def _by_topic(spoken: Dialect, which: int, sides: Sequence[Side]) -> dict[str, tuple[Side, ...]]:
    found: dict[str, tuple[Side, ...]] = {}
    for side in sides:
        topic = spoken.topics(side)[which]
        found[topic] = (*found.get(topic, ()), side)
    return found
