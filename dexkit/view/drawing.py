"""Compute the drawing of a hand or robot at one time, for any library: frames and colours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dexkit.hand import Floats, Side
from dexkit.kinematics import Skeleton, rotation
from dexkit.pressure import STILL
from dexkit.robots import RobotModel
from dexkit.view.skeletons import skeleton_of
from dexkit.watch import SubjectView

__all__ = ["BODY", "CALM", "GHOST", "Colors", "Drawing", "Drawn", "places"]

Colors = NDArray[np.uint8]

BODY = np.array([151, 160, 170])
_STALE = np.array([222, 226, 230])
_NEAR = np.array([247, 163, 37])
_FAULT = np.array([224, 49, 49])
_WARM = np.array([247, 103, 7])
CALM = np.array([73, 80, 87])
GHOST = (51, 154, 240)
_COLD = np.array([233, 236, 239])
# from no change of pressure to the most that was seen
_PRESSURE = np.array([[208, 235, 255], [81, 207, 102], [252, 196, 25], [240, 62, 62]])

_LEAST_SCALE = 20 * STILL  # so that a light touch is not drawn as the most


@dataclass(frozen=True, eq=False)
class Drawn:
    """A moment; frames of shape (n, 4, 4) in the skeleton's own, m, and colours of shape (n, 3).

    :param bodies: of the skeleton's boxes; ``pins`` of its joints' axes.
    :param ghost: the boxes where the command wants them; None where no joint is driven.
    :param elements: places of the sensor elements, m, shape (n, 3).
    """

    bodies: Floats
    body_colors: Colors
    pins: Floats
    pin_colors: Colors
    ghost: Floats | None
    elements: Floats
    element_colors: Colors


class Drawing:
    """Draws one hand or robot.

    :param skeleton: None for that of its model.
    """

    def __init__(self, view: SubjectView, skeleton: Skeleton | None = None) -> None:
        self.robot = isinstance(view.model, RobotModel)
        side = view.subject if isinstance(view.subject, Side) else None
        self.skeleton = skeleton or skeleton_of(view.model, side)
        self._pin_joints = np.array([p.joint for p in self.skeleton.pins], dtype=int)
        self._most_pressure = _LEAST_SCALE

    @property
    def pin_sizes(self) -> Floats:
        """Sizes of the joints' axes, m, shape (n, 3)."""
        thick = 0.045 if self.robot else 0.0105
        rows = [(p.length, thick, thick) for p in self.skeleton.pins]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def root(self, place: tuple[float, float, float]) -> Floats:
        """The frame of the skeleton in the scene, shape (4, 4)."""
        frame = np.eye(4)
        frame[:3, :3] = rotation(self.skeleton.mount)
        frame[:3, 3] = place
        return frame

    def at(self, view: SubjectView) -> Drawn:
        """The drawing of this state."""
        poses = self.skeleton.poses(_drawn_q(view, view.q))
        driven, ghost = np.isfinite(view.target), None
        if driven.any():
            target = _drawn_q(view, np.where(driven, view.target, view.q))
            ghost = self.skeleton.box_poses(self.skeleton.poses(target))
        return Drawn(
            bodies=self.skeleton.box_poses(poses),
            body_colors=self._body_colors(view),
            pins=self.skeleton.pin_poses(poses),
            pin_colors=_torque_colors(view)[self._pin_joints],
            ghost=ghost,
            elements=self.skeleton.element_places(poses),
            element_colors=self._pressure_colors(view),
        )

    def _body_colors(self, view: SubjectView) -> Colors:
        joints = [
            None if b.segment < 0 else self.skeleton.segments[b.segment].joint
            for b in self.skeleton.boxes
        ]
        base = _STALE if view.stale else BODY
        out = np.tile(base, (len(joints), 1))
        for i, joint in enumerate(joints):
            if joint is None or view.stale:
                continue
            if view.fault[joint]:
                out[i] = _FAULT
            elif view.near[joint]:
                out[i] = _NEAR
            elif not len(self._pin_joints):  # a gripper's jaws show its torque
                out[i] = base + (_WARM - base) * float(view.torque_part[joint])
        return out.astype(np.uint8)

    def _pressure_colors(self, view: SubjectView) -> Colors:
        values = np.abs(np.nan_to_num(view.pressure_change))
        count = len(self.skeleton.elements)
        if len(values) != count:
            return np.tile(_COLD, (count, 1)).astype(np.uint8)
        self._most_pressure = max(self._most_pressure, float(values.max(initial=0.0)))
        part = np.clip(values / self._most_pressure, 0.0, 1.0) * (len(_PRESSURE) - 1)
        low = np.minimum(part.astype(int), len(_PRESSURE) - 2)
        mix = (part - low)[:, None]
        colors = _PRESSURE[low] * (1 - mix) + _PRESSURE[low + 1] * mix
        return np.where(values[:, None] > STILL, colors, _COLD).astype(np.uint8)


def _drawn_q(view: SubjectView, q: Floats) -> Floats:
    """Q in the radians of the model's skeleton, which a gripper's dialects may scale."""
    if isinstance(view.model, RobotModel) or not isinstance(view.subject, Side):
        return q
    own = view.model.joints[view.subject]
    scale = np.array(
        [mine.stroke / told.stroke for mine, told in zip(own, view.joints, strict=True)]
    )
    return np.asarray(q * scale)


def _torque_colors(view: SubjectView) -> Colors:
    part = view.torque_part[:, None]
    warm = np.where(part < 0.5, CALM + (_NEAR - CALM) * part * 2,
                    _NEAR + (_FAULT - _NEAR) * (part * 2 - 1))  # fmt: skip
    return np.asarray(warm, dtype=np.uint8)


def places(count: int, robots: Mapping[int, bool]) -> list[tuple[float, float, float]]:
    """Positions of the figures: hands in a row, robots behind them.

    :param robots: whether each is a robot.
    """
    hands = [i for i in range(count) if not robots[i]]
    out = []
    for i in range(count):
        if robots[i]:
            out.append((0.0, 2.2, 0.72))
        else:
            out.append(((hands.index(i) - (len(hands) - 1) / 2) * 0.22, 0.0, 0.0))
    return out
