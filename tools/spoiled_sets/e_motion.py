"""Motion of hands and arms as a faultless recorder would write it, for :mod:`author_e`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.traces import sample_path
from dexkit.traces.reader import open_trace
from dexkit.traces.sessions.frames import open_source, sample
from dexkit.traces.sessions.streams import COMMAND, STATE

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Rng = np.random.Generator

RATE = 120  # Hz of the motion before it is sampled as frames
SIDES = ("left", "right")


# -- hands: what the shipped samples have -----------------------------------------------------


@dataclass(frozen=True)
class Hand:
    """A model of hand.

    :param closing: the sign of each joint's motion when the left hand closes; 0 for neither.
    :param mirror: factor from a left joint to the right one.
    :param top: full travel of a joint.
    :param speed: the fastest motion, travel units a second.
    :param step: resolution of the encoders.
    :param stiff: effort for a distance of one unit between action and state.
    """

    samples: tuple[str, ...]
    closing: tuple[int, ...]
    mirror: tuple[int, ...]
    top: float
    speed: float
    step: float
    stiff: float
    motors: tuple[str, ...]


_DEX5 = tuple(f"{n}" for f in "2345" for n in (f"Roll_{f}1", *(f"Pitch_{f}{j}" for j in "234")))
HANDS = {
    "dex3-1": Hand(
        ("dex3_pinch",), (0, 1, 1, -1, -1, -1, -1), (1, -1, -1, -1, -1, -1, -1), 1.7, 9, 0, 1.5,
        ("Thumb0", "Thumb1", "Thumb2", "Middle0", "Middle1", "Index0", "Index1"),
    ),
    "dex1-1": Hand(
        ("dex1_pick_place", "dex1_legacy_v1_1"), (-1,), (1,), 5.4, 20, 0.0, 5.0, ("Gripper",)
    ),
    "dex5-1": Hand(
        ("dex5_synthetic",), (0, 1, 1, 1) * 4 + (0, -1, 1, 1), (1,) * 17 + (-1, 1, 1), 1.6, 3.2,
        0, 0.1, (*_DEX5, "Yaw_11", "Roll_12", "Pitch_13", "Pitch_14"),
    ),
    "brainco-revo2": Hand(
        ("brainco_grip",), (1,) * 6, (1,) * 6, 1.0, 1.6, 0.001, 2.0,
        ("Thumb", "ThumbAux", "Index", "Middle", "Ring", "Pinky"),
    ),
    "inspire-dfx": Hand(
        ("inspire_dfx_grip",), (-1,) * 6, (1,) * 6, 1.0, 1.25, 0.001, 2.0,
        ("Pinky", "Ring", "Middle", "Index", "ThumbBend", "ThumbRotation"),
    ),
    "inspire-ftp": Hand(
        ("inspire_ftp_grip",), (-1,) * 6, (1,) * 6, 1.0, 1.25, 0.001, 2.0,
        ("Pinky", "Ring", "Middle", "Index", "ThumbBend", "ThumbRotation"),
    ),
}  # fmt: skip
ARM = ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch",
       "WristYaw")  # fmt: skip
ARM_MIRROR = np.array([1, -1, -1, 1, -1, 1, -1.0])
HOME = np.array([-0.1, 0.28, 0.1, 0.6, 0.05, -0.1, 0.0])
SPREAD = np.array([0.45, 0.18, 0.3, 0.4, 0.35, 0.25, 0.25])
ARM_LOW = np.array([-2.6, -0.3, -1.5, -0.8, -1.6, -1.3, -1.3])
ARM_HIGH = np.array([1.2, 1.7, 1.5, 1.9, 1.6, 1.3, 1.3])
ARM_STIFF = np.array([80, 80, 80, 80, 40, 40, 40.0])
TOUCH = tuple(
    f"{place}_{slot}"
    for place, slots in (
        ("thumb_pad", (0, 2, 9, 11)), ("thumb_tip", (3, 6, 8)), ("middle_pad", (0, 2, 9, 11)),
        ("middle_tip", (3, 6, 8)), ("index_pad", (0, 2, 9, 11)), ("index_tip", (3, 6, 8)),
        ("palm_0", (0, 2, 9, 11)), ("palm_1", (0, 2, 9, 11)), ("palm_2", (0, 2, 9, 11)),
    )
    for slot in slots
)  # fmt: skip


@dataclass(frozen=True)
class Recorded:
    """A hand of a sample at RATE: (n, joints).

    :param paths: its ways from open to closed.
    :param begin: where its action has made its first step, from rest to the operator's pose.
    """

    action: Floats
    state: Floats
    effort: Floats
    paths: list[Floats]
    begin: int


def closure(action: Floats, closing: Floats) -> Floats:
    """How far the hand is closed, 0 to 1 over the table."""
    along = (action * closing).sum(axis=1)
    spread = np.ptp(along)
    found: Floats = (along - along.min()) / (spread if spread > 0 else 1.0)
    return found


def _paths(action: Floats, closing: Floats) -> list[Floats]:
    """Pieces from a turning point where the hand is open to the next one where it is closed."""
    c = closure(action, closing)
    found, low, high = [], 0, 0
    for i in range(len(c)):
        if c[i] < c[low]:
            low = high = i
        elif c[i] >= c[high]:
            high = i
        if c[high] - c[i] > 0.3 or i == len(c) - 1:
            if c[high] - c[low] > 0.35:
                piece = action[low : high + 1]
                moving = np.flatnonzero(
                    (c[low : high + 1] > c[low] + 0.02) & (c[low : high + 1] < c[high] - 0.02)
                )
                first, last = max(0, moving[0] - 2), moving[-1] + 3
                piece, gone = piece[first:last], c[low : high + 1][first:last]
                # at an even pace, so that the time of the way can be chosen
                gone = np.maximum.accumulate(gone) + np.arange(len(gone)) * 1e-7
                at = np.interp(np.linspace(gone[0], gone[-1], 80), gone, np.arange(len(gone)))
                path = rows_at(piece, at)
                kernel = np.ones(5) / 5
                padded = np.pad(path, ((2, 2), (0, 0)), mode="edge")
                found.append(
                    np.stack([np.convolve(x, kernel, mode="valid") for x in padded.T], axis=1)
                )
            low = high = i
    return found


def rows_at(table: Floats, places: Floats) -> Floats:
    """Rows of a table at fractional places."""
    grid = np.arange(len(table))
    return np.stack([np.interp(places, grid, column) for column in table.T], axis=1)


def load_library() -> dict[tuple[str, str], list[Recorded]]:
    """By model and side, what the samples have, and the mirrored other side."""
    library: dict[tuple[str, str], list[Recorded]] = {}
    for model, hand in HANDS.items():
        for name in hand.samples:
            runs, _ = sample(open_source(open_trace(sample_path(name))), RATE)
            frames = max(runs, key=len)
            for side in SIDES:
                part = f"{side}_hand"
                action = frames.values[part, COMMAND, "q"]
                state = frames.values[part, STATE, "q"]
                effort = frames.values.get((part, STATE, "tau"), np.zeros_like(state))
                for own in (side, SIDES[side == "left"]):
                    factor = np.array(hand.mirror if own != side else [1] * len(hand.mirror))
                    a = action * factor
                    paths = _paths(a, signs(model, own))
                    if model == "dex1-1":  # not those that end at half the stroke, at the start
                        paths = [path for path in paths if path[-1, 0] < 1.0]
                    pace = np.abs(np.diff(a, axis=0)).max(axis=1)
                    steps = np.flatnonzero(pace[: len(a) * 2 // 5] > 0.05 * hand.top)
                    library.setdefault((model, own), []).append(
                        Recorded(a, state * factor, effort * factor, paths,
                                 int(steps[-1]) + 15 if len(steps) else 0)
                    )  # fmt: skip
    return library


def signs(model: str, side: str) -> Floats:
    """The sign of each joint's motion when the hand closes."""
    hand = HANDS[model]
    factor = np.array(hand.mirror if side == "right" else [1] * len(hand.mirror))
    found: Floats = np.array(hand.closing, dtype=np.float64) * factor
    return found


