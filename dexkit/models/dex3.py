"""The Dex3-1 hand: seven joints, nine pressure sensor packets."""

from __future__ import annotations

import math
from functools import cache

from dexkit.hand import JointSpec, Side
from dexkit.kinematics import BASE, Box, Element, Segment, Skeleton, Vector
from dexkit.lazy import Lazy
from dexkit.models.profile import (
    Dialect,
    Finger,
    HandLayout,
    HandModel,
    ModeByte,
    PressureSensor,
)

__all__ = ["DEX3_1", "skeleton"]


def _joints(side: Side) -> tuple[JointSpec, ...]:
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


_REST = (0.05, 0.2, 0.3, -0.3, -0.4, -0.3, -0.4)  # left; half relaxed, clear of all stops

# docs/sources/unitree-dex.md#b4, the Dex3-1 manual "Number of Pressure Sensors": 9 packets, 33
# elements: three areas of 2 x 2 on the palm, 2 x 2 on each finger pad, 3 x 1 on each finger tip.
# Which packet is which, and which of the 12 values are elements, is in a figure that the sources
# lost. Two public clients of real hands read these slots, and no others: the Dex3 clients in
# sakuzeng/xiangyang_g1 and in a fork of xr_teleoperate that names the packets so, too. They agree
# with each other and with the numbers of elements; a third project names the first six tips before
# pads and index before middle. Likely, not measured here.
_SENSORS = (
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
    # real hands: up to 0.085 rad (docs/sources/real-hands.md); xr_teleoperate's wider limits
    limit_margin=0.15,
    joints={side: _joints(side) for side in Side},
    dialects=(
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
            codec=Lazy("dexkit.service.dialects:RisModeMap"),
            mode_byte=ModeByte.RIS,
            zero_is_no_state=True,
        ),
    ),
    state_rate=1000.0,  # the Dex3-1 manual "Communication rate"
    min_state_rate=200.0,  # inferred: twice the client's command rate, as for the Dex1-1
    command_rate=100.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # the Dex3-1 manual RIS_Mode_t: "default 1s timeout"
    client_gains=(1.5, 0.2),  # docs/sources/unitree-dex.md#b1
    rest_q={
        Side.LEFT: _REST,
        Side.RIGHT: tuple(q if i == 0 else -q for i, q in enumerate(_REST)),
    },
    sensors=_SENSORS,
    low_rate=9.1,  # as a real robot's copy comes (docs/sources/real-hands.md#dex3-low-rate)
    simulator="sim-dex3",
    simulated_by=Lazy("dexkit.emulators.sim_dex3:sim_dex3"),
    fingers=3 * ("thumb",) + 2 * ("middle",) + 2 * ("index",),
    client_forks=True,
    layout=HandLayout(
        centres=(256.0, 624.0),
        top=432.0,
        palm=(206.0, 150.0),
        width=76.0,
        fingers=(
            Finger("thumb", range(0, 3), (-122.0, 28.0), (-12.0, -72.0), tip=1.35, root=0.1),
            Finger("middle", range(3, 5), (52.0, -108.0), (0.0, -72.0), tip=1.35),
            Finger("index", range(5, 7), (-38.0, -108.0), (0.0, -72.0), tip=1.35),
        ),
        palm_sensors=((10.0, -40.0), (-24.0, 34.0), (44.0, 34.0)),
    ),
    skeleton=Lazy("dexkit.models.dex3:skeleton"),
)

_RIGHT = math.pi / 2


@cache
def skeleton(side: Side) -> Skeleton:
    """The joint axes, origins and drawn boxes (docs/sources/unitree-dex.md#i1,
    docs/sources/unitree-dex.md#i2); places of the pressure sensors are schematic.
    """
    # the right hand is the left one mirrored in y; its joints turn about the same axes
    m = 1.0 if side is Side.LEFT else -1.0

    def finger(name: str, joint: int, z: float) -> tuple[Segment, Segment]:
        return (
            Segment(f"{name}_0", BASE, (0.0777, m * 0.0016, z), joint=joint),
            Segment(f"{name}_1", joint, (0.0458, 0.0, 0.0), joint=joint + 1),
        )

    segments = (
        Segment("thumb_0", BASE, (0.0255, 0.0, 0.0), axis=(0.0, 1.0, 0.0), joint=0),
        Segment("thumb_1", 0, (-0.0025, -m * 0.0193, 0.0), joint=1),
        Segment("thumb_2", 1, (0.0, -m * 0.0458, 0.0), joint=2),
        *finger("middle", 3, -0.0285),
        *finger("index", 5, 0.0285),
    )

    def box(segment: int, low: Vector, high: Vector) -> Box:
        return Box.between(segment, *_mirrored(low, high, m))

    lower = ((-0.007, -0.0147, -0.0128), (0.0548, 0.0126, 0.0129))
    upper = ((-0.007, -0.0088, -0.0129), (0.052, 0.0089, 0.0131))
    # of the thumb, the same bodies turned: they point to -y, and bend toward x
    boxes = (
        box(BASE, (0.0, -0.0203, -0.0439), (0.0867, 0.0214, 0.0439)),
        box(0, (-0.0115, -0.0283, -0.0095), (0.0101, 0.0, 0.0095)),
        box(1, (-0.0126, -0.0548, -0.0129), (0.0147, 0.007, 0.0128)),
        box(2, (-0.0089, -0.052, -0.0131), (0.0088, 0.007, 0.0129)),
        *(box(i, *(lower if i in (3, 5) else upper)) for i in (3, 4, 5, 6)),
    )
    elements: list[Element] = []
    for tip in (2, 4, 6):
        # the pad's 2 x 2, then the tip's 3, on the side toward which the finger bends
        for along, across in (
            *_square(0.022, 0.007),
            (0.048, -0.007),
            (0.048, 0.0),
            (0.048, 0.007),
        ):
            if tip == 2:
                elements.append(Element(tip, (0.0095, -m * along, across)))
            else:
                elements.append(Element(tip, (along, -m * 0.0095, across)))
    for x, z in ((0.066, 0.0), (0.02, 0.028), (0.02, -0.028)):
        elements += [Element(BASE, (x + u, -m * 0.021, z + v)) for u, v in _square(0.0, 0.007)]
    mount = (0.0, -_RIGHT, 0.0) if side is Side.LEFT else (math.pi, -_RIGHT, 0.0)
    return Skeleton(
        segments,
        boxes,
        tuple(elements),
        mount=mount,
        note="places of the pressure sensors are schematic",
    )


def _mirrored(low: Vector, high: Vector, m: float) -> tuple[Vector, Vector]:
    """Extents mirrored in y, if m is -1."""
    if m > 0:
        return low, high
    return (low[0], -high[1], low[2]), (high[0], -low[1], high[2])


def _square(along: float, half: float) -> tuple[tuple[float, float], ...]:
    return tuple((along + u, v) for u in (-half, half) for v in (-half, half))
