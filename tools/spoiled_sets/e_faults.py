"""The faults of :mod:`author_e`: each changes an episode and notes where it did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tools.spoiled_sets.e_motion import HANDS, Floats, Ints, Rng, Take, ease, rows_at

Fault = Callable[[Take, Rng], None]


def mark(
    take: Take,
    part: str = "",
    joints: Sequence[int] = (),
    frames: tuple[int, int] | None = None,
) -> None:
    """Note in the label where the fault is; ``frames`` as [begin, end)."""
    take.label.part, take.label.joints = part, [int(j) for j in joints]
    if frames is not None:
        take.label.begin_s = round(frames[0] / take.fps, 3)
        take.label.end_s = round(min(frames[1], len(take)) / take.fps, 3)


def window(take: Take, parts: Sequence[str], share: float, joint: int | None = None) -> slice:
    """The stretch of this share of the episode in which the actions travel most."""
    n = max(3, round(len(take) * share))
    moved = np.zeros(len(take))
    for part in parts:
        table = take.tracks[part].action
        table = table if joint is None else table[:, [joint]]
        spread = np.abs(np.diff(table, axis=0, prepend=table[:1])).sum(axis=1)
        moved += spread / (np.ptp(table) + 1e-9)
    total = np.concatenate([[0.0], np.cumsum(moved)])
    begin = int(np.argmax(total[n:] - total[:-n]))
    return slice(begin, begin + n)


def busiest(take: Take, part: str) -> int:
    """The joint whose action travels most."""
    return int(np.argmax(np.abs(np.diff(take.tracks[part].action, axis=0)).sum(axis=0)))


def frozen(parts: Sequence[str], share: float, joint: bool = False) -> Fault:
    """States that are the same number for a stretch, while the action moves."""

    def do(take: Take, rng: Rng) -> None:
        j = busiest(take, parts[0]) if joint else None
        w = window(take, parts, share, j)
        for part in parts:
            columns = slice(None) if j is None else [j]
            t = take.tracks[part]
            t.state[w, columns] = t.state[w.start, columns]
            t.velocity[w, columns] = t.velocity[w.start, columns]
            t.effort[w, columns] = t.effort[w.start, columns]
        single = parts[0] if len(parts) == 1 else ""
        mark(take, single, [] if j is None else [j], (w.start, w.stop))

    return do


ALL = ("left_arm", "right_arm", "left_hand", "right_hand")


def repeated(every: int, share: float = 1.0) -> Fault:
    """Whole rows that come again: a loop slower than the recorder."""

    def do(take: Take, rng: Rng) -> None:
        w = window(take, list(take.tracks), share)
        at = np.arange(len(take))
        at[w] = w.start + (at[w] - w.start) // every * every
        for t in take.tracks.values():
            for name in ("state", "action", "velocity", "effort"):
                setattr(t, name, getattr(t, name)[at])
        take.touch = {k: v[at] for k, v in take.touch.items()}
        take.shown = {k: v[at] for k, v in take.shown.items()}
        mark(take, frames=(w.start, w.stop))

    return do


def shifted(seconds: float) -> Fault:
    """Action ahead of the observation by so much more than it should be; negative: behind it."""

    def do(take: Take, rng: Rng) -> None:
        d = round(abs(seconds) * take.fps)
        n = len(take) - d
        early, later = slice(0, n), slice(d, d + n)
        seen, asked = (early, later) if seconds > 0 else (later, early)
        for t in take.tracks.values():
            t.action = t.action[asked]
            t.state, t.velocity, t.effort = t.state[seen], t.velocity[seen], t.effort[seen]
        take.touch = {k: v[seen] for k, v in take.touch.items()}
        take.seen, take.number = take.seen[seen], np.arange(n)
        take.shown = {k: np.arange(n) for k in take.shown}
        mark(take, frames=(0, n))

    return do


def drifting(seconds: float) -> Fault:
    """The observation falls behind by more and more, up to so much."""

    def do(take: Take, rng: Rng) -> None:
        n = len(take)
        at = np.maximum(np.arange(n) - np.linspace(0, seconds * take.fps, n), 0)
        for t in take.tracks.values():
            t.state, t.velocity = rows_at(t.state, at), rows_at(t.velocity, at)
            t.effort = rows_at(t.effort, at)
            t.state += rng.normal(0, 1, t.state.shape) * 0.0002
        take.touch = {k: v[at.astype(int)] for k, v in take.touch.items()}
        take.seen = rows_at(take.seen, at)
        mark(take, frames=(0, n))

    return do


def clipped(part: str, level: float, joints: int = 1) -> Fault:
    """The recorded action is cut off at a part of its range; the robot moved on."""

    def do(take: Take, rng: Rng) -> None:
        t = take.tracks[part]
        order = np.argsort(-np.ptp(t.action, axis=0))[:joints]
        for j in order:
            low, high = t.action[:, j].min(), t.action[:, j].max()
            middle, half = np.median(t.action[:, j]), level * (high - low)
            t.action[:, j] = np.clip(t.action[:, j], middle - half, middle + half)
        mark(take, part, np.sort(order).tolist(), (0, len(take)))

    return do


def limp(parts: Sequence[str], share: float, fall: float) -> Fault:
    """The part lies where it was, sinks a little, and does not follow; encoders go on."""

    def do(take: Take, rng: Rng) -> None:
        w = slice(0, len(take)) if share >= 1 else window(take, parts, share)
        n = w.stop - w.start
        for part in parts:
            t = take.tracks[part]
            arm = part.endswith("arm")
            top = 1.0 if arm else HANDS[take.model].top
            sink = fall * top * rng.uniform(0.5, 1, t.state.shape[1])
            tau = np.arange(n)[:, None] / take.fps
            lying = t.state[w.start] + (sink * (1 - np.exp(-tau / 1.5)))
            lying = lying + rng.normal(0, 1, (n, len(sink))) * (0.0008 if arm else 0.002 * top)
            if HANDS[take.model].top == 1.0 and not arm:
                lying = np.clip(lying, 0.002, 0.998)
            back = min(round(0.5 * take.fps), len(take) - w.stop)
            after = ease(np.arange(1, back + 1) / (back + 1))[:, None]
            t.state[w.stop : w.stop + back] = (
                lying[-1] * (1 - after) + t.state[w.stop : w.stop + back] * after
            )
            t.state[w] = lying
            moving = slice(w.start, w.stop + back)
            t.velocity[moving] = np.gradient(t.state[moving], axis=0) * take.fps
            t.effort[w] = rng.normal(0, 0.01, (n, len(sink)))
        mark(take, parts[0] if len(parts) == 1 else "", [], (w.start, w.stop))

    return do


def jump(part: str, size: float, frames: int, what: str = "state") -> Fault:
    """A joint that is elsewhere for some frames; 0 for the rest of the episode."""

    def do(take: Take, rng: Rng) -> None:
        j, n = busiest(take, part), len(take)
        begin = int(n * rng.uniform(0.35, 0.6))
        end = begin + frames if frames else n
        getattr(take.tracks[part], what)[begin:end, j] += size
        mark(take, part, [j], (begin, end))

    return do


def scaled(parts: Sequence[str], change: Callable[[Floats, str], Floats]) -> Fault:
    """Another unit, in states and actions."""

    def do(take: Take, rng: Rng) -> None:
        for part in parts:
            t = take.tracks[part]
            t.state, t.action = change(t.state, part), change(t.action, part)
            t.velocity = change(t.velocity, part) - change(t.velocity * 0, part)
        mark(take, parts[0] if len(parts) == 1 else "", [], (0, len(take)))

    return do


def degrees(table: Floats, part: str) -> Floats:
    """Angles in degrees."""
    found: Floats = np.degrees(table)
    return found


def percent(table: Floats, part: str) -> Floats:
    """0 to 1 as 0 to 100."""
    return table * 100


def part_of_travel(table: Floats, part: str) -> Floats:
    """Angles of a Dex3-1 as parts of the full travel."""
    travel = [1.0472, 1.0472, 1.7453, 1.5708, 1.7453, 1.5708, 1.7453]
    found: Floats = np.abs(table) / np.array(travel)
    return found


def gripper_share(table: Floats, part: str) -> Floats:
    """Angles of a Dex1-1 as parts of the full travel."""
    return table / 5.4


def turned(table: Floats, part: str) -> Floats:
    """0 to 1 as 1 to 0."""
    return 1 - table


def exchanged(kind: str) -> Fault:
    """The state of each side stands in the other side's place."""

    def do(take: Take, rng: Rng) -> None:
        left, right = take.tracks[f"left_{kind}"], take.tracks[f"right_{kind}"]
        for name in ("state", "velocity", "effort"):
            a, b = getattr(left, name), getattr(right, name)
            setattr(left, name, b)
            setattr(right, name, a)
        mark(take, frames=(0, len(take)))

    return do


