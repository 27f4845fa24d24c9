"""A command that was suspended for long moves hands on only when somebody asks for it."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dexkit.cli.consent import Consent
from dexkit.cli.stop_keys import Keys
from dexkit.clock import ManualClock, RealClock
from dexkit.command_age import LONG_PAUSE, PauseWatch
from dexkit.conformance.kit.suspension import sleep_awake
from dexkit.conformance.selftest import supervision
from dexkit.conformance.selftest.joint_motion import Setup
from dexkit.conformance.selftest.live import run
from dexkit.conformance.selftest.procedure import Procedure
from dexkit.dds import DdsNode
from dexkit.emulators.sim_dex1 import SimHand
from dexkit.errors import ConformanceError
from dexkit.hand import HandCommand, HandState, JointMode, Side
from dexkit.models import dialect
from dexkit.stop_signals import StopRequest
from dexkit.teleop import Operator, client_for, profile
from dexkit.teleop.live import LiveClient
from dexkit.traces.replay.live import LiveReplay
from dexkit.traces.replay.machine import End, Guards, Phase, ReplayMachine
from tests.dds_helpers import free_domain
from tests.each import each
from tests.patience import PATIENCE
from tests.test_pauses import Suspendable
from tests.test_replay import Drive, dexkit, plan_of
from tests.test_replay_dds import WAVE, Watched, clip, note_sent, served
from tests.trace_helpers import CMD, CMD_TYPE

LEFT = Side.LEFT
GO = dialect("unitree_go")


class Typed(Keys):
    """Keys as they are found at each look."""

    def __init__(self, *found: bytes, terminal: bool = True) -> None:
        super().__init__(None)
        self.terminal = terminal
        self.found = list(found)

    def __call__(self) -> bytes:
        return self.found.pop(0) if self.found else b""


# -- the question


@each(
    ("keys", "allowed", "stopped"),
    [
        ((b"", b"", b"\n"), True, False),
        ((b"", b"x", b"\r"), True, False),
        ((b"\n", b"", b"q"), False, True),  # Enter of before the question is no answer
        ((b"\nq",), False, True),  # but a wish to stop counts
        ((b"", b" "), False, True),
        ((b"", b"q\n"), False, True),
    ],
)
def test_only_enter_after_the_question_moves_hands_on(
    keys: tuple[bytes, ...], allowed: bool, stopped: bool
) -> None:
    stop = StopRequest()
    consent = Consent(Typed(*keys), stop, ManualClock())
    assert consent(5.0) is allowed
    assert bool(stop) is stopped
    assert consent.explain() == 0


def test_without_a_terminal_the_command_ends(capsys: pytest.CaptureFixture[str]) -> None:
    consent = Consent(Typed(terminal=False), StopRequest(), ManualClock())
    assert consent(LONG_PAUSE)
    assert not consent(3600.0)
    assert consent.explain() == 1
    assert "suspended for 3600.0 s, and has no terminal" in capsys.readouterr().err


# -- replay


@pytest.mark.parametrize("fresh", [True, False])
def test_replay_that_is_stopped_after_a_pause_sends_no_old_pose(fresh: bool) -> None:
    drive = Drive(plan_of(np.full(4000, 2.7)), q=2.7)
    drive.until(Phase.PLAY)
    drive.machine.pause(drive.now)
    before = len(drive.sent)
    drive.machine.stop(End.SUSPENDED, "")
    drive.q, drive.answers = 1.0, fresh
    drive.until(Phase.END)
    poses = {c.q for _, _, c in drive.sent[before:]}
    assert poses == ({1.0} if fresh else set())


@each(("answer", "end"), [(True, End.DONE), (False, End.SUSPENDED)])
def test_replay_on_dds_goes_on_after_a_long_pause_only_with_leave(
    answer: bool, end: End, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = note_sent(monkeypatch)
    clock, hand = Suspendable(), Watched(q=2.0)
    asked: list[float] = []
    with served(hand) as domain, DdsNode(domain) as node:
        machine = ReplayMachine(plan_of(WAVE), Guards(ramp_speed=2.0, stale=PATIENCE))

        def resume(seconds: float) -> bool:
            asked.append(seconds)
            before.append(len(sent))
            hand.held = 1.5  # moved meanwhile
            return answer

        before: list[int] = []
        live = LiveReplay(node, machine, resume=resume)
        live._watch = PauseWatch(clock)
        assert live.wait_ready(threading.Event())

        def turn(machine: ReplayMachine) -> None:
            if machine.at > 0.2 and not clock.away:
                clock.away = 3600.0

        live.play(turn)
    assert asked[0] > 3600.0
    assert machine.end is end
    after = sent[before[0] :]
    assert min(after) < 1.7  # from where the hand is
    assert max(after) == (pytest.approx(4.0) if answer else pytest.approx(1.5, abs=0.1))


def test_recording_played_as_it_is_ends_after_a_suspension_without_a_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Sleeping(RealClock):
        looks = itertools.count()

        def since_boot(self) -> float:
            return super().since_boot() + (100.0 if next(self.looks) > 30 else 0.0)

    monkeypatch.setattr("dexkit.traces.player.RealClock", Sleeping)
    domain = free_domain()
    with DdsNode(domain) as node, node.reader(CMD, CMD_TYPE):
        code, output = dexkit("publish", clip(tmp_path), "--domain", domain)
    assert code == 1, output
    assert "has no terminal to ask" in output


# -- teleoperation


@pytest.mark.parametrize("answer", [True, False])
def test_teleoperation_goes_on_after_a_long_pause_only_with_leave(answer: bool) -> None:
    clock, hand = Suspendable(), Watched(q=2.0)
    asked: list[float] = []

    def resume(seconds: float) -> bool:
        asked.append(seconds)
        return answer

    with served(hand) as domain, DdsNode(domain) as node:
        live = LiveClient(node, client_for(GO, (LEFT,)), resume=resume)
        live._watch = PauseWatch(clock)
        assert live.wait_ready(threading.Event(), lambda missing, seconds: None)
        send = live._send
        poses: list[bool] = []

        def noted(commands: object) -> None:
            if not clock.away and len(poses) > 20:
                clock.away = 3600.0
            poses.append(bool(asked))
            send(commands)  # type: ignore[arg-type]

        live._send = noted  # type: ignore[method-assign]
        session = live.perform(
            Operator(profile("full-stroke", GO.model), GO), 0.5, threading.Event()
        )
        performed = sum(poses)
        live.leave()
    assert asked
    assert asked[0] > 3600.0
    assert len(session.pauses) == 1
    assert (performed > 0) is answer
    assert sum(poses) > performed  # it is commanded to stay where it is


# -- self-test


class Noted(SimHand):
    """Notes what it is commanded."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(LEFT, clock=clock)
        self.commands: list[HandCommand] = []
        self.after: Callable[[], object] = lambda: None

    def exchange(self, command: HandCommand) -> HandState:
        self.commands.append(command)
        self.after()
        return super().exchange(command)


