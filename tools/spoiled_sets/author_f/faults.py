"""The faults: each changes one good episode, and says in its label what and where."""

from __future__ import annotations

import copy
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tools.spoiled_sets.author_f.motion import (
    HANDS,
    MIRROR,
    Episode,
    Part,
    Plan,
    Rows,
    contact,
    smooth,
)

__all__ = ["spoil"]


@dataclass
class Spec:
    """What an entry of a plan asks for."""

    plan: Plan
    fault: str
    part: str
    plain: bool
    variant: str
    made: list[Episode]


def _tell(e: Episode, say: str, rows: tuple[int, int] | None = None, joints: Any = ()) -> None:
    e.label["say"] = say
    e.label["joints"] = [int(j) for j in joints]
    if rows is not None:
        e.label["begin_s"] = round(rows[0] / e.rate, 2)
        e.label["end_s"] = round(min(rows[1], len(e)) / e.rate, 2)


def _chosen(e: Episode, s: Spec) -> list[str]:
    if not s.part or s.part.startswith("camera"):
        return list(e.parts)
    return [s.part]


def _busy(e: Episode, names: Sequence[str], rows: int, joint: int | None = None) -> int:
    """The first row of the stretch in which the actions move most."""
    moved = np.zeros(len(e))
    for name in names:
        step = np.abs(np.diff(e.parts[name].action, axis=0, prepend=e.parts[name].action[:1]))
        moved += step[:, joint] if joint is not None else step.sum(axis=1)
    first, last = len(e) // 10, max(len(e) // 10 + 1, len(e) - rows - len(e) // 10)
    total = np.concatenate([[0], np.cumsum(moved)])
    at = np.arange(first, last)
    return int(at[np.argmax(total[np.minimum(at + rows, len(e))] - total[at])])


def _most_moved(p: Part) -> int:
    return int(np.argmax(p.action.std(axis=0)))


def _still(p: Part, rows: slice, joints: Any) -> None:
    """As a receiver that repeats its last message."""
    first = rows.start
    p.state[rows, joints] = p.state[first, joints]
    p.velocity[rows, joints] = p.velocity[first, joints]
    p.effort[rows, joints] = p.effort[first, joints]