# -- the motion of an episode -----------------------------------------------------------------


@dataclass(frozen=True)
class Style:
    """How an episode is made; times in s, angles in rad.

    :param hand: cycle, opens, direct (a piece of a sample as it is; fingers: one finger after
        the other), holding (closed all the time), late (only at the end), stops (from end to end).
    :param used: sides that work; the other arm and hand rest.
    :param touch: how far along its way a hand meets the object; 0 for no object.
    :param lag: of the arms. ``hand_lag``: of the hands.
    :param loses: the part of the hold after which the object is gone, 0 for never.
    :param follow: delayed, same (action is the state), next (action is the next state).
    :param stairs: frames for which the action is held, as of a slower operator's program.
    """

    seconds: float = 14.0
    tempo: float = 1.0
    hand: str = "cycle"
    used: str = "both"
    touch: float = 0.62
    empty: str = ""
    soft: float = 0.04
    lag: float = 0.08
    hand_lag: float = 0.06
    damping: float = 0.75
    sag: float = 0.012
    reach: float = 1.0
    noise: float = 0.0006
    hand_noise: float = 0.0015
    step: float = 0.0
    tremor: float = 0.002
    lead: float = 0.5
    tail: float = 0.5
    pause: float = 0.0
    cycles: int = 0
    loses: float = 0.0
    squeeze: float = 0.0
    beyond: float = 0.0
    follow: str = "delayed"
    stairs: int = 1
    begin: float = 0.0
    end: float = 0.0
    same: bool = False
    bodyless: bool = False


