"""Write datasets of hands and arms, half of them good but unusual, half spoiled by one fault each.

``python -m tools.spoiled_sets.author_e OUT`` writes LeRobot datasets, task folders of
xr_teleoperate, recordings and a bag below OUT, and what is right or wrong with each episode in
``OUT/labels.json``. Hands move as in the shipped samples; arms make reaches, holds and tremor of
their own, and answer as an arm does: late, with overshoot and sag. The same code gives the same
data.
"""

from __future__ import annotations

import copy
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tools.spoiled_sets.e_faults import (
    ALL,
    Fault,
    at_end,
    blinking,
    camera,
    clipped,
    degrees,
    drifting,
    dropped,
    exchanged,
    frozen,
    gripper_share,
    inverted,
    jump,
    limp,
    marked,
    missing,
    noisy,
    not_finite,
    part_of_travel,
    percent,
    reordered,
    repeated,
    scaled,
    shifted,
    told,
    turn_state,
    turned,
)
from tools.spoiled_sets.e_files import (
    AUTHOR,
    Entry,
    Set,
    Wire,
    dexkit,
    write_export,
    write_session,
    write_wire,
    write_xr,
)
from tools.spoiled_sets.e_motion import (
    Label,
    Recorded,
    Style,
    Take,
    load_library,
    make,
)
from tools.spoiled_sets.lerobot_files import write_json, write_lerobot


def good(say: str, *, seed: int = -1, task: int = 0, **style: Any) -> Entry:
    """An episode that is fine, and what is unusual in it."""
    return Entry(Label("good", say), style, seed=seed, task=task)


def bad(
    fault: str, strength: str, say: str, do: Fault, *, rate: float = 0, copied: int = -1,
    task: int = 0, **style: Any,
) -> Entry:  # fmt: skip
    """An episode with one fault."""
    label = Label("spoiled", say, fault, strength=strength)
    return Entry(label, style, do, rate, copied=copied, task=task)


def takes_of(made: Set, library: dict[tuple[str, str], list[Recorded]], seed: int) -> list[Take]:
    """The episodes of a set."""
    found: list[Take] = []
    for i, entry in enumerate(made.entries):
        rng = np.random.default_rng([seed, i if entry.seed < 0 else 1000 + entry.seed])
        if entry.copied >= 0:
            take = copy.deepcopy(found[entry.copied])
        else:
            style = Style(**{"seconds": float(rng.uniform(9, 17)), **made.base, **entry.style})
            take = make(rng, library, made.model, entry.rate or made.fps, style)
        rng = np.random.default_rng([seed, i, 7])
        take.fps = made.fps
        take.tracks = {p: take.tracks[p] for p in made.parts}
        take.task = made.tasks[entry.task]
        take.shown = {c: np.arange(len(take)) for c in made.cameras}
        take.label = copy.deepcopy(entry.label)
        if entry.do is not None:
            entry.do(take, rng)
        found.append(take)
    return found


# -- the sets ---------------------------------------------------------------------------------

TWO = ("cam_left_high", "cam_left_wrist")
RIGHT = ("right_arm", "right_hand")
HANDS_ONLY = ("left_hand", "right_hand")
RAD = ("state", "velocity", "effort")

