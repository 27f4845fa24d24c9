"""What a recording cannot hold, by where it comes from, is not judged."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.provenance import TIMES, Provenance
from dexkit.conformance.kit.results import Verdict
from dexkit.models import MODELS
from dexkit.traces import open_trace, sample_path
from dexkit.traces.names import CUT, RECORDER
from dexkit.traces.writer import RecordingWriter
from tests.session_helpers import dexkit, document, episode, streamed

PINCH = sample_path("dex3_pinch")


def not_met(path: Path) -> dict[str, str]:
    """What a recording is blamed for: of the hands, and of their client."""
    result = judge(recording_of(open_trace(path), None, ()))
    blamed = (Verdict.FAIL, Verdict.WARN, Verdict.ERROR)
    every = [*result.results, *result.client]
    assert any(r.verdict is Verdict.PASS for r in every), "something is judged"
    return {r.requirement.id: r.observed for r in every if r.verdict in blamed}


@pytest.mark.parametrize("hand", MODELS)
@pytest.mark.parametrize("timed", [False, True])
def test_frames_are_not_blamed_for_what_they_do_not_have(
    tmp_path: Path, hand: str, timed: bool
) -> None:
    found = document(frames=150, hand=hand, cameras=0)
    for i, item in enumerate(found["data"]):
        item |= {"timestamp": 1.7e9 + i / 30} if timed else {}
    source = episode(tmp_path / "e", streamed(found))
    assert dexkit("import", source, tmp_path / "a.mcap", "--set", f"hand={hand}")[0] == 0
    assert not_met(tmp_path / "a.mcap") == {}


def rewritten(path: Path, rounded: int = 1, **metadata: dict[str, str]) -> Path:
    """Three seconds of the sample, without source times and discovery, as a bag has it."""
    trace = open_trace(PINCH)
    with RecordingWriter(path) as writer:
        numbers = {key: writer.add_channel(d) for key, d in trace.definitions.items()}
        for name, values in metadata.items():
            writer.add_metadata(name, values)
        for m in trace.messages():
            if m.log_time_ns < trace.first_ns + 3 * 10**9:
                at = m.log_time_ns // rounded * rounded
                writer.put(numbers[m.topic, m.type_name], m.data, at, at)
    return path


def test_times_of_reception_are_no_source_times(tmp_path: Path) -> None:
    """A clock of 1 ms gives two messages one time."""
    assert not_met(rewritten(tmp_path / "a.mcap", 10**6)) == {}


@pytest.mark.parametrize("topics", [["*/cmd"], ["rt/dex3/left/cmd", "rt/dex3/right/state"]])
def test_topics_that_were_not_asked_for_are_not_missing(tmp_path: Path, topics: list[str]) -> None:
    """Discovery names the writer of a topic that the recorder was not to store."""
    options = [word for topic in topics for word in ("--topic", topic)]
    code, output = dexkit("cut", PINCH, tmp_path / "a.mcap", "--window", ":3", *options)
    assert code == 0, output
    assert open_trace(tmp_path / "a.mcap").endpoints
    assert not_met(tmp_path / "a.mcap") == {}


def test_what_a_source_carries_is_in_its_records() -> None:
    records = {
        RECORDER: {"topics": "rt/dex3/*"},
        CUT: {"topics": "rt/dex3/left/cmd"},
        "dexkit_import": {"absent rt/a": "dq tau", "absent rt/b": "left.tau"},
    }
    found = Provenance.of(records)
    assert found.leaves_out("rt/dex3/left/state")
    assert not found.leaves_out("rt/dex3/left/cmd")
    assert not Provenance.of({CUT: {"topics": "all"}}).leaves_out("rt/dex3/left/state")
    assert "times of its messages and dq" in found.lacking("rt/a", (TIMES, "q", "dq"))
    assert not found.lacking("rt/b", ("q", "dq"))
    assert found.lacking("rt/b", ("tau",))
    assert not found.lacking("rt/c", (TIMES, "mode"))
