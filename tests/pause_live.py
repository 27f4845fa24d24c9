"""A service or bridge that is stopped in motion (SIGSTOP) and continued after its client has gone.

``python -m tests.pause_live --tries 50`` does it with every backend at the same time and prints a
table; what moved counts as a failure. While the program is paused, the client commands the hand to
go back to where it came from, and leaves. What is measured is how far it goes back afterwards: a
hand that only comes to rest does not go back at all.

Emulated devices live in this process, so that they are seen directly; simulated hands are seen by
the states that they publish.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexkit.child_processes import Tool
from dexkit.dds import DdsNode
from dexkit.emulators.dex3_mcu import Dex3Hands
from dexkit.emulators.m4010 import Dex1Motors
from dexkit.emulators.mx64 import EmulatedThread, emulated_ezgripper
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.messages import unitree_go, unitree_hg
from dexkit.models import Dialect, dialect, model
from dexkit.wire import mx64
from tests.patience import PATIENCE

__all__ = ["BACKENDS", "Outcome", "Try", "stop_and_continue"]

SIDE = Side.LEFT
BACKENDS = ("sim-dex1", "sim-dex3", "sim-dex5", "ezgripper", "dex1-serial", "dex3-usb", "bridge")
STOPS = (0.4, 0.7, 1.3, 3.0)  # seconds; the watchdogs of the devices act after 0.5 and 1
WENT_BACK = 0.03  # of the way; more than a spring, friction or an encoder gives
# A servo that is braked at full speed springs back without any pause, too: 2 % of the stroke with
# an exchange every 2 ms, 7 % with one every 30 ms, as on a machine that is busy.
WENT_BACK_BRAKED = 0.1
_SENT = 0.2  # seconds that the client goes on sending to a program that stands still
_WATCHED = 0.8  # seconds after it goes on
_CLOSED_AT = 1510  # encoder ticks of the emulated EZGripper
_TICKS = 2500  # of its stroke

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Try:
    """What one stop did.

    :param stopped: seconds.
    :param back: how far the hand went back afterwards, as a part of its way.
    :param again: seconds from the next client's first command until the hand moved.
    """

    stopped: float
    back: float
    again: float


@dataclass
class Outcome:
    """All tries of one backend."""

    name: str
    tries: list[Try] = field(default_factory=list)

    @property
    def moved(self) -> list[Try]:
        most = WENT_BACK_BRAKED if self.name == "ezgripper" else WENT_BACK
        return [one for one in self.tries if one.back > most]


class _Hand:
    """The served hand as a client commands it, and where it is: 0 at the one end, 1 at the other.

    :param look: where the joints are.
    """

    def __init__(self, spoken: Dialect, look: Callable[[], Array]) -> None:
        self.dialect = spoken
        joints = model(spoken.model).joints[SIDE]
        self.gains = model(spoken.model).gains
        if len(joints) == 1:
            self.ends = np.array([0.3]), np.array([5.1])
        else:
            far = [
                0.8 * (j.q_max if j.closing > 0 else j.q_min) if j.closing else 0 for j in joints
            ]
            self.ends = np.array([0.2 * q for q in far]), np.array(far)
        self._driven = self.ends[0] != self.ends[1]
        self._look = look

    def place(self) -> float:
        low, high = (end[self._driven] for end in self.ends)
        return float(np.mean((self._look()[self._driven] - low) / (high - low)))

    def command(self, end: int) -> Any:
        values = [
            {"q": float(q), "kp": kp, "kd": kd}
            for q, (kp, kd) in zip(self.ends[end], self.gains, strict=True)
        ]
        if self.dialect.name == "dex3":  # driven, without the time-out protection
            return unitree_hg.HandCmd_(
                [unitree_hg.MotorCmd_(mode=0x10 | i, **v) for i, v in enumerate(values)]  # type: ignore[arg-type]
            )
        if self.dialect.name == "dex5":
            return unitree_hg.HandCmd_([unitree_hg.MotorCmd_(mode=1, **v) for v in values])  # type: ignore[arg-type]
        motors = [unitree_go.MotorCmd_(mode=1, **values[0]) for _ in range(self.dialect.length)]  # type: ignore[arg-type]
        return unitree_go.MotorCmds_(motors)


@contextlib.contextmanager
def _serve(*arguments: object) -> Iterator[Tool]:
    tool = Tool(*map(str, arguments))
    try:
        tool.wait_ready(threading.Event())
        yield tool
    except DexkitError as error:
        raise AssertionError(f"{error}: {error.hint}") from error
    finally:
        tool._process.send_signal(signal.SIGCONT)
        tool._process.terminate()
        try:
            tool._process.wait(10)
        except subprocess.TimeoutExpired:
            tool._process.kill()
            tool._process.wait()


@contextlib.contextmanager
def _published(spoken: Dialect, domain: int) -> Iterator[Callable[[], Array]]:
    """The position that the hand reports."""
    n = len(model(spoken.model).joints[SIDE])
    with DdsNode(domain) as node:
        reader = node.reader(spoken.topics(SIDE)[1], spoken.state_type)
        newest = np.zeros(n)

        def look() -> Array:
            nonlocal newest
            for sample in reader.take():
                message = sample.message
                motors = getattr(message, "states", None) or message.motor_state
                newest = np.array([m.q for m in motors[:n]])
            return newest

        deadline = time.monotonic() + 10
        while not look().any():
            assert time.monotonic() < deadline, "no state"
            time.sleep(0.01)
        yield look


@contextlib.contextmanager
def _setup(name: str, domain: int, other: int) -> Iterator[tuple[Tool, _Hand, int]]:
    """(the program to stop, the hand, the client's domain)."""
    with contextlib.ExitStack() as stack:
        enter = stack.enter_context
        options = ("--side", SIDE, "--domain", domain)
        patient = ("--set", "timeout=0.3", "--wait-for-device")  # emulators on a busy machine
        if name == "ezgripper":
            gripper = enter(emulated_ezgripper(start=5.0, closed_at=_CLOSED_AT))
            assert isinstance(gripper, EmulatedThread)
            servo = gripper.servo

            def ticks() -> Array:
                turned = (servo.get(mx64.PRESENT_POSITION) - _CLOSED_AT + 200) % 4096 - 200
                return np.array([turned / _TICKS * 5.4])

            device = ("--device", gripper.path, "--set", f"zero={_CLOSED_AT}")
            tool = enter(_serve("serve", name, *device, *patient, *options))
            yield tool, _Hand(dialect("unitree_go"), ticks), domain
        elif name == "dex1-serial":
            folder = enter(tempfile.TemporaryDirectory())
            motors = Dex1Motors((SIDE,), links={SIDE: os.path.join(folder, "tty")})
            stack.callback(motors.close)
            tool = enter(_serve("serve", name, "--device", motors.path, *patient, *options))
            hand = _Hand(dialect("unitree_go"), lambda: np.array([motors.motor.q]))
            yield tool, hand, domain
        elif name == "dex3-usb":
            hands = enter(Dex3Hands((SIDE,)))
            joints = hands.device(SIDE).mechanics.joints
            tool = enter(
                _serve(
                    "serve",
                    name,
                    "--set",
                    "guesses=accept",
                    "--set",
                    f"usb={hands.url}",
                    *patient,
                    *options,
                )
            )
            hand = _Hand(dialect("dex3"), lambda: np.array([joint.q for joint in joints]))
            yield tool, hand, domain
        elif name == "bridge":
            enter(_serve("serve", "sim-dex1", *options))
            ends = ("unitree_actuator", "unitree_go", "--side", SIDE)
            domains = ("--domain", other, "--to-domain", domain)
            tool = enter(_serve("bridge", *ends, *domains))
            look = enter(_published(dialect("unitree_go"), domain))
            yield tool, _Hand(dialect("unitree_actuator"), look), other
        else:
            spoken = dialect(
                {"sim-dex1": "unitree_go", "sim-dex3": "dex3", "sim-dex5": "dex5"}[name]
            )
            tool = enter(_serve("serve", name, *options))
            yield tool, _Hand(spoken, enter(_published(spoken, domain))), domain


def stop_and_continue(
    name: str, tries: int, domain: int, other: int, *, stops: Sequence[float] = STOPS
) -> Outcome:
    """Stop the program ``tries`` times, for each of ``stops`` seconds in turn.

    :param domain: for the hand; ``other``: for the bridge's client.
    """
    outcome = Outcome(name)
    chance = random.Random(domain)
    with _setup(name, domain, other) as (tool, hand, client_domain):
        for number in range(tries):
            stopped = stops[number % len(stops)]
            outcome.tries.append(
                _one(tool, hand, client_domain, stopped, leaves=number % 2 == 0, chance=chance)
            )
            assert tool.running, f"{name} ended: {tool.last_lines}"
    return outcome


def _one(
    tool: Tool, hand: _Hand, domain: int, stopped: float, *, leaves: bool, chance: random.Random
) -> Try:
    with contextlib.ExitStack() as stack:
        node = stack.enter_context(DdsNode(domain))
        writer = node.writer(hand.dialect.topics(SIDE)[0], hand.dialect.cmd_type)
        assert writer.wait_matched(10), "no reader of the command"
        begin = hand.place()
        end = int(begin < 0.5)
        sign = 1 if end else -1
        there, back = hand.command(end), hand.command(1 - end)
        far = 0.2 + 0.3 * chance.random()
        first = time.monotonic()
        moved = 0.0
        while (way := (hand.place() - begin) * sign) < far:
            writer.write(there)
            if way > 0.02 and not moved:
                moved = time.monotonic() - first
            if time.monotonic() > first + PATIENCE:
                raise AssertionError(f"it does not go: {way:.2f} of {far:.2f}")
            time.sleep(0.004)
        pid = tool._process.pid
        os.kill(pid, signal.SIGSTOP)
        since = time.monotonic()
        try:
            while time.monotonic() - since < _SENT:
                writer.write(back)
                time.sleep(0.004)
            if leaves:
                node.close()
            time.sleep(max(0.0, since + stopped - time.monotonic()))
            furthest = hand.place() * sign
        finally:
            os.kill(pid, signal.SIGCONT)
        went = 0.0
        until = time.monotonic() + _WATCHED
        while time.monotonic() < until:
            at = hand.place() * sign
            furthest = max(furthest, at)
            went = max(went, furthest - at)
            time.sleep(0.004)
    return Try(stopped, went, moved)


def _child(name: str, tries: int, domain: int, other: int) -> int:
    outcome = stop_and_continue(name, tries, domain, other)
    worst = max(one.back for one in outcome.tries)
    slowest = max(one.again for one in outcome.tries[1:] or outcome.tries)
    by_stop = ", ".join(
        f"{s:g} s: {sum(one.stopped == s for one in outcome.moved)}"
        f"/{sum(one.stopped == s for one in outcome.tries)}"
        for s in STOPS
    )
    print(
        f"{name:12} {len(outcome.tries):3} stops, moved back {len(outcome.moved):3} ({by_stop}); "
        f"furthest {100 * worst:5.1f} % of the way; obeyed again within {slowest:.2f} s"
    )
    return len(outcome.moved)


def main() -> int:
    """Every backend in a process of its own, all at once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=50)
    parser.add_argument("--backend", action="append", choices=BACKENDS)
    parser.add_argument("--domain", type=int, action="append", help="two for each backend")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    names = options.backend or list(BACKENDS)
    domains = options.domain or list(range(150, 150 + 2 * len(names)))
    if options.child:
        return min(_child(names[0], options.tries, *domains), 100)
    started = [
        subprocess.Popen(
            [
                *(sys.executable, os.path.abspath(__file__), "--child", "--backend", name),
                *("--tries", str(options.tries)),
                *(word for d in domains[2 * i : 2 * i + 2] for word in ("--domain", str(d))),
            ]
        )
        for i, name in enumerate(names)
    ]
    codes = [child.wait() for child in started]
    return int(any(codes))


if __name__ == "__main__":
    raise SystemExit(main())
