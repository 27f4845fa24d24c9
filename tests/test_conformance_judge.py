"""Test verdicts on recordings: genuine, damaged and incomplete ones."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dexkit.conformance.checks import REGISTRY
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.result_file import as_document, read_json, write_json
from dexkit.conformance.kit.results import Overall, RunResult, Verdict
from dexkit.conformance.kit.stimulus_record import RECORD, Phase, Stimulus
from dexkit.conformance.virtual import MemoryTrace
from dexkit.errors import ConformanceError, TraceUnsupported, UsageError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.traces import Recorder, open_trace, sample_labels, sample_path
from tests.conformance_helpers import copy_of, failed, result_of, short_run
from tests.each import each

STATE = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
CMD = ("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")


def judged(trace: MemoryTrace) -> RunResult:
    return judge(Recording.decode(trace))


@each("sent", [(Side.LEFT,), ()])
def test_second_type_on_command_topic_is_noted_unless_kit_sent_it(
    tmp_path: Path, sent: tuple[Side, ...]
) -> None:
    path = tmp_path / "two.mcap"
    stimulus = Stimulus(phases=[Phase("foreign", sent, 1)] if sent else [])
    with Recorder(path) as recorder:
        recorder.add_metadata(RECORD, stimulus.to_metadata())
        for kind in (CMD[1], "unitree_hg::msg::dds_::HandCmd_"):
            message = message_type(kind)
            recorder.put(CMD[0], kind, message.encode(message.cls()), log_time_ns=1)
    notes = Recording.decode(open_trace(path), dialect_name="unitree_go", sides=(Side.LEFT,)).notes
    assert any("carries 2 types" in note for note in notes) is not bool(sent)


# ------------------------------------------------------------------------- genuine recordings


def test_long_recordings_are_judged_as_short_ones_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is held of a long recording changes no result: few rows, small compressed tables."""
    path = sample_path("dex3_pinch")
    results = judge(Recording.decode(open_trace(path))).results
    monkeypatch.setattr("dexkit.conformance.checks.KEPT_ROWS", 1)
    monkeypatch.setattr("dexkit.messages.packed._SEGMENT", 1000)
    monkeypatch.setattr("dexkit.messages.packed._SEALED", 100)
    recording = Recording.decode(open_trace(path))
    assert judge(recording).results == results
    for view in recording.sides.values():
        assert not view.known
        assert view.states.ddq.strides[0] == 0  # 0 throughout


def test_dropout_is_found_at_its_time() -> None:
    result = judge(Recording.decode(open_trace(sample_path("dex1_hand_dropout"))))
    assert result.overall is Overall.FAIL
    assert failed(result) == {("DEX1-RATE-03", "left")}
    gap = result_of(result, "DEX1-RATE-03").evidence[0]
    stops, resumes = (
        e.seconds_from_first_message for e in sample_labels("dex1_hand_dropout").events
    )
    assert gap.topic == "rt/dex1/left/state"
    assert gap.time_s == pytest.approx(stops, abs=0.01)
    assert gap.end_s == pytest.approx(resumes, abs=0.01)


def test_wrong_dialect_fails_topic_requirements() -> None:
    trace = open_trace(sample_path("dex1_pick_place"))
    result = judge(Recording.decode(trace, dialect_name="unitree_hg"))
    assert failed(result) == {("DEX1-TOPIC-01", "left"), ("DEX1-TOPIC-01", "right")}
    assert result_of(result, "DEX1-RATE-01").verdict is Verdict.BLOCKED
    assert result.stage["left"] == "topic seen"
    with pytest.raises(ConformanceError, match="unitree_actuator"):
        Recording.decode(trace, dialect_name="unitree_actuator")


# ----------------------------------------------------------------------------- too little


def test_requested_side_without_data_fails() -> None:
    trace = copy_of(short_run())
    result = judge(Recording.decode(trace, sides=(Side.LEFT, Side.RIGHT)))
    assert failed(result) == {("DEX1-TOPIC-01", "right"), ("DEX1-TOPIC-02", "right")}
    assert result.stage == {"left": "moving", "right": "participant seen"}


def test_endpoints_are_not_judged_without_discovery_data() -> None:
    trace = copy_of(short_run())
    trace.endpoints.clear()
    result = judged(trace)
    for requirement in ("DEX1-TOPIC-02", "DEX1-QOS-01"):
        assert result_of(result, requirement).verdict is Verdict.NOT_APPLICABLE
    assert result.overall is Overall.PASS


def test_recording_without_commands_is_judged_by_its_states() -> None:
    trace = copy_of(short_run())
    trace.metadata.clear()
    del trace.rows[CMD]
    result = judged(trace)
    assert result.overall is Overall.PASS
    assert result_of(result, "DEX1-START-01").reason == "no commands to this hand in the recording"
    assert result_of(result, "DEX1-MOVE-02").reason.startswith("needs the stimulus 'step'")


def test_empty_topic_does_not_pass() -> None:
    trace = copy_of(short_run())
    trace.metadata.clear()
    trace.rows.clear()
    result = judged(trace)
    assert failed(result) == {("DEX1-TOPIC-01", "left")}


