"""Decode the pictures of an episode's cameras, as small as the checks need them.

Videos need PyAV, single pictures Pillow (``pip install 'dexkit[video]'``). Files are not trusted:
whatever is wrong with one becomes the track's ``trouble``.
"""

from __future__ import annotations

import importlib.util
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.dataset.episode import Episode
from dexkit.documents import open_ordinary
from dexkit.errors import SessionError
from dexkit.escaping import one_line
from dexkit.hand import Floats
from dexkit.traces.sessions.model import Camera
from dexkit.traces.sessions.paths import below
from dexkit.traces.sessions.pictures import parse_picture, read_picture

__all__ = [
    "HEIGHT",
    "WIDTH",
    "CameraTrack",
    "decoders",
    "looked_at",
    "not_judged",
    "picture",
    "tracks_of",
]

HEIGHT, WIDTH = 12, 16
"""Blocks of a thumbnail: large enough that a sensor's noise hardly changes their means, and small
enough that a hand does."""

Grey = NDArray[np.uint8]

_SAMPLE = 16_384  # pixels of a picture that are looked at; 128x96 of 640x480
_AT_ONCE = 32  # pictures that are reduced together
_MOST_PIXELS = 2**26  # of a picture that is decoded: 8K has 2**25
_MOST_PICTURES = 8  # times as many as the episode has frames: a 240 fps camera in a 30 fps set
_PLAIN = frozenset(f"yuv{'j' * j}{s}p" for s in ("420", "422", "444") for j in (0, 1)) | {
    "gray",
    "nv12",
    "nv21",
    "yuva420p",
}
"""Formats whose first plane is the brightness, a byte a pixel."""
# Not what only names other files (playlists), which could be any of this machine.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"
_POINTER = b"version https://git-lfs"
_WIDEST, _LARGEST_PICTURE = 320, 12_000  # pixels and bytes of a picture for a page
_LEAST_COVER = 0.5  # of a frame's time, by which a picture may lie outside of the episode


@dataclass(eq=False)
class CameraTrack:
    """What a camera saw in an episode.

    :param name: ``color_0``.
    :param expected: frames of the episode.
    :param t: of each picture, s after the start of the episode, shape (pictures,).
    :param thumbs: each picture in grey, shape (pictures, HEIGHT, WIDTH).
    :param changes: by how much each differs from the one before, grey levels of 255, on average
        over a sample of its pixels; 0 of the first; shape (pictures,). ``altered`` is the share of
        pixels that differ at all.
    :param digests: of each picture as it was decoded; equal for equal pictures, shape (pictures,).
    :param trouble: why nothing, or not all of it, could be read, as a sentence without its subject.
    :param absent: the file is not there.
    :param length: seconds that the source has for this episode; None where it does not say.
    :param total: pictures that it says to have; None likewise.
    """

    name: str
    expected: int
    t: Floats = field(default_factory=lambda: np.zeros(0))
    thumbs: Grey = field(default_factory=lambda: np.zeros((0, HEIGHT, WIDTH), np.uint8))
    changes: Floats = field(default_factory=lambda: np.zeros(0))
    altered: Floats = field(default_factory=lambda: np.zeros(0))
    digests: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    trouble: str = ""
    absent: bool = False
    length: float | None = None
    total: int | None = None

    def __len__(self) -> int:
        return len(self.t)


class _Collector:
    """Reduce pictures to what a track keeps, some at a time."""

    def __init__(self) -> None:
        self._t: list[float] = []
        self._samples: list[Grey] = []
        self._thumbs: list[Grey] = []
        self._digests: list[int] = []
        self._differences: list[tuple[Floats, Floats]] = []
        self._last: Grey | None = None

    def __len__(self) -> int:
        return len(self._t)

    def add(self, t: float, sample: Grey) -> None:
        """Add a picture, given by a sample of its pixels, shape (height, width)."""
        if self._samples and (
            len(self._samples) == _AT_ONCE or self._samples[0].shape != sample.shape
        ):
            self._reduce()
        self._t.append(t)
        self._samples.append(sample)

    def _reduce(self) -> None:
        first = self._samples[0]
        before = self._last
        other_size = before is None or before.shape != first.shape
        found = np.stack([first if other_size or before is None else before, *self._samples])
        difference = np.maximum(found[1:], found[:-1]) - np.minimum(found[1:], found[:-1])
        changes = difference.mean(axis=(1, 2), dtype=np.float64)
        altered = np.count_nonzero(difference, axis=(1, 2)) / first.size
        if before is not None and other_size:
            changes[0], altered[0] = 255.0, 1.0
        self._differences.append((changes, altered))
        self._digests += [crc32(sample.data) for sample in self._samples]
        self._thumbs.append(_thumbs(found[1:]))
        self._last = self._samples[-1]
        self._samples.clear()

    def into(self, track: CameraTrack) -> CameraTrack:
        """Fill a track."""
        if self._samples:
            self._reduce()
        if self._t:
            track.t = np.array(self._t)
            track.thumbs = np.concatenate(self._thumbs)
            track.changes = np.concatenate([c for c, _ in self._differences])
            track.altered = np.concatenate([a for _, a in self._differences])
            track.digests = np.array(self._digests, np.uint32)
        return track


