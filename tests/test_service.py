"""The threads of the service, with a scripted hand and a fake DDS node."""

from __future__ import annotations

import logging
import math
from itertools import pairwise

import pytest

from dexkit.clock import ManualClock
from dexkit.errors import (
    BackendBroken,
    DdsError,
    HandError,
    HandLost,
    UsageError,
)
from dexkit.hand import HandCommand, HandState, MotorError, Side
from dexkit.messages import encode, message_type, unitree_go
from dexkit.models import dialect
from dexkit.service import HandService, diagnose, limp
from tests.service_helpers import (
    FakeEndpoint,
    FakeNode,
    FakeWriter,
    ScriptedHand,
    deliver_until,
    wait_until,
)

CMD, STATE = dialect("unitree_go").topics(Side.LEFT)
STATES = message_type(dialect("unitree_go").state_type)
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


def cmd(q: float, **fields: float) -> bytes:
    return encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q, kp=5.0, kd=0.05, **fields)]))


def newest(node: FakeNode, topic: str = STATE) -> unitree_go.MotorState_:
    return states(node, topic)[0]


def states(node: FakeNode, topic: str = STATE) -> list[unitree_go.MotorState_]:
    wait_until(lambda: node.sent, what="the first state")
    data = next(data for t, data in reversed(node.sent) if t == topic)
    found: list[unitree_go.MotorState_] = STATES.decode(data).states
    return found


def serve(hand: ScriptedHand, node: FakeNode, **options: object) -> HandService:
    return HandService(hand, node=node, **options)  # type: ignore[arg-type]


def test_invalid_commands_are_counted_and_ignored() -> None:
    hand, node = ScriptedHand(), FakeNode()
    motor = unitree_go.MotorCmd_
    with serve(hand, node) as service:
        bad = [
            cmd(math.nan),
            cmd(math.inf),
            cmd(1.0, tau=math.nan),
            encode(unitree_go.MotorCmds_([])),
            b"\x00\x01\x00\x00\xff\xff\xff\xff",
            b"\x00\x01",
            encode(unitree_go.MotorCmds_([motor(q=2.0, kp=5.0), motor(q=5.0, kp=5.0)])),
            cmd(77.0),
        ]
        for data in bad:
            node.deliver(CMD, data)
        wait_until(lambda: service.counters.received == len(bad))
        wait_until(lambda: newest(node).q == pytest.approx(5.4))
        count, core = service.counters, service.cores[Side.LEFT].counters
    assert (count.short, count.overlong, count.undecodable) == (1, 1, 2)
    assert (core.accepted, core.rejected, core.clamped) == (2, 3, 1)


def test_commands_without_gains_are_counted_and_the_setting_is_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limp, "PERSISTENCE", 0.0)
    hand, node = ScriptedHand(), FakeNode()
    hand.zero_gains_hint = ", or set it"  # type: ignore[attr-defined]
    with caplog.at_level(logging.WARNING), serve(hand, node) as service:
        for number, q in enumerate((1.0, 2.0, 2.0)):
            node.deliver(CMD, encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q)])))
            wait_until(  # received comes before accepted
                lambda n=number: service.snapshot()["hands"]["left"]["accepted"] > n  # type: ignore[misc]
            )
        hands = service.snapshot()["hands"]["left"]
    assert (hands["accepted"], hands["zero_gains"]) == (3, 2)
    (said,) = [r.getMessage() for r in caplog.records if "stays limp" in r.getMessage()]
    assert "kp 5, kd 0.05), or set it" in said


def test_a_hand_may_adapt_the_commands_of_its_clients() -> None:
    hand, node = ScriptedHand(), FakeNode()
    hand.adapt_command = lambda c: HandCommand.position(c.q)  # type: ignore[attr-defined]
    with serve(hand, node) as service:
        deliver_until(
            node,
            CMD,
            encode(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=2.0)])),
            lambda: newest(node).q == pytest.approx(2.0),
        )
        assert service.snapshot()["hands"]["left"]["zero_gains"] == 0


