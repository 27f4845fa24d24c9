"""Hands for Foxglove: a WebSocket server with a scene and numbers. Needs the extra ``foxglove``."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from dexkit.errors import ExtraMissing, UsageError
from dexkit.hand import Floats
from dexkit.kinematics import quaternions
from dexkit.view.drawing import GHOST, Colors
from dexkit.view.forward import Moment
from dexkit.view.guarded_server import GuardedPort
from dexkit.view.web_origins import Allowed

try:
    import foxglove
    from foxglove import messages as fg
    from foxglove.channels import SceneUpdateChannel
except ImportError as error:
    raise ExtraMissing(
        "--foxglove needs the package foxglove-sdk", hint="pip install 'dexkit[foxglove]'"
    ) from error

__all__ = ["DEFAULT_PORT", "ORIGINS", "SCENE", "FoxgloveViewer", "numbers_topic"]

DEFAULT_PORT = 8765  # the one that Foxglove proposes
SCENE = "/dexkit/scene"
ORIGINS = ("https://app.foxglove.dev", "https://studio.foxglove.dev")
"""Foxglove in a browser: its pages may connect."""


def numbers_topic(name: str) -> str:
    """The topic with the numbers of a hand or robot."""
    return f"/dexkit/{name}"


class FoxgloveViewer:
    """A server that Foxglove connects to.

    :param port: 0 for any.
    :param origins: of web pages that may connect, beside :data:`ORIGINS`.
    :raises UsageError: the port is taken, or other web pages cannot be kept out.
    """

    def __init__(self, host: str, port: int, origins: Sequence[str] = ()) -> None:
        self._context = foxglove.Context()
        allowed = Allowed(host, (*ORIGINS, *origins))
        with contextlib.ExitStack() as stack:
            self._guard = stack.enter_context(GuardedPort(host, range(port, port + 1), allowed))
            hidden = self._guard.hidden
            try:
                self._server = foxglove.start_server(
                    name="dexkit", host=hidden.host, port=hidden.port, context=self._context
                )
            except (OSError, RuntimeError) as error:
                raise UsageError(f"the server of Foxglove's SDK does not start: {error}") from error
            stack.callback(self._server.stop)
            self._guard.open()
            stack.pop_all()
        self.host, self.port = host, self._guard.port
        self._scene = SceneUpdateChannel(SCENE, context=self._context)
        self._channels: dict[str, foxglove.Channel] = {}

    @property
    def url(self) -> str:
        """URL for Foxglove."""
        return f"ws://{self._guard.authority}"

    def close(self) -> None:
        """End the server."""
        self._guard.close()
        self._server.stop()

    def show(self, time_ns: int, moments: Sequence[Moment]) -> None:
        """Send a moment to every connected client."""
        stamp = fg.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
        entities = [self._entity(m, stamp) for m in moments]
        self._scene.log(fg.SceneUpdate(entities=entities), log_time=time_ns)
        for moment in moments:
            channel = self._channels.get(moment.name)
            if channel is None:
                channel = foxglove.Channel(
                    numbers_topic(moment.name),
                    schema={"type": "object"},
                    message_encoding="json",
                    context=self._context,
                )
                self._channels[moment.name] = channel
            channel.log(_numbers(moment), log_time=time_ns)

    def _entity(self, moment: Moment, stamp: fg.Timestamp) -> fg.SceneEntity:
        drawn = moment.drawn
        cubes = [
            *_cubes(moment.placed(drawn.bodies), moment.sizes, drawn.body_colors),
            *_cubes(moment.placed(drawn.pins), moment.pin_sizes, drawn.pin_colors),
        ]
        if drawn.ghost is not None:
            color = np.tile(np.array(GHOST, dtype=np.uint8), (len(drawn.ghost), 1))
            ghost = moment.placed(drawn.ghost)
            cubes += _cubes(ghost, moment.sizes * 1.04, color, alpha=0.28)
        frames = np.tile(np.eye(4), (len(drawn.elements), 1, 1))
        frames[:, :3, 3] = drawn.elements
        spheres = [
            fg.SpherePrimitive(
                pose=pose, size=fg.Vector3(x=0.009, y=0.009, z=0.009), color=_color(color)
            )
            for pose, color in zip(_poses(moment.placed(frames)), drawn.element_colors, strict=True)
        ]
        return fg.SceneEntity(
            timestamp=stamp, frame_id="dexkit", id=moment.name, cubes=cubes, spheres=spheres
        )


def _numbers(moment: Moment) -> dict[str, Any]:
    view = moment.view
    return {
        **moment.numbers(),
        "pressure": [float(p) if math.isfinite(p) else None for p in view.pressure],
        "pressure_change": [float(p) if math.isfinite(p) else None for p in view.pressure_change],
        "faults": view.faults,
        "state_age": view.age if math.isfinite(view.age) else None,
        "command_age": view.command_age if math.isfinite(view.command_age) else None,
    }


def _poses(frames: Floats) -> list[fg.Pose]:
    return [
        fg.Pose(
            position=fg.Vector3(x=float(x), y=float(y), z=float(z)),
            orientation=fg.Quaternion(w=float(w), x=float(i), y=float(j), z=float(k)),
        )
        for (x, y, z), (w, i, j, k) in zip(frames[:, :3, 3], quaternions(frames), strict=True)
    ]


def _color(color: Iterable[int], alpha: float = 1.0) -> fg.Color:
    r, g, b = (int(c) / 255 for c in color)
    return fg.Color(r=r, g=g, b=b, a=alpha)


def _cubes(
    frames: Floats, sizes: Floats, colors: Colors, alpha: float = 1.0
) -> list[fg.CubePrimitive]:
    if not len(frames):
        return []
    return [
        fg.CubePrimitive(
            pose=pose,
            size=fg.Vector3(x=float(size[0]), y=float(size[1]), z=float(size[2])),
            color=_color(color, alpha),
        )
        for pose, size, color in zip(_poses(frames), sizes, colors, strict=True)
    ]
