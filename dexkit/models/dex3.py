"""The Dex3-1 hand: seven joints, nine pressure sensor packets."""

from __future__ import annotations

import math

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import (
    ClientCommand,
    Dialect,
    HandModel,
    ModeByte,
    PressureSensor,
)

__all__ = ["DEX3_1"]


def _joints(side: Side) -> tuple[JointSpec, ...]:
    """The seven joints in the order of the IDL, on both sides: thumb, middle, index.

    Names and order: the Dex3-1 manual "Message Structure Sorting"; xr_teleoperate's enum names 3 to
    6 index-then-middle for the right hand, without effect (docs/sources/unitree-dex.md#d13).
    Limits: Unitree's URDF, which for thumb_1 is the manual's and narrower than xr_teleoperate's
    (docs/sources/unitree-dex.md#b4, docs/sources/unitree-dex.md#d17). The sides are
    mirrored: every flexing sign of the left hand turns round on the right; thumb_0 swings both
    ways. dq_max: xr_teleoperate's URDF (docs/sources/unitree-dex.md#d27); tau_max: both URDFs
    (docs/sources/unitree-dex.md#b4). Ratios: the Dex3-1 manual "Miniature Brushless Force Control
    Joint"; that thumb_0 is the one with 214 follows from its torque and speed, and is uncertain
    (docs/sources/unitree-dex.md#b4).
    """
    mirror = 1 if side is Side.LEFT else -1

    def joint(
        name: str, low: float, high: float, flexing: int, *, ratio: float = 108.0
    ) -> JointSpec:
        geared = ratio != 108.0
        q_min, q_max = sorted((mirror * low, mirror * high))
        return JointSpec(
            name,
            q_min=q_min + 0.0,  # no -0.0
            q_max=q_max + 0.0,
            dq_max=6.857 if geared else 12.0,
            tau_max=2.45 if geared else 1.4,
            closing=mirror * flexing,
            urdf=f"{side}_hand_{name}_joint",
            gear_ratio=ratio,
            finger=name.partition("_")[0],
        )

    finger = [("0", -1.5708), ("1", -1.7453)]
    return (
        joint("thumb_0", -1.0472, 1.0472, 0, ratio=214.0),
        joint("thumb_1", -0.6109, 1.0472, 1),
        joint("thumb_2", 0.0, 1.7453, 1),
        *(joint(f"middle_{i}", low, 0.0, -1) for i, low in finger),
        *(joint(f"index_{i}", low, 0.0, -1) for i, low in finger),
    )


_REST = (0.05, 0.2, 0.3, -0.3, -0.4, -0.3, -0.4)  # left; half relaxed, clear of all stops

# docs/sources/unitree-dex.md#b4, the Dex3-1 manual "Number of Pressure Sensors": 9 packets, 33
# elements: three areas of 2 x 2 on the palm, 2 x 2 on each finger pad, 3 x 1 on each finger tip.
# Which packet is which, and which of the 12 values are elements, is in a figure that the sources
# lost. Two public clients of real hands read these slots, and no others: the Dex3 clients in
# sakuzeng/xiangyang_g1 and in a fork of xr_teleoperate that names the packets so, too. They agree
# with each other and with the numbers of elements; a third project names the first six tips before
# pads and index before middle. Likely, not measured here.
_SENSORS = (
    *(
        PressureSensor(f"{finger} {part}", slots)
        for finger in ("thumb", "middle", "index")
        for part, slots in (("pad", (0, 2, 9, 11)), ("tip", (3, 6, 8)))
    ),
    *(PressureSensor(f"palm {i}", (0, 2, 9, 11)) for i in range(3)),
)

DEX3_1 = HandModel(
    name="dex3-1",
    title="Dex3-1 hand",
    # real hands: up to 0.085 rad (docs/sources/real-hands.md); xr_teleoperate's wider limits
    limit_margin=0.15,
    joints={side: _joints(side) for side in Side},
    dialects=(
        Dialect(
            name="dex3",
            model="dex3-1",
            cmd_topic="rt/dex3/{side}/cmd",
            state_topic="rt/dex3/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=7,
            q_open=math.nan,
            summary="Dex3-1 of G1: 7 motors in the order of the IDL, RIS_Mode in the mode byte",
            # docs/sources/unitree-dex.md#a1: the only state topic to which the vendor's C++ example
            # subscribes
            low_rate_topic="rt/lf/dex3/{side}/state",
            low_rate=9.1,  # as a real robot's copy comes (docs/sources/real-hands.md#dex3-low-rate)
            codec=Lazy("dexkit.service.dialects:RisModeMap"),
            mode_byte=ModeByte.RIS,
            zero_is_no_state=True,
        ),
    ),
    state_rate=1000.0,  # the Dex3-1 manual "Communication rate"
    min_state_rate=200.0,  # inferred: twice the client's command rate, as for the Dex1-1
    command_rate=100.0,  # docs/sources/unitree-dex.md#b1
    command_timeout=1.0,  # the Dex3-1 manual RIS_Mode_t: "default 1s timeout"
    client_command=ClientCommand(gains=7 * ((1.5, 0.2),)),  # docs/sources/unitree-dex.md#b1
    rest_q={
        Side.LEFT: _REST,
        Side.RIGHT: tuple(q if i == 0 else -q for i, q in enumerate(_REST)),
    },
    sensors=_SENSORS,
)
