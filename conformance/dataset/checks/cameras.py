"""Camera streams against the joints: missing, frozen, late.

What a camera saw is compared with how the joints moved in the same time. A camera may see nothing
that moves, an arm may be out of its view, and a still scene may be identical after decoding: so a
stretch counts as frozen only where the camera's own noise stops, or where the same camera answers
to such motion elsewhere in the episode and the picture leaps where the stretch ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from msgspec import structs
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dexkit.conformance.dataset.camera_lag import DRIFT, LATENCY, Lag, Motion, motion_of
from dexkit.conformance.dataset.cameras import CameraTrack, tracks_of
from dexkit.conformance.dataset.check import Check, Data, Figure
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.motion import runs_of
from dexkit.escaping import one_line
from dexkit.hand import Floats

__all__ = ["CHECKS", "frozen", "late", "missing"]

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
_MOVES = 0.02  # strokes, all joints together, in a window in which something moves
_LEAST_EQUAL = 0.4  # share of a frozen stretch's pictures that are equal to the one before
_LEAST_MOTION = 0.15  # strokes within a frozen stretch; less may be out of sight
_ANSWERS = 0.85  # share of comparable windows elsewhere in which the picture answers
_MOST_CODING = 20  # levels by which coding changes a block of a frozen picture
_LEAST_WINDOWS = 16  # with motion: 2 s
_SHOWN = 15  # levels by which a block differs where something is in it
_LEAST_COMPARABLE = 6  # of such windows: 1.5 s
_LEAST_SEEN = 4  # windows of a stretch, each with such company elsewhere
_LEAST_LEAP = 0.3  # levels on average: a block in a hundred changes by 30
_ALL_NOISE = 0.3  # share of pixels that change in every picture, also where little moves
_LEAST_REST = 1.0  # s at rest, to know the noise by
_SHOW_NOISE = 0.3  # of the pictures, at least, that do: those that differ by a key frame are fewer
_GONE = 0.1  # of the noise: a sensor's does not change so much within an episode
_FAR = 1.8  # times the largest step after it, by which a frozen picture leaps when it goes on
_NOISE = 0.05  # share of pixels that noise changes from picture to picture


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


def frozen(track: CameraTrack, motion: Motion, late_by: Floats | None = None) -> Iterator[Finding]:
    """A picture that stands still, while the joints move as they do where it does not.

    :param track: with the times of what is seen, ``late_by`` seconds before its pictures, shape
        (pictures,).
    """
    if len(track) < 4 or len(motion.t) < 4:
        return
    if (track.digests == track.digests[0]).all():
        yield from _always_still(track, motion)
        return
    found = [(b, e) for b, e in _still_runs(track) if _is_frozen(track, motion, b, e)]
    if not found:
        return
    seen_at = track.t if late_by is None else track.t + late_by
    begin, end = max(found, key=lambda run: track.t[run[1] - 1] - track.t[run[0]])
    spans = [_same(track, b, e) for b, e in found]
    total = float(sum(seen_at[e - 1] - seen_at[b] for b, e in spans))
    busiest = int(np.argmax(_path(motion, float(track.t[begin]), float(track.t[end - 1]))))
    begin, end = max(spans, key=lambda run: seen_at[run[1] - 1] - seen_at[run[0]])
    first, last = float(seen_at[begin]), float(seen_at[end - 1])
    more = f", and {len(spans) - 1} more times" if len(spans) > 1 else ""
    text = (
        f"its picture stands still from {first:.2f} to {last:.2f} s{more}, while "
        f"{motion.parts[busiest].replace('_', ' ')} moves: the stream froze"
    )
    use = _serious(total, motion)
    yield Finding("camera-frozen", use, text, _part(track), (), first, last, total, _LEAST, "s")


def _same(track: CameraTrack, begin: int, end: int) -> tuple[int, int]:
    """A still stretch from the first to the last pictures of it that are equal, if any are."""
    equal = track.altered[begin + 1 : end] == 0
    runs = list(runs_of(equal, 4))
    return (begin + runs[0][0], begin + runs[-1][1] + 1) if runs else (begin, end)


def _path(motion: Motion, begin: float, end: float) -> Floats:
    """How far each part goes, there and back, in strokes, shape (parts,)."""
    at: Floats = np.arange(begin, max(end, begin + _STEP), _STEP, dtype=np.float64)
    return np.asarray(motion.travel(at, at + _STEP).sum(axis=0))


def _always_still(track: CameraTrack, motion: Motion) -> Iterator[Finding]:
    """The same picture throughout: a remark; it may be a camera that sees nothing that moves."""
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


def _is_frozen(track: CameraTrack, motion: Motion, begin: int, end: int) -> bool:
    first, last = float(track.t[begin]), float(track.t[end - 1])
    if _path(motion, first, last).sum() < _LEAST_MOTION:
        return False
    if not _are_equal(track, begin, end):
        return False  # a live picture of a still scene
    if _noise_stops(track, motion, begin, end):
        return True
    # what moves may leave the view; then the picture shows it no more
    ends = track.t[-1] - track.t[end - 1] < _REFRESH
    goes_on = _shows_something(track, begin, end) if ends else _leaps(track, end)
    return goes_on and _would_answer(track, motion, begin, end)


def _are_equal(track: CameraTrack, begin: int, end: int) -> bool:
    """Whether the pictures of a still stretch are the same one, to the last bit."""
    equal = track.altered[begin + 1 : end] == 0
    longest = max(runs_of(equal), key=lambda run: run[1] - run[0], default=(0, 0))
    seconds = track.t[begin + longest[1]] - track.t[begin + longest[0]]
    return bool(equal.mean() >= _LEAST_EQUAL or seconds >= _LEAST)


def _noise_stops(track: CameraTrack, motion: Motion, begin: int, end: int) -> bool:
    """Whether a sensor's noise, which changes pictures even where nothing moves, is gone."""
    period = float(np.median(np.diff(track.t)))
    width = max(2, round(_REFRESH / period))
    if end - begin <= width or len(track) < 4 * width:
        return False
    # a key frame changes a frozen picture too, and a codec leaves noise out of many pictures
    altered = sliding_window_view(track.altered[1:], width)
    at = round((1 - _SHOW_NOISE) * (width - 1))
    alive = np.partition(altered, at, axis=1)[:, at]
    first = np.arange(len(alive))
    moved = motion.travel(track.t[first], track.t[first + width])
    within = (first >= begin) & (first + width < end)
    # without any noise where it is not: a codec may need a while to show a still picture so
    low, high = _longest(within & (alive <= _GONE * alive.max()))
    if high == low:
        return False
    outside = (first + width < low) | (first >= high - 1 + width)
    # what moves changes pictures too: more of their pixels than noise does, if it is in view
    rests = outside & (moved.sum(axis=1) < _MOVES / 2)
    calm = outside & (moved <= 1.5 * moved[low:high].max(axis=0) + _MOVES / 4).all(axis=1)
    noise = 0.0
    for where, least in ((rests, _NOISE), (calm, _ALL_NOISE)):
        if where.sum() * period >= _LEAST_REST:
            lowest, usual = np.quantile(alive[where], [0.02, 0.25]).tolist()
            # the lowest may be of the time in which a codec showed the still picture better
            if usual > least and lowest > 2 * _GONE * usual:
                noise = max(noise, usual)
    low, high = _longest(within & (alive <= _GONE * noise))
    if high == low or not noise:
        return False
    since, until = float(track.t[low + width - at]), float(track.t[high - 1 + at])
    return until - since >= _LEAST and _path(motion, since, until).sum() >= _LEAST_MOTION


