"""Judge an episode by every check for which it has the data."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.across import OF_SETS
from dexkit.conformance.dataset.cameras import decoders, picture
from dexkit.conformance.dataset.check import Check, Figure, data_of
from dexkit.conformance.dataset.checks import (
    assignment,
    cameras,
    clipped,
    following,
    frames,
    frozen,
    grasps,
    idle,
    jumps,
    metadata,
    timing,
    units,
)
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Curve, Finding, Judgement, Shot, Use, use_of
from dexkit.conformance.dataset.likeness import shape_of
from dexkit.conformance.dataset.motion import span
from dexkit.hand import Floats

__all__ = ["CHECKS", "TITLES", "checks_digest", "judge"]

CHECKS: tuple[Check, ...] = (
    *frozen.CHECKS,
    *frames.CHECKS,
    *jumps.CHECKS,
    *timing.CHECKS,
    *idle.CHECKS,
    *metadata.CHECKS,
    *cameras.CHECKS,
    *units.CHECKS,
    *assignment.CHECKS,
    *clipped.CHECKS,
    *following.CHECKS,
    *grasps.CHECKS,
)
"""Every check of a single episode."""
TITLES = {check.name: check.title for check in CHECKS} | OF_SETS
"""What each check looks for, those of :mod:`~dexkit.conformance.dataset.across` included."""

Frames = NDArray[np.intp]

_CAUSES = {
    # figures in a wrong unit mean nothing
    "units": ("jump", "fps", "frozen", "idle", "not-followed", "clipped"),
    # an action that is cut off stands still while the joint goes on
    "clipped": ("frozen", "not-followed"),
}
"""By check, what follows from what it finds, and is not told again."""
_SURE_CAUSES = {
    # a state that is late, or stands still to the last digit, is not where its action is
    "out-of-step": ("not-followed",),
    "frozen": ("not-followed",),
    "repeated": ("frozen",),
}
"""Likewise, of findings for which an episode is dropped."""
_CURVES = 3  # findings of an episode with a picture of the moment
_POINTS = 160  # of a curve
_AROUND = 1.0  # s that a curve shows before and after its finding


@cache
def checks_digest() -> str:
    """What verdicts depend on besides the episode: the code of the checks, and what pictures can be
    decoded with.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return " ".join([digest.hexdigest()[:16], *decoders()])


def judge(episode: Episode) -> Judgement:
    """The verdict on an episode; a check for which it lacks the data is left out."""
    there = data_of(episode)
    findings: list[Finding] = []
    figures = {"length, s": round(episode.duration, 3)}
    judged = []
    for check in CHECKS:
        if not check.needs <= there:
            continue
        judged.append(check.name)
        for found in check.run(episode):
            if isinstance(found, Figure):
                figures[found.name] = round(found.value, 6)
            else:
                findings.append(found)
    findings = _causes(findings)
    result = Judgement(use_of(findings), findings, figures=figures, judged=judged)
    reasons = [findings.index(f) for f in result.reasons[:_CURVES]]
    result.curves = [c for i in reasons if (c := _curve(episode, i, findings[i])) is not None]
    result.shots = [s for i in reasons[:1] if (s := _shot(episode, i, findings[i])) is not None]
    result.key, result.shape = _key(episode), shape_of(episode)
    result.kind = _kind(episode)
    result.cameras = [camera.name for camera in episode.cameras]
    result.sums = metadata.sums_of(episode)
    return result


def _causes(findings: list[Finding]) -> list[Finding]:
    """Without what follows from another finding, by :data:`_CAUSES` and :data:`_SURE_CAUSES`; and a
    joint or two that leap by a turn are no other unit.
    """
    leaps = {f.part for f in findings if f.check == "jump" and 0 < len(f.joints) <= 2}
    findings = [f for f in findings if f.check != "units" or f.part not in leaps]
    parts = {(cause, f.part) for f in findings for cause in _CAUSES if f.check == cause}
    hidden = {(check, part) for cause, part in parts for check in _CAUSES[cause]}
    sure = [f for f in findings if f.use is Use.DROP and f.check in _SURE_CAUSES]
    hidden |= {(check, f.part) for f in sure for check in _SURE_CAUSES[f.check]}
    everywhere = {check for f in sure if not f.part for check in _SURE_CAUSES[f.check]}
    return [f for f in findings if (f.check, f.part) not in hidden and f.check not in everywhere]


def _curve(episode: Episode, number: int, finding: Finding) -> Curve | None:
    """The joint of a finding that moves most, around the finding."""
    track = next((t for t in episode.tracks if t.part == finding.part), None)
    if track is None:
        return None
    begin = 0.0 if finding.begin_s is None else finding.begin_s - _AROUND
    end = episode.duration if finding.end_s is None else finding.end_s + _AROUND
    inside = np.flatnonzero((episode.t >= begin) & (episode.t <= end))
    if len(inside) < 2:
        return None
    chosen = inside[np.unique(np.linspace(0, len(inside) - 1, _POINTS).astype(int))]
    joint = _joint_to_show(track, finding, chosen)
    return Curve(
        number,
        track.joints[joint],
        "" if track.model is None else track.model.unit,
        [round(float(v), 3) for v in episode.t[chosen]],
        _thin(track.state, chosen, joint),
        _thin(track.action, chosen, joint),
    )


def _shot(episode: Episode, number: int, finding: Finding) -> Shot | None:
    """What a camera saw in the middle of a finding: the finding's camera, or the first."""
    if finding.begin_s is None:
        return None
    colours = [c.name for c in episode.cameras if c.group == "colors"]
    named = finding.part.removeprefix("camera ")
    camera = named if named in colours else next(iter(colours), None)
    if camera is None:
        return None
    end = finding.begin_s if finding.end_s is None else finding.end_s
    seconds = (finding.begin_s + end) / 2
    data = picture(episode, camera, seconds)
    if data is None:
        return None
    return Shot(number, camera, round(seconds, 2), base64.b64encode(data).decode())


def _joint_to_show(track: Track, finding: Finding, frames: Frames) -> int:
    values = [v for v in (track.action, track.state) if v is not None]
    moved: Floats = np.sum([span(v[frames]) for v in values], axis=0)
    among = [j for j in finding.joints if j < len(moved)] or list(range(len(moved)))
    return max(among, key=lambda j: moved[j])


def _thin(values: Floats | None, frames: Frames, joint: int) -> list[float | None]:
    if values is None:
        return []
    return [round(float(v), 4) if np.isfinite(v) else None for v in values[frames, joint]]


def _key(episode: Episode) -> str:
    """A digest of the positions; equal for equal data, whatever the frames are called."""
    digest = hashlib.sha256()
    for track in sorted(episode.tracks, key=lambda t: t.part):
        for values in (track.state, track.action):
            digest.update(b"-" if values is None else np.float32(values).tobytes())
    return digest.hexdigest()


def _kind(episode: Episode) -> str:
    """A digest of what an episode consists of; only episodes of one kind are compared."""
    parts = sorted((t.part, t.joints, t.action is None, t.state is None) for t in episode.tracks)
    return hashlib.sha256(f"{episode.fps:.3f} {parts}".encode()).hexdigest()[:16]
