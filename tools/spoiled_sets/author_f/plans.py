"""The sets: what is in each, an episode a line."""

from __future__ import annotations

from tools.spoiled_sets.author_f.motion import Plan

__all__ = ["PLANS"]

_FULL = ("velocity", "effort")
PLANS = (
    Plan(
        "dex1_pour",
        "lerobot-v2.1",
        "dex1",
        30,
        "unitree",
        ("Pour the beans from the cup into the bowl",),
        """
        good ordinary
        good one_hand_rest
        camera_frozen camera:cam_left_high plain
        good slow
        missing_stretch - plain
        good arm_rest
        camera_frozen camera:cam_right_wrist moderate
        good coarse
        wrong_fps - plain video=15
        good noisy
        camera_late camera:cam_left_high plain
        good camera_slow
        camera_late camera:cam_right_wrist moderate constant
        action_shift - plain
        good alike
        camera_early_end camera:cam_left_high plain
        camera_early_end camera:cam_right_wrist moderate
        good alike
        camera_missing camera:cam_right_wrist plain
        frozen_all - plain
        good camera_hiccup
        good short
        idle_start - plain
        """,
        cameras=("cam_left_high", "cam_right_wrist"),
    ),
    Plan(
        "dex3_cups",
        "lerobot-v3.0",
        "dex3",
        30,
        "dexkit",
        ("Pick up the cup with the right hand and put it on the shelf",),
        """
        good ordinary
        good long_hold
        grasp_on_nothing right_hand plain
        good quick
        good overshoot
        drop_in_grasp right_hand plain
        frozen_joint right_hand plain
        good soft
        good beyond
        drop_in_grasp right_hand moderate
        wrong_joint_order right_hand plain thumb_last
        good ordinary
        good tremor
        inverted_sign left_arm plain
        wrong_fps - plain velocity=20
        good ordinary
        jump right_arm plain
        good big_sag
        lag_drift - plain
        wrong_stats - plain
        good long
        not_followed left_arm moderate
        duplicate - plain noise
        grasp_on_nothing right_hand plain
        """,
        carries=(*_FULL, "pressure"),
        grasp=True,
    ),
    Plan(
        "ftp_boxes",
        "lerobot-v3.0",
        "ftp",
        50,
        "dexkit",
        ("Hold the box with the right hand",),
        """
        good ordinary
        good slow
        grasp_on_nothing right_hand plain
        good ordinary
        drop_in_grasp right_hand plain
        good long_hold
        drop_in_grasp right_hand moderate
        frozen_side right_hand plain
        good quick
        repeated_frames - plain
        good joint_unused
        not_finite left_hand moderate
        good ordinary
        action_shift - moderate late
        good noisy
        wrong_unit - plain percent
        good soft
        good pause
        """,
        arms=False,
        carries=("effort", "pressure"),
        grasp=True,
    ),
    Plan(
        "brainco_signs",
        "lerobot-v2.0",
        "brainco",
        30,
        "unitree",
        ("Count with the fingers", "Wave and open and close the hands"),
        """
        good ordinary
        wrong_unit right_hand plain percent_state
        good slow_hand
        wrong_joint_order left_hand moderate fingers
        good joint_unused
        frozen_joint left_hand moderate
        good both_same
        clipped_action right_arm plain
        good rounded
        not_followed right_hand plain
        no_task - plain empty
        good large_motion
        broken_file - plain half
        good pause
        idle_end - plain
        duplicate - plain task
        broken_file - moderate row
        good arm_rest
        frozen_side left_arm moderate
        good next_state
        good quick_arm
        """,
        spread=0.9,
    ),
    Plan(
        "dfx_drawer",
        "lerobot-v2.1",
        "dfx",
        30,
        "unitree",
        ("Open the drawer, gesture, and close the drawer",),
        """
        good ordinary
        wrong_side hand plain
        good lagging_arm
        wrong_unit left_hand plain flip_state
        good hands_still
        repeated_frames - moderate rows
        good small_motion
        broken_file - plain gone
        camera_frozen camera:cam_left_high plain
        good slow_hand
        jump left_arm moderate
        good quick_arm
        wrong_stats - plain
        good camera_slow
        no_task - plain dangling
        camera_missing camera:cam_left_high plain
        good quiet_end
        not_followed left_hand moderate
        good offset
        good one_hand_rest
        """,
        cameras=("cam_left_high",),
        spread=0.9,
    ),
    Plan(
        "dex5_fingers",
        "lerobot-v3.0",
        "dex5",
        60,
        "dexkit",
        ("Move the fingers one after the other",),
        """
        good ordinary
        frozen_joint right_hand moderate
        good slow
        wrong_joint_order left_hand plain reversed
        good pause
        not_followed right_hand plain all
        good noisy
        wrong_fps - plain velocity=30
        good slow_hand
        jump left_hand plain
        good one_hand_rest
        missing_stretch - plain numbered
        action_shift - plain
        good short
        good quick
        good beyond
        good both_same
        """,
        arms=False,
        carries=_FULL,
        spread=0.8,
    ),
    Plan(
        "follower_grippers",
        "lerobot-v3.0",
        "dex1",
        20,
        "other",
        ("Sort the blocks by colour", "Stack the blocks"),
        """
        good ordinary
        good kinesthetic
        good next_state
        wrong_unit - plain degrees
        good end_stops
        camera_late camera:top moderate
        good open_only
        wrong_side arm plain
        good offset
        clipped_action left_arm moderate followed
        good beyond
        not_finite right_arm plain
        lag_drift - moderate
        good camera_hiccup
        idle_end - moderate
        good large_motion
        wrong_unit left_hand plain unit
        good alike
        camera_frozen camera:top moderate
        good alike
        duplicate - plain exact
        wrong_stats - moderate
        """,
        cameras=("top",),
    ),
    Plan(
        "dex3_degrees",
        "lerobot-v2.1",
        "dex3",
        30,
        "unitree",
        ("Fold the towel",),
        "wrong_unit - plain degrees\n" * 8,
        spread=0.4,
    ),
    Plan(
        "left_only",
        "lerobot-v3.0",
        "dex1",
        15,
        "dexkit",
        ("Put the screws into the box",),
        """
        good ordinary
        good slow
        frozen_side left_hand plain
        good quick
        camera_frozen camera:wrist plain
        good camera_hiccup
        inverted_sign left_arm moderate
        good tremor
        repeated_frames - plain rows
        good quiet_end
        jump left_hand moderate step
        good coarse
        idle_start - moderate
        good small_motion
        good overshoot
        good open_only
        """,
        sides=("left",),
        cameras=("wrist",),
    ),
    Plan(
        "ten_hertz",
        "lerobot-v2.0",
        "dex3",
        10,
        "unitree",
        ("Wipe the table", "Wave at the visitor"),
        """
        good ordinary
        action_shift - plain late
        good hands_still
        not_followed right_hand plain
        good slow
        frozen_all - moderate
        good one_hand_rest
        jump right_arm plain action
        good long
        missing_stretch - moderate numbered
        good kinesthetic
        wrong_joint_order right_hand plain fingers
        no_task - plain blank
        good pause
        wrong_side hand plain both
        good rounded
        good lagging_arm
        good both_same
        """,
        spread=0.5,
    ),
    Plan(
        "half_file",
        "lerobot-v3.0",
        "dfx",
        30,
        "unitree",
        ("Turn the knob",),
        """
        good ordinary
        good arm_rest
        good slow
        good small_motion
        broken_file - plain half
        broken_file - plain half
        good tremor
        good short
        """,
        spread=0.9,
    ),
    Plan(
        "meta_gone",
        "lerobot-v3.0",
        "brainco",
        30,
        "unitree",
        ("Ring the bell",),
        "good ordinary\n" * 3,
        spread=0.9,
    ),
    Plan(
        "xr_dex3_old",
        "xr-v0.5",
        "dex3",
        30,
        "unitree",
        ("Place the apple on the plate",),
        """
        good ordinary
        frozen_side right_hand moderate
        good one_hand_rest
        jump left_hand plain
        good quick
        wrong_side hand plain
        good arm_rest
        missing_stretch - plain numbered
        good slow_hand
        broken_file - plain cut
        clipped_action right_hand plain
        good tremor
        good end_stops
        good beyond
        """,
        spread=0.4,
    ),
    Plan(
        "xr_dex1_v11",
        "xr-v1.1",
        "dex1",
        60,
        "unitree",
        ("Hand the bottle over", "Take the bottle back"),
        """
        good ordinary
        camera_missing camera:color_1 plain
        good short
        camera_frozen camera:color_0 plain
        good overshoot
        action_shift - moderate
        good end_stops
        camera_early_end camera:color_0 plain
        good camera_slow
        wrong_fps - plain stamps=30
        not_finite left_arm plain
        good small_motion
        """,
        cameras=("color_0", "color_1"),
    ),
    Plan(
        "xr_brainco_v13",
        "xr-v1.3",
        "brainco",
        30,
        "unitree",
        ("Play rock, paper, scissors",),
        """
        good ordinary
        wrong_unit - plain degrees
        good joint_unused
        broken_file - plain latin
        good noisy
        frozen_joint right_arm plain
        good big_sag
        lag_drift - plain
        good slow
        inverted_sign right_arm plain
        good next_state
        no_task - plain empty
        good rounded
        duplicate - plain exact
        broken_file - moderate short
        broken_file - plain name
        good both_same
        good small_motion
        """,
        spread=0.9,
    ),
    Plan(
        "xr_ftp_v13",
        "xr-v1.3",
        "ftp",
        30,
        "unitree",
        ("Greet the visitor with both hands",),
        """
        good ordinary
        frozen_all - plain
        good pause
        broken_file - plain cut
        good both_same
        idle_end - plain
        good lagging_arm
        wrong_joint_order left_arm plain reversed
        good hands_still
        repeated_frames - moderate
        good quiet_end
        not_finite right_hand moderate inf
        broken_file - plain empty
        good offset
        good slow_hand
        good large_motion
        good kinesthetic
        """,
        spread=0.9,
    ),
)