def _longest(mask: Mask) -> tuple[int, int]:
    """Begin and end (exclusive) of the longest run."""
    return max(runs_of(mask), key=lambda run: run[1] - run[0], default=(0, 0))


def _windows(track: CameraTrack, motion: Motion) -> tuple[Floats, Floats, Floats]:
    """Begins of short windows, s, how far each part gets in them, shape (windows, parts), and by
    how much the block that changes most does.
    """
    at: Floats = np.arange(0.0, float(motion.t[-1]) - _STEP, _STEP / 2, dtype=np.float64)
    moved = motion.travel(at, at + _STEP)
    a, b = (np.clip(np.searchsorted(track.t, x), 0, len(track) - 1) for x in (at, at + _STEP))
    difference = np.abs(track.thumbs[b].astype(np.int16) - track.thumbs[a])
    return at, moved, difference.max(axis=(1, 2)).astype(np.float64)


def _would_answer(track: CameraTrack, motion: Motion, begin: int, end: int) -> bool:
    """Whether the picture answers elsewhere to less motion of the same parts than here."""
    first, last = float(track.t[begin]), float(track.t[end - 1])
    at, moved, changed = _windows(track, motion)
    total = moved.sum(axis=1)
    here = (at >= first) & (at + _STEP <= last) & (total > _MOVES)
    outside = ((at + _STEP < first) | (at > last)) & (total > _MOVES)
    coding = float(np.quantile(changed[here], 0.9)) if here.any() else np.inf
    if coding > _MOST_CODING:
        return False
    answers = changed >= max(_ANSWER, 2 * coding)
    shares = []
    for window in np.flatnonzero(here).tolist():
        # no part moves more there than here, and all together not much less
        comparable = (
            outside
            & (moved <= 1.5 * moved[window] + _MOVES / 4).all(axis=1)
            & (total >= 0.3 * total[window])
        )
        if comparable.sum() >= _LEAST_COMPARABLE:
            shares.append(float(answers[comparable].mean()))
    return len(shares) >= _LEAST_SEEN and float(np.mean(shares)) >= _ANSWERS


