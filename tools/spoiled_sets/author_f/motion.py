"""The motion of good episodes: hands from the shipped recordings, arms of a person's reaches."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dexkit.traces.reader import Trace
from dexkit.traces.sessions.lerobot_out import export_dataset

__all__ = [
    "ARM",
    "FINGERS",
    "GOOD",
    "HANDS",
    "MIRROR",
    "SAMPLES",
    "Episode",
    "Floats",
    "Library",
    "Part",
    "Plan",
    "Rows",
    "contact",
    "make",
    "smooth",
]

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
SAMPLES = Path(__file__).resolve().parents[3] / "traces" / "samples"
BASE_HZ = 100
ARM = [f"shoulder_{axis}" for axis in ("pitch", "roll", "yaw")] + ["elbow"]
ARM += [f"wrist_{axis}" for axis in ("roll", "pitch", "yaw")]
# recording, episode of its export, side, first and last row at 100 Hz, an object is grasped
CLIPS = {
    "dex1": [
        ("dex1_pick_place", 0, "right", 230, 1050, True),
        ("dex1_pick_place", 0, "right", 1000, 1780, True),
        ("dex1_legacy_v1_1", 0, "right", 320, 1160, True),
        ("dex1_pick_place", 0, "left", 200, 2000, False),
        ("dex1_hand_dropout", 1, "left", 20, 840, False),
        ("dex1_hand_dropout", 1, "right", 20, 840, False),
        ("dex1_hand_dropout", 0, "right", 130, 840, False),
        ("dex1_idle_then_startle", 0, "left", 740, 1850, False),
        ("dex1_idle_then_startle", 0, "right", 740, 1850, False),
        ("dex1_legacy_v1_1", 0, "left", 150, 1700, False),
    ],
    "dex3": [
        ("dex3_pinch", 0, "right", 900, 1600, True),
        ("dex3_pinch", 0, "left", 300, 1850, False),
        ("dex3_pinch", 0, "right", 330, 960, False),
        ("dex3_pinch", 0, "right", 1540, 1850, False),
    ],
    "dex5": [
        ("dex5_synthetic", 0, "left", 120, 545, False),
        ("dex5_synthetic", 0, "right", 120, 545, False),
    ],
    "brainco": [
        ("brainco_grip", 0, "right", 195, 1000, True),
        ("brainco_grip", 0, "left", 205, 1050, False),
    ],
    "dfx": [
        ("inspire_dfx_grip", 0, "right", 210, 1250, True),
        ("inspire_dfx_grip", 0, "left", 210, 1255, False),
    ],
    "ftp": [
        ("inspire_ftp_grip", 0, "right", 10, 1090, True),
        ("inspire_ftp_grip", 0, "left", 10, 1240, False),
    ],
}


@dataclass(frozen=True)
class Hand:
    """A model: its name in the metadata, range of positions, pace of its clips, noise, step."""

    model: str
    low: Sequence[float]
    high: Sequence[float]
    opened: Sequence[float]
    pace: tuple[float, float]
    noise: float
    step: float
    contact: float  # distance of state and action at an object


HANDS = {
    "dex1": Hand("dex1-1", [0.0], [5.4], [5.4], (0.6, 1.6), 0.004, 0.0004, 0.12),
    "dex3": Hand(
        "dex3-1",
        [-1.05, -0.61, 0.0, -1.57, -1.75, -1.57, -1.75],  # left
        [1.05, 1.05, 1.75, 0.0, 0.0, 0.0, 0.0],
        [-0.3, -0.4, 0.05, -0.05, -0.05, -0.05, -0.05],
        (0.6, 1.5),
        0.002,
        0.0005,
        0.2,
    ),
    "dex5": Hand(
        "dex5-1",
        [*([-0.38, 0, 0, 0] * 4), -0.59, -1.82, 0, 0],
        [*([0.38, 1.57, 1.68, 1.4] * 4), 0.68, 0, 1.77, 1.64],
        [0.0] * 20,
        (0.35, 0.75),
        0.001,
        0.0,
        9.0,
    ),
    "brainco": Hand("brainco-revo2", [0.0] * 6, [1.0] * 6, [0.0] * 6, (0.5, 1.2), 0, 0.001, 0.12),
    "dfx": Hand("inspire-dfx", [0.0] * 6, [1.0] * 6, [1.0] * 6, (0.5, 1.25), 0.0007, 0.001, 0.12),
    "ftp": Hand("inspire-ftp", [0.0] * 6, [1.0] * 6, [1.0] * 6, (0.5, 1.25), 0.0007, 0.001, 0.12),
}
MIRROR = {"dex3": [1, -1, -1, -1, -1, -1, -1], "dex5": [1] * 17 + [-1] + [1] * 2}
ARM_MIRROR = np.array([1, -1, -1, 1, -1, 1, -1])
FINGERS = {
    "dex1": (["Gripper"], ["Gripper"]),
    # the converter names the right hand's columns index before middle; their numbers are not
    "dex3": tuple(
        [f"Hand{f}{i}" for f, k in (("Thumb", 3), (a, 2), (b, 2)) for i in range(k)]
        for a, b in (("Middle", "Index"), ("Index", "Middle"))
    ),
    "brainco": 2
    * ([f"Hand{f}" for f in ["Thumb", "ThumbAux", "Index", "Middle", "Ring", "Pinky"]],),
    "dfx": 2
    * ([f"Hand{f}" for f in ["Pinky", "Ring", "Middle", "Index", "ThumbBend", "ThumbRotation"]],),
}
FINGERS["ftp"] = FINGERS["dfx"]


@dataclass(eq=False)
class Part:
    """A hand or an arm; every field has a row a frame."""

    action: Floats
    state: Floats
    velocity: Floats
    effort: Floats
    pressure: NDArray[Any]

    def rows(self, index: Any) -> Part:
        """These rows."""
        return Part(**{k: np.array(v[index]) for k, v in vars(self).items()})

    def mixed(self, weight: Floats, other: Part) -> Part:
        """Crossfade: weight 0 is this, 1 the other."""
        w = weight[:, None]
        return Part(**{k: v * (1 - w) + getattr(other, k) * w for k, v in vars(self).items()})

    def joined(self, other: Part) -> Part:
        """Itself, then the other."""
        return Part(**{k: np.concatenate([v, getattr(other, k)]) for k, v in vars(self).items()})


@dataclass(eq=False)
class Episode:
    """An episode with its label; ``seen`` has the row of ``scene`` that each picture shows."""

    parts: dict[str, Part]
    task: str
    rate: float
    stamps: Floats
    numbers: Rows
    scene: Floats
    seen: dict[str, Rows | None]
    label: dict[str, Any]
    video_rate: float = 0.0
    broken: str = ""
    false_stats: float = 0.0
    time_ns: bool = False

    def __len__(self) -> int:
        return len(self.numbers)

    def keep(self, rows: Rows, *, renumber: bool = True) -> None:
        """Keep these rows of everything."""
        self.parts = {k: p.rows(rows) for k, p in self.parts.items()}
        self.seen = {k: v[rows] if v is not None else None for k, v in self.seen.items()}
        if renumber:
            self.numbers = np.arange(len(rows))
            self.stamps = self.numbers / self.rate
        else:
            self.numbers, self.stamps = self.numbers[rows], self.stamps[rows]


@dataclass(frozen=True)
class Plan:
    """A dataset: an entry an episode, ``good KIND`` or ``FAULT PART STRENGTH VARIANT``."""

    folder: str
    form: str
    hand: str
    fps: int
    style: str
    tasks: tuple[str, ...]
    entries: str
    arms: bool = True
    sides: tuple[str, ...] = ("left", "right")
    carries: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    grasp: bool = False
    spread: float = 0.15


class Library:
    """The clips of all hands, as left hands, from the exported recordings."""

    def __init__(self, work: Path) -> None:
        self.clips: dict[str, list[tuple[Part, bool]]] = {}
        self.names: dict[str, dict[str, list[str]]] = {}
        for hand, clips in CLIPS.items():
            for sample, episode, side, first, last, grasp in clips:
                folder = work / sample
                if not folder.exists():
                    trace = Trace(SAMPLES / f"{sample}.mcap")
                    export_dataset([trace], folder, fps=BASE_HZ, task="base")
                table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
                info = json.loads((folder / "meta/info.json").read_text())["features"]
                self.names[hand] = {
                    k: v["names"] for k, v in info.items() if isinstance(v.get("names"), list)
                }
                rows = np.flatnonzero(table["episode_index"].to_numpy() == episode)[first:last]
                part = self._part(table, rows, side)
                if side == "right":
                    part = mirrored(part, hand)
                self.clips.setdefault(hand, []).append((part, grasp))
        free = {h: next(c for c, grasp in own if not grasp) for h, own in self.clips.items()}
        self.lags = {h: _lag(part) for h, part in free.items()}

    @staticmethod
    def _part(table: Any, rows: Rows, side: str) -> Part:
        def read(name: str) -> Floats:
            if name not in table.column_names:
                return np.zeros((len(rows), 0))
            column = table[name].combine_chunks()
            flat = np.asarray(column.flatten(), dtype=np.float64).reshape(len(column), -1)[rows]
            half = flat.shape[1] // 2
            return flat[:, :half] if side == "left" else flat[:, half:]

        tables = {k: read(f"observation.{k}") for k in ("state", "velocity", "effort", "pressure")}
        return Part(action=read("action"), **tables)

    def track(
        self,
        rng: np.random.Generator,
        hand: str,
        side: str,
        seconds: float,
        grasp: bool,
        pace: float,
        spread: float,
        scale: tuple[float, float],
        touch: bool,
    ) -> Part:
        """A hand's motion at 100 Hz, of pieces of clips, crossfaded."""
        known = HANDS[hand]
        choice = [c for c, g in self.clips[hand] if g == grasp]
        joints = choice[0].action.shape[1]
        made: Part | None = None
        factor = rng.uniform(*scale, joints)
        while made is None or len(made.action) < seconds * BASE_HZ + 100:
            clip = choice[rng.integers(len(choice))]
            n = len(clip.action)
            rate = pace * rng.uniform(*known.pace)
            want = n if grasp else int(n * rng.uniform(0.45, 0.9))
            first = int(rng.integers(0, n - want + 1))
            # the pace itself changes slowly, as that of a person does
            t = np.arange(int(want / rate))
            wave = 1 + 0.2 * np.sin(t / BASE_HZ * rng.uniform(0.4, 1.2) + rng.uniform(0, 6))
            at = first + np.cumsum(rate * wave)
            at, wave = at[at < n - 1], wave[at < n - 1]
            # at another pace the hand itself is as quick as before
            behind = self.lags[hand] * (1 - rate * wave)
            piece = self._sampled(clip, at, behind, rng.uniform(-1, 1, joints) * spread * BASE_HZ)
            made = piece if made is None else _crossfade(made, piece, known)
        made = made.rows(slice(50, 50 + int(seconds * BASE_HZ)))
        opened = np.array(known.opened)
        for name in ("action", "state"):
            setattr(made, name, opened + (getattr(made, name) - opened) * factor)
        made.velocity = _velocity(made.state)
        if not made.effort.shape[1]:
            made.effort = np.zeros_like(made.state)
        if not touch:
            made.pressure = made.pressure[:, :0]
        return mirrored(made, hand) if side == "right" else made

    @staticmethod
    def _sampled(clip: Part, at: Floats, behind: Floats, shifts: Floats) -> Part:
        n = len(clip.action)
        found: dict[str, Floats] = {}
        for name, table in vars(clip).items():
            shift = shifts if table.shape[1] == len(shifts) else np.zeros(table.shape[1])
            base = at if name == "action" else at + behind
            place = np.clip(base[:, None] + shift, 0, n - 1.001)
            low = place.astype(int)
            columns = np.arange(table.shape[1])
            part = place - low
            found[name] = table[low, columns] * (1 - part) + table[low + 1, columns] * part
        return Part(**found)


