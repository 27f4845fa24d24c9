"""Cameras of datasets: decoded from videos, pictures and Parquet, and judged against the joints."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dexkit.conformance.dataset import cameras as decoding
from dexkit.conformance.dataset.camera_lag import motion_of
from dexkit.conformance.dataset.camera_sets import never_moving
from dexkit.conformance.dataset.cameras import CameraTrack, not_judged, picture, tracks_of
from dexkit.conformance.dataset.checks import cameras
from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.conformance.dataset.read import episode_of_dataset, episode_of_session
from dexkit.hand import Floats
from dexkit.traces.sessions.episodes import read_episode
from dexkit.traces.sessions.lerobot_in import Dataset
from dexkit.traces.sessions.model import Camera
from tests.each import each as each_of

av = pytest.importorskip("av")
image_library = pytest.importorskip("PIL.Image")

Picture = NDArray[np.uint8]


def each(name: str, cases: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Cases by name, or as they are."""
    if isinstance(cases, dict):
        return each_of(name, list(cases.values()), list(cases))
    return each_of(name, cases)


FPS = 20
SIZE = 60, 80
REACHES = ((0.6, 0.8), (1.9, -0.6), (3.0, 0.5), (4.3, -0.9), (5.6, 0.4), (6.7, -0.3), (8.0, 0.9))
"""(s, position): each takes 0.8 s."""
CODECS = (
    ("libx264", {"crf": "23"}),
    ("libx264", {"crf": "30", "g": "2"}),
    ("mpeg4", {}),
)


def reaches(seconds: float, fps: float, lag: float = 0.0) -> Floats:
    """A joint that goes from one place to the next, shape (frames,)."""
    t = np.arange(round(seconds * fps)) / fps - lag
    q, now = np.zeros(len(t)), 0.0
    for begin, target in REACHES:
        s = np.clip((t - begin) / 0.8, 0, 1)
        q = np.where(t >= begin, now + (target - now) * (10 * s**3 - 15 * s**4 + 6 * s**5), q)
        now = target
    return q


