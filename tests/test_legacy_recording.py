"""The genuine recording of xr_teleoperate v1.1, as if its service had one gripper."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Overall, Verdict
from dexkit.hand import Side
from dexkit.models import dialect
from dexkit.traces import Recorder, open_trace, sample_path
from tests.conformance_helpers import result_of

ACTUATOR = dialect("unitree_actuator")
INDEX = {Side.RIGHT: 0, Side.LEFT: 1}  # docs/sources/unitree-dex.md#a1
# mode, padding, q dq ddq tau_est q_raw dq_raw ddq_raw, temperature, padding, lost, reserve[2]
STATE = struct.Struct("<B3x7fB3x3I")
# mode, padding, q dq tau kp kd, reserve[3]
COMMAND = struct.Struct("<B3x5f3I")
HEADER = 8  # bytes of encapsulation header and sequence length


def without(side: Side, path: Path, *, driven: bool) -> Path:
    """The session as of a service of one gripper, driven by a client of one or of both."""
    start = HEADER + INDEX[side] * STATE.size
    begin = HEADER + INDEX[side] * COMMAND.size
    with Recorder(path) as recorder:
        for message in open_trace(sample_path("dex1_legacy_v1_1")).messages():
            data = bytearray(message.data)
            if message.topic == ACTUATOR.state_topic:
                data[start : start + STATE.size] = bytes(STATE.size)
            elif not driven:
                data[begin : begin + COMMAND.size] = bytes(COMMAND.size)
            recorder.put(
                message.topic,
                message.type_name,
                bytes(data),
                log_time_ns=message.log_time_ns,
                publish_time_ns=message.publish_time_ns,
            )
    return path


@pytest.mark.parametrize("missing", list(Side))
def test_absent_gripper_of_a_one_gripper_service_is_not_judged(
    missing: Side, tmp_path: Path
) -> None:
    there = Side.LEFT if missing is Side.RIGHT else Side.RIGHT
    recording = Recording.decode(open_trace(without(missing, tmp_path / "one.mcap", driven=False)))
    assert recording.judged == (there,)
    assert any(f"says nothing of the {missing} hand" in note for note in recording.notes)
    result = judge(recording)
    assert result.overall is Overall.PASS
    assert result_of(result, "DEX1-TRACK-01", there).verdict is Verdict.PASS


def test_commanded_gripper_without_state_is_judged(tmp_path: Path) -> None:
    path = without(Side.LEFT, tmp_path / "dead.mcap", driven=True)
    result = judge(Recording.decode(open_trace(path)))
    assert result_of(result, "DEX1-TRACK-01", Side.LEFT).verdict is Verdict.FAIL
    assert result.overall is Overall.FAIL
    asked = Recording.decode(
        open_trace(without(Side.LEFT, tmp_path / "asked.mcap", driven=False)),
        sides=(Side.LEFT,),
    )
    assert asked.judged == (Side.LEFT,)
