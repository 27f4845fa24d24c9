"""``dexkit calibrate``: measure and store a gripper's zero and speed."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import click
from rich.table import Table

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    Number,
    device_option,
    dry_run_option,
    one_side_option,
    yes_option,
)
from dexkit.console import Console
from dexkit.drivers.ezgripper import (
    EZGripper,
    GripperSettings,
    calibration,
    discovery,
    servo_registers,
)
from dexkit.drivers.ezgripper.bus import ServoBus
from dexkit.drivers.ezgripper.calibration_file import GripperRecord, Store, record_key
from dexkit.drivers.ezgripper.control import ControlSettings
from dexkit.drivers.ezgripper.force import ForceTable
from dexkit.drivers.ezgripper.gripper import stored_device
from dexkit.drivers.ezgripper.scaling import amperes
from dexkit.drivers.ezgripper.servo import Servo
from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.hand import Side
from dexkit.stop_signals import StopRequest, stop_on_signals
from dexkit.wire import mx64

__all__ = ["command"]

_HIGHEST_ID = 252
_HIGHEST_BAUDRATE = 12_000_000
_RUNS = 3
"""Strokes each way for the speed."""
_MOST_CLOSING = 60.0
_LEAST_FORCE = 10.0
_FORCE_EFFORTS = (10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 65.0, 80.0)
"""Percent, as far as they are below the most that is asked for."""


class _NumberOrAuto(click.ParamType):  # type: ignore[type-arg]
    name = "N|auto"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> object:
        if value == "auto" or isinstance(value, int):
            return value
        if re.fullmatch("[0-9]{1,9}", str(value)) and int(str(value)) <= _HIGHEST_BAUDRATE:
            return int(str(value))
        self.fail(
            f"{one_line(value, 40)!r} is neither a number up to {_HIGHEST_BAUDRATE} nor 'auto'",
            param,
            ctx,
        )


class _Ids(click.ParamType):  # type: ignore[type-arg]
    """One or two servo ids as a tuple, or ``auto``."""

    name = "N[,N]|auto"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> object:
        if value == "auto" or isinstance(value, tuple):
            return value
        words = str(value).split(",")
        if len(words) <= 2 and all(
            re.fullmatch("[0-9]{1,3}", word) and int(word) <= _HIGHEST_ID for word in words
        ):
            return tuple(map(int, words))
        self.fail(
            f"{one_line(value, 40)!r} is neither a servo id up to {_HIGHEST_ID}, nor two (1,2), "
            "nor 'auto'",
            param,
            ctx,
        )


@click.command(
    "calibrate",
    cls=Command,
    exit_codes={
        0: "measured and stored",
        1: "the measurement failed; nothing is stored",
    },
)
@click.argument("gripper", type=click.Choice(["ezgripper", "dex1-serial"]), default="ezgripper")
@device_option("Serial port, or its USB serial number.")
@one_side_option(
    "Side of the gripper. Required for dex1-serial; for an EZGripper it selects the adapter "
    "that the file names for this side."
)
@click.option(
    "--id",
    "ids",
    type=_Ids(),
    default="1",
    show_default=True,
    metavar="N[,N]|auto",
    help="Servo id, or auto; N,N are the two servos of a quad gripper. Each of them is calibrated "
    "alone, the other one limp or held open.",
)
@click.option(
    "--baudrate",
    type=_NumberOrAuto(),
    default=1_000_000,
    show_default=True,
    help="Bits per second, or auto to try the known rates.",
)
@click.option(
    "--measure",
    type=click.Choice(["zero", "speed", "distances", "force"]),
    default="zero",
    show_default=True,
    help="The zero; with speed also the speed, at full effort; with distances also moves of "
    "several distances, whose overhead is printed; or only the force table, with a gauge.",
)
@click.option(
    "--effort",
    type=Number(5, 100),
    metavar="PCT",
    help=f"Effort while searching the closed position, at most {_MOST_CLOSING:g}  "
    f"[default: {calibration.EFFORT:g}]; of a force table the largest effort, as in 'serve --set "
    f"effort=PCT', at least {_LEAST_FORCE:g}  [default: {ControlSettings().effort:g}]. A higher "
    "effort heats the motor more.",
)
@click.option(
    "--set-baudrate",
    type=click.Choice([str(b) for b in mx64.BAUD_RATES.values() if b < 4_500_000]),
    help="First change the servo's baud rate; 1000000 is what dexkit expects.",
)
@click.option(
    "--config",
    type=LocalPath(dir_okay=False),
    help="File to store in, instead of the user's.",
)
@dry_run_option("Only print the servo's state: nothing moves, nothing is written.")
@yes_option("whether the gripper is empty")
@click.option("--show", is_flag=True, help="Print the stored values, and stop.")
@click.pass_context
def command(
    ctx: click.Context,
    gripper: str,
    device: str | None,
    side: str | None,
    ids: tuple[int, ...] | str,
    baudrate: int | str,
    measure: str,
    effort: float | None,
    set_baudrate: str | None,
    config: Path | None,
    dry_run: bool,
    yes: bool,
    show: bool,
) -> None:
    """Measure and store a gripper's zero, its speed or its force table.

    The gripper MOVES: it closes until it is stopped, then opens. It must be empty and free. The
    result is stored under the adapter's USB serial number (without one, under its path), so that it
    does not depend on the port.

    With dex1-serial nothing moves: you hold the jaws closed, and the motor itself stores that
    position as its zero. Only the options --device, --side, --dry-run and --yes apply.
    """
    if gripper == "dex1-serial":
        from dexkit.cli.calibrate_dex1 import calibrate_dex1

        _refuse_foreign(ctx, {"gripper", "device", "side", "dry_run", "yes"}, gripper)
        calibrate_dex1(device, side, dry_run=dry_run, yes=yes)
        return
    store = Store(config)
    if show:
        _print_store(store)
        return
    if device is not None and side is not None:
        raise UsageError("for an ezgripper, --side cannot be combined with --device")
    if device is None and side is None:
        raise UsageError(
            "no gripper is given",
            hint="--device PATH or USB serial number, or --side left|right of the file",
        )
    if device is None:
        device = stored_device(store, Side(side))
    force = measure == "force"
    if effort is None:
        effort = ControlSettings().effort if force else calibration.EFFORT
    if force and effort < _LEAST_FORCE:
        raise UsageError(f"--effort {effort:g}: a force table needs {_LEAST_FORCE:g} or more")
    if not force and effort > _MOST_CLOSING:
        raise UsageError(f"--effort {effort:g}: the gripper closes with at most {_MOST_CLOSING:g}")
    pair = not isinstance(ids, str) and len(ids) == 2
    for option, given in (("--measure force", force), ("--set-baudrate", set_baudrate)):
        if pair and given:
            raise UsageError(f"{option} is for one servo at a time", hint="give --id N")
    console = Console()
    configuration = GripperSettings(
        id=None if isinstance(ids, str) else ids[0],
        ids=ids if pair and not isinstance(ids, str) else (),
        baudrate=baudrate if isinstance(baudrate, int) else None,
        config=config,
    )
    hand = EZGripper(device, configuration=configuration)
    if dry_run:
        _print_servo(hand, console, store)
        return
    if not yes and not sys.stdin.isatty():
        raise UsageError("cannot ask whether the gripper is empty: no terminal", hint="give --yes")
    if not yes and not click.confirm(
        "The gripper will move. Put the gauge between the fingers. Ready?"
        if force
        else "The gripper will close and open. Is it empty and free to move?"
    ):
        raise click.Abort
    with stop_on_signals() as stop:
        try:
            servo = hand.connect(lambda text: console.print(f"[dim]{text}[/dim]"))
            if set_baudrate is not None:
                _change_baudrate(servo, int(set_baudrate))
                console.print(f"servo {servo.id} is at {set_baudrate} baud now")
            records = {}
            for unit in hand.units:
                servo = unit.servo
                console.print(f"servo {servo.id} on {servo.bus.path} is set up; key {unit.key}")
                if force:
                    table = _force(hand, servo, console, stop, effort)
                    records[unit.key] = GripperRecord(force_table=table)
                else:
                    records[unit.key] = _zero_and_speed(
                        servo,
                        console,
                        stop,
                        effort,
                        measure,
                        stroke=unit.stroke,
                    )
        except calibration.CalibrationFailed:
            if stop:
                raise click.Abort from None
            raise
        finally:
            hand.close()
        for key, record in records.items():
            store.write(key, record)
    console.print(f"stored for {', '.join(records)} in {store.path}")


def _refuse_foreign(ctx: click.Context, known: set[str], gripper: str) -> None:
    """Refuse options that mean nothing for that gripper.

    :raises UsageError: naming the first of them.
    """
    for parameter in ctx.command.params:
        name = parameter.name or ""
        source = ctx.get_parameter_source(name)
        if name not in known and source is not click.core.ParameterSource.DEFAULT:
            raise UsageError(f"{parameter.opts[0]} does not apply to {gripper}")


def _zero_and_speed(
    servo: Servo,
    console: Console,
    stop: StopRequest,
    effort: float,
    measure: str,
    *,
    stroke: int,
) -> GripperRecord:
    def progress(text: str) -> None:
        console.print(text)

    def cancelled() -> bool:
        return bool(stop)

    zero = calibration.find_zero(
        servo, stroke=stroke, effort=effort, progress=progress, cancelled=cancelled
    )
    console.print(f"zero: {zero} ticks")
    if measure == "zero":
        return GripperRecord(zero=zero)
    result = calibration.measure_speed(
        servo, zero, stroke=stroke, runs=_RUNS, progress=progress, cancelled=cancelled
    )
    console.print(f"speed: opens {result.opening:.0f} %/s, closes {result.closing:.0f} %/s")
    if measure == "distances":
        ways = calibration.measure_distances(
            servo, zero, stroke=stroke, progress=progress, cancelled=cancelled
        )
        for verb, way in zip(("open", "close"), ways, strict=True):
            console.print(
                f"overhead of a move: {1e3 * way.overhead:.0f} ms to {verb}, beside "
                f"{way.speed:.0f} %/s; not stored, and in no prediction"
            )
    return GripperRecord(zero=zero, opening=result.opening, closing=result.closing)


def _force(
    hand: EZGripper, servo: Servo, console: Console, stop: StopRequest, up_to: float
) -> ForceTable:
    zero = hand.record.zero
    if zero is None:
        raise UsageError(
            "the zero is not known yet", hint="run 'dexkit calibrate' without --measure first"
        )
    points = [(0.0, 0.0)]
    for effort in (*(e for e in _FORCE_EFFORTS if e < up_to), up_to):
        asked = _Question()
        current = calibration.measure_current(
            servo, zero, effort, asked.holding, cancelled=lambda: bool(stop)
        )
        console.print(f"{effort:g} %: {current:.0f} units ({amperes(current):.2f} A)")
        points.append((float(round(current)), asked.answer))  # SAKE's driver reads whole numbers
    return ForceTable(tuple(points))


class _Question:
    """Asks for the gauge's reading while the gripper goes on holding."""

    def __init__(self) -> None:
        self.answer = 0.0
        self._thread: threading.Thread | None = None
        self._failed: BaseException | None = None

    def _ask(self) -> None:
        try:
            self.answer = click.prompt("force that the gauge shows", type=Number(0))
        except BaseException as error:  # end of input, for example: belongs to the main thread
            self._failed = error

    def holding(self, current: float) -> bool:
        if self._thread is None:
            self._thread = threading.Thread(target=self._ask, daemon=True)
            self._thread.start()
        if self._thread.is_alive():
            return True
        if self._failed is not None:
            raise click.Abort from self._failed
        return False


