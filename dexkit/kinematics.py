"""Forward kinematics of a hand or a robot: where its links are for given joint positions.

Lengths in m, angles in rad, right-handed frames; a rotation by (roll, pitch, yaw) turns about x,
then y, then z of the fixed frame, as in URDF.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dexkit.errors import UsageError
from dexkit.hand import Floats

__all__ = [
    "BASE",
    "Box",
    "Element",
    "Pin",
    "Segment",
    "Skeleton",
    "quaternions",
    "rotation",
    "turned_to",
]

Vector = tuple[float, float, float]

BASE = -1
"""Index of the link that does not move: the palm, or the pelvis."""


@dataclass(frozen=True)
class Segment:
    """A link and the joint that moves it relative to its parent.

    :param parent: index of the parent, which comes before this one; :data:`BASE` for the base.
    :param origin: of its frame in the parent's frame; ``rpy`` its rotation there.
    :param axis: of the joint, in its own frame; a unit vector.
    :param joint: index of the joint in q; None if it is fixed.
    :param prismatic: whether the joint slides.
    :param factor: motion, rad or m, of one unit of q; ``offset`` that at q = 0.
    """

    name: str
    parent: int
    origin: Vector
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    joint: int | None = None
    prismatic: bool = False
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Box:
    """The drawn body of a link: a box that is fixed to a segment, or to the base.

    :param centre: in the segment's frame.
    :param size: along x, y and z of its own frame.
    :param along: direction of its own x in the segment's frame.
    """

    segment: int
    centre: Vector
    size: Vector
    along: Vector = (1.0, 0.0, 0.0)

    @classmethod
    def between(cls, segment: int, low: Vector, high: Vector) -> Box:
        """The box between two opposite corners, in the segment's frame."""
        a, b = np.array(low), np.array(high)
        x, y, z = ((a + b) / 2).tolist()
        dx, dy, dz = (b - a).tolist()
        return cls(segment, (x, y, z), (dx, dy, dz))


@dataclass(frozen=True)
class Element:
    """One element of a pressure sensor: a point that is fixed to a segment."""

    segment: int
    place: Vector


@dataclass(frozen=True)
class Pin:
    """The drawn axis of a joint, in the middle of a segment's origin.

    :param length: along the axis.
    """

    segment: int
    joint: int
    length: float


@dataclass(frozen=True)
class Skeleton:
    """A tree of links with their drawn shapes.

    :param segments: parents before children.
    :param elements: in the order of the model's sensors and their slots.
    :param mount: rpy of the base where it is drawn: fingers upward (z), the palm toward -y.
    :param schematic: whether lengths and axes are not those of the device.
    :param note: what the drawing does not show truly, or empty.
    """

    segments: tuple[Segment, ...]
    boxes: tuple[Box, ...]
    elements: tuple[Element, ...] = ()
    mount: Vector = (0.0, 0.0, 0.0)
    schematic: bool = False
    note: str = ""

    def __post_init__(self) -> None:
        for i, segment in enumerate(self.segments):
            if not BASE <= segment.parent < i:
                raise UsageError(f"link {segment.name} comes before its parent")
            if not math.isclose(sum(c * c for c in segment.axis), 1.0, abs_tol=1e-6):
                raise UsageError(f"the axis of {segment.name} is not of length 1")
        for link in (*(b.segment for b in self.boxes), *(e.segment for e in self.elements)):
            if not BASE <= link < len(self.segments):
                raise UsageError(f"a part of link {link}, which is not there")

    @cached_property
    def joints(self) -> int:
        """Joints that are needed in q."""
        return 1 + max((s.joint for s in self.segments if s.joint is not None), default=-1)

    @cached_property
    def _fixed(self) -> list[Floats]:
        return [_frame(rotation(s.rpy), s.origin) for s in self.segments]

    def poses(self, q: Sequence[float] | Floats) -> Floats:
        """The frames of all segments in that of the base, shape (n_segments + 1, 4, 4).

        The last one is the base's, so that :data:`BASE` finds it. A position that is not finite
        counts as 0.

        :raises UsageError: too few joints.
        """
        if len(q) < self.joints:
            raise UsageError(f"{len(q)} joint positions, {self.joints} are needed")
        out = np.empty((len(self.segments) + 1, 4, 4))
        out[-1] = np.eye(4)
        for i, (segment, fixed) in enumerate(zip(self.segments, self._fixed, strict=True)):
            here = out[segment.parent] @ fixed
            if segment.joint is not None:
                value = float(q[segment.joint])
                motion = segment.factor * (value if math.isfinite(value) else 0.0) + segment.offset
                if segment.prismatic:
                    here[:3, 3] += here[:3, :3] @ (motion * np.array(segment.axis))
                else:
                    here[:3, :3] = here[:3, :3] @ _about(segment.axis, motion)
            out[i] = here
        return out

    @cached_property
    def _box_frames(self) -> tuple[list[int], Floats]:
        frames = [_frame(turned_to(b.along), b.centre) for b in self.boxes]
        return [b.segment for b in self.boxes], np.array(frames).reshape(-1, 4, 4)

    @cached_property
    def sizes(self) -> Floats:
        """Sizes of the boxes, shape (n_boxes, 3)."""
        return np.array([b.size for b in self.boxes]).reshape(-1, 3)

    def box_poses(self, poses: Floats) -> Floats:
        """The frames of the boxes for :meth:`poses`, shape (n_boxes, 4, 4)."""
        segments, frames = self._box_frames
        return np.asarray(poses[segments] @ frames)

    @cached_property
    def _element_places(self) -> tuple[list[int], Floats]:
        places = np.array([(*e.place, 1.0) for e in self.elements]).reshape(-1, 4, 1)
        return [e.segment for e in self.elements], places

    def element_places(self, poses: Floats) -> Floats:
        """Positions of the sensor elements for :meth:`poses`, shape (n_elements, 3)."""
        segments, places = self._element_places
        return np.asarray((poses[segments] @ places)[:, :3, 0])

    @cached_property
    def pins(self) -> tuple[Pin, ...]:
        """A pin along the axis of each segment that turns, which shows beside its body."""
        out = []
        for i, segment in enumerate(self.segments):
            if segment.joint is None or segment.prismatic:
                continue
            turn = turned_to(segment.axis)
            widths = [
                float(np.abs(turn[:, 0] @ (turned_to(b.along) * np.array(b.size))).sum())
                for b in self.boxes
                if b.segment == i
            ]
            out.append(Pin(i, segment.joint, max(widths, default=0.012) + 0.005))
        return tuple(out)

    @cached_property
    def _pin_frames(self) -> tuple[list[int], Floats]:
        frames = [_frame(turned_to(self.segments[p.segment].axis), (0.0,) * 3) for p in self.pins]
        return [p.segment for p in self.pins], np.array(frames).reshape(-1, 4, 4)

    def pin_poses(self, poses: Floats) -> Floats:
        """The frames of the pins for :meth:`poses`, along x, shape (n_pins, 4, 4)."""
        segments, frames = self._pin_frames
        return np.asarray(poses[segments] @ frames)


