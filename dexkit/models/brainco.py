"""The BrainCo Revo2 hand on Unitree's topics: six position servos."""

from __future__ import annotations

import math

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import ClientCommand, Dialect, HandModel

__all__ = ["BRAINCO_REVO2"]

_FULL_SPEED = (
    # name, travel in rad by the client's scale, full speed in degrees a second by the SDK's default
    ("thumb", 1.52, 145.0),
    ("thumb_aux", 1.05, 150.0),
    ("index", 1.47, 130.0),
    ("middle", 1.47, 130.0),
    ("ring", 1.47, 130.0),
    ("pinky", 1.47, 130.0),
)
"""docs/sources/unitree-dex.md#j1."""


def _joint(name: str, travel: float, degrees_s: float) -> JointSpec:
    """A joint in parts of its travel. tau_max is the default current limit, A: no source says how
    much torque that is.
    """
    return JointSpec(
        name,
        q_min=0.0,
        q_max=1.0,
        dq_max=math.radians(degrees_s) / travel,
        tau_max=1.0,
        closing=1,
        finger=name.partition("_")[0],
    )


_JOINTS = tuple(_joint(*each) for each in _FULL_SPEED)

BRAINCO_REVO2 = HandModel(
    name="brainco-revo2",
    title="BrainCo Revo2 hand",
    unit="full travel",
    torque_unit="A",
    limit_margin=0.05,
    joints=dict.fromkeys(Side, _JOINTS),
    dialects=(
        Dialect(
            name="brainco",
            model="brainco-revo2",
            cmd_topic="rt/brainco/{side}/cmd",
            state_topic="rt/brainco/{side}/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=6,
            q_open=math.nan,
            summary="Revo2: q 0 open to 1 closed, dq a part of the full speed, tau_est in A",
            codec=Lazy("dexkit.service.dialects:ServoMap"),
            position_servo=True,
            speed_units=tuple(joint.dq_max for joint in _JOINTS),
        ),
    ),
    state_rate=500.0,  # docs/sources/unitree-dex.md#j1; 100 Hz of the service before
    min_state_rate=80.0,  # inferred: that of the service before, less a fifth
    command_rate=100.0,  # docs/sources/unitree-dex.md#j1
    # dexkit's own: the vendor's service has none (docs/decisions.md)
    command_timeout=1.0,
    client_command=ClientCommand(gains=6 * ((0.0, 0.0),), dq=1.0),  # docs/sources/unitree-dex.md#j1
    rest_q=dict.fromkeys(Side, (0.1, 0.1, 0.15, 0.15, 0.15, 0.15)),
)