def _frozen(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    names = _chosen(e, s)
    joint = _most_moved(e.parts[s.part]) if s.fault == "frozen_joint" else None
    n = len(e)
    length = int(n * 0.85) if s.plain else int(max(3.0, 0.35 * n / e.rate) * e.rate)
    first = n - length if s.plain else _busy(e, names, length, joint)
    for name in names:
        p = e.parts[name]
        joints = np.array([joint]) if joint is not None else np.arange(p.state.shape[1])
        _still(p, slice(first, first + length), joints)
        if joint is None:
            p.pressure[first : first + length] = p.pressure[first]
    what = f"joint {joint} of the {s.part}" if joint is not None else (s.part or "all parts")
    rows = (first, first + length)
    _tell(e, f"The state of {what} stands still at its last value while the action moves.", rows)
    e.label["joints"] = [joint] if joint is not None else []


def _repeated(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    n = len(e)
    if s.variant == "rows":
        index, bursts = np.arange(n), 14 if s.plain else 8
        length = max(3, int(0.4 * e.rate))
        for k in np.linspace(n * 0.08, n * 0.92 - length, bursts).astype(int):
            index[k : k + length] = k
        stamps, numbers, seen = e.stamps, e.numbers, e.seen
        e.keep(index)
        e.stamps, e.numbers = stamps, numbers
        say = f"{bursts} times the recorder wrote one frame {length} times, action and state."
    else:
        step = max(2, round(e.rate / (4 if s.plain else 8)))
        index = np.arange(n) // step * step
        seen = e.seen
        e.parts = {k: replace(p.rows(index), action=p.action.copy()) for k, p in e.parts.items()}
        e.seen = seen
        say = f"All observations are renewed only every {step} frames and repeated between."
    _tell(e, say, (0, n))


def _action_shift(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    early = s.variant != "late"
    by = rng.uniform(0.8, 1.2) if s.plain else rng.uniform(0.5, 0.6)
    if not early:
        by *= 0.7
    m = round(by * e.rate)
    n = len(e)
    ahead = {k: p.action.copy() for k, p in e.parts.items()}
    e.keep(np.arange(0, n - m) if early else np.arange(m, n))
    for k, p in e.parts.items():
        p.action = ahead[k][m:] if early else ahead[k][: n - m]
    what = "The observations come" if early else "The actions were written"
    _tell(e, f"{what} {m / e.rate:.2f} s too late, constantly, beside what delay there is.")


def _lag_drift(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    most = rng.uniform(1.2, 1.6) if s.plain else rng.uniform(0.7, 0.8)
    n = len(e)
    at = np.maximum(np.arange(n) - most * e.rate * np.linspace(0, 1, n), 0)
    low = at.astype(int)
    for k, p in e.parts.items():
        late = p.rows(low).mixed(at - low, p.rows(np.minimum(low + 1, n - 1)))
        late.action = p.action
        e.parts[k] = late
    say = f"The observations fall behind the actions more and more, {most:.1f} s at the end."
    _tell(e, say, (0, n))


def _clipped(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    order = np.argsort(-np.ptp(p.action, axis=0))
    joints = np.sort(order[: 3 if s.part.endswith("arm") else max(1, len(order) // 2)])
    cut = 0.38 if s.plain else 0.28
    clipped = p.action.copy()
    for j in joints:
        low, high = p.action[:, j].min(), p.action[:, j].max()
        if s.part.endswith("arm"):
            low, high = np.quantile(p.action[:, j], [cut, 1 - 0.8 * cut])
        elif abs(high) > abs(low):
            high = low + (1 - 1.3 * cut) * (high - low)
        else:
            low = high - (1 - 1.3 * cut) * (high - low)
        clipped[:, j] = np.clip(p.action[:, j], low, high)
    if s.variant == "followed":
        kernel = np.exp(-np.arange(40) / (0.09 * e.rate))
        gap = clipped - p.action
        p.state = p.state + np.column_stack(
            [np.convolve(c, kernel / kernel.sum())[: len(gap)] for c in gap.T]
        )
        say = "Actions are cut at limits inside the range, flat at one value again and again."
    else:
        say = "The recorded actions are cut at limits inside the range; the states go beyond them."
    p.action = clipped
    _tell(e, say, None, joints)


def _not_followed(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    n = len(e)
    length = n if s.variant == "all" else int(0.6 * n) if s.plain else int(4.0 * e.rate)
    first = 0 if s.variant == "all" else n - length if s.plain else _busy(e, [s.part], length)
    last = first + length
    t = np.arange(length) / e.rate
    start = p.state[first]
    hand = HANDS[s.plan.hand]
    arm = s.part.endswith("arm")
    # limp: it sinks slowly to where springs and gravity leave it, and trembles with the robot
    rest = start * 0.75 if not arm else start * np.array([0.3, 0.6, 0.8, 0.4, 1, 1, 1])
    if hand.high[0] == 1.0 and not arm:
        rest = start + 0.06 * np.sign(0.5 - start)
    sunk = rest + (start - rest) * np.exp(-t[:, None] / 1.2)
    quake = 0.004 * np.sin(2 * np.pi * 0.7 * t)[:, None] * rng.uniform(-1, 1, len(start))
    noise = rng.normal(0, 1, sunk.shape) * max(hand.noise, 0.0006)
    limp = sunk + quake + noise
    if hand.step and not arm:
        limp = np.round(limp / hand.step) * hand.step
    if hand.high[0] == 1.0 and not arm:
        limp = np.clip(limp, 0, 1)
    true = p.state[first:last].copy()
    back = min(int(0.8 * e.rate), length) if last < n else 0
    w = np.zeros(length)
    if back:
        w[-back:] = smooth(np.linspace(0, 1, back))
    p.state[first:last] = limp * (1 - w[:, None]) + true * w[:, None]
    speed = np.gradient(p.state[first:last], axis=0) * e.rate
    p.velocity[first:last] = speed
    p.effort[first:last] = rng.normal(0, 0.003, p.effort[first:last].shape)
    p.pressure[first:last] = 0
    what = "throughout" if s.variant == "all" else "from here on" if last >= n else "for a while"
    _tell(e, f"The {s.part} is limp {what}: it does not follow the actions.", (first, last))


def _jump(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    n = len(e)
    hand = HANDS[s.plan.hand]
    first = int(rng.uniform(0.3, 0.6) * n)
    if s.part.endswith("arm"):
        joint, size = int(rng.choice([0, 3, 4])), 1.4 if s.plain else 0.8
    else:
        joint = _most_moved(p)
        size = (0.85 if s.plain else 0.6) * (hand.high[joint] - hand.low[joint])
    table = p.action if s.variant == "action" else p.state
    away = -1.0 if table[first, joint] > np.median(table[:, joint]) else 1.0
    if s.part.endswith("hand"):  # to the other end of the range
        flip = MIRROR.get(s.plan.hand, [1] * 20)[joint] if s.part.startswith("right") else 1
        middle = flip * (hand.high[joint] + hand.low[joint]) / 2
        away = -1.0 if table[first, joint] > middle else 1.0
    if s.variant == "step":
        last = n
        table[first:last, joint] += away * size * 0.6
        say = "jumps and keeps the new offset (the encoder lost its zero)"
    elif s.variant == "action":
        last = first + max(3, int(0.25 * e.rate))
        table[first:last, joint] += away * size
        lag = 1 - np.exp(-np.arange(1, last - first + 1) / (0.1 * e.rate))
        p.state[first:last, joint] += away * size * 0.5 * lag
        tail = np.exp(-np.arange(n - last) / (0.1 * e.rate))
        p.state[last:, joint] += away * size * 0.5 * lag[-1] * tail
        say = "of the action jumps and back (the solver found another solution)"
    else:
        last = first + (2 if s.plain else 1)
        table[first:last, joint] += away * size
        say = f"has a spike of {last - first} frame(s)"
    _tell(e, f"Joint {joint} of the {s.part} {say}.", (first, last), [joint])


def _wrong_unit(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    names = _chosen(e, s)
    if s.variant == "degrees" and HANDS[s.plan.hand].high[0] == 1.0:
        names = [n for n in names if n.endswith("arm")]  # the hands have no angles
    columns = ("action", "state") if s.variant in ("degrees", "percent", "unit") else ("state",)
    for name in names:
        p = e.parts[name]
        for column in columns:
            v = getattr(p, column)
            if s.variant.startswith("degrees"):
                v = np.degrees(v)
            elif s.variant.startswith("percent"):
                v = v * 100
            elif s.variant.startswith("flip"):
                v = 1 - v
            else:
                v = v / 5.4
            setattr(p, column, v)
    words = {
        "degrees": "in degrees, where the others are in rad",
        "degrees_state": "of the state in degrees, of the action in rad",
        "percent": "in percent, where the others are 0 to 1",
        "percent_state": "of the state in percent, of the action 0 to 1",
        "flip_state": "of the state 1 to 0 (open is 0), of the action 0 to 1",
        "unit": "0 to 1, where the others are in rad",
    }
    _tell(e, f"Values {words[s.variant]}: {', '.join(names)}.")


def _wrong_side(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    kind = s.part
    left, right = e.parts[f"left_{kind}"], e.parts[f"right_{kind}"]
    if s.variant == "both":
        e.parts[f"left_{kind}"], e.parts[f"right_{kind}"] = right, left
        say = f"Actions and states of the {kind}s are those of the other side, beyond its limits."
    else:
        for name in ("state", "velocity", "effort", "pressure"):
            a, b = getattr(left, name), getattr(right, name)
            setattr(left, name, b)
            setattr(right, name, a)
        say = f"The states of the two {kind}s are exchanged; the actions are not."
    e.label["part"] = f"left_{kind}"
    _tell(e, say)


def _wrong_order(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    n = p.state.shape[1]
    order: Rows = np.arange(n)
    if s.variant == "reversed":
        order = order[::-1]
    elif s.variant == "fingers":  # Dex3: index and middle; others: first and fourth
        order = np.array([0, 1, 2, 5, 6, 3, 4]) if n == 7 else order
        if n != 7:
            order[[0, 3]] = order[[3, 0]]
    elif s.variant == "thumb_last":
        order = np.roll(order, -3 if n == 7 else -1)
    else:
        order[[0, 1]] = order[[1, 0]]
    for name in ("state", "velocity", "effort"):
        table = getattr(p, name)
        setattr(p, name, table[:, order])
    moved = np.flatnonzero(order != np.arange(n))
    say = f"The states of the {s.part} are in another order than the actions: {order.tolist()}."
    _tell(e, say, None, moved)


def _inverted(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    by_motion = np.argsort(-p.action.std(axis=0))
    joints = np.sort(by_motion[: 2 if s.plain else 1])
    for name in ("state", "velocity", "effort"):
        getattr(p, name)[:, joints] *= -1
    _tell(e, f"The sign of the state of joint(s) {joints.tolist()} is inverted.", None, joints)


def _missing(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    n = len(e)
    length = int((3.0 if s.plain else 1.5) * e.rate)
    best, first = -1.0, n // 5
    for k in range(n // 6, n - length - n // 6):  # where the pose before and after differ most
        far = sum(
            float(np.abs(p.action[k + length] - p.action[k]).max() / np.ptp(p.action, axis=0).max())
            for p in e.parts.values()
            if np.ptp(p.action) > 1e-3
        )
        if far > best:
            best, first = far, k
    rows = np.concatenate([np.arange(first), np.arange(first + length, n)])
    e.keep(rows, renumber=s.variant != "numbered")
    how = "numbers and times have a gap" if s.variant == "numbered" else "the numbering goes on"
    _tell(e, f"{length / e.rate:.1f} s of frames are lost; {how}.", (first, first + 1))


def _wrong_fps(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    true = float(s.variant.partition("=")[2])
    if s.variant.startswith("video"):
        e.video_rate = true
        shown = "the video's length shows it"
    elif s.variant.startswith("stamps"):
        e.stamps = e.numbers / true
        e.time_ns = True
        shown = "the time stamps show it"
    else:
        shown = "velocities and positions differ by the ratio"
    _tell(e, f"Recorded at {true:g} frames a second, not {e.rate:g}: {shown}.")


def _duplicate(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    source = next(m for m in s.made[::-1] if m.label["expect"] == "good" and not m.label["part"])
    number = s.made.index(source)
    for name in ("parts", "task", "stamps", "numbers", "scene", "seen"):
        setattr(e, name, copy.deepcopy(getattr(source, name)))
    say = "the same episode once more"
    if s.variant == "task":
        e.task = next(t for t in (*s.plan.tasks, "Tidy up the table") if t != source.task)
        say = "the same motion under another task"
    elif s.variant == "noise":
        e.keep(np.arange(7, len(e) - 3))
        for p in e.parts.values():
            span = max(float(np.ptp(p.action)), 0.1)
            p.state = p.state + rng.normal(0, 0.002 * span, p.state.shape)
            p.action = p.action + rng.normal(0, 0.001 * span, p.action.shape)
        say = "the same motion with small noise, 7 frames cut off"
    _tell(e, f"A duplicate of episode {number}: {say}.")


def _idle(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    start = s.fault == "idle_start"
    n = len(e)
    length = int((rng.uniform(18, 25) if s.plain else rng.uniform(10, 12)) * e.rate)
    use = min(n, int(9 * e.rate))
    rows = (
        np.r_[np.zeros(length, int), np.arange(use)]
        if start
        else np.r_[np.arange(use), np.full(length, use - 1)]
    )
    alike = {k: p.rows(slice(0, n)) for k, p in e.parts.items()}
    e.keep(rows)
    idle = slice(0, length) if start else slice(use, use + length)
    for k, p in e.parts.items():
        arm = k.endswith("arm")
        shape = p.state[idle].shape
        noise = 0.0006 if arm else HANDS[s.plan.hand].noise
        shake = np.cumsum(rng.normal(0, 1, shape), axis=0)
        shake = shake - np.linspace(0, 1, length)[:, None] * shake[-1]
        p.velocity[idle] = rng.normal(0, 0.004, shape)
        p.effort[idle] += rng.normal(0, 0.002, shape)
        if arm:
            p.action[idle] += 0.0003 * shake
            p.state[idle] += 0.0003 * shake
        rest = alike[k].state[0 if start else use - 1]
        settled = np.exp(-np.arange(length) / (0.15 * e.rate))[:, None]
        off = p.action[use - 1] - rest
        if not start and np.abs(off).max() < HANDS[s.plan.hand].contact:  # it arrives
            p.state[idle] += (1 - settled) * off * 0.8
        p.state[idle] += rng.normal(0, 1, shape) * noise
        if HANDS[s.plan.hand].step and not arm:
            step = HANDS[s.plan.hand].step
            p.state[idle] = np.round(p.state[idle] / step) * step
    where = "before the motion begins" if start else "after the motion ended"
    _tell(e, f"{length / e.rate:.0f} s of standing still {where}.", (idle.start, idle.stop))


def _grasp_on_nothing(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    say = "The right hand closes fully on nothing; in the other episodes an object stops it."
    _tell(e, say)


def _drop(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    hand = HANDS[s.plan.hand]
    first, last = contact(p, hand.contact)
    if last - first < 0.8 * e.rate:
        raise ValueError(f"{s.plan.folder}: nothing is held in a drop: {first} {last}")
    at = first + int((0.35 if s.plain else 0.5) * (last - first))
    pushed = np.abs(p.effort).max(axis=1)
    last = min(last, len(e) - 1)
    while last < len(e) - 1 and pushed[last] > 0.3 * pushed[at]:
        last += 1  # until the object would have been let go
    t = np.arange(len(e)) / e.rate
    gone = smooth((t - t[at]) / 0.35) * (1 - smooth((t - t[last]) / 0.3))
    if s.plan.hand == "dex1":  # the goal of the client is its state less 0.18 rad
        fall = np.clip((t - t[at]) * 6.0, 0, None)
        state = np.maximum(p.state[:, 0] - fall, 0)
        w = smooth((t - t[last]) / 0.4 + 1)
        p.state[at:, 0] = (state * (1 - w) + p.state[:, 0] * w)[at:]
        p.action[at:last, 0] = np.maximum(p.state[at:last, 0] - 0.18, 0)
        p.state[at:] += rng.normal(0, hand.noise, p.state[at:].shape)
    else:
        p.state = p.state + gone[:, None] * (p.action - p.state) * 0.97
        if hand.step:
            p.state = np.round(p.state / hand.step) * hand.step
    p.velocity[at : last + 1] = (np.gradient(p.state, axis=0) * e.rate)[at : last + 1]
    light = p.effort * 0.06
    p.effort = p.effort + gone[:, None] * (light - p.effort)
    p.pressure = p.pressure * (1 - gone[:, None])
    say = "The object is lost: torque or touch falls while the hand stays closed."
    _tell(e, say, (at, last))


def _camera(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    name = s.part.removeprefix("camera ")
    n = len(e)
    seen = e.seen[name]
    assert seen is not None
    say, rows = "", (0, n)
    if s.fault == "camera_frozen":
        first = int(n * (0.3 if s.plain else 0.5))
        last = n if s.plain else min(n, first + int(4 * e.rate))
        seen[first:last] = seen[first]
        rows = (first, last)
        say = "shows one picture while the arms move"
    elif s.fault == "camera_late":
        most = (1.8 if s.plain else 1.0) * e.rate
        drift = np.full(n, most) if s.variant == "constant" else np.linspace(0, most, n)
        seen = np.maximum(seen - drift.astype(int), 0)
        say = f"falls behind the joints, {most / e.rate:.1f} s at the end"
        if s.variant == "constant":
            say = f"is {most / e.rate:.1f} s behind the joints throughout"
    elif s.fault == "camera_early_end":
        seen = seen[: int(n * (0.6 if s.plain else 0.8))]
        rows = (len(seen), n)
        say = "has no pictures from here on"
    e.seen[name] = seen
    if s.fault == "camera_missing":
        e.seen[name] = None
        say = "has no pictures at all"
    _tell(e, f"Camera {name} {say}.", rows)


def _no_task(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    e.task = {"empty": "", "blank": "  ", "dangling": "\0"}[s.variant]
    how = "its number is in no list" if s.variant == "dangling" else "the text is empty"
    _tell(e, f"It has no task: {how}.")


def _wrong_stats(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    e.false_stats = 57.29578 if s.plain else 0.4
    _tell(e, f"The episode's statistics are those of values {e.false_stats:.1f} times as large.")


def _not_finite(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    p = e.parts[s.part]
    joint = _most_moved(p)
    first = int(len(e) * 0.4)
    last = len(e) if s.plain else first + 3
    value = np.inf if s.variant == "inf" else np.nan
    (p.action if s.variant == "inf" else p.state)[first:last, joint] = value
    _tell(
        e, f"Joint {joint} of the {s.part} has values that are no numbers.", (first, last), [joint]
    )


def _broken(e: Episode, s: Spec, rng: np.random.Generator) -> None:
    e.broken = s.variant
    words = {
        "half": "Half of the file is missing.",
        "gone": "The file of the episode is gone.",
        "row": "The file has fewer rows than the metadata says.",
        "cut": "data.json ends in the middle of a frame.",
        "latin": "The text is not UTF-8.",
        "empty": "data.json has no frames.",
        "name": "The folder's name is no UTF-8.",
        "short": "A joint is missing from the states of some frames.",
    }
    _tell(e, words[s.variant])


FAULTS: dict[str, Callable[[Episode, Spec, np.random.Generator], None]] = {
    "frozen_joint": _frozen,
    "frozen_side": _frozen,
    "frozen_all": _frozen,
    "repeated_frames": _repeated,
    "action_shift": _action_shift,
    "lag_drift": _lag_drift,
    "clipped_action": _clipped,
    "not_followed": _not_followed,
    "jump": _jump,
    "wrong_unit": _wrong_unit,
    "wrong_side": _wrong_side,
    "wrong_joint_order": _wrong_order,
    "inverted_sign": _inverted,
    "missing_stretch": _missing,
    "wrong_fps": _wrong_fps,
    "duplicate": _duplicate,
    "idle_start": _idle,
    "idle_end": _idle,
    "grasp_on_nothing": _grasp_on_nothing,
    "drop_in_grasp": _drop,
    "camera_frozen": _camera,
    "camera_late": _camera,
    "camera_early_end": _camera,
    "camera_missing": _camera,
    "no_task": _no_task,
    "wrong_stats": _wrong_stats,
    "not_finite": _not_finite,
    "broken_file": _broken,
}


def spoil(e: Episode, plan: Plan, entry: str, made: list[Episode], number: int) -> None:
    """Put the entry's fault into an episode, and name it in its label."""
    fault, part, strength, variant = (*entry.split(), "")[:4]
    part = "" if part == "-" else part.replace("camera:", "camera ")
    e.label |= {"expect": "spoiled", "fault": fault, "part": part, "strength": strength}
    spec = Spec(plan, fault, part, strength == "plain", variant, made)
    rng = np.random.default_rng([57, zlib.crc32(plan.folder.encode()), number])
    FAULTS[fault](e, spec, rng)