def _lag(part: Part) -> float:
    """Rows by which the states follow the actions."""
    n, j = len(part.action), int(np.argmax(part.action.std(axis=0)))
    a, s = part.action[:, j], part.state[:, j]
    found = [np.corrcoef(a[: n - lag], s[lag:])[0, 1] for lag in range(40)]
    return float(np.argmax(found))


def _crossfade(a: Part, b: Part, known: Hand) -> Part:
    span = np.array(known.high) - np.array(known.low)
    far = float(np.max(np.abs(a.state[-1] - b.state[0]) / span))
    n = min(int((0.7 + 1.6 * far) * BASE_HZ), len(a.action) - 2, len(b.action) - 2)
    # the end of the one stands still while the beginning of the other comes
    tail = a.rows(np.full(n, len(a.action) - 1))
    head = b.rows(np.zeros(n, dtype=int))
    w = np.linspace(0, 1, n)
    bridge = tail.mixed(smooth(w), head)
    bridge.state = np.concatenate([np.repeat(bridge.state[:1], 6, axis=0), bridge.state[:-6]])
    return a.joined(bridge).joined(b)


def smooth(w: Any) -> Floats:
    """Minimum jerk from 0 to 1."""
    w = np.clip(w, 0, 1)
    return np.asarray(10 * w**3 - 15 * w**4 + 6 * w**5, dtype=np.float64)


