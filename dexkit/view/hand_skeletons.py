"""Skeletons of hands: joint axes and origins, and the boxes that are drawn.

Origins and axes are those of Unitree's URDFs (docs/sources/unitree-dex.md#i1).
The boxes have the extents of the meshes that the URDFs name, rounded
(docs/sources/unitree-dex.md#i2); the meshes themselves are not used. Places of pressure sensor
elements are schematic (docs/sources/unitree-dex.md#i3).
"""

from __future__ import annotations

import math
from functools import cache

from dexkit.hand import Side
from dexkit.kinematics import BASE, Box, Element, Segment, Skeleton, Vector

__all__ = ["dex1", "dex3", "dex5"]

_RIGHT = math.pi / 2


@cache
def dex1(side: Side) -> Skeleton:
    """Two jaws that slide; both sides are alike.

    In the URDF a jaw slides from 0.0245 m, where the jaws touch, to -0.02 m. That q is in
    proportion is derived: 5.4 rad are 9 cm (docs/sources/unitree-dex.md#b3).
    """
    touching, stroke = 0.0245, 0.0445 / 5.4
    segments, boxes = [], [Box.between(BASE, (-0.035, 0.0, -0.035), (0.035, 0.074, 0.035))]
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
            boxes.append(Box.between(here, *_turned(low, high, sign)))
    return Skeleton(tuple(segments), tuple(boxes), mount=(_RIGHT, 0.0, 0.0))


def _turned(low: Vector, high: Vector, sign: int) -> tuple[Vector, Vector]:
    """Extents turned by half a turn about y, if the sign is -1."""
    if sign > 0:
        return low, high
    return (-high[0], low[1], -high[2]), (-low[0], high[1], -low[2])


@cache
def dex3(side: Side) -> Skeleton:
    """A thumb of three joints, then two fingers of two."""
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


@cache
def dex5(side: Side) -> Skeleton:
    """Four fingers of four joints, then the thumb."""
    left = side is Side.LEFT
    m = 1.0 if left else -1.0
    segments: list[Segment] = []
    boxes = [
        # narrower than the mesh, which has the thumb's mount as well
        Box.between(BASE, (-0.07, -0.0398, -0.012 if left else -0.028),
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
            Box.between(n + 1, (-0.0044, -0.0145, -0.0082), (0.0471, 0.0058, 0.0082)),
            Box.between(n + 2, (-0.0025, -0.0125, -0.008), (0.0242, 0.005, 0.0082)),
            Box.between(n + 3, (-0.0029, -0.0125, -0.0082), (0.029, 0.0051, 0.0082)),
        ]
    n = len(segments)
    segments += [
        Segment("Yaw_11", BASE, (0.0, 0.0, -m * 0.01435), joint=n),
        Segment("Roll_12", n, (-0.0000106, 0.0, 0.0), (_RIGHT, 0.0, 0.0), joint=n + 1),
        Segment("Pitch_13", n + 1, (0.0335, 0.0, -0.006), (-_RIGHT, 0.0, 0.0), joint=n + 2),
        Segment("Pitch_14", n + 2, (0.036609, -0.0053654, 0.0), joint=n + 3),
    ]
    boxes += [
        Box.between(n + 1, (-0.0085, -0.0165, -0.0165), (0.0415, 0.0165, 0.0165)),
        Box.between(n + 2, (-0.0132, -0.0245, -0.0145), (0.0476, 0.0097, 0.0145)),
        Box.between(n + 3, (-0.008, -0.0088, -0.0133), (0.0589, 0.015, 0.0135)),
    ]
    mount = (_RIGHT, 0.0, math.pi) if left else (_RIGHT, 0.0, 0.0)
    return Skeleton(
        tuple(segments),
        tuple(boxes),
        mount=mount,
        note="the palm's and the fingers' backs are simplified",
    )
