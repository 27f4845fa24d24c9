"""Where the drawings put joints and sensors.

Schematic: chosen so that the labels find room, not measured and not to scale. Names, limits and
directions come from :mod:`dexkit.models` and :mod:`dexkit.robots`; only places are here. Lengths
in px on the sheet, y downward, relative to the centre of a hand or robot; hands are left hands,
the right one is their mirror image.
"""

from __future__ import annotations

from dataclasses import dataclass

from tools.generate.svg_sheet import Point

__all__ = ["HANDS", "ROBOTS", "Finger", "HandLayout", "Limb", "RobotLayout"]


@dataclass(frozen=True)
class Finger:
    """Joints one behind the other.

    :param name: what it is called; sensor packets are found by it (``"thumb pad"``).
    :param joints: their indices, from the palm outward.
    :param start: place of the first joint.
    :param step: from one joint to the next.
    :param tip: from the last joint to the end, in steps.
    :param root: from its beginning, which the palm may hide, to the first joint, in steps.
    """

    name: str
    joints: range
    start: Point
    step: Point
    tip: float
    root: float = 0.4

    def along(self, steps: float) -> Point:
        """The place so many steps behind the first joint."""
        (x, y), (dx, dy) = self.start, self.step
        return x + steps * dx, y + steps * dy

    @property
    def end(self) -> Point:
        """Where it ends."""
        return self.along(len(self.joints) - 1 + self.tip)


@dataclass(frozen=True)
class HandLayout:
    """One hand model.

    :param centres: x of the left and of the right hand.
    :param top: y of the palm's centre on the sheet.
    :param palm: its size.
    :param width: of a finger.
    :param fingers: of a left hand, the palm toward the reader.
    :param palm_sensors: where the palm's sensor packets are.
    """

    centres: tuple[float, float]
    top: float
    palm: Point
    width: float
    fingers: tuple[Finger, ...]
    palm_sensors: tuple[Point, ...] = ()


HANDS: dict[str, HandLayout] = {
    "dex3-1": HandLayout(
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
    "dex5-1": HandLayout(
        centres=(240.0, 640.0),
        top=466.0,
        palm=(280.0, 130.0),
        width=62.0,
        fingers=(
            Finger("index", range(0, 4), (-108.0, -90.0), (0.0, -66.0), tip=0.15),
            Finger("middle", range(4, 8), (-36.0, -106.0), (0.0, -66.0), tip=0.15, root=0.7),
            Finger("ring", range(8, 12), (36.0, -90.0), (0.0, -66.0), tip=0.15),
            Finger("little", range(12, 16), (108.0, -66.0), (0.0, -66.0), tip=0.15),
            Finger("thumb", range(16, 20), (-167.0, 26.0), (-9.0, -66.0), tip=0.15, root=0.1),
        ),
    ),
}
"""By model name; a gripper of one joint is drawn as such and needs none."""


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


ROBOTS: dict[str, RobotLayout] = {
    "h1": RobotLayout(
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
    ),
    "g1": RobotLayout(
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
    ),
}
"""By robot name."""
