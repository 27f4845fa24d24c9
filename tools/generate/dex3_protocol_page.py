"""The tables of docs/dex3-protocol.md, from layouts, scaling, bus map and packers of the codec."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from dexkit.hand import MotorError
from dexkit.models import DEX3_1
from dexkit.wire.crc32 import crc32_words
from dexkit.wire.dex3_usb import units
from dexkit.wire.dex3_usb.codec import DEFAULT_BUS_MAP
from dexkit.wire.dex3_usb.layout import (
    COMMAND_734,
    COMMAND_1234,
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
    CommandLayout,
)
from dexkit.wire.dex3_usb.packets import (
    CommandFrame,
    MotorCmd,
    MotorState,
    SensorState,
    pack_command,
)
from dexkit.wire.ris import RIS_MODE, Structure
from tools.generate import DOCS

__all__ = ["BLOCKS", "PAGE", "files", "worked_example"]

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


def _crc_vectors() -> str:
    inputs = [
        ("`00000000`", bytes(4)),
        ("`FFFFFFFF`", b"\xff" * 4),
        ("`01000000`", b"\x01\0\0\0"),
        ('`3132333435363738` ("12345678")', b"12345678"),
        ("bytes 00 to 0F", bytes(range(16))),
        ("bytes 00 to FF, four times", bytes(range(256)) * 4),
        ("728 zero bytes: an empty 734-byte command, mode 0", bytes(728)),
        ("1228 zero bytes: an empty 1234-byte command, mode 0", bytes(1228)),
        ("1264 zero bytes: an empty state frame", bytes(1264)),
    ]
    return _table(
        ["bytes as they lie in memory", "CRC"],
        [[name, f"`{crc32_words(data):08X}`"] for name, data in inputs],
    )


def worked_example(layout: CommandLayout) -> bytes:
    """Seven motors in FOC, kp 1.5, kd 0.2; all of ratio 108, head FC FD
    (docs/sources/unitree-dex.md#c10).
    """
    targets = ((0.0, 0.2, 0.5), (-0.3, -0.6), (-0.4, -0.8), (), ())
    buses = [
        [
            MotorCmd(
                id=number,
                status=1,
                timeout=False,
                tor_des=0,
                spd_des=0,
                pos_des=units.POSITION.encode(q, 108),
                k_pos=units.STIFFNESS.encode(1.5, 108),
                k_spd=units.DAMPING.encode(0.2, 108),
            )
            for number, q in enumerate(bus)
        ]
        for bus in targets
    ]
    return pack_command(CommandFrame(buses, head=b"\xfc\xfd"), layout)


def _example() -> str:
    lines = []
    data = worked_example(COMMAND_1234)

    def line(at: int, parts: list[int], comment: str) -> None:
        cut, texts = at, []
        for part in parts:
            texts.append(data[cut : cut + part].hex())
            cut += part
        lines.append(f"{at:<5}{' '.join(texts):<61}{comment}")

    line(0, [2, 4, 4, 4, 4, 4, 4], "head, mode, cmd_size[5]")
    sizes = [len(part) for part in ((0,) * 60, (0,) * 40, (0,) * 40)]
    for bus, size in enumerate(sizes):
        for number in range(size // MOTOR_CMD.size):
            at = COMMAND_1234.bus_offset(bus) + number * MOTOR_CMD.size
            packet = MotorCmd.parse(data[at : at + MOTOR_CMD.size])
            q = units.POSITION.decode(packet.pos_des, 108)
            line(
                at,
                [4, 2, 2, 4, 2, 2, 4],
                f"bus {bus} id {number}: q = {q:.4f} rad ({packet.pos_des})",
            )
    line(1226, [4, 4], "reserve, crc")
    digests = [
        f"{layout.name} bytes: SHA-256 `{hashlib.sha256(worked_example(layout)).hexdigest()}`"
        for layout in (COMMAND_1234, COMMAND_734)
    ]
    return "```text\n" + "\n".join(lines) + "\n```\n\n" + "  \n".join(digests)


def _packets() -> str:
    motor = MotorState(0, 1, False, 30, 40, 48, 0, 0, 11000)
    sensor = SensorState(1, 0, tuple(range(1000, 1012)), (25,) * 12)
    return _table(
        ["packet", "bytes"],
        [
            [
                "motor state, id 0, FOC, case 30 °C, winding 40 °C, 24 V, position 11000",
                f"`{motor.pack().hex()}`",
            ],
            [
                "sensor state, id 1, pressures 1000 to 1011, temperatures 25 °C",
                f"`{sensor.pack().hex()}`",
            ],
        ],
    )


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
    "crc-vectors": _crc_vectors,
    "example": _example,
    "packets": _packets,
}
"""What is between ``<!-- made: NAME -->`` and ``<!-- end -->``."""


def files() -> dict[Path, str]:
    """The page with every block generated."""
    text = PAGE.read_text(encoding="utf-8")
    return {PAGE: _BLOCK.sub(lambda m: f"{m[1]}\n{BLOCKS[m[2]]()}\n\n{m[3]}", text)}
