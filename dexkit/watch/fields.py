"""Which numbers of a message are shown, and where they are, per topic and hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from dexkit.hand import ROBOT, JointSpec, Side, Subject
from dexkit.messages import MessageType, message_type
from dexkit.models import Dialect, HandModel, ModeByte, model
from dexkit.robots import ROBOTS, RobotModel
from dexkit.topics import roles, split_prefix

__all__ = ["Field", "Part", "parts_of"]

_STATE = {
    "q": ("q",),
    "dq": ("dq",),
    "ddq": ("ddq",),
    "tau": ("tau_est",),
    "temperature": ("temperature",),
    # where there is no motorstate, dexkit's services put the motor error bits into the first
    # reserved word (docs/service.md); Unitree's leave it 0
    "fault": ("motorstate", "reserve"),
    "mode": ("mode",),
    "voltage": ("vol",),
}
"""The members of a motor's state that may hold a quantity; the first that it has does. Of an array
the first element.
"""
_COMMAND = {name: name for name in ("q", "dq", "tau", "kp", "kd", "mode")}
_UNITS = {
    "q": "rad",
    "dq": "rad/s",
    "ddq": "rad/s²",
    "tau": "N·m",
    "kp": "N·m/rad",
    "kd": "N·m·s/rad",
    "temperature": "°C",
    "voltage": "V",
}
_SUPPLY = {"power_v": "V", "power_a": "A", "system_v": "V", "device_v": "V"}


@dataclass(frozen=True)
class Field:
    """One number of a message.

    :param path: in the message, as :class:`~dexkit.messages.columns.Columns` takes it.
    :param name: for people: ``thumb_0 q``.
    :param quantity: ``q``, ``tau``, ``pressure``, ...
    :param index: of the joint, sensor or tactile area; -1 for the whole hand.
    :param factor: from the message's unit to that of ``unit``.
    :param elements: of a list at ``path``, whose largest number it is; 0 for a single number.
    """

    path: str
    name: str
    quantity: str
    index: int
    unit: str = ""
    factor: float = 1.0
    elements: int = 0

    @property
    def paths(self) -> list[str]:
        """Each number of the message that it is made of."""
        return [f"{self.path}[{i}]" for i in range(self.elements)] or [self.path]


@dataclass(frozen=True)
class Part:
    """The part of a topic for one hand or robot.

    :param kind: ``"cmd"``, ``"state"``, ``"low"`` or ``"touch"``.
    :param joints: in the units of the topic's dialect.
    :param expected: samples a second that the vendor's publisher sends.
    :param mode_byte: what the mode byte of a motor holds.
    :param timeout: seconds after which a command no longer counts.
    :param gains_are_used: whether kp and kd of a command have an effect.
    :param prefix: under which the hand's topics are: ``r2`` of ``rt/r2/dex3/left/cmd``.
    """

    subject: Subject
    kind: str
    model: HandModel | RobotModel
    dialect: str
    joints: tuple[JointSpec, ...]
    fields: tuple[Field, ...]
    expected: float
    mode_byte: ModeByte
    timeout: float
    gains_are_used: bool = True
    prefix: str = ""

    def columns(self, quantity: str) -> list[int]:
        """The places of a quantity in :attr:`fields`, by joint or sensor element."""
        return [i for i, f in enumerate(self.fields) if f.quantity == quantity]


def parts_of(topic: str, type_name: str) -> list[Part]:
    """The parts of a topic, by its name and type; empty for other topics."""
    prefix, bare = split_prefix(topic)
    found = [
        replace(_hand_part(role.dialect, role.kind, side, type_name), prefix=prefix)
        for role in roles(bare, type_name)
        for side in role.sides
    ]
    return found or list(_robot_parts(topic, type_name))


def _hand_part(dialect: Dialect, kind: str, side: Side, type_name: str) -> Part:
    hand = model(dialect.model)
    joints = hand.joints[side]
    if dialect.is_gripper:
        joints = tuple(replace(j, q_min=0.0, q_max=dialect.q_open) for j in joints)
    units = dialect.torque_units or (1.0,) * len(joints)
    first = dialect.index[side]
    fields: list[Field] = []
    if kind == "touch":
        fields += [
            Field(a.member, f"{a.place} touch", "touch", i, "counts", elements=a.elements)
            for i, a in enumerate(dialect.areas)
        ]
    else:
        slots = [(first + i, j) for i, j in enumerate(joints)]
        fields += _motor_fields(
            type_name, kind, slots, units, hand.unit, hand.torque_unit, dialect.speed_units
        )
    members = {f.name for f in message_type(type_name).layout.fields}
    if "press_sensor_state" in members:
        fields += [
            Field(
                f"press_sensor_state[{i}].pressure[{slot}]",
                f"{sensor.place} {n} pressure",
                "pressure",
                i,
            )
            for i, sensor in enumerate(hand.sensors)
            for n, slot in enumerate(sensor.slots)
        ]
    fields += [
        Field(name, name, name, -1, unit) for name, unit in _SUPPLY.items() if name in members
    ]
    rate = {
        "cmd": hand.command_rate,
        "state": hand.state_rate,
        "low": dialect.low_rate,
        "touch": dialect.touch_rate,
    }[kind]
    return Part(
        side,
        kind,
        hand,
        dialect.name,
        joints,
        tuple(fields),
        rate,
        dialect.mode_byte,
        hand.command_timeout,
        dialect.gains_are_used,
    )


def _motor_fields(
    type_name: str,
    kind: str,
    joints: list[tuple[int, JointSpec]],
    units: tuple[float, ...],
    unit: str = "rad",
    torque_unit: str = "N m",
    speeds: tuple[float, ...] = (),
) -> Iterator[Field]:
    """The numbers of motors in a message.

    :param units: N·m in one unit of each joint's torque.
    :param unit: of q, and that of tau.
    :param speeds: that of dq, in units of q a second; empty for 1.
    """
    mt = message_type(type_name)
    members = _COMMAND if kind == "cmd" else _state_members(mt.motor_type)
    for number, (slot, joint) in enumerate(joints):
        for quantity, member in members.items():
            place = mt.motor_place(member, slot)
            if place is None:
                continue
            yield Field(
                place[0],
                f"{joint.name} {quantity}",
                quantity,
                number,
                _unit(quantity, unit, torque_unit),
                (
                    units[number]
                    if quantity == "tau"
                    else speeds[number]
                    if speeds and quantity in ("dq", "ddq")
                    else 1.0
                )
                / place[1],
            )


def _state_members(motor: MessageType) -> dict[str, str]:
    """The member that holds each quantity of a motor's state, of those that it has."""
    fields = {f.name: f for f in motor.layout.fields}
    found = {}
    for quantity, names in _STATE.items():
        name = next((n for n in names if n in fields), None)
        if name is not None:
            found[quantity] = name if fields[name].array is None else f"{name}[0]"
    return found


def _unit(quantity: str, unit: str, torque_unit: str) -> str:
    """The unit of a quantity of a hand with these units of q and tau."""
    found = _UNITS.get(quantity, "").replace("rad", unit)
    return found.replace("N·m", torque_unit.replace("N m", "N·m"))


def _robot_parts(topic: str, type_name: str) -> Iterator[Part]:
    for robot in ROBOTS.values():
        kinds = {
            (robot.cmd_topic, robot.cmd_type): ("cmd", robot.command_rate),
            (robot.arm_topic, robot.cmd_type): ("arm", robot.teleop_rate),
            (robot.state_topic, robot.state_type): ("state", robot.state_rate),
        }
        if (topic, type_name) not in kinds:
            continue
        kind, rate = kinds[topic, type_name]
        slots = [(i, robot.joint(i)) for i in robot.used]
        one = (1.0,) * len(slots)
        as_kind = "state" if kind == "state" else "cmd"
        yield Part(
            ROBOT,
            kind,
            robot,
            robot.name,
            tuple(joint for _, joint in slots),
            tuple(_motor_fields(type_name, as_kind, slots, one)),
            rate,
            ModeByte.UNUSED,
            robot.command_timeout,
        )