def scene(q: Floats, noise: float = 1.0, seed: int = 0) -> list[Picture]:
    """What a fixed camera sees of an arm: something bright, before a wall with a pattern."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    wall = np.kron(rng.integers(50, 150, (height // 10, width // 10)), np.ones((10, 10)))
    found = []
    for position in q.tolist():
        seen = wall + rng.normal(0, noise, wall.shape) if noise else wall.copy()
        x = round(width / 2 + 30 * position)
        seen[20:40, max(0, x - 8) : x + 8] = 250
        found.append(np.clip(seen, 0, 255).astype(np.uint8))
    return found


def write_video(
    path: Path,
    pictures: Sequence[Picture],
    fps: int = FPS,
    codec: tuple[str, dict[str, str]] = CODECS[0],
    times: Sequence[int] | None = None,
    pixels: str = "yuv420p",
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec[0], rate=fps, options=codec[1])
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt = pixels
        for i, grey in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[:, :, None], 3, 2), format="rgb24")
            frame.pts = i if times is None else times[i]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def episode_with(
    folder: Path,
    q: Floats,
    fps: float = FPS,
    videos: Sequence[str] = ("v.mp4",),
    **camera: float,
) -> Episode:
    """An arm of one joint and cameras with a video each."""
    n = len(q)
    noise = np.random.default_rng(1).normal(0, 0.001, n)
    return Episode(
        "episode",
        "LeRobot v2.1",
        float(fps),
        np.arange(n) / fps,
        [Track("right_arm", ("elbow",), state=(q + noise)[:, None])],
        cameras=[
            Camera(Path(v).stem, (v,) * n, seconds=(0.0,) * n, **camera)  # type: ignore[arg-type]
            for v in videos
        ],
        folder=folder,
    )


def camera_findings(episode: Episode) -> list[Finding]:
    found = [each for check in cameras.CHECKS for each in check.run(episode)]
    return [each for each in found if isinstance(each, Finding)]


def reasons(episode: Episode) -> list[tuple[str, Use, str]]:
    return [(f.check, f.use, f.part) for f in camera_findings(episode) if f.use is not Use.KEEP]


def only(episode: Episode) -> Finding:
    found = [f for f in camera_findings(episode) if f.use is not Use.KEEP]
    assert len(found) == 1, found
    return found[0]


# -- good
# ------------------------------------------------------------------------------------


def still(pictures: list[Picture]) -> list[Picture]:
    return [pictures[0]] * len(pictures)


def of_wall(pictures: list[Picture]) -> list[Picture]:
    return scene(np.full(len(pictures), 9.0), 2.0)


@each("codec", CODECS)
@each("noise", (0.0, 1.0, 4.0))
def test_a_camera_that_sees_the_arm_is_good(
    tmp_path: Path, codec: tuple[str, dict[str, str]], noise: float
) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", scene(reaches(10, FPS, lag=0.15), noise), codec=codec)
    assert reasons(episode_with(tmp_path, q)) == []


@each("seen", {"nothing that moves": of_wall, "always the same": still})
def test_a_camera_that_sees_nothing_move_is_good(
    tmp_path: Path, seen: Callable[[list[Picture]], list[Picture]]
) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", seen(scene(q)))
    assert reasons(episode_with(tmp_path, q)) == []


def test_an_arm_that_is_out_of_view_for_a_while_is_good(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", scene(q + 1.3, noise=0))
    assert reasons(episode_with(tmp_path, q)) == []


def test_a_camera_that_does_not_see_the_arm_that_moves_is_good(tmp_path: Path) -> None:
    left, right = reaches(10, FPS), reaches(10, FPS)
    right[3 * FPS : 7 * FPS] = right[3 * FPS]
    right[7 * FPS :] = right[3 * FPS] + np.sin(np.arange(3 * FPS) / 8) * 0.5
    write_video(tmp_path / "v.mp4", scene(right, noise=0))
    episode = episode_with(tmp_path, right)
    episode.tracks.append(Track("left_arm", ("elbow",), state=left[:, None]))
    assert reasons(episode) == []


def test_a_camera_on_an_arm_that_rests_is_good(tmp_path: Path) -> None:
    """Without noise its picture is still then, whatever the fingers do out of its view."""
    q = reaches(10, FPS)
    q[3 * FPS : 6 * FPS] = q[3 * FPS]
    rng = np.random.default_rng(0)
    world = np.kron(rng.integers(0, 255, (6, 40)), np.ones((10, 10))).astype(np.uint8)
    pictures = [world[:, x : x + SIZE[1]] for x in np.round(150 + 60 * q).astype(int).tolist()]
    write_video(tmp_path / "v.mp4", pictures)
    episode = episode_with(tmp_path, q)
    fingers = 0.5 + 0.5 * np.sin(np.arange(len(q)) / 7)
    episode.tracks.append(Track("right_hand", ("index",), state=fingers[:, None]))
    assert reasons(episode) == []


@each("noise", (0.0, 4.0))
def test_a_camera_that_sees_one_arm_of_two_is_good(tmp_path: Path, noise: float) -> None:
    """The other arm may do the same a second before, and the name may be that of the other."""
    seen = reaches(10, FPS)
    write_video(tmp_path / "cam_left_wrist.mp4", scene(seen, noise))
    episode = episode_with(tmp_path, seen, videos=("cam_left_wrist.mp4",))
    episode.tracks.append(Track("left_arm", ("elbow",), state=reaches(10, FPS, -1.0)[:, None]))
    assert reasons(episode) == []


@each("fps", (10, 15, 40))
def test_a_camera_may_have_another_rate(tmp_path: Path, fps: int) -> None:
    write_video(tmp_path / "v.mp4", scene(reaches(10, fps)), fps)
    assert reasons(episode_with(tmp_path, reaches(10, FPS))) == []


def test_an_encoder_may_leave_out_pictures_that_do_not_change(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    pictures = scene(q, noise=0)
    kept = [i for i, p in enumerate(pictures) if not i or (p != pictures[i - 1]).any()]
    kept = sorted({*kept, *range(0, len(pictures), 10), len(pictures) - 1})
    write_video(tmp_path / "v.mp4", [pictures[i] for i in kept], times=kept)
    assert reasons(episode_with(tmp_path, q)) == []


@each("pixels", ("gray", "yuv444p", "yuv420p10le"))
def test_grey_and_deep_videos_are_read(tmp_path: Path, pixels: str) -> None:
    q = reaches(4, FPS)
    write_video(tmp_path / "v.mkv", scene(q), codec=("ffv1", {}), pixels=pixels)
    (track,) = tracks_of(episode_with(tmp_path, q, videos=("v.mkv",)))
    assert (len(track), track.trouble) == (len(q), "")
    assert track.thumbs.shape == (len(q), decoding.HEIGHT, decoding.WIDTH)
    assert np.ptp(track.thumbs) > 50


def test_very_small_pictures_are_read(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", [p[:8, :6] for p in scene(reaches(1, FPS))])
    (track,) = tracks_of(episode_with(tmp_path, reaches(1, FPS)))
    assert len(track) == FPS


def test_seven_cameras_are_judged(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    names = [f"v{i}.mp4" for i in range(7)]
    for i, name in enumerate(names):
        write_video(tmp_path / name, scene(q, seed=i))
    assert reasons(episode_with(tmp_path, q, videos=names)) == []


# -- missing
# ------------------------------------------------------------------------------------


def test_a_missing_video_is_found_beside_others(tmp_path: Path) -> None:
    q = reaches(3, FPS)
    write_video(tmp_path / "here.mp4", scene(q))
    found = only(episode_with(tmp_path, q, videos=("here.mp4", "gone.mp4")))
    assert (found.check, found.use, found.part) == ("camera-missing", Use.DROP, "camera gone")


def test_a_set_without_its_videos_is_not_judged(tmp_path: Path) -> None:
    episode = episode_with(tmp_path, reaches(3, FPS), videos=("videos/a.mp4", "videos/b.mp4"))
    assert reasons(episode) == []
    assert not_judged(episode) == ["videos are not looked at: the set is here without them"]
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos/a.mp4").write_text("version https://git-lfs.github.com/spec/v1\n")
    assert reasons(episode) == []


def test_without_the_library_a_remark_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding, "_is_there", lambda library: False)
    episode = episode_with(tmp_path, reaches(3, FPS))
    assert reasons(episode) == []
    assert ["PyAV" in text for text in not_judged(episode)] == [True]
    assert picture(episode, "v", 1.0) is None


@each("end", {"one second": 9.0, "half": 5.0})
def test_an_early_end_is_found(tmp_path: Path, end: float) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", scene(q)[: int(end * FPS)])
    found = only(episode_with(tmp_path, q))
    assert (found.check, found.use) == ("camera-missing", Use.DROP)
    assert (found.begin_s, found.value, found.limit) == (pytest.approx(end), end * FPS, 200)


@each("missing", (1, 2, 4))
def test_some_pictures_less_at_the_end_are_no_fault(tmp_path: Path, missing: int) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", scene(q)[:-missing])
    assert reasons(episode_with(tmp_path, q)) == []


def test_a_camera_that_goes_dark_is_found(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    dark = [np.zeros(SIZE, np.uint8)] * len(q)
    write_video(tmp_path / "v.mp4", dark)
    assert only(episode_with(tmp_path, q)).text == "all of its pictures are black"
    seen = scene(q)
    write_video(tmp_path / "w.mp4", seen[: 6 * FPS] + dark[6 * FPS :])
    found = only(episode_with(tmp_path, q, videos=("w.mp4",)))
    assert (found.check, found.use, found.begin_s) == ("camera-missing", Use.DROP, 6.0)


def test_a_stretch_without_pictures_is_found(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    kept = [i for i in range(len(q)) if not 60 <= i < 100]
    pictures = scene(q)
    write_video(tmp_path / "v.mp4", [pictures[i] for i in kept], times=kept)
    found = only(episode_with(tmp_path, q))
    assert (found.check, found.begin_s, found.end_s) == ("camera-missing", 3.0, 5.0)


def test_a_video_with_the_rate_of_another_set_is_found(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", scene(reaches(10, FPS)), FPS)
    found = only(episode_with(tmp_path, reaches(10, FPS), fps=FPS / 2))
    assert "one of the rates is wrong" in found.text


def test_a_video_that_lasts_longer_is_found(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", scene(reaches(10, FPS)))
    found = only(episode_with(tmp_path, reaches(8, FPS)))
    assert (found.check, found.use) == ("camera-late", Use.REVIEW)


# -- hostile files
# ------------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def scribbled(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 4 : len(data) // 2] = bytes(len(data) // 4)
    path.write_bytes(data)


def playlist(path: Path) -> None:
    other = path.with_name("other.mp4")
    path.rename(other)
    path.write_text(f"#EXTM3U\n#EXTINF:10,\n{other}\n#EXT-X-ENDLIST\n")


def list_of_files(path: Path) -> None:
    other = path.with_name("other.mp4")
    path.rename(other)
    path.write_text(f"ffconcat version 1.0\nfile '{other}'\n")


def sound(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


@each(
    "spoil",
    {
        "cut": cut,
        "scribbled": scribbled,
        "empty": lambda path: path.write_bytes(b""),
        "text": lambda path: path.write_text("no video"),
        "playlist": playlist,
        "list of files": list_of_files,
        "only sound": sound,
    },
)
def test_whatever_is_wrong_with_a_video_is_a_finding(
    tmp_path: Path, spoil: Callable[[Path], object]
) -> None:
    q = reaches(5, FPS)
    write_video(tmp_path / "v.mp4", scene(q))
    spoil(tmp_path / "v.mp4")
    episode = episode_with(tmp_path, q)
    assert {check for check, _, _ in reasons(episode)} == {"camera-missing"}
    picture(episode, "v", 1.0)


def test_pictures_of_a_huge_size_are_not_decoded(tmp_path: Path) -> None:
    q = reaches(3, FPS)
    write_video(tmp_path / "v.mp4", scene(q))
    data = bytearray((tmp_path / "v.mp4").read_bytes())
    at = data.index(b"avc1")
    # the box of the sample description states the size a second time
    data[at + 28 : at + 32] = b"\xff\xff\xff\xff"
    (tmp_path / "v.mp4").write_bytes(data)
    tracks_of(episode_with(tmp_path, q))


@each("path", ("../v.mp4", "/etc/passwd", "link.mp4"))
def test_no_file_outside_of_the_set_is_read(tmp_path: Path, path: str) -> None:
    q = reaches(3, FPS)
    (tmp_path / "set").mkdir()
    write_video(tmp_path / "v.mp4", scene(q))
    write_video(tmp_path / "set/here.mp4", scene(q))
    (tmp_path / "set/link.mp4").symlink_to(tmp_path / "v.mp4")
    episode = episode_with(tmp_path / "set", q, videos=("here.mp4", path))
    assert only(episode).use is Use.DROP
    assert all(not len(track) for track in tracks_of(episode)[1:])


# -- frozen
# ------------------------------------------------------------------------------------


@each("codec", CODECS[:2])
@each("noise", (0.0, 2.0))
@each("stretch", {"middle": (2.5, 5.3), "start": (0.0, 4.0), "end": (5.0, 10.0)})
def test_a_frozen_stretch_is_found(
    tmp_path: Path,
    codec: tuple[str, dict[str, str]],
    noise: float,
    stretch: tuple[float, float],
) -> None:
    q = reaches(10, FPS)
    pictures = scene(q, noise)
    begin, end = (int(s * FPS) for s in stretch)
    pictures[begin:end] = [pictures[begin]] * (end - begin)
    write_video(tmp_path / "v.mp4", pictures, codec=codec)
    found = only(episode_with(tmp_path, q))
    assert (found.check, found.use, found.part) == ("camera-frozen", Use.DROP, "camera v")
    assert found.begin_s == pytest.approx(stretch[0], abs=1.0)
    assert found.end_s == pytest.approx(stretch[1], abs=0.5)


@each("codec", CODECS)
@each("noise", (6.0, 10.0))
def test_a_noisy_picture_that_freezes_is_found(
    tmp_path: Path, codec: tuple[str, dict[str, str]], noise: float
) -> None:
    """To the end: so it leaps nowhere, and a codec may show noise that froze better and better."""
    q = reaches(10, FPS)
    pictures = scene(q, noise)
    begin = 4 * FPS
    pictures[begin:] = [pictures[begin]] * (len(pictures) - begin)
    write_video(tmp_path / "v.mp4", pictures, codec=codec)
    found = only(episode_with(tmp_path, q))
    assert (found.check, found.use, found.part) == ("camera-frozen", Use.DROP, "camera v")
    assert found.begin_s == pytest.approx(4.0, abs=2.0)


def test_noise_that_stops_is_found_where_little_else_is_seen(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    pictures = of_wall(scene(q))
    pictures[4 * FPS :] = [pictures[4 * FPS]] * (len(pictures) - 4 * FPS)
    write_video(tmp_path / "v.mp4", pictures, codec=("libx264", {"crf": "10"}))
    assert only(episode_with(tmp_path, q)).check == "camera-frozen"


@each(
    "name",
    {
        "on the right wrist": ("cam_right_wrist", {"right_arm"}),
        "on the left wrist": ("left_wrist_2", {"left_arm"}),
        "left eye of the head": ("cam_left_high", {"left_arm", "right_arm"}),
        "no words": ("相机 1", {"left_arm", "right_arm"}),
    },
)
def test_a_camera_on_a_wrist_is_compared_with_its_own_arm(
    tmp_path: Path, name: tuple[str, set[str]]
) -> None:
    episode = episode_with(tmp_path, reaches(8, FPS))
    left = Track("left_arm", ("elbow",), state=reaches(8, FPS, 0.5)[:, None])
    episode.tracks.append(left)
    motion = motion_of(episode)
    moved = motion.seen_by(name[0]).travel(np.array([0.0]), np.array([5.0]))[0] > 0
    assert {p for p, moves in zip(motion.parts, moved, strict=True) if moves} == name[1]


def test_a_camera_that_never_moves_is_found_beside_other_episodes(tmp_path: Path) -> None:
    q = reaches(8, FPS)
    pictures = scene(q)
    write_video(tmp_path / "v.mp4", pictures)
    write_video(tmp_path / "w.mp4", still(pictures))
    judged = {}
    for i in range(7):
        episode = episode_with(tmp_path, q + 0.1 * i, videos=("w.mp4" if i == 3 else "v.mp4",))
        episode.cameras = [replace(c, name="head") for c in episode.cameras]
        judged[str(i)] = judge(episode)
    found = {n: [f.check for f in each] for n, each in dict_of(never_moving(judged)).items()}
    assert found == {"3": ["camera-frozen"]}
    blind = dict.fromkeys(judged, judged["3"])
    assert not list(never_moving(blind))


def dict_of(found: Iterable[tuple[str, Finding]]) -> dict[str, list[Finding]]:
    by_name: dict[str, list[Finding]] = {}
    for name, finding in found:
        by_name.setdefault(name, []).append(finding)
    return by_name


# -- late
# ------------------------------------------------------------------------------------


@each("lag", (-0.5, 0.7, 1.0))
@each("noise", (1.0, 8.0))
def test_a_late_picture_is_found(tmp_path: Path, lag: float, noise: float) -> None:
    q = reaches(10, FPS)
    write_video(tmp_path / "v.mp4", scene(reaches(10, FPS, lag), noise))
    found = only(episode_with(tmp_path, q))
    assert (found.check, found.use) == ("camera-late", Use.REVIEW)
    assert found.value == pytest.approx(lag, abs=0.1)


@each("noise", (1.0, 8.0))
def test_a_drifting_picture_is_found(tmp_path: Path, noise: float) -> None:
    q = reaches(10, FPS)
    slow = np.interp(np.arange(len(q)) * 0.9, np.arange(len(q)), q)
    write_video(tmp_path / "v.mp4", scene(slow, noise))
    found = only(episode_with(tmp_path, q))
    assert found.check == "camera-late"
    assert "drifts" in found.text


def test_all_cameras_late_are_one_finding(tmp_path: Path) -> None:
    q = reaches(10, FPS)
    names = ("a.mp4", "b.mp4")
    for i, name in enumerate(names):
        write_video(tmp_path / name, scene(reaches(10, FPS, 0.8), seed=i))
    found = only(episode_with(tmp_path, q, videos=names))
    assert (found.part, found.text[:14]) == ("", "all 2 cameras:")


# -- sources
# ------------------------------------------------------------------------------------


def dataset(folder: Path, count: int, q: Floats, feature: str, key: str, **info: object) -> None:
    """A LeRobot dataset of v3.0, of episodes of the same motion."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    n = len(q)
    features: dict[str, object] = {
        name: {"dtype": "float32", "shape": [2], "names": ["elbow", "wrist"]}
        for name in ("observation.state", "action")
    }
    features[key] = {"dtype": feature, "shape": [*SIZE, 3], "names": None}
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/info.json").write_text(
        json.dumps(
            {
                "codebase_version": "v3.0",
                "fps": FPS,
                "features": features,
                "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "video_path": "videos/{video_key}/"
                "chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
                **info,
            }
        )
    )
    columns: dict[str, object] = {
        "timestamp": np.tile(np.arange(n) / FPS, count),
        "frame_index": np.tile(np.arange(n), count),
        "episode_index": np.repeat(np.arange(count), n),
        "task_index": np.zeros(n * count, int),
    }
    both = np.stack([q, q / 2], 1)
    columns["observation.state"] = columns["action"] = list(np.tile(both, (count, 1)))
    if feature == "image":
        data = [{"bytes": encoded(p, "PNG"), "path": ""} for p in scene(q)]
        columns[key] = data * count
    parquet.write_table(arrow.table(columns), folder / "data/chunk-000/file-000.parquet")
    rows = {
        "episode_index": list(range(count)),
        "tasks": [["reach"]] * count,
        "data/chunk_index": [0] * count,
        "data/file_index": [0] * count,
        f"videos/{key}/chunk_index": [0] * count,
        f"videos/{key}/file_index": [0] * count,
        f"videos/{key}/from_timestamp": [i * n / FPS for i in range(count)],
        f"videos/{key}/to_timestamp": [(i + 1) * n / FPS for i in range(count)],
    }
    parquet.write_table(arrow.table(rows), folder / "meta/episodes/chunk-000/file-000.parquet")


