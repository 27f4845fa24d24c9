"""The 500 Hz loop of an emulated robot: command in, step of the mechanics, state out."""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable

from benchmarks import Result
from dexkit.dds import cyclone_type
from dexkit.emulators.robot import RobotMechanics
from dexkit.messages import message_type
from dexkit.robots import ROBOTS, RobotModel
from dexkit.wire.low_level import encode_with_crc

ROUNDS = 40
TICKS = 100
PERIOD_TARGET = 5.0  # times shorter than the period: hands and clients want the processor, too
CODEC_TARGET = 4.0


def _best(function: Callable[[], object], number: int = TICKS) -> float:
    """Least processor time of one call, us."""
    runs = timeit.repeat(function, timer=time.thread_time, number=number, repeat=ROUNDS)
    return min(runs) / number * 1e6


def _command(model: RobotModel) -> bytes:
    """The rest position, held."""
    kind = message_type(model.cmd_type)
    message = kind.decode(kind.encode(kind.cls()))
    for slot in model.used:
        motor = message.motor_cmd[slot]
        motor.mode, motor.q = model.enable[slot], model.rest_q[slot] + 0.05
        motor.kp, motor.kd = model.client_gains[slot]
    if model.mode_machine is not None:
        message.mode_machine = model.mode_machine
    return encode_with_crc(message)


def run() -> list[Result]:
    """Times of the loop and of its state alone."""
    results = []
    for model in ROBOTS.values():
        robot = RobotMechanics(model)
        command = _command(model)
        now = 0.0

        def tick(robot: RobotMechanics = robot, command: bytes = command) -> None:
            nonlocal now
            now += 1.0 / robot.model.state_rate
            robot.command(command, now)
            robot.advance(now)
            robot.state(now)

        spent = _best(tick)
        assert robot.counters.commands == robot.counters.states == ROUNDS * TICKS
        period = 1e6 / model.state_rate
        results.append(
            Result(
                name=f"{model.name}: command, step and state",
                value=spent,
                unit="us",
                peer="period",
                peer_value=period,
                ratio=period / spent,
                target=f"at least {PERIOD_TARGET:g}x",
                met=period / spent >= PERIOD_TARGET,
                note="processor time of one thread, DDS not included",
            )
        )
        cls = cyclone_type(model.state_type)
        peer = cls.deserialize(robot.state(now))
        ours = _best(lambda robot=robot: robot.state(now))  # type: ignore[misc]  # noqa: B023
        theirs = _best(peer.serialize, 10)
        results.append(
            Result(
                name=f"{model.name}: state with its CRC",
                value=ours,
                unit="us",
                peer="CycloneDDS Python, no CRC",
                peer_value=theirs,
                ratio=theirs / ours,
                target=f"at least {CODEC_TARGET:g}x",
                met=theirs / ours >= CODEC_TARGET,
            )
        )
    return results
