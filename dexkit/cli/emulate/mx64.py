"""``dexkit emulate mx64``: an emulated gripper on a pseudo-terminal."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from contextlib import nullcontext
from pathlib import Path

import click

from dexkit import documents
from dexkit.cli.emulate.stdin import A_MISTAKE, read_faults
from dexkit.cli.exit_codes import Command
from dexkit.cli.options import (
    LocalPath,
    any_baudrate_option,
    fault_options,
    latency_timer_option,
    line_time_option,
    link_option,
    object_option,
    real_time_option,
    seed_option,
    start_option,
    wiring_option,
)
from dexkit.clock import RealClock
from dexkit.errors import EmulatorError, UsageError
from dexkit.stop_signals import stop_on_signals
from dexkit.wire import mx64

__all__ = ["emulate_mx64"]


@click.command(
    "mx64",
    context_settings={"show_default": True},
    cls=Command,
    exit_codes={
        0: "stopped by Ctrl-C or SIGTERM",
        1: "the emulator failed",
    },
)
@link_option(
    "Link that clients open; usbip://HOST:PORT for an FTDI adapter (FT232R) on USB/IP, which "
    "has a latency timer of its own."
)
@click.option(
    "--id",
    "ids",
    type=click.IntRange(0, 252),
    multiple=True,
    default=(1,),
    help="Id of the servo; repeat it for several grippers on one line.",
)
@click.option(
    "--baudrate",
    type=click.Choice([str(rate) for rate in mx64.BAUD_RATES.values()]),
    default="1000000",
    metavar="B",
    help="Baud rate of the servo, bit/s.",
)
@click.option(
    "--bare", is_flag=True, help="Emulate the servo without a gripper: its shaft turns freely."
)
@object_option("Percent of opening at which the fingers touch an object")
@start_option("Opening at first.", 50.0)
@click.option(
    "--closed-at",
    type=click.IntRange(0, mx64.TICKS_PER_TURN - 1),
    default=1510,
    metavar="TICK",
    help="Encoder tick at which the fingers are closed.",
)
@wiring_option(
    "One or two grippers, dual or quad, with random ids, directions, closed positions and "
    "strokes, to test a bring-up; replaces --id and the options of a gripper."
)
@line_time_option()
@latency_timer_option(1.0)
@fault_options("overload@3s, drop:p=0.05, unplug@5s:for=2s")
@seed_option("the faults and of measurement noise")
@click.option(
    "--eeprom",
    type=LocalPath(dir_okay=False),
    metavar="FILE",
    help="Keep the servos' EEPROM in this file between runs; it overrides --id and --baudrate.",
)
@any_baudrate_option()
@click.option("--fast-reads", is_flag=True, help="Firmware with Fast Sync and Fast Bulk Read.")
@click.option("--backup", is_flag=True, help="Firmware with Control Table Backup.")
@click.option("--protocol-1", is_flag=True, help="Old firmware with Protocol 1.0 only.")
@real_time_option(default=False)
def emulate_mx64(
    link: str,
    ids: tuple[int, ...],
    baudrate: str,
    bare: bool,
    object_pct: float | None,
    start: float,
    closed_at: int,
    wiring: int | None,
    line_time: bool,
    latency_timer: float,
    faults: tuple[str, ...],
    faults_from_stdin: bool,
    seed: int,
    eeprom: Path | None,
    any_baudrate: bool,
    fast_reads: bool,
    backup: bool,
    protocol_1: bool,
    real_time: bool,
) -> None:
    """Emulate a DYNAMIXEL MX-64 (Protocol 2.0) with an EZGripper on its shaft.

    Use --bare for ROBOTIS' own examples: they move between ends of the range that no gripper
    reaches.

    Prints "ready: PATH ..." when it answers there. Ctrl-C or SIGTERM ends it and removes the
    link.
    """
    from dexkit.emulators.faults import parse_fault
    from dexkit.emulators.line_port import SCHEME, line_port
    from dexkit.emulators.mx64 import (
        Bus,
        Firmware,
        GripperMechanics,
        Physics,
        Servo,
        Wiring,
    )
    from dexkit.emulators.mx64.protocol1 import Protocol1Servo
    from dexkit.service.realtime import real_time as real_time_priority

    plan = [parse_fault(spec) for spec in faults]
    if bare:
        _refuse_gripper_options("--bare has none", "object_pct", "start", "closed_at")
        mechanics = GripperMechanics.none()
    else:
        mechanics = GripperMechanics(closed_at=closed_at, start=start, object_pct=object_pct)
    grippers = [(number, mechanics) for number in ids]
    if wiring is not None:
        _refuse_gripper_options(
            "--wiring sets it", "bare", "ids", "object_pct", "start", "closed_at"
        )
        sides = Wiring.random(wiring).servos.values()
        grippers = [pair for servos_of in sides for pair in servos_of.items()]
    firmware = Firmware(fast_reads=fast_reads, backup=backup)
    store = _EepromFile(eeprom) if eeprom is not None else None
    with (
        # before the line's thread is started, which inherits it
        real_time_priority() if real_time else nullcontext(True) as granted,
        stop_on_signals() as request,
    ):
        if not granted:
            click.echo("no real-time priority: this user has no rtprio limit", err=True)
        now = RealClock().now()
        servos = []
        if not protocol_1:
            for index, (servo_id, each) in enumerate(grippers):
                servo = Servo(
                    servo_id,
                    baudrate=int(baudrate),
                    physics=dataclasses.replace(Physics(), gripper=each),
                    firmware=firmware,
                    now=now,
                    eeprom=store.load(index) if store else None,
                    seed=seed + index,
                )
                servos.append(servo)
        bus = Bus(
            servos,
            line_time=line_time,
            latency_timer=latency_timer * 1e-3,
            faults=plan,
            start=now,
            seed=seed,
            protocol_1=[Protocol1Servo(i, baudrate=int(baudrate)) for i in ids]
            if protocol_1
            else (),
        )
        if store is not None:
            for servo in servos:
                servo.on_eeprom = lambda: store.save([s.eeprom for s in servos])
        with line_port(bus, link, serial="DKMX64", check_baudrate=not any_baudrate) as port:
            if faults_from_stdin:
                read_faults(lambda spec: port.inject(parse_fault(spec)), request)
            port.start()
            answering = ",".join(
                [str(s.id) for s in bus.servos] + [str(s.id) for s in bus.protocol_1]
            )
            rate = servos[0].baudrate if servos else int(baudrate)
            shown = port.path if link.startswith(SCHEME) else link
            click.echo(f"ready: {shown} id={answering} baudrate={rate} {port.place}")
            sys.stdout.flush()
            while not request.wait(0.2):
                if port.error is not None:
                    raise EmulatorError(f"the emulator stopped: {port.error}") from port.error
        summary = bus.counters.summary() or "nothing was sent"
        if port.overruns:
            summary += f", {port.overruns} bytes not read by the client"
        click.echo(f"stopped: {summary}")
        if bus.failure is not None:
            raise EmulatorError(f"the emulator failed inside: {bus.failure!r}", hint=A_MISTAKE)


def _refuse_gripper_options(why: str, *names: str) -> None:
    """Refuse options of a gripper that another option leaves without meaning.

    :raises UsageError: one was given.
    """
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT:
            option = next(p.opts[0] for p in context.command.params if p.name == name)
            raise click.UsageError(f"{option} describes a gripper, and {why}")


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
