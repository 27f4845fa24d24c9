"""The Dex3-1's USB driver against an emulated hand: motion, faults, cables, and the service."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dexkit.backoff import Backoff
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.drivers.dex3_usb.settings import format_places
from dexkit.emulators.dex3_mcu import Dex3Hands, emulated_dex3
from dexkit.errors import HandNotFound, HandRefused, HandTimeout
from dexkit.hand import HandCommand, HandState, JointMode, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.service import HandService
from dexkit.wire.dex3_usb import DEFAULT_BUS_MAP
from tests.patience import PATIENCE
from tests.service_helpers import FakeNode, wait_until

GOAL = {
    Side.LEFT: np.array([0.3, 0.5, 0.8, -0.6, -0.7, -0.5, -0.9]),
    Side.RIGHT: np.array([-0.2, -0.4, -0.6, 0.5, 0.4, 0.7, 0.3]),
}
TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)
LOST = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


PATIENT: dict[str, Any] = {"timeout": 5.0, "send_timeout": 5.0}
"""Settings of a driver that shares a busy machine with its emulated hand."""


def hand_at(url: str, side: Side = Side.LEFT, **values: Any) -> Dex3Usb:
    return Dex3Usb(side, Dex3Settings(server=parse_server(url)[0], **values))


def go(q: np.ndarray, **values: float) -> HandCommand:  # type: ignore[type-arg]
    return HandCommand.position(q, **{"kp": 1.5, "kd": 0.1, **values})


def drive(
    hand: Dex3Usb,
    command: HandCommand,
    until: Callable[[HandState], object],
    timeout: float = PATIENCE,
) -> HandState:
    """Exchange, time-outs allowed, until the state is as wanted."""
    deadline = time.monotonic() + timeout
    while True:
        try:
            state = hand.exchange(command)
        except HandTimeout:
            state = None
        if state is not None and until(state):
            return state
        assert time.monotonic() < deadline, f"not within {timeout} s: {state}"
        time.sleep(0.001)


def test_a_hand_that_was_never_brought_up_gets_no_command(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Bus map, signs, zeros and gears are guesses then: another joint would move, the other way."""
    file = tmp_path / "dex3.json"
    with emulated_dex3((Side.LEFT,), process=False) as emulated:
        with pytest.raises(HandRefused, match=r"not been brought up.*zero of each") as e:
            hand_at(emulated.url, config=file, **PATIENT).open()
        assert "guesses=accept" in str(e.value.hint)
        with hand_at(emulated.url, config=file, guesses=True, **PATIENT) as hand:
            key = hand.serial
        assert "guessed: the place of each motor" in caplog.text
        ones = ",".join(["1"] * 7)
        known = {"motors": format_places(DEFAULT_BUS_MAP.motors), "signs": ones,
                 "offsets": ",".join(["0"] * 7)}  # fmt: skip
        file.write_text(json.dumps({key: {"settings": known}}))
        with pytest.raises(HandRefused, match="does not say the gear of each joint"):
            hand_at(emulated.url, config=file, **PATIENT).open()
        ratios = ",".join(f"{j.gear_ratio:g}" for j in DEX3_1.joints[Side.LEFT])
        file.write_text(json.dumps({key: {"settings": {**known, "ratios": ratios}}}))
        with hand_at(emulated.url, config=file, **PATIENT) as hand:
            assert hand.serial == key


def test_both_hands_reach_their_goals() -> None:
    with emulated_dex3((Side.LEFT, Side.RIGHT), process=True) as emulated:
        hands = {side: hand_at(emulated.url, side, **PATIENT) for side in Side}
        for hand in hands.values():
            hand.open()
        assert hands[Side.LEFT].serial != hands[Side.RIGHT].serial
        for side, hand in hands.items():
            rest = hand.exchange(HandCommand.brake(7))
            assert rest.q == pytest.approx(np.array(DEX3_1.rest_q[side]), abs=0.01)
        for side, hand in hands.items():
            goal = GOAL[side]

            def there(state: HandState, goal: Any = goal) -> bool:
                # on a busy machine the protection may have stopped the motors just there
                driven = state.mode.tolist() == [JointMode.FOC] * 7
                return driven and bool(np.abs(state.q - goal).max() < 0.02)

            state = drive(hand, go(goal), there)
            assert not state.fault.any()
            assert state.voltage == pytest.approx(np.full(7, 24.0), abs=1.0)
            assert state.supply is not None
            assert state.supply.power_v == pytest.approx(24.0, abs=0.5)
            assert state.pressure is not None
            assert np.isfinite(state.pressure).sum() == 33
            assert state.imu is not None
            assert abs(np.linalg.norm(state.imu.accelerometer) - 9.81) < 0.1
        for hand in hands.values():
            hand.close()