def _velocity(state: Floats) -> Floats:
    slope = np.gradient(state, axis=0) * BASE_HZ
    kernel = np.ones(5) / 5
    return np.column_stack([np.convolve(c, kernel, "same") for c in slope.T])


def mirrored(part: Part, hand: str) -> Part:
    """A left hand as a right one, and the reverse."""
    if hand not in MIRROR:
        return part
    sign = np.array(MIRROR[hand])
    return Part(
        part.action * sign,
        part.state * sign,
        part.velocity * sign if part.velocity.shape[1] else part.velocity,
        part.effort * sign if part.effort.shape[1] else part.effort,
        part.pressure,
    )


def arm_track(rng: np.random.Generator, side: str, seconds: float, mood: dict[str, Any]) -> Part:
    """An arm's motion at 100 Hz: reaches and holds of a person, followed by a real arm."""
    n = int(seconds * BASE_HZ)
    pace = mood.get("arm_pace", mood.get("pace", 1.0))
    base = np.array([-0.2, 0.25, 0.0, 0.7, 0.0, 0.0, 0.0])
    spread = np.array([0.55, 0.22, 0.4, 0.5, 0.6, 0.35, 0.35]) * mood.get("reach", 1.0)
    # two performances of one task share the places, not the motion
    same = np.random.default_rng([mood["like"], len(side)]) if mood.get("like") else rng
    loose = 0.07 if mood.get("like") else 0.0
    goal = base + spread * same.uniform(-0.7, 0.7, 7) + rng.normal(0, 1, 7) * loose
    rows: list[Floats] = []
    total = 0
    while total < n:
        hold = np.repeat(goal[None], int(rng.uniform(10, 110) / pace), axis=0)
        new = base + spread * same.uniform(-1, 1, 7) + rng.normal(0, 1, 7) * loose
        w = smooth(np.linspace(0, 1, int(rng.uniform(90, 180) / pace)))[:, None]
        rows += [hold, goal + (new - goal) * w]
        total += len(hold) + len(w)
        goal = new
    plan = np.concatenate(rows)[:n]
    if mood.get("arm_rest") == side:
        plan = np.repeat(plan[:1], n, axis=0)
    else:
        shake = rng.normal(0, 1, (n + 60, 7))
        kernel = np.exp(-np.arange(30) / 6) * np.sin(np.arange(30) / 2.4)
        wobble = np.column_stack([np.convolve(c, kernel, "same")[:n] for c in shake.T])
        plan = plan + wobble / wobble.std() * mood.get("tremor", 0.0025)
    lag, zeta = rng.integers(1, 5), mood.get("zeta", rng.uniform(0.6, 0.95))
    wn = mood.get("wn", rng.uniform(20, 40))
    t = np.arange(200) / BASE_HZ
    wd = wn * np.sqrt(1 - zeta**2)
    response = wn**2 / wd * np.exp(-zeta * wn * t) * np.sin(wd * t)
    response /= response.sum()
    padded = np.concatenate([np.repeat(plan[:1], 200 + lag, axis=0), plan])
    followed = np.column_stack([np.convolve(c, response)[200 : 200 + n] for c in padded.T])
    sag = mood.get("sag", rng.uniform(0.005, 0.03))
    state = followed.copy()
    state[:, 0] += sag * np.cos(followed[:, 0])
    state[:, 3] -= 0.7 * sag * np.cos(followed[:, 0] + followed[:, 3] - 1.2)
    effort = 12 * (plan - state) + np.array([4, 1, 0.5, 2, 0.2, 0.3, 0.1]) * np.cos(state)
    flip = 1 if side == "left" else ARM_MIRROR
    return Part(plan * flip, state * flip, _velocity(state) * flip, effort * flip, np.zeros((n, 0)))