def encoded(picture: Picture, form: str) -> bytes:
    out = io.BytesIO()
    image_library.fromarray(picture).save(out, form)
    return out.getvalue()


@each("key", ("observation.images.head", "observation.images.Köpfe 1/2"))
def test_episodes_share_a_video(tmp_path: Path, key: str) -> None:
    q = reaches(8, FPS)
    dataset(tmp_path, 3, q, "video", key)
    frozen = scene(q)
    frozen[40:100] = [frozen[40]] * 60
    pictures = [*scene(q), *frozen, *scene(q)]
    path = tmp_path / f"videos/{key}/chunk-000/file-000.mp4"
    write_video(path, pictures)
    read = Dataset(tmp_path)
    episodes = [episode_of_dataset(read, i) for i in range(3)]
    (track,) = tracks_of(episodes[2])
    assert (len(track), track.t[0]) == (len(q), pytest.approx(0))
    assert [reasons(e) for e in (episodes[0], episodes[2])] == [[], []]
    assert [check for check, _, _ in reasons(episodes[1])] == ["camera-frozen"]
    shown = image_library.open(io.BytesIO(picture(episodes[2], track.name, 2.0) or b""))
    assert shown.size == (SIZE[1], SIZE[0])
    seen = np.asarray(shown.convert("L")).astype(int)
    assert np.abs(seen - pictures[2 * len(q) + 2 * FPS]).mean() < 4