def test_the_units_are_right_on_both_ends() -> None:
    """Commands to the motors and states that the driver reads are the mechanics's own values."""
    with emulated_dex3() as emulated:
        assert isinstance(emulated, Dex3Hands)
        mechanics = emulated.device().mechanics
        with hand_at(emulated.url, **PATIENT) as hand:
            state = drive(hand, go(GOAL[Side.LEFT], kp=1.0), lambda s: np.abs(s.dq).max() > 1.0)
            assert (
                np.sign(state.dq[1:]).tolist()
                == np.sign(GOAL[Side.LEFT] - np.array(DEX3_1.rest_q[Side.LEFT])).tolist()[1:]
            )
            drive(
                hand,
                go(GOAL[Side.LEFT]),
                lambda s: (
                    np.abs(s.q - GOAL[Side.LEFT]).max() < 0.01
                    and np.abs(s.q - mechanics.q).max() < 1e-3
                ),
            )
            # a torque of its own, held against nothing but the gains: kp (q - q_now) + tau = 0
            push = 0.15
            drive(
                hand,
                go(GOAL[Side.LEFT], tau=push),
                lambda s: (
                    np.abs(s.q - GOAL[Side.LEFT] - push / 1.5).max() < 0.02
                    and np.abs(s.dq).max() < 0.02
                ),
            )


class TestFaults:
    @pytest.mark.parametrize("fault", ["drop:p=0.2", "corrupt:p=0.2", "delay:ms=150,p=0.2,for=1s"])
    def test_hand_reaches_its_goal_despite_faults(self, fault: str) -> None:
        with emulated_dex3() as emulated, hand_at(emulated.url) as hand:
            emulated.inject(fault)
            statistics = hand.statistics

            def struck() -> bool:  # on a busy machine a motion is but a few exchanges
                if fault.startswith("drop"):
                    return statistics.link.timeouts > 0
                if fault.startswith("corrupt"):
                    return statistics.damaged_frames + statistics.damaged_packets > 0
                return True

            state = drive(
                hand,
                go(GOAL[Side.LEFT]),
                lambda s: np.abs(s.q - GOAL[Side.LEFT]).max() < 0.02 and struck(),
                timeout=10.0,
            )
            assert not (state.fault & ~np.uint32(LOST | TRIPPED)).any()


class TestTimeoutProtection:
    def test_motors_stop_after_the_driver_is_killed(self) -> None:
        code = f"""
import sys, numpy as np
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.hand import HandCommand, Side
settings = Dex3Settings(server=parse_server(sys.argv[1])[0], **{PATIENT})
hand = Dex3Usb(Side.LEFT, settings)
hand.open()
for count in range(10**9):
    hand.exchange(HandCommand.position(np.array({GOAL[Side.LEFT].tolist()}), kp=1.5, kd=0.2))
    if count == 100:
        print("driving", flush=True)
"""
        with emulated_dex3() as emulated:
            assert isinstance(emulated, Dex3Hands)
            device = emulated.device()
            process = subprocess.Popen(
                [sys.executable, "-c", code, emulated.url], stdout=subprocess.PIPE
            )
            assert process.stdout is not None
            assert process.stdout.readline() == b"driving\n"
            assert not any(device.tripped)
            os.kill(process.pid, signal.SIGKILL)
            killed = time.monotonic()
            process.wait()
            process.stdout.close()
            wait_until(lambda: all(device.tripped), what="the motors to stop")
            assert time.monotonic() - killed > 0.9
            # the next driver works
            with hand_at(emulated.url, **PATIENT) as hand:
                assert not hand.exchange(HandCommand.brake(7)).fault.any()


class TestService:
    def test_attempts_to_reopen_continue(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """After a long absence too, a hand is looked for every half second."""
        pauses: list[float] = []

        class Noted(Backoff):
            def next(self) -> float:
                pauses.append(super().next())
                return pauses[-1]

        monkeypatch.setattr("dexkit.service.service.Backoff", Noted)
        node = FakeNode()
        with emulated_dex3() as emulated:
            hand = hand_at(emulated.url)
            opening = hand.open

            def away_for_long() -> None:
                if 0 < len(pauses) < 5:
                    raise HandNotFound("away")
                opening()

            hand.open = away_for_long  # type: ignore[method-assign]
            with HandService(hand, node=node, dialect="dex3", state_rate=100.0) as service:  # type: ignore[arg-type]
                emulated.inject("unplug:for=100ms")
                core = service.cores[Side.LEFT]
                wait_until(lambda: core.counters.reconnects == 1)
            assert max(pauses) == hand.reconnect_interval == 0.5
