"""Hands for other people's viewers: the same figures and numbers, 30 times a second."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dexkit.hand import ROBOT, Floats
from dexkit.kinematics import Skeleton
from dexkit.view.drawing import Drawing, Drawn, places
from dexkit.view.sources import Source
from dexkit.watch import Picture, SubjectView

__all__ = ["RATE", "Moment", "Viewer", "forward"]

RATE = 30.0
"""Pictures a second."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One hand or robot at a moment.

    :param name: a path that is its own: ``left_hand``, or ``run.mcap/left_hand`` of two sources.
    :param root: the frame of its base in the scene, shape (4, 4), m.
    :param sizes: of its boxes, m, shape (n, 3); ``pin_sizes`` of its joints' axes.
    """

    name: str
    view: SubjectView
    drawn: Drawn
    root: Floats
    sizes: Floats
    pin_sizes: Floats

    def placed(self, frames: Floats) -> Floats:
        """Frames of the skeleton, shape (n, 4, 4), in the scene."""
        return np.asarray(self.root @ frames)

    def numbers(self) -> dict[str, dict[str, float]]:
        """Values by field and joint, in the dialect's units, without NaN."""
        view = self.view
        fields = {"q": view.q, "target": view.target, "dq": view.dq, "tau_est": view.tau}
        return {
            field: {
                joint.name: float(value)
                for joint, value in zip(view.joints, values, strict=True)
                if np.isfinite(value)
            }
            for field, values in fields.items()
        }


class Viewer(Protocol):
    """Somebody else's viewer."""

    def show(self, time_ns: int, moments: Sequence[Moment]) -> None:
        """Show the state of a time, ns since the epoch."""
        ...


class _Scene:
    """The figures of all sources, each with its place."""

    def __init__(self, sources: Sequence[Source], skeletons: Mapping[tuple[str, str], Skeleton]):
        self._prefixes = [f"{s.title}/" if len(sources) > 1 else "" for s in sources]
        self._skeletons = skeletons
        self._drawings: dict[str, Drawing] = {}

    def moments(self, pictures: Sequence[Picture]) -> list[Moment]:
        named = [
            (f"{prefix}{_name(view, picture)}", view)
            for prefix, picture in zip(self._prefixes, pictures, strict=True)
            for view in picture.subjects
        ]
        for name, view in named:
            if name not in self._drawings:
                skeleton = self._skeletons.get((view.model.name, str(view.subject)))
                self._drawings[name] = Drawing(view, skeleton)
        drawings = [self._drawings[name] for name, _ in named]
        spots = places(len(named), {i: d.robot for i, d in enumerate(drawings)})
        return [
            Moment(name, view, d.at(view), d.root(spot), d.skeleton.sizes, d.pin_sizes)
            for (name, view), d, spot in zip(named, drawings, spots, strict=True)
        ]


def _name(view: SubjectView, picture: Picture) -> str:
    name = view.model.name if view.subject == ROBOT else f"{view.subject}_hand"
    if view.prefix:
        name = f"{view.prefix}/{name}"
    alike = [v for v in picture.subjects if (v.subject, v.prefix) == (view.subject, view.prefix)]
    return f"{name}_{view.dialect}" if len(alike) > 1 else name


def forward(
    sources: Sequence[Source],
    viewer: Viewer,
    stop: threading.Event,
    *,
    skeletons: Mapping[tuple[str, str], Skeleton] | None = None,
    paced: bool = True,
    progress: Callable[[float, float], None] = lambda at, end: None,
) -> None:
    """Show sources until ``stop`` is set, or a recording ends.

    :param paced: recordings at their own pace; False: as fast as they can be written.
    :param progress: called with seconds done and in all, of recordings.
    """
    scene = _Scene(sources, skeletons or {})
    live = any(s.live for s in sources)
    begin, frame = time.monotonic(), 0
    while not stop.is_set():
        ends = [s.poll() for s in sources]
        played = frame / RATE
        moments = [
            s.collector.picture(end if s.live else min(played, end))
            for s, end in zip(sources, ends, strict=True)
        ]
        at = ends[0] if sources[0].live else min(played, ends[0])
        origin = sources[0].collector.origin_ns
        viewer.show(origin + round(at * 1e9) if origin else time.time_ns(), scene.moments(moments))
        if not live:
            progress(min(played, max(ends)), max(ends))
            if played >= max(ends):
                return
        frame += 1
        if paced or live:
            stop.wait(max(0.0, begin + frame / RATE - time.monotonic()))
