"""Skeletons of the hands and robots: joint axes and origins, and the boxes that are drawn.

Origins and axes are those of Unitree's URDFs (docs/sources/unitree-dex.md#i1). The boxes have the
extents of the meshes that the URDFs name, rounded (docs/sources/unitree-dex.md#i2); the
meshes themselves are not used. Places of pressure sensor elements are schematic
(docs/sources/unitree-dex.md#i3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from dexkit.hand import JointSpec, Side
from dexkit.kinematics import BASE, Box, Element, Segment, Skeleton, Vector
from dexkit.models.profile import HandModel
from dexkit.robots import G1, H1, RobotModel

__all__ = ["dex1", "dex3", "dex5", "g1", "h1", "schematic", "skeleton_of"]

_RIGHT = math.pi / 2


def skeleton_of(model: HandModel | RobotModel, side: Side | None = None) -> Skeleton:
    """The skeleton of a hand or a robot: its profile's, or a schematic one of a hand.

    :param side: of a hand; None for a robot.
    """
    if isinstance(model, RobotModel):
        return model.skeleton.load()()
    assert side is not None
    if model.skeleton is not None:
        return model.skeleton.load()(side)
    return schematic(model, side)


@cache
def dex1(side: Side) -> Skeleton:
    """The Dex1-1: two jaws that slide; both sides are alike.

    In the URDF a jaw slides from 0.0245 m, where the jaws touch, to -0.02 m. That q is in
    proportion is derived: 5.4 rad are 9 cm (docs/sources/unitree-dex.md#b3).
    """
    touching, stroke = 0.0245, 0.0445 / 5.4
    segments, boxes = [], [_between(BASE, (-0.035, 0.0, -0.035), (0.035, 0.074, 0.035))]
    for sign, name in ((1, "jaw_1"), (-1, "jaw_2")):
        segments.append(
            Segment(
                name,
                BASE,
                (sign * 0.04055, 0.0593, sign * 0.0152),
                axis=(-float(sign), 0.0, 0.0),
                joint=0,
                prismatic=True,
                factor=-stroke,
                offset=touching,
            )
        )
        here = len(segments) - 1
        for low, high in (
            ((-0.08, -0.005, -0.008), (0.0, 0.009, 0.0065)),  # the rack
            ((-0.019, 0.006, -0.03), (0.0, 0.088, 0.0)),  # the finger
            ((-0.0155, 0.036, -0.029), (-0.0115, 0.085, -0.001)),  # its pad
        ):
            # the second jaw is the first one turned by half a turn about y
            boxes.append(_between(here, *_turned(low, high, sign)))
    return Skeleton(tuple(segments), tuple(boxes), mount=(_RIGHT, 0.0, 0.0))


@cache
def dex3(side: Side) -> Skeleton:
    """The Dex3-1."""
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
        return _between(segment, *_mirrored(low, high, m))

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


@cache
def dex5(side: Side) -> Skeleton:
    """The Dex5-1: four fingers of four joints, then the thumb."""
    left = side is Side.LEFT
    m = 1.0 if left else -1.0
    segments: list[Segment] = []
    boxes = [
        # narrower than the mesh, which has the thumb's mount as well
        _between(BASE, (-0.07, -0.0398, -0.012 if left else -0.028),
                 (0.024, 0.072, 0.028 if left else 0.012)),
    ]  # fmt: skip
    for x, y in ((0.01, 0.0731), (-0.012, 0.0771), (-0.034, 0.0731), (-0.056, 0.0691)):
        turn = (-math.pi, 0.0, _RIGHT) if left else (0.0, 0.0, _RIGHT)
        n = len(segments)
        finger = f"{2 + n // 4}"
        segments += [
            Segment(f"Roll_{finger}1", BASE, (x, y, m * 0.0034702), turn, joint=n),
            Segment(f"Pitch_{finger}2", n, (0.0042, 0.0, 0.0), (_RIGHT, 0.0, 0.0), joint=n + 1),
            Segment(f"Pitch_{finger}3", n + 1, (0.04, 0.0, 0.0), joint=n + 2),
            Segment(f"Pitch_{finger}4", n + 2, (0.020985, 0.000804, 0.0), joint=n + 3),
        ]
        boxes += [
            _between(n + 1, (-0.0044, -0.0145, -0.0082), (0.0471, 0.0058, 0.0082)),
            _between(n + 2, (-0.0025, -0.0125, -0.008), (0.0242, 0.005, 0.0082)),
            _between(n + 3, (-0.0029, -0.0125, -0.0082), (0.029, 0.0051, 0.0082)),
        ]
    n = len(segments)
    segments += [
        Segment("Yaw_11", BASE, (0.0, 0.0, -m * 0.01435), joint=n),
        Segment("Roll_12", n, (-0.0000106, 0.0, 0.0), (_RIGHT, 0.0, 0.0), joint=n + 1),
        Segment("Pitch_13", n + 1, (0.0335, 0.0, -0.006), (-_RIGHT, 0.0, 0.0), joint=n + 2),
        Segment("Pitch_14", n + 2, (0.036609, -0.0053654, 0.0), joint=n + 3),
    ]
    boxes += [
        _between(n + 1, (-0.0085, -0.0165, -0.0165), (0.0415, 0.0165, 0.0165)),
        _between(n + 2, (-0.0132, -0.0245, -0.0145), (0.0476, 0.0097, 0.0145)),
        _between(n + 3, (-0.008, -0.0088, -0.0133), (0.0589, 0.015, 0.0135)),
    ]
    mount = (_RIGHT, 0.0, math.pi) if left else (_RIGHT, 0.0, 0.0)
    return Skeleton(
        tuple(segments),
        tuple(boxes),
        mount=mount,
        note="the palm's and the fingers' backs are simplified",
    )


# (joint, its parent or "" for the pelvis, axis, origin in m, rpy in rad)
_Row = tuple[str, str, str, Vector, Vector]
_AS_PARENT = (0.0, 0.0, 0.0)


def _g1_leg(side: str, m: float) -> tuple[_Row, ...]:
    return (
        (f"{side}_hip_pitch", "", "y", (0.0, m * 0.064452, -0.1027), _AS_PARENT),
        (f"{side}_hip_roll", "hip_pitch", "x", (0.0, m * 0.052, -0.030465), (0.0, -0.1749, 0.0)),
        (f"{side}_hip_yaw", "hip_roll", "z", (0.025001, 0.0, -0.12412), _AS_PARENT),
        (f"{side}_knee", "hip_yaw", "y", (-0.078273, m * 0.002149, -0.17734), (0.0, 0.1749, 0.0)),
        (f"{side}_ankle_pitch", "knee", "y", (0.0, -m * 0.000094, -0.30001), _AS_PARENT),
        (f"{side}_ankle_roll", "ankle_pitch", "x", (0.0, 0.0, -0.017558), _AS_PARENT),
    )


def _g1_arm(side: str, m: float) -> tuple[_Row, ...]:
    return (
        (f"{side}_shoulder_pitch", "waist_pitch", "y", (0.003956, m * 0.10022, 0.24778),
         (m * 0.27931, 0.0, 0.0)),
        (f"{side}_shoulder_roll", "shoulder_pitch", "x", (0.0, m * 0.038, -0.013831),
         (-m * 0.27925, 0.0, 0.0)),
        (f"{side}_shoulder_yaw", "shoulder_roll", "z", (0.0, m * 0.00624, -0.1032), _AS_PARENT),
        (f"{side}_elbow", "shoulder_yaw", "y", (0.015783, 0.0, -0.080518), _AS_PARENT),
        (f"{side}_wrist_roll", "elbow", "x", (0.1, m * 0.001888, -0.01), _AS_PARENT),
        (f"{side}_wrist_pitch", "wrist_roll", "y", (0.038, 0.0, 0.0), _AS_PARENT),
        (f"{side}_wrist_yaw", "wrist_pitch", "z", (0.046, 0.0, 0.0), _AS_PARENT),
    )  # fmt: skip


def _h1_leg(side: str, m: float) -> tuple[_Row, ...]:
    return (
        (f"{side}_hip_yaw", "", "z", (0.0, m * 0.0875, -0.1742), _AS_PARENT),
        (f"{side}_hip_roll", "hip_yaw", "x", (0.039468, 0.0, 0.0), _AS_PARENT),
        (f"{side}_hip_pitch", "hip_roll", "y", (0.0, m * 0.11536, 0.0), _AS_PARENT),
        (f"{side}_knee", "hip_pitch", "y", (0.0, 0.0, -0.4), _AS_PARENT),
        (f"{side}_ankle", "knee", "y", (0.0, 0.0, -0.4), _AS_PARENT),
    )


def _h1_arm(side: str, m: float) -> tuple[_Row, ...]:
    return (
        (f"{side}_shoulder_pitch", "waist_yaw", "y", (0.0055, m * 0.15535, 0.42999),
         (m * 0.43633, 0.0, 0.0)),
        (f"{side}_shoulder_roll", "shoulder_pitch", "x", (-0.0055, m * 0.0565, -0.0165),
         (-m * 0.43633, 0.0, 0.0)),
        (f"{side}_shoulder_yaw", "shoulder_roll", "z", (0.0, 0.0, -0.1343), _AS_PARENT),
        (f"{side}_elbow", "shoulder_yaw", "y", (0.0185, 0.0, -0.198), _AS_PARENT),
    )  # fmt: skip


_SIDES = (("left", 1.0), ("right", -1.0))


@cache
def g1() -> Skeleton:
    """The G1 of 29 joints; bodies are schematic."""
    waist: tuple[_Row, ...] = (
        ("waist_yaw", "", "z", (0.0, 0.0, 0.0), _AS_PARENT),
        ("waist_roll", "waist_yaw", "x", (-0.003964, 0.0, 0.044), _AS_PARENT),
        ("waist_pitch", "waist_roll", "y", (0.0, 0.0, 0.0), _AS_PARENT),
    )
    rows = [*waist]
    for side, m in _SIDES:
        rows += [*_g1_leg(side, m), *_g1_arm(side, m)]
    boxes = {
        "": ((0.0, 0.0, -0.05), (0.13, 0.15, 0.14)),
        "waist_pitch": ((0.0, 0.0, 0.17), (0.14, 0.2, 0.26)),
    }
    return _robot(G1, rows, boxes, trunk=("waist_pitch", (0.01, 0.0, 0.4), (0.12, 0.12, 0.16)))


@cache
def h1() -> Skeleton:
    """The H1; bodies are schematic."""
    rows: list[_Row] = [("waist_yaw", "", "z", (0.0, 0.0, 0.0), _AS_PARENT)]
    for side, m in _SIDES:
        rows += [*_h1_leg(side, m), *_h1_arm(side, m)]
    boxes = {
        "": ((0.0, 0.0, -0.1), (0.14, 0.18, 0.16)),
        "waist_yaw": ((0.0, 0.0, 0.28), (0.17, 0.26, 0.42)),
    }
    return _robot(H1, rows, boxes, trunk=("waist_yaw", (0.03, 0.0, 0.62), (0.15, 0.14, 0.2)))


_AXES: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def _robot(
    robot: RobotModel,
    rows: Sequence[_Row],
    boxes: dict[str, tuple[Vector, Vector]],
    trunk: tuple[str, Vector, Vector],
) -> Skeleton:
    places: dict[str, int] = {"": BASE}
    order = [robot.joint(slot).name for slot in robot.used]
    segments: list[Segment] = []
    for name, parent, axis, origin, turn in rows:
        side = name.partition("_")[0]
        above = places.get(parent, places.get(f"{side}_{parent}", BASE))
        places[name] = len(segments)
        segments.append(
            Segment(name, above, origin, turn, axis=_AXES[axis], joint=order.index(name))
        )
    drawn = [Box(places[name], centre, size) for name, (centre, size) in boxes.items()]
    name, centre, size = trunk
    drawn.append(Box(places[name], centre, size))
    drawn += _limbs(segments, skip={places[n] for n in boxes} | {BASE}, width=0.07)
    feet = [i for i, s in enumerate(segments) if s.name.endswith(("ankle", "ankle_roll"))]
    drawn += [Box(i, (0.035, 0.0, -0.03), (0.2, 0.07, 0.03)) for i in feet]
    hands = [i for i, s in enumerate(segments) if s.name.endswith(("wrist_yaw",))]
    drawn += [Box(i, (0.03, 0.0, 0.0), (0.06, 0.05, 0.04)) for i in hands]
    if not hands:
        elbows = [i for i, s in enumerate(segments) if s.name.endswith("elbow")]
        drawn += [Box(i, (0.13, 0.0, 0.0), (0.26, 0.06, 0.06)) for i in elbows]
    return Skeleton(
        tuple(segments), tuple(drawn), mount=(0.0, 0.0, _RIGHT), note="bodies are schematic"
    )


def _limbs(segments: Sequence[Segment], skip: set[int], width: float) -> list[Box]:
    """A box from each segment to each that hangs on it."""
    out = []
    for segment in segments:
        length = math.dist((0, 0, 0), segment.origin)
        if segment.parent in skip or length < 0.02:
            continue
        x, y, z = segment.origin
        out.append(
            Box(segment.parent, (x / 2, y / 2, z / 2), (length + width / 2, width, width),
                along=segment.origin)
        )  # fmt: skip
    return out


def schematic(model: HandModel, side: Side) -> Skeleton:
    """A drawing of a hand whose axes and lengths are not known: fingers side by side.

    Joints that close the hand bend, the others swing sideways.
    """
    groups = _groups(model)
    joints = model.joints[side]
    width = 0.03
    height = max(0.06, width * len(groups))
    segments: list[Segment] = []
    boxes = [Box(BASE, (0.0, 0.0, -0.045), (height, 0.03, 0.09))]
    for column, group in enumerate(groups):
        x = (column - (len(groups) - 1) / 2) * width
        parent, place = BASE, (x, 0.0, 0.0)
        for joint in group:
            here = len(segments)
            segments.append(
                Segment(joints[joint].name, parent, place, axis=_swing(joints[joint]), joint=joint)
            )
            boxes.append(Box(here, (0.0, 0.0, 0.02), (0.022, 0.022, 0.044)))
            parent, place = here, (0.0, 0.0, 0.04)
    return Skeleton(
        tuple(segments), tuple(boxes), schematic=True, note="axes and lengths are not known"
    )


def _groups(model: HandModel) -> list[list[int]]:
    """Joints by finger, one behind the other."""
    if model.layout is not None:
        return [list(finger.joints) for finger in model.layout.fingers]
    found: list[list[int]] = []
    before = None
    for i in range(len(model.joints[Side.LEFT])):
        finger = model.fingers[i] if i < len(model.fingers) else str(i)
        if finger != before or len(found[-1]) >= 4:
            found.append([])
        found[-1].append(i)
        before = finger
    return found


def _swing(joint: JointSpec) -> Vector:
    return (float(joint.closing), 0.0, 0.0) if joint.closing else (0.0, 1.0, 0.0)


def _between(segment: int, low: Vector, high: Vector) -> Box:
    a, b = np.array(low), np.array(high)
    x, y, z = ((a + b) / 2).tolist()
    dx, dy, dz = (b - a).tolist()
    return Box(segment, (x, y, z), (dx, dy, dz))


def _mirrored(low: Vector, high: Vector, m: float) -> tuple[Vector, Vector]:
    """Extents mirrored in y, if m is -1."""
    if m > 0:
        return low, high
    return (low[0], -high[1], low[2]), (high[0], -low[1], high[2])


def _turned(low: Vector, high: Vector, sign: int) -> tuple[Vector, Vector]:
    """Extents turned by half a turn about y, if the sign is -1."""
    if sign > 0:
        return low, high
    return (-high[0], low[1], -high[2]), (-low[0], high[1], -low[2])


def _square(along: float, half: float) -> tuple[tuple[float, float], ...]:
    return tuple((along + u, v) for u in (-half, half) for v in (-half, half))