def reordered(part: str, order: Sequence[int]) -> Fault:
    """Columns of the state in another order than those of the action."""

    def do(take: Take, rng: Rng) -> None:
        t = take.tracks[part]
        for name in ("state", "velocity", "effort"):
            setattr(t, name, getattr(t, name)[:, list(order)])
        mark(take, part, [i for i, o in enumerate(order) if i != o], (0, len(take)))

    return do


def inverted(part: str, joints: Sequence[int], what: Sequence[str] = ("state",)) -> Fault:
    """Joints whose sign is wrong."""

    def do(take: Take, rng: Rng) -> None:
        t = take.tracks[part]
        for name in (*what, "velocity"):
            getattr(t, name)[:, list(joints)] *= -1
        mark(take, part, joints, (0, len(take)))

    return do


def missing(seconds: float, numbered_on: bool) -> Fault:
    """A stretch of frames that was lost while all moved."""

    def do(take: Take, rng: Rng) -> None:
        n = round(seconds * take.fps)
        tables = [t.action / (np.ptp(t.action) + 1e-9) for t in take.tracks.values()]
        whole = np.concatenate(tables, axis=1)
        away = np.abs(whole[n:] - whole[:-n]).sum(axis=1)
        away[: round(1.0 * take.fps)] = away[-round(1.0 * take.fps) :] = 0
        begin = int(np.argmax(away))
        keep = np.r_[0:begin, begin + n : len(take)]
        for t in take.tracks.values():
            for name in ("state", "action", "velocity", "effort"):
                setattr(t, name, getattr(t, name)[keep])
        take.touch = {k: v[keep] for k, v in take.touch.items()}
        take.seen = take.seen[keep]
        take.number = np.arange(len(keep)) if numbered_on else take.number[keep]
        take.shown = {k: np.arange(len(keep)) for k in take.shown}
        mark(take, frames=(begin, begin + 1))
        if not numbered_on:
            take.label.end_s = round((begin + n) / take.fps, 3)

    return do


