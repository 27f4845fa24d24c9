"""The Dex1-1 gripper: one joint, three dialects."""

from __future__ import annotations

import math

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import ClientCommand, Dialect, HandModel

__all__ = ["DEX1_1"]

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
    client_command=ClientCommand(gains=((5.0, 0.05),)),  # docs/sources/unitree-dex.md#b1
    rest_q=dict.fromkeys(Side, (0.2 * _JOINT.stroke,)),
    vendor_ids={Side.LEFT: 1, Side.RIGHT: 0},  # docs/sources/unitree-dex.md#b2
)