def test_run_without_judged_requirement_is_inconclusive() -> None:
    recording = Recording.decode(copy_of(short_run()))
    only = select(catalogue(), prefixes=["DEX1-LIFE-01"])
    result = judge(recording, requirements=only)
    assert result.judged == 0
    assert result.overall is Overall.INCONCLUSIVE
    assert result.overall.exit_code == 2
    assert "nothing can be said" in result.sentence()


def test_start_up_is_not_judged_in_recording_that_begins_late() -> None:
    trace = copy_of(short_run())
    trace.metadata.clear()
    first_command = trace.rows[CMD][0][0]
    trace.rows[STATE] = [r for r in trace.rows[STATE] if r[0] > first_command]
    assert result_of(judged(trace), "DEX1-START-01").verdict is Verdict.NOT_APPLICABLE


def test_reception_times_are_judged_without_source_timestamps() -> None:
    trace = copy_of(short_run())
    trace.rows[STATE] = [(log, 0, data) for log, _, data in trace.rows[STATE]]
    result = judged(trace)
    assert result_of(result, "DEX1-ORDER-01").verdict is Verdict.NOT_APPLICABLE
    assert result_of(result, "DEX1-RATE-01").verdict is Verdict.PASS


# ------------------------------------------------------------------------ whose fault is it


def test_state_that_never_returns_is_a_gap() -> None:
    trace = copy_of(short_run())
    trace.metadata.clear()  # no phase without commands that has a separate requirement
    rows = trace.rows[STATE]
    trace.rows[STATE] = rows[: len(rows) // 2]
    assert ("DEX1-RATE-03", "left") in failed(judged(trace))


def test_end_of_state_blocks_later_requirements() -> None:
    trace = copy_of(short_run())
    trace.rows[STATE] = trace.rows[STATE][: len(trace.rows[STATE]) // 2]
    found = [r for r in judged(trace).results if r.verdict is Verdict.FAIL]
    assert "DEX1-WDOG-02" in [r.requirement.id for r in found]
    assert all("fell silent for good" in r.cause for r in found), found
    early = copy_of(short_run())
    del early.rows[STATE][1000:1100]  # a gap, then state goes on
    assert "silent for good" not in result_of(judged(early), "DEX1-RATE-03").cause


def test_exception_in_check_is_verdict_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(context: object) -> None:
        raise ZeroDivisionError("1/0")

    monkeypatch.setitem(REGISTRY, "DEX1-TOPIC-01", broken)
    result = judged(short_run())
    assert result_of(result, "DEX1-TOPIC-01").verdict is Verdict.ERROR
    assert "ZeroDivisionError: 1/0" in result_of(result, "DEX1-TOPIC-01").reason
    assert result_of(result, "DEX1-RATE-01").reason == "blocked by DEX1-TOPIC-01"
    assert result.overall is Overall.INCONCLUSIVE


# --------------------------------------------------------------------------------- hostile


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32), share=st.sampled_from([0.001, 0.05, 1.0]))
def test_damaged_samples_raise_no_exception_in_checks(seed: int, share: float) -> None:
    """Any bytes give a verdict, never an error of the kit."""
    random_ = random.Random(seed)
    trace = copy_of(short_run())
    for key, rows in trace.rows.items():
        trace.rows[key] = [
            (log, sent, damage(random_, data) if random_.random() < share else data)
            for log, sent, data in rows[:: random_.choice([3, 7, 50, 400])]
        ]
    result = judged(trace)
    assert Verdict.ERROR not in {r.verdict for r in result.results}


def damage(random_: random.Random, data: bytes) -> bytes:
    kind = random_.randrange(4)
    if kind == 0:
        return data[: random_.randrange(len(data))]
    if kind == 1:
        return data + random_.randbytes(random_.randrange(1, 40))
    changed = bytearray(data)
    for _ in range(random_.randrange(1, 8)):
        changed[random_.randrange(len(changed))] = random_.randrange(256)
    return bytes(changed) if kind == 2 else random_.randbytes(len(data))


# ------------------------------------------------------------------------- result and record


def test_result_file_is_read_back_unchanged(tmp_path: Path) -> None:
    result = judge(Recording.decode(open_trace(sample_path("dex1_hand_dropout"))))
    path = tmp_path / "r.json"
    write_json(result, path)
    again = read_json(path)
    assert as_document(again) == as_document(result)
    data = json.loads(path.read_text())
    assert (data["overall"], data["counts"]["fail"]) == ("fail", 1)
    path.write_text(json.dumps({**data, "version": 99}))
    with pytest.raises(UsageError, match="version 99"):
        read_json(path)
    path.write_text("[]")
    with pytest.raises(UsageError, match="not a result file"):
        read_json(path)


def test_stimulus_record_is_read_back_and_refuses_unknown_versions() -> None:
    record = short_run().metadata[RECORD]
    assert Stimulus.from_metadata(record).to_metadata() == record
    with pytest.raises(TraceUnsupported, match="version"):
        Stimulus.from_metadata({**record, "version": "2"})
    with pytest.raises(TraceUnsupported, match="damaged"):
        Stimulus.from_metadata({**record, "phases": "[{}]"})
