"""The facts of a hand model: joints, dialects, rates, units, touch.

What else is needed of it refers to these: how it is judged (:mod:`dexkit.conformance.hands`),
teleoperated (:mod:`dexkit.teleop.hands`), drawn (:mod:`dexkit.view.skeletons`) and simulated
(``dexkit.emulators``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from dexkit.errors import UsageError
from dexkit.hand import HandSpec, JointMode, JointSpec, Side, Subject
from dexkit.lazy import Lazy

__all__ = [
    "ClientCommand",
    "Dialect",
    "HandModel",
    "ModeByte",
    "PressureSensor",
    "TouchArea",
]


class ModeByte(Enum):
    """Contents of the mode byte of a motor's command and state."""

    UNUSED = "nothing"
    STATUS = "1 driven, 0 not"
    RIS = "RIS_Mode: id in bits 0 to 3, status in 4 to 6, time-out in 7"


@dataclass(frozen=True)
class TouchArea:
    """One tactile area of a hand with a touch topic.

    :param place: where it is; the finger's name comes first.
    :param member: of the touch message: the list of its elements, row after row.
    :param rows: of elements.
    :param columns: elements of a row.
    """

    place: str
    member: str
    rows: int
    columns: int

    @property
    def elements(self) -> int:
        """Number of elements."""
        return self.rows * self.columns


@dataclass(frozen=True)
class Dialect:
    """A hand model on DDS: topics, types, motors and scale of q.

    :param model: name of the hand model.
    :param cmd_topic: command topic; ``{side}`` is replaced by ``left`` or ``right``, ``{s}`` by
        ``l`` or ``r``.
    :param cmd_type: DDS type name of the command.
    :param index: position of a subject's first motor in the sequence (0 unless both sides share
        a topic).
    :param length: motors in the sequence.
    :param q_open: q of a fully open gripper, rad, where 0 is closed; NaN for hands whose joints
        have no such scale.
    :param ends: a gripper's targets from which on it closes or opens all the way: at or below the
        first, at or above the second, rad; infinite where a target is where it goes.
    :param codec: the :class:`~dexkit.service.dialects.DialectMap` that translates its messages in
        ``dexkit serve``; None for a robot, which has none.
    :param mode_byte: what the mode byte of a motor holds.
    :param interface_specification: it is defined by the gripper's DDS interface specification:
        gains, dq and tau of a command are not used, targets near an end go to the end, and a
        state has no sign of force and no mode.
    :param has_client: a client of Unitree's uses it.
    :param zero_is_no_state: clients take a state of which every q is exactly 0 for no state
        (docs/sources/unitree-dex.md#b1).
    :param low_rate_topic: topic of the low-rate copy of the state, or empty; with ``{side}``.
    :param low_rate: Hz of that copy.
    :param touch_topic: topic of what the hand's tactile areas measure, or empty; with ``{side}`` or
        ``{s}``.
    :param touch_type: its DDS type name.
    :param touch_rate: Hz at which dexkit publishes it.
    :param areas: tactile areas, in the order of its message.
    :param torque_units: N·m in one unit of a motor's tau and tau_est; empty where all are in N·m.
    :param position_servo: each motor goes to q by itself: kp, kd, tau and mode of a command are not
        used, and dq is no feed-forward.
    :param speed_units: of position servos, the speed of each joint (the model's unit a second) that
        is 1 in a motor's dq: in a command the most that it may move with, in a state how fast it
        moves. Empty where dq is not used, or holds the speed itself.
    """

    name: str
    model: str
    cmd_topic: str
    state_topic: str
    cmd_type: str
    state_type: str
    index: Mapping[Subject, int]
    length: int
    q_open: float
    summary: str
    ends: tuple[float, float] = (-math.inf, math.inf)
    codec: Lazy[type[Any]] | None = None
    mode_byte: ModeByte = ModeByte.UNUSED
    interface_specification: bool = False
    has_client: bool = True
    zero_is_no_state: bool = False
    low_rate_topic: str = ""
    low_rate: float = 0.0
    touch_topic: str = ""
    touch_type: str = ""
    touch_rate: float = 0.0
    areas: tuple[TouchArea, ...] = ()
    torque_units: tuple[float, ...] = ()
    position_servo: bool = False
    speed_units: tuple[float, ...] = ()

    def topics(self, side: Subject) -> tuple[str, str]:
        """(command topic, state topic) of a side or a robot."""
        return self._topic(self.cmd_topic, side), self._topic(self.state_topic, side)

    def touch_topic_of(self, side: Subject) -> str:
        """The topic of a side's tactile areas; empty where the dialect has none."""
        return self._topic(self.touch_topic, side)

    @staticmethod
    def _topic(topic: str, side: Subject) -> str:
        return topic.format(side=side, s=str(side)[0])

    def under(self, prefix: str) -> Dialect:
        """The same on topics under a prefix: ``rt/r2/dex3/left/cmd`` for ``r2``."""

        def moved(topic: str) -> str:
            return topic and f"rt/{prefix}/{topic.removeprefix('rt/')}"

        return replace(
            self,
            cmd_topic=moved(self.cmd_topic),
            state_topic=moved(self.state_topic),
            low_rate_topic=moved(self.low_rate_topic),
            touch_topic=moved(self.touch_topic),
        )

    @property
    def is_gripper(self) -> bool:
        """Whether its hand has one joint, whose q runs from 0, closed, to :attr:`q_open`."""
        return not math.isnan(self.q_open)

    @property
    def shared(self) -> bool:
        """Whether both hands are in one message."""
        return len({self.topics(side) for side in Side}) < len(Side)

    @property
    def commands_both(self) -> bool:
        """Whether every command moves both hands: no value leaves a position servo alone."""
        return self.shared and self.position_servo

    def check_sides(self, sides: Collection[Subject]) -> None:
        """Check that these hands can be commanded without the others.

        :raises UsageError: a command would move the other hand.
        """
        if self.commands_both and set(sides) != set(Side):
            raise UsageError(
                f"a command on {self.cmd_topic} moves both hands, and has no value that leaves "
                "one alone",
                hint="choose both sides",
            )

    @property
    def gains_are_used(self) -> bool:
        """Whether kp and kd of a command have an effect."""
        return not (self.interface_specification or self.position_servo)

    def mode(self, index: int, status: JointMode) -> int:
        """The mode byte that a client sends to a motor.

        :param index: of the motor within its hand.
        """
        if self.mode_byte is ModeByte.RIS:
            return index | status << 4
        return int(status) if self.mode_byte is ModeByte.STATUS else 0

    @property
    def command_fields(self) -> tuple[str, ...]:
        """The numbers of a motor's command that have an effect."""
        if self.gains_are_used:
            return ("q", "dq", "tau", "kp", "kd")
        return ("q", "dq") if self.speed_units else ("q",)