def rotation(rpy: Vector) -> Floats:
    """The matrix of a rotation by roll, pitch and yaw, shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def turned_to(direction: Vector) -> Floats:
    """A rotation that turns x to ``direction``, by the shortest way, shape (3, 3).

    :raises UsageError: the direction has no length.
    """
    length = math.sqrt(sum(c * c for c in direction))
    if not length > 0:
        raise UsageError("a direction has no length")
    x, y, z = (c / length for c in direction)
    angle = math.acos(max(-1.0, min(1.0, x)))
    across = math.hypot(y, z)
    if across < 1e-9:
        return np.eye(3) if x > 0 else np.diag([-1.0, -1.0, 1.0])
    return _about((0.0, -z / across, y / across), angle)


def quaternions(frames: Floats) -> Floats:
    """The rotations of frames, shape (n, 4, 4) or (n, 3, 3), as w x y z, shape (n, 4)."""
    m = frames[:, :3, :3]
    # four times the square of each component; the largest is safe to divide by
    squares = 1 + np.stack(
        [
            m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            m[:, 1, 1] - m[:, 0, 0] - m[:, 2, 2],
            m[:, 2, 2] - m[:, 0, 0] - m[:, 1, 1],
        ],
        axis=1,
    )
    a, b, c = (m[:, i, j] - m[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (m[:, i, j] + m[:, j, i] for i, j in ((1, 0), (0, 2), (2, 1)))
    w, x, y, z = squares.T
    rows = np.stack(
        [
            np.stack([w, a, b, c], axis=1),
            np.stack([a, x, d, e], axis=1),
            np.stack([b, d, y, f], axis=1),
            np.stack([c, e, f, z], axis=1),
        ],
        axis=1,
    )
    chosen = rows[np.arange(len(m)), np.argmax(squares, axis=1)]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))


def _about(axis: Vector, angle: float) -> Floats:
    x, y, z = axis
    c, s = math.cos(angle), math.sin(angle)
    k = 1 - c
    return np.array(
        [
            [c + x * x * k, x * y * k - z * s, x * z * k + y * s],
            [y * x * k + z * s, c + y * y * k, y * z * k - x * s],
            [z * x * k - y * s, z * y * k + x * s, c + z * z * k],
        ]
    )


def _frame(turn: Floats, origin: Vector) -> Floats:
    out = np.eye(4)
    out[:3, :3] = turn
    out[:3, 3] = origin
    return out