SETS = (
    Set("toast_dex3", "v3.0", "dex3-1", 30, (
        good("Both hands work, each in its own time."),
        good("The right arm and hand are never used.", used="left"),
        good("A slow operator: one grasp in half a minute.", tempo=2.8, seconds=30),
        good("A very quick operator.", tempo=0.55, seconds=10),
        good("Arms that answer 150 ms late and swing past their goals.", lag=0.15, damping=0.5),
        good("A pause of two seconds in the middle, in which only tremor is left.", pause=2.0),
        good("The hands move as in a sample, pinches of two fingers between grasps.",
             hand="direct", seconds=13),
        dataclasses.replace(good("The cameras miss one picture in fifteen and show the one before "
                                 "again."), do=blinking),
        good("The operator waits for 2.5 s before starting; cameras show a still scene so long.",
             lead=2.5, seconds=17),
        bad("frozen_side", "plain", "The left hand's state is the same for half of the episode "
            "while its action opens and closes.", frozen(["left_hand"], 0.5), tempo=0.8),
        bad("action_shift", "plain", "All actions are 0.7 s ahead of all observations.",
            shifted(0.7)),
        bad("camera_frozen", "plain", "The head camera shows one picture for half of the episode.",
            camera("cam_left_high", "frozen", 0.5)),
        bad("camera_late", "moderate", "The wrist camera falls behind the joints, at last by "
            "1.6 s.", camera("cam_left_wrist", "late", 1.6), seconds=16),
        bad("camera_early_end", "plain", "The head camera's pictures end 3.5 s before the joints.",
            camera("cam_left_high", "early", 3.5), seconds=15),
        bad("missing_stretch", "plain", "1.8 s of frames are lost in the midst of motion, and the "
            "numbers go on.", missing(1.8, True)),
        bad("not_followed", "plain", "The right hand is off for almost half of the episode.",
            limp(["right_hand"], 0.45, 0.05), used="both", tempo=0.8),
        bad("idle_end", "plain", "Nobody stopped the recorder: 16 s of nothing at the end.",
            at_end("", 16, "end"), tail=16.3, seconds=28),
        bad("jump", "plain", "A joint of the right arm is 0.9 rad elsewhere for two frames.",
            jump("right_arm", 0.9, 2)),
    ), cameras=TWO),
    Set("pick_dex1", "v2.1", "dex1-1", 30, (
        good("An object is held for 20 s and the action keeps closing on it.", squeeze=1,
             cycles=1, seconds=28),
        good("A soft object that gives way in the grippers.", soft=0.4),
        good("One of two that are alike: same way, a little slower.", seed=1, seconds=12.0),
        good("One of two that are alike: same way, a little quicker.", seed=1, seconds=11.4),
        good("The episode begins with objects in both grippers and ends so.", hand="holding"),
        good("It ends in the midst of motion.", end=1.6),
        good("Coarse encoders of gripper and arm.", step=0.006),
        good("A thin object: the grippers close almost wholly.", touch=0.86),
        good("A thick object: the grippers hardly close.", touch=0.45),
        bad("grasp_on_nothing", "plain", "The right gripper closes wholly, there is no object "
            "in it as in all other episodes.", marked("right_hand", 0.25, 0.8), empty="right",
            cycles=1),
        bad("grasp_on_nothing", "plain", "The left gripper closes wholly on nothing.",
            marked("left_hand", 0.25, 0.8), empty="left", cycles=1, seconds=11),
        bad("camera_missing", "plain", "The wrist camera has no video.",
            camera("cam_left_wrist", "none", 0)),
        bad("camera_early_end", "moderate", "The wrist camera ends 1.5 s early.",
            camera("cam_left_wrist", "early", 1.5)),
        bad("camera_frozen", "moderate", "The wrist camera stands still for a quarter.",
            camera("cam_left_wrist", "frozen", 0.27)),
        bad("camera_late", "plain", "The head camera falls behind by up to 2.5 s.",
            camera("cam_left_high", "late", 2.5), seconds=15),
        bad("duplicate", "plain", "A copy of episode 1.", marked("", 0, 1), copied=1),
        bad("wrong_stats", "plain", "The statistics are those of degrees, the data are rad.",
            told("stats", (57.3, 0.4))),
        bad("broken_file", "plain", "Its Parquet file is cut in half.", told("half", 0.5)),
        bad("broken_file", "moderate", "Its Parquet file has 7 rows fewer than the metadata say.",
            told("rows", 7)),
        bad("no_task", "plain", "The task is an empty text.", told("no task")),
        bad("frozen_joint", "plain", "The right gripper's state stands still for 60 % of the "
            "episode while its action moves.", frozen(["right_hand"], 0.6, True), tempo=0.7),
        bad("duplicate", "moderate", "Episode 7 again with a little noise.", noisy(0.0004),
            copied=7),
    ), cameras=TWO, tasks=("Pick up the block and put it into the box.",)),
    Set("brainco_cups", "v2.0", "brainco-revo2", 30, (
        good("The left arm rests all the time.", used="right"),
        good("Slow hands: 300 ms behind their actions, which is their way.", hand_lag=0.3),
        good("Positions in steps of a hundredth of the travel.", step=0.01),
        good("The operator's program gives a new action every third frame only.", stairs=3),
        good("The hands begin closed and only open, once.", hand="opens", cycles=1, touch=0),
        good("The hands go from end stop to end stop many times.", hand="stops", tempo=0.6,
             touch=0),
        good("A short episode of 4 s.", seconds=4.2, lead=0.2, tail=0.2, tempo=0.5),
        good("The hands move as in a sample, finger after finger.", hand="direct", seconds=8.2),
        bad("wrong_joint_order", "plain", "The left hand's state has its six fingers in reverse.",
            reordered("left_hand", (5, 4, 3, 2, 1, 0)), hand="fingers", seconds=8.4),
        bad("wrong_side", "plain", "The states of both hands are exchanged.", exchanged("hand"),
            hand="direct", seconds=8.0),
        bad("wrong_unit", "plain", "The right hand is in percent, others are 0 to 1.",
            scaled(["right_hand"], percent)),
        bad("wrong_unit", "moderate", "Both hands are 1 to 0 where all others are 0 to 1.",
            scaled(HANDS_ONLY, turned)),
        bad("lag_drift", "plain", "The observation falls behind the action, at last by 1.2 s.",
            drifting(1.2), seconds=18),
        bad("repeated_frames", "plain", "Every row is there twice: a loop at half the rate.",
            repeated(2)),
        bad("idle_start", "plain", "13 s pass before anything moves.",
            at_end("", 13, "start"), lead=13.3, seconds=25),
        bad("not_followed", "plain", "Both hands have no power in the whole episode.",
            limp(HANDS_ONLY, 1.0, 0.03)),
    ), tasks=("Stack the cups.",), base={"touch": 0.6}),
    Set("inspire_wipe", "v3.0", "inspire-dfx", 30, (
        good("A long episode of 40 s.", seconds=40, tempo=1.3),
        good("Fine work: the arms move little.", reach=0.35),
        good("An operator whose hands tremble.", tremor=0.008),
        good("It begins in the midst of motion.", begin=1.7),
        good("The hands only act at the end.", hand="late", cycles=2, seconds=18),
        good("Both sides do the same, mirrored.", same=True),
        good("The hands move as in a sample.", hand="direct", seconds=10),
        good("A heavy load: the arms sag by up to 0.1 rad.", sag=0.07),
        bad("wrong_side", "moderate", "The states of both hands are exchanged, as by "
            "xr_teleoperate v1.1.", exchanged("hand"), hand="direct", seconds=10.5),
        bad("not_finite", "plain", "NaN in a joint of the left arm for 12 frames.",
            not_finite("left_arm", 12, np.nan)),
        bad("not_finite", "moderate", "Infinity in one frame of an action.",
            not_finite("right_hand", 1, np.inf, "action")),
        bad("frozen_all", "plain", "All states stand still for 40 %, the actions go on.",
            frozen(ALL, 0.4)),
        bad("clipped_action", "plain", "Three joints of the right arm have actions cut off at half "
            "their range, the states go beyond.", clipped("right_arm", 0.22, 3)),
        bad("inverted_sign", "plain", "The left elbow's state has the wrong sign.",
            inverted("left_arm", [3])),
        bad("missing_stretch", "plain", "2 s of frames are missing, the numbers and stamps show "
            "it.", missing(2.0, False)),
        bad("wrong_stats", "plain", "The statistics in the metadata are of other data.",
            told("stats", (3.0, 0.4))),
        bad("no_task", "plain", "The task is an empty text.", told("no task")),
    ), tasks=("Wipe the table with the sponge.",), base={"touch": 0.58}),
    Set("export_dex3", "export", "dex3-1", 30, (
        good("Arms and hands with velocity and torque.",),
        good("A soft object in both hands.", soft=0.3),
        good("The left side rests.", used="right"),
        good("Noisy encoders.", noise=0.003, hand_noise=0.006),
        good("Arms swing past their goals.", damping=0.45, lag=0.12),
        good("The hands are closed all the time.", hand="holding"),
        good("One grasp after the other.", tempo=0.7, reach=0.8, seconds=18),
        bad("wrong_fps", "plain", "It was recorded at 15 Hz and is counted as 30: velocities are "
            "half of what positions do.", marked("", 0, 1), rate=15, seconds=20),
        bad("drop_in_grasp", "plain", "The right hand loses its object while it stays closed: "
            "torque falls and the fingers close on.", dropped("right_hand"), cycles=1, loses=0.4,
            used="right", seconds=12),
        bad("jump", "moderate", "A finger's state is off by 0.5 rad from the middle on.",
            jump("left_hand", -0.5, 0)),
        bad("frozen_joint", "plain", "One joint of the left arm stands still for 55 %.",
            frozen(["left_arm"], 0.55, True)),
        bad("repeated_frames", "plain", "Bursts: in half of the episode a row is there six times.",
            repeated(6, 0.5)),
        bad("wrong_joint_order", "moderate", "Index and middle of the right hand are exchanged in "
            "the state.", reordered("right_hand", (0, 1, 2, 5, 6, 3, 4)), hand="direct",
            seconds=13),
    ), names="dexkit", columns=RAD),
    Set("hands_dex5", "v3.0", "dex5-1", 50, (
        good("Hands without arms, at 50 frames a second.", seconds=10),
        good("The hands move as in the sample: a short episode.", hand="direct", seconds=4.0),
        good("Hands that stop short of their goals by friction.", beyond=0.02, seconds=9),
        good("Only the left hand is used.", used="left", seconds=9),
        good("Nothing is touched: the hands open and close in the air.", touch=0, seconds=8),
        bad("frozen_joint", "moderate", "One joint of the left hand stands still for a third.",
            frozen(["left_hand"], 0.33, True), seconds=12, tempo=0.8),
        bad("not_followed", "plain", "The left hand has no power in the whole episode.",
            limp(["left_hand"], 1.0, 0.03), seconds=11),
        bad("wrong_fps", "plain", "25 frames a second are counted as 50.", marked("", 0, 1),
            rate=25, seconds=16),
        bad("wrong_unit", "plain", "Both hands are in degrees, the other episodes in rad.",
            scaled(HANDS_ONLY, degrees), seconds=9),
        bad("lag_drift", "plain", "The observation falls behind by up to 0.9 s.", drifting(0.9),
            seconds=14),
    ), names="dexkit", columns=RAD, parts=HANDS_ONLY, tasks=("Open and close.",)),
    Set("named_otherwise", "v3.0", "dex1-1", 30, (
        good("Names of joints as LeRobot's plug-ins have them."),
        good("One gripper never moves.", used="right"),
        good("A quick operator.", tempo=0.6),
        good("The arms answer at once.", lag=0.035, damping=0.9),
        good("The grippers read 0.08 rad too much: beyond their range when they are open.",
             beyond=0.08),
        good("A tired operator: slow, with tremor.", tempo=1.8, tremor=0.005, seconds=20),
        bad("wrong_unit", "plain", "The grippers are 0 to 1 here, 0 to 5.4 in the others.",
            scaled(HANDS_ONLY, gripper_share)),
        bad("clipped_action", "moderate", "One joint of the left arm has its action cut off.",
            clipped("left_arm", 0.25, 1)),
        bad("action_shift", "moderate", "The observations come 0.27 s before the actions that "
            "cause them.", shifted(-0.35)),
        bad("jump", "moderate", "One action of the right arm is 0.7 rad elsewhere.",
            jump("right_arm", -0.7, 1, "action")),
        bad("idle_end", "moderate", "8 s of nothing at the end of 17 s.", at_end("", 8, "end"),
            tail=8.2, seconds=17),
        bad("inverted_sign", "plain", "Shoulder pitch of the right arm has the wrong sign.",
            inverted("right_arm", [0]), reach=1.2),
        bad("duplicate", "plain", "The motion of episode 3 with the name of another task.",
            marked("", 0, 1), copied=3, task=1),
    ), names="other", tasks=("Hand over the pen.", "Hand over the screwdriver.")),
    Set("all_degrees", "v2.1", "dex3-1", 30, tuple(
        bad("wrong_unit", "plain", "Arms and hands of the whole set are in degrees.",
            scaled(ALL, degrees), seconds=8.0 + i)
        for i in range(8)
    )),
    Set("ftp_effort", "v2.1", "inspire-ftp", 20, (
        good("20 frames a second, with the hands' effort."),
        good("A soft object.", soft=0.3),
        good("The hands move as in a sample.", hand="direct", seconds=10),
        good("Only the right side works.", used="right"),
        good("An object held for long.", squeeze=1, cycles=1, seconds=22),
        good("Another object, larger.", touch=0.5),
        bad("drop_in_grasp", "plain", "The left hand's object falls: effort goes, fingers close "
            "on.", dropped("left_hand"), used="left", cycles=1, loses=0.45, seconds=13),
        bad("drop_in_grasp", "moderate", "The right hand's object falls shortly before it is "
            "put down.", dropped("right_hand"), cycles=1, loses=0.72, seconds=14, used="right"),
        bad("frozen_side", "plain", "The right hand's state stands still for 40 %.",
            frozen(["right_hand"], 0.4), tempo=0.8),
        bad("not_followed", "moderate", "The left hand trips and lies for 30 %.",
            limp(["left_hand"], 0.3, 0.04), tempo=0.8),
        bad("wrong_joint_order", "plain", "The left arm's state begins with the wrist.",
            reordered("left_arm", (6, 5, 4, 3, 2, 1, 0))),
    ), columns=("state", "effort"), tasks=("Put the can on the shelf.",)),
    Set("taught_by_hand", "v2.1", "dex3-1", 10, (
        *(good(say, **style) for say, style in (
            ("Guided by hand: the action is the state. 10 frames a second.", {}),
            ("Guided by hand, slowly.", {"tempo": 2.0, "seconds": 26.0}),
            ("Guided by hand, the left side rests.", {"used": "right"}),
            ("Guided by hand, short.", {"seconds": 6.0, "tempo": 0.7}),
            ("Guided by hand, with a rest of 2 s.", {"pause": 2.0}),
            ("Guided by hand, coarse encoders.", {"step": 0.01}),
        )),
        bad("missing_stretch", "plain", "2.5 s of frames are lost, and the numbers go on.",
            missing(2.5, True), tempo=0.8),
        bad("not_finite", "plain", "A joint is NaN for four frames.",
            not_finite("right_arm", 4, np.nan)),
    ), base={"follow": "same", "tremor": 0.003}),
    Set("next_state_60", "v3.0", "dex1-1", 60, (
        good("60 frames a second; the action is the next state."),
        good("The same, the object is soft.", soft=0.4),
        good("The same, slow.", tempo=2.0, seconds=18),
        good("The same, only the left side.", used="left"),
        good("The same, noisy encoders.", noise=0.0025, hand_noise=0.003),
        bad("duplicate", "plain", "Episode 2 was saved twice.", marked("", 0, 1), copied=2),
        bad("idle_start", "moderate", "8 s pass before the first motion of 17 s.",
            at_end("", 8, "start"), lead=8.2, seconds=17),
        bad("jump", "plain", "The left arm's elbow has slipped by 0.6 rad from the middle on.",
            jump("left_arm", 0.6, 0)),
        bad("repeated_frames", "plain", "Every row three times, in the last 60 %.",
            repeated(3, 0.6)),
    ), base={"follow": "next"}),
    Set("one_inspire", "v3.0", "inspire-dfx", 15, (
        good("One arm and one hand, 15 frames a second."),
        good("The same, tempo of a beginner.", tempo=1.7, seconds=20),
        good("The same, quick.", tempo=0.7),
        good("The same, a stiff arm.", lag=0.04, sag=0.0),
        good("The same, the object is large.", touch=0.42),
        bad("inverted_sign", "moderate", "Wrist roll and wrist yaw of the state are inverted.",
            inverted("right_arm", [4, 6]), reach=1.2),
        bad("frozen_joint", "plain", "The right elbow's reading stands still for half.",
            frozen(["right_arm"], 0.5, True)),
        bad("action_shift", "plain", "Actions are 0.8 s ahead of observations.", shifted(0.8),
            seconds=15),
        bad("clipped_action", "plain", "All fingers' actions end at half of the way; the hand goes "
            "on.", clipped("right_hand", 0.25, 6), touch=0.9),
    ), parts=RIGHT, tasks=("Put the cup on the tray.",)),
    Set("xr_dex3", "xr v1.4", "dex3-1", 30, (
        good("A task folder with times of frames, and pictures as files."),
        good("Quick, the left side rests.", used="right", tempo=0.7),
        good("Overshooting arms.", damping=0.45, lag=0.11),
        good("No object at all: gestures.", touch=0),
        good("Noisy encoders.", noise=0.002, hand_noise=0.004),
        good("Open fingers read 0.06 rad beyond their limits, as those of real hands do.",
             beyond=0.06),
        bad("camera_missing", "plain", "None of its pictures is there.",
            camera("color_0", "none", 0)),
        bad("camera_frozen", "plain", "One picture for 45 %.", camera("color_0", "frozen", 0.45)),
        bad("broken_file", "plain", "data.json ends in the midst of an item.", told("cut", 0.6)),
        bad("no_task", "plain", "The goal is empty.", told("no task")),
        bad("frozen_side", "plain", "The left hand's state stands still for half.",
            frozen(["left_hand"], 0.5)),
        bad("wrong_fps", "plain", "Its stamps are of 20 frames a second, its info says 30.",
            told("hz", 20), rate=20),
    ), cameras=("color_0",), columns=RAD, base={"seconds": 9.0}),
    Set("xr_old_dex3", "xr v0.5", "dex3-1", 30, (
        good("A task folder of the first release."),
        good("Slow.", tempo=1.8, seconds=19),
        good("Only the left side.", used="left"),
        good("A pause of 2 s.", pause=2.0),
        good("The hands move as in a sample.", hand="direct", seconds=12),
        bad("not_finite", "plain", "NaN in a finger for 8 frames.",
            not_finite("left_hand", 8, np.nan)),
        bad("repeated_frames", "plain", "Each item is there twice.", repeated(2)),
        bad("missing_stretch", "plain", "1.5 s of items are lost, idx shows it.",
            missing(1.5, False)),
        bad("wrong_unit", "moderate", "The left hand is a part of the travel, not rad.",
            scaled(["left_hand"], part_of_travel)),
        bad("broken_file", "moderate", "data.json is not UTF-8: the goal was saved as Latin-1.",
            told("latin")),
        bad("frozen_all", "moderate", "All states stand still for a quarter.", frozen(ALL, 0.27)),
    )),
    Set("xr_brainco", "xr v1.1", "brainco-revo2", 30, (
        good("A task folder of release 1.1."),
        good("Slow hands.", hand_lag=0.28),
        good("Steps of a hundredth.", step=0.01),
        good("Both sides mirrored.", same=True),
        good("Very quick.", tempo=0.6, seconds=9, reach=0.7),
        bad("wrong_unit", "plain", "The right hand's state is 1 to 0, its action 0 to 1.",
            turn_state),
        bad("wrong_side", "plain", "The states of both arms are exchanged.", exchanged("arm")),
        bad("wrong_joint_order", "moderate", "Thumb and little finger of the left hand's state "
            "are exchanged.", reordered("left_hand", (5, 1, 2, 3, 4, 0)), hand="fingers",
            seconds=8.3),
        bad("lag_drift", "plain", "The observation falls behind by up to 1.0 s.", drifting(1.0),
            seconds=16),
        bad("idle_start", "plain", "10 s of nothing first.", at_end("", 10, "start"), lead=10.2,
            seconds=20),
    )),
    Set("touch_dex3", "v3.0", "dex3-1", 30, (
        good("Hands alone with their pressure."),
        good("A soft object.", soft=0.3),
        good("The right hand alone works.", used="right"),
        good("Held for 18 s.", squeeze=1, cycles=1, seconds=26),
        good("Another object, thinner.", touch=0.75),
        bad("drop_in_grasp", "plain", "The object slips out of the right hand: pressure and torque "
            "fall while it stays closed.", dropped("right_hand"), used="right", cycles=1,
            loses=0.35, seconds=12),
        bad("drop_in_grasp", "plain", "The object slips out of the left hand, pressure falls.",
            dropped("left_hand"), used="left", cycles=1, loses=0.5, seconds=13),
        bad("grasp_on_nothing", "plain", "The right hand closes on nothing: no pressure.",
            marked("right_hand", 0.25, 0.8), empty="right", cycles=1, used="right", seconds=10),
        bad("not_followed", "moderate", "The right hand lies without power for 40 %.",
            limp(["right_hand"], 0.4, 0.04), tempo=0.8),
    ), names="dexkit", columns=(*RAD, "pressure"), parts=HANDS_ONLY),
    Set("sixty_as_thirty", "v2.1", "dex1-1", 30, tuple(
        bad("wrong_fps", "plain", "60 frames a second by the stamps, fps says 30.",
            marked("", 0, 1), rate=60, seconds=9.0 + i)
        for i in range(3)
    ), stamp=60),
    Set("no_metadata", "v3.0", "dex3-1", 30, (good("-"), good("-")), base={"seconds": 6.0}),
    Set("names_latin", "v2.1", "brainco-revo2", 30, (good("-"), good("-")), base={"seconds": 6.0}),
)  # fmt: skip

