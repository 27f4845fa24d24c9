"""Find the serial port of a Dex1-1 motor: probe the ports that match glob patterns, as the vendor's
service does (docs/sources/unitree-dex.md#b2).
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
    """Return the paths that match the glob patterns, without duplicates."""
    return list(dict.fromkeys(p for pattern in patterns for p in sorted(glob.glob(pattern))))


def find_motor(
    settings: Dex1Settings, number: int, sleep: Callable[[float], None] = time.sleep
) -> tuple[MotorLine, MotorData]:
    """Find motor ``number``; return its open line and its first data frame.

    The probe is a brake command. The vendor's probe (FOC with zero gains) would drop a held object.

    :raises HandNotFound: the motor does not answer on any port; the hint lists what does.
    :raises HandRefused: more than one port has such a motor, or another program uses the port that
        was named.
    :raises HandLost: the port goes away during the search.
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
                remarks.append(_describe_answering_motor(line, number, settings.timeout, sleep))
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
    # without the time-out bit, which clears a tripped protection
    frame = MotorCmd(number).pack()
    for attempt in range(attempts):
        if attempt:
            sleep(PAUSE)
        try:
            return line.exchange(frame, number, timeout)
        except HandTimeout:
            pass
    return None


def _describe_answering_motor(
    line: MotorLine, number: int, timeout: float, sleep: Callable[[float], None]
) -> str:
    """Describe the other motors that answer on a port without the wanted motor."""
    if not is_shared(line):  # the probe is a brake: do not brake a motor that is in use
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
            f"no port to search for {who}: nothing matches {', '.join(settings.ports)}",
            hint="is the USB adapter plugged in? Otherwise say where: --device PATH",
        )
    return HandNotFound(
        f"{who} does not answer at {settings.baudrate} baud on {', '.join(ports)}",
        hint="; ".join([*remarks, "is its 24 V supply on?"]),
    )
