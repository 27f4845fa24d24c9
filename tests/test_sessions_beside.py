"""Episodes get the times of a recording made beside them: ``record --beside-episodes``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dexkit.cli.record import _episodes, _merge_episodes
from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions.edit import Span, cut
from dexkit.traces.sessions.episode_times import find_times
from dexkit.traces.sessions.episodes import read_episode
from dexkit.traces.sessions.imported import RECORD
from dexkit.traces.sessions.resample import hold, interpolate
from dexkit.traces.sessions.streams import COMMAND, STATE, Stream, streams_of
from tests.session_helpers import document, episode, streamed
from tests.test_sessions_import import dexkit, streams

Made = tuple[Path, np.ndarray]


@pytest.fixture(scope="module")
def pick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven seconds of a Dex1 session, with the motion of :func:`beside`."""
    out = tmp_path_factory.mktemp("wire") / "pick.mcap"
    trace = open_trace(sample_path("dex1_pick_place"))
    cut(trace, out, spans=[Span(trace.first_ns + 3 * 10**9, trace.first_ns + 10 * 10**9)])
    return out


def wire_of(name: str, repeated: int = 1) -> list[Stream]:
    """The streams of a sample; each command is sent ``repeated`` times instead of the next ones."""
    found = []
    for stream in streams_of(open_trace(sample_path(name))):
        if stream.kind == COMMAND:
            sent = np.arange(len(stream)) // repeated * repeated
            stream = replace(stream, values={k: v[sent] for k, v in stream.values.items()})
        found.append(stream)
    return found


