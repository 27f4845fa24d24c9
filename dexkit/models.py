"""The Dex family as data: joints, topics, types, rates, time-outs, per side and dialect.

Every other module takes these facts from here. Sources are sections of
docs/sources/unitree-dex.md and the gripper's DDS interface specification.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dexkit.errors import UsageError
from dexkit.hand import HandSpec, JointSpec, Side

__all__ = [
    "DEX1_1",
    "DEX3_1",
    "DEX5_1",
    "DIALECTS",
    "MODELS",
    "Dialect",
    "HandModel",
    "PressureSensor",
    "dialect",
    "model",
]


@dataclass(frozen=True)
class Dialect:
    """How a hand model appears on DDS.

    :param cmd_topic: command topic; ``{side}`` is replaced by ``left`` or ``right``.
    :param cmd_type: DDS type name of the command.
    :param index: position of a side's first motor in the sequence (0 unless both share a topic).
    :param length: motors in the sequence.
    :param q_open: q of a fully open gripper, rad, where 0 is closed; NaN for hands whose joints
        have no such scale.
    :param low_rate_topic: topic of the low-rate copy of the state, or empty; with ``{side}``.
    :param torque_units: N·m in one unit of a motor's tau and tau_est; empty where all are in N·m.
    """

    name: str
    model: str
    cmd_topic: str
    state_topic: str
    cmd_type: str
    state_type: str
    index: dict[Side, int]
    length: int
    q_open: float
    summary: str
    low_rate_topic: str = ""
    torque_units: tuple[float, ...] = ()

    def topics(self, side: Side) -> tuple[str, str]:
        """(command topic, state topic) of a side."""
        return self.cmd_topic.format(side=side), self.state_topic.format(side=side)


@dataclass(frozen=True)
class PressureSensor:
    """One sensor packet of a hand.

    :param place: where it is.
    :param slots: which of the packet's 12 values are sensor elements; the others hold "no value".
    """

    place: str
    slots: tuple[int, ...]


@dataclass(frozen=True)
class HandModel:
    """One model of the family.

    :param state_rate: Hz at which the vendor's service publishes state.
    :param min_state_rate: Hz below which clients suffer.
    :param command_rate: Hz at which xr_teleoperate sends commands.
    :param command_timeout: seconds without a command after which the vendor's service brakes.
    :param vendor_ids: id on the vendor's bus, for a hand of one motor.
    :param client_gains: kp in N·m/rad and kd in N·m·s/rad that xr_teleoperate sends, to every
        joint that ``joint_gains`` does not name.
    :param joint_gains: those that it sends to some joints, by index.
    :param rest_q: where a simulated hand rests at first, per side, rad; never all zero, because
        clients wait for a position that is not.
    :param sensors: pressure sensor packets of a state, in order.
    :param low_rate: Hz of the low-rate copy of the state, where the dialect has one.
    :param shared_motors: joints that one motor moves, by index; the others have one each.
    """

    name: str
    title: str
    joints: dict[Side, tuple[JointSpec, ...]]
    dialects: tuple[Dialect, ...]
    state_rate: float
    min_state_rate: float
    command_rate: float
    command_timeout: float
    client_gains: tuple[float, float]
    rest_q: dict[Side, tuple[float, ...]]
    vendor_ids: dict[Side, int] = field(default_factory=dict)
    sensors: tuple[PressureSensor, ...] = ()
    low_rate: float = 0.0
    joint_gains: dict[int, tuple[float, float]] = field(default_factory=dict)
    shared_motors: tuple[tuple[int, ...], ...] = ()

    @property
    def gains(self) -> tuple[tuple[float, float], ...]:
        """(kp, kd) that xr_teleoperate sends to each joint."""
        count = len(self.joints[Side.LEFT])
        return tuple(self.joint_gains.get(i, self.client_gains) for i in range(count))

    @property
    def motors(self) -> tuple[tuple[int, ...], ...]:
        """The joints of each motor, by index, in the order of the joints."""
        shared = {i: group for group in self.shared_motors for i in group}
        count = len(self.joints[Side.LEFT])
        return tuple(dict.fromkeys(shared.get(i, (i,)) for i in range(count)))

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
            n_sensors=len(self.sensors),
            simulated=simulated,
        )


# docs/sources/unitree-dex.md#b3: 0 closed, rising q opens, 5.4 rad = 9 cm of jaw travel; closing is
# toward smaller q.
# dq_max: two jaws at 0.2 m/s would need 24 rad/s (docs/sources/unitree-dex.md#b3, derived; the real
# limit is uncertain).
# tau_max: 20 N a jaw x 2 jaws x 0.09 m / 5.4 rad = 0.67 N m at the URDF's effort limit; the
# recordings reach kp * 0.18 = 0.9 N m, and vendor clients feed forward at most a few N m. 15 is
# what the vendor library clamps to (docs/sources/unitree-dex.md#g, rotor side), so nothing a client
# sends is cut short.
_DEX1_JOINT = JointSpec("gripper", q_min=0.0, q_max=5.4, dq_max=24.0, tau_max=15.0, closing=-1)

DIALECTS: dict[str, Dialect] = {
    d.name: d
    for d in (
        Dialect(
            name="unitree_go",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=5.4,
            summary="xr_teleoperate and the vendor's dex1_1_service: 0 closed .. 5.4 rad open",
        ),
        Dialect(
            name="unitree_hg",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=2 * math.pi,
            summary="the gripper's DDS interface specification: 0 closed .. 2 pi rad open",
        ),
        Dialect(
            name="unitree_actuator",
            model="dex1-1",
            cmd_topic="rt/unitree_actuator/cmd",
            state_topic="rt/unitree_actuator/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            # docs/sources/unitree-dex.md#a1: 0 is the right gripper, whatever the enum of
            # xr_teleoperate v1.1 says
            index={Side.LEFT: 1, Side.RIGHT: 0},
            length=2,
            q_open=5.4,
            summary="xr_teleoperate v1.1: both grippers in one message, 0 right, 1 left",
        ),
        Dialect(
            name="dex3",
            model="dex3-1",
            cmd_topic="rt/dex3/{side}/cmd",
            state_topic="rt/dex3/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=7,
            q_open=math.nan,
            summary="Dex3-1 of G1: 7 motors in the order of the IDL, RIS_Mode in the mode byte",
            # docs/sources/unitree-dex.md#a1: the only state topic to which the vendor's C++ example
            # subscribes
            low_rate_topic="rt/lf/dex3/{side}/state",
        ),
        Dialect(
            name="dex5",
            model="dex5-1",
            cmd_topic="rt/dex5/{side}/cmd",
            state_topic="rt/dex5/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=20,
            q_open=math.nan,
            summary="Dex5-1: 20 joints, fingers first, thumb last; mode 1 is position control",
            # docs/sources/unitree-dex.md#b5: a comment in xr_teleoperate says that fingers report
            # in mN m, the thumb in N m. Uncertain; the only statement there is.
            torque_units=(0.001,) * 16 + (1.0,) * 4,
        ),
    )
}

DEX1_1 = HandModel(
    name="dex1-1",
    title="Dex1-1 gripper",
    joints={Side.LEFT: (_DEX1_JOINT,), Side.RIGHT: (_DEX1_JOINT,)},
    dialects=tuple(d for d in DIALECTS.values() if d.model == "dex1-1"),
    state_rate=500.0,  # docs/sources/unitree-dex.md#b2: 2000 us loop
    min_state_rate=200.0,  # docs/sources/unitree-dex.md#d7; the interface specification "200+ Hz"
    command_rate=200.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # docs/sources/unitree-dex.md#b2: timeout_ms_ = 1000
    client_gains=(5.0, 0.05),  # docs/sources/unitree-dex.md#b1
    rest_q=dict.fromkeys(Side, (0.2 * _DEX1_JOINT.stroke,)),
    vendor_ids={Side.LEFT: 1, Side.RIGHT: 0},  # docs/sources/unitree-dex.md#b2
)


def _dex3_joints(side: Side) -> tuple[JointSpec, ...]:
    """The seven joints in the order of the IDL, on both sides: thumb, middle, index.

    Names and order: the Dex3-1 manual "Message Structure Sorting"; xr_teleoperate's enum names 3 to
    6 index-then-middle for the right hand, without effect (docs/sources/unitree-dex.md#d13).
    Limits: Unitree's URDF, which for thumb_1 is the manual's and narrower than xr_teleoperate's
    (docs/sources/unitree-dex.md#b4, docs/sources/unitree-dex.md#d17). The sides are
    mirrored: every flexing sign of the left hand turns round on the right; thumb_0 swings both
    ways. dq_max: xr_teleoperate's URDF (docs/sources/unitree-dex.md#d27); tau_max: both URDFs
    (docs/sources/unitree-dex.md#b4). Ratios: the Dex3-1 manual "Miniature Brushless Force Control
    Joint"; that thumb_0 is the one with 214 follows from its torque and speed, and is uncertain
    (docs/sources/unitree-dex.md#b4).
    """
    mirror = 1 if side is Side.LEFT else -1

    def joint(
        name: str, low: float, high: float, flexing: int, *, ratio: float = 108.0
    ) -> JointSpec:
        geared = ratio != 108.0
        q_min, q_max = sorted((mirror * low, mirror * high))
        return JointSpec(
            name,
            q_min=q_min + 0.0,  # no -0.0
            q_max=q_max + 0.0,
            dq_max=6.857 if geared else 12.0,
            tau_max=2.45 if geared else 1.4,
            closing=mirror * flexing,
            urdf=f"{side}_hand_{name}_joint",
            gear_ratio=ratio,
        )

    finger = [("0", -1.5708), ("1", -1.7453)]
    return (
        joint("thumb_0", -1.0472, 1.0472, 0, ratio=214.0),
        joint("thumb_1", -0.6109, 1.0472, 1),
        joint("thumb_2", 0.0, 1.7453, 1),
        *(joint(f"middle_{i}", low, 0.0, -1) for i, low in finger),
        *(joint(f"index_{i}", low, 0.0, -1) for i, low in finger),
    )


_DEX3_REST = (0.05, 0.2, 0.3, -0.3, -0.4, -0.3, -0.4)  # left; half relaxed, clear of all stops

# docs/sources/unitree-dex.md#b4, the Dex3-1 manual "Number of Pressure Sensors": 9 packets, 33
# elements: three areas of 2 x 2 on the palm, 2 x 2 on each finger pad, 3 x 1 on each finger tip.
# Which packet is which, and which of the 12 values are elements, is in a figure that the sources
# lost. Two public clients of real hands read these slots, and no others: the Dex3 clients in
# sakuzeng/xiangyang_g1 and in a fork of xr_teleoperate that names the packets so, too. They agree
# with each other and with the numbers of elements; a third project names the first six tips before
# pads and index before middle. Likely, not measured here.
_DEX3_SENSORS = (
    *(
        PressureSensor(f"{finger} {part}", slots)
        for finger in ("thumb", "middle", "index")
        for part, slots in (("pad", (0, 2, 9, 11)), ("tip", (3, 6, 8)))
    ),
    *(PressureSensor(f"palm {i}", (0, 2, 9, 11)) for i in range(3)),
)

DEX3_1 = HandModel(
    name="dex3-1",
    title="Dex3-1 hand",
    joints={side: _dex3_joints(side) for side in Side},
    dialects=tuple(d for d in DIALECTS.values() if d.model == "dex3-1"),
    state_rate=1000.0,  # the Dex3-1 manual "Communication rate"
    min_state_rate=200.0,  # inferred: twice the client's command rate, as for the Dex1-1
    command_rate=100.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # the Dex3-1 manual RIS_Mode_t: "default 1s timeout"
    client_gains=(1.5, 0.2),  # docs/sources/unitree-dex.md#b1
    rest_q={
        Side.LEFT: _DEX3_REST,
        Side.RIGHT: tuple(q if i == 0 else -q for i, q in enumerate(_DEX3_REST)),
    },
    sensors=_DEX3_SENSORS,
    # inferred: the sources give a topic and no rate (docs/sources/unitree-dex.md#a1)
    low_rate=20.0,
)


def _dex5_joints(side: Side) -> tuple[JointSpec, ...]:
    """The 20 joints in the order of the IDL: index, middle, ring and little finger, thumb.

    Everything about this hand is from a pull request to xr_teleoperate that was open when it was
    read, and from Unitree's URDF (docs/sources/unitree-dex.md#b5). Names are the URDF's without the
    side's letter; the left URDF calls joint 41 Link_41L. Limits: URDF; only Roll_12 is mirrored.
    dq_max and tau_max: the left URDF, for both sides: the right one has zeros for torques and for
    the fingers' sideways joints.
    """
    letter = "L" if side is Side.LEFT else "R"
    across = -1 if side is Side.LEFT else 1

    def joint(
        name: str, low: float, high: float, flexing: int, dq_max: float, urdf: str = ""
    ) -> JointSpec:
        return JointSpec(
            name,
            q_min=low,
            q_max=high,
            dq_max=dq_max,
            tau_max=0.93,
            closing=flexing,
            urdf=f"{urdf or name}{letter}",
        )

    fingers = [
        spec
        for finger in (2, 3, 4, 5)
        for spec in (
            joint(
                f"Roll_{finger}1",
                -0.38397,
                0.38397,
                0,
                0.76794,
                "Link_41" if (finger, side) == (4, Side.LEFT) else "",
            ),
            joint(f"Pitch_{finger}2", 0.0, 1.5708, 1, 3.1416),
            joint(f"Pitch_{finger}3", 0.0, 1.68424, 1, 3.3685),
            joint(f"Pitch_{finger}4", 0.0, 1.3963, 1, 2.7925),
        )
    ]
    low, high = sorted((0.0, across * 1.8151))
    return (
        *fingers,
        joint("Yaw_11", -0.5867, 0.6803, 0, 4.18),
        joint("Roll_12", low, high, across, 4.18),
        joint("Pitch_13", 0.0, 1.7652, 1, 4.18),
        joint("Pitch_14", 0.0, 1.6406, 1, 4.18),
    )


# half relaxed, clear of all stops
_DEX5_FINGER_REST = (0.03, 0.31, 0.34, 0.28)
_DEX5_THUMB_REST = (0.05, 0.36, 0.35, 0.33)

DEX5_1 = HandModel(
    name="dex5-1",
    title="Dex5-1 hand",
    joints={side: _dex5_joints(side) for side in Side},
    dialects=tuple(d for d in DIALECTS.values() if d.model == "dex5-1"),
    # inferred: no source gives a rate; a client polls every 2 ms (docs/sources/unitree-dex.md#b1)
    state_rate=500.0,
    min_state_rate=200.0,  # inferred: twice the client's command rate, as for the others
    command_rate=100.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # inferred: that of its relatives
    client_gains=(0.10, 0.001),  # docs/sources/unitree-dex.md#b1, the fingers
    # docs/sources/unitree-dex.md#b1, the thumb
    joint_gains=dict.fromkeys(range(16, 20), (1.0, 0.02)),
    rest_q={
        side: (
            *(4 * _DEX5_FINGER_REST),
            *(-q if (i, side) == (1, Side.LEFT) else q for i, q in enumerate(_DEX5_THUMB_REST)),
        )
        for side in Side
    },
    # derived: 16 motors for 20 joints (docs/sources/unitree-dex.md#b5) leave four each for thumb
    # and fingers less one in each finger, and what a finger of four joints shares is its two outer
    # ones. Uncertain.
    shared_motors=((2, 3), (6, 7), (10, 11), (14, 15)),
)

MODELS: dict[str, HandModel] = {m.name: m for m in (DEX1_1, DEX3_1, DEX5_1)}


def model(name: str) -> HandModel:
    """The model called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return MODELS[name]
    except KeyError:
        raise UsageError(f"no hand model {name!r}", hint=f"known: {', '.join(MODELS)}") from None


def dialect(name: str) -> Dialect:
    """The dialect called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return DIALECTS[name]
    except KeyError:
        raise UsageError(f"no dialect {name!r}", hint=f"known: {', '.join(DIALECTS)}") from None
