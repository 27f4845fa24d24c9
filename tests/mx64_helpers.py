"""A servo or bus on a manual clock, spoken to as a host would."""

from __future__ import annotations

import dataclasses

from dexkit.emulators.faults import parse_fault
from dexkit.emulators.mx64 import Bus, Firmware, GripperMechanics, Physics, Servo
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import Instruction, Packet
from dexkit.wire.mx64 import Item, OperatingMode

QUIET = Firmware(current_noise=0.0)


def servo(
    servo_id: int = 1,
    *,
    firmware: Firmware = QUIET,
    object_pct: float | None = None,
    start: float = 50.0,
    closed_at: int = 1510,
    eeprom: bytes | None = None,
    baudrate: int = 1_000_000,
    **physics: float,
) -> Servo:
    mechanics = GripperMechanics(closed_at=closed_at, start=start, object_pct=object_pct)
    return Servo(
        servo_id,
        baudrate=baudrate,
        firmware=firmware,
        physics=dataclasses.replace(Physics(gripper=mechanics), **physics),
        eeprom=eeprom,
    )


def write(target: Servo, item: Item, value: int, instruction: int = Instruction.WRITE) -> int:
    """Write an item as a host does; returns the error byte (-1 for no status)."""
    params = item.address.to_bytes(2, "little") + item.encode(value)
    return error_of(target.handle(Packet(target.id, instruction, params)))


def error_of(status: bytes | None) -> int:
    return -1 if status is None else dxl.decode(status).error


def read(target: Servo, item: Item) -> int:
    params = item.address.to_bytes(2, "little") + item.size.to_bytes(2, "little")
    status = target.handle(Packet(target.id, Instruction.READ, params))
    assert status is not None
    return item.decode(dxl.decode(status).data)


def run(target: Servo, seconds: float) -> None:
    target.advance_to(target.now + seconds)


def ready(target: Servo, mode: OperatingMode) -> None:
    """Torque on in a mode, with limits that do not matter."""
    for item, value in (
        (mx64.TORQUE_ENABLE, 0),
        (mx64.OPERATING_MODE, mode),
        (mx64.VELOCITY_LIMIT, 1023),
        (mx64.TORQUE_ENABLE, 1),
    ):
        assert write(target, item, value) == 0, item


class Host:
    """The other end of a bus, in virtual time."""

    def __init__(self, *servos: Servo, faults: tuple[str, ...] = (), **options: object) -> None:
        self.bus = Bus(
            servos or (servo(),),
            faults=[parse_fault(spec) for spec in faults],
            **options,  # type: ignore[arg-type]
        )
        self.now = 0.0
        self.at = 0.0  # when the last byte of the last answer came

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.bus.advance_to(self.now)

    def send(self, packet_id: int, instruction: int, params: bytes = b"") -> list[Packet]:
        return self.send_raw(dxl.encode(packet_id, instruction, params))

    def send_raw(self, data: bytes, *, patience: float = 1.0) -> list[Packet]:
        """Send, wait for all answers, return them."""
        raw = self.exchange_raw(data, patience=patience)
        parser = dxl.PacketParser()
        packets = parser.feed(raw)
        assert parser.skipped == parser.pending == 0, raw.hex(" ")
        return packets

    def exchange_raw(self, data: bytes, *, patience: float = 1.0) -> bytes:
        self.bus.advance_to(self.now)
        self.bus.receive(data, self.now)
        out = b""
        deadline = self.now + patience
        while self.bus.next_time is not None and self.bus.next_time <= deadline:
            self.now = max(self.now, self.bus.next_time)
            self.bus.advance_to(self.now)
            piece = self.bus.due(self.now)
            if piece:
                self.at = self.now
            out += piece
        return out