def beside(
    folder: Path,
    name: str,
    *,
    rate: float,
    begin: float = 4.0,
    seconds: float = 5.0,
    noise: float = 0.0,
    end: bool = True,
    repeated: int = 1,
    stall: float = 0.0,
) -> Made:
    """An episode of a recorded session as xr_teleoperate would have written it, and the true times.

    It takes its actions from the commands at that time, at less than the nominal 30 Hz, unevenly.

    :param repeated: as for :func:`wire_of`.
    :param stall: seconds that each frame of the second quarter takes longer.
    """
    random = np.random.default_rng(1)
    trace = open_trace(sample_path(name))
    wire = {(s.part, s.kind): s for s in wire_of(name, repeated)}
    periods = 1 / rate + np.abs(random.normal(0, 0.003, int(seconds * rate)))
    periods[len(periods) // 4 : len(periods) // 2] += stall
    at = trace.first_ns + ((begin + np.cumsum(periods)) * 1e9).astype(np.int64)
    found = document(len(at), wire["left_hand", COMMAND].model, cameras=1)
    for side in ("left", "right"):
        command, state = wire[f"{side}_hand", COMMAND], wire[f"{side}_hand", STATE]
        actions = hold(command.times_ns, command.q, at, 10.0)
        actions = actions + random.normal(0, noise, actions.shape) if noise else actions
        states = hold(state.times_ns, state.q, at, 10.0)
        for i, item in enumerate(found["data"]):
            item["actions"][f"{side}_ee"]["qpos"] = actions[i].tolist()
            item["states"][f"{side}_ee"]["qpos"] = states[i].tolist()
    return episode(folder, streamed(found, end=end)), at


@pytest.mark.parametrize(
    ("name", "rate", "noise"),
    [("dex1_pick_place", 28, 0.0), ("dex3_pinch", 24, 0.0), ("dex1_legacy_v1_1", 26, 0.002)],
)
def test_the_true_times_are_found(tmp_path: Path, name: str, rate: float, noise: float) -> None:
    folder, at = beside(tmp_path / "e", name, rate=rate, noise=noise)
    session = read_episode(folder)
    found = find_times(session, streams_of(open_trace(sample_path(name))))
    error = np.abs(found.times_ns - at) / 1e6
    assert np.median(error) < 8  # a command's period is 5 or 10 ms
    assert error.max() < 60
    assert found.confidence > 0.5
    assert found.matched == (0.0 if noise else 1.0)
    assert found.rate == pytest.approx((len(at) - 1) * 1e9 / (at[-1] - at[0]), rel=0.02)
    assert (np.diff(found.times_ns) > 0).all()


def test_an_episode_is_merged_with_the_wire(tmp_path: Path) -> None:
    folder, at = beside(tmp_path / "e", "dex3_pinch", rate=26, seconds=3.0)
    wire = tmp_path / "wire.mcap"
    whole = open_trace(sample_path("dex3_pinch"))
    cut(whole, wire, spans=[Span(int(at[0]) - 10**9, int(at[-1]) + 10**9)])
    code, output = dexkit("import", folder.parent, tmp_path / "m.mcap", "--wire", wire)
    assert (code, "confidence 1.00" in output) == (1, True), output  # its pictures are missing
    trace = open_trace(tmp_path / "m.mcap")
    record = trace.metadata[RECORD]
    assert (record["clock"], record["wire"]) == ("measured", "wire.mcap")
    assert record["pictures_folder"] == folder.name
    assert float(record["alignment_confidence"]) > 0.9
    got, source = streams(trace), streams(open_trace(wire))
    hand = got["left_hand", STATE]
    # the hands are the wire's, at its rate, with everything that it has
    assert set(hand.values) == {"q", "dq", "tau"}
    assert hand.pressure is not None
    assert np.isin(hand.times_ns, source["left_hand", STATE].times_ns).all()
    arm = got["left_arm", STATE]
    assert np.abs(arm.times_ns - at).max() < 60e6
    assert len(arm) == len(at)
    # and back as an episode: q, dq, tau_est and pressure of the hands in every frame
    code, output = dexkit(
        "export", tmp_path / "m.mcap", "--to", "episodes", "--out", tmp_path / "t"
    )
    assert code == 1, output
    original = json.loads((folder / "data.json").read_text())["data"]
    back = json.loads((tmp_path / "t" / "episode_0000" / "data.json").read_text())["data"]
    assert [i["idx"] for i in back] == [i["idx"] for i in original]
    for i in (0, 30, len(at) - 1):
        item = back[i]
        t = item["timestamp_ns"]
        assert t == arm.times_ns[i]
        s = source["right_hand", STATE]
        expected = interpolate(s.times_ns, s.values["tau"], np.array([t]))[0]
        assert item["states"]["right_ee"]["torque"] == expected.tolist()
        assert len(item["states"]["right_ee"]["qvel"]) == 7
        assert len(item["tactiles"]["left_ee"]) == 33
        assert item["states"]["left_arm"]["qpos"] == original[i]["states"]["left_arm"]["qpos"]
        assert item["colors"] == original[i]["colors"]
    made = np.array([i["actions"]["left_ee"]["qpos"] for i in back])
    written = np.array([i["actions"]["left_ee"]["qpos"] for i in original])
    assert np.abs(made - written).max() < 0.1
    code, _ = dexkit("export", tmp_path / "m.mcap", "--to", "lerobot", "--out", tmp_path / "d")
    assert code == 1  # without its pictures, which are missing


def test_an_episode_of_another_session_is_refused(tmp_path: Path) -> None:
    folder, _ = beside(tmp_path / "e", "dex1_pick_place", rate=28)
    for other, why in (
        ("dex1_legacy_v1_1", "not found in the recording with certainty"),
        ("dex1_idle_then_startle", "not found in the recording with certainty"),
        ("dex3_pinch", "no commands of a hand"),
    ):
        code, output = dexkit("import", folder, tmp_path / "m.mcap", "--wire", sample_path(other))
        assert code == 2
        assert why in output
        assert not (tmp_path / "m.mcap").exists()


def test_episode_without_motion_is_refused(tmp_path: Path, pick: Path) -> None:
    folder, _ = beside(tmp_path / "e", "dex1_pick_place", rate=28)
    found = json.loads((folder / "data.json").read_text())
    for item in found["data"]:
        for side in ("left", "right"):
            item["actions"][f"{side}_ee"]["qpos"] = [2.7]
    (folder / "data.json").write_text(streamed(found))
    code, output = dexkit("import", folder, tmp_path / "m.mcap", "--wire", pick)
    assert (code, "no joint moves" in output) == (2, True)


def test_record_merges_episodes_written_meanwhile(
    tmp_path: Path, pick: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    out.write_bytes(pick.read_bytes())
    folder = tmp_path / "task"
    assert _episodes(folder) == {}
    assert not _merge_episodes(out, folder, {}, False)
    assert "no episode was written" in capsys.readouterr().err
    old, _ = beside(folder / "episode_0000", "dex1_legacy_v1_1", rate=28)
    before = _episodes(folder)
    assert set(before) == {old}
    beside(folder / "episode_0001", "dex1_pick_place", rate=28)
    beside(folder / "episode_0002", "dex1_pick_place", rate=25, seconds=4.0, end=False)
    assert _merge_episodes(out, folder, before, False)
    made = sorted(p.name for p in tmp_path.glob("out_*.mcap"))
    assert made == ["out_episode_0001.mcap", "out_episode_0002.mcap"]
    (old / "data.json").write_text((old / "data.json").read_text() + "\n")  # it has changed
    assert not _merge_episodes(out, folder, before, True)
    assert "episode_0000: not merged" in capsys.readouterr().err
