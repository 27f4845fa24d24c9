"""A hand that failed to start: valid states at full rate in which every number is 0."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexkit.cli import main
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.results import Overall, RunResult, Verdict
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import DIALECTS, Dialect, dialect
from dexkit.traces import Recorder, open_trace, sample_path
from tests.conformance_helpers import result_of
from tests.each import each

T0 = 1_790_000_000_000_000_000
OWN_TOPICS = [n for n, d in DIALECTS.items() if d.topics(Side.LEFT) != d.topics(Side.RIGHT)]


def zeros(spoken: Dialect) -> bytes:
    """A state of ``spoken`` in which every number is 0."""
    kind = message_type(spoken.state_type)
    return kind.encode(kind.of_motors([kind.motor_type.cls() for _ in range(spoken.length)]))


def dead(path: Path, spoken: Dialect, sides: tuple[Side, ...] = (Side.LEFT,)) -> Path:
    with Recorder(path) as recorder:
        for i in range(1500):
            t = T0 + i * 2_000_000
            for side in sides:
                topic, type_name = spoken.topics(side)[1], spoken.state_type
                recorder.put(topic, type_name, zeros(spoken), log_time_ns=t, publish_time_ns=t)
    return path


def judged(path: Path) -> RunResult:
    return judge(recording_of(open_trace(path), None, ()))


@each("name", OWN_TOPICS)
def test_a_hand_that_says_nothing_does_not_pass(name: str, tmp_path: Path) -> None:
    result = judged(dead(tmp_path / "dead.mcap", dialect(name)))
    starts = [r for r in result.results if r.requirement.id.endswith("-START-01")]
    fails = any(r.verdict is Verdict.FAIL for r in starts)
    assert result.overall is (Overall.FAIL if fails else Overall.INCONCLUSIVE)
    assert result.exit_code() != 0
    assert any("every number in every state is 0" in r.reason for r in result.results)


def test_a_dead_dex3_beside_a_live_one_is_a_failure(tmp_path: Path) -> None:
    """Its own topic is no place that a service of one hand has to fill."""
    path = tmp_path / "one_dead.mcap"
    hg = dialect("dex3")
    with Recorder(path) as recorder:
        for message in open_trace(sample_path("dex3_pinch")).messages():
            data, topic = message.data, message.topic
            if topic.startswith("rt/lf") or topic == hg.topics(Side.RIGHT)[0]:
                continue
            if topic == hg.topics(Side.RIGHT)[1]:
                data = zeros(hg)
            stamps = {
                "log_time_ns": message.log_time_ns,
                "publish_time_ns": message.publish_time_ns,
            }
            recorder.put(topic, message.type_name, data, **stamps)
    result = judged(path)
    assert result_of(result, "DEX3-START-01", Side.RIGHT).verdict is Verdict.FAIL
    assert "is it powered" in result_of(result, "DEX3-START-01", Side.RIGHT).cause
    assert result_of(result, "DEX3-RATE-01", Side.RIGHT).verdict is Verdict.BLOCKED
    assert result_of(result, "DEX3-TRACK-01", Side.LEFT).verdict is Verdict.PASS
    assert not any("service of one hand" in note for note in result.notes)


def test_check_and_audit_do_not_pass_it(tmp_path: Path) -> None:
    path = dead(tmp_path / "dead.mcap", dialect("dex3"), tuple(Side))
    for arguments in (["check", path], ["audit", path, "--out", tmp_path / "audit"]):
        with pytest.raises(SystemExit) as end:
            main(list(map(str, arguments)))
        assert end.value.code == 1, arguments
