"""Camera streams against the joints: missing, frozen, late.

What a camera saw is compared with how the joints moved in the same time. A camera may see nothing
that moves, an arm may be out of its view, and a still scene may be identical after decoding: so a
stretch counts as frozen only where the same camera answers to such motion elsewhere in the episode
and the picture leaps where the stretch ends, or where its own noise stops.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.dataset.cameras import CameraTrack, tracks_of
from dexkit.conformance.dataset.check import Check, Data, Figure
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import runs_of, stroke
from dexkit.escaping import one_line
from dexkit.hand import Floats

__all__ = ["CHECKS", "Lag", "Motion", "camera_findings", "frozen", "late", "missing", "motion_of"]

Mask = NDArray[np.bool_]

# camera-missing
_SHORT, _SHORT_SHARE = 0.25, 0.02  # s, and share of the episode, that a video may end early
_LONG, _LONG_SHARE = 0.5, 0.05  # by which it may last longer
_LEAST_GAP = 1.0  # s without a picture: encoders leave out some that do not change
_MUCH = 0.2  # share of the episode from which on a policy learns from what is not there
_DARK, _EVEN = 24.0, 6  # grey level of black (16 in a video); levels within one colour

# camera-frozen
_LEAST = 1.0  # s: shorter ones are dropped pictures, which policies are trained with anyway
_POP = 2.5  # levels on average, by which a key frame may show the same picture differently
_REFRESH = 0.5  # s in which a codec shows a sensor's noise at least once
_STEP = 0.25  # s of a window in which joints and picture are compared
_STILL = 3  # grey levels of a block, that coding alone changes in a picture that is the same
_ANSWER = 6  # levels by which a block changes where something moves in it
_DEAD = 0.01  # of a joint's stroke, which noise of the encoder may be
_MOVES = 0.02  # strokes, all joints together, in a window in which something moves
_LEAST_MOTION = 0.15  # strokes within a frozen stretch; less may be out of sight
_ANSWERS = 0.9  # share of comparable windows elsewhere in which the picture answers
_LEAST_COMPARABLE = 6  # of such windows: 1.5 s
_LEAST_SEEN = 4  # windows of a stretch, each with such company elsewhere
_LEAST_LEAP = 0.3  # levels on average: a block in a hundred changes by 30
_LEAST_RESTS = 8  # pictures to compare with
_LEAP = 1.5  # times the step after it, by which a frozen picture leaps when it goes on
_NOISE = 0.05  # share of pixels that noise changes from picture to picture

# camera-late
_LATEST = 2.0  # s that are looked at
_LATENCY = 0.3  # s that a camera and its network may take
_CLEAR, _CLEARER = 0.6, 0.12  # correlation of a clear peak, and how much better than elsewhere
_LEAST_LENGTH = 6.0  # s of an episode; in a shorter one anything may correlate
_DRIFT = 0.25  # s between start and end


@dataclass(frozen=True, eq=False)
class Motion:
    """How the parts of a robot move.

    :param t: of the frames, s, shape (frames,).
    :param positions: of every joint that moves at all, in strokes, shape (frames, joints).
    :param part: of each joint, the index of its part, shape (joints,).
    :param parts: their names.
    """

    t: Floats
    positions: Floats
    part: NDArray[np.intp]
    parts: tuple[str, ...]

    @cached_property
    def speed(self) -> Floats:
        """Strokes a second, all joints of each part together, shape (frames, parts)."""
        found = np.zeros((len(self.t), len(self.parts)))
        if len(self.t) > 1 and self.positions.shape[1]:
            smooth = _smooth(self.positions, max(1, round(0.1 / self._period)))
            speeds = np.abs(np.gradient(smooth, self.t, axis=0))
            for i in range(len(self.parts)):
                found[:, i] = speeds[:, self.part == i].sum(axis=1)
        return found

    @property
    def _period(self) -> float:
        return float(np.median(np.diff(self.t)))

    def travel(self, begin: Floats, end: Floats) -> Floats:
        """How far each part gets between two times, in strokes, shape (times, parts).

        What noise of an encoder may be does not count.
        """
        found = np.zeros((len(begin), len(self.parts)))
        if not self.positions.shape[1]:
            return found
        a, b = (np.clip(np.searchsorted(self.t, x), 0, len(self.t) - 1) for x in (begin, end))
        way = np.maximum(np.abs(self.positions[b] - self.positions[a]) - _DEAD, 0.0)
        for i in range(len(self.parts)):
            found[:, i] = way[:, self.part == i].sum(axis=1)
        return found


@lru_cache(maxsize=1)
def motion_of(episode: Episode) -> Motion:
    """What moves in an episode: what was observed, or else commanded."""
    columns, parts = [], []
    for number, track in enumerate(episode.tracks):
        values = _positions(track)
        if values is not None:
            columns.append(values)
            parts += [number] * values.shape[1]
    shape = (len(episode), 0)
    positions = np.concatenate(columns, axis=1) if columns else np.zeros(shape)
    names = tuple(track.part for track in episode.tracks)
    return Motion(episode.t, positions, np.array(parts, np.intp), names)


def _positions(track: Track) -> Floats | None:
    """Positions in strokes, without gaps; None where the part has none."""
    values = track.state if track.state is not None else track.action
    if values is None or not len(values):
        return None
    values = values / stroke(track)
    finite = np.isfinite(values)
    if not finite.all():
        # the newest that is known
        rows = np.where(finite, np.arange(len(values))[:, None], 0)
        values = np.nan_to_num(np.take_along_axis(values, np.maximum.accumulate(rows), axis=0))
    return np.asarray(values)


def _smooth(values: Floats, width: int) -> Floats:
    """Means over ``width`` rows around each."""
    if width < 2:
        return values
    padded = np.concatenate([values[:1].repeat(width // 2, 0), values])
    padded = np.concatenate([padded, values[-1:].repeat(width - 1 - width // 2, 0)])
    sums = np.cumsum(np.concatenate([np.zeros_like(padded[:1]), padded]), axis=0)
    return np.asarray((sums[width:] - sums[:-width]) / width)


def _part(track: CameraTrack) -> str:
    return f"camera {one_line(track.name, 64)}"


def _serious(seconds: float, episode: Motion, least: float = 2.0) -> Use:
    """What a stretch of an episode means: dropped from some seconds or a fifth of it on."""
    whole = float(episode.t[-1]) if len(episode.t) else 0.0
    return Use.DROP if seconds >= least or seconds >= _MUCH * whole else Use.REVIEW


# -- missing
# ------------------------------------------------------------------------------------


def missing(track: CameraTrack, motion: Motion, fps: float) -> Iterator[Finding]:
    """No pictures, too few of them, or pictures that show nothing."""
    name, part = "camera-missing", _part(track)
    if not len(track):
        why = track.trouble or "it has no picture in this episode"
        yield Finding(name, Use.DROP, f"there are no pictures: {why}", part)
        return
    frames, period = track.expected, 1.0 / fps
    whole = frames * period
    own = float(np.median(np.diff(track.t))) if len(track) > 1 else period
    ended = float(track.t[-1]) + max(own, period)
    end = float(motion.t[-1]) + period
    if (wrong := _other_rate(track, fps)) is not None:
        yield Finding("camera-late", Use.REVIEW, wrong, part, value=track.length, unit="s")
    elif end - ended > max(_SHORT, _SHORT_SHARE * whole):
        text = (
            f"its pictures end {end - ended:.2f} s before the joints, at {ended:.2f} of "
            f"{end:.2f} s ({len(track)} pictures for {frames} frames)"
        )
        if track.trouble:
            text += f"; {track.trouble}"
        use = _serious(end - ended, motion, 0.5)
        yield Finding(name, use, text, part, (), ended, end, len(track), frames, "pictures")
    elif track.length is not None and track.length - whole > max(_LONG, _LONG_SHARE * whole):
        text = (
            f"its video lasts {track.length:.2f} s and the episode {whole:.2f} s: pictures and "
            "joints do not belong together frame by frame"
        )
        yield Finding("camera-late", Use.REVIEW, text, part, value=track.length, unit="s")
    elif track.trouble:
        use = Use.DROP if len(track) < (1 - _MUCH) * frames else Use.REVIEW
        yield Finding(name, use, track.trouble, part)
    begins = np.concatenate([[0.0], track.t + max(own, period)])
    ends = np.concatenate([track.t, [track.t[-1]]])
    if (gaps := ends - begins).max() > _LEAST_GAP:
        lost, at = float(gaps[gaps > _LEAST_GAP].sum()), int(np.argmax(gaps))
        text = (
            f"it has no picture from {begins[at]:.2f} to {ends[at]:.2f} s, while the joints go on"
        )
        use = _serious(lost, motion)
        yield Finding(name, use, text, part, (), float(begins[at]), float(ends[at]))
    yield from _blank(track, motion)


def _other_rate(track: CameraTrack, fps: float) -> str | None:
    """What is wrong where a video has a picture for each frame, and lasts another time."""
    length, whole = track.length, track.expected / fps
    total = track.total if track.total is not None else len(track)
    if length is None or not length or abs(total - track.expected) > 2 or track.expected < 30:
        return None
    if 0.95 < length / whole < 1.05:
        return None
    return (
        f"its video has a picture for each frame and lasts {length:.2f} s, which is "
        f"{total / length:.3g} pictures a second; by the rate that the set states, {fps:.3g}, it "
        f"would be {whole:.2f} s: one of the rates is wrong"
    )


def _blank(track: CameraTrack, motion: Motion) -> Iterator[Finding]:
    """Pictures of one colour: a cap on the lens, a camera without light, a broken stream."""
    flat = track.thumbs.reshape(len(track), -1)
    high, low = flat.max(axis=1).astype(int), flat.min(axis=1).astype(int)
    even = high - low <= _EVEN
    black = even & (high <= _DARK)
    name, part = "camera-missing", _part(track)
    if even.all():
        colour = "black" if black.all() else "of one even colour"
        yield Finding(name, Use.DROP, f"all of its pictures are {colour}", part)
        return
    period = float(np.median(np.diff(track.t))) if len(track) > 1 else 0.0
    for begin, end in runs_of(even):
        seconds = float(track.t[end - 1] - track.t[begin]) + period
        if seconds < _LEAST:
            continue
        colour = "black" if black[begin:end].all() else "of one even colour"
        first, last = float(track.t[begin]), float(track.t[end - 1]) + period
        text = f"its pictures are {colour} from {first:.2f} to {last:.2f} s"
        yield Finding(name, _serious(seconds, motion), text, part, (), first, last)
        return


# -- frozen
# ------------------------------------------------------------------------------------


def frozen(track: CameraTrack, motion: Motion, late_by: float = 0.0) -> Iterator[Finding]:
    """A picture that stands still, while the joints move as they do where it does not.

    :param track: with the times of what is seen, ``late_by`` seconds before its pictures.
    """
    if len(track) < 4 or len(motion.t) < 4:
        return
    runs = _still_runs(track)
    for begin, end in runs:
        if end - begin >= len(track) - 2:
            yield from _always_still(track, motion)
            return
    found = [(b, e) for b, e in runs if _is_frozen(track, motion, b, e, runs)]
    if not found:
        return
    spans = [(float(track.t[b]) + late_by, float(track.t[e - 1]) + late_by) for b, e in found]
    total = sum(b - a for a, b in spans)
    first, last = max(spans, key=lambda s: s[1] - s[0])
    busiest = int(np.argmax(_path(motion, first - late_by, last - late_by)))
    more = f", and {len(spans) - 1} more times" if len(spans) > 1 else ""
    text = (
        f"its picture stands still from {first:.2f} to {last:.2f} s{more}, while "
        f"{motion.parts[busiest].replace('_', ' ')} moves: the stream froze"
    )
    use = _serious(total, motion)
    yield Finding("camera-frozen", use, text, _part(track), (), first, last, total, _LEAST, "s")


def _path(motion: Motion, begin: float, end: float) -> Floats:
    """How far each part goes, there and back, in strokes, shape (parts,)."""
    at: Floats = np.arange(begin, max(end, begin + _STEP), _STEP, dtype=np.float64)
    return np.asarray(motion.travel(at, at + _STEP).sum(axis=0))


def _always_still(track: CameraTrack, motion: Motion) -> Iterator[Finding]:
    """The same picture throughout: a remark; it may be a camera that sees nothing that moves."""
    if (track.digests != track.digests[0]).any():
        return
    if _path(motion, 0.0, float(motion.t[-1])).sum() < _LEAST_MOTION:
        return
    text = (
        "all of its pictures are the same one: it froze before the start, or it sees nothing "
        "that moves"
    )
    yield Finding("camera-frozen", Use.KEEP, text, _part(track))


def _still_runs(track: CameraTrack) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of stretches of the same picture, but for what coding changes."""
    flat = track.thumbs.reshape(len(track), -1).astype(np.int16)
    steps = np.abs(np.diff(flat, axis=0))
    # pictures of one colour are missing ones
    still = (steps.max(axis=1) <= _STILL) & (np.ptp(flat, axis=1)[1:] > _EVEN)
    small = steps.mean(axis=1) <= _POP
    # a key frame, and the two that follow, show the same picture a little differently
    for begin, end in list(runs_of(~still)):
        if begin >= 2 and end <= len(still) - 2 and end - begin <= 3 and small[begin:end].all():
            still[begin:end] = still[begin - 2 : begin].all() and still[end : end + 2].all()
    found: list[tuple[int, int]] = []
    for begin, end in runs_of(still):
        last = end + 1
        if track.t[last - 1] - track.t[begin] < _LEAST:
            continue
        at = begin
        while at < last:
            # the longest stretch around this picture in which none differs from it
            same = np.abs(flat[begin:last] - flat[at]).mean(axis=1) <= _POP
            low, high = next((b, e) for b, e in runs_of(same) if b <= at - begin < e)
            low, high = begin + low, begin + high
            if track.t[high - 1] - track.t[low] < _LEAST:
                at += max(1, (high - low) // 2)
                continue
            if not found or low >= found[-1][1]:
                found.append((low, high))
            at = high
    return found


def _is_frozen(
    track: CameraTrack, motion: Motion, begin: int, end: int, runs: Sequence[tuple[int, int]]
) -> bool:
    first, last = float(track.t[begin]), float(track.t[end - 1])
    if _path(motion, first, last).sum() < _LEAST_MOTION:
        return False
    if _noise_stops(track, motion, begin, end):
        return True
    leap = _leap(track, end)
    if leap is not None and _is_unexplained(track, motion, leap, runs):
        return True
    if not _would_answer(track, motion, begin, end):
        return False
    if end < len(track):
        return leap is not None
    return begin == 0 or _stops_short(track, begin)


def _noise_stops(track: CameraTrack, motion: Motion, begin: int, end: int) -> bool:
    """Whether a sensor's noise, which changes pictures even where nothing moves, is gone."""
    period = float(np.median(np.diff(track.t)))
    width = max(2, round(_REFRESH / period))
    if len(track) < 4 * width or np.mean(track.altered[begin + 1 : end] > 0) > 0.1:
        return False
    # the codec may leave noise out of most pictures, and has it in some of each half second
    alive = sliding_window_view(track.altered[1:], width).max(axis=1)
    starts, ends = track.t[: len(alive)], track.t[width : width + len(alive)]
    rests = motion.travel(starts, ends).sum(axis=1) < _MOVES / 2
    elsewhere = (np.arange(len(alive)) + width < begin) | (np.arange(len(alive)) >= end)
    rests &= elsewhere
    return int(rests.sum()) >= _LEAST_RESTS and bool(np.quantile(alive[rests], 0.05) > _NOISE)


def _would_answer(track: CameraTrack, motion: Motion, begin: int, end: int) -> bool:
    """Whether the picture answers elsewhere to less motion of the same parts than here."""
    first, last = float(track.t[begin]), float(track.t[end - 1])
    at: Floats = np.arange(0.0, float(motion.t[-1]) - _STEP, _STEP / 2, dtype=np.float64)
    if not len(at):
        return False
    moved = motion.travel(at, at + _STEP)
    total = moved.sum(axis=1)
    a, b = (np.clip(np.searchsorted(track.t, x), 0, len(track) - 1) for x in (at, at + _STEP))
    difference = np.abs(track.thumbs[b].astype(np.int16) - track.thumbs[a]).reshape(len(at), -1)
    answers = difference.max(axis=1) >= _ANSWER
    here = (at >= first) & (at + _STEP <= last) & (total > _MOVES)
    outside = ((at + _STEP < first) | (at > last)) & (total > _MOVES)
    if not here.any() or answers[here].mean() > 1 - _ANSWERS:
        return False
    seen = 0
    for window in np.flatnonzero(here).tolist():
        # no part moves more there than here, and all together not much less
        comparable = (
            outside
            & (moved <= 1.5 * moved[window] + _MOVES / 4).all(axis=1)
            & (total >= 0.3 * total[window])
        )
        if comparable.sum() >= _LEAST_COMPARABLE:
            seen += bool(answers[comparable].mean() >= _ANSWERS)
    return seen >= _LEAST_SEEN


def _steps(track: CameraTrack) -> Floats:
    """By how much each picture differs from the one before, in blocks, shape (pictures,)."""
    thumbs = track.thumbs.astype(np.int16)
    found: Floats = np.zeros(len(track))
    found[1:] = np.abs(np.diff(thumbs, axis=0)).mean(axis=(1, 2))
    return found


def _leap(track: CameraTrack, end: int) -> int | None:
    """The picture that is far from a still stretch before it, further than the next ones from each
    other: the stream goes on elsewhere. None where the picture begins to move as anything does.
    """
    steps = _steps(track)
    if end >= len(track):
        return None
    # coding may change the still picture once more before
    at = end + int(np.argmax(steps[end : end + 4]))
    after = steps[at + 1 : at + 7]
    far = steps[at] >= _LEAST_LEAP and steps[at] > _LEAP * after.max(initial=0.0)
    return at if far else None


def _is_unexplained(
    track: CameraTrack, motion: Motion, at: int, runs: Sequence[tuple[int, int]]
) -> bool:
    """Whether a picture is further from the one before than any other one where the joints are no
    faster, and that is coded alike.
    """
    steps = _steps(track)
    before = np.concatenate([track.t[:1], track.t[:-1]])
    way = np.interp((track.t + before) / 2, motion.t, motion.speed.sum(axis=1))
    way *= track.t - before
    others = np.ones(len(track), bool)
    others[[0, at]] = False
    others &= way <= 1.5 * way[at] + 1e-3
    alike = others & (track.keys == track.keys[at])
    if alike.sum() >= _LEAST_RESTS:
        others = alike
    # the stream may have frozen before
    ends = [steps[e : e + 4].max() for _, e in runs if e < len(track) and not e <= at < e + 4]
    again = sum(1 for step in ends if step > 0.5 * steps[at])
    highest = np.sort(steps[others])[: -again or None] if again <= 3 else steps[others]
    return len(highest) >= _LEAST_RESTS and bool(steps[at] > _LEAP * highest.max())


def _stops_short(track: CameraTrack, begin: int) -> bool:
    """Whether what moves in the picture is gone from one picture to the next."""
    before = track.changes[max(1, begin - 3) : begin + 1]
    usual = track.changes[max(1, begin - 30) : max(2, begin - 3)]
    return bool(np.median(before) > 0.6 * np.median(usual)) if len(usual) >= 5 else False


# -- late
# ------------------------------------------------------------------------------------


def late(track: CameraTrack, found: Lag | None) -> Iterator[Finding | Figure]:
    """Motion in the picture that is not at the time of the joints' motion, or drifts from it."""
    if found is None:
        return
    part = _part(track)
    if found.clear:
        yield Figure(f"lag of {part}, s", found.lag)
    if found.drifts:
        text = (
            f"it drifts against the joints: its picture is {_by(found.begin)} at the start and "
            f"{_by(found.end)} at the end"
        )
        drift = abs(found.end - found.begin)
        yield Finding("camera-late", Use.REVIEW, text, part, value=drift, limit=_DRIFT, unit="s")
    elif found.clear and not -_LATENCY / 2 <= found.lag <= _LATENCY:
        text = f"its picture is {_by(found.lag)}, from start to end"
        yield Finding(
            "camera-late", Use.REVIEW, text, part, value=found.lag, limit=_LATENCY, unit="s"
        )


def _by(lag: float) -> str:
    """A lag in words."""
    if abs(lag) < 0.05:
        return "in step with the joints"
    return f"{abs(lag):.2f} s {'behind' if lag > 0 else 'ahead of'} the joints"


@dataclass(frozen=True)
class Lag:
    """By how much a picture is behind the joints, s, at the start and at the end.

    :param clear: whether the constant lag is certain; ``drifts`` whether its drift is.
    """

    lag: float
    begin: float
    end: float
    clear: bool
    drifts: bool

    @classmethod
    def of(cls, track: CameraTrack, motion: Motion) -> Lag | None:
        """None where there is too little to tell it by."""
        if len(track) < 30 or len(motion.t) < 30:
            return None
        end = min(float(track.t[-1]), float(motion.t[-1]))
        if end < _LEAST_LENGTH:
            return None
        step = 1 / 30
        grid = np.arange(0.0, end, step)
        width = 5  # frames of 30 Hz: joints and picture are smoothed alike
        middle = (track.t[1:] + track.t[:-1]) / 2
        seen = _smooth(np.sqrt(np.interp(grid, middle, track.changes[1:]))[:, None], width)[:, 0]
        speeds = motion.speed
        signals = [speeds.sum(axis=1), *(s for s in speeds.T if s.any())]
        best: tuple[float, Floats] | None = None
        lags = np.arange(-round(_LATEST / step), round(_LATEST / step) + 1)
        for signal in signals:
            moved = _smooth(np.sqrt(np.interp(grid, motion.t, signal))[:, None], width)[:, 0]
            curve = _correlations(seen, moved, lags)
            if best is None or curve.max() > best[0] + 0.02:
                best = float(curve.max()), moved
        assert best is not None
        return _judge_lag(seen, best[1], lags, step)


def _judge_lag(seen: Floats, moved: Floats, lags: NDArray[np.int_], step: float) -> Lag:
    curve = _correlations(seen, moved, lags)
    at, clear = _peak(curve, lags, step)
    half = len(seen) // 2
    halves = [_correlations(seen[s], moved[s], lags) for s in (slice(half), slice(half, None))]
    (a, a_clear), (b, b_clear) = (_peak(c, lags, step) for c in halves)
    slope = (b - a) * 2  # between the middles of the halves lies half of the episode
    begin, end = (a + b - slope) / 2, (a + b + slope) / 2
    agree = a_clear and b_clear and abs(b - a) <= 0.12
    drifts = a_clear and b_clear and abs(slope) > _DRIFT and abs(b - a) > 0.12
    if drifts:
        # a picture that is put right by the drift fits clearly better than by one lag
        times = np.arange(len(seen)) * step
        put_right = np.interp(times + begin + slope * times / max(times[-1], step), times, seen)
        better = float(np.corrcoef(put_right, moved)[0, 1])
        drifts = better > curve.max() + 0.05
    return Lag(at, begin, end, clear and agree, drifts)


def _correlations(seen: Floats, moved: Floats, lags: NDArray[np.int_]) -> Floats:
    """Correlation of the picture, put earlier by each lag, with the joints; shape (lags,)."""
    found = np.zeros(len(lags))
    n = len(seen)
    for i, lag in enumerate(lags.tolist()):
        a, b = seen[max(0, lag) : n + min(0, lag)], moved[max(0, -lag) : n - max(0, lag)]
        if len(a) < n // 2:
            continue
        a, b = a - a.mean(), b - b.mean()
        power = float(a @ a) * float(b @ b)
        found[i] = float(a @ b) / power**0.5 if power > 0 else 0.0
    return found


def _peak(curve: Floats, lags: NDArray[np.int_], step: float) -> tuple[float, bool]:
    """The lag of the highest correlation, s, and whether it stands out."""
    top = int(np.argmax(curve))
    far = np.abs(lags - lags[top]) * step > 0.4
    inside = 0 < top < len(curve) - 1
    clear = curve[top] >= _CLEAR and curve[top] - curve[far].max(initial=-1.0) >= _CLEARER
    return float(lags[top] * step), bool(clear and inside)


# -- of an episode
# ------------------------------------------------------------------------------------


def _missing(episode: Episode) -> Iterator[Finding]:
    tracks, motion = tracks_of(episode), motion_of(episode)
    found = [f for track in tracks for f in missing(track, motion, episode.fps)]
    yield from _merged(found, len(tracks))


def _frozen(episode: Episode) -> Iterator[Finding]:
    motion = motion_of(episode)
    for track, lag in zip(tracks_of(episode), _lags_of(episode), strict=True):
        # what a late picture does not show yet has not frozen
        late_by = lag.lag if lag is not None and lag.clear else 0.0
        yield from frozen(replace(track, t=track.t - late_by), motion, late_by)


@lru_cache(maxsize=1)
def _lags_of(episode: Episode) -> tuple[Lag | None, ...]:
    motion = motion_of(episode)
    return tuple(Lag.of(track, motion) for track in tracks_of(episode))


def _late(episode: Episode) -> Iterator[Finding | Figure]:
    found: list[Finding] = []
    tracks = tracks_of(episode)
    for track, lag in zip(tracks, _lags_of(episode), strict=True):
        for each in late(track, lag):
            if isinstance(each, Figure):
                yield each
            else:
                found.append(each)
    yield from _merged(found, len(tracks))


def _merged(findings: Sequence[Finding], cameras: int) -> Iterator[Finding]:
    """One finding where all cameras have the same."""
    same = {(f.check, f.use) for f in findings}
    parts = {f.part for f in findings}
    if len(findings) < 2 or len(same) > 1 or len(parts) < cameras or len(findings) > cameras:
        yield from findings
        return
    first = findings[0]
    text = f"all {cameras} cameras: {first.text}" + (
        " (the first of them)" if len({f.text for f in findings}) > 1 else ""
    )
    yield Finding(
        first.check,
        first.use,
        text,
        "",
        (),
        first.begin_s,
        first.end_s,
        first.value,
        first.limit,
        first.unit,
    )


def camera_findings(episode: Episode) -> Iterator[Finding]:
    """What is wrong with the cameras of an episode."""
    for check in CHECKS:
        yield from (f for f in check.run(episode) if isinstance(f, Finding))


CHECKS = (
    Check("camera-missing", "Cameras without pictures", frozenset({Data.CAMERA}), _missing),
    Check("camera-frozen", "Frozen cameras", frozenset({Data.CAMERA}), _frozen),
    Check("camera-late", "Cameras out of step", frozenset({Data.CAMERA}), _late),
)
