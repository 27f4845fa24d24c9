"""Verdicts and figures of the genuine recording of xr_teleoperate v1.1.

The figures are taken here with mcap, struct and numpy alone, not with the kit's decoder.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Overall, RunResult, Verdict
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


@dataclass(frozen=True)
class Session:
    """Times in seconds; motors of shape (messages, 2, fields)."""

    t: NDArray[np.float64]
    states: NDArray[np.float64]
    t_cmd: NDArray[np.float64]
    commands: NDArray[np.float64]


@cache
def session() -> Session:
    times: dict[str, list[int]] = {ACTUATOR.state_topic: [], ACTUATOR.cmd_topic: []}
    rows: dict[str, list[list[tuple[float, ...]]]] = {topic: [] for topic in times}
    with sample_path("dex1_legacy_v1_1").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            motor = STATE if channel.topic == ACTUATOR.state_topic else COMMAND
            assert len(message.data) == HEADER + 2 * motor.size
            times[channel.topic].append(message.publish_time)
            rows[channel.topic].append(
                [motor.unpack_from(message.data, HEADER + i * motor.size) for i in range(2)]
            )
    state, cmd = ACTUATOR.state_topic, ACTUATOR.cmd_topic
    return Session(
        np.array(times[state]) / 1e9,
        np.array(rows[state]),
        np.array(times[cmd]) / 1e9,
        np.array(rows[cmd]),
    )


@cache
def verdicts() -> RunResult:
    return judge(Recording.decode(open_trace(sample_path("dex1_legacy_v1_1"))))


def test_figures_equal_those_computed_from_the_messages() -> None:
    s, result = session(), verdicts()
    gaps = np.diff(s.t)

    def figure(name: str, side: Side) -> float:
        text = result_of(result, name, side).figure
        return float(next(word for word in text.split() if word.replace(".", "").isdigit()))

    for side, index in INDEX.items():
        q, dq, tau = (s.states[:, index, i] for i in (1, 2, 4))
        wanted = np.interp(s.t, s.t_cmd, s.commands[:, index, 1])
        assert figure("DEX1-START-01", side) == pytest.approx(s.t_cmd[0] - s.t[0], abs=0.005)
        assert figure("DEX1-START-02", side) == pytest.approx(q[0], abs=0.005)
        assert figure("DEX1-RATE-01", side) == pytest.approx(1 / gaps.mean(), abs=0.06)
        assert figure("DEX1-RATE-03", side) == pytest.approx(1e3 * gaps.max(), abs=0.06)
        assert (
            result_of(result, "DEX1-FIELD-03", side).figure == f"{q.min():.2f} .. {q.max():.2f} rad"
        )
        assert figure("DEX1-FORCE-04", side) == pytest.approx(np.abs(tau).max(), abs=0.006)
        blocked = (np.abs(dq) < 0.02) & (np.abs(q - wanted) > 0.1)
        driven = (s.t > s.t_cmd[0] + 0.3) & (s.t < s.t_cmd[-1]) & ~blocked
        rms, delay = min(
            (
                np.sqrt(
                    np.mean((q - np.interp(s.t - d, s.t_cmd, s.commands[:, index, 1]))[driven] ** 2)
                ),
                d,
            )
            for d in np.arange(0.0, 0.1, 0.0025)
        )
        assert figure("DEX1-TRACK-01", side) == pytest.approx(rms, abs=0.004)
        assert figure("DEX1-TRACK-02", side) == pytest.approx(1e3 * delay, abs=5)


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
