"""Store the calibration of each gripper (zero, speeds, force table) in the user's JSON file.

The layout is that of docs/sources/mx64-ezgripper.md#d8-5, so a file of SAKE's driver can be used
unchanged, and what is written has the types that such a driver reads::

    {"left": "/dev/ttyUSB0", "left_serial": "DA1Z9T40",
     "calibration":          {"DA1Z9T40": 3010},
     "movement_speed":       {"DA1Z9T40": 127.5},
     "direction_speeds":     {"DA1Z9T40": {"opening": 131.0, "closing": 127.5}},
     "force_lookup":         {"DA1Z9T40": {"0": 0.0, "100": 0.5}},
     "force_lookup_unit":    {"DA1Z9T40": "3.36 mA"},
     "left_ids": [1, 2], "mirrored": {"DA1Z9T40": true}, "stroke": {"DA1Z9T40": 2480}}

Keys are the USB serial number of the adapter, or the device path where there is none (a
pseudo-terminal); ``#2`` is appended for servo id 2. Zero in ticks within the turn, speed in
percent of stroke a second, force over current units. ``movement_speed`` is the slower of the two
``direction_speeds``; if another program has changed it, that number holds for both directions.
(Earlier files hold the two in ``movement_speed``; they are read.) ``left``, ``right``,
``left_serial`` and ``right_serial`` name the adapter of a side. ``left_ids``, ``right_ids``,
``mirrored`` and ``stroke`` (ticks from closed to open) are of ``dexkit bringup``. Unknown entries
are kept.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import platformdirs

from dexkit import documents
from dexkit.drivers.ezgripper.force import ForceTable
from dexkit.drivers.ezgripper.scaling import STROKES
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.records import to_record
from dexkit.wire import mx64

_HINT = "correct it, or remove it and calibrate again"

__all__ = ["CURRENT_UNIT", "ENVIRONMENT", "GripperRecord", "Store", "default_path", "record_key"]

ENVIRONMENT = "DEXKIT_EZGRIPPER_CONFIG"
"""Environment variable with the path of another file."""

_ZERO, _SPEED, _FORCE = "calibration", "movement_speed", "force_lookup"
_DIRECTIONS, _UNIT = "direction_speeds", "force_lookup_unit"
_MIRRORED, _STROKE = "mirrored", "stroke"
CURRENT_UNIT = "3.36 mA"
"""Unit of the currents of a force table: one count of Present Current(126)."""


def default_path() -> Path:
    """Return ``$DEXKIT_EZGRIPPER_CONFIG``, or ezgripper.json in the user's configuration."""
    named = os.environ.get(ENVIRONMENT)
    return Path(named) if named else platformdirs.user_config_path("dexkit") / "ezgripper.json"


def record_key(device: str, servo_id: int) -> str:
    """Return the key of a gripper in the file.

    :param device: USB serial number, or path.
    """
    return device if servo_id == 1 else f"{device}#{servo_id}"


@dataclass(frozen=True)
class GripperRecord:
    """Stored calibration of one gripper; None where unknown.

    :param zero: position of the closed gripper, ticks within the turn.
    :param opening: percent of stroke a second.
    :param closing: percent of stroke a second.
    :param force_unit_known: the file says that the table is in units of 3.36 mA. A table of SAKE's
        driver, which says nothing, may be of register 40 (docs/sources/mx64-ezgripper.md#d10-1).
    :param mirrored: the fingers close while the encoder's position rises; ``zero`` is then counted
        in the direction in which it falls.
    :param stroke: ticks from closed to open.
    """

    zero: int | None = None
    opening: float | None = None
    closing: float | None = None
    force_table: ForceTable | None = None
    force_unit_known: bool = True
    mirrored: bool | None = None
    stroke: int | None = None


_Speed = Annotated[float, msgspec.Meta(gt=0)]


class _Speeds(msgspec.Struct):
    opening: _Speed | None = None
    closing: _Speed | None = None


class _Entries(msgspec.Struct):
    """The entries of one gripper, by the section of the file."""

    calibration: Annotated[int, msgspec.Meta(ge=-mx64.POSITION_SPAN, le=mx64.POSITION_SPAN)] | None
    movement_speed: _Speed | _Speeds | None
    direction_speeds: _Speed | _Speeds | None
    force_lookup: dict[str, float] | None
    force_lookup_unit: str | None
    mirrored: bool | None
    stroke: Annotated[int, msgspec.Meta(ge=STROKES[0], le=STROKES[1])] | None


def _pair(speeds: float | _Speeds | None) -> tuple[float | None, float | None]:
    """The speeds of opening and closing."""
    if isinstance(speeds, _Speeds):
        return speeds.opening, speeds.closing
    return speeds, speeds


