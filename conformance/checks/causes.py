"""Determine likely causes from measured values: wrong units, wrong sides, wrong types."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from dexkit.hand import Floats, JointSpec
from dexkit.models import DIALECTS, Dialect

__all__ = ["of_positions", "of_range", "of_scale", "of_type"]


def of_positions(
    q: Floats, joints: Sequence[JointSpec], other: Sequence[JointSpec], unit: str = "rad"
) -> str:
    """Explain positions outside their range; empty if no cause is known.

    :param q: rad, shape (n, n_joints).
    :param other: the joints of the hand's other side.
    :param unit: that q should have.
    """
    right = "radians" if unit == "rad" else f"parts of the {unit}"
    q = q[np.isfinite(q).all(axis=1)]
    if not len(q):
        return ""
    low, high = q.min(axis=0), q.max(axis=0)

    def within(limits: Sequence[JointSpec], scale: float = 1.0, margin: float = 0.1) -> bool:
        return all(
            scale * (j.q_min - margin * j.stroke) <= a
            and b <= scale * (j.q_max + margin * j.stroke)
            for a, b, j in zip(low, high, limits, strict=True)
        )

    if len(joints) > 1 and within(other):
        return (
            "These are the other side's positions: its signs are used here, or sides are swapped."
        )
    if within([_mirrored(j) for j in joints]):
        return "The sign of q is wrong."
    if low.min() >= -1.0 and 20.0 < high.max() <= 101.0:
        return f"q appears to be in percent, not {right}."
    widest = max(max(-j.q_min, j.q_max) for j in joints)
    if np.abs(q).max() > 3 * widest and within(joints, 180 / np.pi):
        also = "percent or " if low.min() >= -1.0 and high.max() <= 20.0 else ""
        return f"q appears to be in {also}degrees, not {right}."
    if np.abs(q).max() > 100.0:
        return "q appears to be in the device's counts, or to be the rotor's angle before the gear."
    return ""


def of_range(q: float) -> str:
    """Explain a joint at ``q``, far outside its range; empty if no cause is known."""
    if abs(q - 100.0) < 5.0:
        unit = "percent"
    elif 120.0 < abs(q) <= 400.0:
        unit = "degrees"
    else:
        return ""
    return f"q appears to be in {unit}, in commands and state: only a part of its range was used."


def of_scale(targets: Floats, reached: Floats, stroke: float) -> str:
    """Explain steps of one joint that miss their targets; empty if no cause is known.

    :param targets: q that was commanded, rad; ``reached``: where each step ended.
    :param stroke: of a joint whose q counts from 0.
    """
    # one target far from the middle is enough for that
    far = len(targets) and np.abs(targets - stroke / 2).max() > 0.2 * stroke
    if far and np.allclose(reached, stroke - targets, atol=0.06 * stroke):
        return "Travel is mirrored: commands to open close the hand."
    if len(targets) < 2 or np.ptp(targets) < 0.2 * stroke:
        return ""
    if reached.max() <= 0.06 * stroke and np.ptp(reached) >= 0.02 * stroke:
        return "Commands appear to be read as percent or degrees: radians always close the hand."
    if np.allclose(reached, stroke * np.clip(targets, 0.0, 1.0), atol=0.03 * stroke):
        return "Commands appear to be read as 0 to 1: all commands above 1 rad open fully."
    if np.allclose(reached, np.clip(targets, 0.0, 1.0), atol=0.03):
        return "q appears to be 0 to 1 instead of radians, in commands and state."
    for scale, what in ((1 / stroke, "0 to 1"), (100 / stroke, "0 to 100 (percent)")):
        if np.allclose(reached, scale * targets, atol=0.06 * scale * stroke):
            return f"q is published as {what} instead of radians."
    return ""


def of_type(found: Iterable[str], wanted: str, dialect: Dialect) -> str:
    """Explain a topic with other types than the expected one; empty if no cause is known."""
    for name in sorted(found):
        if name in (dialect.cmd_type, dialect.state_type) and name != wanted:
            return "The types of state and command are swapped."
        dialects = [d.name for d in DIALECTS.values() if name in (d.cmd_type, d.state_type)]
        if dialects:
            return (
                f"{_short(name)} is the type of another hand or generation "
                f"(--dialect {' or '.join(dialects)}); here it has to be {_short(wanted)}."
            )
        if _short(name) == _short(wanted):
            return f"The type has the right name in another package: {name}."
    return ""


def _short(type_name: str) -> str:
    return type_name.rpartition("::")[2]


def _mirrored(joint: JointSpec) -> JointSpec:
    return replace(joint, q_min=-joint.q_max, q_max=-joint.q_min)