@dataclass
class Label:
    """What is right or wrong with an episode."""

    expect: str
    say: str
    fault: str = ""
    part: str = ""
    joints: list[int] = field(default_factory=list)
    begin_s: float | None = None
    end_s: float | None = None
    strength: str = ""


@dataclass
class Track:
    """A part at the frames: (n, joints)."""

    state: Floats
    action: Floats
    velocity: Floats
    effort: Floats


@dataclass
class Take:
    """An episode.

    :param seen: what the cameras see, at every frame as it truly was: (n, 6).
    :param shown: the frame that each picture shows, by camera.
    :param done: what is done to the files at last.
    """

    model: str
    fps: float
    tracks: dict[str, Track]
    touch: dict[str, Floats]
    seen: Floats
    task: str
    label: Label
    number: Ints
    shown: dict[str, Ints] = field(default_factory=dict)
    done: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.number)


def ease(u: Floats) -> Floats:
    """Minimum jerk from 0 to 1."""
    u = np.clip(u, 0, 1)
    found: Floats = u**3 * (10 - 15 * u + 6 * u**2)
    return found


def _wobble(rng: Rng, n: int, joints: int, size: float, hz: float) -> Floats:
    """Smooth noise of about this frequency."""
    width = max(2, round(RATE / hz / 2))
    kernel = np.hanning(width * 2 + 1)
    raw = rng.standard_normal((joints, n + 2 * width))
    smooth = np.stack([np.convolve(row, kernel, mode="valid") for row in raw], axis=1)
    found: Floats = smooth / np.sqrt((kernel**2).sum()) * size
    return found


@dataclass
class Plan:
    """What one side is asked to do, at RATE."""

    arm: Floats
    hand: Floats
    bound: Floats  # where an object stops each joint, 1e9 where there is none
    closed: NDArray[np.bool_]