def not_finite(part: str, frames: int, value: float, what: str = "state") -> Fault:
    """NaN or infinity in a joint for some frames."""

    def do(take: Take, rng: Rng) -> None:
        begin, j = int(len(take) * rng.uniform(0.3, 0.7)), busiest(take, part)
        getattr(take.tracks[part], what)[begin : begin + frames, j] = value
        mark(take, part, [j], (begin, begin + frames))

    return do


def camera(name: str, kind: str, amount: float) -> Fault:
    """Pictures that stand still, come late, end early or are not there."""

    def do(take: Take, rng: Rng) -> None:
        n = len(take)
        at: Ints = np.arange(n)
        begin = 0
        if kind == "frozen":
            begin = round(n * (1 - amount) * 0.6)
            at[begin : begin + round(n * amount)] = begin
            mark(take, f"camera {name}", [], (begin, begin + round(n * amount)))
        elif kind == "late":
            at = np.maximum(at - np.linspace(0, amount * take.fps, n).astype(int), 0)
            mark(take, f"camera {name}", [], (0, n))
        elif kind == "early":
            at = at[: n - round(amount * take.fps)]
            mark(take, f"camera {name}", [], (len(at), n))
        else:
            take.done["no camera"] = name
            mark(take, f"camera {name}", [], (0, n))
        take.shown[name] = at

    return do


def told(key: str, value: Any = True, part: str = "", joints: Sequence[int] = ()) -> Fault:
    """Something that is done to the files."""

    def do(take: Take, rng: Rng) -> None:
        take.done[key] = value
        if key == "no task":
            take.task = ""
        mark(take, part, joints)

    return do


def marked(part: str, begin: float, end: float) -> Fault:
    """The motion itself is the fault: say where, in parts of the episode."""

    def do(take: Take, rng: Rng) -> None:
        mark(take, part, [], (round(begin * len(take)), round(end * len(take))))

    return do


def at_end(part: str, seconds: float, where: str) -> Fault:
    """So many seconds at the start or the end, in which nothing happens."""

    def do(take: Take, rng: Rng) -> None:
        n = round(seconds * take.fps)
        mark(take, part, [], (0, n) if where == "start" else (len(take) - n, len(take)))

    return do


def dropped(part: str) -> Fault:
    """Find where the object left the hand: the effort falls while it stays closed."""

    def do(take: Take, rng: Rng) -> None:
        force = np.abs(take.tracks[part].effort).sum(axis=1)
        held = np.convolve(force, np.ones(5) / 5, mode="same") > 0.35 * np.quantile(force, 0.95)
        edges = np.flatnonzero(held[:-1] & ~held[1:])
        at = int(edges[0]) if len(edges) else len(take) // 2
        mark(take, part, [], (at, min(len(take), at + round(0.5 * take.fps))))

    return do


def noisy(size: float) -> Fault:
    """Noise on all, so that a copy is not the same to the bit."""

    def do(take: Take, rng: Rng) -> None:
        for t in take.tracks.values():
            t.state += rng.normal(0, size, t.state.shape)
            t.action += rng.normal(0, size, t.action.shape)
        mark(take, frames=(0, len(take)))

    return do


def blinking(take: Take, rng: Rng) -> None:
    """A camera that misses some of the pictures: the one before comes again."""
    for name, at in take.shown.items():
        lost = rng.random(len(at)) < 0.07
        lost[1:] &= ~lost[:-1]
        take.shown[name] = np.maximum(at - lost, 0)


def turn_state(take: Take, rng: Rng) -> None:
    """Only the right hand's state is 1 to 0."""
    t = take.tracks["right_hand"]
    t.state, t.velocity = 1 - t.state, -t.velocity
    mark(take, "right_hand", [], (0, len(take)))
