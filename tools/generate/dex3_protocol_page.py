"""The tables of docs/dex3-protocol.md, from layouts, scaling and bus map of the codec."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from dexkit.hand import MotorError
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import units
from dexkit.wire.dex3_usb.codec import DEFAULT_BUS_MAP
from dexkit.wire.dex3_usb.layout import (
    COMMAND_LAYOUTS,
    MANUFACTURER,
    MOTOR_CMD,
    MOTOR_STATE,
    N_BUSES,
    PRODUCT,
    PRODUCT_ID,
    SENSOR_STATE,
    STATE,
    STATE_BUS_SIZE,
    VENDOR_ID,
)
from dexkit.wire.ris import RIS_MODE, Structure
from tools.generate import DOCS

__all__ = ["BLOCKS", "PAGE", "files"]

PAGE = DOCS / "dex3-protocol.md"

_BLOCK = re.compile(r"(<!-- made: ([a-z0-9-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def _table(headings: list[str], rows: list[list[object]]) -> str:
    lines: list[Sequence[object]] = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _structure(structure: Structure) -> str:
    start, end = structure.covered
    rows: list[list[object]] = [
        [
            structure.offsets[f.name],
            f.size,
            f.type if f.count == 1 else f"{f.type}[{f.count}]",
            f"`{f.name}`",
            f.meaning,
            f.unit,
        ]
        for f in structure.fields
    ]
    table = _table(["offset", "size", "type", "field", "meaning", "one count is"], rows)
    return (
        f"{table}\n\n{structure.size} bytes. CRC over bytes {start} to {end - 1}: "
        f"{(end - start) // 4} words."
    )


def _commands() -> str:
    """Both layouts beside each other."""
    first, second = (layout.structure for layout in COMMAND_LAYOUTS)
    rows: list[list[object]] = [
        [
            first.offsets[f.name],
            second.offsets[f.name],
            f"`{f.type}[{N_BUSES}][N]`" if f.name == "cmd" else _type(f.type, f.count),
            f"`{f.name}`",
            f"{N_BUSES} bus buffers" if f.name == "cmd" else f.meaning,
        ]
        for f in first.fields
    ]
    headings = [f"offset, N = {layout.bus_size}" for layout in COMMAND_LAYOUTS]
    notes = [
        f"N = {layout.bus_size}: {layout.size} bytes, bus buffers at "
        + ", ".join(str(layout.bus_offset(bus)) for bus in range(N_BUSES))
        + f", CRC over bytes 2 to {layout.structure.covered[1] - 1} "
        f"({(layout.structure.covered[1] - 2) // 4} words)."
        for layout in COMMAND_LAYOUTS
    ]
    return _table([*headings, "type", "field", "meaning"], rows) + "\n\n" + "  \n".join(notes)


def _type(name: str, count: int) -> str:
    return name if count == 1 else f"{name}[{count}]"


def _errors() -> str:
    rows: list[list[object]] = [
        [f"`{int(bit):08X}`", str(bit.name).lower().replace("_", " ").replace("mos ", "MOS ")]
        for bit in MotorError
        if bit
    ]
    return _table(["bit", "meaning"], rows)


def _mode() -> str:
    rows: list[list[object]] = [
        [
            str(f.first) if f.bits == 1 else f"{f.first} to {f.first + f.bits - 1}",
            f"`{f.name}`",
            f.meaning,
        ]
        for f in RIS_MODE
    ]
    return _table(["bits", "field", "meaning"], rows)


def _identity() -> str:
    rows: list[list[object]] = [
        [
            side,
            f"`{VENDOR_ID:04X}`",
            f"`{PRODUCT_ID[side]:04X}`",
            f"`{MANUFACTURER}`",
            f"`{PRODUCT[side]}`",
        ]
        for side in PRODUCT_ID
    ]
    return _table(["hand", "vendor", "product", "manufacturer string", "product string"], rows)


def _figure(value: float) -> str:
    text = f"{value:.8g}"
    return f"{value:.0f}" if "e" in text else text


def _units() -> str:
    ratios = sorted({joint.gear_ratio for j in DEX3_1.joints.values() for joint in j})
    rows: list[list[object]] = []
    for scale in units.SCALES:
        per_joint = [_figure(scale.factor(ratio)) if scale.power else "" for ratio in ratios]
        low, high = (f"{limit:.6g}" for limit in scale.limits(ratios[0]))
        rows.append(
            [
                scale.name,
                ", ".join(f"`{name}`" for name in scale.fields),
                scale.unit,
                _figure(scale.counts),
                *per_joint,
                f"{low} to {high}",
            ]
        )
    columns = [f"of a joint, 1:{ratio:g}" for ratio in ratios]
    return _table(
        ["quantity", "fields", "SI unit", "counts per unit, rotor", *columns, "reach (1:108)"],
        rows,
    )


def _bus_map() -> str:
    joints = next(iter(DEX3_1.joints.values()))
    rows: list[list[object]] = []
    for bus in range(N_BUSES):
        motors = [
            f"{number} {joint.name}"
            for joint, (b, number) in zip(joints, DEFAULT_BUS_MAP.motors, strict=True)
            if b == bus
        ]
        sensors = [
            f"{number} {sensor.place}"
            for sensor, (b, number) in zip(DEX3_1.sensors, DEFAULT_BUS_MAP.sensors, strict=True)
            if b == bus
        ]
        rows.append([bus, ", ".join(motors) or "none", ", ".join(sensors) or "none"])
    return _table(["bus", "motors (id, joint)", "sensor packets (id, place)"], rows)


BLOCKS: dict[str, Callable[[], str]] = {
    "identity": _identity,
    "ris-mode": _mode,
    "errors": _errors,
    "motor-cmd": lambda: _structure(MOTOR_CMD),
    "motor-state": lambda: _structure(MOTOR_STATE),
    "sensor-state": lambda: _structure(SENSOR_STATE),
    "command": _commands,
    "state": lambda: _structure(STATE),
    "state-buses": lambda: (
        "Bus buffers at "
        + ", ".join(str(STATE.offsets["state"] + b * STATE_BUS_SIZE) for b in range(N_BUSES))
        + "."
    ),
    "units": _units,
    "bus-map": _bus_map,
}
"""What is between ``<!-- made: NAME -->`` and ``<!-- end -->``."""


def files() -> dict[Path, str]:
    """The page with every block generated."""
    text = PAGE.read_text(encoding="utf-8")
    return {PAGE: _BLOCK.sub(lambda m: f"{m[1]}\n{BLOCKS[m[2]]()}\n\n{m[3]}", text)}