@each(
    ("away", "answer", "ends"),
    [(0.5, False, False), (60.0, False, True), (60.0, True, False)],
)
def test_selftest_sends_nothing_old_and_asks_after_a_long_pause(
    away: float, answer: bool, ends: bool
) -> None:
    clock = ManualClock()
    hand = Noted(clock)
    hand.open()
    test = supervision.SelfTest(
        Procedure(Setup.from_spec(hand.spec), joints=[0], speed=0.25, touch=False)
    )
    asked: list[float] = []
    moving_at = 0

    def after() -> None:
        nonlocal moving_at
        driven = hand.commands[-1].mode[0] == JointMode.FOC
        if driven and not moving_at and len(hand.commands) > 800:
            moving_at = len(hand.commands)
            clock.suspend(away)

    def resume(seconds: float) -> bool:
        asked.append(seconds)
        return answer

    def turn(test: supervision.SelfTest) -> None:
        if moving_at and len(hand.commands) > moving_at + 200:
            test.stop(supervision.End.STOPPED, "seen enough")

    hand.after = after
    run(hand, test, clock=clock, turn=turn, resume=resume)
    assert hand.commands[moving_at].mode[0] == JointMode.BRAKE
    assert bool(asked) is (away > LONG_PAUSE)
    assert test.end is supervision.End.STOPPED
    assert test.reason.startswith("this program was suspended" if ends else "seen enough")


# -- conformance run


def test_a_suspended_conformance_run_ends() -> None:
    class Sleeping(ManualClock):
        away = 0.0

        def sleep_until(self, deadline: float) -> None:
            super().sleep_until(deadline)
            self.suspend(self.away)

    clock = Sleeping()
    sleep_awake(clock, 5.0)
    clock.away = 0.9
    sleep_awake(clock, 5.0)
    clock.away = 30.0
    with pytest.raises(ConformanceError, match=r"suspended for 30\.0 s"):
        sleep_awake(clock, 6.0)
