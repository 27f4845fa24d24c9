"""One MX-64(2.0): control table, instructions and supervision, sans-IO.

``advance_to`` moves its time; ``handle`` takes one instruction packet and returns the status
packet's bytes or None. Nothing here sleeps or knows of a port. Behaviour on which the manual is
silent is in :class:`~dexkit.emulators.mx64.settings.Firmware`.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable

from dexkit.emulators.mx64.drive import PERIOD, SLOW, Drive
from dexkit.emulators.mx64.settings import Firmware, Physics
from dexkit.errors import UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import ErrorNumber, Instruction, Packet
from dexkit.wire.mx64 import (
    DriveMode,
    HardwareError,
    Item,
    MovingStatus,
    OperatingMode,
    StatusReturnLevel,
)

__all__ = ["Servo"]

_OWNER: list[Item | None] = [None] * mx64.TABLE_END
for _item in mx64.TABLE.values():
    for _address in range(_item.address, _item.end):
        _OWNER[_address] = _item

_GAINS = (
    mx64.VELOCITY_I_GAIN,
    mx64.VELOCITY_P_GAIN,
    mx64.POSITION_D_GAIN,
    mx64.POSITION_I_GAIN,
    mx64.POSITION_P_GAIN,
    mx64.FEEDFORWARD_1ST_GAIN,
    mx64.FEEDFORWARD_2ND_GAIN,
)
_GOALS = (mx64.GOAL_PWM, mx64.GOAL_CURRENT, mx64.GOAL_VELOCITY, mx64.GOAL_POSITION)
_POSITION_MODES = frozenset(
    (
        int(OperatingMode.POSITION),
        int(OperatingMode.EXTENDED_POSITION),
        int(OperatingMode.CURRENT_BASED_POSITION),
    )
)
# plain integers: enum arithmetic is slow, and these are used a thousand times a second
_REVERSE, _TIMED = int(DriveMode.REVERSE), int(DriveMode.TIME_BASED_PROFILE)
_DRIVE_MODE, _OPERATING_MODE = mx64.DRIVE_MODE.address, mx64.OPERATING_MODE.address
_TORQUE_ENABLE = mx64.TORQUE_ENABLE.address
_HARDWARE_ERROR = mx64.HARDWARE_ERROR_STATUS.address
# Realtime Tick(120) to Present Temperature(146): the block without a gap that changes by itself
_PRESENT = struct.Struct("<HBBhhiiiiHB")
_PRESENT_START = mx64.REALTIME_TICK.address
_PRESENT_END = mx64.PRESENT_TEMPERATURE.end
_HOMING_IN_ONE_TURN = 1024


class Servo:
    """An MX-64 with a gripper on its shaft.

    :param servo_id: ID(7) as delivered.
    :param baudrate: bits a second as delivered; one of :data:`dexkit.wire.mx64.BAUD_RATES`.
    :param now: time at power-on, seconds; it answers at once.
    :param eeprom: 64 bytes kept from an earlier run; they win over ``servo_id`` and ``baudrate``.
    :param seed: of the noise on Present Current.
    :ivar watchdog_trips: times that its bus watchdog has tripped.
    :raises UsageError: no such id or baud rate, or ``eeprom`` is not one.
    """

    def __init__(
        self,
        servo_id: int = 1,
        *,
        baudrate: int = 1_000_000,
        physics: Physics | None = None,
        firmware: Firmware | None = None,
        now: float = 0.0,
        eeprom: bytes | None = None,
        seed: int = 0,
    ) -> None:
        codes = {rate: code for code, rate in mx64.BAUD_RATES.items()}
        if baudrate not in codes:
            raise UsageError(
                f"an MX-64 cannot do {baudrate} baud", hint=f"one of {', '.join(map(str, codes))}"
            )
        if not 0 <= servo_id <= dxl.MAX_ID:
            raise UsageError(f"a servo's id is 0 to {dxl.MAX_ID}, not {servo_id}")
        self.firmware = firmware or Firmware()
        self.physics = physics or Physics()
        self.drive = Drive(self.physics)
        self.on_eeprom: Callable[[], None] | None = None
        self._random = random.Random(seed)
        self._origin = now
        self._periods = 0
        self._table = bytearray(mx64.TABLE_END)
        self._backup: bytes | None = None
        self._powered = True
        self._shut_down = False
        self._overload_time = 0.0
        self._profile_acceleration = 0
        self._watchdog = self._least_volts = self._most_volts = self._most_heat = 0
        self.watchdog_trips = 0
        self._after: Callable[[], None] | None = None
        self._factory_eeprom()
        self._put(mx64.ID, servo_id)
        self._put(mx64.BAUD_RATE, codes[baudrate])
        if eeprom is not None:
            self._load(eeprom)
        self._boot(0.0)

    # --- what the bus asks

    @property
    def id(self) -> int:
        """ID(7)."""
        return self._table[mx64.ID.address]

    @property
    def secondary_id(self) -> int | None:
        """Secondary ID(12), or None when it is off or the same as the primary."""
        value = self._table[mx64.SECONDARY_ID.address]
        return value if value <= dxl.MAX_ID and value != self.id else None

    @property
    def baudrate(self) -> int:
        """Bits a second on the line."""
        return mx64.BAUD_RATES[self._table[mx64.BAUD_RATE.address]]

    @property
    def return_delay(self) -> float:
        """Seconds between an instruction's last byte and the status' first."""
        return self._table[mx64.RETURN_DELAY_TIME.address] * mx64.RETURN_DELAY_UNIT

    @property
    def silent(self) -> bool:
        """Whether it receives nothing: it is booting, or has no supply."""
        return not self._powered or self.now < self._boot_until

    @property
    def now(self) -> float:
        """The servo's time, seconds on the caller's clock."""
        return self._origin + self._periods * PERIOD

    @property
    def eeprom(self) -> bytes:
        """The 64 bytes that survive power-off."""
        return bytes(self._table[: mx64.EEPROM_END])

    @property
    def hardware_error(self) -> HardwareError:
        """Hardware Error Status(70)."""
        return HardwareError(self._table[mx64.HARDWARE_ERROR_STATUS.address])

    @property
    def torque(self) -> bool:
        """Torque Enable(64)."""
        return bool(self._table[_TORQUE_ENABLE])

    @property
    def led(self) -> bool:
        """Whether the LED is lit now; it blinks at 1 Hz in shutdown
        (docs/sources/mx64-ezgripper.md#b6).
        """
        if self._shut_down:
            return self.now % 1.0 < 0.5
        return bool(self._table[mx64.LED.address])

    def get(self, item: Item) -> int:
        """The present value of an item."""
        self._refresh()
        return item.decode(self._table, 0)

    # --- time

    def advance_to(self, now: float) -> None:
        """Advance to ``now`` in whole control periods; never goes back."""
        periods = int((now - self._origin) / PERIOD + 1e-6) - self._periods
        drive = self.drive
        while periods > 0:
            n = min(periods, SLOW)
            if drive.resting:
                drive.rest(n)
            else:
                acceleration = self._profile_acceleration
                for _ in range(n):
                    drive.step(acceleration)
            self._periods += n
            periods -= n
            self._supervise(n * PERIOD)

    def _supervise(self, dt: float) -> None:
        drive = self.drive
        if drive.supply < self.physics.brown_out_reset:
            if self._powered:
                self._powered = False
                self._torque_off()
            return
        if not self._powered:
            self._powered = True
            self._boot(self.firmware.boot_time)
        if (
            self._watchdog > 0
            and self.torque
            and self.now - self._last_packet > self._watchdog * mx64.WATCHDOG_UNIT
        ):
            self._put(mx64.BUS_WATCHDOG, mx64.WATCHDOG_TRIPPED)
            self.watchdog_trips += 1
            drive.reset_control()
            self._update_demand()
        load = abs(drive.current) / self.physics.stall_current
        if load > self.firmware.overload_level:
            self._overload_time += dt
        else:
            self._overload_time = max(0.0, self._overload_time - dt)
        error = 0
        if self._overload_time >= self.firmware.overload_delay:
            error |= HardwareError.OVERLOAD
        if math.floor(drive.temperature) > self._most_heat:
            error |= HardwareError.OVERHEATING
        if not self._least_volts <= round(drive.voltage / mx64.VOLTAGE_UNIT) <= self._most_volts:
            error |= HardwareError.INPUT_VOLTAGE
        if error:
            self.raise_error(HardwareError(error))

    # --- faults

    def raise_error(self, error: HardwareError) -> None:
        """Set bits of Hardware Error Status(70); shuts down if Shutdown(63) has one of them."""
        if not self._powered:
            return
        present = self.hardware_error | error
        self._put(mx64.HARDWARE_ERROR_STATUS, int(present))
        if present & self._get(mx64.SHUTDOWN) and not self._shut_down:
            self._shut_down = True
            self._torque_off()

    # --- boot and power

    def _factory_eeprom(self) -> None:
        for item in mx64.TABLE.values():
            if item.area is mx64.Area.EEPROM:
                self._put(item, item.initial or 0)
        self._put(mx64.FIRMWARE_VERSION, self.firmware.version)
        self._put(mx64.VELOCITY_LIMIT, self.firmware.velocity_limit)

    def _load(self, eeprom: bytes) -> None:
        if len(eeprom) != mx64.EEPROM_END or mx64.MODEL_NUMBER.decode(eeprom) != mx64.MODEL:
            raise UsageError("this is not the EEPROM of an MX-64")
        if eeprom[mx64.BAUD_RATE.address] not in mx64.BAUD_RATES:
            raise UsageError("this EEPROM holds no baud rate that an MX-64 knows")
        if eeprom[mx64.OPERATING_MODE.address] not in set(OperatingMode):
            raise UsageError("this EEPROM holds no operating mode that an MX-64 knows")
        self._table[: mx64.EEPROM_END] = eeprom

    def _boot(self, silence: float) -> None:
        """Power-on or reboot: RAM to its initial values, the position folded to one turn."""
        for item in mx64.TABLE.values():
            if item.area is mx64.Area.RAM:
                self._put(item, item.initial or 0)
        self._registered: tuple[int, bytes] | None = None
        self._boot_until = self.now + silence
        self._booted = self.now
        self._last_packet = self.now
        self._overload_time = 0.0
        self._shut_down = False
        self._put(mx64.GOAL_PWM, self._get(mx64.PWM_LIMIT))
        self._put(mx64.GOAL_CURRENT, self._get(mx64.CURRENT_LIMIT))
        self.drive.fold(reverse=self._reverse)
        self._update_demand()
        self.drive.reset_control()
        self._put(mx64.GOAL_POSITION, self._position())

    def _torque_off(self) -> None:
        self._put(mx64.TORQUE_ENABLE, 0)
        self._update_demand()
        self.drive.reset_control()

    # --- registers

    def _get(self, item: Item) -> int:
        # Item.decode without its checks: this is the inner loop
        start = item.address
        raw = self._table[start : start + item.size]
        return int.from_bytes(raw, "little", signed=item.signed)

    def _put(self, item: Item, value: int) -> None:
        self._table[item.address : item.end] = item.encode(value)

    @property
    def _reverse(self) -> bool:
        return bool(self._table[_DRIVE_MODE] & _REVERSE)

    @property
    def _mode(self) -> int:
        return self._table[_OPERATING_MODE]

    @property
    def _homing(self) -> int:
        offset = self._get(mx64.HOMING_OFFSET)
        if self._mode == OperatingMode.POSITION:
            offset = max(-_HOMING_IN_ONE_TURN, min(_HOMING_IN_ONE_TURN, offset))
        return offset

    def _position(self) -> int:
        sign = -1 if self._reverse else 1
        return sign * self.drive.position + self._homing

    def _update_demand(self) -> None:
        """Set the drive's demand from the registers, in the motor's direction."""
        sign = -1 if self._reverse else 1
        demand = self.drive.demand
        demand.torque = self.torque
        demand.mode = self._mode
        pwm_limit = self._get(mx64.PWM_LIMIT)
        current_limit = self._get(mx64.CURRENT_LIMIT)
        demand.pwm = sign * max(-pwm_limit, min(pwm_limit, self._get(mx64.GOAL_PWM)))
        demand.current = sign * max(
            -current_limit, min(current_limit, self._get(mx64.GOAL_CURRENT))
        )
        demand.velocity = sign * self._get(mx64.GOAL_VELOCITY)
        demand.position_p = self._get(mx64.POSITION_P_GAIN)
        demand.position_i = self._get(mx64.POSITION_I_GAIN)
        demand.position_d = self._get(mx64.POSITION_D_GAIN)
        demand.feedforward_1 = self._get(mx64.FEEDFORWARD_1ST_GAIN)
        demand.feedforward_2 = self._get(mx64.FEEDFORWARD_2ND_GAIN)
        demand.velocity_p = self._get(mx64.VELOCITY_P_GAIN)
        demand.velocity_i = self._get(mx64.VELOCITY_I_GAIN)
        self._watchdog = self._get(mx64.BUS_WATCHDOG)
        demand.stopped = self._watchdog == mx64.WATCHDOG_TRIPPED
        self._profile_acceleration = self._get(mx64.PROFILE_ACCELERATION)
        self._least_volts = self._get(mx64.MIN_VOLTAGE_LIMIT)
        self._most_volts = self._get(mx64.MAX_VOLTAGE_LIMIT)
        self._most_heat = self._get(mx64.TEMPERATURE_LIMIT)

    def _start_profile(self) -> None:
        sign = -1 if self._reverse else 1
        goal = sign * (self._get(mx64.GOAL_POSITION) - self._homing)
        timed = bool(self._table[_DRIVE_MODE] & _TIMED)
        self.drive.profile.start(
            float(goal),
            self._get(mx64.PROFILE_VELOCITY),
            self._get(mx64.PROFILE_ACCELERATION),
            timed=timed,
        )

    def _refresh(self) -> None:
        """Write the present values into the table."""
        drive = self.drive
        sign = -1 if self._reverse else 1
        velocity = round(sign * drive.velocity / mx64.VELOCITY_UNIT)
        position = self._position()
        profile = drive.profile
        torque = drive.demand.torque
        current = sign * drive.current / mx64.CURRENT_UNIT
        if self.firmware.current_follows_goal and torque:
            goal = abs(drive.demand.current)
            current = math.copysign(min(abs(current), goal), current)
        elif self.firmware.current_noise and self._powered:
            current += self._random.gauss(0.0, self.firmware.current_noise)
        moving = profile.running or abs(velocity) > self._get(mx64.MOVING_THRESHOLD)
        status = 0
        homing = self._homing
        trajectory = sign * round(profile.position) + homing
        if drive.demand.mode in _POSITION_MODES and torque:
            if profile.running:
                status |= MovingStatus.PROFILE_ONGOING | profile.shape
            if abs(self._get(mx64.GOAL_POSITION) - position) <= self.firmware.in_position_window:
                status |= MovingStatus.IN_POSITION
            if abs(trajectory - position) > self.firmware.following_error_window:
                status |= MovingStatus.FOLLOWING_ERROR
        else:
            trajectory = position
        _PRESENT.pack_into(
            self._table,
            _PRESENT_START,
            int((self.now - self._booted) * 1000) & 0x7FFF,
            moving,
            status,
            round(sign * drive.duty / mx64.PWM_UNIT),
            max(-32768, min(32767, round(current))),
            velocity,
            position,
            round(sign * drive.ramped_velocity * mx64.TICK / mx64.VELOCITY_UNIT) if torque else 0,
            trajectory,
            round(drive.voltage / mx64.VOLTAGE_UNIT),
            max(0, min(255, math.floor(drive.temperature))),
        )

    def _target(self, address: int) -> int:
        """Address that ``address`` stands for: follows one level of indirect data."""
        for block in mx64.INDIRECT_BLOCKS:
            k = address - block.data
            if 0 <= k < block.count:
                at = block.address + 2 * k
                return int.from_bytes(self._table[at : at + 2], "little")
        return address

    def read_block(self, address: int, length: int) -> tuple[int, bytes]:
        """(error number, data) of a read of ``length`` bytes."""
        if length == 0:
            return ErrorNumber.DATA_LENGTH, b""
        if address + length > mx64.TABLE_END:
            return ErrorNumber.ACCESS, b""
        first, last = address, address + length
        indirect = any(
            first < block.data + block.count and last > block.data for block in mx64.INDIRECT_BLOCKS
        )
        if indirect or (first < _PRESENT_END and last > _PRESENT_START):
            self._refresh()
        out = bytearray(self._table[first:last])
        for i, at in enumerate(range(first, last)):
            owner = _OWNER[at]
            if owner is not None and indirect:
                target = self._target(at)
                owner = _OWNER[target]
                out[i] = self._table[target]
            if owner is None:
                if not self.firmware.read_across_gaps:
                    return ErrorNumber.ACCESS, b""
                out[i] = 0
        return ErrorNumber.NONE, bytes(out)

    def write_block(
        self, address: int, data: bytes, *, eeprom: bool = True, clamp: bool = False
    ) -> int:
        """Write ``data`` if all of it may be written; returns the error number.

        :param eeprom: EEPROM may be changed (not through the secondary id).
        :param clamp: bring goals beyond a limit to the limit instead of refusing.
        """
        values = self._check_write(address, data, eeprom=eeprom, clamp=clamp)
        if isinstance(values, int):
            return values
        saved = self.eeprom
        for item, value in values:
            self._apply(item, value)
        if len(values) > 1 or values[0][0] is not mx64.GOAL_POSITION:
            self._update_demand()
        if self.eeprom != saved and self.on_eeprom is not None:
            self.on_eeprom()
        return ErrorNumber.NONE

    def _check_write(
        self, address: int, data: bytes, *, eeprom: bool, clamp: bool
    ) -> list[tuple[Item, int]] | int:
        """The items and values that a write sets, or the error number."""
        if not data:
            return ErrorNumber.DATA_LENGTH
        if address + len(data) > mx64.TABLE_END:
            return self.firmware.undefined_address_error
        targets = [self._target(at) for at in range(address, address + len(data))]
        values: list[tuple[Item, int]] = []
        i = 0
        while i < len(targets):
            item = _OWNER[targets[i]]
            if item is None:
                return self.firmware.undefined_address_error
            if not item.writable:
                return ErrorNumber.ACCESS
            if item.area is mx64.Area.EEPROM and (self.torque or not eeprom):
                return ErrorNumber.ACCESS
            # all bytes of the item, in order, or none
            if targets[i : i + item.size] != list(range(item.address, item.end)):
                return ErrorNumber.DATA_LENGTH
            value = item.decode(data[i : i + item.size])
            error, value = self._check_value(item, value, clamp=clamp)
            if error:
                return error
            values.append((item, value))
            i += item.size
        return values

    def _check_value(self, item: Item, value: int, *, clamp: bool) -> tuple[int, int]:
        """(error number, value) for a value to be written to ``item``."""
        if item in _GOALS and self._get(mx64.BUS_WATCHDOG) == mx64.WATCHDOG_TRIPPED:
            return ErrorNumber.DATA_RANGE, value
        low, high = item.minimum, item.maximum
        assert low is not None
        assert high is not None
        if item is mx64.OPERATING_MODE:
            allowed = value in set(OperatingMode)
        elif item is mx64.DRIVE_MODE:
            allowed = not value & ~int(DriveMode.REVERSE | DriveMode.TIME_BASED_PROFILE)
        elif item is mx64.SHUTDOWN:
            allowed = not value & ~sum(HardwareError)
        else:
            allowed = low <= value <= high
        if not allowed:
            return ErrorNumber.DATA_RANGE, value
        low, high = self._limits(item, low, high)
        if not low <= value <= high:
            if clamp:
                return ErrorNumber.NONE, max(low, min(high, value))
            return ErrorNumber.DATA_LIMIT, value
        return ErrorNumber.NONE, value

    def _limits(self, item: Item, low: int, high: int) -> tuple[int, int]:
        """The range that other items leave for ``item`` now."""
        if item.limit is not None:
            most = self._get(item.limit)
            return -most, most
        if item is mx64.GOAL_POSITION and self._mode == OperatingMode.POSITION:
            return self._get(mx64.MIN_POSITION_LIMIT), self._get(mx64.MAX_POSITION_LIMIT)
        if self._table[_DRIVE_MODE] & _TIMED:
            if item is mx64.PROFILE_ACCELERATION or item is mx64.PROFILE_VELOCITY:
                return low, mx64.PROFILE_TIME_MAX
        else:
            if item is mx64.PROFILE_ACCELERATION:
                return low, self._get(mx64.ACCELERATION_LIMIT)
            if item is mx64.PROFILE_VELOCITY and self.firmware.profile_velocity_limited:
                return low, self._get(mx64.VELOCITY_LIMIT)
        return low, high

    def _apply(self, item: Item, value: int) -> None:
        """Set an item, and carry out its effect."""
        if item is mx64.TORQUE_ENABLE:
            self._set_torque(bool(value))
            return
        before = self._get(item)
        self._put(item, value)
        if item is mx64.OPERATING_MODE and value != before:
            for gain in _GAINS:
                self._put(gain, gain.initial or 0)
            self._put(mx64.PROFILE_ACCELERATION, 0)
            self._put(mx64.PROFILE_VELOCITY, 0)
            self._put(mx64.GOAL_PWM, self._get(mx64.PWM_LIMIT))
            self._put(mx64.GOAL_CURRENT, self._get(mx64.CURRENT_LIMIT))
            self._put(mx64.GOAL_VELOCITY, 0)
            if value == OperatingMode.POSITION:
                self.drive.fold(reverse=self._reverse)
            self._update_demand()
            self.drive.reset_control()
            self._put(mx64.GOAL_POSITION, self._position())
        elif item is mx64.GOAL_POSITION and self.torque and self._mode in _POSITION_MODES:
            self._start_profile()
        elif item is mx64.BUS_WATCHDOG and before == mx64.WATCHDOG_TRIPPED:
            self._update_demand()
            self.drive.reset_control()
            if self.firmware.watchdog_resumes and self.torque and self._mode in _POSITION_MODES:
                self._start_profile()

    def _set_torque(self, on: bool) -> None:
        if on == self.torque or (on and self._shut_down):
            return
        if not on:
            self._torque_off()
            return
        if self._mode == OperatingMode.POSITION:
            self.drive.fold(reverse=self._reverse)
        self._put(mx64.TORQUE_ENABLE, 1)
        self._update_demand()
        self.drive.reset_control()
        self._last_packet = self.now
        if self.firmware.goal_starts_at_present:
            self._put(mx64.GOAL_POSITION, self._position())
        elif self._mode in _POSITION_MODES:
            self._start_profile()

    # --- instructions

    def note_packet(self) -> None:
        """Note that an instruction packet passed on the bus: it feeds the watchdog."""
        self._last_packet = self.now

    def status(self, error: int, data: bytes = b"") -> bytes:
        """Bytes of a status packet with the alert bit as it stands."""
        return dxl.status(self.id, self.error_byte(error), data)

    def error_byte(self, error: int) -> int:
        """``error`` with the alert bit if Hardware Error Status(70) is not zero."""
        return error | (dxl.ALERT if self._table[_HARDWARE_ERROR] else 0)

    def answers_reads(self, *, sync: bool = False) -> bool:
        """Whether Status Return Level(68) lets it answer a read."""
        level = self._table[mx64.STATUS_RETURN_LEVEL.address]
        if sync and self.firmware.level_0_answers_sync:
            return True
        return level >= StatusReturnLevel.READ

    def handle(self, packet: Packet) -> bytes | None:
        """Execute one instruction addressed to it or to all; returns its status, if any.

        Sync, bulk and broadcast ping need to know the other servos: the bus takes those apart.
        """
        broadcast = packet.id == dxl.BROADCAST_ID
        secondary = not broadcast and packet.id != self.id
        own_id = self.id
        level = self._table[mx64.STATUS_RETURN_LEVEL.address]
        error, data = self._execute(packet, broadcast=broadcast, secondary=secondary)
        reboots = error == ErrorNumber.NONE and self._after is not None
        status = dxl.status(own_id, self.error_byte(error), data)
        if reboots and self._after is not None:
            self._after()
        if broadcast or secondary:
            return None
        if packet.instruction == Instruction.PING:
            return status
        if packet.instruction == Instruction.READ:
            return status if level >= StatusReturnLevel.READ else None
        return status if level >= StatusReturnLevel.ALL else None

    def _execute(self, packet: Packet, *, broadcast: bool, secondary: bool) -> tuple[int, bytes]:
        code, params = packet.instruction, packet.params
        self._after = None
        if code == Instruction.PING:
            return ErrorNumber.NONE, self.ping_data
        if code == Instruction.READ:
            if len(params) != 4:
                return ErrorNumber.DATA_LENGTH, b""
            address, length = struct.unpack("<HH", params)
            return self.read_block(address, length)
        if code in (Instruction.WRITE, Instruction.REG_WRITE):
            if len(params) < 3:
                return ErrorNumber.DATA_LENGTH, b""
            address = int.from_bytes(params[:2], "little")
            return self._write(code, address, params[2:], eeprom=not secondary), b""
        if code == Instruction.ACTION:
            if self._registered is None:
                return ErrorNumber.INSTRUCTION, b""
            address, data = self._registered
            self._registered = None
            self._put(mx64.REGISTERED_INSTRUCTION, 0)
            return self.write_block(address, data, eeprom=not secondary), b""
        if code == Instruction.REBOOT:
            self._after = self._reboot
            return ErrorNumber.NONE, b""
        if code == Instruction.FACTORY_RESET:
            return self._factory_reset(params, broadcast=broadcast or secondary), b""
        if code == Instruction.CLEAR:
            return self._clear(params), b""
        if code == Instruction.CONTROL_TABLE_BACKUP and self.firmware.backup:
            return self._control_table_backup(params), b""
        return ErrorNumber.INSTRUCTION, b""

    @property
    def ping_data(self) -> bytes:
        """Model number and firmware version, the parameters of a ping's status."""
        return bytes(self._table[0:2]) + bytes((self._table[mx64.FIRMWARE_VERSION.address],))

    def _write(self, code: int, address: int, data: bytes, *, eeprom: bool) -> int:
        if code == Instruction.REG_WRITE:
            checked = self._check_write(address, data, eeprom=eeprom, clamp=False)
            if isinstance(checked, int):
                return checked
            self._registered = (address, data)
            self._put(mx64.REGISTERED_INSTRUCTION, 1)
            return ErrorNumber.NONE
        refuse = self.firmware.refuse_torque_in_shutdown
        if refuse and self._shut_down and address == mx64.TORQUE_ENABLE.address and data[0] == 1:
            return refuse
        return self.write_block(address, data, eeprom=eeprom)

    def _reboot(self) -> None:
        self._boot(self.firmware.boot_time)

    def _factory_reset(self, params: bytes, *, broadcast: bool) -> int:
        if len(params) != 1:
            return ErrorNumber.DATA_LENGTH
        option = params[0]
        if option not in (0xFF, 0x01, 0x02):
            return ErrorNumber.DATA_RANGE
        if option == 0xFF and broadcast:
            return ErrorNumber.RESULT_FAIL
        servo_id, baud = self._get(mx64.ID), self._get(mx64.BAUD_RATE)

        def reset() -> None:
            self._factory_eeprom()
            if option in (0x01, 0x02):
                self._put(mx64.ID, servo_id)
            if option == 0x02:
                self._put(mx64.BAUD_RATE, baud)
            if self.on_eeprom is not None:
                self.on_eeprom()
            self._reboot()

        self._after = reset
        return ErrorNumber.NONE

    def _clear(self, params: bytes) -> int:
        if len(params) != len(dxl.CLEAR_POSITION_KEY):
            return ErrorNumber.DATA_LENGTH
        if params != dxl.CLEAR_POSITION_KEY:
            return ErrorNumber.DATA_RANGE
        self._refresh()
        if self._table[mx64.MOVING.address]:
            return ErrorNumber.RESULT_FAIL
        self.drive.fold(reverse=self._reverse)
        self.drive.reset_control()
        self._put(mx64.GOAL_POSITION, self._position())
        return ErrorNumber.NONE

    def _control_table_backup(self, params: bytes) -> int:
        if len(params) != 1 + len(dxl.BACKUP_KEY):
            return ErrorNumber.DATA_LENGTH
        if params[1:] != dxl.BACKUP_KEY or params[0] not in (0x01, 0x02):
            return ErrorNumber.DATA_RANGE
        if self.torque:
            return ErrorNumber.RESULT_FAIL
        if params[0] == 0x01:
            self._backup = self.eeprom
            return ErrorNumber.NONE
        backup = self._backup
        if backup is None:
            return ErrorNumber.RESULT_FAIL

        def restore() -> None:
            self._load(backup)
            if self.on_eeprom is not None:
                self.on_eeprom()
            self._reboot()

        self._after = restore
        return ErrorNumber.NONE
