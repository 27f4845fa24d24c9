"""Settings of the EZGripper driver, which ``--set`` changes on the command line."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path

from dexkit import documents
from dexkit.backends import BackendOptions
from dexkit.drivers.ezgripper.calibration_file import Store
from dexkit.drivers.ezgripper.control import ControlSettings
from dexkit.drivers.ezgripper.force import DEFAULT_FORCE_TABLE, ForceTable
from dexkit.drivers.ezgripper.scaling import STROKE, STROKES
from dexkit.drivers.setting_parsers import parse_settings
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.wire import mx64

__all__ = [
    "PARSERS",
    "Calibrate",
    "GripperSettings",
    "ZeroGains",
    "settings_of",
    "stored_device",
]

log = logging.getLogger(__name__)


class ZeroGains(str, Enum):
    """Effect of a command without gains (kp = kd = dq = tau = 0)."""

    LIMP = "limp"
    POSITION = "position"

    def __str__(self) -> str:
        return self.value


class Calibrate(str, Enum):
    """Whether ``open`` may move the gripper to find its zero."""

    NO = "no"
    AUTO = "auto"
    YES = "yes"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class GripperSettings:
    """Settings of :class:`EZGripper`.

    :param id: servo id, or None for the only servo that answers.
    :param ids: ids of the two servos of a quad gripper, instead of ``id``; empty for one servo.
    :param baudrate: bits a second, or None to try the known ones.
    :param control: limits and times of the control.
    :param calibrate: NO needs a stored zero, and opening never moves; AUTO closes and opens the
        gripper if there is no zero; YES does so always. AUTO and YES act at the first opening only:
        opening again, for example after a lost link, never moves the gripper.
    :param zero: zero in ticks, instead of the stored one; of one servo.
    :param mirrored: the fingers close while the encoder's position rises; None as stored.
    :param stroke: ticks from closed to open; None as stored, or that of SAKE's grippers.
    :param config: file of the stored calibration; None for the user's file.
    :param force_table: table instead of the stored one.
    :param zero_gains: LIMP: a command whose kp, kd, dq and tau are 0 lets go, as the vendor's
        gripper does. POSITION: it is a position command, for clients that send q alone (SAKE's).
    :param timeout: seconds to wait for a status packet.
    :param retries: how often an unanswered transaction is sent again within an exchange.
    """

    id: int | None = 1
    ids: tuple[int, ...] = ()
    baudrate: int | None = 1_000_000
    control: ControlSettings = field(default_factory=ControlSettings)
    calibrate: Calibrate = Calibrate.NO
    zero: int | None = None
    mirrored: bool | None = None
    stroke: int | None = None
    config: Path | None = None
    force_table: ForceTable | None = None
    zero_gains: ZeroGains = ZeroGains.LIMP
    timeout: float = 0.03
    retries: int = 2

    def __post_init__(self) -> None:
        for number in self.servo_ids:
            if number is not None and not 0 <= number <= 252:
                raise UsageError(f"id must be 0 to 252, not {number}")
        if self.ids and (len(self.ids) > 2 or len(set(self.ids)) < len(self.ids)):
            raise UsageError(
                f"ids are those of one servo, or of the two of a quad gripper, not {self.ids}"
            )
        if self.stroke is not None and not STROKES[0] <= self.stroke <= STROKES[1]:
            raise UsageError(
                f"stroke must be {STROKES[0]} to {STROKES[1]} ticks, not {self.stroke}"
            )
        if self.zero is not None and len(self.ids) > 1:
            raise UsageError(
                "each servo of a quad gripper has a zero of its own",
                hint="calibrate it: dexkit calibrate ezgripper --id N for each servo",
            )
        if self.baudrate is not None and self.baudrate not in mx64.BAUD_RATES.values():
            raise UsageError(
                f"an MX-64 has no baud rate {self.baudrate}",
                hint="known: " + ", ".join(str(b) for b in mx64.BAUD_RATES.values()),
            )
        if not 0 < self.timeout <= 1:
            raise UsageError(f"timeout must be within 0 and 1 s, not {self.timeout:g}")
        if not 0 <= self.retries <= 10:
            raise UsageError(f"retries must be 0 to 10, not {self.retries}")

    @property
    def servo_ids(self) -> tuple[int | None, ...]:
        """Id of each servo; None for the only one that answers."""
        return self.ids or (self.id,)


def _in_range(low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise ValueError(f"not within {low:g} and {high:g}")
        return value

    return parse


def _parse_or_auto(text: str) -> int | None:
    return None if text == "auto" else int(text)


def _parse_ids(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


def _parse_sign(text: str) -> bool:
    """Whether the servo is mirrored."""
    if text not in ("+", "-"):
        raise ValueError("+ or -")
    return text == "-"


def _read_force_table(text: str) -> ForceTable:
    if text == "default":
        return DEFAULT_FORCE_TABLE
    content = documents.read_json(Path(text))
    if not isinstance(content, dict):
        raise ValueError("the file must hold a JSON object")
    return ForceTable.from_mapping(content)


_CONTROL = {f.name for f in fields(ControlSettings)}

PARSERS: dict[str, tuple[Callable[[str], object], str]] = {
    "id": (_parse_or_auto, "servo id, or auto for the one that answers (default 1)"),
    "ids": (_parse_ids, "ids of the two servos of a quad gripper, such as 1,2, instead of id"),
    "baudrate": (_parse_or_auto, "bits a second, or auto to try those known (default 1000000)"),
    "calibrate": (
        Calibrate,
        "no: needs a stored zero; auto: moves at the start to find one if needed; "
        "yes: always (default no)",
    ),
    "sign": (
        _parse_sign,
        "+: the fingers open while the encoder's position rises; - (default as stored, else +)",
    ),
    "stroke": (
        int,
        f"servo ticks from closed to open (default as stored, else {STROKE})",
    ),
    "zero": (int, "zero in servo ticks, instead of the stored one"),
    "config": (Path, "calibration file (default the user's)"),
    "force_table": (
        _read_force_table,
        "JSON file {current units: force}, or default (default: as stored)",
    ),
    "zero_gains": (
        ZeroGains,
        "limp: kp = kd = 0 lets go; position: with dq = tau = 0, too, it goes to q (default limp)",
    ),
    "effort": (_in_range(0, 100), "force limit while moving, % (default 50)"),
    "hold_effort": (_in_range(0, 100), "force limit while holding and braking, % (default 15)"),
    "hold_after": (_in_range(0, 60), "seconds of contact until hold_effort (default 0.5)"),
    "speed": (_in_range(0, 1000), "speed limit, % of stroke a second (default 150)"),
    "startup_speed": (_in_range(0, 1000), "speed limit of the first motion, %/s (default 50)"),
    "startup_time": (_in_range(0, 60), "seconds after which that limit ends anyway (default 3)"),
    "warm": (_in_range(0, 80), "degC from which effort is reduced to hold_effort (default 70)"),
    "timeout": (_in_range(0, 1), "seconds to wait for a reply (default 0.03)"),
    "retries": (int, "times that an unanswered request is repeated (default 2)"),
}


def settings_of(options: BackendOptions) -> GripperSettings:
    """Build the settings from command-line options.

    :raises UsageError: a value cannot be parsed or is out of range, or two contradict each other.
    """
    values = parse_settings(options.settings, PARSERS)
    if "id" in values and "ids" in values:
        raise UsageError("give id of one servo, or ids of two, not both")
    if "sign" in values:
        values["mirrored"] = values.pop("sign")
    control = ControlSettings(**{k: v for k, v in values.items() if k in _CONTROL})  # type: ignore[arg-type]
    rest = {k: v for k, v in values.items() if k not in _CONTROL}
    return GripperSettings(control=control, **rest)  # type: ignore[arg-type]


def stored_device(store: Store, side: Side) -> str:
    """USB serial number or path of the adapter that the calibration file names for a side.

    :raises UsageError: it names none.
    """
    device = store.device(side)
    if device is None:
        raise UsageError(
            f"no gripper is given, and {store.path} names none for the {side} hand",
            hint=f"give --device PATH or USB serial number, or {side}_serial in that file",
        )
    log.info("the %s gripper is on %s (%s)", side, device, store.path)
    return device
