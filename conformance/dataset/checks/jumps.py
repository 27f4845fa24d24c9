"""Positions that leap: further in a frame than the joint can move, or out and back."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import (
    Bools,
    Series,
    frames_of,
    joined,
    joints_text,
    series_of,
    stroke,
)
from dexkit.hand import Floats

__all__ = ["CHECKS"]

_LEAST = 0.08  # strokes: a leap that is worth a word
_ODD = 0.15  # strokes: a single action that far off is no tremor
_NOISES = 10.0  # standard deviations
_ODD_S = 0.5  # for which an arm's action may be out of line: another solution of its solver
_ISOLATED = 4.0  # times the fastest step around it
_MARGIN = 3.0  # times the speed limit: Inspire's real hands do 2.2 times what is taken for theirs
_FASTEST = 40.0  # rad/s, of any joint without a profile: arms do 20, fingers 24
_EXPLAINS = 0.35  # part of a leap that its action must have done in a frame, shortly before
_LATE_S = 0.6  # s that a hand may be behind its action
_TURN = 2 * np.pi


def _jumps(episode: Episode) -> Iterator[Finding]:
    at_once = np.zeros(len(episode), dtype=int)
    ordered = np.zeros(len(episode), dtype=np.bool_)
    held = np.ones(len(episode), dtype=np.bool_)
    found: list[tuple[Track, Bools, Bools]] = []
    for track in episode.tracks:
        state, action = series_of(track, "state"), series_of(track, "action")
        if state is None or len(state.q) < 8:
            continue
        spikes, steps = _leaps(episode, track, state, action)
        at_once += steps.any(axis=1)
        if steps.any():
            ordered |= np.zeros_like(ordered) if action is None else action.leaps.any(axis=1)
            held[1:] &= state.same[:-1].all(axis=1) | ~steps[1:].any(axis=1)
        found.append((track, spikes, steps))
    together = (at_once > 1) & (at_once == len(found))
    for track, spikes, steps in found:
        # where every part leaps at once something is missing
        yield from _findings(episode, track, spikes, steps & ~together[:, None])
    # where the actions leap as well frames are missing, and after a stretch of one value the
    # stream was frozen: both are told as such
    for i in np.flatnonzero(together & ~ordered & ~held)[:1].tolist():
        yield Finding(
            "missing",
            Use.DROP,
            f"observations are missing before {episode.t[i]:.1f} s: those of all parts leap in one "
            "frame while their actions go on",
            begin_s=float(episode.t[i - 1]),
            end_s=float(episode.t[i]),
        )
    yield from _odd_actions(episode)


def _odd_actions(episode: Episode) -> Iterator[Finding]:
    """Single actions that are out of line: out and back, of an operator who has no such steps."""
    for track in episode.tracks:
        action = series_of(track, "action")
        if action is None or len(action.q) < 8:
            continue
        size = action.size
        floor = np.maximum(_ODD, np.maximum(_NOISES * action.noise, 3 * action.quantum))
        big = size > floor
        if not big.any():
            continue
        big &= (action.there & joined(episode))[:, None]
        spikes = np.zeros_like(big)
        # a hand that is told to close and open by a trigger may be told so for a moment
        longest = 2 if track.is_hand else max(2, frames_of(episode, _ODD_S))
        for width in range(1, min(longest, len(size) - 1) + 1):
            out, back = action.steps[:-width], action.steps[width:]
            hit = big[:-width] & big[width:] & (out * back < 0)
            hit &= np.abs(out + back) < 0.3 * np.abs(out)
            hit &= np.abs(out) > _ISOLATED * action.around(width)[:-width]
            spikes[:-width] |= hit
        # triggers and buttons have steps, clicks as well
        steps = big.sum(axis=0) - 2 * spikes.sum(axis=0)
        spikes &= steps <= 0
        if not spikes.any() or _is_taught(track):
            continue
        frames, joints = np.flatnonzero(spikes.any(axis=1)), np.flatnonzero(spikes.any(axis=0))
        far = np.abs(action.steps) * spikes * stroke(track)
        at, joint = np.unravel_index(int(np.argmax(far)), far.shape)
        unit = "" if track.model is None else track.model.unit
        where = f"at {episode.t[at]:.2f} s"
        if len(frames) > 1:
            where = f"at {len(frames)} places, the farthest {where}"
        yield Finding(
            "jump",
            Use.REVIEW,
            f"the action of {joints_text(track, joints.tolist())} leaps out and back {where}, by "
            f"{far[at, joint]:.3g} {unit}".rstrip()
            + f", within {max(2 / episode.fps, _ODD_S if longest > 2 else 0):.2g} s: it is no "
            "motion, but wrong values",
            track.part,
            () if len(joints) == len(track.joints) else tuple(joints.tolist()),
            float(episode.t[max(frames[0] - 1, 0)]),
            float(episode.t[min(frames[-1] + 1, len(episode) - 1)]),
            value=round(float(far[at, joint]), 4),
            limit=round(float(_ODD * stroke(track)[joint]), 4),
            unit=unit,
        )


def _is_taught(track: Track) -> bool:
    """Whether its actions are its states: the same leap is told of the states."""
    state, action = series_of(track, "state"), series_of(track, "action")
    if state is None or action is None or state.q.shape != action.q.shape:
        return False
    return bool(
        np.abs(action.q - state.q).max() < 1e-5 or np.abs(action.q[:-1] - state.q[1:]).max() < 1e-5
    )


def _leaps(
    episode: Episode, track: Track, state: Series, action: Series | None
) -> tuple[Bools, Bools]:
    """Frames and joints of values out of line for 1 to 3 frames, and of leaps that stay."""
    size, steps = state.size, state.steps
    n = len(size)
    floor = np.maximum(_LEAST, np.maximum(_NOISES * state.noise, 3 * state.quantum))
    big = size > floor
    spikes, stays = np.zeros_like(big), np.zeros_like(big)
    if not big.any():
        return spikes, stays
    big &= (state.there & joined(episode))[:, None]
    around = state.around()
    given = _given(episode, action, size.shape)
    unexplained = big & ((given < _EXPLAINS * size) | _leaves(episode, state, action, size))
    # out and back: the values before and after it agree
    for width in (1, 2, 3):
        if n <= width + 2:
            break
        out, back = steps[: n - width], steps[width:]
        opposite = (out * back < 0) & (np.abs(out + back) < 0.3 * np.abs(out))
        sizable = unexplained[: n - width] & (np.abs(back) > floor)
        hit = opposite & sizable
        hit &= np.abs(out) > _ISOLATED * state.around(width)[: n - width]
        spikes[: n - width] |= hit
    # a leap that stays, alone among slow steps, or faster than any joint
    held = _held_for(state)
    limit = _fastest(episode, track) * np.minimum(held, frames_of(episode, 0.25))
    impossible = unexplained & (size > limit + floor)
    alone = unexplained & (size > _ISOLATED * around + floor) & (held <= 2)
    stays = (alone | impossible) & ~spikes
    # and the way back of a spike is no leap of its own
    for width in (1, 2, 3):
        stays[width:] &= ~spikes[: n - width]
    return spikes, stays


def _held_for(state: Series) -> Floats:
    """For how many frames each joint had its value before it changed, 1 at least."""
    n = len(state.q)
    index = np.arange(n)[:, None]
    changed = np.where(state.same, 0, index)
    last = np.maximum.accumulate(changed, axis=0)
    held = np.ones_like(state.q)
    held[1:] = index[1:] - last[:-1]
    return np.asarray(held)


def _fastest(episode: Episode, track: Track) -> Floats:
    """Strokes per frame that no joint does, shape (joints,)."""
    size = stroke(track)
    if track.fastest is not None:
        return np.asarray(track.fastest * _MARGIN / episode.fps / size)
    return np.asarray(np.full(len(size), _FASTEST / episode.fps) / np.minimum(size, _TURN))


def _given(episode: Episode, action: Series | None, shape: tuple[int, ...]) -> Floats:
    """The largest step of the action in each frame or shortly before it, over one or two frames."""
    if action is None or action.q.shape != shape:
        return np.zeros(shape)
    size = np.abs(action.steps)
    size[1:] = np.maximum(size[1:], np.abs(action.steps[1:] + action.steps[:-1]))
    late = frames_of(episode, _LATE_S)
    found = size.copy()
    # the highest of a window, by doubling
    width = 1
    while width < late:
        step = min(width, late - width)
        found[step:] = np.maximum(found[step:], found[:-step].copy())
        width += step
    found[:-1] = np.maximum(found[:-1], size[1:])  # and in the next frame: the next state
    return found


def _leaves(episode: Episode, state: Series, action: Series | None, size: Floats) -> Bools:
    """Whether a state leaps away from wherever its action has been for as long as it may be late:
    no step of the action asks for this.
    """
    found = np.zeros(size.shape, dtype=np.bool_)
    if action is None or action.q.shape != size.shape:
        return found
    late = frames_of(episode, _LATE_S)
    low, high = action.q.copy(), action.q.copy()
    width = 1
    while width < late:
        step = min(width, late - width)
        low[step:] = np.minimum(low[step:], low[:-step].copy())
        high[step:] = np.maximum(high[step:], high[:-step].copy())
        width += step
    low[:-1] = np.minimum(low[:-1], action.q[1:])
    high[:-1] = np.maximum(high[:-1], action.q[1:])
    outside = np.maximum(np.maximum(low - state.q, state.q - high), 0)
    found[1:] = outside[1:] - outside[:-1] > 0.7 * size[1:]
    return found


def _findings(episode: Episode, track: Track, spikes: Bools, stays: Bools) -> Iterator[Finding]:
    state = series_of(track, "state")
    assert state is not None
    for mask, kind in ((spikes, "spike"), (stays, "leap")):
        if not mask.any():
            continue
        frames = np.flatnonzero(mask.any(axis=1))
        joints = np.flatnonzero(mask.any(axis=0)).tolist()
        far = np.abs(state.steps) * mask
        at, joint = np.unravel_index(int(np.argmax(far)), far.shape)
        value = float(far[at, joint] * stroke(track)[joint])
        unit = "rad" if track.model is None or track.model.unit == "rad" else "of the stroke"
        if track.model is None:
            unit = ""
        where = f"at {episode.t[at]:.2f} s"
        if len(frames) > 1:
            where = f"at {len(frames)} places, the farthest {where}"
        what = f"the observation of {joints_text(track, joints)}"
        if kind == "spike":
            text = f"{what} leaps out and back {where}, by {value:.3g} {unit}".rstrip()
            text += ", which its action does not ask for: single wrong values"
        elif unit != "of the stroke" and abs(value - _TURN * max(1, round(value / _TURN))) < 0.5:
            text = f"{what} leaps by a full turn {where}: its encoder wrapped"
        else:
            text = f"{what} leaps {where}, by {value:.3g} {unit} in a frame".rstrip()
            text += ", which no joint does and its action does not ask for"
        yield Finding(
            "jump",
            Use.DROP if kind == "leap" or len(frames) > 2 else Use.REVIEW,
            text,
            track.part,
            () if len(joints) == len(track.joints) else tuple(joints),
            float(episode.t[max(frames[0] - 1, 0)]),
            float(episode.t[min(frames[-1] + 1, len(episode) - 1)]),
            value=round(value, 4),
            limit=round(float(_LEAST * stroke(track)[joint]), 4),
            unit=unit,
        )


CHECKS = (Check("jump", "Positions that leap", frozenset({Data.STATE}), _jumps),)
