"""The Dex1-1 gripper: one joint, three dialects."""

from __future__ import annotations

import math
from functools import cache

from dexkit.hand import JointSpec, Side
from dexkit.kinematics import BASE, Box, Segment, Skeleton, Vector
from dexkit.lazy import Lazy
from dexkit.models.profile import Dialect, HandModel

__all__ = ["DEX1_1", "skeleton"]

# docs/sources/unitree-dex.md#b3: 0 closed, rising q opens, 5.4 rad = 9 cm of jaw travel; closing is
# toward smaller q.
# dq_max: two jaws at 0.2 m/s would need 24 rad/s (docs/sources/unitree-dex.md#b3, derived; the real
# limit is uncertain).
# tau_max: 20 N a jaw x 2 jaws x 0.09 m / 5.4 rad = 0.67 N m at the URDF's effort limit; the
# recordings reach kp * 0.18 = 0.9 N m, and vendor clients feed forward at most a few N m. 15 is
# what the vendor library clamps to (docs/sources/unitree-dex.md#g, rotor side), so nothing a client
# sends is cut short.
_JOINT = JointSpec("gripper", q_min=0.0, q_max=5.4, dq_max=24.0, tau_max=15.0, closing=-1)

DEX1_1 = HandModel(
    name="dex1-1",
    title="Dex1-1 gripper",
    limit_margin=0.25,  # the catalogue of the kit gives its reasons
    joints={Side.LEFT: (_JOINT,), Side.RIGHT: (_JOINT,)},
    dialects=(
        Dialect(
            name="unitree_go",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=5.4,
            summary="xr_teleoperate and the vendor's dex1_1_service: 0 closed .. 5.4 rad open",
            codec=Lazy("dexkit.service.dialects:MotorCmdsMap"),
        ),
        Dialect(
            name="unitree_hg",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=2 * math.pi,
            summary="the gripper's DDS interface specification: 0 closed .. 2 pi rad open",
            ends=(0.1, 6.0),  # the interface specification, "Position Conversion"
            codec=Lazy("dexkit.service.dialects:InterfaceSpecificationMap"),
            interface_specification=True,
            has_client=False,
        ),
        Dialect(
            name="unitree_actuator",
            model="dex1-1",
            cmd_topic="rt/unitree_actuator/cmd",
            state_topic="rt/unitree_actuator/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            # docs/sources/unitree-dex.md#a1: 0 is the right gripper, whatever the enum of
            # as in xr_teleoperate v1.1
            index={Side.LEFT: 1, Side.RIGHT: 0},
            length=2,
            q_open=5.4,
            summary="xr_teleoperate v1.1: both grippers in one message, 0 right, 1 left",
            codec=Lazy("dexkit.service.dialects:MotorCmdsMap"),
            zero_is_no_state=True,
        ),
    ),
    state_rate=500.0,  # docs/sources/unitree-dex.md#b2: 2000 us loop
    min_state_rate=200.0,  # docs/sources/unitree-dex.md#d7; the interface specification "200+ Hz"
    command_rate=200.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # docs/sources/unitree-dex.md#b2: timeout_ms_ = 1000
    client_gains=(5.0, 0.05),  # docs/sources/unitree-dex.md#b1
    rest_q=dict.fromkeys(Side, (0.2 * _JOINT.stroke,)),
    vendor_ids={Side.LEFT: 1, Side.RIGHT: 0},  # docs/sources/unitree-dex.md#b2
    simulator="sim-dex1",
    simulated_by=Lazy("dexkit.emulators.sim_dex1:sim_dex1"),
    client=Lazy("dexkit.teleop.client:Dex1Client"),
    operator_profiles=Lazy("dexkit.teleop.profiles:gripper_profiles"),
    skeleton=Lazy("dexkit.models.dex1:skeleton"),
)

_RIGHT = math.pi / 2


@cache
def skeleton(side: Side) -> Skeleton:
    """The joint axes, origins and drawn boxes (docs/sources/unitree-dex.md#i1,
    docs/sources/unitree-dex.md#i2): two jaws that slide; both sides are alike.

    In the URDF a jaw slides from 0.0245 m, where the jaws touch, to -0.02 m. That q is in
    proportion is derived: 5.4 rad are 9 cm (docs/sources/unitree-dex.md#b3).
    """
    touching, stroke = 0.0245, 0.0445 / 5.4
    segments, boxes = [], [Box.between(BASE, (-0.035, 0.0, -0.035), (0.035, 0.074, 0.035))]
    for sign, name in ((1, "jaw_1"), (-1, "jaw_2")):
        segments.append(
            Segment(
                name,
                BASE,
                (sign * 0.04055, 0.0593, sign * 0.0152),
                axis=(-float(sign), 0.0, 0.0),
                joint=0,
                prismatic=True,
                factor=-stroke,
                offset=touching,
            )
        )
        here = len(segments) - 1
        for low, high in (
            ((-0.08, -0.005, -0.008), (0.0, 0.009, 0.0065)),  # the rack
            ((-0.019, 0.006, -0.03), (0.0, 0.088, 0.0)),  # the finger
            ((-0.0155, 0.036, -0.029), (-0.0115, 0.085, -0.001)),  # its pad
        ):
            # the second jaw is the first one turned by half a turn about y
            boxes.append(Box.between(here, *_turned(low, high, sign)))
    return Skeleton(tuple(segments), tuple(boxes), mount=(_RIGHT, 0.0, 0.0))


def _turned(low: Vector, high: Vector, sign: int) -> tuple[Vector, Vector]:
    """Extents turned by half a turn about y, if the sign is -1."""
    if sign > 0:
        return low, high
    return (-high[0], low[1], -high[2]), (-low[0], high[1], -low[2])
