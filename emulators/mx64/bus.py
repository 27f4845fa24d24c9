"""Several servos on one half-duplex line behind a USB-serial adapter, sans-IO.

``receive`` takes the bytes that the host sent and when; ``due`` gives the bytes that have
reached the host by a time. In between lie the line and the adapter
(:mod:`dexkit.emulators.serial_line`) and each servo's return delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.emulators.faults import Fault
from dexkit.emulators.mx64.protocol1 import Protocol1Servo
from dexkit.emulators.mx64.servo import Servo
from dexkit.emulators.serial_line import BITS_PER_BYTE, LineCounters, SerialLine
from dexkit.errors import UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire.dynamixel import ErrorNumber, Instruction, Packet, PacketParser
from dexkit.wire.mx64 import HardwareError

__all__ = ["Bus", "Counters"]

_GROUP_READS = (
    Instruction.SYNC_READ,
    Instruction.BULK_READ,
    Instruction.FAST_SYNC_READ,
    Instruction.FAST_BULK_READ,
)
_FAST = (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)


@dataclass
class Counters(LineCounters):
    """Counters of the bus."""

    instructions: int = 0
    statuses: int = 0
    crc_errors: int = 0
    skipped: int = 0


class Bus(SerialLine):
    """The line, its servos and its faults.

    :param servos: on the line; ids must differ.
    :param line_time: bytes, return delay and latency take their time; otherwise everything is
        answered at once.
    :param latency_timer: seconds; 0 for an adapter without one.
    :param faults: to come, times counted from ``start``.
    :param start: time on the caller's clock.
    :param seed: of the faults' random numbers.
    :param protocol_1: servos whose firmware speaks Protocol 1.0 only.
    :raises UsageError: two servos have one id, or there is no servo.
    """

    def __init__(
        self,
        servos: Sequence[Servo],
        *,
        line_time: bool = True,
        latency_timer: float = 1e-3,
        faults: Sequence[Fault] = (),
        start: float = 0.0,
        seed: int = 0,
        protocol_1: Sequence[Protocol1Servo] = (),
    ) -> None:
        if not servos and not protocol_1:
            raise UsageError("a bus needs at least one servo")
        ids = [servo.id for servo in servos] + [servo.id for servo in protocol_1]
        if len(set(ids)) != len(ids):
            raise UsageError(f"servos on one bus need different ids, not {ids}")
        super().__init__(
            line_time=line_time,
            latency_timer=latency_timer,
            faults=faults,
            start=start,
            seed=seed,
        )
        self.servos = list(servos)
        self.protocol_1 = list(protocol_1)
        self.counters: Counters = Counters()
        self._parser = PacketParser(keep_bad=True)
        self._last_byte = start
        self._parser_rate: int | None = None
        self._byte_gap = min((s.firmware.byte_gap for s in servos), default=1.5e-3)
        for servo in self.servos:
            servo.advance_to(start)

    # --- time and faults

    def advance_to(self, now: float) -> None:
        """Advance faults and servos to ``now``."""
        for fault, begins in self.schedule.poll(now):
            self._apply_fault(fault, begins)
        for servo in self.servos:
            servo.advance_to(now)

    @property
    def busy(self) -> bool:
        """Whether a servo moves or holds, so that :meth:`advance_to` should be called often."""
        return any(not servo.drive.resting for servo in self.servos)

    def _apply_fault(self, fault: Fault, begins: bool) -> None:
        if fault.kind == "unplug":
            self._apply_plug()
            self._parser.reset()
            return
        for servo in self.servos:
            if fault.device is not None and fault.device != servo.id:
                continue
            drive = servo.drive
            if fault.kind == "overload":
                servo.raise_error(HardwareError.OVERLOAD)
            elif fault.kind == "encoder":
                servo.raise_error(HardwareError.ENCODER)
            elif fault.kind == "shock":
                servo.raise_error(HardwareError.ELECTRICAL_SHOCK)
            elif fault.kind == "overheat":
                drive.temperature = fault["c"]
            elif fault.kind == "stuck":
                drive.joint.locked = begins
            elif fault.kind == "brown-out":
                drive.supply = fault["volts"] if begins else servo.physics.supply_voltage

    # --- from the host

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the host's adapter began to send at ``now``.

        Call it in order of time, after :meth:`advance_to` of the same ``now``.
        """
        self.counters.bytes_in += len(data)
        rate = self.host_baudrate
        hearing = [s for s in self.servos if rate is None or s.baudrate == rate]
        if rate is not None and not hearing and all(s.baudrate != rate for s in self.protocol_1):
            # at the wrong baud rate they become other bytes, and no packet
            self.counters.garbled += len(data)
            return
        begin = max(now, self._line_free) if self.line_time else now
        line_rate = rate or (hearing[0].baudrate if hearing else 1_000_000)
        byte_time = BITS_PER_BYTE / line_rate if self.line_time else 0.0
        if self._parser.pending and (
            begin - self._last_byte > self._byte_gap or self._parser_rate != rate
        ):
            self._parser.reset()
        self._parser_rate = rate
        arrival = begin + len(data) * byte_time
        self._line_free = self._last_byte = arrival
        for old in self.protocol_1:
            if rate is None or old.baudrate == rate:
                for answer in old.feed(data):
                    self._answer(arrival + old.return_delay * self.line_time, answer, line_rate)
        for packet in self._parser.feed(data):
            for servo in self.servos:
                servo.advance_to(arrival)
            try:
                self._dispatch(packet, hearing, arrival)
            except Exception as error:  # one packet must not end the others' service
                self._record_failure(error, packet)
        self.counters.crc_errors = self._parser.crc_errors
        self.counters.skipped = self._parser.skipped

    def _dispatch(self, packet: Packet, hearing: list[Servo], at: float) -> None:
        hearing = [s for s in hearing if not s.silent]
        if packet.is_status:
            return
        if not packet.crc_ok:
            for servo in hearing:
                if packet.id == servo.id and servo.firmware.answer_bad_crc:
                    self._status(servo, at, servo.status(ErrorNumber.CRC))
            return
        self.counters.instructions += 1
        for servo in hearing:
            servo.note_packet()
        code = packet.instruction
        if packet.id == dxl.BROADCAST_ID and code == Instruction.PING:
            self._broadcast_ping(hearing, at)
        elif code in _GROUP_READS:
            self._group_read(packet, hearing, at)
        elif code in (Instruction.SYNC_WRITE, Instruction.BULK_WRITE):
            self._group_write(packet, hearing)
        else:
            self._single(packet, hearing, at)

    def _single(self, packet: Packet, hearing: list[Servo], at: float) -> None:
        answers = []
        for servo in hearing:
            if packet.id in (servo.id, servo.secondary_id, dxl.BROADCAST_ID):
                # a change of id or baud rate counts from the next packet on
                delay, rate = servo.return_delay, servo.baudrate
                answer = servo.handle(packet)
                if answer is not None:
                    answers.append((delay, rate, answer))
        if not answers:
            return
        delay, rate, data = answers[0]
        for _, _, other in answers[1:]:
            # two servos with one id drive the line at once; a 0 bit wins
            size = max(len(data), len(other))
            mixed = zip(data.ljust(size, b"\xff"), other.ljust(size, b"\xff"), strict=True)
            data = bytes(a & b for a, b in mixed)
        self._answer(at + delay * self.line_time, data, rate)

    def _broadcast_ping(self, hearing: list[Servo], at: float) -> None:
        for servo in sorted(hearing, key=lambda s: s.id):
            slot = at + servo.firmware.ping_slot * servo.id * self.line_time
            self._status(servo, max(at, slot), servo.status(0, servo.ping_data))
            at = max(at, self._line_free)

    def _wanted(self, packet: Packet) -> list[tuple[int, int, int]] | None:
        """(id, address, length) of each servo asked by a group read; None if malformed."""
        params = packet.params
        wanted: list[tuple[int, int, int]] = []
        if packet.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            if len(params) < 5:
                return None
            address = int.from_bytes(params[0:2], "little")
            length = int.from_bytes(params[2:4], "little")
            wanted = [(servo_id, address, length) for servo_id in params[4:]]
        else:
            if not params or len(params) % 5:
                return None
            for i in range(0, len(params), 5):
                address = int.from_bytes(params[i + 1 : i + 3], "little")
                length = int.from_bytes(params[i + 3 : i + 5], "little")
                wanted.append((params[i], address, length))
        ids = [servo_id for servo_id, _, _ in wanted]
        return wanted if len(set(ids)) == len(ids) else None

    def _group_read(self, packet: Packet, hearing: list[Servo], at: float) -> None:
        fast = packet.instruction in _FAST
        by_id = {servo.id: servo for servo in hearing}
        if packet.id != dxl.BROADCAST_ID:
            servo = by_id.get(packet.id)
            if servo is not None:
                self._status(servo, at, servo.status(ErrorNumber.INSTRUCTION))
            return
        wanted = self._wanted(packet)
        if wanted is None:
            return
        # the first servo announces the length of all; what no packet can hold is not answered
        whole = dxl.fast_length([length for _, _, length in wanted])
        if fast and whole > dxl.MAX_LENGTH:
            return
        parts: list[tuple[int, int, bytes]] = []
        for servo_id, address, length in wanted:
            servo = by_id.get(servo_id)
            answers = (
                servo is not None
                and servo.answers_reads(sync=True)
                and (servo.firmware.fast_reads or not fast)
            )
            if servo is None or not answers:
                if any(s.firmware.missing_id_stalls for s in hearing):
                    break
                continue
            error, data = servo.read_block(address, length)
            if fast:
                # the combined packet has a place of fixed size for each
                parts.append((servo_id, servo.error_byte(error), data or bytes(length)))
                at = max(at, self._line_free) + servo.return_delay * self.line_time
            else:
                self._status(servo, at, servo.status(error, data))
                at = max(at, self._line_free)
        if parts:
            rate = by_id[parts[0][0]].baudrate
            # a chain that breaks leaves the first part's length unfulfilled
            data = dxl.fast_status(parts)
            if len(parts) < len(wanted):
                data = data[:5] + whole.to_bytes(2, "little") + data[7:]
            self._answer(at, data, rate)

    def _group_write(self, packet: Packet, hearing: list[Servo]) -> None:
        if packet.id != dxl.BROADCAST_ID:
            return
        for servo_id, address, data in self._writes(packet):
            for servo in hearing:
                if servo_id in (servo.id, servo.secondary_id):
                    servo.write_block(
                        address,
                        data,
                        eeprom=servo_id == servo.id,
                        clamp=servo.firmware.sync_write_clamps,
                    )

    def _writes(self, packet: Packet) -> list[tuple[int, int, bytes]]:
        params = packet.params
        writes: list[tuple[int, int, bytes]] = []
        if packet.instruction == Instruction.SYNC_WRITE:
            if len(params) < 4:
                return []
            address = int.from_bytes(params[0:2], "little")
            length = int.from_bytes(params[2:4], "little")
            entries = params[4:]
            if not length or len(entries) % (1 + length):
                return []
            for i in range(0, len(entries), 1 + length):
                writes.append((entries[i], address, entries[i + 1 : i + 1 + length]))
        else:
            i = 0
            while i + 5 <= len(params):
                address = int.from_bytes(params[i + 1 : i + 3], "little")
                length = int.from_bytes(params[i + 3 : i + 5], "little")
                data = params[i + 5 : i + 5 + length]
                if len(data) < length:
                    return []
                writes.append((params[i], address, data))
                i += 5 + length
            if i != len(params):
                return []
        ids = [servo_id for servo_id, _, _ in writes]
        return writes if len(set(ids)) == len(ids) else []

    # --- to the host

    def _status(self, servo: Servo, at: float, data: bytes) -> None:
        self._answer(at + servo.return_delay * self.line_time, data, servo.baudrate)

    def _answer(self, begin: float, data: bytes, rate: int) -> None:
        """Send ``data`` from a servo, its first bit at ``begin``."""
        self.counters.statuses += 1
        self._send(begin, data, rate)