SESSIONS = Set("sessions", "xr v1.4", "dex3-1", 30, (
    good("Arms and hands with measured times.", seconds=10),
    good("A quick operator, the right side rests.", used="left", tempo=0.6, seconds=8),
    bad("frozen_side", "plain", "The right hand's state stands still for half.",
        frozen(["right_hand"], 0.5), seconds=11),
    bad("not_followed", "plain", "The left arm is off for half of the episode and sinks.",
        limp(["left_arm"], 0.5, 0.3), seconds=12),
), columns=RAD)  # fmt: skip

WIRES = (
    Wire("wire_pick", "dex1_pick_place", 1.2, 11.0, Label("good", "Grippers on the wire.")),
    Wire("wire_pick_late", "dex1_pick_place", 11.2, 21.0, Label("good", "Likewise, later.")),
    Wire("wire_pinch", "dex3_pinch", 2.6, 10.4, Label("good", "Open, pinch, open.")),
    Wire("wire_brainco", "brainco_grip", 1.6, 6.4, Label("good", "Finger after finger.")),
    Wire("wire_ftp", "inspire_ftp_grip", 2.0, 13.9, Label("good", "With touch.")),
    Wire("wire_dex5", "dex5_synthetic", 0.6, 5.9, Label("good", "Twenty joints, short.")),
    Wire("wire_shift", "dex1_legacy_v1_1", 1.0, 17.0, Label(
        "spoiled", "The commands are stamped 0.6 s late: states come before them.", "action_shift",
        "", [], 0, 16, "plain"), late="/cmd", by=0.6),
    Wire("wire_frozen", "dex3_pinch", 10.5, 18.6, Label(
        "spoiled", "The left hand's state is the same for 4.5 s.", "frozen_side", "left_hand", [],
        1.5, 6.0, "plain"), frozen="left/state", window=(1.5, 6.0)),
    Wire("wire_gap", "brainco_grip", 6.5, 11.9, Label(
        "spoiled", "All topics are silent for 1.8 s.", "missing_stretch", "", [], 1.6, 3.4,
        "plain"), lost="/", window=(1.6, 3.4)),
    Wire("wire_dropout", "dex1_hand_dropout", 2.0, 18.0, Label(
        "spoiled", "The left gripper's state is silent for 1.5 s.", "missing_stretch", "left_hand",
        [], 7.5, 9.0, "plain")),
    Wire("wire_idle", "dex1_idle_then_startle", 1.6, 15.5, Label(
        "spoiled", "Almost 7 s pass before the operator moves.", "idle_start", "", [], 0, 6.8,
        "moderate")),
    Wire("wire_copy", "dex1_pick_place", 1.2, 11.0, Label(
        "spoiled", "A copy of wire_pick.mcap.", "duplicate", "", [], 0, 9.8, "plain")),
)  # fmt: skip