def test_pictures_of_a_parquet_file_are_read_on_demand(tmp_path: Path) -> None:
    q = reaches(8, FPS)
    dataset(tmp_path, 2, q, "image", "observation.images.head")
    episode = episode_of_dataset(Dataset(tmp_path), 1)
    assert reasons(episode) == []
    (track,) = tracks_of(episode)
    assert (track.name, len(track), track.trouble) == ("head", len(q), "")
    assert (picture(episode, "head", 1.0) or b"")[:2] == b"\xff\xd8"


def task_folder(folder: Path, q: Floats, pictures: Sequence[bytes | None], end: str) -> Episode:
    folder = folder / str(len(list(folder.parent.rglob("colors"))))
    (folder / "colors").mkdir(parents=True)
    items = []
    for i, position in enumerate(q.tolist()):
        name = f"colors/{i:06d}_color_0.{end}"
        data = pictures[i] if i < len(pictures) else None
        if data is not None:
            (folder / name).write_bytes(data)
        joints = {"right_arm": {"qpos": [position] * 7}, "left_arm": {"qpos": [0.0] * 7}}
        depths = {"depth_0": f"depths/{i:06d}_depth_0.jpg"}
        items.append(
            {
                "idx": i,
                "colors": {"color_0": name},
                "depths": depths,
                "states": joints,
                "actions": joints,
            }
        )
    head = {"info": {"image": {"fps": FPS}}, "text": {"goal": "reach"}}
    (folder / "data.json").write_text(json.dumps({**head, "data": items}))
    return episode_of_session(read_episode(folder))


