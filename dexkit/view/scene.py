"""Hands and robots in the scene: measured pose, commanded ghost, torque, pressure, faults."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import viser
from numpy.typing import NDArray

from dexkit.hand import Floats
from dexkit.kinematics import Skeleton, quaternions, rotation
from dexkit.view.drawing import BODY, CALM, GHOST, Colors, Drawing
from dexkit.watch import SubjectView

__all__ = ["Figure"]


class Figure:
    """One hand or robot in the scene.

    :param name: of its nodes, unique.
    :param place: where its base is, m.
    :param skeleton: None for that of its model.
    :param row: of the title below it; neighbours have different ones where they are narrow.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        view: SubjectView,
        title: str,
        place: tuple[float, float, float],
        skeleton: Skeleton | None = None,
        row: int = 0,
    ) -> None:
        self._drawing = Drawing(view, skeleton)
        self.skeleton = self._drawing.skeleton
        self._server = server
        scene = server.scene
        mount = quaternions(rotation(self.skeleton.mount)[None])[0]
        self._root = scene.add_frame(name, wxyz=mount, position=place, show_axes=False)
        vertices, faces = _rounded_box()
        count = len(self.skeleton.boxes)
        still = np.tile([1.0, 0.0, 0.0, 0.0], (max(count, 1), 1)).astype(np.float32)
        nowhere = np.zeros((max(count, 1), 3), np.float32)
        sizes = self.skeleton.sizes.astype(np.float32)
        self._bodies = scene.add_batched_meshes_simple(
            f"{name}/bodies",
            vertices,
            faces,
            still[:count],
            nowhere[:count],
            batched_scales=sizes,
            batched_colors=np.tile(BODY, (count, 1)).astype(np.uint8),
            lod="off",
        )
        self._ghost = scene.add_batched_meshes_simple(
            f"{name}/ghost",
            vertices,
            faces,
            still[:count],
            nowhere[:count],
            batched_scales=sizes * 1.04,
            batched_colors=GHOST,
            opacity=0.28,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        pins = self.skeleton.pins
        self._pins = scene.add_batched_meshes_simple(
            f"{name}/joints",
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (len(pins), 1)).astype(np.float32),
            np.zeros((len(pins), 3), np.float32),
            batched_scales=self._drawing.pin_sizes.astype(np.float32),
            batched_colors=np.tile(CALM, (len(pins), 1)).astype(np.uint8),
            lod="off",
            cast_shadow=False,
        )
        elements = len(self.skeleton.elements)
        self._elements = self._balls(f"{name}/elements", elements, 0.0045) if elements else None
        bottom = -0.85 if self._drawing.robot else -0.05 - 0.026 * row
        turn = mount * np.array([1.0, -1.0, -1.0, -1.0])  # labels are placed upright
        scene.add_frame(f"{name}/upright", wxyz=turn, show_axes=False)
        self._label = scene.add_label(
            f"{name}/upright/title", title, position=(0.0, 0.0, bottom), anchor="top-center"
        )
        self._fault = scene.add_label(
            f"{name}/upright/fault",
            "",
            position=(0.0, 0.0, 0.75 if self._drawing.robot else 0.215),
            anchor="bottom-center",
            visible=False,
        )
        self._title = title
        self._shown: dict[str, object] = {}

    def _balls(self, name: str, count: int, radius: float) -> viser.BatchedMeshHandle:
        vertices, faces = _ball()
        return self._server.scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)).astype(np.float32),
            np.zeros((count, 3), np.float32),
            batched_scales=np.full(count, radius, np.float32),
            batched_colors=np.tile(CALM, (count, 1)).astype(np.uint8),
            lod="off",
            cast_shadow=False,
        )

    def update(self, view: SubjectView) -> None:
        """Show another state; only changes are sent."""
        drawn = self._drawing.at(view)
        self._place(self._bodies, "bodies", drawn.bodies)
        if len(drawn.pins):
            self._place(self._pins, "pins", drawn.pins)
            self._color(self._pins, "pin colors", drawn.pin_colors)
        self._color(self._bodies, "body colors", drawn.body_colors)
        self._flag(self._ghost, "visible", drawn.ghost is not None)
        if drawn.ghost is not None:
            self._place(self._ghost, "ghost", drawn.ghost)
        if self._elements is not None:
            self._set(self._elements, "batched_positions", "elements", drawn.elements)
            self._color(self._elements, "element colors", drawn.element_colors)
        self._show_problems(view)

    def remove(self) -> None:
        """Take it off the scene."""
        self._root.remove()

    def _show_problems(self, view: SubjectView) -> None:
        faults = view.faults
        text = ""
        if view.stale:
            text = "no state" if not math.isfinite(view.age) else f"state {view.age:.1f} s old"
        elif faults:
            text = "; ".join(faults[:2]) + (f" and {len(faults) - 2} more" if faults[2:] else "")
        if self._shown.get("fault") != text:
            self._shown["fault"] = text
            self._fault.text = text
            self._fault.visible = bool(text)

    def _place(self, handle: viser.BatchedMeshHandle, what: str, frames: Floats) -> None:
        self._set(handle, "batched_positions", f"{what} places", frames[:, :3, 3])
        self._set(handle, "batched_wxyzs", f"{what} turns", quaternions(frames))

    def _set(self, handle: object, name: str, what: str, values: Floats) -> None:
        sent = values.astype(np.float32)
        before = self._shown.get(what)
        # a tenth of a millimetre, or of a thousandth of a turn, cannot be seen
        if isinstance(before, np.ndarray) and np.allclose(before, sent, rtol=0, atol=1e-4):
            return
        self._shown[what] = sent
        setattr(handle, name, sent)

    def _color(self, handle: object, what: str, colors: Colors) -> None:
        before = self._shown.get(what)
        if isinstance(before, np.ndarray) and np.array_equal(before, colors):
            return
        self._shown[what] = colors
        setattr(handle, "batched_colors", colors)  # noqa: B010 - a property of several handles

    def _flag(self, handle: viser.SceneNodeHandle, name: str, value: bool) -> None:
        if self._shown.get(name) != value:
            self._shown[name] = value
            handle.visible = value


@cache
def _rounded_box() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """A cube of side 1 around the origin with rounded edges."""
    steps, radius = 7, 0.2
    line = np.linspace(-0.5, 0.5, steps)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    vertices: list[Floats] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.empty((steps * steps, 3))
            points[:, axis] = 0.5 * sign
            points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = u, v
            inner = np.clip(points, -0.5 + radius, 0.5 - radius)
            away = points - inner
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            first = sum(len(part) for part in vertices)
            vertices.append(inner + radius * away)
            for i in range(steps - 1):
                for j in range(steps - 1):
                    a = first + i * steps + j
                    corners = [a, a + steps, a + steps + 1, a + 1]
                    if sign < 0:
                        corners.reverse()
                    faces += [[corners[0], corners[1], corners[2]],
                              [corners[0], corners[2], corners[3]]]  # fmt: skip
    return np.concatenate(vertices).astype(np.float32), np.array(faces, dtype=np.uint32)


@cache
def _ball() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """A ball of radius 1, made of a rounded box."""
    vertices, faces = _rounded_box()
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces
