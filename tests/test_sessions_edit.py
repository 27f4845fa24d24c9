"""Recordings are cut, merged and compared: ``dexkit cut``, ``dexkit merge``, ``dexkit diff``."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.cli import cli
from dexkit.conformance.kit.stimulus_record import RECORD, Phase, Stimulus
from dexkit.errors import DexkitError, TraceError, UsageError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.traces import Recorder, open_trace, sample_path
from dexkit.traces.names import CUT
from dexkit.traces.sessions.compare import compare
from dexkit.traces.sessions.edit import Span, clock_offset, cut, merge
from dexkit.traces.sessions.streams import COMMAND
from dexkit.traces.writer import RecordingWriter, definition
from tests.session_helpers import document, episode, streamed
from tests.trace_helpers import (
    CMD,
    CMD_TYPE,
    STATE,
    STATE_TYPE,
    T0,
    cmd,
    mcap_bytes,
    rows,
    state,
    write,
)

PICK = sample_path("dex1_pick_place")


def messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    return [
        (m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in open_trace(path).messages()
    ]


def dexkit(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)
    if isinstance(result.exception, DexkitError):
        return result.exception.exit_code, result.exception.message
    assert result.exception is None, result.exception
    return int(result.return_value or 0), result.output


def test_a_cut_has_the_messages_of_its_times_unchanged(tmp_path: Path) -> None:
    whole = messages(PICK)
    begin, end = T0 + 3 * 10**9, T0 + 5 * 10**9
    written = cut(open_trace(PICK), tmp_path / "a.mcap", spans=[Span(begin, end)], topics=["*/cmd"])
    expected = [m for m in whole if begin <= m[1] < end and m[0].endswith("/cmd")]
    assert written == len(expected) > 500
    assert messages(tmp_path / "a.mcap") == expected
    part = open_trace(tmp_path / "a.mcap")
    assert not part.warnings
    assert part.metadata["provenance"] == open_trace(PICK).metadata["provenance"]
    assert part.metadata[CUT]["spans"] == f"{begin} {end}"
    assert {c.schema_encoding for c in part.channels} == {"omgidl"}


@settings(max_examples=8, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=0, max_size=4, unique=True))
def test_pieces_of_a_recording_merge_to_the_recording(
    tmp_path_factory: pytest.TempPathFactory, places: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("pieces")
    source = write(folder / "source.mcap", mcap_bytes(rows(60)))
    ends = [T0 - 1, *(T0 + p * 2_000_000 for p in sorted(places)), T0 + 10**10]
    parts = []
    for i, (begin, end) in enumerate(itertools.pairwise(ends)):
        trace = open_trace(source)
        if any(begin <= m.log_time_ns < end for m in trace.messages()):
            parts.append(folder / f"{i}.mcap")
            # each piece overlaps with the one before it
            cut(trace, parts[-1], spans=[Span(begin - 5_000_000, end)])
    done = merge([open_trace(p) for p in parts], folder / "merged.mcap")
    assert sorted(messages(folder / "merged.mcap")) == sorted(messages(source))
    assert done.written == len(messages(source))


def test_a_phase_is_cut_with_its_record(tmp_path: Path) -> None:
    source = tmp_path / "run.mcap"
    phases = [
        Phase(name, (Side.LEFT,), T0 + i * 40_000_000, T0 + (i + 1) * 40_000_000)
        for i, name in enumerate(["listen", "step", "silence"])
    ]
    with Recorder(source) as recorder:
        recorder.add_metadata(RECORD, Stimulus(phases=phases).to_metadata())
        for topic, log, publish, data in rows(60):
            recorder.put(topic, STATE_TYPE if topic == STATE else CMD_TYPE, data, log, publish)
    assert dexkit("cut", source, tmp_path / "step.mcap", "--phase", "step")[0] == 0
    part = open_trace(tmp_path / "step.mcap")
    assert [p.name for p in Stimulus.from_metadata(part.metadata[RECORD]).phases] == ["step"]
    assert phases[1].begin_ns <= part.first_ns
    assert part.last_ns < phases[1].end_ns
    assert "messages" not in part.metadata["dexkit_recorder"]
    code, text = dexkit("cut", source, tmp_path / "x.mcap", "--phase", "walk")
    assert (code, text) == (2, "run.mcap has no phase walk")


def test_failed_cut_leaves_no_file(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    for arguments in (
        ["--window", "1000:"],
        ["--topic", "rt/nothing"],
        ["--phase", "step"],
        ["--window", "3:3"],
    ):
        code, _ = dexkit("cut", PICK, out, *arguments)
        assert code == 2
        assert not out.exists()
    kept = write(out, b"something else")
    assert dexkit("cut", PICK, out)[0] == 2
    assert dexkit("cut", PICK, out, "--overwrite", "--window", "1000:")[0] == 2
    assert kept.read_bytes() == b"something else"
    assert dexkit("cut", PICK, out, "--overwrite", "--window", ":1")[0] == 0
    assert dexkit("cut", out, out, "--overwrite")[0] == 2


def test_clocks_of_two_recorders_are_compared_by_common_messages(tmp_path: Path) -> None:
    a = write(tmp_path / "a.mcap", mcap_bytes(rows(60)))
    late = [(t, log + 250_000_000, sent, data) for t, log, sent, data in rows(60)]
    b = write(tmp_path / "b.mcap", mcap_bytes(late))
    assert clock_offset(open_trace(a), open_trace(b)) == pytest.approx(0.25)
    code, text = dexkit("merge", "--align", a, b, tmp_path / "out.mcap")
    assert (code, "90 duplicates" in text) == (0, True)
    assert messages(tmp_path / "out.mcap") == messages(a)
    assert dexkit("merge", a, b, tmp_path / "shifted.mcap", "--shift", f"{b}=-0.25")[0] == 0
    assert messages(tmp_path / "shifted.mcap") == messages(a)
    stranger = write(tmp_path / "c.mcap", mcap_bytes(rows(60, T0 + 1)))
    with pytest.raises(UsageError, match="0 messages in common"):
        clock_offset(open_trace(a), open_trace(stranger))


def test_recordings_of_different_schemas_are_not_merged(tmp_path: Path) -> None:
    a = write(tmp_path / "a.mcap", mcap_bytes(rows(10)))
    b = write(tmp_path / "b.mcap", mcap_bytes(rows(10), encoding="omgidl"))
    with pytest.raises(TraceError, match="another schema"):
        merge([open_trace(a), open_trace(b)], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_two_runs_are_aligned_and_compared(tmp_path: Path) -> None:
    later, first = tmp_path / "later.mcap", tmp_path / "first.mcap"
    cut(open_trace(PICK), first, spans=[Span(T0 + 3 * 10**9, T0 + 12 * 10**9)])
    merge([open_trace(first)], later, shifts=[12.345])
    part = tmp_path / "part.mcap"
    whole = open_trace(later)
    cut(whole, part, spans=[Span(whole.first_ns + 2 * 10**9, whole.first_ns + 8 * 10**9)])
    found = compare(open_trace(first), open_trace(part))
    assert found.offset == pytest.approx(12.345, abs=2e-3)
    assert found.equal
    assert {j.joint for j in found.joints} == {"left_gripper", "right_gripper"}
    assert all(j.worst < 0.03 for j in found.joints)
    code, text = dexkit("diff", first, part, "--json")
    assert code == 0
    assert json.loads(text)["equal"] is True
    moved = compare(open_trace(first), open_trace(part), offset=12.0, tolerance=0.1)
    assert not moved.equal
    assert moved.joints[0].first_at is not None


def test_diff_finds_where_a_hand_moves_less(tmp_path: Path) -> None:
    def session(path: Path, stuck_after: float) -> Path:
        t = np.arange(0, 6, 0.01)
        q = 2 + 1.5 * np.sin(t + 0.4 * t**1.5)
        made = [(CMD, T0 + int(a * 1e9), T0, cmd(float(b))) for a, b in zip(t, q, strict=True)]
        for a, b in zip(t, q, strict=True):
            here = float(b if a < stuck_after else np.interp(stuck_after, t, q))
            made.append((STATE, T0 + int(a * 1e9) + 1000, T0, state(here)))
        return write(path, mcap_bytes(made))

    good = session(tmp_path / "good.mcap", 99)
    stuck = session(tmp_path / "stuck.mcap", 4.0)
    found = compare(open_trace(good), open_trace(stuck))
    command, measured = (next(j for j in found.joints if j.kind == k) for k in (COMMAND, "state"))
    assert command.worst < 0.01
    assert measured.first_at == pytest.approx(4.0, abs=0.1)
    assert dexkit("diff", good, stuck)[0] == 1
    only = tmp_path / "commands.mcap"
    cut(open_trace(good), only, topics=[CMD])
    code, text = dexkit("diff", good, only)
    assert code == 1
    assert f"only in A: {STATE}" in text


def test_sessions_without_a_common_motion_are_refused() -> None:
    for other, why in (
        ("dex1_hand_dropout", "not runs of one session"),
        ("dex3_pinch", "no joint moves in both"),
    ):
        code, text = dexkit("diff", PICK, sample_path(other))
        assert code == 2
        assert why in text


# -- times that say nothing of each other ---------------------------------------------------------


def stepped(path: Path, back: float = 1.0) -> Path:
    """The sample session, whose clock is set back in its middle."""
    trace = open_trace(PICK)
    middle = trace.first_ns + round(trace.duration / 2 * 1e9)
    with RecordingWriter(path) as writer:
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        for m in trace.messages():
            off = round(back * 1e9) if m.log_time_ns >= middle else 0
            number = numbers[m.topic, m.type_name]
            writer.put(number, m.data, m.log_time_ns - off, m.publish_time_ns - off)
    return path


def test_a_clock_that_steps_back_mixes_nothing(tmp_path: Path) -> None:
    """What puts messages in order of time refuses, and each stretch can be taken by itself."""
    path = stepped(tmp_path / "a.mcap")
    code, output = dexkit("info", path)
    assert "its clock steps back by 0.99" in output
    for command in (
        ("check", path),
        *(
            ("export", path, "--to", form, "--out", tmp_path / form)
            for form in ("lerobot", "episodes", "rosbag2", "csv", "parquet")
        ),
        ("merge", path, PICK, tmp_path / "m.mcap"),
        ("cut", path, tmp_path / "c.mcap"),
        ("import", path, tmp_path / "i.mcap"),
    ):
        code, output = dexkit(*command)
        assert (code, "steps back by 0.99" in output) == (2, True), (command[0], output)
    assert sorted(tmp_path.iterdir()) == [path]
    pieces = []
    for number in (1, 2):
        out = tmp_path / f"{number}.mcap"
        assert dexkit("cut", path, out, "--stretch", number)[0] == 0
        pieces.append(messages(out))
        assert not open_trace(out).clock_steps
    second = [(topic, log + 10**9, sent + 10**9, data) for topic, log, sent, data in pieces[1]]
    assert pieces[0] + second == messages(PICK)


def test_recordings_of_two_domains_are_not_one_hand(tmp_path: Path) -> None:
    for number in (1, 2):
        with RecordingWriter(tmp_path / f"{number}.mcap") as writer:
            d = definition(STATE, message_type(STATE_TYPE), {"dds.domain": str(number)})
            writer.put(writer.add_channel(d), state(0.1), T0 + number, T0 + number)
    code, output = dexkit("merge", *(tmp_path / f"{n}.mcap" for n in "123"))
    assert (code, "two robots" in output) == (2, True)
    assert not (tmp_path / "3.mcap").exists()


def test_sessions_with_nominal_times_are_merged_where_they_are_said_to_begin(
    tmp_path: Path,
) -> None:
    for name in "ab":
        source = episode(tmp_path / name, streamed(document(frames=10, cameras=0)))
        assert dexkit("import", source, tmp_path / f"{name}.mcap")[0] == 0
    files = tmp_path / "a.mcap", tmp_path / "b.mcap"
    code, output = dexkit("merge", *files, tmp_path / "m.mcap")
    assert (code, "nominal times" in output) == (2, True)
    code, output = dexkit("merge", *files, tmp_path / "m.mcap", "--shift", f"{files[1]}=100")
    assert code == 0, output
    assert open_trace(tmp_path / "m.mcap").duration > 100
