"""Figures of one joint from time series; no clock, no device.

Every function takes arrays of one joint, shape (n,): seconds, commanded q, measured q, torque. What
cannot be distinguished from them is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexkit.hand import Floats

__all__ = ["Rest", "Start", "delay", "lost_motion", "rest", "speed", "spread", "start"]

_FEWEST = 4
"""Samples of a joint that stands still under a rising command, from which its stiffness is told."""
_SWING = 0.3
"""Part of the torque to start by which torque has to rise meanwhile."""
_RISEN = 0.9
"""Part of the torque to start up to which torque is taken to rise with the command alone."""
_FEWEST_MOVING = 3
_OBEYS = 0.2
"""Part of kp by which a measured stiffness may differ from it, and the joint still follows the law
``tau = kp (q - q_now)``."""


@dataclass(frozen=True)
class Rest:
    """Rest position of a joint.

    :param q: median of the samples; ``tau`` likewise.
    """

    q: float
    tau: float


@dataclass(frozen=True)
class Start:
    """A joint that starts to move under a command that moves away slowly.

    :param torque: highest before it had moved, in the direction of the command; NaN where it did
        not move or torque is not known.
    :param stiffness: torque for a unit of the command's distance, while it stood still; NaN where
        that was too short.
    :param swing: by how much the torque rose meanwhile.
    """

    torque: float
    stiffness: float = math.nan
    swing: float = 0.0


def rest(q: Floats, tau: Floats) -> Rest:
    """Rest position from samples at rest."""
    return Rest(float(np.median(q)), float(np.median(tau)))


def _steady(values: Floats) -> Floats:
    """Each value replaced by the median of it and its neighbours."""
    if len(values) < 3:
        return values
    return np.asarray(
        np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0), dtype=np.float64
    )


def start(command: Floats, q: Floats, tau: Floats, direction: int, threshold: float) -> Start:
    """The torque to start, from a slow command in ``direction``.

    :param threshold: q by which a joint has moved from where it was.
    """
    moved = direction * (q - np.median(q[:3])) > threshold
    if not moved.any() or not tau.any():  # a hand that reports torque in a grip only has none
        return Start(math.nan)
    begin = int(np.argmax(moved))
    before = direction * _steady(tau[: begin + 1])
    torque = float(before.max()) if len(before) else math.nan
    # while its torque rises: then it gives way, and play is crossed before it is seen to move
    rising = np.flatnonzero(before >= _RISEN * torque) if torque > 0 else np.empty(0)
    end = int(rising[0]) + 1 if len(rising) else begin + 1
    still = np.abs(q[:end] - q[0]) < 0.02 * threshold
    x, y = command[:end][still], tau[:end][still]
    # the state of a turn was measured before the turn's command
    x, y = x[:-1], y[1:]
    swing = float(np.ptp(y)) if len(y) else 0.0
    if len(x) < _FEWEST or float(np.ptp(x)) <= 0 or swing <= _SWING * abs(torque):
        return Start(torque)
    return Start(torque, float(np.polyfit(x, y, 1)[0]), swing)


def spread(rests: Sequence[Rest]) -> float:
    """The largest difference of places at which it came to rest."""
    return max(r.q for r in rests) - min(r.q for r in rests)


def lost_motion(below: Sequence[Rest], above: Sequence[Rest], kp: float, stiffness: float) -> float:
    """Distance between a joint's rest positions at one command, reached from below and from above.

    A motor that follows ``tau = kp (q - q_now)`` rests beside its command by its torque at rest
    over kp: friction, not play. That part is taken away where the stiffness that was measured says
    that the joint follows this law.
    """
    if not below or not above:
        return math.nan
    apart = float(np.mean([r.q for r in above]) - np.mean([r.q for r in below]))
    if kp > 0 and abs(stiffness - kp) <= _OBEYS * kp:  # NaN: not known
        apart -= float(np.mean([r.tau for r in below]) - np.mean([r.tau for r in above])) / kp
    return max(0.0, apart)


def delay(t: Floats, q: Floats, commanded: float, direction: int, threshold: float) -> float:
    """Seconds from a command to the first sample in which the joint has moved by ``threshold``.

    :param commanded: when the command was sent.
    """
    before = t <= commanded
    origin = float(np.median(q[before])) if before.any() else float(q[0])
    moved = (direction * (q - origin) > threshold) & (t > commanded)
    return float(t[int(np.argmax(moved))] - commanded) if moved.any() else math.nan


def speed(t: Floats, q: Floats, low: float, high: float) -> float:
    """Magnitude of the mean speed between two places."""
    inside = np.flatnonzero((q >= low) & (q <= high))
    if len(inside) < _FEWEST_MOVING:
        return math.nan
    x, y = t[inside], q[inside]
    return abs(float(np.polyfit(x - x[0], y, 1)[0])) if float(np.ptp(x)) > 0 else math.nan
