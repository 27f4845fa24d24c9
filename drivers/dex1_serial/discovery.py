"""Finding a motor: which port, as the vendor's service probes them
(docs/sources/unitree-dex.md#b2).
"""

from __future__ import annotations

import glob
import time
from collections.abc import Callable, Sequence

from dexkit.drivers.dex1_serial.line import MotorLine, acquire, is_shared
from dexkit.drivers.dex1_serial.settings import Dex1Settings
from dexkit.drivers.serial_port import find_device
from dexkit.errors import HandError, HandNotFound, HandRefused, HandTimeout
from dexkit.wire.m4010 import SIDES, MotorCmd, MotorData

__all__ = ["ATTEMPTS", "PAUSE", "find_motor", "list_ports"]

ATTEMPTS = 3
PAUSE = 0.05
"""Seconds between attempts."""


def list_ports(patterns: Sequence[str]) -> list[str]:
    """The ports that match glob patterns, each once."""
    return list(dict.fromkeys(p for pattern in patterns for p in sorted(glob.glob(pattern))))


def find_motor(
    settings: Dex1Settings, number: int, sleep: Callable[[float], None] = time.sleep
) -> tuple[MotorLine, MotorData]:
    """The line with motor ``number`` on it, and what the motor answered.

    The probe is a brake: unlike the vendor's (FOC without gains) it never lets go of anything.

    :raises HandNotFound: there is none, or more than one; says what there is.
    :raises HandRefused: the one port that was named is another program's.
    :raises HandLost: it goes away meanwhile.
    """
    if settings.device is not None:
        ports = [find_device(settings.device).path]
    else:
        ports = list_ports(settings.ports)
    found: list[tuple[MotorLine, MotorData]] = []
    remarks: list[str] = []
    try:
        for port in ports:
            try:
                line = acquire(port, settings.baudrate)
            except HandError as error:
                if settings.device is not None:
                    raise
                remarks.append(error.message)
                continue
            try:
                data = _probe(line, number, settings.timeout, ATTEMPTS, sleep)
                if data is not None:
                    found.append((line, data))
                    continue
                remarks.append(_who_else(line, number, settings.timeout, sleep))
            except HandError as error:
                line.release()
                if settings.device is not None:
                    raise
                remarks.append(error.message)
                continue
            except BaseException:
                line.release()
                raise
            line.release()
        if len(found) == 1:
            return found.pop()
        raise _not_found(settings, number, ports, [line.path for line, _ in found], remarks)
    finally:
        for line, _ in found:
            line.release()


def _probe(
    line: MotorLine, number: int, timeout: float, attempts: int, sleep: Callable[[float], None]
) -> MotorData | None:
    # without the time-out bit: a protection that has tripped is cleared
    frame = MotorCmd(number).pack()
    for attempt in range(attempts):
        if attempt:
            sleep(PAUSE)
        try:
            return line.exchange(frame, number, timeout)
        except HandTimeout:
            pass
    return None


def _who_else(line: MotorLine, number: int, timeout: float, sleep: Callable[[float], None]) -> str:
    """What a port without the motor has instead."""
    if not is_shared(line):  # nobody else's motor is braked by being asked
        for other, side in SIDES.items():
            if other != number and _probe(line, other, timeout, 1, sleep) is not None:
                return f"{line.path}: motor {other} answers, which is the {side} one"
    if line.statistics.damaged or line.statistics.stray:
        return f"{line.path}: something answers, but no intact frames (another device or rate?)"
    return f"{line.path}: no answer"


def _not_found(
    settings: Dex1Settings, number: int, ports: list[str], found: list[str], remarks: list[str]
) -> HandError:
    if found:
        return HandRefused(
            f"more than one port has a motor with id {number}: {', '.join(found)}",
            hint="say which: --device PATH",
        )
    side = SIDES.get(number)
    who = f"motor {number}" if side is None else f"motor {number} (the {side} one)"
    if not ports:
        return HandNotFound(
            f"no port to look for {who}: nothing matches {', '.join(settings.ports)}",
            hint="is the USB adapter plugged in? Otherwise say where: --device PATH",
        )
    return HandNotFound(
        f"{who} does not answer at {settings.baudrate} baud on {', '.join(ports)}",
        hint="; ".join([*remarks, "is its 24 V supply on?"]),
    )
