"""Exchange goals and samples with one servo or a group, with their bus watchdogs enabled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.ezgripper import register_block
from dexkit.drivers.ezgripper.bus import BITS_PER_BYTE, ServoBus
from dexkit.drivers.ezgripper.register_block import Goal, Sample
from dexkit.drivers.ezgripper.servo_registers import (
    WATCHDOG_UNITS,
    ServoLimits,
    apply_settings,
    hold_here,
)
from dexkit.errors import HandTimeout
from dexkit.wire import mx64

__all__ = [
    "BOOT_TIME",
    "Servo",
    "ServoGroup",
    "ServoStatistics",
    "exchange_bytes",
    "line_time",
]

BOOT_TIME = 5.0
"""Seconds after which a rebooted servo should answer again; the true boot time is not published
(docs/sources/mx64-ezgripper.md#d6: its authors waited 0.5 to 1.5 s)."""

_SYNC_WRITE_OVERHEAD = 14
_READ_INSTRUCTION = 14  # also of a sync read, and an id for each servo
_STATUS_OVERHEAD = 11
_RETURN_DELAY = 4e-6  # as settings.py sets it


def exchange_bytes(servos: int = 1) -> tuple[int, int]:
    """Return the bytes on the line of one exchange: (to the servos, from the servos)."""
    sent = _SYNC_WRITE_OVERHEAD + servos * (1 + register_block.WRITE_SIZE) + _read_bytes(servos)
    return sent, servos * (_STATUS_OVERHEAD + register_block.READ_SIZE)


def _read_bytes(servos: int) -> int:
    return _READ_INSTRUCTION + (servos if servos > 1 else 0)


def line_time(baudrate: int, return_delay: float = _RETURN_DELAY, *, servos: int = 1) -> float:
    """Return the seconds that one exchange takes on the line, without the USB adapter.

    With the adapter: :func:`dexkit.drivers.serial_port.exchange_period`.

    :param baudrate: bits a second.
    :param return_delay: seconds that a servo waits before it answers.
    """
    return sum(exchange_bytes(servos)) * BITS_PER_BYTE / baudrate + servos * return_delay


@dataclass
class ServoStatistics:
    """Counters of the exchanges.

    :ivar exchanges: exchanges completed.
    :ivar lost_writes: goals that were not in the next sample.
    :ivar stale: samples with the same Realtime Tick as the one before.
    :ivar watchdog_trips: times that the servo's bus watchdog tripped.
    """

    exchanges: int = 0
    lost_writes: int = 0
    stale: int = 0
    watchdog_trips: int = 0


class Servo:
    """A configured servo.

    :param bus: open, at the servo's baud rate.
    :param servo_id: its id.
    """

    def __init__(self, bus: ServoBus, servo_id: int, clock: Clock | None = None) -> None:
        self.bus = bus
        self.id = servo_id
        self.statistics = ServoStatistics()
        self._clock: Clock = clock if clock is not None else RealClock()
        self._tick = -1
        sent, _ = exchange_bytes()
        self._to_measurement = bus.wire_time(sent)
        self._read_to_measurement = bus.wire_time(_READ_INSTRUCTION)

    def configure(self, *, mirrored: bool = False) -> ServoLimits:
        """Write and verify all registers. As :func:`settings.apply_settings`."""
        return apply_settings(self.bus, self.id, mirrored=mirrored)

    def exchange(self, goal: Goal, before: WriteDeadline | None = None) -> Sample:
        """Write a goal and read a sample.

        :param before: checked right before the goal is written.
        :raises HandTimeout: no answer, or ``before`` raises it.
        :raises HandLost: the port has gone away.
        """
        started = self._clock.now()
        data = register_block.encode(goal)
        self.bus.write_unacknowledged(
            self.id, register_block.WRITE_ADDRESS, data, with_next=True, before=before
        )
        return self.check_goal(goal, self._read(started + self._to_measurement))

    def check_goal(self, goal: Goal, sample: Sample) -> Sample:
        """Count an exchange, and whether its goal has arrived; return its sample."""
        self.statistics.exchanges += 1
        if sample.goal_current != goal.current or sample.goal_position != goal.position:
            self.statistics.lost_writes += 1
        return sample

    def sample(self) -> Sample:
        """Read a sample. Raises as :meth:`exchange`."""
        return self._read(self._clock.now() + self._read_to_measurement)

    def _read(self, measured_at: float) -> Sample:
        data, _ = self.bus.read(self.id, register_block.READ_ADDRESS, register_block.READ_SIZE)
        return self.decode(data, measured_at)

    def decode(self, data: bytes, measured_at: float) -> Sample:
        """The sample in the bytes that have just been read.

        :param measured_at: monotonic seconds, the earliest that it can be.
        """
        received = self._clock.now()
        # the time must not be in the future
        sample = register_block.decode(data, min(measured_at, received), received)
        if sample.tick == self._tick:
            self.statistics.stale += 1
        self._tick = sample.tick
        return sample

    def set_torque(self, on: bool) -> None:
        """Write Torque Enable. Raises as the bus, and ServoError in a shutdown."""
        self.bus.write_item(self.id, mx64.TORQUE_ENABLE, int(on))

    def engage(self, goal: Goal, before: WriteDeadline | None = None) -> None:
        """Write ``goal``, then switch torque on."""
        data = register_block.encode(goal)
        self.bus.write_unacknowledged(self.id, register_block.WRITE_ADDRESS, data, before=before)
        self.set_torque(True)

    def rearm_watchdog(self) -> None:
        """Clear a tripped bus watchdog, so that the servo accepts goals; it holds its position."""
        self.statistics.watchdog_trips += 1
        hold_here(self.bus, self.id, WATCHDOG_UNITS)

    def hardware_error(self) -> int:
        """Read Hardware Error Status(70), one byte: address 71 does not exist."""
        return self.bus.read_item(self.id, mx64.HARDWARE_ERROR_STATUS)

    def temperature(self) -> int:
        """Read Present Temperature(146), °C."""
        return self.bus.read_item(self.id, mx64.PRESENT_TEMPERATURE)

    def reboot(self) -> None:
        """Reboot the servo. Raises as the bus."""
        self.bus.reboot(self.id)

    def answers(self) -> bool:
        """Whether the servo answers a ping now."""
        try:
            self.bus.ping(self.id, retries=0)
        except HandTimeout:
            return False
        return True


class ServoGroup:
    """The servos of one gripper, on one line: one packet with the goals, one with the request.

    :param servos: one, or several on one bus.
    """

    def __init__(self, servos: Sequence[Servo], clock: Clock | None = None) -> None:
        self.servos = tuple(servos)
        self._clock: Clock = clock if clock is not None else RealClock()
        self._bus = servos[0].bus
        sent, _ = exchange_bytes(len(servos))
        self._to_measurement = self._bus.wire_time(sent)

    def exchange(self, goals: Sequence[Goal], before: WriteDeadline | None = None) -> list[Sample]:
        """Write every servo's goal and read every servo's sample. As :meth:`Servo.exchange`."""
        if len(self.servos) == 1:
            return [self.servos[0].exchange(goals[0], before)]
        started = self._clock.now()
        pairs = list(zip(self.servos, goals, strict=True))
        data = {servo.id: register_block.encode(goal) for servo, goal in pairs}
        self._bus.sync_write(register_block.WRITE_ADDRESS, data, with_next=True, before=before)
        answers = self._bus.sync_read(
            list(data), register_block.READ_ADDRESS, register_block.READ_SIZE
        )
        at = started + self._to_measurement
        return [
            servo.check_goal(goal, servo.decode(answers[servo.id], at)) for servo, goal in pairs
        ]

    def switch_off(self) -> None:
        """Switch every motor off with one packet, whichever of them answer.

        :raises HandLost: the port has gone away.
        """
        off = mx64.TORQUE_ENABLE.encode(0)
        ids = [servo.id for servo in self.servos]
        self._bus.sync_write(mx64.TORQUE_ENABLE.address, dict.fromkeys(ids, off))