@pytest.fixture
def in_files(tmp_path: Path) -> tuple[Path, Floats, list[Picture]]:
    q = reaches(8, FPS)
    return tmp_path / "episode_0001", q, scene(q)


@each("form", ("JPEG", "PNG"))
def test_pictures_in_files_are_judged(
    in_files: tuple[Path, Floats, list[Picture]], form: str
) -> None:
    folder, q, pictures = in_files
    episode = task_folder(folder, q, [encoded(p, form) for p in pictures], form.lower())
    assert reasons(episode) == []
    assert (picture(episode, "color_0", 1.0) or b"")[:2] == b"\xff\xd8"
    (episode.folder / f"colors/000020_color_0.{form.lower()}").write_bytes(b"no picture")
    assert picture(episode, "color_0", 1.0) is not None


def test_pictures_with_colours_and_transparency_are_read() -> None:
    grey = scene(reaches(1, FPS))[3]
    for mode in ("L", "RGB", "RGBA", "P", "1", "I;16"):
        image = image_library.fromarray(grey).convert(mode)
        out = io.BytesIO()
        image.save(out, "PNG")
        sample = decoding._sample_of_picture(out.getvalue())
        assert sample is not None, mode
        assert sample.shape == grey.shape


@each(
    "lost",
    {
        "the second half": (lambda i: i >= 80, Use.DROP),
        "three seconds": (lambda i: 40 <= i < 100, Use.DROP),
        "all": (lambda i: True, Use.DROP),
        "some": (lambda i: i % 9 == 4, Use.REVIEW),
    },
)
def test_missing_files_are_found(
    in_files: tuple[Path, Floats, list[Picture]], lost: tuple[Callable[[int], bool], Use]
) -> None:
    folder, q, pictures = in_files
    data = [None if lost[0](i) else encoded(p, "JPEG") for i, p in enumerate(pictures)]
    found = list(camera_findings(task_folder(folder, q, data, "jpg")))
    assert {f.check for f in found} == {"camera-missing"}
    assert max(found, key=lambda f: f.use is Use.DROP).use is lost[1]


