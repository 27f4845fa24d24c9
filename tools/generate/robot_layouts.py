"""Layout of the drawings of robots.

Schematic: chosen so that the labels fit, not measured and not to scale. Lengths in px on the
sheet, y downward, relative to the middle of the neck.
"""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.robots import G1, H1

__all__ = ["LAYOUTS", "Limb", "RobotLayout"]

Point = tuple[float, float]


@dataclass(frozen=True)
class Limb:
    """An arm or a leg on the left; joints from the trunk outward.

    :param joints: their names without the side.
    :param places: of each joint, and last the end of the limb.
    """

    joints: tuple[str, ...]
    places: tuple[Point, ...]


@dataclass(frozen=True)
class RobotLayout:
    """One robot, seen from behind. The origin is the middle of the neck.

    :param limbs: on the left; the right ones are their mirror images.
    :param trunk: joints in the middle, from the legs upward, with their places.
    :param torso: y of its upper and lower edge, and half its width.
    :param bottom: y of the lowest line.
    """

    limbs: tuple[Limb, ...]
    trunk: tuple[tuple[str, Point], ...]
    torso: tuple[float, float, float]
    bottom: float


def _row(joints: tuple[str, ...], start: Point, step: Point, tip: float) -> Limb:
    (x, y), (dx, dy) = start, step
    steps = (*range(len(joints)), len(joints) - 1 + tip)
    return Limb(joints, tuple((x + k * dx, y + k * dy) for k in steps))


_H1 = RobotLayout(
    limbs=(
        _row(
            ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
            *((-84.0, 26.0), (-14.0, 48.0), 1.3),
        ),
        _row(
            ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle"),
            *((-40.0, 292.0), (-5.0, 46.0), 0.5),
        ),
    ),
    trunk=(("waist_yaw", (-46.0, 222.0)),),
    torso=(4.0, 270.0, 66.0),
    bottom=510.0,
)

_G1 = RobotLayout(
    limbs=(
        _row(
            (
                *("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow"),
                *("wrist_roll", "wrist_pitch", "wrist_yaw"),
            ),
            *((-84.0, 24.0), (-11.0, 35.0), 0.9),
        ),
        _row(
            ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll"),
            *((-40.0, 310.0), (-5.0, 38.0), 0.5),
        ),
    ),
    trunk=(
        ("waist_yaw", (-46.0, 240.0)),
        ("waist_roll", (-46.0, 202.0)),
        ("waist_pitch", (-46.0, 164.0)),
    ),
    torso=(4.0, 286.0, 66.0),
    bottom=530.0,
)

LAYOUTS = {model.name: layout for model, layout in ((H1, _H1), (G1, _G1))}
"""By the robot's name."""
