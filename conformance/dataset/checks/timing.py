"""Action against observation in time, and true time against the stated rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dexkit.conformance.dataset.check import Check, Data, Figure
from dexkit.conformance.dataset.checks.assignment import misassigned
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import (
    Bools,
    frames_of,
    median,
    moves,
    part_text,
    quick_size,
    runs_of_joints,
    series_of,
    speed_of,
    stroke,
)
from dexkit.hand import Floats

__all__ = ["CHECKS", "LAG", "Lag", "lag_of"]

LAG = "lag of the {}, s"
"""Name of the figure of a part, where the lag is sharp."""

_REACH_S = 1.5  # of delays that are tried, both ways
_SURE = 0.7  # correlation from which a delay is believed
_FIRM = 0.8  # from which it is a reason: the other hand's action may be like it by 0.78
_CLEAR = 0.95  # above which no object stops a hand
_STOPS_S = 0.5  # s in which the state of a joint comes to rest after its action
_STANDS = 0.004  # strokes in 0.1 s that a joint moves which an object stops
_STOPPED = 0.1  # strokes that its action moves on, or is away from it
_SHARP = 0.9  # and from which it is compared with that of other episodes
_LATEST_HAND_S = 0.7  # Inspire's hands on a G1 are 0.4 s behind, with values up to 0.13 s old
_LATEST_QUICK_S = (
    0.6  # hands with 200 states a second: 0.15 s; with a slow bridge before them 0.5 s
)
_QUICK_HZ = 150.0
_LATEST_ARM_S = 0.4  # arms that swing are 0.2 s behind
_EARLY_FRAMES = 2.5  # that a state may be before its action: the next state is the action
_APART_S = 0.4  # that one of two equal parts may be later than the other: one may only tremble
_LEAST_SURE = 0.55  # correlation in a third of an episode, in which a drift smears it
_DRIFT_FRAMES = 3.0
_DRIFT_S = 0.09
_DRIFT_ALONE_S = 0.2  # of one part alone
_SMOOTH_S = 0.1
_BETTER = 0.06  # correlation by which a growing lag must exceed a constant one
_FAR_BETTER = 0.12  # likewise, where no part of the episode has a lag of its own
_FAR_S = 2.0  # s of lag at the end that are tried
_FAR_LEAST_S = 5.0  # s of an episode in which this can be told
_ENOUGH = 0.1  # of a joint's motion, that a third of an episode has at least
_NO_UNIT = 2.0  # strokes that no joint moves: it counts in another unit
_RENEWED_S = 0.25  # s in which the slowest registers are renewed
_OFF = 0.05  # of a rate that is not the stated one
_JITTER = 0.5  # periods that stamps are off, at the usual frame


@dataclass(frozen=True)
class Lag:
    """By how much a state is later than its action.

    :param seconds: from the rise of the correlation of their speeds: the time before the part
        begins to follow. A hand that is slow, but follows at once, has a small one.
    :param peak_s: at which the correlation is highest; ``correlation`` is its height.
    """

    seconds: float
    peak_s: float
    correlation: float


def lag_of(state: Floats, action: Floats, fps: float) -> Lag | None:
    """The lag of states behind actions, shape (frames, joints) both, scaled so that joints count
    alike; None where nothing is to be told.
    """
    n = len(state)
    reach = min(round(_REACH_S * fps), n // 3)
    if reach < 4:
        return None
    size = quick_size(n + 2 * reach)
    both = np.fft.rfft(np.concatenate((state.T, action.T)), size)
    s, a = both[: state.shape[1]], both[state.shape[1] :]
    cross, auto = np.fft.irfft(np.stack([np.einsum("ij,ij->j", x, a.conj()) for x in (s, a)]), size)
    power = np.sqrt(auto[0] * float((state**2).sum()))
    if power <= 0:
        return None
    at = np.arange(-reach, reach + 1)
    c = cross[at] / power
    own = auto[at] / auto[0]
    peak = _peak(c, reach)
    if peak is None:
        return None
    top = float(c[peak])
    rise = _rise(c, peak) - _rise(own, reach)
    return Lag(rise / fps, _refined(c, peak, reach) / fps, top)


def _peak(c: Floats, zero: int) -> int | None:
    """The highest correlation; of several that are nearly as high, as with periodic motion, the
    first that a hand can have.
    """
    best = float(c.max())
    if best <= 0:
        return None
    inner = np.flatnonzero((c[1:-1] >= c[:-2]) & (c[1:-1] >= c[2:]) & (c[1:-1] > 0.9 * best)) + 1
    if not len(inner):
        return None
    possible = inner[inner >= zero - 1]
    return int(possible[0]) if len(possible) else int(inner[-1])


def _refined(c: Floats, peak: int, zero: int) -> float:
    a, b, d = float(c[peak - 1]), float(c[peak]), float(c[peak + 1])
    bend = a - 2 * b + d
    return peak - zero + (0.5 * (a - d) / bend if bend < 0 else 0.0)


def _rise(c: Floats, peak: int) -> float:
    """Where the correlation rises through half of its peak, in frames."""
    half = 0.5 * float(c[peak])
    below = np.flatnonzero(c[:peak] < half)
    if not len(below):
        return 0.0
    i = int(below[-1])
    return i + (half - float(c[i])) / max(float(c[i + 1] - c[i]), 1e-12)


@dataclass(frozen=True, eq=False)
class _Speeds:
    """The speeds of the joints of a part that move, smoothed, shape (frames, joints).

    :param use: which joints of the part these are.
    """

    state: Floats
    action: Floats
    use: Bools


def _speeds(episode: Episode, track: Track) -> _Speeds | None:
    state, action = series_of(track, "state"), series_of(track, "action")
    if state is None or action is None or state.q.shape != action.q.shape:
        return None
    use = moves(state, 0.05) & moves(action, 0.05)
    if not use.any():
        return None
    width = max(2, round(_SMOOTH_S * episode.fps))
    # joints count alike, whatever their way
    whole = bool(use.all())
    s, a = (
        _scaled(_smoothed(x.steps if whole else x.steps[:, use], width)) for x in (state, action)
    )
    return _Speeds(s, a, use)


def _scaled(values: Floats) -> Floats:
    """Columns of length 1."""
    size = np.sqrt(np.einsum("ij,ij->j", values, values))
    return np.asarray(values / np.maximum(size, 1e-12))


def _unheld(episode: Episode, track: Track, speeds: _Speeds) -> _Speeds:
    """Without the actions of joints that an object, or an end, stops: the action goes on and
    comes back there while the state stands still, which says nothing of a delay.
    """
    state, action = series_of(track, "state"), series_of(track, "action")
    assert state is not None
    assert action is not None
    begin_s, end_s = frames_of(episode, _STOPS_S), frames_of(episode, _LATEST_HAND_S)
    width = max(2, round(_SMOOTH_S * episode.fps))
    moved = np.abs(_smoothed(state.steps, width))
    still = moved < np.maximum(_STANDS, np.maximum(6 * state.noise, 1.5 * state.quantum))
    kept = speeds.action.copy(order="K")
    columns = np.flatnonzero(speeds.use).tolist()
    for k, begin, end in runs_of_joints(still[:, speeds.use], begin_s):
        # what it does as the state comes to rest, or begins to move, may be a delay
        first = begin + begin_s if begin > 1 else begin
        last = end - end_s if end < len(still) - 1 else end
        inner = action.q[first : last + 1, columns[k]]
        if len(inner) > 1:
            away = np.abs(inner - state.q[(begin + end) // 2, columns[k]])
            if np.ptp(inner) > _STOPPED or away.min() > _STOPPED:
                kept[begin:end, k] = 0
    return _Speeds(speeds.state, kept, speeds.use)


def _smoothed(values: Floats, width: int) -> Floats:
    sums = np.cumsum(values, axis=0)
    sums[width:] -= sums[:-width].copy()
    return np.asarray(sums)


@dataclass(frozen=True)
class _Step:
    """A part that is out of step.

    :param kind: ``early``, ``late`` or ``drift``.
    :param value: its lag, s, or by how much it drifts; ``limit`` is what was allowed.
    :param ends: of a drift, its lags in the first and the last third of the episode, s.
    """

    kind: str
    track: Track
    value: float
    limit: float
    correlation: float
    ends: tuple[float, float] = (0.0, 0.0)


def _out_of_step(episode: Episode) -> Iterator[Finding | Figure]:
    lags: dict[str, tuple[Track, Lag]] = {}
    found: list[_Step] = []
    for track in episode.tracks:
        speeds = _speeds(episode, track)
        if speeds is None:
            continue
        lag = lag_of(speeds.state, speeds.action, episode.fps)
        drift = _drift(episode, track, speeds) if _may_drift(speeds, lag, episode.fps) else None
        if drift is None and (lag is None or lag.correlation < _CLEAR):
            free = _unheld(episode, track, speeds)
            without = lag_of(free.state, free.action, episode.fps)
            if without is not None and (lag is None or without.correlation > lag.correlation):
                speeds, lag = free, without
            drift = _far_drift(episode, track, speeds, lag)
        if drift is not None:
            found.append(drift)
        elif lag is not None and lag.correlation >= _SURE:
            lags[track.part] = track, lag
            step = _absolute(episode, track, lag)
            if step is not None:
                found.append(step)
    # a state beside another part's action has no lag
    found = [s for s in found if not misassigned(episode, s.track.part)]
    drifts = [s for s in found if s.kind == "drift"]
    for step in drifts:
        # one part alone may be held by an object now, and not before
        alike = [s for s in drifts if s.value * step.value > 0]
        if len(alike) < 2 and abs(step.value) < _DRIFT_ALONE_S:
            found.remove(step)
    yield from _told(found)
    if not found:
        yield from _apart(lags)
    hands = [lag.seconds for track, lag in lags.values() if track.is_hand]
    if lags:
        usual = hands or [lag.seconds for _, lag in lags.values()]
        yield Figure("lag, s", median(np.array(usual)))
    for part, (_, lag) in lags.items():
        if lag.correlation > _SHARP:
            yield Figure(LAG.format(part.replace("_", " ")), lag.seconds)


def _told(found: list[_Step]) -> Iterator[Finding]:
    """One finding for each kind, whatever the number of parts."""
    for kind in dict.fromkeys(step.kind for step in found):
        steps = [step for step in found if step.kind == kind]
        worst = max(steps, key=lambda step: abs(step.value))
        what = "the observation of " + " and ".join(part_text(s.track.part) for s in steps)
        match = f"(correlation {worst.correlation:.2f})"
        by = abs(worst.value)
        if kind == "early":
            text = (
                f"{what} is up to {by:.2f} s before its action {match}, as if it knew it: the two "
                "streams are out of step"
            )
        elif kind == "late":
            text = (
                f"{what} is up to {by:.2f} s behind its action {match}, more than any "
                f"{'hand' if worst.track.is_hand else 'arm'}: the two streams are out of step"
            )
        else:
            text = (
                f"{what} drifts against its action, from {worst.ends[0]:.2f} s behind it at the "
                f"begin to {worst.ends[1]:.2f} s at the end"
            )
        yield Finding(
            "out-of-step",
            Use.DROP,
            text,
            worst.track.part if len(steps) == 1 else "",
            value=round(worst.value, 3),
            limit=round(worst.limit, 3),
            unit="s",
        )


def _absolute(episode: Episode, track: Track, lag: Lag) -> _Step | None:
    early = -lag.peak_s * episode.fps
    if lag.correlation < _FIRM:
        return None
    if early > _EARLY_FRAMES and -lag.seconds * episode.fps > 0.5 * _EARLY_FRAMES:
        limit = -_EARLY_FRAMES / episode.fps
        return _Step("early", track, lag.peak_s, limit, lag.correlation)
    latest = _LATEST_HAND_S if track.is_hand else _LATEST_ARM_S
    if track.model is not None and track.model.min_state_rate > _QUICK_HZ:
        latest = _LATEST_QUICK_S
    if lag.seconds > latest:
        return _Step("late", track, lag.seconds, latest, lag.correlation)
    return None


def _apart(lags: dict[str, tuple[Track, Lag]]) -> Iterator[Finding]:
    """Two equal parts of which one is later."""
    for part, (track, lag) in lags.items():
        other = lags.get(part.replace("left", "right")) if part.startswith("left") else None
        if other is None or min(lag.correlation, other[1].correlation) < _SHARP:
            continue
        apart = lag.seconds - other[1].seconds
        if abs(apart) > _APART_S:
            late = track if apart > 0 else other[0]
            yield Finding(
                "out-of-step",
                Use.REVIEW,
                f"the observation of {part_text(late.part)} is {abs(apart):.2f} s later behind its "
                "action than that of the other side",
                late.part,
                value=round(abs(apart), 3),
                limit=_APART_S,
                unit="s",
            )


def _drift(episode: Episode, track: Track, speeds: _Speeds) -> _Step | None:
    """A lag that grows: first against last third."""
    n = len(speeds.state)
    third = n // 3
    if third < 2.5 * episode.fps:
        return None
    found: list[Lag] = []
    for begin in (0, third, n - third):
        s, a = (x[begin : begin + third] for x in (speeds.state, speeds.action))
        if (a**2).sum() < _ENOUGH * a.shape[1]:
            return None
        lag = lag_of(s, a, episode.fps)
        if lag is None or lag.correlation < _LEAST_SURE:
            return None
        found.append(lag)
    by_peak = found[2].peak_s - found[0].peak_s
    by_rise = found[2].seconds - found[0].seconds
    drift = by_peak if abs(by_peak) < abs(by_rise) else by_rise
    limit = max(_DRIFT_FRAMES / episode.fps, _DRIFT_S)
    if by_peak * by_rise <= 0 or abs(drift) < limit:
        return None
    low, high = sorted((found[0].peak_s, found[2].peak_s))
    if not low - 0.04 <= found[1].peak_s <= high + 0.04:
        return None  # it comes and goes: no drift of a clock
    # joints that an object holds leave it late, as their action has to come back first: a lag that
    # grows with time must explain the whole episode better than a constant one
    steady = _match(speeds, np.full(n, found[1].peak_s * episode.fps))
    slope = by_peak * episode.fps * (np.arange(n) - 0.5 * third) / (n - third)
    growing = _match(speeds, found[0].peak_s * episode.fps + slope)
    if growing < _FIRM or growing - steady < _BETTER:
        return None
    return _Step("drift", track, drift, limit, growing, (found[0].peak_s, found[2].peak_s))


def _far_drift(episode: Episode, track: Track, speeds: _Speeds, lag: Lag | None) -> _Step | None:
    """A lag that grows so much that no third of an episode has one of its own: the line that
    explains the whole of it far better than any constant lag. Of hands it is not told: what they
    hold makes them late as well.
    """
    steady = 0.0 if lag is None else lag.correlation
    if track.is_hand or steady > _FIRM - _FAR_BETTER or episode.duration < _FAR_LEAST_S:
        return None
    stride = max(1, round(_SMOOTH_S * episode.fps / 2))
    few = _Speeds(speeds.state[::stride], speeds.action[::stride], speeds.use)
    fps = episode.fps / stride
    time = np.linspace(0.0, 1.0, len(few.state))
    best, first, last = 0.0, 0.0, 0.0
    ends = np.arange(-_FAR_S, _FAR_S + 0.01, 0.1)
    for begin in np.arange(0.0, _LATEST_HAND_S, 0.1).tolist():
        for end in ends[np.abs(ends - begin) > _DRIFT_ALONE_S].tolist():
            match = _match(few, (begin + (end - begin) * time) * fps)
            if match > best:
                best, first, last = match, begin, end
    if best < _FIRM or best - steady < _FAR_BETTER:
        return None
    limit = max(_DRIFT_FRAMES / episode.fps, _DRIFT_S)
    return _Step("drift", track, last - first, limit, best, (first, last))


def _may_drift(speeds: _Speeds, lag: Lag | None, fps: float) -> bool:
    """Whether what a constant lag leaves over goes with time and the change of the action, as a
    small drift makes it; a large one leaves little correlation. Cheaper than to look for it.
    """
    if lag is None or lag.correlation < 0.93:
        return True
    late = round(lag.peak_s * fps)
    n = len(speeds.state) - abs(late)
    state, action = speeds.state[max(late, 0) :][:n], speeds.action[max(-late, 0) :][:n]
    changes = np.zeros_like(action)
    changes[1:-1] = 0.5 * (action[2:] - action[:-2])
    changes *= np.linspace(-0.5, 0.5, n)[:, None]
    power = float((changes**2).sum())
    drift = -float(((state - action) * changes).sum()) / power if power > 0 else 0.0
    return abs(drift) > 0.6 * max(_DRIFT_FRAMES, _DRIFT_S * fps)


def _match(speeds: _Speeds, late: Floats) -> float:
    """The correlation of states with actions that are so many frames late, shape (frames,)."""
    n = len(speeds.state)
    at = np.clip(np.arange(n) - late, 0, n - 1)
    low = np.minimum(at.astype(int), n - 2)
    part = (at - low)[:, None]
    action = speeds.action[low] * (1 - part) + speeds.action[low + 1] * part
    power = float((action**2).sum() * (speeds.state**2).sum())
    return float((action * speeds.state).sum()) / np.sqrt(power) if power > 0 else 0.0


# -- the rate ------------------------------------------------------------------------------------


def _fps(episode: Episode) -> Iterator[Finding]:
    if episode.measured and len(episode) > 8:
        rate = 1 / float(np.median(np.diff(episode.t)))
        if abs(rate / episode.fps - 1) > _OFF:
            yield _other_rate(rate, episode.fps)
            return
    yield from _stamps(episode)
    yield from _speed_limits(episode)
    yield from _velocities(episode)


def _other_rate(rate: float, stated: float) -> Finding:
    return Finding(
        "fps",
        Use.REVIEW,
        f"its times are those of {rate:.3g} frames per second, and {stated:g} are stated: all "
        "speeds are wrong by this where the stated rate is used",
        value=round(rate, 3),
        limit=stated,
        unit="Hz",
    )


def _stamps(episode: Episode) -> Iterator[Finding]:
    stamps = episode.stamps
    if stamps is None or len(stamps) < 8:
        return
    steps = np.diff(stamps)
    if not steps.any():
        yield Finding("fps", Use.REVIEW, "the times of all frames are the same")
        return
    if (steps <= 0).any():
        count = int((steps <= 0).sum())
        at = int(np.argmax(steps <= 0))
        yield Finding(
            "fps",
            Use.REVIEW,
            f"the times of the frames do not ascend at {count} places, first at "
            f"{episode.t[at]:.1f} s",
            begin_s=float(episode.t[at]),
            end_s=float(episode.t[at + 1]),
            value=float(count),
            limit=0.0,
        )
        return
    usual = median(steps)
    if episode.numbers is not None:
        ahead = np.diff(episode.numbers)
        if (ahead > 0).all():
            usual = median(steps / ahead)
    rate = 1 / usual
    if abs(rate / episode.fps - 1) > _OFF:
        yield _other_rate(rate, episode.fps)
        return
    off = np.abs(steps - usual)
    spread = float(np.partition(off, 3 * len(off) // 4)[3 * len(off) // 4]) / usual
    if spread > _JITTER:
        yield Finding(
            "fps",
            Use.REVIEW,
            f"the times between frames vary: a quarter of them is off by {spread:.0%} of a "
            "period or more",
            value=round(spread, 3),
            limit=_JITTER,
            unit="periods",
        )


def _speed_limits(episode: Episode) -> Iterator[Finding]:
    """Hands that are faster than their motors whenever they move."""
    for track in episode.tracks:
        state = series_of(track, "state")
        if state is None or track.fastest is None or len(state.q) < 30:
            continue
        window = frames_of(episode, _RENEWED_S)
        if len(state.q) <= 2 * window:
            continue
        speed = np.abs(state.q[window:] - state.q[:-window]) * (episode.fps / window)
        if (state.spans > _NO_UNIT).any():
            continue
        allowed = track.fastest / stroke(track)
        if not (speed > 3.0 * allowed).any():
            continue
        moving = speed > 0.3 * allowed
        counts = moving.sum(axis=0)
        fast = np.where(moving, speed / allowed, 0)
        often = (fast > 3.0).sum(axis=0) > np.maximum(0.3 * counts, 8)
        if often.sum() * 2 > len(allowed):
            ratio = float(np.median(fast[:, often].max(axis=0)))
            yield Finding(
                "fps",
                Use.REVIEW,
                f"{part_text(track.part)} moves {ratio:.1f} times as fast as its motors can, all "
                f"the time, at the stated {episode.fps:g} frames per second",
                track.part,
                value=round(ratio, 2),
                limit=3.0,
            )


def _velocities(episode: Episode) -> Iterator[Finding]:
    """Velocities against the differences of positions."""
    for track in episode.tracks:
        state = series_of(track, "state")
        dq = speed_of(track)
        if dq is None or state is None or len(state.q) < 30:
            continue
        seen = (state.q[2:] - state.q[:-2]) * (0.5 * episode.fps)
        said = dq[1:-1]
        own, other = (said**2).sum(axis=0), (seen**2).sum(axis=0)
        use = moves(state, 0.1) & (own > 0) & (other > 0)
        if not use.any():
            continue
        product = (seen * said).sum(axis=0)
        match = product[use] / np.sqrt(own[use] * other[use])
        ratio = np.sqrt(other[use] / own[use])
        if float(np.median(match)) < 0.85:
            continue
        times = float(np.median(ratio))
        alike = np.abs(np.log(ratio / times)).max() < np.log(1.3)
        if alike and (1.25 < times < 8 or 0.125 < times < 0.8):
            yield Finding(
                "fps",
                Use.REVIEW,
                f"{part_text(track.part)} moves {times:.2f} times as fast, by its positions and "
                f"the stated {episode.fps:g} frames per second, as its own velocities say "
                f"(correlation {float(np.median(match)):.2f}): rather "
                f"{episode.fps / times:.3g} frames per second",
                track.part,
                value=round(times, 3),
                limit=1.25,
            )


CHECKS = (
    Check(
        "out-of-step",
        "Observation and action out of step",
        frozenset({Data.STATE, Data.ACTION}),
        _out_of_step,
    ),
    Check("fps", "A stated rate that is not the true one", frozenset({Data.STATE}), _fps),
)
