"""``dexkit replay`` on served hands: played, stopped, left at rest."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from dexkit.child_processes import command_line
from dexkit.dds import DdsNode
from dexkit.errors import TopicConflict
from dexkit.hand import HandCommand, HandState, JointMode, Side
from dexkit.models import dialect
from dexkit.service import HandService
from dexkit.traces.replay.live import LiveReplay
from dexkit.traces.replay.machine import Commands, End, Guards, Phase, ReplayMachine
from tests.dds_helpers import free_domain
from tests.patience import PATIENCE
from tests.service_helpers import ScriptedHand
from tests.test_replay import dexkit, gripper, plan_of
from tests.trace_helpers import CMD, CMD_TYPE, mcap_bytes, write

GO = dialect("unitree_go")
WAVE = np.linspace(2.0, 4.0, 100)
PATIENT = ("--set", f"max-silence={PATIENCE}", "--wait", PATIENCE)
"""States may come late on a busy machine."""
TRIALS = 5
"""Of what a busy machine can spoil: a program that was suspended for a second ends itself."""


class Watched(ScriptedHand):
    """Keeps what it is commanded, and can be unplugged at a position."""

    def __init__(self, side: Side = Side.LEFT, *, q: float = 1.9, breaks_at: float = 99.0) -> None:
        super().__init__(side, q=q)
        self.taken: list[tuple[int, float, float]] = []
        self.breaks_at = breaks_at
        self.held: float | None = None
        """Where someone holds it, until it is commanded to be there."""

    def exchange(self, command: HandCommand) -> HandState:
        mode, q, kp = int(command.mode[0]), float(command.q[0]), float(command.kp[0])
        if not self.taken or self.taken[-1] != (mode, q, kp):
            self.taken.append((mode, q, kp))
        if q > self.breaks_at:
            self.plugged = False
        state = super().exchange(command)
        if self.held is None or abs(q - self.held) < 0.1:
            self.held = None
            return state
        self.q = self.held
        return HandState.from_values(self.q, stamp=state.stamp, mode=mode)

    @property
    def positions(self) -> list[float]:
        return [q for mode, q, kp in self.taken if mode == JointMode.FOC and kp > 0]


@contextmanager
def served(*hands: Watched) -> Iterator[int]:
    domain = free_domain()
    with ExitStack() as stack:
        for hand in hands:
            stack.enter_context(HandService(hand, domain=domain, state_rate=200.0))
        yield domain


def note_sent(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The q of every command that a replay sends from now on."""
    sent: list[float] = []
    send = LiveReplay._send

    def noted(live: LiveReplay, commands: Commands) -> None:
        sent.extend(motors[0].q for motors in commands.values())
        send(live, commands)

    monkeypatch.setattr(LiveReplay, "_send", noted)
    return sent


