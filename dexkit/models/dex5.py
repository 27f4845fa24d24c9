"""The Dex5-1 hand: 20 joints of five fingers."""

from __future__ import annotations

import math

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import ClientCommand, Dialect, HandModel, ModeByte

__all__ = ["DEX5_1"]


_FINGERS = ("thumb", "index", "middle", "ring", "little")
"""As the names of the joints count them, from 1."""


def _joints(side: Side) -> tuple[JointSpec, ...]:
    """The 20 joints in the order of the IDL: index, middle, ring and little finger, thumb.

    Everything about this hand is from a pull request to xr_teleoperate that was open when it was
    read, and from Unitree's URDF (docs/sources/unitree-dex.md#b5). Names are the URDF's without the
    side's letter; the left URDF calls joint 41 Link_41L. Limits: URDF; only Roll_12 is mirrored.
    dq_max and tau_max: the left URDF, for both sides: the right one has zeros for torques and for
    the fingers' sideways joints. Coupled joints are derived: 16 motors for 20 joints leave four
    each for thumb and fingers less one in each finger, and what a finger of four joints shares is
    its two outer ones. Uncertain.
    """
    letter = "L" if side is Side.LEFT else "R"
    across = -1 if side is Side.LEFT else 1

    def joint(
        name: str,
        low: float,
        high: float,
        flexing: int,
        dq_max: float,
        urdf: str = "",
        coupled: bool = False,
    ) -> JointSpec:
        return JointSpec(
            name,
            q_min=low,
            q_max=high,
            dq_max=dq_max,
            tau_max=0.93,
            closing=flexing,
            urdf=f"{urdf or name}{letter}",
            coupled=coupled,
            finger=_FINGERS[int(name[-2]) - 1],
        )

    fingers = [
        spec
        for finger in (2, 3, 4, 5)
        for spec in (
            joint(
                f"Roll_{finger}1",
                -0.38397,
                0.38397,
                0,
                0.76794,
                "Link_41" if (finger, side) == (4, Side.LEFT) else "",
            ),
            joint(f"Pitch_{finger}2", 0.0, 1.5708, 1, 3.1416),
            joint(f"Pitch_{finger}3", 0.0, 1.68424, 1, 3.3685),
            joint(f"Pitch_{finger}4", 0.0, 1.3963, 1, 2.7925, coupled=True),
        )
    ]
    low, high = sorted((0.0, across * 1.8151))
    return (
        *fingers,
        joint("Yaw_11", -0.5867, 0.6803, 0, 4.18),
        joint("Roll_12", low, high, across, 4.18),
        joint("Pitch_13", 0.0, 1.7652, 1, 4.18),
        joint("Pitch_14", 0.0, 1.6406, 1, 4.18),
    )


# half relaxed, clear of all stops
_FINGER_REST = (0.03, 0.31, 0.34, 0.28)
_THUMB_REST = (0.05, 0.36, 0.35, 0.33)

DEX5_1 = HandModel(
    name="dex5-1",
    title="Dex5-1 hand",
    joints={side: _joints(side) for side in Side},
    dialects=(
        Dialect(
            name="dex5",
            model="dex5-1",
            cmd_topic="rt/dex5/{side}/cmd",
            state_topic="rt/dex5/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=20,
            q_open=math.nan,
            summary="Dex5-1: 20 joints, fingers first, thumb last; mode 1 is position control",
            # docs/sources/unitree-dex.md#b5: by a comment in xr_teleoperate, fingers report
            # in mN m, the thumb in N m. Uncertain; the only statement there is.
            torque_units=(0.001,) * 16 + (1.0,) * 4,
            codec=Lazy("dexkit.service.dialects:StatusModeMap"),
            mode_byte=ModeByte.STATUS,
            zero_is_no_state=True,
        ),
    ),
    # inferred: no source gives a rate; a client polls every 2 ms (docs/sources/unitree-dex.md#b1)
    state_rate=500.0,
    min_state_rate=200.0,  # inferred: twice the client's command rate, as for the others
    command_rate=100.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # inferred: that of its relatives
    # docs/sources/unitree-dex.md#b1: fingers, thumb
    client_command=ClientCommand(gains=16 * ((0.10, 0.001),) + 4 * ((1.0, 0.02),)),
    rest_q={
        side: (
            *(4 * _FINGER_REST),
            *(-q if (i, side) == (1, Side.LEFT) else q for i, q in enumerate(_THUMB_REST)),
        )
        for side in Side
    },
)