def _plan(rng: Rng, style: Style, model: str, side: str, recorded: Sequence[Recorded]) -> Plan:
    n = round(style.seconds * RATE)
    t = np.arange(n) / RATE
    joints = len(HANDS[model].motors)
    arm_signs = np.ones(7) if side == "left" else ARM_MIRROR
    works = style.used in ("both", side)
    usable = style.seconds - style.lead - style.tail - style.pause
    cycles = style.cycles or max(1, round(usable / (8 * style.tempo)))
    period = usable / cycles
    pause_at = style.lead + 0.4 * period
    u = np.where(t > pause_at, np.maximum(pause_at, t - style.pause), t) - style.lead

    def pose(scale: float) -> Floats:
        found = HOME + rng.normal(0, 1, 7).clip(-1.6, 1.6) * SPREAD * scale * style.reach
        return np.asarray(np.clip(found, ARM_LOW, ARM_HIGH))

    rest = pose(0.25)
    arm = np.tile(rest, (n, 1))
    paths = [p for r in recorded for p in r.paths]
    progress: Floats = np.zeros(n)
    path = paths[int(rng.integers(len(paths)))]
    hand = np.tile(path[0], (n, 1))
    bound = np.full((n, joints), 1e9)
    closed = np.zeros(n, dtype=bool)
    sign = signs(model, side)
    reaching = u if works else np.full(n, -1.0)
    now, shape = rest, path[0]
    for k in range(cycles):
        f = np.array([0.02, 0.26, 0.28, 0.40, 0.45, 0.57, 0.60, 0.72, 0.74, 0.85, 0.86, 0.99])
        f[1:-1] += rng.normal(0, 0.006, 10)
        begins = rng.uniform(0, 0.25)  # the sides do not act at once
        f = begins + f * (1 - begins)
        if style.squeeze:  # an object held for so long
            f[4:] = f[4:] * 0.14 + 0.86
            f[3] = f[2] + 0.12
        at = (k + f) * period
        goals = [pose(1.0), pose(0.6), pose(1.0), pose(0.3)]
        for goal, a, b in zip(goals, at[[0, 4, 6, 10]], at[[1, 5, 7, 11]], strict=True):
            share = ease((reaching - a) / max(b - a, 0.2))[:, None]
            arm = np.where(share > 0, arm + (goal - now) * share, arm)
            now = goal
        if not works or style.hand in ("direct", "fingers"):
            continue
        if style.hand != "holding" or k == 0:
            path = paths[int(rng.integers(len(paths)))]
        shift = ease((u - k * period) / (0.2 * period))[:, None]
        opening = (style.hand == "opens") or (style.hand == "holding")
        p = ease((u - at[2]) / (at[3] - at[2])) - ease((u - at[8]) / (at[9] - at[8]))
        if style.hand == "late" and k < cycles - 1:
            p = np.zeros(n)
        if style.squeeze:
            p = p * (0.8 + 0.2 * np.clip((u - at[3]) / (at[8] - at[3]), 0, 1))
        if opening:
            p = 1 - ease((u - at[8]) / (at[9] - at[8])) if style.hand == "opens" else np.ones(n)
            shape = path[0]
            progress[:] = 1.0 if style.hand == "holding" else progress
        inside = (u >= k * period) & (u < (k + 1) * period) | ((k == 0) & (u < 0))
        inside |= (k == cycles - 1) & (u >= (k + 1) * period)
        progress = np.where(inside, p, progress)
        way = rows_at(path, np.clip(p, 0, 1) * (len(path) - 1))
        way = np.where(shift < 1, way + (shape - path[0]) * (1 - shift), way)
        hand = np.where(inside[:, None], way, hand)
        shape = path[0]
        meets = style.touch + rng.uniform(-0.06, 0.06) if style.touch else 0.0
        if meets and style.empty != side and style.hand != "stops":
            holds = inside & (u > at[2] - 0.1)
            if style.hand == "holding":
                holds, meets = np.ones(n, dtype=bool), style.touch
            if style.loses:
                holds &= u < at[3] + style.loses * (at[8] - at[3])
            stop = path[round(meets * (len(path) - 1))]
            moves = (np.abs(path[-1] - path[0]) > 0.06 * HANDS[model].top) & (sign != 0)
            bound[np.ix_(holds, moves)] = np.where(sign > 0, stop, -stop)[moves]
        closed |= inside & (p > 0.9)
    arm = arm + _wobble(rng, n, 7, style.tremor * (1.0 if works else 0.0), 4.0)
    hand = (
        hand
        + _wobble(rng, n, joints, 0.0015 * HANDS[model].top * bool(style.tremor), 2.0)
        * ((progress > 0.02) & (progress < 0.98))[:, None]
        * works
    )
    if style.hand == "stops":
        hand = hand + sign * 0.08 * HANDS[model].top * (2 * progress[:, None] - 1)
        hand = np.clip(hand, 0, HANDS[model].top)
    return Plan(arm * arm_signs, hand, bound, closed)