def _thumbs(samples: Grey) -> Grey:
    """Means of blocks, of pictures of shape (pictures, height, width)."""
    _, height, width = samples.shape
    rows, columns = np.arange(HEIGHT) * height // HEIGHT, np.arange(WIDTH) * width // WIDTH
    sums = np.add.reduceat(samples, rows, axis=1, dtype=np.uint32)
    sums = np.add.reduceat(sums, columns, axis=2)
    heights = np.maximum(np.diff(rows, append=height), 1)
    widths = np.maximum(np.diff(columns, append=width), 1)
    area = heights[:, None] * widths
    found: Grey = ((sums + area // 2) // area).astype(np.uint8)
    return found


def _stride(height: int, width: int) -> int:
    return max(1, math.isqrt(height * width // _SAMPLE))


# -- which cameras
# ------------------------------------------------------------------------------------


@cache
def _is_there(library: str) -> bool:
    return importlib.util.find_spec(library) is not None


def decoders() -> list[str]:
    """The libraries that are here to decode pictures with."""
    return [library for library in ("av", "PIL") if _is_there(library)]


def not_judged(episode: Episode) -> list[str]:
    """Why cameras of an episode are not looked at, as sentences; equal for the episodes of a set.

    That is so if a library is not installed, or if the set is here without its videos.
    """
    found = []
    if any(c.seconds is not None for c in _colours(episode)):
        if not _is_there("av"):
            found.append("videos are not looked at: that needs PyAV, pip install 'dexkit[video]'")
        elif _without_videos(episode):
            found.append("videos are not looked at: the set is here without them")
    if any(c.seconds is None for c in _colours(episode)) and not _is_there("PIL"):
        found.append("pictures are not looked at: that needs Pillow, pip install 'dexkit[video]'")
    return found


def looked_at(episode: Episode) -> list[Camera]:
    """The cameras that can be judged here: without those of which :func:`not_judged` speaks, and
    without depth cameras.
    """
    found = _colours(episode)
    if not _is_there("av") or _without_videos(episode):
        found = [c for c in found if c.seconds is None]
    if not _is_there("PIL"):
        found = [c for c in found if c.seconds is not None]
    return found


def _colours(episode: Episode) -> list[Camera]:
    return [c for c in episode.cameras if c.group != "depths"]


def _without_videos(episode: Episode) -> bool:
    """Whether no video of a dataset is here: it was fetched without them."""
    videos = [c.paths[0] for c in _colours(episode) if c.seconds is not None and c.paths]
    return bool(videos) and not any(_is_video_here(episode.folder, path) for path in videos)


def _is_video_here(folder: Path, path: str) -> bool:
    """Whether a video, or another one of its camera, is in the dataset."""
    try:
        file = below(folder, path)
        if file.is_file():
            return not _is_pointer(file)
        return any(not _is_pointer(p) for p in file.parent.glob(f"*{file.suffix}") if p.is_file())
    except (SessionError, OSError):
        return True  # told as what it is


def _is_pointer(file: Path) -> bool:
    """Whether it stands for a file that Git LFS has not fetched."""
    if file.stat().st_size > 1024:
        return False
    with open_ordinary(file, error=SessionError) as opened:
        return opened.read(len(_POINTER)) == _POINTER


@lru_cache(maxsize=1)
def tracks_of(episode: Episode) -> tuple[CameraTrack, ...]:
    """What the cameras of an episode saw; decoded once for all checks."""
    return tuple(
        _picture_track(episode, camera) if camera.seconds is None else _video_track(episode, camera)
        for camera in looked_at(episode)
    )


# -- videos
# ------------------------------------------------------------------------------------


def _video_track(episode: Episode, camera: Camera) -> CameraTrack:
    track = CameraTrack(camera.name, len(episode))
    if not len(episode):
        return track
    try:
        path = below(episode.folder, camera.paths[0])
        if not path.is_file():
            track.absent, track.trouble = True, "its video is missing"
            return track
        if _is_pointer(path):
            track.absent = True
            track.trouble = "its video was not fetched: the file is a pointer of Git LFS"
            return track
    except (SessionError, OSError) as error:
        track.absent, track.trouble = True, f"its video cannot be used: {one_line(error, 300)}"
        return track
    collector = _Collector()
    try:
        with open_ordinary(path, error=SessionError) as file, _Video(file) as video:
            _collect(video, episode, camera, track, collector)
    except Exception as error:  # of the decoder: it has dozens, and more with each version
        track.trouble = f"its video cannot be read: {_reason(error)}"
    return collector.into(track)


def _collect(
    video: _Video, episode: Episode, camera: Camera, track: CameraTrack, collector: _Collector
) -> None:
    period = 1.0 / episode.fps
    spare = _LEAST_COVER * period
    begin, last = camera.begin_s, camera.begin_s + len(episode) * period
    end = last if camera.end_s is None else min(last + period, camera.end_s)
    if camera.end_s is not None:
        track.length = max(0.0, camera.end_s - begin)
    else:
        track.length, track.total = video.length, video.total
    most = _MOST_PICTURES * len(episode) + 100
    for seconds, frame in video.frames(begin - spare):
        if seconds >= end - spare:
            break
        if len(collector) >= most:
            track.trouble = f"it has more than {most} pictures in {len(episode)} frames"
            break
        collector.add(seconds - begin, _sample_of_frame(frame))
    if video.damaged:
        track.trouble = f"{video.damaged} pieces of its video are damaged"


class _Video:
    """A video file of whatever contents, open to be decoded.

    :raises Exception: of any kind, where FFmpeg cannot.
    """

    def __init__(self, file: io.BufferedReader) -> None:
        import av

        self.damaged = 0
        self._container: Any = av.open(
            file,
            mode="r",
            # of names and comments that are no UTF-8
            metadata_errors="replace",
            options={"format_whitelist": _CONTAINERS},
        )
        try:
            streams = self._container.streams.video
            if not streams:
                raise ValueError("there is no picture in it")
            self._stream: Any = streams[0]
            context = self._stream.codec_context
            if context is None:
                raise ValueError("no decoder for it is installed")
            if context.width * context.height > _MOST_PIXELS:
                size = f"{context.width} x {context.height}"
                raise ValueError(f"its pictures of {size} pixels are too large")
            # a process an episode keeps all processors busy
            context.thread_type, context.thread_count = "NONE", 1
            context.options = {"max_pixels": str(_MOST_PIXELS)}
        except BaseException:
            self._container.close()
            raise
        self._base = float(self._stream.time_base or 0) or 1e-3
        start = self._stream.start_time or 0
        # a file that begins some frames late was written so by the encoder; players do the same
        self._start = start if start * self._base < 0.2 else 0

    def __enter__(self) -> _Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    @property
    def length(self) -> float | None:
        """Seconds, as the file states them."""
        duration = self._stream.duration
        return None if not duration or duration < 0 else float(duration * self._base)

    @property
    def total(self) -> int | None:
        """Pictures, as the file states them."""
        return int(self._stream.frames) or None

    def frames(self, begin: float) -> Iterator[tuple[float, Any]]:
        """Time, s, and picture, from a time on."""
        import av

        if begin > 0:
            # to the key frame before; what lies between is decoded and passed over
            self._container.seek(int(begin / self._base) + self._start, stream=self._stream)
        before = -math.inf
        for packet in self._container.demux(self._stream):
            try:
                frames = packet.decode()
            except av.error.InvalidDataError:
                self.damaged += 1
                continue
            for frame in frames:
                if frame.pts is None:
                    continue
                seconds = (frame.pts - self._start) * self._base
                if seconds >= begin and seconds > before:
                    before = seconds
                    yield seconds, frame


def _sample_of_frame(frame: Any) -> Grey:
    step = _stride(frame.height, frame.width)
    if frame.format.name in _PLAIN:
        plane = frame.planes[0]
        whole = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        # a copy: the decoder uses the memory again
        return whole[: frame.height : step, : frame.width : step].copy()
    size = {"width": max(1, frame.width // step), "height": max(1, frame.height // step)}
    found: Grey = frame.reformat(**size, format="gray").to_ndarray()
    return found


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return one_line(text, 300)


# -- single pictures
# ------------------------------------------------------------------------------------


def _picture_track(episode: Episode, camera: Camera) -> CameraTrack:
    track = CameraTrack(camera.name, len(episode))
    collector = _Collector()
    reasons: dict[str, int] = {}
    asked = 0
    for i, t in enumerate(episode.t[: len(camera.paths)].tolist()):
        if not camera.paths[i]:
            continue
        asked += 1
        data, why = _picture_data(episode.folder, camera, i)
        sample = None if data is None else _sample_of_picture(data)
        if sample is not None:
            collector.add(t, sample)
            continue
        why = why or "are damaged"
        reasons[why] = reasons.get(why, 0) + 1
    if reasons:
        why = max(reasons, key=lambda w: reasons[w])
        track.trouble = f"{sum(reasons.values())} of its {asked} pictures {why}"
        track.absent = not len(collector) and why == "are missing"
    return collector.into(track)


def _picture_data(folder: Path, camera: Camera, frame: int) -> tuple[bytes | None, str]:
    """(the picture, or None; why not, as the end of "pictures that ...")"""
    if camera.load is not None:
        try:
            data = camera.load(frame)
        except SessionError as error:
            return None, f"cannot be read: {one_line(error, 300)}"
        found = None if data is None else parse_picture(data)
        why = "are missing" if data is None else "are neither JPEG nor PNG"
    else:
        found, why = read_picture(folder, camera.paths[frame])
    if found is None:
        return None, why
    if found.width * found.height > _MOST_PIXELS:
        return None, "are too large"
    return found.data, ""


def _sample_of_picture(data: bytes) -> Grey | None:
    """Some of the pixels; None of one that is damaged."""
    try:
        image = _open_picture(data)
        step = _stride(image.height, image.width)
        image.draft("L", (max(1, image.width // step), max(1, image.height // step)))
        if image.mode.startswith("I") or image.mode == "F":
            deep = np.asarray(image, dtype=np.float64)
            grey = (deep / max(1.0, float(deep.max()) / 255)).astype(np.uint8)
        else:
            grey = np.asarray(image.convert("L"))
    except Exception:  # of the decoder, likewise
        return None
    step = _stride(*grey.shape)
    return np.ascontiguousarray(grey[::step, ::step])


def _open_picture(data: bytes) -> Any:
    from PIL import Image

    return Image.open(io.BytesIO(data), formats=("JPEG", "PNG"))


# -- one picture for a page
# ------------------------------------------------------------------------------------


def picture(episode: Episode, camera: str, seconds: float) -> bytes | None:
    """A small JPEG of what a camera saw at a time; None where there is none.

    :param seconds: after the start of the episode.
    """
    found = next((c for c in _colours(episode) if c.name == camera), None)
    if found is None or not len(episode) or not _is_there("PIL"):
        return None
    try:
        image = (
            _picture_near(episode, found, seconds)
            if found.seconds is None
            else _frame_near(episode, found, seconds)
        )
        return None if image is None else _small(image)
    except Exception:  # of the decoders; there is no picture then
        return None


def _picture_near(episode: Episode, camera: Camera, seconds: float) -> Any:
    frames = np.argsort(np.abs(episode.t[: len(camera.paths)] - seconds))
    for i in frames[:5].tolist():
        data, _ = _picture_data(episode.folder, camera, i) if camera.paths[i] else (None, "")
        if data is not None:
            return _open_picture(data)
    return None


def _frame_near(episode: Episode, camera: Camera, seconds: float) -> Any:
    if not _is_there("av"):
        return None
    path = below(episode.folder, camera.paths[0])
    at = camera.begin_s + min(max(seconds, 0.0), episode.duration)
    with open_ordinary(path, error=SessionError) as file, _Video(file) as video:
        for _, frame in video.frames(max(0.0, at - _LEAST_COVER / episode.fps)):
            return frame.to_image()
    return None


def _small(image: Any) -> bytes | None:
    image.draft("RGB", (_WIDEST, _WIDEST)) if hasattr(image, "draft") else None
    image = image.convert("RGB")
    image.thumbnail((_WIDEST, _WIDEST))
    for quality in (80, 60, 40, 20):
        out = io.BytesIO()
        image.save(out, "JPEG", quality=quality, optimize=True)
        if out.tell() <= _LARGEST_PICTURE:
            return out.getvalue()
    return None