def test_damaged_files_are_found(in_files: tuple[Path, Floats, list[Picture]]) -> None:
    folder, q, pictures = in_files
    data: list[bytes | None] = [encoded(p, "JPEG") for p in pictures]
    data[90:] = [(d or b"")[:300] for d in data[90:]]
    found = only(task_folder(folder, q, data, "jpg"))
    assert (found.check, found.use) == ("camera-missing", Use.DROP)
    assert "are damaged" in found.text


def test_a_frozen_camera_of_a_task_folder_is_found(
    in_files: tuple[Path, Floats, list[Picture]],
) -> None:
    folder, q, pictures = in_files
    pictures[50:120] = [pictures[50]] * 70
    found = only(task_folder(folder, q, [encoded(p, "JPEG") for p in pictures], "jpg"))
    assert (found.check, found.part) == ("camera-frozen", "camera color_0")


# -- bounds
# ------------------------------------------------------------------------------------


def test_the_picture_of_a_page_is_small(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280)).astype(np.uint8)
    write_video(tmp_path / "v.mp4", [noise] * 3, codec=("mpeg4", {"q": "2"}))
    found = picture(episode_with(tmp_path, reaches(0.15, FPS)), "v", 0.1)
    assert found is not None
    assert len(found) <= 12_000
    assert max(image_library.open(io.BytesIO(found)).size) <= 320


def test_depth_pictures_are_not_decoded(in_files: tuple[Path, Floats, list[Picture]]) -> None:
    folder, q, pictures = in_files
    episode = task_folder(folder, q, [encoded(p, "JPEG") for p in pictures], "jpg")
    assert [c.group for c in episode.cameras] == ["colors", "depths"]
    assert [t.name for t in tracks_of(episode)] == ["color_0"]


def test_an_episode_without_frames_or_joints_is_no_error(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", scene(reaches(2, FPS)))
    episode = episode_with(tmp_path, np.zeros(0))
    list(camera_findings(episode))
    list(camera_findings(replace(episode_with(tmp_path, reaches(2, FPS)), tracks=[])))
    assert CameraTrack("a", 0).trouble == ""