def _change_baudrate(servo: Servo, baudrate: int) -> None:
    value = next(k for k, b in mx64.BAUD_RATES.items() if b == baudrate)
    if servo.bus.baudrate == baudrate:
        return
    servo.set_torque(False)
    # whether the answer comes at the old or the new rate is not documented: ask for none
    servo.bus.write_unacknowledged(servo.id, mx64.BAUD_RATE.address, mx64.BAUD_RATE.encode(value))
    servo.bus.drain()
    servo.bus.set_baudrate(baudrate)
    servo.bus.ping(servo.id)


def _print_servo(hand: EZGripper, console: Console, store: Store) -> None:
    device = discovery.find_device(hand.device_name)
    configuration = hand.configuration
    warning = discovery.latency_warning(device.path)
    if warning:
        console.print(f"[yellow]{warning}[/yellow]")
    bus = ServoBus(device.path, configuration.baudrate or 1_000_000)
    try:
        for number in configuration.servo_ids:
            ping = discovery.find_servo(bus, number, configuration.baudrate, _print_dim(console))
            console.print(
                f"servo {ping.id} at {bus.baudrate} baud: MX-64(2.0), firmware {ping.firmware}"
            )
            mirrored = bool(store.read(record_key(device.key, ping.id)).mirrored)
            differing = servo_registers.differences(bus, ping.id, mirrored=mirrored)
            for item, found, wanted in differing:
                console.print(f"  {item.name}({item.address}) is {found}, would be set to {wanted}")
            if not differing:
                console.print("  its EEPROM holds what the driver needs")
    finally:
        bus.close()
    _print_store(store)


def _print_dim(console: Console) -> Callable[[str], None]:
    return lambda text: console.print(f"[dim]{text}[/dim]")


def _describe_table(record: GripperRecord) -> str:
    if record.force_table is None:
        return "default"
    points = f"{len(record.force_table.points)} points"
    return points if record.force_unit_known else f"{points}, no unit"


def _print_store(store: Store) -> None:
    console = Console()
    keys = store.keys()
    if not keys:
        console.print(f"nothing is stored in {store.path}")
        return
    table = Table(box=None, pad_edge=False, header_style="bold", title=str(store.path))
    for heading in ("gripper", "zero (ticks)", "opens (%/s)", "closes (%/s)", "force table"):
        table.add_column(heading)
    for key in keys:
        record = store.read(key)
        table.add_row(
            key,
            *(
                "-" if v is None else f"{v:g}"
                for v in (record.zero, record.opening, record.closing)
            ),
            _describe_table(record),
        )
    console.print(table)
