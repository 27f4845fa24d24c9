"""Convert between servo ticks, percent of stroke, joint radians, effort, current and speed.

Positions are relative to the calibrated zero: 0 ticks is closed; 2500 ticks, 100 % and 5.4 rad
of the Dex1 joint are fully open (docs/sources/mx64-ezgripper.md#d2,
docs/sources/mx64-ezgripper.md#d7; docs/sources/mx64-ezgripper.md#d10-3,
docs/sources/mx64-ezgripper.md#d10-4, docs/sources/mx64-ezgripper.md#d10-5).
"""

from __future__ import annotations

from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.wire import mx64

__all__ = [
    "CURRENT_LIMIT",
    "JOINT_PER_TICK",
    "STROKE",
    "STROKES",
    "TICKS_PER_PERCENT",
    "VELOCITY_LIMIT",
    "amperes",
    "current_of_effort",
    "joint_of_ticks",
    "joint_speed",
    "profile_velocity",
    "relative_position",
    "ticks_of_joint",
    "ticks_per_second",
]

STROKE = mx64.EZGRIPPER_STROKE
STROKES = (1000, 3600)
"""Allowed strokes, ticks: less than one turn, so that open and closed can be told apart."""
TICKS_PER_PERCENT = STROKE / 100

_JOINT = DEX1_1.joints[Side.LEFT][0]
JOINT_PER_TICK = _JOINT.stroke / STROKE
"""rad of the Dex1 joint in one servo tick: 2500 ticks are 5.4 rad."""

CURRENT_LIMIT = 1600
"""Current units that are 100 % effort (docs/sources/mx64-ezgripper.md#d2); 76 % already stalls the
servo at 12 V."""

VELOCITY_LIMIT = 1023
"""Highest value of Velocity Limit(44): 640 % of stroke a second, far above the motor's speed."""

_TICKS_PER_SECOND = mx64.VELOCITY_UNIT_RPM / 60 * mx64.TICKS_PER_TURN
"""ticks/s of one velocity unit (0.229 rpm): 15.63."""


def joint_of_ticks(ticks: float, stroke: int = STROKE) -> float:
    """Joint angle, rad, of a position relative to the zero.

    :param stroke: ticks from closed to open, here and below.
    """
    return _JOINT.q_min + ticks * _JOINT.stroke / stroke


def ticks_of_joint(q: float, stroke: int = STROKE) -> int:
    """Position relative to the zero, in whole ticks within the stroke, of a joint angle in rad."""
    return min(max(round((q - _JOINT.q_min) * stroke / _JOINT.stroke), 0), stroke)


def ticks_per_second(velocity: float) -> float:
    """ticks/s of a velocity register's value."""
    return velocity * _TICKS_PER_SECOND


def joint_speed(velocity: float, stroke: int = STROKE) -> float:
    """rad/s of the joint of a velocity register's value; positive opens."""
    return ticks_per_second(velocity) * _JOINT.stroke / stroke


def profile_velocity(percent_per_second: float, stroke: int = STROKE) -> int:
    """Profile Velocity register value for a speed.

    At least 1, because 0 means no limit, and at most Velocity Limit's 1023, because the servo
    may refuse more (docs/sources/mx64-ezgripper.md#b5).
    """
    units = round(percent_per_second * stroke / 100 / _TICKS_PER_SECOND)
    return min(max(units, 1), VELOCITY_LIMIT)


def current_of_effort(effort: float) -> int:
    """Goal Current units of an effort in percent, clamped to 0..100
    (docs/sources/mx64-ezgripper.md#d2).
    """
    return round(min(max(effort, 0.0), 100.0) * CURRENT_LIMIT / 100)


def amperes(units: float) -> float:
    """A of current units."""
    return units * mx64.CURRENT_UNIT


def relative_position(present: int, zero: int, stroke: int = STROKE) -> int:
    """Return ticks from the zero to ``present``, which may be counted in different turns.

    The encoder is absolute only within one turn: after power-on or a reboot the servo reports
    0..4095, while the zero may have been stored in another turn (docs/sources/mx64-ezgripper.md#b4,
    docs/sources/mx64-ezgripper.md#d4). The difference modulo 4096 is still unique, because the
    stroke is 2500 ticks, which leaves 1596 ticks that no position can have. The result wraps in
    the middle of these: up to 798 ticks (32 %) beyond open read as open, up to 798 below the zero
    as negative.
    """
    margin = (mx64.TICKS_PER_TURN - stroke) // 2
    return (present - zero + margin) % mx64.TICKS_PER_TURN - margin
