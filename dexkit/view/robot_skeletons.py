"""Skeletons of the robots: joint axes and origins of Unitree's URDFs
(docs/sources/unitree-dex.md#i1). Bodies are schematic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

from dexkit.kinematics import BASE, Box, Segment, Skeleton, Vector
from dexkit.robots import G1, H1, RobotModel

__all__ = ["g1", "h1"]

_RIGHT = math.pi / 2

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