def _answer(
    rng: Rng, style: Style, model: str, plans: dict[str, Plan]
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Positions of all parts, and the actions as a clipping client sends them."""
    hand, n = HANDS[model], len(plans["left"].arm)
    k = len(hand.motors)
    ask = np.concatenate([plans[s].arm for s in SIDES] + [plans[s].hand for s in SIDES], axis=1)
    late = np.full(14 + 2 * k, 0)
    late[:14] = round(style.lag * 0.3 * RATE)
    late[14:] = round(style.hand_lag * 0.4 * RATE)
    delayed = np.stack(
        [np.concatenate([np.full(d, ask[0, j]), ask[: n - d, j]]) for j, d in enumerate(late)],
        axis=1,
    )
    w = np.full(14 + 2 * k, 2 * 0.95 / max(style.hand_lag * 0.6, 0.012))
    w[:14] = 2 * style.damping / max(style.lag * 0.7, 0.012)
    w *= rng.uniform(0.92, 1.08, len(w))
    damping = np.full(len(w), 0.95)
    damping[:14] = style.damping
    weights = np.tile([1, 0.2, 0.1, 0.8, 0.1, 0.5, 0.1], 2)
    target = delayed.copy()
    target[:, :14] += style.sag * weights * (1 + 0.3 * np.sin(delayed[:, :14]))
    top = np.full(len(w), 6.0)
    top[14:] = hand.speed
    sign = np.concatenate([np.zeros(14), signs(model, "left"), signs(model, "right")])
    bound = np.full((n, len(w)), 1e9)
    bound[:, 14:] = np.concatenate([plans[s].bound for s in SIDES], axis=1)
    gripper = model == "dex1-1"
    step, h = np.empty((n, len(w))), 1 / RATE
    sent = ask.copy()
    s: Floats = target[0].copy()
    v: Floats = np.zeros(len(w))
    s = np.where(sign * s > bound[0], sign * bound[0], s)
    for i in range(n):
        goal = target[i]
        if gripper:  # the client never asks for more than 0.18 rad beyond the state
            goal[14:] = np.clip(goal[14:], s[14:] - 0.18, s[14:] + 0.18)
            sent[i, 14:] = goal[14:]
            v[14:] = (goal[14:] - s[14:]) / 0.027
            v[:14] += h * (w[:14] ** 2 * (goal[:14] - s[:14]) - 2 * damping[:14] * w[:14] * v[:14])
        else:
            # implicit in the damping: stiff joints stay stable at this rate
            v = (v + h * w**2 * (goal - s)) / (1 + h * 2 * damping * w + (h * w) ** 2)
        v = np.clip(v, -top, top)
        s = s + h * v
        over = sign * s - bound[i]
        hit = over > 0
        if hit.any():
            give = np.clip(style.soft * (sign * goal - bound[i]), 0, None)
            s = np.where(hit & (over > give), sign * (bound[i] + give), s)
            v = np.where(hit, 0, v)
        step[i] = s
    if style.beyond:
        step[:, 14:] += sign[14:] * -style.beyond
    names = ("left_arm", "right_arm", "left_hand", "right_hand")
    edges = np.cumsum([0, 7, 7, k, k])
    cuts = {p: slice(edges[i], edges[i + 1]) for i, p in enumerate(names)}
    return {p: step[:, c] for p, c in cuts.items()}, {p: sent[:, c] for p, c in cuts.items()}


def make(
    rng: Rng, library: dict[tuple[str, str], list[Recorded]], model: str, fps: float, style: Style
) -> Take:
    """One episode as a faultless recorder would write it."""
    hand = HANDS[model]
    seeds = rng.integers(0, 2**31, 2).tolist()
    plans = {
        side: _plan(np.random.default_rng(seed), style, model, side, library[model, side])
        for side, seed in zip(SIDES, seeds, strict=True)
    }
    if style.same:
        factor = np.array(hand.mirror, dtype=np.float64)
        left = plans["left"]
        plans["right"] = Plan(
            left.arm * ARM_MIRROR, left.hand * factor, left.bound.copy(), left.closed
        )
    pieces: dict[str, tuple[Floats, Floats, Floats]] = {}
    if style.hand in ("direct", "fingers"):
        for side in SIDES:
            if style.used not in ("both", side):
                continue
            own = library[model, side]
            chosen = own[0 if style.hand == "fingers" else int(rng.integers(len(own)))]
            warp = rng.uniform(0.86, 1.15)
            n = round(style.seconds * RATE)
            room = len(chosen.action) - 1 - n * warp
            begin = rng.uniform(min(chosen.begin, room), max(0.0, room))
            at = np.minimum(begin + np.arange(n) * warp, len(chosen.action) - 1)
            spread = np.arange(len(hand.motors)) * (0.3 * RATE if style.hand == "fingers" else 0)
            places = np.clip(at[:, None] - spread, chosen.begin, None)
            whole = (chosen.action, chosen.state, chosen.effort)
            a, b, c = (
                np.stack(
                    [rows_at(x[:, [j]], places[:, j])[:, 0] for j in range(x.shape[1])], axis=1
                )
                for x in whole
            )
            pieces[f"{side}_hand"] = a, b, c
    states, actions = _answer(rng, style, model, plans)
    begin, end = round(style.begin * RATE), round((style.seconds - style.end) * RATE)
    count = int((end - begin) * fps / RATE)
    at = begin + np.arange(count) * RATE / fps
    tracks = {}
    for part, full in states.items():
        ask, force = actions[part], None
        if part in pieces:
            ask, full, force = pieces[part]
        is_arm = part.endswith("arm")
        width = full.shape[1]
        noise = style.noise if is_arm else style.hand_noise * hand.top
        step = style.step * (0.4 if is_arm else hand.top) or (0 if is_arm else hand.step)
        state = rows_at(full, at) + rng.normal(0, 1, (count, width)) * noise
        speed = np.gradient(full, axis=0) * RATE
        velocity = rows_at(speed, at) + rng.normal(0, 1, (count, width)) * noise * 6
        if force is None:
            gap = ask - full
            force = gap * (ARM_STIFF * 0.15 if is_arm else hand.stiff)
            force = np.clip(force, -25, 25) if is_arm else np.clip(force, -1.2, 1.2)
        effort = rows_at(force, at) + rng.normal(0, 1, (count, width)) * (0.05 if is_arm else 0.008)
        if hand.top == 1.0 and not is_arm:
            state = np.clip(state, 0, 1)
        if step:
            state = np.round(state / step) * step
        if style.follow == "same":
            action = state.copy()
        elif style.follow == "next":
            action = np.concatenate([state[1:], state[-1:]])
        else:
            action = ask[np.floor(at + 1e-6).astype(int)]
            if hand.top == 1.0 and not is_arm:
                action = np.clip(action, 0, 1)
        if style.stairs > 1:
            action = action[np.arange(count) // style.stairs * style.stairs]
        tracks[part] = Track(state, action.copy(), velocity, effort)
    touch = {}
    for side in SIDES:
        track, sign = tracks[f"{side}_hand"], signs(model, side)
        force_on = np.clip((track.effort * sign), 0.05, None) - 0.05
        load = force_on.sum(axis=1, keepdims=True)
        gains = rng.uniform(0, 700, len(TOUCH)) * (rng.random(len(TOUCH)) < 0.7)
        rest = 100_000 + rng.normal(0, 400, len(TOUCH))
        raw = rest + load * gains + rng.normal(0, 12, (count, len(TOUCH)))
        touch[f"{side}_hand"] = np.round(raw / 10) * 10
    true = {p: rows_at(f if p not in pieces else pieces[p][1], at) for p, f in states.items()}
    seen = np.stack(
        [
            v
            for i, s in enumerate(SIDES)
            for v in (
                26 + 44 * i + 22 * np.sin(true[f"{s}_arm"][:, 2]) + 22 * true[f"{s}_arm"][:, 1],
                28 + 24 * true[f"{s}_arm"][:, 0] + 16 * true[f"{s}_arm"][:, 3],
                11 - 5 * closure(true[f"{s}_hand"], signs(model, s)),
            )
        ],
        axis=1,
    )
    return Take(
        model, fps, tracks, touch, seen, "", Label("good", ""), np.arange(count, dtype=np.int64)
    )
