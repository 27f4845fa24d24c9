"""The profile of the hand: six joints, one dialect."""

from __future__ import annotations

import math

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import ClientCommand, Dialect, HandModel, ModeByte

__all__ = ["TWOFINGER_1"]


def _joints(side: Side) -> tuple[JointSpec, ...]:
    """Two fingers of three joints; the right hand is the mirror image of the left one."""
    low, high, closing = (0.0, 1.5, 1) if side is Side.LEFT else (-1.5, 0.0, -1)
    return tuple(
        JointSpec(
            f"{finger}_{part}",
            q_min=low,  # rad
            q_max=high,
            dq_max=12.0,  # rad/s
            tau_max=1.4,  # N m
            closing=closing,
            finger=finger,
        )
        for finger in ("thumb", "index")
        for part in ("base", "middle", "tip")
    )


_DIALECT = Dialect(
    name="twofinger",
    model="twofinger-1",
    cmd_topic="rt/twofinger/{side}/cmd",
    state_topic="rt/twofinger/{side}/state",
    cmd_type="unitree_hg::msg::dds_::HandCmd_",
    state_type="unitree_hg::msg::dds_::HandState_",
    index={Side.LEFT: 0, Side.RIGHT: 0},
    length=6,
    q_open=math.nan,  # a hand of several joints has no single opening
    summary="two fingers of three joints; mode byte 1 drives a joint, 0 brakes it",
    codec=Lazy("dexkit.service.dialects:StatusModeMap"),
    mode_byte=ModeByte.STATUS,
    zero_is_no_state=True,
)

TWOFINGER_1 = HandModel(
    name="twofinger-1",
    title="Two-finger hand",
    joints={side: _joints(side) for side in Side},
    dialects=(_DIALECT,),
    state_rate=500.0,
    min_state_rate=200.0,
    command_rate=100.0,
    command_timeout=1.0,
    client_command=ClientCommand(gains=6 * ((1.5, 0.2),)),
    rest_q={Side.LEFT: 2 * (0.3, 0.4, 0.4), Side.RIGHT: 2 * (-0.3, -0.4, -0.4)},
)
