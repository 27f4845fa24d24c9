"""Find servos on a serial port and hands on a USB/IP server, for the doctor.

Serial ports are looked at from outside: who may use them, who does. Only a port that the user
names is opened and asked.
"""

from __future__ import annotations

import dataclasses
import grp
import os
from collections.abc import Callable
from pathlib import Path

from serial.tools import list_ports

from dexkit.doctor.observations import SerialPort, Servo, UsbDevice
from dexkit.doctor.proc_files import command_line, holders
from dexkit.drivers.ezgripper.bus import ServoBus
from dexkit.drivers.ezgripper.discovery import SCAN_BAUD_RATES, latency_timer
from dexkit.errors import DexkitError, HandError, HandRefused, HandTimeout

__all__ = ["inspect_port", "on_server", "ports"]

_IDS = range(1, 4)
"""Servo ids that are asked one by one, at every baud rate, before a broadcast: that takes a
second each. SAKE ships grippers with id 1, a pair gets 1 and 2."""
_TIMEOUT = 0.05  # beyond the time of the bytes; an untuned adapter holds them back 16 ms


def ports() -> list[SerialPort]:
    """The USB serial ports of this machine, without opening any."""
    return [
        _port_facts(port.device, named=False)
        for port in list_ports.comports()
        if port.vid is not None
    ]


def inspect_port(
    path: str,
    *,
    thorough: bool = True,
    progress: Callable[[str], object] = lambda text: None,
    sysfs: Path = Path("/sys"),
) -> SerialPort:
    """Inspect a serial port; if no other program has it open, ping the servos on it.

    Servos are only pinged, never written to.

    :param thorough: if no servo answers, ping all ids at the usual baud rates.
    """
    port = _port_facts(path, named=True, sysfs=sysfs)
    if not port.exists or not port.readable or port.holders:
        return port
    error = ""
    servos: tuple[Servo, ...] = ()
    try:
        servos = _scan_servos(path, thorough, progress)
    except HandRefused as refused:  # locked by a process that may not be seen
        return dataclasses.replace(port, holders=("another program",), error=refused.message)
    except HandError as failed:
        error = failed.message
    return dataclasses.replace(port, error=error, servos=servos, asked=not error)


def on_server(url: str) -> tuple[UsbDevice, ...]:
    """The Dex3-1 hands that a USB/IP server offers.

    :param url: ``usbip://host[:port][/serial]``.
    :raises UsageError: it is no such address.
    """
    # here, not above: it needs libusb
    from dexkit.drivers.dex3_usb.discovery import list_hands, parse_server

    server, serial = parse_server(url)
    try:
        hands = list_hands(server)
    except (OSError, DexkitError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return (UsbDevice(where=url, error=f"no USB/IP server answers: {reason}"),)
    found = []
    for hand in hands:
        try:
            number = hand.serial()
        except (OSError, DexkitError):
            number = ""  # in use: it may still be the one
        if serial in (None, number) or not number:
            found.append(UsbDevice(where=f"{server}", side=str(hand.side), serial=number))
    if found:
        return tuple(found)
    what = f"Dex3-1 with serial number {serial}" if serial else "Dex3-1"
    return (UsbDevice(where=url, error=f"the server offers no {what}"),)


def _port_facts(path: str, *, named: bool, sysfs: Path = Path("/sys")) -> SerialPort:
    try:
        status = os.stat(path)
    except OSError as error:
        return SerialPort(path, exists=isinstance(error, PermissionError), named=named)
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    return SerialPort(
        path,
        readable=os.access(path, os.R_OK | os.W_OK),
        group=group,
        latency_timer=latency_timer(path, sysfs),
        holders=tuple(
            f"{command_line(pid) or 'a process'} (pid {pid})" for pid in _holders_of(path)
        ),
        named=named,
    )


def _holders_of(path: str) -> list[int]:
    """Processes that have it open, without the emulator that made a pseudo-terminal."""
    found = holders(path)
    if os.path.realpath(path).startswith("/dev/pts/"):
        found = [pid for pid in found if " emulate " not in f" {command_line(pid)} "]
    return found


def _scan_servos(path: str, thorough: bool, progress: Callable[[str], object]) -> tuple[Servo, ...]:
    bus = ServoBus(path, SCAN_BAUD_RATES[0], timeout=_TIMEOUT, retries=0)
    bus.open()
    try:
        for rate in SCAN_BAUD_RATES:
            progress(f"asking for a servo on {path} at {rate} baud")
            bus.set_baudrate(rate)
            found = []
            for number in _IDS:
                try:
                    found.append(Servo(number, bus.ping(number, retries=1).model, rate))
                except HandTimeout:
                    model = bus.ping_protocol_1(number)
                    if model is not None:
                        found.append(Servo(number, model, rate, protocol=1))
            if found:
                return tuple(found)
        for rate in SCAN_BAUD_RATES[:2] if thorough else ():
            progress(f"asking for servos of any id on {path} at {rate} baud")
            bus.set_baudrate(rate)
            everyone = tuple(Servo(p.id, p.model, rate) for p in bus.ping_all())
            if everyone:
                return everyone
        return ()
    finally:
        bus.close()