BAGS = (
    Wire("bag_dfx", "inspire_dfx_grip", 1.6, 7.6, Label("good", "A bag of Inspire hands.")),
    Wire("bag_frozen", "inspire_dfx_grip", 7.7, 13.9, Label(
        "spoiled", "The message of both hands' states is the same for 3 s.", "frozen_all", "", [],
        1.5, 4.5, "plain"), frozen="/state", window=(1.5, 4.5)),
)  # fmt: skip


def write_all(out: Path) -> None:
    """Write every set below a folder that does not exist yet, and its labels."""
    out.mkdir(parents=True)
    library = load_library()
    labels: list[dict[str, Any]] = []

    def tell(dataset: str, form: str, episode: int | str | None, label: Label) -> None:
        told_of = dataclasses.asdict(label)
        order = ("expect", "fault", "part", "joints", "begin_s", "end_s", "strength", "say")
        row = {"dataset": dataset, "form": form, "episode": episode}
        labels.append(row | {k: told_of[k] for k in order})

    for number, made in enumerate(SETS):
        takes = takes_of(made, library, 100 + number)
        root = out / made.name
        xr = made.form.startswith("xr")
        if xr:
            write_xr(root, made, takes, full="velocity" in made.columns)
        elif made.form == "export":
            write_export(root, made, takes)
        else:
            write_lerobot(AUTHOR, root, made, takes)
        form = "lerobot-v3.0" if made.form == "export" else f"lerobot-{made.form}"
        form = made.form.replace(" ", "-") if xr else form
        if made.name == "no_metadata":
            (root / "meta/info.json").unlink()
            gone = Label("spoiled", "meta/info.json is gone.", "broken_file", strength="plain")
            tell(made.name, form, None, gone)
        elif made.name == "names_latin":
            path = root / "meta/info.json"
            path.write_bytes(path.read_bytes().replace(b"kLeftElbow", b"kCoude\xe9Gauche"))
            wrong = Label("spoiled", "Names of joints are Latin-1, no UTF-8.", "broken_file")
            wrong.strength = "moderate"
            tell(made.name, form, None, wrong)
        else:
            for e, take in enumerate(takes):
                tell(made.name, form, f"episode_{e:04d}" if xr else e, take.label)
    folder = out / "recordings"
    folder.mkdir()
    for i, take in enumerate(takes_of(SESSIONS, library, 50)):
        write_session(folder / f"session_{i}.mcap", SESSIONS, take)
        tell(f"recordings/session_{i}.mcap", "mcap", None, take.label)
    for wire in WIRES:
        write_wire(folder / f"{wire.name}.mcap", wire)
        tell(f"recordings/{wire.name}.mcap", "mcap", None, wire.label)
    for wire in BAGS:
        work = out / f"{wire.name}.mcap"
        write_wire(work, wire)
        dexkit("export", work, "--to", "rosbag2", "--out", out / "bags" / wire.name)
        work.unlink()
        tell(f"bags/{wire.name}", "rosbag2", None, wire.label)
    write_json(out / "labels.json", labels)
    count = sum(label["expect"] == "good" for label in labels)
    print(f"{out}: {len(labels)} episodes, {count} good, {len(labels) - count} spoiled")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tools.spoiled_sets.author_e OUT")
    write_all(Path(sys.argv[1]))
