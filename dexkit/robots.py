"""The robots that carry the hands, as data: joints by motor slot, topics, types, rates.

A robot is not a hand: one message commands and reports all of its motors. Sources are
sections of docs/sources/unitree-dex.md, and Unitree's URDFs in unitree_ros (revision
d6f13aad): ``h1_description/urdf/h1.urdf`` and ``g1_description/g1_29dof_rev_1_0.urdf``, the G1
whose ``mode_machine`` is 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from dexkit.errors import UsageError
from dexkit.hand import JointSpec

__all__ = ["DQ_STOP", "G1", "H1", "Q_STOP", "ROBOTS", "RobotModel", "robot"]

Q_STOP = 2.146e9
"""A ``q`` that means "no position" (docs/sources/unitree-dex.md#a8); what is sent is the nearest
single, 2146000000."""
DQ_STOP = 16000.0
"""A ``dq`` that means "no velocity" (docs/sources/unitree-dex.md#a8)."""


@dataclass(frozen=True)
class RobotModel:
    """One robot.

    :param family: message family, ``"unitree_go"`` or ``"unitree_hg"``.
    :param motor_temperatures: values in the temperature of a motor's state.
    :param has_battery: whether its state has the battery, the supply and a frame header.
    :param battery_cells: of the battery, in series.
    :param teleop_name: its name in xr_teleoperate (``--arm``).
    :param lerobot_name: its name in LeRobot (``--robot.type``), or empty.
    :param joints: by motor slot; None where the slot is not used.
    :param enable: mode byte that lets the motor of a slot follow commands; 0 turns it off.
    :param client_gains: by slot, kp in N·m/rad and kd in N·m·s/rad that xr_teleoperate sends.
    :param rest_q: by slot, where an emulated robot rests at first, rad.
    :param mode_machine: kind of machine in every state, which commands must repeat; None where the
        messages have no such field.
    :param weight_slot: unused slot whose ``q`` on the arm topic is the arm's weight, 0 to 1.
    :param arm_slots: slots that the arm topic commands.
    :param state_rate: states a second.
    :param command_rate: commands a second of Unitree's low-level examples
        (docs/sources/unitree-dex.md#b1: 2 ms).
    :param teleop_rate: commands a second of xr_teleoperate (docs/sources/unitree-dex.md#b1).
    :param remote_rate: messages of the wireless remote a second.
    :param command_timeout: seconds without a command after which the robot damps.
    """

    name: str
    title: str
    family: str
    motor_temperatures: int
    has_battery: bool
    battery_cells: int
    teleop_name: str
    joints: tuple[JointSpec | None, ...]
    enable: tuple[int, ...]
    client_gains: tuple[tuple[float, float], ...]
    rest_q: tuple[float, ...]
    mode_machine: int | None
    weight_slot: int
    arm_slots: tuple[int, ...]
    cmd_topic: str = "rt/lowcmd"
    state_topic: str = "rt/lowstate"
    arm_topic: str = "rt/arm_sdk"
    remote_topic: str = "rt/wirelesscontroller"
    remote_type: str = "unitree_go::msg::dds_::WirelessController_"
    # docs/sources/unitree-dex.md#b1: clients poll at 500 Hz, the examples' loops take 2 ms
    state_rate: float = 500.0
    command_rate: float = 500.0
    teleop_rate: float = 250.0
    remote_rate: float = 50.0  # invented: the sources give the topic and no rate
    # inferred: the sources are silent; the protection of the hands' motors trips after 1 s
    # (docs/sources/unitree-dex.md#b4)
    command_timeout: float = 1.0
    lerobot_name: str = ""
    unit: ClassVar[str] = "rad"
    torque_unit: ClassVar[str] = "N m"

    @property
    def slots(self) -> int:
        """Motors in each message, used or not."""
        return len(self.joints)

    @property
    def min_state_rate(self) -> float:
        """Hz below which clients suffer: each command is to be made from a new state."""
        return self.teleop_rate

    @cached_property
    def used(self) -> tuple[int, ...]:
        """The slots that have a joint, in order."""
        return tuple(i for i, joint in enumerate(self.joints) if joint is not None)

    @property
    def cmd_type(self) -> str:
        """DDS type of the command, on the arm topic as well."""
        return f"{self.family}::msg::dds_::LowCmd_"

    @property
    def state_type(self) -> str:
        """DDS type of the state."""
        return f"{self.family}::msg::dds_::LowState_"

    def joint(self, slot: int) -> JointSpec:
        """The joint of a used slot.

        :raises UsageError: there is none.
        """
        found = self.joints[slot] if 0 <= slot < self.slots else None
        if found is None:
            raise UsageError(f"slot {slot} of the {self.name} has no joint")
        return found

    def slot(self, name: str) -> int:
        """Motor slot of the joint called ``name``.

        :raises UsageError: there is none.
        """
        for i, joint in enumerate(self.joints):
            if joint is not None and joint.name == name:
                return i
        known = ", ".join(joint.name for joint in self.joints if joint is not None)
        raise UsageError(f"the {self.name} has no joint {name!r}", hint=f"joints: {known}")


@dataclass(frozen=True)
class _Kind:
    """Limits that the two joints of a pair share, or of one in the middle; left hand side."""

    q_min: float
    q_max: float
    tau_max: float
    dq_max: float
    rest: float = 0.0

    def spec(self, name: str, *, mirrored: bool, urdf: str) -> JointSpec:
        low, high = (-self.q_max, -self.q_min) if mirrored else (self.q_min, self.q_max)
        return JointSpec(name, low, high, dq_max=self.dq_max, tau_max=self.tau_max, urdf=urdf)


def _joints(
    order: tuple[str | None, ...], kinds: dict[str, _Kind], urdf: dict[str, str]
) -> tuple[tuple[JointSpec | None, ...], tuple[float, ...]]:
    """Joints and rest positions by slot; joints about the roll and yaw axes are mirrored."""
    joints: list[JointSpec | None] = []
    rest: list[float] = []
    for name in order:
        if name is None:
            joints.append(None)
            rest.append(0.0)
            continue
        side, _, part = name.partition("_")
        kind = kinds[part if side in ("left", "right") else name]
        mirrored = side == "right" and part.endswith(("roll", "yaw"))
        joints.append(kind.spec(name, mirrored=mirrored, urdf=urdf.get(name, f"{name}_joint")))
        rest.append(-kind.rest if mirrored else kind.rest)
    return tuple(joints), tuple(rest)


# Slots: docs/sources/unitree-dex.md#a8. Rest positions of both robots are invented: knees slightly
# bent, arms off the sides.
_H1_ORDER = (
    *("right_hip_roll", "right_hip_pitch", "right_knee"),
    *("left_hip_roll", "left_hip_pitch", "left_knee"),
    *("waist_yaw", "left_hip_yaw", "right_hip_yaw", None, "left_ankle", "right_ankle"),
    *(
        f"{side}_{part}"
        for side in ("right", "left")
        for part in ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
    ),
)
_H1_KINDS = {
    "hip_yaw": _Kind(-0.43, 0.43, 200.0, 23.0),
    "hip_roll": _Kind(-0.43, 0.43, 200.0, 23.0),
    "hip_pitch": _Kind(-3.14, 2.53, 200.0, 23.0, rest=-0.1),
    "knee": _Kind(-0.26, 2.05, 300.0, 14.0, rest=0.3),
    "ankle": _Kind(-0.87, 0.52, 40.0, 9.0, rest=-0.2),
    "waist_yaw": _Kind(-2.35, 2.35, 200.0, 23.0),
    "shoulder_pitch": _Kind(-2.87, 2.87, 40.0, 9.0, rest=0.1),
    "shoulder_roll": _Kind(-0.34, 3.11, 40.0, 9.0, rest=0.1),
    "shoulder_yaw": _Kind(-1.3, 4.45, 18.0, 20.0),
    "elbow": _Kind(-1.25, 2.61, 18.0, 20.0, rest=0.3),
}
_h1_joints, _h1_rest = _joints(_H1_ORDER, _H1_KINDS, {"waist_yaw": "torso_joint"})
_H1_WEAK = {i for i, n in enumerate(_H1_ORDER) if i >= 12 or (n or "").endswith("ankle")}

H1 = RobotModel(
    name="h1",
    title="H1 robot",
    family="unitree_go",
    motor_temperatures=1,
    has_battery=True,
    battery_cells=15,  # as many as its state has fields for (docs/sources/unitree-dex.md#a2)
    teleop_name="H1",
    joints=_h1_joints,
    # docs/sources/unitree-dex.md#a8: 0x01 for weak motors (ankles, arms), 0x0A for the others
    enable=tuple(0x01 if i in _H1_WEAK else 0x0A for i in range(len(_H1_ORDER))),
    client_gains=tuple(
        (140.0, 3.0) if i in _H1_WEAK else (300.0, 5.0) for i in range(len(_H1_ORDER))
    ),  # docs/sources/unitree-dex.md#b1
    rest_q=_h1_rest,
    mode_machine=None,
    # unitree_sdk2 example/h1/high_level/h1_arm_sdk_dds_example.cpp: weight in the slot that is not
    # used, for the arms and the waist
    weight_slot=9,
    arm_slots=(6, *range(12, 20)),
)

_G1_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_G1_ARM = (
    *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
    *("wrist_roll", "wrist_pitch", "wrist_yaw"),
)
_G1_ORDER = (
    *(f"{side}_{part}" for side in ("left", "right") for part in _G1_LEG),
    *("waist_yaw", "waist_roll", "waist_pitch"),
    *(f"{side}_{part}" for side in ("left", "right") for part in _G1_ARM),
    *([None] * 6),
)
_G1_KINDS = {
    "hip_pitch": _Kind(-2.5307, 2.8798, 88.0, 32.0, rest=-0.1),
    "hip_roll": _Kind(-0.5236, 2.9671, 139.0, 20.0),
    "hip_yaw": _Kind(-2.7576, 2.7576, 88.0, 32.0),
    "knee": _Kind(-0.087267, 2.8798, 139.0, 20.0, rest=0.3),
    "ankle_pitch": _Kind(-0.87267, 0.5236, 35.0, 30.0, rest=-0.2),
    "ankle_roll": _Kind(-0.2618, 0.2618, 35.0, 30.0),
    "waist_yaw": _Kind(-2.618, 2.618, 88.0, 32.0),
    "waist_roll": _Kind(-0.52, 0.52, 35.0, 30.0),
    "waist_pitch": _Kind(-0.52, 0.52, 35.0, 30.0),
    "shoulder_pitch": _Kind(-3.0892, 2.6704, 25.0, 37.0, rest=0.2),
    "shoulder_roll": _Kind(-1.5882, 2.2515, 25.0, 37.0, rest=0.2),
    "shoulder_yaw": _Kind(-2.618, 2.618, 25.0, 37.0),
    "elbow": _Kind(-1.0472, 2.0944, 25.0, 37.0, rest=0.6),
    "wrist_roll": _Kind(-1.972222054, 1.972222054, 25.0, 37.0),
    "wrist_pitch": _Kind(-1.614429558, 1.614429558, 5.0, 22.0),
    "wrist_yaw": _Kind(-1.614429558, 1.614429558, 5.0, 22.0),
}
_g1_joints, _g1_rest = _joints(_G1_ORDER, _G1_KINDS, {})


def _g1_gains(name: str | None) -> tuple[float, float]:
    """docs/sources/unitree-dex.md#b1; which motors are weak: xr_teleoperate's robot_arm.py (ankle
    pitch, not roll).
    """
    part = (name or "").partition("_")[2]
    if part.startswith("wrist"):
        return 40.0, 1.5
    if part.startswith(("shoulder", "elbow")) or part == "ankle_pitch":
        return 80.0, 3.0
    return (300.0, 3.0) if name else (0.0, 0.0)


G1 = RobotModel(
    name="g1",
    title="G1 robot (29 joints)",
    family="unitree_hg",
    motor_temperatures=2,
    has_battery=False,
    battery_cells=13,  # the G1's datasheet
    teleop_name="G1_29",
    lerobot_name="unitree_g1",
    joints=_g1_joints,
    enable=(1,) * len(_G1_ORDER),  # docs/sources/unitree-dex.md#a8: 1 enable, 0 disable
    client_gains=tuple(_g1_gains(name) for name in _G1_ORDER),
    rest_q=_g1_rest,
    mode_machine=5,
    weight_slot=29,  # docs/sources/unitree-dex.md#a8
    # unitree_sdk2 example/g1/high_level/g1_arm7_sdk_dds_example.cpp: waist and arms
    arm_slots=tuple(range(12, 29)),
)

ROBOTS: dict[str, RobotModel] = {b.name: b for b in (H1, G1)}


def robot(name: str) -> RobotModel:
    """The robot called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return ROBOTS[name]
    except KeyError:
        raise UsageError(f"no robot {name!r}", hint=f"known: {', '.join(ROBOTS)}") from None
