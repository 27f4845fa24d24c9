"""Time at the begin and the end of an episode in which nothing is commanded and nothing moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexkit.conformance.dataset.check import Check, Figure
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import Bools, frames_of, medians, runs_of, series_of
from dexkit.hand import Floats

__all__ = ["CHECKS"]

_STILL = 0.02  # strokes: less is no motion, but noise, sag or a trembling operator
_NOISES = 8.0
_LONG_S, _SHARE = 5.0, 0.25  # of idle time that asks to be cut
_REMARK_S = 2.0
_HOLDS = 0.08  # strokes that an action is beyond its state while a hand holds something


def _idle(episode: Episode) -> Iterator[Finding | Figure]:
    begin, end = _still(episode)
    count = len(episode)
    if count < 3 or episode.duration <= 0:
        return
    if begin >= count - 1:
        yield Figure("idle, %", 100.0)
        if episode.duration > 2.0:
            yield Finding("idle", Use.REVIEW, "nothing moves in the whole episode")
        return
    times = {"begin": float(episode.t[begin]), "end": float(episode.duration - episode.t[end])}
    idle = sum(times.values())
    yield Figure("idle, %", 100 * idle / episode.duration)
    pause = _longest_pause(episode, begin, end) if max(times.values()) > _LONG_S else 0.0
    for where, seconds in times.items():
        if seconds < _REMARK_S:
            continue
        # where nothing moves for as long in the midst of it, to wait is part of the task
        long = seconds > max(_LONG_S, pause) and seconds > _SHARE * episode.duration
        cut = (
            (float(episode.t[begin]), episode.duration)
            if where == "begin"
            else (0.0, float(episode.t[end]))
        )
        yield Finding(
            "idle",
            Use.REVIEW if long else Use.KEEP,
            f"nothing is commanded and nothing moves for {seconds:.1f} s at the {where}, "
            f"{seconds / episode.duration:.0%} of the episode"
            + (f": cut it to {cut[0]:.1f} to {cut[1]:.1f} s" if long else ""),
            begin_s=0.0 if where == "begin" else float(episode.t[end]),
            end_s=float(episode.t[begin]) if where == "begin" else episode.duration,
            value=round(seconds, 3),
            limit=_LONG_S,
            unit="s",
        )


def _still(episode: Episode) -> tuple[int, int]:
    """The frames at which the motion begins and ends; the number of frames where there is none."""
    count = len(episode)
    begin, end = count, 0
    smooth = frames_of(episode, 0.1)
    for track in episode.tracks:
        state, action = series_of(track, "state"), series_of(track, "action")
        for series in (state, action):
            if series is None:
                continue
            limit = np.maximum(_STILL, np.maximum(_NOISES * series.noise, 2.5 * series.quantum))
            if series is state and (2.5 * series.quantum > _STILL).any():
                limit = np.minimum(limit, 0.06)  # two steps of the coarsest encoders
            # only what other parts leave still is looked at
            first = medians(series.q[: smooth + 1])
            moved = _beyond(series.q[:begin], first, limit)
            begin = int(np.argmax(moved)) if moved.any() else begin
            last = medians(series.q[-smooth - 1 :])
            moved = _beyond(series.q[:end:-1], last, limit)
            end = count - 1 - int(np.argmax(moved)) if moved.any() else end
    if begin >= count:
        return count, count
    for track in episode.hands:
        state, action = series_of(track, "state"), series_of(track, "action")
        # a hand that presses on an object is at work, though nothing moves
        if state is not None and action is not None and _holds(state.q[end:], action.q[end:]):
            return begin, count - 1
    return begin, end


def _beyond(values: Floats, level: Floats, limit: Floats) -> Bools:
    """Frames in which a joint is further than that from a level."""
    return np.asarray(((values > level + limit) | (values < level - limit)).any(axis=1))


def _longest_pause(episode: Episode, begin: int, end: int) -> float:
    """The longest time between begin and end in which nothing moves, s."""
    block = frames_of(episode, 0.5)
    count = (end - begin) // block
    if count < 2:
        return 0.0
    still = np.ones(count, dtype=np.bool_)
    for track in episode.tracks:
        for series in (series_of(track, "state"), series_of(track, "action")):
            if series is not None:
                q = series.q[begin : begin + count * block].reshape(count, block, -1)
                limit = np.maximum(_STILL, np.maximum(_NOISES * series.noise, 2 * series.quantum))
                still &= (np.ptp(q, axis=1) < limit).all(axis=1)
    longest = max((e - b for b, e in runs_of(still)), default=0)
    return longest * block / episode.fps


def _holds(state: Floats, action: Floats) -> bool:
    return bool((np.abs(medians(action - state)) > _HOLDS).any())


CHECKS = (Check("idle", "Long idle time at the start or the end", frozenset(), _idle),)
