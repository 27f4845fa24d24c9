"""Playback of a recording: times, gaps, loops, pauses."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.errors import UsageError
from dexkit.traces import Player, TraceMessage, open_trace, sample_path
from tests.each import each
from tests.trace_helpers import CMD, STATE, T0, Row, cmd, mcap_bytes, rows, write

RIGHT = "rt/dex1/right/cmd"


def trace_of(tmp_path: Path, times_ms: list[float]) -> Path:
    written: list[Row] = [(CMD, T0 + round(t * 1e6), 0, cmd(t)) for t in times_ms]
    return write(tmp_path / "a.mcap", mcap_bytes(written))


class Log:
    """Notes when each message was published, on a clock."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.rows: list[tuple[float, TraceMessage]] = []

    def __call__(self, message: TraceMessage) -> None:
        self.rows.append((self.clock.now(), message))

    @property
    def times(self) -> list[float]:
        return [t for t, _ in self.rows]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    times=st.lists(st.integers(0, 20_000), min_size=1, max_size=30).map(sorted),
    speed=st.sampled_from([0.25, 1.0, 2.0, 7.5]),
)
def test_player_sends_every_message_at_its_exact_time(
    tmp_path: Path, times: list[int], speed: float
) -> None:
    clock = ManualClock(100.0)
    log = Log(clock)
    player = Player(open_trace(trace_of(tmp_path, [float(t) for t in times])), speed=speed)
    stats = player.play(log, clock)
    assert log.times == pytest.approx(
        [100.0 + (t - times[0]) / 1000 / speed for t in times], abs=1e-9
    )
    assert (stats.sent, stats.passes, stats.stopped) == (len(times), 1, False)
    assert stats.error_max == 0
    assert stats.duration == pytest.approx(player.duration)


def test_a_slow_publish_delays_no_later_message(tmp_path: Path) -> None:
    clock = ManualClock()
    log = Log(clock)

    def publish(message: TraceMessage) -> None:
        log(message)
        if len(log.rows) == 3:
            clock.advance(0.025)

    stats = Player(open_trace(trace_of(tmp_path, [i * 10.0 for i in range(10)]))).play(
        publish, clock
    )
    # the two that were due meanwhile go out at once, the rest at their own times
    expected = [0.0, 0.01, 0.02, 0.045, 0.045, 0.05, 0.06, 0.07, 0.08, 0.09]
    assert log.times == pytest.approx(expected)
    assert stats.error_max == pytest.approx(0.015)


def test_long_gaps_are_kept_or_capped(tmp_path: Path) -> None:
    path = trace_of(tmp_path, [0, 10, 5010, 5020])
    for cap, expected in ((None, [0, 0.01, 5.01, 5.02]), (1.0, [0, 0.01, 1.01, 1.02])):
        log = Log(ManualClock())
        Player(open_trace(path), max_gap=cap).play(log, log.clock)
        assert log.times == pytest.approx(expected)


def test_loops_follow_each_other_at_the_recorded_pace(tmp_path: Path) -> None:
    log = Log(ManualClock())
    stop = threading.Event()

    def publish(message: TraceMessage) -> None:
        log(message)
        if len(log.rows) == 7:
            stop.set()

    player = Player(open_trace(trace_of(tmp_path, [0, 10, 20])), loop=True)
    stats = player.play(publish, log.clock, stop)
    assert log.times == pytest.approx([0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06])
    assert (stats.sent, stats.passes, stats.stopped) == (7, 2, True)


def test_commands_are_played_by_default_and_topics_can_be_chosen() -> None:
    trace = open_trace(sample_path("dex1_pick_place"))
    player = Player(trace)
    assert sorted(player.topics) == [CMD, RIGHT]
    assert len(player) == 8052
    assert player.duration == pytest.approx(20.54, abs=0.01)
    log = Log(ManualClock())
    player.play(log, log.clock)
    expected = list(trace.messages([CMD, RIGHT]))
    assert [m for _, m in log.rows] == expected
    assert sorted(Player(trace, ["/dex1/left/*"]).topics) == [CMD, STATE]
    assert list(Player(trace, ["dex1/right/cmd"]).topics) == [RIGHT]


def test_unplayable_sessions_are_refused(tmp_path: Path) -> None:
    trace = open_trace(trace_of(tmp_path, [0, 10]))
    for bad in ({"speed": 0.0}, {"speed": float("inf")}, {"speed": -1.0}, {"max_gap": 0.0}):
        with pytest.raises(UsageError):
            Player(trace, **bad)  # type: ignore[arg-type]
    with pytest.raises(UsageError) as caught:
        Player(trace, ["/nope"])
    assert CMD in caught.value.hint
    states = write(tmp_path / "b.mcap", mcap_bytes([r for r in rows() if r[0] == STATE]))
    with pytest.raises(UsageError, match="no command topics"):
        Player(open_trace(states))


@each("suspended", [False, True], ids=["stopped", "suspended"])
@each("at", ["while sending", "in a gap"])
def test_messages_due_during_a_pause_are_not_sent_in_a_burst(
    tmp_path: Path, suspended: bool, at: str
) -> None:
    clock = ManualClock()
    log = Log(clock)
    told: list[float] = []

    def stand_still() -> None:
        (clock.suspend if suspended else clock.advance)(3.0)

    class Gap(ManualClock):
        stood = False

        def sleep_until(self, deadline: float) -> None:
            super().sleep_until(deadline)
            if at == "in a gap" and not self.stood and self.now() > 0.5:
                self.stood = True
                stand_still()

    clock = log.clock = Gap()

    def publish(message: TraceMessage) -> None:
        log(message)
        if at == "while sending" and len(log.rows) == 3:
            stand_still()

    times_ms = [0.0, 10.0, 20.0, *(1000.0 + 10 * i for i in range(400))]
    stats = Player(open_trace(trace_of(tmp_path, times_ms))).play(
        publish, clock, paused=told.append
    )
    assert told == [pytest.approx(3.0, abs=0.03)]
    assert (stats.sent, stats.pauses) == (len(times_ms), 1)
    recorded = np.diff(times_ms) / 1e3
    gaps = np.diff(log.times)
    if not suspended:
        recorded[2] += 3.0
    assert gaps == pytest.approx(recorded, abs=0.05)  # the nap that was interrupted
    assert np.delete(gaps, 2) == pytest.approx(np.delete(recorded, 2), abs=1e-6)
    assert stats.error_max < 1e-6
