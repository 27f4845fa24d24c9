"""``dexkit serve dex3-usb`` and ``dexkit emulate dex3-usb`` as processes, with a DDS client."""

from __future__ import annotations

import itertools
import math
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dexkit.dds import DdsNode, Qos, Sample
from dexkit.emulators.dex3_mcu import emulated_dex3
from dexkit.hand import Floats, MotorError, Side
from dexkit.messages import unitree_hg
from dexkit.models import DEX3_1, dialect
from tests.dds_helpers import dds_domain, dds_node
from tests.test_service_cli import serving

__all__ = ["dds_domain", "dds_node"]

D = dialect("dex3")
CMD, STATE = D.topics(Side.LEFT)
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
GOAL = np.array([0.3, 0.5, 0.8, -0.6, -0.7, -0.5, -0.9])
LOCKED = list(range(7))  # the mode byte of a motor that brakes is its id
_AWAY = 1.3  # seconds: longer than the motors' own protection takes to stop them


def command(q: np.ndarray) -> Any:  # type: ignore[type-arg]
    return unitree_hg.HandCmd_(
        [unitree_hg.MotorCmd_(mode=0x10 | i, q=float(x), kp=1.5, kd=0.2) for i, x in enumerate(q)]
    )


class Client:
    """Reads every state and keeps it, with the time of its publication."""

    def __init__(self, node: DdsNode) -> None:
        self._reader = node.reader(STATE, D.state_type, qos=Qos("best_effort", depth=5000))
        self._writer = node.writer(CMD, D.cmd_type)
        self.times: list[float] = []
        self.states: list[Any] = []
        self.goal: np.ndarray | None = None  # type: ignore[type-arg]

    def until(self, arrived: Callable[[Any], object], timeout: float = 60.0) -> Any:
        """The first state from now on that ``arrived`` accepts; sends ``goal`` meanwhile."""
        deadline = time.monotonic() + timeout
        seen = len(self.states)
        while True:
            if self.goal is not None:
                self._writer.write(command(self.goal))
            samples: list[Sample] = self._reader.take()
            self.times += [s.source_timestamp_ns * 1e-9 for s in samples]
            self.states += [s.message for s in samples]
            for state in self.states[seen:]:
                if arrived(state):
                    return state
            seen = len(self.states)
            assert time.monotonic() < deadline, f"never came: {self.states[-1:]}"
            time.sleep(0.01)

    def until_moving(self, goal: Floats, back: Floats) -> None:
        """Send a goal until the hand is seen in motion.

        Where the machine is so busy that the whole motion is missed, go back and try again.
        """

        def moving(state: Any) -> bool:
            return bool(np.abs([m.dq for m in state.motor_state]).max() > 0.5)

        def moving_or_there(state: Any) -> bool:
            return moving(state) or bool(np.abs(q_of(state) - self.goal).max() < 0.02)

        for self.goal in itertools.cycle((goal, back)):
            if moving(self.until(moving_or_there)):
                return

    def time_of(self, state: Any) -> float:
        return next(t for t, s in zip(self.times, self.states, strict=True) if s is state)


def q_of(state: Any) -> np.ndarray:  # type: ignore[type-arg]
    return np.array([m.q for m in state.motor_state])


def lost(state: Any) -> bool:
    return all(m.motorstate & LINK for m in state.motor_state)


def numbers(value: Any) -> Iterator[float]:
    """Every number in a message."""
    if isinstance(value, (int, float)):
        yield float(value)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from numbers(item)
    else:
        for name in value.__dataclass_fields__:
            yield from numbers(getattr(value, name))


def test_served_hand_unplugged_in_motion_comes_back_without_motion(
    dds_domain: int, dds_node: DdsNode
) -> None:
    """The state goes on and shows the fault; no stale command moves the hand on its return."""
    client = Client(dds_node)
    with (
        emulated_dex3(process=True) as emulated,
        serving(
            *(
                "dex3-usb",
                "--side",
                "left",
                "--set",
                f"usb={emulated.url}",
                "--set",
                "guesses=accept",
            ),
            *("--domain", dds_domain, "--state-rate", 500),
        ) as service,
    ):
        service.ready()
        rest = client.until(lambda s: any(m.q for m in s.motor_state))
        assert np.abs(q_of(rest) - np.array(DEX3_1.rest_q[Side.LEFT])).max() < 0.02

        client.until_moving(GOAL, np.array(DEX3_1.rest_q[Side.LEFT]))
        emulated.inject(f"unplug:for={_AWAY}s")
        gone = client.until(lost)
        assert gone.error[0] & LINK
        assert not any(m.motorstate & LINK for m in client.states[0].motor_state)

        client.goal = -0.5 * GOAL  # a client that goes on while there is no hand ...
        gone = client.until(lambda s: s.error[1] > 1)
        client.goal = None  # ... and stops before it is back: what it sent is stale
        back = client.until(lambda s: not lost(s))

        until = client.time_of(back) + 0.4
        still = client.until(lambda s: client.times[-1] > until)
        assert [m.mode for m in still.motor_state] == LOCKED
        assert np.abs(q_of(still) - q_of(back)).max() < 0.02
        assert not any(m.motorstate for m in still.motor_state)
        assert not still.error[0]

        client.goal = 0.5 * GOAL
        client.until(lambda s: np.abs(q_of(s) - 0.5 * GOAL).max() < 0.05)  # a new one does

        # what USB does not carry, an attitude for one, is 0, with the hand and without; never NaN
        for state in (rest, gone, still):
            assert all(map(math.isfinite, numbers(state)))
            assert tuple(state.imu_state.quaternion) == (0.0,) * 4
            assert abs(np.linalg.norm(state.imu_state.accelerometer) - 9.81) < 0.2
            assert state.power_v > 20.0

        pauses = np.diff(client.times)
        assert np.percentile(pauses, 99) < 0.05, "state must go on, whatever the hand does"
        assert pauses.max() < 0.5
        code, _, log = service.end(signal.SIGTERM)
        assert code == 0
        assert "Traceback" not in log