def _steps(track: CameraTrack) -> Floats:
    """By how much each picture differs from the one before, in blocks, shape (pictures,)."""
    thumbs = track.thumbs.astype(np.int16)
    found: Floats = np.zeros(len(track))
    found[1:] = np.abs(np.diff(thumbs, axis=0)).mean(axis=(1, 2))
    return found


def _leaps(track: CameraTrack, end: int) -> bool:
    """Whether a still stretch ends with a picture that is far from it, much further than the next
    ones are from each other: the stream goes on elsewhere, and does not begin to move.
    """
    steps = _steps(track)
    if end >= len(track):
        return False
    # coding may change the still picture once more before
    at = end + int(np.argmax(steps[end : end + 4]))
    after = steps[at + 1 : at + 7]
    return bool(len(after) >= 3 and steps[at] >= max(_LEAST_LEAP, _FAR * after.max()))


def _shows_something(track: CameraTrack, begin: int, end: int) -> bool:
    """Whether a still picture has something in it that is elsewhere at other times."""
    away = np.abs(track.t - track.t[(begin + end) // 2])
    away -= (track.t[end - 1] - track.t[begin]) / 2
    others = track.thumbs[away > _STEP].astype(np.int16)
    if len(others) < 8:
        return False
    here = track.thumbs[(begin + end) // 2]
    alike = np.abs(others - here).max(axis=(1, 2)).min()
    return bool(np.abs(np.median(others, axis=0) - here).max() >= _SHOWN and alike >= _SHOWN / 2)


# -- late
# ------------------------------------------------------------------------------------


def late(track: CameraTrack, found: Lag | None) -> Iterator[Finding | Figure]:
    """Motion in the picture that is not at the time of the joints' motion, or drifts from it."""
    if found is None:
        return
    part = _part(track)
    if found.clear:
        yield Figure(f"lag of {part}, s", found.constant)
    if found.drifts:
        text = (
            f"it drifts against the joints: its picture is {_by(found.begin)} at the start and "
            f"{_by(found.end)} at the end"
        )
        drift = abs(found.end - found.begin)
        yield Finding("camera-late", Use.REVIEW, text, part, value=drift, limit=DRIFT, unit="s")
    elif found.clear and abs(found.constant) > LATENCY:
        text = f"its picture is {_by(found.constant)}, from start to end"
        yield Finding(
            "camera-late", Use.REVIEW, text, part, value=found.constant, limit=LATENCY, unit="s"
        )


def _by(lag: float) -> str:
    """A lag in words."""
    if abs(lag) < 0.05:
        return "in step with the joints"
    return f"{abs(lag):.2f} s {'behind' if lag > 0 else 'ahead of'} the joints"


# -- of an episode
# ------------------------------------------------------------------------------------


def _missing(episode: Episode) -> Iterator[Finding]:
    tracks, motion = tracks_of(episode), motion_of(episode)
    found = [f for track in tracks for f in missing(track, motion, episode.fps)]
    yield from _merged(found, len(tracks))


def _seen(track: CameraTrack, motion: Motion) -> Iterator[Figure]:
    """In how much of the motion the picture moves; only where all arms that it may see move."""
    if len(track) < 4 or len(motion.t) < 4:
        return
    _, moved, changed = _windows(track, motion)
    arms = [i for i in np.unique(motion.part).tolist() if motion.parts[i].endswith("arm")]
    ways = moved[:, arms].sum(axis=0) if arms else moved.sum(axis=0)
    moving = moved.sum(axis=1) > _MOVES
    if moving.sum() >= _LEAST_WINDOWS and ways.min(initial=np.inf) >= _LEAST_MOTION:
        share = 100 * float((changed[moving] >= _ANSWER).mean())
        yield Figure(f"motion seen by {_part(track)}, %", round(share, 1))


def _frozen(episode: Episode) -> Iterator[Finding | Figure]:
    motion = motion_of(episode)
    for track, lag in zip(tracks_of(episode), _lags_of(episode), strict=True):
        # what a late picture does not show yet has not frozen
        late_by = np.zeros(len(track)) if lag is None else lag.at(track.t)
        seen = motion.seen_by(track.name)
        yield from frozen(replace(track, t=track.t - late_by), seen, late_by)
        yield from _seen(track, seen)


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
    yield structs.replace(first, text=text, part="")


CHECKS = (
    Check("camera-missing", "Cameras without pictures", frozenset({Data.CAMERA}), _missing),
    Check("camera-frozen", "Frozen cameras", frozenset({Data.CAMERA}), _frozen),
    Check("camera-late", "Cameras out of step", frozenset({Data.CAMERA}), _late),
)