# Good but unusual: what is unusual, and how it is made.
GOOD: dict[str, tuple[str, dict[str, Any]]] = {
    "ordinary": ("an ordinary episode", {}),
    "one_hand_rest": ("the left hand is never used", {"hand_rest": "left"}),
    "arm_rest": ("the left arm rests", {"arm_rest": "left"}),
    "slow": ("a slow operator", {"pace": 0.45}),
    "quick": ("a very quick operator", {"pace": 1.9, "servo_pace": 1.0}),
    "quick_arm": ("very quick reaches of the arms", {"arm_pace": 2.2}),
    "long_hold": (
        "an object is held for 20 s; the action stays past it",
        {"hold": 20.0, "seconds": 11.0},
    ),
    "coarse": ("coarse encoders", {"coarse": 12.0}),
    "noisy": ("noisy encoders", {"noise": 7.0}),
    "kinesthetic": ("led by hand: the action is the state", {"copy": 0}),
    "next_state": ("the action is the next frame's state", {"copy": 1}),
    "short": ("a short episode of 4 s", {"seconds": 4.2}),
    "long": ("a long episode of 38 s", {"seconds": 38.0}),
    "open_only": ("the hands only open, once", {"open_only": True}),
    "alike": ("like its neighbour, performed again: the same task, not a copy", {"like": 77}),
    "pause": ("a pause of 2 s in the middle", {"pause": 2.0}),
    "end_stops": ("the hands reach their end stops often", {"stretch": 1.25}),
    "soft": ("a soft object that gives way slowly", {"soft": 0.35}),
    "slow_hand": ("slow hands that follow about 0.3 s later", {"late": 0.3}),
    "beyond": ("states slightly beyond the limits, as of a calibration", {"offset": 0.06}),
    "big_sag": ("arms that sag by several degrees", {"sag": 0.1}),
    "overshoot": ("arms that overshoot", {"zeta": 0.35, "wn": 18.0}),
    "lagging_arm": ("arms that follow about 0.15 s later", {"zeta": 0.9, "wn": 15.0}),
    "tremor": ("an operator whose hands tremble", {"tremor": 0.008}),
    "small_motion": ("fine work: the arms move by few degrees", {"reach": 0.15}),
    "large_motion": ("wide reaches", {"reach": 1.5}),
    "both_same": ("both hands and arms move symmetrically", {"both": True}),
    "joint_unused": ("one joint of each hand is never commanded", {"unused": True}),
    "rounded": ("positions in whole hundredths", {"rounded": 0.01}),
    "offset": ("a wrist with a constant error of calibration of 0.06 rad", {"wrist": 0.06}),
    "camera_slow": ("a camera of half the rate: each picture twice", {"camera_step": 2}),
    "camera_hiccup": ("a camera misses a single frame now and then", {"camera_skip": True}),
    "quiet_end": ("the operator waits 1.5 s before the end is recorded", {"quiet": 1.5}),
    "hands_still": ("only the arms move: the hands keep a half-closed pose", {"hand_rest": "both"}),
}