@dataclass(frozen=True)
class PressureSensor:
    """One sensor packet of a hand.

    :param place: where it is.
    :param slots: which of the packet's 12 values are sensor elements; the others hold "no value".
    """

    place: str
    slots: tuple[int, ...]


@dataclass(frozen=True)
class ClientCommand:
    """What xr_teleoperate sends to a hand beside positions.

    :param gains: kp in N·m/rad and kd in N·m·s/rad of each joint.
    :param dq: to every joint, as it is on the wire.
    """

    gains: tuple[tuple[float, float], ...]
    dq: float = 0.0


@dataclass(frozen=True)
class HandModel:
    """One hand model.

    :param unit: of q, of its limits and of all that is derived from them.
    :param torque_unit: of tau_est and tau_max: A, where a hand reports currents.
    :param limit_margin: how far beyond its joint's limits q of a genuine hand, or of its client,
        may lie: end stops and zeros differ from hand to hand (docs/sources/real-hands.md).
    :param state_rate: Hz at which the vendor's service publishes state.
    :param min_state_rate: Hz below which clients suffer.
    :param command_rate: Hz at which xr_teleoperate sends commands.
    :param command_timeout: seconds without a command after which the vendor's service brakes.
    :param vendor_ids: id on the vendor's bus, for a hand of one motor.
    :param client_command: what xr_teleoperate sends beside positions.
    :param rest_q: where a simulated hand rests at first, per side; never all zero, because
        clients wait for a position that is not.
    :param sensors: pressure sensor packets of a state, in order.
    """

    name: str
    title: str
    joints: dict[Side, tuple[JointSpec, ...]]
    dialects: tuple[Dialect, ...]
    state_rate: float
    min_state_rate: float
    command_rate: float
    command_timeout: float
    client_command: ClientCommand
    rest_q: dict[Side, tuple[float, ...]]
    vendor_ids: dict[Side, int] = field(default_factory=dict)
    sensors: tuple[PressureSensor, ...] = ()
    unit: str = "rad"
    torque_unit: str = "N m"
    limit_margin: float = 0.15

    @property
    def gains(self) -> tuple[tuple[float, float], ...]:
        """(kp, kd) that xr_teleoperate sends to each joint."""
        return self.client_command.gains

    @property
    def motors(self) -> tuple[tuple[int, ...], ...]:
        """The joints of each motor, by index, in the order of the joints."""
        found: list[tuple[int, ...]] = []
        for i, joint in enumerate(self.joints[Side.LEFT]):
            if joint.coupled:
                found[-1] += (i,)
            else:
                found.append((i,))
        return tuple(found)

    def spec(
        self,
        side: Side,
        *,
        io_rate: float,
        exchange_timeout: float = 0.1,
        simulated: bool = False,
    ) -> HandSpec:
        """The specification of a hand of this model."""
        return HandSpec(
            model=self.name,
            side=side,
            joints=self.joints[side],
            io_rate=io_rate,
            exchange_timeout=exchange_timeout,
            n_sensors=len(self.sensors) or len(self.dialects[0].areas),
            simulated=simulated,
        )
