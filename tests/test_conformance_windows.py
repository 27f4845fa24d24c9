"""Requirements that are judged in sliding windows, over the whole recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.kit.stimulus_record import RECORD, Phase, Stimulus
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.hand import Side
from dexkit.models import dialect

ORIGIN = 1_700_000_000_000_000_000


def _recorded(
    sent: Sequence[float], received: Sequence[float] | None = None, *, kit: bool = False
) -> MemoryTrace:
    """A recording of states that were sent and received at these times, s.

    :param kit: with the record of a stimulus, as a run of the kit has.
    """
    go = dialect("unitree_go")
    payload = MotorCodec(go).state_payload({Side.LEFT: [{"q": 1.0}]})
    trace = MemoryTrace()
    times = np.array([sent, sent if received is None else received])
    for at, arrived in (ORIGIN + np.round(times * 1e9).astype(np.int64)).T.tolist():
        trace.put(go.topics(Side.LEFT)[1], go.state_type, arrived, at, payload)
    if kit:
        phase = Phase("listen", (Side.LEFT,), ORIGIN, ORIGIN + 10**9)
        trace.metadata[RECORD] = Stimulus(phases=[phase]).to_metadata()
    return trace


def _result(trace: MemoryTrace, requirement: str) -> Result:
    every = judge(recording_of(trace, "unitree_go", (Side.LEFT,))).results
    return next(r for r in every if r.requirement.id == requirement)


def _at(rate: float, begin: float, end: float) -> list[float]:
    return np.arange(begin, end, 1 / rate).tolist()


def test_rate_that_falls_for_the_second_half_fails_with_the_second_in_which_it_began() -> None:
    result = _result(_recorded(_at(500, 0, 10) + _at(60, 10, 20)), "DEX1-RATE-01")
    assert result.verdict is Verdict.FAIL
    assert result.values["rate_hz"] == pytest.approx(60, abs=1)
    assert result.evidence[0].time_s == pytest.approx(10.0, abs=0.02)
    assert "60.0 Hz from 10.00 s" in result.observed


def test_one_late_state_does_not_fail_the_rate() -> None:
    times = _at(210, 0, 5) + _at(210, 5.09, 10)
    # the original is quicker
    assert _result(_recorded(times), "DEX1-RATE-01").verdict is Verdict.WARN


def test_states_that_arrive_late_are_a_gap_in_a_run_of_the_kit_alone() -> None:
    sent = np.array(_at(500, 0, 6))
    received = np.where((sent > 3.0) & (sent < 3.3), 3.3, sent)
    late = _recorded(sent.tolist(), received.tolist(), kit=True)
    result = _result(late, "DEX1-RATE-03")
    assert result.verdict is Verdict.FAIL
    assert result.evidence[0].time_s == pytest.approx(3.0, abs=0.01)
    # another recorder may have been late itself
    offline = _recorded(sent.tolist(), received.tolist())
    assert _result(offline, "DEX1-RATE-03").verdict is Verdict.PASS


def test_long_bursts_fail_in_a_run_of_the_kit_although_their_stamps_are_good() -> None:
    sent = np.array(_at(500, 0, 6))
    received = np.where((sent > 2.0) & (sent < 4.0), np.ceil(sent / 0.08) * 0.08, sent)
    result = _result(_recorded(sent.tolist(), received.tolist(), kit=True), "DEX1-RATE-03")
    assert result.verdict is Verdict.FAIL
    assert result.evidence[0].time_s == pytest.approx(2.0, abs=0.1)
    assert result.values["intervals"] == pytest.approx(12, abs=1)
    # another recorder may have been late itself
    offline = _recorded(sent.tolist(), received.tolist())
    assert _result(offline, "DEX1-RATE-03").verdict is Verdict.PASS


def test_four_long_intervals_in_a_second_are_no_bursts() -> None:
    times = np.array(_at(500, 0, 6))
    for begin in (2.0, 2.2, 2.4, 2.6):
        times = times[(times < begin) | (times > begin + 0.06)]
    result = _result(_recorded(times.tolist()), "DEX1-RATE-03")
    assert (result.verdict, result.values["intervals"]) == (Verdict.PASS, 4)