def make(plan: Plan, library: Library, number: int, entry: str) -> Episode:
    """The motion of an entry, before its fault."""
    kind = entry.split()[1] if entry.startswith("good") else "ordinary"
    words = entry.split()
    say, mood = GOOD[kind]
    # one that is like its neighbour shares the operator's habits, not the performance
    rng = np.random.default_rng([56, zlib.crc32(plan.folder.encode()), number])
    hand = HANDS[plan.hand]
    least = 6.0 if plan.grasp else 5.0
    seconds = mood.get("seconds", float(rng.uniform(max(least, 7.0), 19.0)))
    if plan.cameras and plan.fps >= 60:
        seconds = min(seconds, 9.0)  # many pictures
    pace = mood.get("pace", 1.0)
    if pace > 1 and hand.high[0] == 1.0:
        pace = mood.get("servo_pace", 1.0)
    scale = (1.0, 1.0) if "stretch" in mood or plan.grasp else (0.85, 1.0)
    tracks: dict[str, Part] = {}
    for side in plan.sides:
        if plan.arms:
            tracks[f"{side}_arm"] = arm_track(rng, side, seconds, mood)
        grasp = plan.grasp and side == "right" and "grasp_on_nothing" not in entry
        grasp = grasp or "hold" in mood or "soft" in mood
        half = plan.grasp and side == "left" and not grasp
        track = library.track(
            rng,
            plan.hand,
            side,
            seconds,
            grasp,
            pace,
            0.0 if plan.hand == "dex3" and plan.grasp else plan.spread,
            (0.4, 0.5) if half else scale,
            "pressure" in plan.carries,
        )
        tracks[f"{side}_hand"] = track
    if "both" in mood:
        tracks["right_hand"] = mirrored(tracks["left_hand"], plan.hand)
        if plan.arms:
            left = tracks["left_arm"]
            tables = {k: getattr(left, k) * ARM_MIRROR for k in ("action", "state", "effort")}
            speed = left.velocity * ARM_MIRROR
            tracks["right_arm"] = Part(velocity=speed, pressure=left.pressure, **tables)
    _shape_hands(plan, tracks, mood, rng, library.lags[plan.hand])
    n = min(len(p.action) for p in tracks.values())
    tracks = {k: p.rows(slice(0, n)) for k, p in tracks.items()}
    if "pause" in mood:
        motion = sum(np.abs(p.velocity).max(axis=1) for p in tracks.values())
        middle = slice(n // 3, 2 * n // 3)
        at = n // 3 + int(np.argmin(np.convolve(motion, np.ones(20), "same")[middle]))
        tracks = {k: _paused(p, at, mood["pause"], hand.contact) for k, p in tracks.items()}
    if "quiet" in mood:
        tracks = {k: _paused(p, n - 1, mood["quiet"], hand.contact) for k, p in tracks.items()}
    true_rate = float(plan.fps)
    if entry.startswith("wrong_fps"):
        true_rate = float(words[3].split("=")[1])
    e = _frames(plan, tracks, true_rate, mood, rng)
    e.rate = float(plan.fps)
    e.task = plan.tasks[number % len(plan.tasks)]
    e.stamps = e.numbers / plan.fps
    e.label = {"expect": "good", "fault": "", "part": "", "joints": [], "begin_s": None}
    e.label |= {"end_s": None, "strength": "plain", "say": f"{say[0].upper()}{say[1:]}."}
    return e


def _paused(p: Part, at: int, seconds: float, threshold: float) -> Part:
    """Stand still at a row; what is still on its way arrives, unless it is at an object."""
    extra = int(seconds * BASE_HZ)
    held = p.rows(np.insert(np.arange(len(p.action)), at, [at] * extra))
    rows = slice(at, at + extra)
    held.velocity[rows] = 0
    off = p.action[at] - p.state[at]
    if np.abs(off).max() < threshold:
        t = np.arange(extra)[:, None]
        # and sets off again from where the motion goes on
        w = (1 - np.exp(-t / 8)) * (smooth((extra - t) / 25) if at < len(p.action) - 1 else 1.0)
        held.state[rows] += w * off * 0.9
    return held


def _shape_hands(
    plan: Plan,
    tracks: dict[str, Part],
    mood: dict[str, Any],
    rng: np.random.Generator,
    lag: float,
) -> None:
    hand = HANDS[plan.hand]
    for side in plan.sides:
        name = f"{side}_hand"
        p = tracks[name]
        flip = np.array(MIRROR.get(plan.hand, [1]) if side == "right" else [1])
        low, high = np.array(hand.low), np.array(hand.high)
        low, high = np.minimum(low * flip, high * flip), np.maximum(low * flip, high * flip)
        opened = np.array(hand.opened) * flip
        if mood.get("hand_rest") in (side, "both"):
            pose = opened + (low + high - 2 * opened) * rng.uniform(0.1, 0.3)
            p.action = np.repeat(pose[None], len(p.action), axis=0)
            p.state = p.action + rng.normal(0, 2 * hand.noise + 0.001, p.action.shape[1])
            p.velocity, p.effort, p.pressure = p.velocity * 0, p.effort * 0, p.pressure * 0
        if mood.get("unused"):
            j = min(1, p.action.shape[1] - 1)
            p.action[:, j], p.state[:, j] = opened[j], opened[j]
            p.velocity[:, j], p.effort[:, j] = 0, 0
        if "stretch" in mood:
            middle, ends = (low + high) / 2, (p.action.min(axis=0), p.action.max(axis=0))
            centre = (ends[0] + ends[1]) / 2
            room = np.maximum(ends[1] - ends[0], 1e-6)
            gain = np.where(room > 0.05, mood["stretch"] * (high - low) / room, 0)
            move = np.where(room > 0.05, middle - centre * gain, opened)
            p.action = np.clip(p.action * gain + move, low, high)
            p.state = np.clip(p.state * gain + move, low, high)
            p.velocity = _velocity(p.state)
        if "open_only" in mood:
            n = len(p.action)
            begin = int(n * rng.uniform(0.3, 0.5))
            closed = low + high - opened
            w = smooth((np.arange(n) - begin) / 120)[:, None]
            start = opened + (closed - opened) * 0.8
            p.action = start + (opened - start) * w
            p.state = np.concatenate([np.repeat(p.action[:1], 7, axis=0), p.action[:-7]])
            p.velocity, p.effort = _velocity(p.state), p.effort * 0
        if "late" in mood:
            p.state = _lagged(p.state, max(0.1, mood["late"] - lag / BASE_HZ))
            p.velocity = _velocity(p.state)
        if "offset" in mood:
            p.state = p.state + mood["offset"] * np.sign(opened - (low + high) / 2) * (
                1.0 if high.max() > 1.0 else 0.5
            )
        if "hold" in mood or "soft" in mood:
            first, last = contact(p, hand.contact)
            middle = (first + last) // 2
            if "soft" in mood:
                ramp = np.clip((np.arange(len(p.action)) - first) / max(1, last - first), 0, 1)
                give = (mood["soft"] * ramp * (np.arange(len(ramp)) < last))[:, None]
                back = mood["soft"] * np.exp(-np.maximum(0, np.arange(len(ramp)) - last) / 15)
                give = np.where(np.arange(len(ramp))[:, None] >= last, back[:, None], give)
                p.state = p.state + give * (p.action - p.state)
                p.velocity = _velocity(p.state)
            elif last > first:
                extra = int(mood["hold"] * BASE_HZ)
                tracks[name] = p.rows(np.insert(np.arange(len(p.action)), middle, [middle] * extra))
    if "hold" in mood and plan.arms:
        long = max(len(tracks[f"{s}_hand"].action) for s in plan.sides) / BASE_HZ
        for side in plan.sides:
            tracks[f"{side}_arm"] = arm_track(rng, side, long, mood)


def _lagged(state: Floats, seconds: float) -> Floats:
    """A delay of a third, and a filter of the rest."""
    wait = int(seconds / 3 * BASE_HZ)
    tau = seconds * 2 / 3 * BASE_HZ
    kernel = np.exp(-np.arange(int(8 * tau)) / tau)
    kernel /= kernel.sum()
    padded = np.concatenate([np.repeat(state[:1], len(kernel) + wait, axis=0), state])
    n = len(state)
    return np.column_stack([np.convolve(c, kernel)[len(kernel) :][:n] for c in padded.T])


def contact(p: Part, threshold: float) -> tuple[int, int]:
    """The longest stretch in which the state stays off the action: an object."""
    off = np.abs(p.action - p.state).max(axis=1) > threshold
    edges = np.flatnonzero(np.diff(np.concatenate([[0], off.astype(int), [0]])))
    if not len(edges):
        return 0, 0
    spans = edges.reshape(-1, 2)
    best = spans[np.argmax(spans[:, 1] - spans[:, 0])]
    return int(best[0]), int(best[1])


def _frames(
    plan: Plan, tracks: dict[str, Part], rate: float, mood: dict[str, Any], rng: np.random.Generator
) -> Episode:
    """Sample at the frame rate: states between neighbours, commands held; noise, steps."""
    n = int((min(len(p.action) for p in tracks.values()) - 2) / BASE_HZ * rate)
    at = np.arange(n) / rate * BASE_HZ
    low = at.astype(int)
    hand = HANDS[plan.hand]
    parts = {}
    for name, p in tracks.items():
        now = p.rows(low).mixed(at - low, p.rows(low + 1))
        now.action = p.action[low]
        now.pressure = now.pressure.astype(np.float32)
        arm = name.endswith("arm")
        noise = (0.0006 if arm else hand.noise) * mood.get("noise", 1.0)
        if "noise" in mood and not arm and hand.high[0] == 1.0:
            noise = 0.006
        if mood.get("hand_rest") and not arm and hand.high[0] == 1.0:
            noise = 0.0
        now.state = now.state + rng.normal(0, 1, now.state.shape) * noise
        now.velocity = now.velocity + rng.normal(0, 0.004 + 4 * noise, now.velocity.shape)
        spread = np.maximum(np.ptp(now.effort, axis=0), 0.02) * 0.01
        now.effort = now.effort + rng.normal(0, 1, now.effort.shape) * spread
        step = (2 * np.pi / 65536) if arm else hand.step
        if "coarse" in mood:
            step = mood["coarse"] * (0.0015 if arm or hand.high[0] != 1.0 else 0.001)
        if step:
            now.state = np.round(now.state / step) * step
        if hand.high[0] == 1.0 and not arm:
            now.state = np.clip(now.state, 0, 1 if not mood.get("offset") else 1.03)
            now.action = np.clip(now.action, 0, 1)
        if "rounded" in mood:
            now.state, now.action = np.round(now.state, 2), np.round(now.action, 2)
        if "wrist" in mood and arm:
            now.state[:, 5] += mood["wrist"]
        parts[name] = now
    if "copy" in mood:
        for p in parts.values():
            shift = mood["copy"]
            p.action = np.concatenate([p.state[shift:], np.repeat(p.state[-1:], shift, axis=0)])
    scene = np.full((n, 4), 0.5)
    for i, side in enumerate(plan.sides):
        s = parts[f"{side}_arm" if plan.arms else f"{side}_hand"].state
        scene[:, 2 * i] = 0.3 + 0.35 * i + 0.3 * (s[:, 2 % s.shape[1]] + 0.5 * s[:, -1])
        scene[:, 2 * i + 1] = 0.5 + 0.35 * (s[:, 0] + s[:, 3 % s.shape[1]] - 0.5)
    pictures = np.arange(n)
    if "camera_step" in mood:
        pictures = pictures // mood["camera_step"] * mood["camera_step"]
    if "camera_skip" in mood:
        for k in rng.choice(np.arange(5, n - 5), max(3, n // 60), replace=False):
            pictures[k] = pictures[k - 1]
    seen: dict[str, Rows | None] = {c: pictures.copy() for c in plan.cameras}
    return Episode(parts, "", rate, at / BASE_HZ, np.arange(n), scene, seen, {})