def test_commands_without_gains_count_from_a_second_after_q_changed() -> None:
    watch = limp.LimpCommands(ScriptedHand().spec)

    def command(q: float, **gains: float) -> HandCommand:
        return HandCommand.position(q, **{"kp": 0.0, "kd": 0.0, **gains})

    def seen(*times_and_qs: tuple[float, float]) -> list[bool]:
        return [watch.update(command(q), now) for now, q in times_and_qs]

    assert seen((0.0, 1.0), (5.0, 1.0), (6.0, 1.05)) == [False] * 3, "q stays the same"
    assert seen((7.0, 2.0), (7.9, 3.0), (8.0, 2.0), (9.0, 2.0)) == [False, False, True, True]
    for gain in ("kp", "kd", "tau", "dq"):
        assert not watch.update(command(2.0, **{gain: 0.1}), 10.0)
        assert seen((11.0, 3.0), (11.5, 2.0), (12.4, 3.0)) == [False] * 3
        assert seen((12.5, 1.0)) == [True]
    assert not watch.update(HandCommand.brake(1), 13.0)
    assert not HandCommand.brake(1).is_limp


class TestLink:
    def test_unplugged_hand_is_reopened(self) -> None:
        hand, node = ScriptedHand(), FakeNode()
        with serve(hand, node) as service:
            deliver_until(node, CMD, cmd(2.0), lambda: node.sent and newest(node).q == 2.0)
            hand.plugged = False
            wait_until(lambda: newest(node).lost >= 2)
            lost = newest(node)
            assert (lost.q, lost.reserve[0]) == (2.0, LINK)
            assert not hand.is_open
            node.deliver(CMD, cmd(3.0))  # commanded while away: stale when it is back
            while not hand.commands.empty():
                hand.commands.get()
            hand.plugged = True
            wait_until(lambda: newest(node).lost == 0)
            assert newest(node).reserve[0] == 0
            seen = [hand.commands.get(timeout=60) for _ in range(20)]
            assert all(command.is_brake for command in seen)
            assert hand.q == 2.0
            deliver_until(node, CMD, cmd(4.0), lambda: newest(node).q == 4.0)
            counters = service.cores[Side.LEFT].counters
            assert (counters.losses, counters.reconnects) == (1, 1)
        assert hand.closes == 2

    def test_hand_lost_during_stop_ends_cleanly(self) -> None:
        hand, node = ScriptedHand(), FakeNode()
        service = serve(hand, node)
        service.start()
        hand.plugged = False
        service.stop()
        assert not hand.is_open

    def test_service_continues_after_any_exception_of_a_backend(
        self, caplog: pytest.LogCaptureFixture
    ) -> None:
        hand, node = ScriptedHand(), FakeNode()
        with serve(hand, node) as service:
            hand.errors.append(ZeroDivisionError("a bug"))
            wait_until(lambda: service.cores[Side.LEFT].counters.reconnects == 1)
            assert service.failure is None
        assert "the backend failed" in caplog.text
        assert "ZeroDivisionError" in caplog.text

    def test_hanging_exchange_is_visible_in_the_published_state(self) -> None:
        hand, node = ScriptedHand(exchange_timeout=0.05), FakeNode()
        with serve(hand, node) as service:
            hand.hang.clear()
            wait_until(lambda: newest(node).reserve[0] == LINK)
            assert newest(node).lost == 1
            sent = len(node.sent)
            wait_until(lambda: len(node.sent) > sent + 20)
            hand.hang.set()
            wait_until(lambda: newest(node).lost == 0)
            assert service.cores[Side.LEFT].counters.losses == 0

    def test_missing_hand_at_start_fails_and_releases_resources(self) -> None:
        hand, node = ScriptedHand(), FakeNode()
        hand.plugged = False
        with pytest.raises(HandLost):
            serve(hand, node).start()
        assert node.open_entities == 0

    def test_error_in_a_backend_at_start_names_file_and_line(self) -> None:
        class Unfinished(ScriptedHand):
            def open(self) -> None:
                raise OSError("no such port")

        with pytest.raises(BackendBroken, match="left hand: OSError: no such port") as raised:
            serve(Unfinished(), FakeNode(), wait_for_device=True).start()
        assert f"at {__file__}:" in raised.value.hint

    def test_invalid_state_type_is_named(self) -> None:
        class Bare(ScriptedHand):
            def exchange(self, command: HandCommand) -> HandState:
                return 2.7  # type: ignore[return-value]

        with pytest.raises(HandError, match="returned a float, not a HandState") as raised:
            serve(Bare(), FakeNode()).start()
        assert "HandState.from_values" in raised.value.hint

    def test_missing_hand_at_start_can_be_waited_for(self) -> None:
        hand, node = ScriptedHand(q=0.5), FakeNode()
        hand.plugged = False
        with serve(hand, node, wait_for_device=True):
            assert node.types.keys() == {CMD, STATE}
            assert node.sent == []  # nothing is known, so nothing is said
            hand.plugged = True
            wait_until(lambda: node.sent)
            assert newest(node).q == 0.5


