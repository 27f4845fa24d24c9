"""Numbers that stand still: an observation, or an action, that is not what there was.

A live hand may stand still to the last digit: a simulated one at rest, a coarse encoder, a finger
at an object or at its end. So a joint is called frozen only where something shows that it was
not there: its action went where nothing can have held it back, its own velocities say that it
moved, or its sensor trembles at all other times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import (
    Bools,
    Series,
    frames_of,
    joints_text,
    part_text,
    runs_of,
    runs_of_joints,
    series_of,
    speed_of,
)
from dexkit.hand import Floats

__all__ = ["CHECKS"]

_SHORTEST_S = 0.4  # a hand with slow registers renews its values each 0.2 s
_LATE_S = 0.5  # that a hand may be behind its action: what the action did last proves nothing
_LATER_S = 0.6  # that a slow hand may go on to do what it was told before
_OPENS = 0.15  # strokes further open than the state: ends of real hands are 9 % off
_ASIDE = 0.1  # strokes to either side of the state
_FAR = 0.4  # strokes from an end at which no object can have held the hand
_AT_END = 0.12  # strokes from that end
_LASTS_S = 0.2  # s for which the action must be there
_AWAY = 0.15  # strokes that a state moves away from an action that stands still


@dataclass
class _Stretch:
    """Frames in which joints of a part stand still."""

    begin: int
    end: int
    joints: list[int]
    moved: float
    reason: str


def _observation(episode: Episode) -> Iterator[Finding]:
    found: list[tuple[Track, _Stretch]] = []
    for track in episode.tracks:
        state = series_of(track, "state")
        if state is not None:
            found += [(track, s) for s in _merged(list(_stretches(episode, track, state)))]
    for group in _together(found):
        yield _finding(episode, group)


def _stretches(episode: Episode, track: Track, state: Series) -> Iterator[_Stretch]:
    """The stretches of single joints for which there is evidence."""
    least = frames_of(episode, _SHORTEST_S)
    action = series_of(track, "action")
    runs = [
        (j, begin - 1, end)  # the first frame of the same value is not the same as before
        for j, begin, end in runs_of_joints(state.same, least)
    ]
    if not runs:
        return
    trembles = _trembles(state, action, runs)
    closing = track.closing
    turned = _turned(episode, track, state)
    window = frames_of(episode, 1.0)
    for j, begin, end in runs:
        reason, moved = "", 0.0
        if action is not None:
            sign = 0.0 if closing is None else float(closing[j])
            reason, moved = _defied(episode, track, state, action, j, begin, end, sign)
        if not reason and turned is not None:
            way = _way(turned[begin:end, j], window)
            if way > _OPENS:
                reason, moved = "velocity", way
        if not reason and trembles[j] and end - begin > 8 and not _at_rail(state, j, begin, end):
            reason = "noise"
        if reason:
            yield _Stretch(begin, end, [j], moved, reason)


def _defied(
    episode: Episode,
    track: Track,
    state: Series,
    action: Series,
    joint: int,
    begin: int,
    end: int,
    closing: float,
) -> tuple[str, float]:
    """How far the action went where nothing can have held the joint back; 0 and no reason if it
    did not.
    """
    late = frames_of(episode, _LATE_S)
    goal = action.q[begin : max(end - late, begin), joint]
    goal = goal[action.there[begin : max(end - late, begin)]]
    lasts = frames_of(episode, _LASTS_S)
    if len(goal) <= lasts:
        return "", 0.0
    way = float(np.ptp(goal))
    if way < _ASIDE:
        return "", 0.0
    off = goal - state.q[begin, joint]
    limit = max(0.0, 3 * float(state.noise[joint]))
    below, above = -_held(-off, lasts), _held(off, lasts)
    if not track.is_hand:
        if max(above, -below) > _OPENS + limit and way > _OPENS:
            return "action", way
        return "", 0.0
    if closing and -below * closing > 0 and way > _OPENS:
        opens = -below if closing > 0 else above
        if opens > _OPENS + limit:
            return "action", way
    if closing < 0 and above > _OPENS + limit and way > _OPENS:
        return "action", way
    if above > _ASIDE + limit and -below > _ASIDE + limit and not closing:
        return "action", way
    # at the end from which all of the action's way lies on one side: no object fits there
    low, high = _ends(action, joint)
    here = float(state.q[begin, joint])
    if way > _FAR and (
        (above > _FAR and here < low + _AT_END) or (-below > _FAR and here > high - _AT_END)
    ):
        return "action", way
    return "", 0.0


def _held(values: Floats, lasts: int) -> float:
    """The highest value that is reached or exceeded for some frames in all."""
    return float(np.partition(values, len(values) - lasts)[len(values) - lasts])


def _ends(action: Series, joint: int) -> tuple[float, float]:
    return float(action.q[:, joint].min()), float(action.q[:, joint].max())


def _turned(episode: Episode, track: Track, state: Series) -> Floats | None:
    """Where the velocities say that the joints are, in strokes; None without, or where they do
    not agree with the positions while these move.
    """
    speed = speed_of(track)
    if speed is None:
        return None
    seen = np.where(state.same, 0, state.steps)[1:] * episode.fps
    said = np.where(state.same, 0, 0.5 * (speed + np.roll(speed, 1, axis=0)))[1:]
    product, own, other = (seen * said).sum(), (said * said).sum(), (seen * seen).sum()
    if not own or not other or product < 0.7 * np.sqrt(own * other):
        return None
    if not 0.7 < product / own < 1.4:
        return None
    return np.asarray(np.cumsum(speed, axis=0) / episode.fps)


def _way(turned: Floats, window: int) -> float:
    """The farthest way within a window; longer ones sum up what a sensor is off at rest."""
    if len(turned) <= window:
        return float(np.ptp(turned))
    return float(np.abs(turned[window:] - turned[:-window]).max())


def _trembles(state: Series, action: Series | None, runs: list[tuple[int, int, int]]) -> Bools:
    """Whether each joint trembles outside of its stretches, though its action stands still: else
    it may tremble because its action does.
    """
    outside = np.ones(state.q.shape, dtype=bool)
    for j, begin, end in runs:
        outside[begin : end + 1, j] = False
    steady = outside if action is None else outside & action.same
    return state.live(outside) & state.live(steady)


def _at_rail(state: Series, joint: int, begin: int, end: int) -> bool:
    """Whether it stands at the lowest or highest value, and does so at other times as well: a
    value that is cut off there does not tremble.
    """
    q = state.q[:, joint]
    here = q[begin]
    if q.min() < here < q.max():
        return False
    return bool((np.count_nonzero(q == here) > end - begin) or here in (0.0, 1.0))


def _merged(stretches: list[_Stretch]) -> list[_Stretch]:
    """Stretches of a part that overlap by more than half, as one."""
    found: list[_Stretch] = []
    for new in sorted(stretches, key=lambda s: (s.begin, s.end)):
        for old in found:
            common = min(new.end, old.end) - max(new.begin, old.begin)
            if common > 0.5 * min(new.end - new.begin, old.end - old.begin):
                old.begin, old.end = min(old.begin, new.begin), max(old.end, new.end)
                old.joints = sorted({*old.joints, *new.joints})
                if new.moved > old.moved:
                    old.moved, old.reason = new.moved, new.reason
                break
        else:
            found.append(new)
    return found


_Group = list[tuple[Track, _Stretch]]


def _together(found: _Group) -> list[_Group]:
    """Stretches of several parts that begin and end together, in one group."""
    groups: list[_Group] = []
    for track, stretch in found:
        for group in groups:
            _, first = group[0]
            if (
                all(t is not track for t, _ in group)
                and abs(first.begin - stretch.begin) <= 3
                and abs(first.end - stretch.end) <= 3
            ):
                group.append((track, stretch))
                break
        else:
            groups.append([(track, stretch)])
    return groups


def _companions(track: Track, stretch: _Stretch) -> list[int]:
    """The joints of a part that stand still in a stretch, those without evidence as well."""
    state = series_of(track, "state")
    assert state is not None
    still = state.same[stretch.begin + 1 : stretch.end].mean(axis=0) > 0.95
    return sorted({*stretch.joints, *np.flatnonzero(still).tolist()})


def _stands(track: Track, begin: int, end: int) -> bool:
    """Whether all joints of a part stand still, evidence or not."""
    state = series_of(track, "state")
    return state is not None and float(state.same[begin + 1 : end].mean()) > 0.95


def _finding(episode: Episode, group: _Group) -> Finding:
    stretches = [s for _, s in group]
    worst = max(stretches, key=lambda s: s.moved)
    begin, end = min(s.begin for s in stretches), max(s.end for s in stretches)
    begin_s = float(episode.t[begin])
    end_s = float(episode.t[min(end, len(episode.t)) - 1])
    observed = [t for t in episode.tracks if t.state is not None]
    everything = len(observed) > 1 and all(_stands(t, begin, end) for t in observed)
    joints: tuple[int, ...]
    if everything:
        what, part, joints = "all parts", "", ()
    elif len(group) > 1:
        what = " and ".join(part_text(t.part) for t, _ in group)
        part, joints = group[0][0].part, ()
    else:
        track, stretch = group[0]
        together = _companions(track, stretch)
        what, part = joints_text(track, together), track.part
        joints = () if len(together) == len(track.joints) else tuple(together)
    whole = begin <= 1 and end >= len(episode) - 1
    when = "in the whole episode" if whole else f"from {begin_s:.1f} to {end_s:.1f} s"
    text = f"the observation of {what} stands still {when}"
    if worst.reason == "action":
        text += f" while its action moves by {worst.moved:.0%} of the stroke"
    elif worst.reason == "velocity":
        text += f" while its velocities say that it moves by {worst.moved:.0%} of the stroke"
    else:
        text += " to the last digit, while its sensor trembles at all other times"
    text += _cause(group)
    use = Use.DROP
    if worst.reason == "noise":
        # nothing tells that it moved: a policy learns little that is wrong
        use = Use.REVIEW
    return Finding(
        "frozen",
        use,
        text,
        part,
        joints,
        None if whole else begin_s,
        None if whole else end_s,
        value=round(end_s - begin_s, 3),
        limit=_SHORTEST_S,
        unit="s",
    )


def _cause(group: _Group) -> str:
    """What the other numbers of the part say."""
    still = []
    for track, stretch in group:
        for values in (track.dq, track.tau, track.touch):
            if values is not None:
                here = values[stretch.begin + 1 : stretch.end]
                if len(here):
                    still.append(bool((here == here[0]).all()))
    if not still:
        return ": the stream of its sensors froze, or it was off"
    if all(still):
        return ": velocities, torques and touch stand still too, so its numbers froze"
    if not any(still):
        return ": its other numbers are live, so it was off or blocked, or its positions froze"
    return ": the stream of its sensors froze, or it was off"


def _stuck(episode: Episode) -> Iterator[Finding]:
    """Actions that stand still while the part goes on to move."""
    least = frames_of(episode, _LATE_S)
    for track in episode.tracks:
        state, action = series_of(track, "state"), series_of(track, "action")
        if state is None or action is None:
            continue
        found: dict[bytes, Finding | None] = {}
        for begin, end in runs_of(np.asarray(action.same.all(axis=1)), least):
            finding = _moved_away(episode, track, state, action, begin - 1, end)
            if finding is not None:
                # at one value more than once: it is cut off there, not stuck
                key = action.q[begin].tobytes()
                found[key] = None if key in found else finding
        yield from (finding for finding in found.values() if finding is not None)


def _moved_away(
    episode: Episode, track: Track, state: Series, action: Series, begin: int, end: int
) -> Finding | None:
    """The finding of a state that leaves the way to its action, and comes back or is followed."""
    q = np.where(state.there[begin:end, None], state.q[begin:end], np.nan)
    goal = action.q[begin]
    if not np.isfinite(q).any():
        return None
    # what it was told before it may still do
    late = max(begin - frames_of(episode, _LATER_S), 0)
    told = np.concatenate([action.q[late : begin + 1], state.q[late : begin + 1]])
    low, high = told.min(axis=0), told.max(axis=0)
    away = np.fmax(np.nanmax(q - high, axis=0), np.nanmax(low - q, axis=0))
    far = away > _AWAY + 6 * state.noise
    if not far.any():
        return None
    # the action goes on from where the state is by then: the operator had moved it
    last = min(end, len(action.q) - 1)
    follows = (np.abs(action.q[last] - goal) > 0.5 * _AWAY) & (
        np.abs(action.q[last] - state.q[last]) < 0.5 * np.abs(goal - state.q[last])
    )
    up = np.nanmax(np.maximum.accumulate(np.nan_to_num(q)) - np.nan_to_num(q), axis=0)
    down = np.nanmax(np.nan_to_num(q) - np.minimum.accumulate(np.nan_to_num(q)), axis=0)
    returns = np.minimum(up, down) > _AWAY
    sure = far & ((follows & (end < len(action.q))) | returns)
    if not sure.any():
        return None
    joints = np.flatnonzero(sure).tolist()
    begin_s, end_s = float(episode.t[begin]), float(episode.t[end - 1])
    moved = float(np.nanmax(away[joints]))
    return Finding(
        "frozen",
        Use.DROP,
        f"the action of {part_text(track.part)} stands still from {begin_s:.1f} to {end_s:.1f} s "
        f"while {joints_text(track, joints)} moves away from it by {moved:.0%} of the stroke: "
        "the stream of actions froze",
        track.part,
        () if len(joints) == len(track.joints) else tuple(joints),
        begin_s,
        end_s,
        value=round(end_s - begin_s, 3),
        limit=_LATE_S,
        unit="s",
    )


def _frozen(episode: Episode) -> Iterator[Finding]:
    yield from _observation(episode)
    yield from _stuck(episode)


CHECKS = (Check("frozen", "Numbers that stand still", frozenset({Data.STATE}), _frozen),)
