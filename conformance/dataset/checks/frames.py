"""Frames that are there twice, and frames that are not there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode, Gap, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import (
    Bools,
    Series,
    frames_of,
    joined,
    part_text,
    runs_of,
    series_of,
)
from dexkit.hand import Floats

__all__ = ["CHECKS"]

_PERIODS = 15  # changes from which a period can be told
_SLOW_S = 0.09  # s between two values: no hand or arm that sends 200 a second looks like this
_SLOWEST_S = 0.22  # likewise of six joints, which may be an Inspire hand: it renews each 0.2 s
_FAST_HZ = 150.0  # of hands whose values must be newer
_REPEATS = 4  # frames of a run
_LIVE = 3  # joints that tremble, from which no frame is the same as another by chance
_REPLAY_S = 0.4  # s of a stretch that is there again
_LOST_S = 0.1  # s without frames that are worth a look; fewer are a remark
_SILENT_S = 0.3  # s without a state of a hand
_LONG_S = 1.0  # s after which too much is missing


@dataclass(frozen=True, eq=False)
class _Table:
    """All parts side by side."""

    states: list[tuple[Track, Series]]
    actions: list[tuple[Track, Series]]

    @property
    def all(self) -> list[Series]:
        return [s for _, s in (*self.states, *self.actions)]


def _table(episode: Episode) -> _Table:
    states = [(t, s) for t in episode.tracks if (s := series_of(t, "state")) is not None]
    actions = [(t, s) for t in episode.tracks if (s := series_of(t, "action")) is not None]
    return _Table(states, actions)


def _same(series: list[Series]) -> Bools:
    """Frames in which no value differs from the frame before."""
    return np.asarray(np.logical_and.reduce([s.same.all(axis=1) for s in series]))


def _repeated(episode: Episode) -> Iterator[Finding]:
    table = _table(episode)
    if not table.states:
        return
    same = _same(table.all)
    if table.actions:
        every, begin, end = _period(table.all, same)
        if every and end - begin < 0.7 * len(episode):
            yield _finding_of_run(episode, [(begin, end)], f"each frame is there {every} times")
            return
        if every:
            yield Finding(
                "repeated",
                Use.REVIEW,
                f"each frame is there {every} times: it was recorded at "
                f"{episode.fps / every:g} frames per second, not at {episode.fps:g}",
                value=float(every),
                limit=1.0,
            )
            return
        yield from _runs(episode, table, same)
    yield from _replayed(episode, table, same)
    yield from _stale(episode, table)


def _period(series: list[Series], same: Bools) -> tuple[int, int, int]:
    """How many times each value is there, and the first and last frame of this; 0 where values are
    not repeated regularly.

    Steps of one quantum do not count: a coarse encoder has them at regular times.
    """
    changes = np.flatnonzero(~same)
    if len(changes) < _PERIODS + 2:
        return 0, 0, 0
    gaps = np.diff(changes)
    size = np.max([(np.abs(s.steps) / np.maximum(s.quantum, 1e-9)).max(axis=1) for s in series], 0)
    counted = size[changes[1:]] >= 3
    lengths, counts = np.unique(gaps[counted & (gaps > 1) & (gaps <= 12)], return_counts=True)
    if not len(lengths):
        return 0, 0, 0
    every = int(lengths[np.argmax(counts)])
    # longer ones, as it rests, may lie between; shorter ones may not
    fits = (gaps % every == 0) | ~counted & (gaps > every)
    best = max(runs_of(fits), key=lambda r: r[1] - r[0], default=(0, 0))
    begin, end = best
    inside = gaps[begin:end][counted[begin:end]]
    if (inside == every).sum() < _PERIODS or np.mean(inside == every) < 0.5:
        return 0, 0, 0
    return every, int(changes[begin]), int(changes[end])


def _live_repeats(episode: Episode, table: _Table, same: Bools) -> list[tuple[int, int]]:
    """Frames that are the same as the frame before, though sensors tremble in all others; begin
    and end of each stretch with many of them.
    """
    count = int(same.sum())
    if count < _REPEATS or same.mean() > 0.9:
        return []
    fresh = ~same
    fresh[1:] &= ~same[:-1]
    live = 0
    for _, state in table.states:
        # a sensor that has slow registers repeats its values while the actions go on
        if state.same[fresh].all(axis=1).mean() > 0.05:
            return []
        live += int(state.live(fresh).sum())
    if live < _LIVE:
        return []
    window = frames_of(episode, 1.0)
    near = np.convolve(same, np.ones(window), mode="same") >= max(_REPEATS, 0.2 * window)
    found = []
    for begin, end in runs_of(np.asarray(near)):
        at = begin + np.flatnonzero(same[begin:end])
        if len(at) >= _REPEATS:
            found.append((int(at[0]) - 1, int(at[-1]) + 1))
    return found


def _runs(episode: Episode, table: _Table, same: Bools) -> Iterator[Finding]:
    """Runs of one frame between frames that move, or that tremble."""
    usual = _usual_run(same)
    found = _live_repeats(episode, table, same) or [
        run for run in runs_of(same, max(_REPEATS, 2 * usual + 1)) if _cut_out(episode, table, *run)
    ]
    if found:
        count = sum(int(same[begin:end].sum()) for begin, end in found)
        yield _finding_of_run(episode, found, f"{count} frames are those before them again")


def _finding_of_run(episode: Episode, found: list[tuple[int, int]], what: str) -> Finding:
    count = sum(end - begin for begin, end in found)
    begin_s, end_s = float(episode.t[found[0][0]]), float(episode.t[found[-1][1] - 1])
    where = (
        f"from {begin_s:.1f} to {end_s:.1f} s"
        if len(found) == 1
        else f"at {len(found)} places from {begin_s:.1f} to {end_s:.1f} s"
    )
    return Finding(
        "repeated",
        Use.DROP if count >= frames_of(episode, 0.5) else Use.REVIEW,
        f"{what} {where}, states and actions of all parts alike, while they move or tremble: "
        "the recorder stood still",
        begin_s=begin_s,
        end_s=end_s,
        value=float(count),
        limit=float(_REPEATS),
        unit="frames",
    )


def _usual_run(same: Bools) -> int:
    """The length of runs that is usual where values are renewed slowly."""
    lengths = [end - begin for begin, end in runs_of(same)]
    return int(np.percentile(lengths, 75)) if len(lengths) >= 8 else 0


def _cut_out(episode: Episode, table: _Table, begin: int, end: int) -> bool:
    """Whether all values stop in one frame though most of them changed in each frame before.

    A state comes to rest after its action: both never stop in one frame, unless the action is the
    state.
    """
    around = 5
    if begin - around < 1 and end + around > len(episode):
        return False
    states = [s for _, s in table.states]
    actions = [s for _, s in table.actions]
    if begin > around:
        before = slice(begin - around, begin)
        s, a = (_changing(series, before) for series in (states, actions))
        if s > 0.8 and a > 0.5 and not _is_taught(table):
            return True
    if end + 1 < len(episode) and begin > 1:
        # the motion goes on after it as it was before it
        v = np.concatenate([x.steps[[begin - 1, end]] for x in states + actions], axis=1)
        top = np.concatenate(
            [np.maximum(np.abs(x.steps).max(axis=0), 1e-9) for x in states + actions]
        )
        fast = np.abs(v).min(axis=0) / top > 0.25
        alike = (v[0] * v[1] > 0) & fast
        return bool(
            alike.sum() >= 2 and alike.sum() >= 0.6 * (np.abs(v).max(axis=0) / top > 0.25).sum()
        )
    return False


def _is_taught(table: _Table) -> bool:
    """Whether the actions are the states, or the next ones."""
    for track, state in table.states:
        for other, action in table.actions:
            if other is track:
                same = np.abs(action.q - state.q).max() < 1e-5
                shifted = np.abs(action.q[:-1] - state.q[1:]).max() < 1e-5
                if not (same or shifted):
                    return False
    return True


def _changing(series: list[Series], frames: slice) -> float:
    """The share of values that change from frame to frame, of those that ever do."""
    share = [(~s.same[frames]).mean(axis=0)[~s.same.all(axis=0) & (s.quantum > 0)] for s in series]
    values = np.concatenate(share)
    return float(values.mean()) if len(values) else 0.0


def _replayed(episode: Episode, table: _Table, same: Bools) -> Iterator[Finding]:
    """A moving stretch that is there again, to the last digit of states that tremble."""
    n = len(episode)
    least = max(frames_of(episode, _REPLAY_S), 5)
    if n < 3 * least:
        return
    matrix = np.concatenate([s.q for s in table.all], axis=1)
    mixed = matrix @ np.cos(1.7 + 2.3999632 * np.arange(matrix.shape[1]))
    moving = np.flatnonzero(~same)
    order = moving[np.argsort(mixed[moving], kind="stable")]
    equal = mixed[order[1:]] == mixed[order[:-1]]
    first, second = order[:-1][equal], order[1:][equal]
    if len(first) < least:
        return
    lags = second - first
    values, counts = np.unique(lags, return_counts=True)
    for lag in values[np.argsort(-counts)][:3].tolist():
        if lag < least:
            continue
        again = np.zeros(n, dtype=bool)
        again[second[lags == lag]] = True
        for begin, end in runs_of(again, least):
            if not np.array_equal(matrix[begin:end], matrix[begin - lag : end - lag]):
                continue
            if not _unrepeatable(table, begin, end):
                continue
            begin_s, end_s = float(episode.t[begin]), float(episode.t[end - 1])
            yield Finding(
                "repeated",
                Use.DROP,
                f"from {begin_s:.1f} to {end_s:.1f} s the frames of {lag / episode.fps:.1f} s "
                "earlier are there again, to the last digit",
                begin_s=begin_s,
                end_s=end_s,
                value=round(end_s - begin_s, 3),
                limit=_REPLAY_S,
                unit="s",
            )
            return


def _unrepeatable(table: _Table, begin: int, end: int) -> bool:
    """Whether the states tremble in a stretch, or it begins or ends with a leap: a simulated
    hand that does the same again has the same numbers again.
    """
    for _, state in table.states:
        turned = state.steps[begin + 1 : end] * state.steps[begin : end - 1] < 0
        sizes = np.abs(state.steps[begin:end]).max(axis=0)
        if ((turned.mean(axis=0) > 0.2) & (sizes > 6 * state.quantum)).any():
            return True
        for i in (begin, end):
            if i < len(state.there):
                near = np.abs(state.steps[max(i - 3, 1) : i + 4])
                step = np.abs(state.steps[i])
                if (step > 0.05).any() and (
                    step > 3 * np.delete(near, min(3, i - 1), 0).max(0)
                ).any():
                    return True
    return False


def _stale(episode: Episode, table: _Table) -> Iterator[Finding]:
    """States that are renewed more seldom than the frames, though the part sends more of them."""
    for track, state in table.states:
        limit = _SLOWEST_S if track.model is None and track.is_hand else _SLOW_S
        if track.model is not None and track.model.min_state_rate < _FAST_HZ:
            continue
        every, begin, end = _period([state], np.asarray(state.same.all(axis=1)))
        if end - begin < 0.5 * len(episode):
            continue
        action = series_of(track, "action")
        if every / episode.fps < limit or action is None:
            continue
        if _period([action], np.asarray(action.same.all(axis=1)))[0] == every:
            continue
        yield Finding(
            "repeated",
            Use.REVIEW,
            f"the observation of {part_text(track.part)} has a new value only each "
            f"{every / episode.fps:.2f} s, {every} frames: it is that of a slow topic, and up to "
            "so much too old",
            track.part,
            value=round(every / episode.fps, 3),
            limit=limit,
            unit="s",
        )


# -- frames that are missing ---------------------------------------------------------------------


def _missing(episode: Episode) -> Iterator[Finding]:
    yield from _not_finite(episode)
    yield from _numbers(episode)
    if episode.measured:
        yield from _gaps(episode)
    else:
        yield from _leaps(episode)


def _not_finite(episode: Episode) -> Iterator[Finding]:
    for track in episode.tracks:
        for what, series in (
            ("observation", series_of(track, "state")),
            ("action", series_of(track, "action")),
        ):
            if series is None:
                continue
            there = series.there
            first, last = int(np.argmax(there)), len(there) - int(np.argmax(there[::-1]))
            inside = ~there
            inside[:first] = False  # before the first command of a client
            if episode.measured:
                # gaps of a stream are told as such; after the last message nothing is wrong
                continue
            count = int(inside.sum())
            if not count:
                continue
            del last
            at = np.flatnonzero(inside)
            begin_s, end_s = float(episode.t[at[0]]), float(episode.t[at[-1]])
            yield Finding(
                "missing",
                Use.DROP if count > frames_of(episode, _LOST_S) else Use.REVIEW,
                f"the {what} of {part_text(track.part)} has no finite value in {count} frames "
                f"between {begin_s:.1f} and {end_s:.1f} s",
                track.part,
                begin_s=begin_s,
                end_s=end_s,
                value=float(count),
                limit=0.0,
                unit="frames",
            )


def _numbers(episode: Episode) -> Iterator[Finding]:
    """Numbers of frames, or else their stamps, that skip."""
    steps: Floats | None = None
    if episode.numbers is not None and len(episode.numbers) > 1:
        steps = np.diff(episode.numbers)
        what = "their numbers skip"
        if (steps <= 0).any():
            steps = None
    elif episode.numbers is None and episode.stamps is None and not episode.measured:
        # formats without stamps have their times by the numbers of their frames
        steps = np.diff(episode.t) * episode.fps
        what = "their numbers skip"
    if (steps is None or not (steps > 1.7).any()) and episode.stamps is not None:
        usual = float(np.median(np.diff(episode.stamps))) if len(episode.stamps) > 2 else 0.0
        if usual <= 0:
            return
        steps = np.diff(episode.stamps) / usual
        what = "their times skip"
    if steps is None:
        return
    lost = np.rint(steps) - 1
    at = np.flatnonzero(steps > 1.7)
    if not len(at):
        return
    longest = int(at[np.argmax(lost[at])])
    count = int(lost[at].sum())
    seconds = float(lost[longest] / episode.fps)
    begin_s = float(episode.t[longest])
    use = Use.KEEP
    if seconds >= _LOST_S:
        use = Use.DROP if seconds >= _LONG_S else Use.REVIEW
    yield Finding(
        "missing",
        use,
        f"{count} frames are missing: {what} at {len(at)} place{'s' * (len(at) > 1)}, "
        f"by {seconds:.2f} s at {begin_s:.1f} s",
        begin_s=begin_s,
        end_s=float(episode.t[longest + 1]),
        value=round(seconds, 3),
        limit=_LOST_S,
        unit="s",
    )


def _gaps(episode: Episode) -> Iterator[Finding]:
    """Stretches that a source with times of its own lacks."""
    topics: dict[str, list[Gap]] = {}
    for gap in episode.gaps:
        topics.setdefault(gap.what, []).append(gap)
    told: list[Finding] = []
    for what, gaps in topics.items():
        command = "cmd" in what.rpartition("/")[2]
        longest = max(gaps, key=lambda g: g.end_s - g.begin_s)
        seconds = longest.end_s - longest.begin_s
        limit = _LONG_S if command else _SILENT_S
        use = Use.REVIEW if seconds > limit else Use.KEEP
        if not command and seconds > _LONG_S:
            use = Use.DROP
        told.append(
            Finding(
                "missing",
                use,
                what,
                begin_s=longest.begin_s,
                end_s=longest.end_s,
                value=round(seconds, 3),
                limit=limit,
                unit="s",
            )
        )
    # topics that are silent together have one cause
    while told:
        first = max(told, key=lambda f: list(Use).index(f.use))
        together = [f for f in told if _at_once(f, first)]
        told = [f for f in told if f not in together]
        names = [f.text for f in together]
        what = "frames" if names == ["frames"] else "messages of " + " and ".join(names)
        count = sum(len(topics[n]) for n in names) - len(names)
        yield msgspec.structs.replace(
            first,
            text=f"no {what} for {first.value:.2f} s at {first.begin_s:.1f} s"
            + (f", and {count} more such gaps" if count else ""),
        )


def _at_once(a: Finding, b: Finding) -> bool:
    assert a.begin_s is not None
    assert b.begin_s is not None
    return abs(a.begin_s - b.begin_s) < 0.1 and abs((a.value or 0) - (b.value or 0)) < 0.2


def _leaps(episode: Episode) -> Iterator[Finding]:
    """Frames at which states and actions of all parts leap at once, and go on as before."""
    table = _table(episode)
    if len(episode) < 12:
        return
    names = {t.part for t, _ in table.states} & {t.part for t, _ in table.actions}
    states = {t.part: s.leaps for t, s in table.states if t.part in names}
    actions = {t.part: s.leaps for t, s in table.actions if t.part in names}
    moved = {t.part: s for t, s in table.states}
    parts = [(states[p].any(axis=1) & actions[p].any(axis=1)) for p in sorted(names)]
    if not parts:
        return
    both = np.sum(parts, axis=0)
    joints = np.sum([s.sum(axis=1) for s in states.values()], axis=0)
    orders = np.sum([a.sum(axis=1) for a in actions.values()], axis=0)
    at = np.flatnonzero(
        ((both >= 2) & (joints >= 2) & (orders >= 2))
        | ((both >= 1) & (joints >= 3) & (orders >= 3))
    )
    at = at[(at > 3) & (at < len(episode) - 3) & joined(episode)[at]]
    places: list[int] = []
    for i in at.tolist():
        if _goes_on(table, states, actions, i):
            places.append(i)
    if not places:
        return
    i = max(places, key=lambda k: int(joints[k]))
    far = max(float(np.abs(moved[p].steps[i][states[p][i]]).max(initial=0)) for p in states)
    yield Finding(
        "missing",
        Use.REVIEW if far < 0.1 else Use.DROP,
        f"frames are missing before {episode.t[i]:.1f} s"
        + (f" and at {len(places) - 1} more places" if len(places) > 1 else "")
        + f": states and actions of {int(both[i])} parts leap in one frame, by up to {far:.0%} of "
        "the stroke, though their numbers go on",
        begin_s=float(episode.t[i - 1]),
        end_s=float(episode.t[i]),
        value=round(far, 4),
        unit="strokes",
    )


def _goes_on(table: _Table, states: dict[str, Bools], actions: dict[str, Bools], i: int) -> bool:
    """Whether the actions that leap move before or after it: a trigger's stand still."""
    for track, action in table.actions:
        if track.part in actions and actions[track.part][i].any():
            which = actions[track.part][i]
            near = np.abs(action.steps[[i - 2, i - 1, i + 1, i + 2]][:, which]).max(axis=0)
            if (near > 0.002 + action.quantum[which]).any():
                return True
    return False


CHECKS = (
    Check("repeated", "Frames that are there twice", frozenset({Data.STATE}), _repeated),
    Check("missing", "Frames that are missing", frozenset(), _missing),
)

Counts = NDArray[np.intp]