@pytest.fixture(autouse=True)
def stalls_are_no_suspension(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that stalls for seconds is not the subject here."""
    for module in ("dexkit.cli.consent", "dexkit.traces.replay.live"):
        monkeypatch.setattr(f"{module}.LONG_PAUSE", PATIENCE)


def clip(tmp_path: Path, q: np.ndarray = WAVE) -> Path:
    return write(tmp_path / "clip.mcap", mcap_bytes(gripper(q), types={CMD: CMD_TYPE}))


def test_a_session_is_played_on_a_served_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = note_sent(monkeypatch)
    hand = Watched()
    with served(hand) as domain:
        code, output = dexkit(
            "replay", clip(tmp_path), "--domain", domain, "--set", "ramp-speed=2", *PATIENT
        )
    assert code == 0, output
    assert "played 0.5 s" in output
    assert sent[0] == pytest.approx(1.9, abs=0.05)  # where it was, and not where the session is
    assert np.max(np.abs(np.diff(sent))) <= 0.15
    assert max(sent) == pytest.approx(4.0)
    assert sent[-1] == pytest.approx(hand.q)
    assert len(hand.positions) > 10


def test_a_lost_hand_stops_the_replay(tmp_path: Path) -> None:
    hand = Watched(breaks_at=3.0)
    with served(hand) as domain:
        long = clip(tmp_path, np.linspace(2.0, 4.0, 400))
        code, output = dexkit("replay", long, "--domain", domain, *PATIENT)
    assert code == 1, output
    assert "stopped: left hand: gripper reports host_saw_motor_timeout" in output
    assert "Traceback" not in output


def test_a_subscriber_without_states_is_no_hand(tmp_path: Path) -> None:
    domain = free_domain()
    with DdsNode(domain) as node, node.reader(CMD, CMD_TYPE):
        code, output = dexkit("replay", clip(tmp_path), "--domain", domain, "--wait", 0.4)
    assert code == 1
    assert "no usable state of the left hand" in output
    assert "dexkit publish" in output


def test_replay_gives_way_to_another_client_without_a_last_command() -> None:
    hand = Watched()
    with served(hand) as domain, DdsNode(domain) as near, DdsNode(domain) as far, ExitStack() as s:
        machine = ReplayMachine(plan_of(np.full(100_000, 2.0)), Guards(stale=PATIENCE))
        live = LiveReplay(near, machine)
        assert live.wait_ready(threading.Event())
        turns = 0

        def turn(machine: ReplayMachine) -> None:
            nonlocal turns
            turns += 1
            if turns == 50:
                s.enter_context(far.writer(CMD, CMD_TYPE))

        with pytest.raises(TopicConflict, match=f"commands {CMD}"):
            live.play(turn)
        sent = machine.progress.sent
        assert machine.step(time.monotonic()) == {}
        assert machine.progress.sent == sent


def test_a_failure_of_the_program_leaves_the_hand_at_rest() -> None:
    hand = Watched(q=2.0)
    with served(hand) as domain, DdsNode(domain) as node:
        machine = ReplayMachine(plan_of(np.full(100_000, 2.0)), Guards(stale=PATIENCE))
        live = LiveReplay(node, machine)
        assert live.wait_ready(threading.Event())
        phases: list[Phase] = []
        send = live._send

        def noted(commands: Commands) -> None:
            phases.extend(machine.phase for _ in commands)
            send(commands)

        live._send = noted  # type: ignore[method-assign]

        def turn(machine: ReplayMachine) -> None:
            if machine.progress.sent > 20:
                raise OSError("the terminal is gone")

        with pytest.raises(OSError, match="terminal"):
            live.play(turn)
    assert (machine.phase, machine.end) == (Phase.END, End.ASKED)
    assert phases[-1] is Phase.LEAVE


def test_after_a_pause_replay_ramps_from_the_present_position(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent = note_sent(monkeypatch)
    hand = Watched(q=2.0)
    with served(hand) as domain, DdsNode(domain) as node:
        machine = ReplayMachine(
            plan_of(np.linspace(2.0, 3.0, 100)), Guards(ramp_speed=2.0, stale=PATIENCE)
        )
        live = LiveReplay(node, machine)
        assert live.wait_ready(threading.Event())
        paused_at: list[tuple[int, int]] = []

        def turn(machine: ReplayMachine) -> None:
            if machine.at > 0.2 and not paused_at:
                paused_at.append((len(hand.taken), len(sent)))
                time.sleep(0.4)
                hand.held = 1.5  # moved meanwhile

        live.play(turn)
    assert machine.end is End.DONE
    assert machine.progress.pauses >= 1
    ((taken, sent_before),) = paused_at
    obeyed = [q for mode, q, kp in hand.taken[taken + 1 :] if mode and kp > 0]
    assert min(obeyed) < 1.7
    # a busy hand may miss the last of the commands
    assert max(sent[sent_before:]) == pytest.approx(3.0)


@pytest.mark.parametrize("how", ["interrupt", pytest.param("key", marks=pytest.mark.soak)])
def test_replay_stopped_by_the_user_leaves_the_hand_at_rest(tmp_path: Path, how: str) -> None:
    path = clip(tmp_path, np.full(50_000, 2.0))
    for _ in range(TRIALS):
        hand = Watched()
        code, out, err = stopped_replay(path, hand, how)
        if "was suspended" not in err:
            break
    assert code == 130, err
    assert "played" in out
    assert "Traceback" not in err
    assert hand.positions[-1] == pytest.approx(hand.q)


def stopped_replay(path: Path, hand: Watched, how: str) -> tuple[int, str, str]:
    """Replay a file to a hand until it moves, and stop by Ctrl-C or a key; exit code, out, err."""
    main, terminal = pty.openpty()
    with served(hand) as domain:
        process = subprocess.Popen(
            command_line("replay", str(path), "--domain", str(domain), *map(str, PATIENT)),
            stdin=terminal,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=_take_terminal if how == "key" else None,
        )
        try:
            assert process.stdout is not None
            if any(line.startswith("ready:") for line in process.stdout):
                end = time.monotonic() + PATIENCE
                while not hand.positions and process.poll() is None and time.monotonic() < end:
                    time.sleep(0.01)
                if how == "interrupt":
                    process.send_signal(signal.SIGINT)
                else:
                    os.write(main, b"q")
            out, err = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
            os.close(main)
            os.close(terminal)
    return process.returncode, out, err


def _take_terminal() -> None:
    """Make standard input the terminal of this session, and be in its foreground."""
    import fcntl
    import termios

    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    os.tcsetpgrp(0, os.getpgrp())