@pytest.mark.parametrize("thread", ["receive", "publish"])
def test_hands_brake_when_a_thread_dies(thread: str, monkeypatch: pytest.MonkeyPatch) -> None:
    hand, node = ScriptedHand(), FakeNode()
    with serve(hand, node) as service:
        core = service.cores[Side.LEFT]
        deliver_until(node, CMD, cmd(2.0), lambda: core.driving)

        def fail(*arguments: object, **options: object) -> None:
            raise RuntimeError("a bug")

        monkeypatch.setattr(service, "_receive" if thread == "receive" else "_publish", fail)
        node.deliver(CMD, cmd(1.0))
        wait_until(lambda: not hand.is_open)
        assert hand.last is not None
        assert hand.last.is_brake
        assert isinstance(service.failure, RuntimeError)
        monkeypatch.undo()
    assert node.open_entities == 0


class TestStop:
    def test_stop_brakes_publishes_and_ends(self) -> None:
        hand, node = ScriptedHand(), FakeNode()
        service = serve(hand, node)
        service.start()
        deliver_until(node, CMD, cmd(2.0), lambda: node.sent and newest(node).q == 2.0)
        service.stop()
        service.stop()
        assert hand.last is not None
        assert hand.last.is_brake
        assert not hand.is_open
        assert (newest(node).q, newest(node).mode) == (2.0, 0)
        assert node.open_entities == 0
        assert not node.closed  # it was lent

    def test_the_last_state_is_from_after_the_brake(self) -> None:
        hand, node = ScriptedHand(), FakeNode()
        service = serve(hand, node, state_rate=5.0)
        service.start()
        deliver_until(node, CMD, cmd(2.0), lambda: newest(node).mode == 1)
        service.stop()
        assert newest(node).mode == 0

    def test_a_hanging_backend_does_not_hang_the_stop(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("dexkit.service.service._JOIN", 0.05)
        hand, node = ScriptedHand(exchange_timeout=0.05), FakeNode()
        service = serve(hand, node)
        service.start()
        hand.hang.clear()
        wait_until(lambda: newest(node).reserve[0] == LINK)
        service.stop()
        assert hand.closes == 1
        assert node.open_entities == 0
        hand.hang.set()


def test_publishing_errors_are_counted_and_the_service_continues(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand, node = ScriptedHand(), FakeNode()
    with serve(hand, node) as service:
        wait_until(lambda: node.sent)

        def refuse(self: FakeWriter, data: bytes, source_timestamp_ns: int | None = None) -> bool:
            raise DdsError("no")

        with monkeypatch.context() as patch:
            patch.setattr(FakeWriter, "write_raw", refuse)
            wait_until(lambda: service.counters.publish_errors > 3)
        sent = len(node.sent)
        wait_until(lambda: len(node.sent) > sent)


class TestTwoHands:
    def test_both_grippers_share_one_topic_pair(self) -> None:
        right, left, node = ScriptedHand(Side.RIGHT), ScriptedHand(Side.LEFT), FakeNode()
        d = dialect("unitree_actuator")
        motors = [unitree_go.MotorCmd_(q=q, kp=5.0) for q in (1.0, 2.0)]
        with HandService([left, right], node=node, dialect=d):
            deliver_until(
                node,
                d.cmd_topic,
                encode(unitree_go.MotorCmds_(motors)),
                lambda: (right.q, left.q) == (1.0, 2.0),
            )
            wait_until(lambda: [m.q for m in states(node, d.state_topic)] == [1.0, 2.0])
        assert {topic for topic, _ in node.sent} == {d.state_topic}

    def test_lost_hand_does_not_affect_the_other(self) -> None:
        right, left, node = ScriptedHand(Side.RIGHT), ScriptedHand(Side.LEFT), FakeNode()
        d = dialect("unitree_actuator")
        motors = [unitree_go.MotorCmd_(q=q, kp=5.0) for q in (1.0, 2.0)]
        with HandService([left, right], node=node, dialect=d):
            right.plugged = False
            wait_until(lambda: states(node, d.state_topic)[0].lost > 0)
            deliver_until(
                node,
                d.cmd_topic,
                encode(unitree_go.MotorCmds_(motors)),
                lambda: states(node, d.state_topic)[1].q == 2.0,
            )
            assert states(node, d.state_topic)[1].lost == 0

    def test_two_hands_of_one_side_are_refused(self) -> None:
        hands = [ScriptedHand(Side.LEFT), ScriptedHand(Side.LEFT)]
        with pytest.raises(UsageError, match="share one topic pair"):
            HandService(hands, node=FakeNode(), dialect="unitree_actuator")


def test_state_beyond_float32_is_not_published() -> None:
    """What the wire cannot hold is a backend's fault, not the end of the service."""

    class Broken(ScriptedHand):
        def exchange(self, command: object) -> HandState:
            return HandState.from_values(1e300, stamp=0.0)

    node = FakeNode()
    with serve(Broken(), node):
        wait_until(lambda: node.sent)
        assert math.isfinite(newest(node).q)


class TestExchangePacing:
    """The exchange loop alone, on a clock that moves by what the exchanges take on the line."""

    PERIOD = 0.002

    def run(self, durations: list[float]) -> list[tuple[float, float]]:
        """(begin, end) of each exchange, seconds from the first one."""
        clock = ManualClock(start=1.0)
        spans: list[tuple[float, float]] = []
        left = list(durations)

        class Line(ScriptedHand):
            def exchange(self, command: HandCommand) -> HandState:
                begin = clock.now()
                clock.advance(left.pop(0) if left else 0.0)
                spans.append((begin, clock.now()))
                if not left:
                    service._stop.set()
                return super().exchange(command)

        service = serve(Line(io_rate=1 / self.PERIOD, clock=clock), FakeNode(), clock=clock)
        (unit,) = service._units
        unit.hand.open()
        unit.core.opened(unit.hand.spec)
        service._exchange_loop(unit)
        first = spans[0][0]
        return [(a - first, b - first) for a, b in spans[: len(durations)]]

    def test_exchanges_in_time_keep_the_period(self) -> None:
        begins = [a for a, _ in self.run([0.0012] * 20)]
        assert begins == pytest.approx([i * self.PERIOD for i in range(20)])

    def test_late_exchange_is_followed_at_once_and_missed_periods_are_skipped(self) -> None:
        for late in (0.0021, 0.0039, 0.0041, 0.0075):
            spans = self.run([0.0012, late, *[0.0005] * 6])
            assert spans[2][0] == pytest.approx(spans[1][1]), late
            for (begin, end), (following, _) in pairwise(spans):
                # one exchange a period, and none before the line is free
                deadline = (math.floor(begin / self.PERIOD + 1e-6) + 1) * self.PERIOD
                assert following == pytest.approx(max(end, deadline)), (late, begin)

    def test_exchanges_longer_than_the_period_follow_without_a_pause(self) -> None:
        spans = self.run([0.0021] * 40)
        assert [a for a, _ in spans[1:]] == pytest.approx([b for _, b in spans[:-1]])


class TestConflict:
    HG = dialect("unitree_hg").state_type

    def test_force_allows_another_publisher(self) -> None:
        node = FakeNode([FakeEndpoint(STATE, self.HG, "writer")])
        with serve(ScriptedHand(), node, force=True):
            wait_until(lambda: node.sent)


class TestDiagnose:
    GO, HG, LEGACY = (dialect(n) for n in ("unitree_go", "unitree_hg", "unitree_actuator"))

    def test_matching_client_has_no_finding(self) -> None:
        peers = [
            FakeEndpoint(STATE, self.GO.state_type, "reader"),
            FakeEndpoint(CMD, self.GO.cmd_type, "writer"),
            FakeEndpoint("rt/lowstate", "unitree_hg::msg::dds_::LowState_", "writer"),
        ]
        assert diagnose(peers, self.GO, [Side.LEFT]) == []

    def test_client_with_another_type_on_the_topic_is_reported(self) -> None:
        (text,) = diagnose([FakeEndpoint(CMD, self.HG.cmd_type, "writer")], self.GO, [Side.LEFT])
        assert "HandCmd_" in text
        assert "never match" in text
        assert "--dialect unitree_hg" in text

    def test_client_of_the_legacy_topic_is_reported(self) -> None:
        """xr_teleoperate issue 100: client and hand wait for each other on other topics."""
        peers = [FakeEndpoint("rt/unitree_actuator/cmd", self.LEGACY.cmd_type, "writer")]
        (text,) = diagnose(peers, self.GO, [Side.LEFT])
        assert "--dialect unitree_actuator" in text
        assert diagnose(peers, self.LEGACY, [Side.LEFT]) == []

    def test_a_client_of_the_new_topics_at_a_legacy_service(self) -> None:
        peers = [FakeEndpoint(CMD, self.GO.cmd_type, "writer")]
        (text,) = diagnose(peers, self.LEGACY, list(Side))
        assert "--dialect unitree_go" in text

    def test_client_of_a_hand_that_is_not_served_is_reported(self) -> None:
        waiting = FakeEndpoint("rt/dex3/left/state", self.HG.state_type, "reader")
        (text,) = diagnose([waiting], self.GO, [Side.LEFT])
        assert "rt/dex3/left/state, the state of a dex3-1" in text
        served = FakeEndpoint("rt/dex3/left/state", self.HG.state_type, "writer")
        assert diagnose([waiting, served], self.GO, [Side.LEFT]) == []
        example = FakeEndpoint("rt/lf/dex3/left/state", self.HG.state_type, "reader")
        (text,) = diagnose([example], self.GO, [Side.LEFT])
        assert "the state of a dex3-1" in text

    def test_reader_of_the_low_rate_topic_with_a_wrong_type_is_reported(self) -> None:
        topic = "rt/lf/dex3/left/state"
        peer = FakeEndpoint(topic, self.GO.state_type, "reader")
        (text,) = diagnose([peer], dialect("dex3"), [Side.LEFT])
        assert topic in text
        assert "never match" in text

    def test_own_endpoints_are_not_peers(self) -> None:
        peers = [FakeEndpoint(CMD, self.HG.cmd_type, "writer", own=True)]
        assert diagnose(peers, self.GO, [Side.LEFT]) == []
