"""``dexkit emulate mx64``: an emulated gripper on a pseudo-terminal."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dexkit import documents
from dexkit.cli.emulate.serving import (
    ANY_BAUDRATE,
    LINE_TIME,
    device_command,
    latency_timer,
    object_setting,
    one_link,
    real_time_setting,
    seed_setting,
    start_setting,
    wiring_setting,
)
from dexkit.cli.options import LocalPath
from dexkit.cli.settings import YES_OR_NO, Setting, Settings
from dexkit.clock import RealClock
from dexkit.errors import EmulatorError, UsageError
from dexkit.escaping import one_line
from dexkit.wire import mx64

if TYPE_CHECKING:
    from dexkit.emulators.ftdi import FtdiPort
    from dexkit.emulators.mx64 import Bus
    from dexkit.emulators.serial_port import Port

__all__ = ["emulate_mx64"]

_HIGHEST_ID = 252


class _Ids(click.ParamType):  # type: ignore[type-arg]
    name = "ids"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        words = str(value).split(",")
        if not all(re.fullmatch("[0-9]{1,3}", w) and int(w) <= _HIGHEST_ID for w in words):
            self.fail(f"{one_line(value, 40)!r} is not ids of servos, each 0 to {_HIGHEST_ID}")
        return tuple(map(int, words))


@device_command(
    "mx64",
    side=None,
    link="Link that clients open; usbip://HOST:PORT for an FTDI adapter (FT232R) on USB/IP, which "
    "has a latency timer of its own.",
    settings=(
        Setting("id", "N[,N...]", _Ids(), "Id of the servo, or of several on one line.", (1,)),
        Setting(
            "baudrate",
            "B",
            click.Choice([str(rate) for rate in mx64.BAUD_RATES.values()]),
            "Baud rate of the servo, bit/s.",
            "1000000",
        ),
        Setting(
            "bare",
            "yes|no",
            YES_OR_NO,
            "Emulate the servo without a gripper: its shaft turns freely.",
            False,
        ),
        object_setting("Percent of opening at which the fingers touch an object"),
        start_setting("Percent of opening at first.", 50.0),
        Setting(
            "closed-at",
            "TICK",
            click.IntRange(0, mx64.TICKS_PER_TURN - 1),
            "Encoder tick at which the fingers are closed.",
            1510,
        ),
        wiring_setting(
            "One or two grippers, dual or quad, with random ids, directions, closed positions and "
            "strokes, to test a bring-up; replaces id and the settings of a gripper."
        ),
        LINE_TIME,
        latency_timer(1.0),
        seed_setting("the faults and of measurement noise"),
        Setting(
            "eeprom",
            "FILE",
            LocalPath(dir_okay=False),
            "Keep the servos' EEPROM in this file between runs; it overrides id and baudrate.",
        ),
        ANY_BAUDRATE,
        Setting(
            "fast-reads", "yes|no", YES_OR_NO, "Firmware with Fast Sync and Fast Bulk Read.", False
        ),
        Setting("backup", "yes|no", YES_OR_NO, "Firmware with Control Table Backup.", False),
        Setting("protocol-1", "yes|no", YES_OR_NO, "Old firmware with Protocol 1.0 only.", False),
        real_time_setting(False),
    ),
    faults="overload@3s, drop:p=0.05, unplug@5s:for=2s",
)
def emulate_mx64(links: Sequence[str], settings: Settings, faults: Sequence[str]) -> _Grippers:
    """Emulate a DYNAMIXEL MX-64 (Protocol 2.0) with an EZGripper on its shaft.

    Use --set bare=yes for ROBOTIS' own examples: they move between ends of the range that no
    gripper reaches.

    Prints "ready: PATH ..." when it answers there. Ctrl-C or SIGTERM ends it and removes the
    link.
    """
    from dexkit.emulators.faults import parse_fault
    from dexkit.emulators.line_port import line_port
    from dexkit.emulators.mx64 import Bus, Firmware, GripperMechanics, Physics, Servo, Wiring
    from dexkit.emulators.mx64.protocol1 import Protocol1Servo

    link = one_link(links)
    plan = [parse_fault(spec) for spec in faults]
    baudrate, seed = int(settings["baudrate"]), settings["seed"]
    if settings["bare"]:
        _refuse_gripper(settings, "a bare servo has none", "object", "start", "closed-at")
        mechanics = GripperMechanics.none()
    else:
        mechanics = GripperMechanics(
            closed_at=settings["closed-at"],
            start=settings["start"],
            object_pct=settings["object"],
        )
    grippers = [(number, mechanics) for number in settings["id"]]
    if settings["wiring"] is not None:
        _refuse_gripper(settings, "wiring sets it", "bare", "id", "object", "start", "closed-at")
        sides = Wiring.random(settings["wiring"]).servos.values()
        grippers = [pair for servos_of in sides for pair in servos_of.items()]
    firmware = Firmware(fast_reads=settings["fast-reads"], backup=settings["backup"])
    store = None if settings["eeprom"] is None else _EepromFile(settings["eeprom"])
    old = settings["protocol-1"]
    now = RealClock().now()
    servos = [
        Servo(
            servo_id,
            baudrate=baudrate,
            physics=dataclasses.replace(Physics(), gripper=each),
            firmware=firmware,
            now=now,
            eeprom=store.load(index) if store else None,
            seed=seed + index,
        )
        for index, (servo_id, each) in enumerate([] if old else grippers)
    ]
    bus = Bus(
        servos,
        line_time=settings["line-time"],
        latency_timer=settings["latency-timer"] * 1e-3,
        faults=plan,
        start=now,
        seed=seed,
        protocol_1=[Protocol1Servo(i, baudrate=baudrate) for i in settings["id"]] if old else (),
    )
    if store is not None:
        for servo in servos:
            servo.on_eeprom = lambda: store.save([s.eeprom for s in servos])
    port = line_port(bus, link, serial="DKMX64", check_baudrate=not settings["any-baudrate"])
    return _Grippers(port, bus, link, servos[0].baudrate if servos else baudrate)


class _Grippers:
    """The servos on their line; a context manager."""

    def __init__(self, port: Port | FtdiPort, bus: Bus, link: str, baudrate: int) -> None:
        self._port, self._bus, self._link, self._baudrate = port, bus, link, baudrate

    @property
    def ready_lines(self) -> list[str]:
        """Where it answers, and its ids."""
        from dexkit.emulators.line_port import SCHEME

        numbers = [s.id for s in self._bus.servos] + [s.id for s in self._bus.protocol_1]
        ids = ",".join(map(str, numbers))
        shown = self._port.path if self._link.startswith(SCHEME) else self._link
        return [f"ready: {shown} id={ids} baudrate={self._baudrate} {self._port.place}"]

    @property
    def error(self) -> BaseException | None:
        """The error that ended its service, or None."""
        return self._port.error

    @property
    def failure(self) -> Exception | None:
        """The first exception that its service has survived, or None."""
        return self._bus.failure

    def inject(self, spec: str) -> None:
        """Inject a fault."""
        from dexkit.emulators.faults import parse_fault

        self._port.inject(parse_fault(spec))

    def summaries(self) -> list[str]:
        """Its counters."""
        text = self._bus.counters.summary() or "nothing was sent"
        if self._port.overruns:
            text += f", {self._port.overruns} bytes not read by the client"
        return [text]

    def close(self) -> None:
        """Stop, and remove the path."""
        self._port.close()

    def __enter__(self) -> _Grippers:
        self._port.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _refuse_gripper(settings: Settings, why: str, *keys: str) -> None:
    """Refuse settings of a gripper that another one leaves without meaning.

    :raises UsageError: one was given.
    """
    for key in keys:
        if key in settings.given:
            raise UsageError(f"{key} describes a gripper, and {why}")


class _EepromFile:
    """EEPROM contents of the servos on a line, in one JSON file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._contents: list[bytes] = []
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise EmulatorError(
                f"cannot keep the EEPROM in {path}",
                hint="its directory must exist and be writable",
            )
        if os.path.lexists(path):
            hint = "it is to hold the servos' EEPROM; remove it to start with factory values"
            data = documents.read_json(path, error=EmulatorError, hint=hint)
            try:
                if data["device"] != "mx64":
                    raise ValueError(f"it is for a {data['device']}")
                self._contents = [bytes.fromhex(text) for text in data["eeprom"]]
            except (ValueError, KeyError, TypeError) as error:
                raise EmulatorError(
                    f"{path} is not an EEPROM file of this emulator: {error}", hint=hint
                ) from error

    def load(self, index: int) -> bytes | None:
        """The stored EEPROM of servo ``index`` on the line, or None."""
        return self._contents[index] if index < len(self._contents) else None

    def save(self, contents: list[bytes]) -> None:
        """Replace the file; a disk that is full does not stop the emulator."""
        text = json.dumps({"device": "mx64", "eeprom": [c.hex() for c in contents]}, indent=1)
        try:
            documents.update_file(self.path, lambda _: text + "\n")
        except UsageError as error:
            click.echo(f"warning: the EEPROM is not kept: {error.message}", err=True)
