"""The skeleton of each model: joint axes and origins, and the boxes that are drawn.

A hand whose axes are not known, such as that of another package, gets a schematic one;
``dexkit view --urdf`` draws it as its URDF says.
"""

from __future__ import annotations

from itertools import groupby

from dexkit.hand import JointSpec, Side
from dexkit.kinematics import BASE, Box, Segment, Skeleton, Vector
from dexkit.models import DEX1_1, DEX3_1, DEX5_1, HandModel
from dexkit.robots import G1, H1, RobotModel
from dexkit.view import hand_skeletons, robot_skeletons

__all__ = ["schematic", "skeleton_of"]

_HANDS = {
    model.name: made
    for model, made in (
        (DEX1_1, hand_skeletons.dex1),
        (DEX3_1, hand_skeletons.dex3),
        (DEX5_1, hand_skeletons.dex5),
    )
}
_ROBOTS = {model.name: made for model, made in ((H1, robot_skeletons.h1), (G1, robot_skeletons.g1))}


def skeleton_of(model: HandModel | RobotModel, side: Side | None = None) -> Skeleton:
    """The skeleton of a hand or a robot.

    :param side: of a hand; None for a robot.
    """
    if isinstance(model, RobotModel):
        return _ROBOTS[model.name]()
    assert side is not None
    made = _HANDS.get(model.name)
    return made(side) if made else schematic(model, side)


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
    joints = model.joints[Side.LEFT]
    return [list(group) for _, group in groupby(range(len(joints)), lambda i: joints[i].finger)]


def _swing(joint: JointSpec) -> Vector:
    return (float(joint.closing), 0.0, 0.0) if joint.closing else (0.0, 1.0, 0.0)