class Store:
    """The calibration file.

    :param path: by default :func:`default_path`.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path if path is not None else default_path()

    def _load(self) -> dict[str, Any]:
        if not os.path.lexists(self.path):
            return {}
        return self._parse(documents.read_text(self.path, hint=_HINT))

    def _parse(self, text: str) -> dict[str, Any]:
        content = documents.parse_json(text, self.path, hint=_HINT)
        if not isinstance(content, dict):
            raise UsageError(f"{self.path} must hold a JSON object")
        return content

    def _get_section(self, content: dict[str, Any], name: str) -> dict[str, Any]:
        section = content.get(name, {})
        if not isinstance(section, dict):
            raise UsageError(f"{self.path}: {name!r} must be an object")
        return section

    def keys(self) -> list[str]:
        """List the keys of all grippers in the file.

        :raises UsageError: the file cannot be read.
        """
        content = self._load()
        names: set[str] = set()
        for section in (_ZERO, _SPEED, _FORCE):
            names.update(self._get_section(content, section))
        return sorted(names)

    def device(self, side: Side) -> str | None:
        """USB serial number, else path, of the adapter of a side; None if the file names none.

        :raises UsageError: the file cannot be read, or an entry is no text.
        """
        content = self._load()
        for name in (f"{side}_serial", str(side)):
            value = content.get(name)
            if value is not None and not isinstance(value, str):
                raise UsageError(f"{self.path}: {name} must be text, not {value!r}")
            if value:
                return value
        return None

    def servo_ids(self, side: Side) -> tuple[int, ...]:
        """Ids of the servos of a side's gripper; empty if the file names none.

        :raises UsageError: the file cannot be read, or they are no ids.
        """
        value = self._load().get(f"{side}_ids", [])
        if not isinstance(value, list) or not all(type(number) is int for number in value):
            raise UsageError(f"{self.path}: {side}_ids must be a list of servo ids, not {value!r}")
        return tuple(value)

    def write_side(self, side: Side, device: str, servo_ids: Sequence[int]) -> None:
        """Store which adapter and which servos a side has.

        :raises UsageError: the file cannot be read or written.
        """

        def change(text: str | None) -> str:
            content = {} if text is None else self._parse(text)
            content[str(side) if "/" in device else f"{side}_serial"] = device
            content[f"{side}_ids"] = list(servo_ids)
            return json.dumps(content, indent=2, sort_keys=True) + "\n"

        documents.update_file(self.path, change)

    def read(self, key: str) -> GripperRecord:
        """Read a gripper's calibration; an empty record if there is none.

        :raises UsageError: the file cannot be read, or this gripper's entries are invalid.
        """
        content = self._load()
        entries = {n: self._get_section(content, n).get(key) for n in _Entries.__struct_fields__}
        found = to_record(entries, _Entries, f"{self.path}: {key}", hint=_HINT)
        if found.force_lookup_unit not in (None, CURRENT_UNIT):
            raise UsageError(
                f"{self.path}: {key}: the force table is in {found.force_lookup_unit!r}, not in "
                f"{CURRENT_UNIT!r}",
                hint="measure it: dexkit calibrate ezgripper --measure force",
            )
        opening, closing = _pair(found.movement_speed)
        directions = _pair(found.direction_speeds)
        known = [speed for speed in directions if speed is not None]
        if opening == closing and known and min(known) == opening:
            opening, closing = directions
        zero, table = found.calibration, found.force_lookup
        return GripperRecord(
            zero=None if zero is None else zero % mx64.TICKS_PER_TURN,
            opening=opening,
            closing=closing,
            force_table=None if table is None else ForceTable.from_mapping(table),
            force_unit_known=table is None or found.force_lookup_unit is not None,
            mirrored=found.mirrored,
            stroke=found.stroke,
        )

    def write(self, key: str, record: GripperRecord) -> None:
        """Store the known values of ``record``; the file keeps its values for the others.

        Concurrent changes of other programs are kept (:func:`dexkit.documents.update_file`).

        :raises UsageError: the file cannot be read or written.
        """

        def change(text: str | None) -> str:
            content = {} if text is None else self._parse(text)
            self._store_record(content, key, record)
            return json.dumps(content, indent=2, sort_keys=True) + "\n"

        documents.update_file(self.path, change)

    def _store_record(self, content: dict[str, Any], key: str, record: GripperRecord) -> None:
        if record.zero is not None:
            content[_ZERO] = self._get_section(content, _ZERO) | {
                key: record.zero % mx64.TICKS_PER_TURN
            }
        speeds = {
            name: round(value, 2)
            for name, value in (("opening", record.opening), ("closing", record.closing))
            if value is not None
        }
        if speeds:
            content[_SPEED] = self._get_section(content, _SPEED) | {key: min(speeds.values())}
            content[_DIRECTIONS] = self._get_section(content, _DIRECTIONS) | {key: speeds}
        for name, value in ((_MIRRORED, record.mirrored), (_STROKE, record.stroke)):
            if value is not None:
                content[name] = self._get_section(content, name) | {key: value}
        if record.force_table is not None:
            content[_FORCE] = self._get_section(content, _FORCE) | {
                key: record.force_table.to_mapping()
            }
            content[_UNIT] = self._get_section(content, _UNIT) | {key: CURRENT_UNIT}
