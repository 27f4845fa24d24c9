"""The data of one episode as the checks see it, whatever file it came from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from dexkit.hand import Floats, JointSpec, Side
from dexkit.models import HandModel
from dexkit.traces.sessions.model import Camera
from dexkit.traces.sessions.streams import HAND

__all__ = ["Episode", "Gap", "Track"]

_LIMBS = (
    *("arm", "shoulder", "elbow", "wrist", "waist", "torso", "body", "leg", "hip", "knee", "ankle"),
    *("head", "neck"),
)
"""Parts of words in the names of joints of arms and bodies."""


@dataclass(frozen=True, eq=False)
class Track:
    """A hand, an arm or another group of joints over the frames of an episode.

    :param part: ``left_hand``, ``right_arm``, ``robot``.
    :param joints: names, in the order of the columns.
    :param state: observed positions, shape (frames, joints), NaN where a frame has none; None
        where the episode has no observation of this part.
    :param action: commanded positions, likewise.
    :param dq: observed velocities, likewise; ``tau`` torques or currents.
    :param touch: pressures of the hand's sensors, shape (frames, elements).
    :param model: the hand's; None for a group that has no profile.
    """

    part: str
    joints: tuple[str, ...]
    state: Floats | None = None
    action: Floats | None = None
    dq: Floats | None = None
    tau: Floats | None = None
    touch: Floats | None = None
    model: HandModel | None = None

    @cached_property
    def limits(self) -> tuple[Floats, Floats] | None:
        """Lowest and highest position of each joint, shape (joints,) each; None if not known."""
        specs = self._specs
        if specs is None:
            return None
        return np.array([s.q_min for s in specs]), np.array([s.q_max for s in specs])

    @cached_property
    def fastest(self) -> Floats | None:
        """The highest speed of each joint, unit/s, shape (joints,); None if not known."""
        specs = self._specs
        return None if specs is None else np.array([s.dq_max for s in specs])

    @cached_property
    def is_hand(self) -> bool:
        """Whether it is a hand or a gripper, or may be one: nothing in its names says otherwise.

        An object may stop it.
        """
        if self.model is not None or self.part.endswith(HAND):
            return True
        words = re.findall(r"[a-z]+", " ".join((self.part, *self.joints)).lower())
        return not any(limb in word for word in words for limb in _LIMBS)

    @property
    def closing(self) -> Floats | None:
        """Sign of the motion that closes each joint, 0 where neither does; None if not known."""
        specs = self._specs
        return None if specs is None else np.array([float(s.closing) for s in specs])

    @property
    def _specs(self) -> tuple[JointSpec, ...] | None:
        if self.model is None:
            return None
        return self.model.joints[Side(self.part.removesuffix(HAND))]


@dataclass(frozen=True)
class Gap:
    """A stretch of time in which a source has no frame, or no message of a topic.

    :param begin_s: seconds after the start of the episode; likewise ``end_s``.
    :param what: what is missing: ``frames``, or a topic.
    """

    begin_s: float
    end_s: float
    what: str = "frames"


@dataclass(eq=False)
class Episode:
    """One episode.

    :param name: how reports call it.
    :param form: the format with its version: ``LeRobot v3.0``.
    :param fps: frames per second that the source states.
    :param t: time of each frame after the first, s, by its number and ``fps``, or as it was
        measured; strictly ascending, shape (frames,).
    :param measured: whether ``t`` was measured.
    :param stamps: the times that the source states for its frames, s, shape (frames,), as they
        are; None without.
    :param numbers: the frames' own numbers, shape (frames,); None without.
    :param gaps: stretches that the source lacks.
    :param tasks: texts; None where the format has none.
    :param stated: statistics that the metadata state for this episode: by feature and name
        (``min``, ``max``, ``mean``, ``std``), shape (elements,).
    :param features: by feature, the values that ``stated`` is about, shape (frames, elements).
    :param cameras: with paths relative to ``folder``.
    :param problems: what could not be read, as sentences.
    """

    name: str
    form: str
    fps: float
    t: Floats
    tracks: list[Track]
    measured: bool = False
    stamps: Floats | None = None
    numbers: Floats | None = None
    gaps: list[Gap] = field(default_factory=list)
    tasks: Sequence[str] | None = None
    stated: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    features: Mapping[str, Floats] = field(default_factory=dict)
    cameras: Sequence[Camera] = ()
    folder: Path = Path()
    problems: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last frame."""
        return float(self.t[-1]) if len(self.t) else 0.0

    @property
    def hands(self) -> list[Track]:
        """The tracks that are hands."""
        return [track for track in self.tracks if track.is_hand]
