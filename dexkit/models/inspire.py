"""Inspire's hands on Unitree's topics: six position servos a side."""

from __future__ import annotations

import math
from dataclasses import replace

from dexkit.hand import JointSpec, Side
from dexkit.lazy import Lazy
from dexkit.models.profile import ClientCommand, Dialect, HandModel, TouchArea

__all__ = ["INSPIRE_DFX", "INSPIRE_FTP"]

_FULL_TRAVEL_S = 0.8  # docs/sources/unitree-dex.md#j2
_NAMES = ("pinky", "ring", "middle", "index", "thumb_bend", "thumb_rotation")

_JOINTS = tuple(
    # 1 is open; the limit of force is 1000 of its register, and sources differ on how much that is
    JointSpec(
        name,
        q_min=0.0,
        q_max=1.0,
        dq_max=1.0 / _FULL_TRAVEL_S,
        tau_max=1.0,
        closing=-1,
        straight=1.0,
        finger=name.partition("_")[0],
    )
    for name in _NAMES
)

INSPIRE_DFX = HandModel(
    name="inspire-dfx",
    title="Inspire DFX hand",
    unit="full travel",
    torque_unit="full force",
    limit_margin=0.05,
    joints=dict.fromkeys(Side, _JOINTS),
    dialects=(
        Dialect(
            name="inspire_dfx",
            model="inspire-dfx",
            cmd_topic="rt/inspire/cmd",
            state_topic="rt/inspire/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            index={Side.LEFT: 6, Side.RIGHT: 0},
            length=12,
            q_open=math.nan,
            summary="RH56DFX: 6 motors right, 6 left; q 0 closed to 1 open, nothing else counts",
            codec=Lazy("dexkit.service.dialects:ServoMap"),
            position_servo=True,
            zero_is_no_state=True,
        ),
    ),
    # docs/sources/unitree-dex.md#j2: the loop of Unitree's service, which it cannot keep while it
    # is commanded; derived: its four exchanges take up to 25 ms; less a fifth
    state_rate=100.0,
    min_state_rate=32.0,
    command_rate=100.0,  # docs/sources/unitree-dex.md#j2
    command_timeout=1.0,  # docs/sources/unitree-dex.md#j2
    client_command=ClientCommand(gains=6 * ((0.0, 0.0),)),  # docs/sources/unitree-dex.md#j2
    rest_q=dict.fromkeys(Side, (0.85, 0.85, 0.85, 0.85, 0.9, 0.9)),
)

# docs/sources/unitree-dex.md#j3: the vendor counts the fingers from the pinky
_FINGER_AREAS = (("tip", 3, 3), ("top", 12, 8), ("palm", 10, 8))
_THUMB_AREAS = (("tip", 3, 3), ("top", 12, 8), ("middle", 3, 3), ("palm", 12, 8))
_COUNTED = {"pinky": "one", "ring": "two", "middle": "three", "index": "four", "thumb": "five"}
_AREAS = (
    *(
        TouchArea(f"{finger} {part}", f"finger{number}_{part}_touch", rows, columns)
        for finger, number in _COUNTED.items()
        for part, rows, columns in (_THUMB_AREAS if finger == "thumb" else _FINGER_AREAS)
    ),
    TouchArea("palm", "palm_touch", 14, 8),
)

INSPIRE_FTP = replace(
    INSPIRE_DFX,
    name="inspire-ftp",
    title="Inspire FTP hand",
    dialects=(
        Dialect(
            name="inspire_ftp",
            model="inspire-ftp",
            cmd_topic="rt/inspire_hand/ctrl/{s}",
            state_topic="rt/inspire_hand/state/{s}",
            cmd_type="inspire::inspire_hand_ctrl",
            state_type="inspire::inspire_hand_state",
            index=dict.fromkeys(Side, 0),
            length=6,
            q_open=math.nan,
            summary="RH56DFTP: lists of 6 integers; angles 0 closed to 1000 open, with mode bit 1",
            codec=Lazy("dexkit.service.ftp_map:FtpMap"),
            position_servo=True,
            zero_is_no_state=True,
            touch_topic="rt/inspire_hand/touch/{s}",
            touch_type="inspire::inspire_hand_touch",
            touch_rate=50.0,  # more than the 30 Hz that clients record
            areas=_AREAS,
        ),
    ),
)
