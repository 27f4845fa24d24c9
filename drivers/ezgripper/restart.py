"""Stop a gripper at a fault of any of its servos, and restart it step by step.

Of two servos no motor is driven without the other: at a fault or silence of either both are
switched off with one packet. :mod:`recovery` says when a servo may be rebooted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NoReturn

from dexkit.clock import Clock
from dexkit.drivers.ezgripper.bus import ServoSilent
from dexkit.drivers.ezgripper.calibrated_servo import Unit
from dexkit.drivers.ezgripper.recovery import RebootPolicy, describe, motor_error
from dexkit.drivers.ezgripper.register_block import Sample
from dexkit.drivers.ezgripper.servo import BOOT_TIME, ServoGroup
from dexkit.errors import HandFault, HandTimeout
from dexkit.hand import HandCommand, MotorError
from dexkit.wire import mx64
from dexkit.wire.mx64 import HardwareError

__all__ = ["GripperStatistics", "Restart"]

log = logging.getLogger(__name__)

_MAX_RESTART_WAIT = 2.0
"""Seconds that ``open`` waits at most for a reboot to be due; otherwise it raises."""


@dataclass
class GripperStatistics:
    """Counters since the object was created.

    :ivar faults: hardware shutdowns of the servo.
    :ivar reboots: reboots to recover from them.
    :ivar resets: times that the servo restarted by itself (a supply dip).
    """

    faults: int = 0
    reboots: int = 0
    resets: int = 0


def _is_shutdown(error: int) -> bool:
    # by default an input voltage error leaves torque on (docs/sources/mx64-ezgripper.md#b6)
    return error > HardwareError.INPUT_VOLTAGE


class _Phase(Enum):
    NONE = 0
    FAULT = 1
    BOOTING = 2


class Restart:
    """Fault handling and restart of one gripper.

    :ivar units: the servos, while the gripper is connected.
    """

    def __init__(self, clock: Clock) -> None:
        self.units: Sequence[Unit] = ()
        self.statistics = GripperStatistics()
        self._group: ServoGroup | None = None
        self._clock = clock
        self._policy = RebootPolicy()
        self._phase = _Phase.NONE
        self._fault = MotorError.NONE
        self._message = ""
        self._since = 0.0
        self._commanded: HandCommand | None = None

    @property
    def active(self) -> bool:
        """Whether the gripper is stopped by a fault."""
        return self._phase is not _Phase.NONE

    def connected(self, units: Sequence[Unit], group: ServoGroup) -> None:
        """Take the servos of a connection, before anything is configured."""
        self.units, self._group = tuple(units), group

    def opened(self) -> None:
        """Every servo has been configured: nothing is pending."""
        self._phase = _Phase.NONE

    def note_command(self, command: HandCommand) -> None:
        """Remember the newest command, which a recovery does not obey again."""
        self._commanded = command

    def check(self, unit: Unit, command: HandCommand, sample: Sample, *, engaged: bool) -> None:
        """Look for faults in a servo's sample.

        :param engaged: the motors are driven.
        :raises HandFault: it has shut down, restarted, or was switched off by something else; the
            gripper is stopped.
        """
        if sample.voltage == 0:
            # voltage 0: the indirect addresses have their defaults, so the servo has restarted
            self.statistics.resets += 1
            self._begin_recovery(
                unit,
                HardwareError.NONE,
                MotorError.ABNORMAL_RESET,
                command,
                "the servo has restarted by itself",
                hint="is the supply strong enough?",
            )
        if _is_shutdown(sample.error) or (sample.error and engaged and not sample.torque):
            self.statistics.faults += 1
            if sample.error & HardwareError.OVERLOAD:
                # of every servo: none is to push harder than the one that was overloaded
                for each in self.units:
                    control, last = each.working
                    at = sample if each is unit else last
                    each.overload_at = float(control.position(at))
            self._policy.fault(self._clock.now())
            self._begin_recovery(
                unit,
                sample.error,
                unit.motor_error(sample),
                command,
                f"the servo has shut down: {describe(sample.error)}",
            )
        if engaged and not sample.torque:
            # another program switched torque off: start over as after a reset
            self._begin_recovery(
                unit,
                HardwareError.NONE,
                MotorError.ABNORMAL_RESET,
                command,
                "the servo's torque was switched off by something else",
            )
        if sample.watchdog == mx64.WATCHDOG_TRIPPED:
            log.warning("the servo's bus watchdog tripped for lack of instructions; clearing it")
            unit.servo.rearm_watchdog()
        control, _ = unit.working
        if sample.temperature >= control.settings.warm and not unit.was_warm:
            log.warning("the servo is at %d degC: effort is reduced", sample.temperature)
        unit.was_warm = sample.temperature >= control.settings.warm

    def _begin_recovery(
        self,
        unit: Unit,
        error: int,
        fault: MotorError,
        command: HandCommand,
        message: str,
        hint: str = "",
    ) -> NoReturn:
        if len(self.units) > 1:
            message = message.replace("the servo", f"servo {unit.servo.id}", 1)
        for each in self.units:
            each.error = error if each is unit else 0
        # without an error bit the servo only needs its registers set again
        self._stop_all(fault, command, message, booting=not error)
        raise HandFault(message, bits=(fault,), hint=hint)

    def _stop_all(
        self, fault: MotorError, command: HandCommand, message: str, *, booting: bool
    ) -> None:
        """Begin a recovery; of two servos no motor is driven without the other."""
        self._fault = fault
        self._commanded = command
        self._since = self._clock.now()
        self._phase = _Phase.BOOTING if booting else _Phase.FAULT
        self._message = message
        log.error("%s", message)
        if len(self.units) > 1 and self._group is not None:
            self._group.switch_off()

    def lost_servo(self, command: HandCommand, error: ServoSilent) -> None:
        """Stop the gripper because one of its servos no longer answers.

        :raises HandLost: the port has gone away.
        """
        fault = MotorError.HOST_SAW_MOTOR_TIMEOUT
        for unit in self.units:
            unit.error = 0
        message = f"{error.message}: the gripper is switched off"
        self._stop_all(fault, command, message, booting=True)

    def step(self) -> None:
        """Do one bounded step of the recovery; return once every servo works again.

        No motion: torque is off after the reboot, and stays off until a command differs from the
        last one.
        """
        now = self._clock.now()
        if self._phase is _Phase.FAULT:
            for unit in self.units:
                if not unit.error:
                    continue
                temperature = unit.servo.temperature()
                if not self._policy.due(now, unit.error, temperature, unit.limits.temperature):
                    raise self._pending_fault(f"waiting before the restart ({temperature} degC)")
            self._reboot(now)
            raise self._pending_fault("restarting")
        for unit in self.units:
            if not unit.servo.answers():
                if now - self._since > BOOT_TIME:
                    raise HandTimeout(
                        f"servo {unit.servo.id} on {unit.servo.bus.path} does not come back after "
                        "its restart",
                        hint="switch its supply off and on",
                    )
                raise self._pending_fault("restarting")
        for unit in self.units:
            unit.error = unit.servo.hardware_error()
            if not _is_shutdown(unit.error):
                unit.error = 0
        if any(unit.error for unit in self.units):
            self._phase = _Phase.FAULT
            self._policy.fault(now)
            raise self._pending_fault("the restart did not help")
        for unit in self.units:
            if len(self.units) > 1:
                # it may have missed being switched off while it did not answer
                unit.servo.set_torque(False)
            unit.limits = unit.servo.configure(mirrored=unit.mirrored)
        for unit in self.units:
            control, _ = unit.working
            unit.last = unit.servo.sample()
            control.recovered(self._commanded, overload_at=unit.overload_at)
            unit.overload_at = None
        self._phase = _Phase.NONE
        self._fault = MotorError.NONE
        log.warning("the servo works again; its motor is off until a new command comes")

    def _reboot(self, now: float) -> None:
        self.statistics.reboots += 1
        for unit in self.units:
            if unit.error:
                log.warning("restarting the servo after: %s", describe(unit.error))
                unit.servo.reboot()
        self._since = now
        self._phase = _Phase.BOOTING

    def _pending_fault(self, what: str) -> HandFault:
        return HandFault(f"{self._message}; {what}", bits=(self._fault,))

    def clear_shutdown(self) -> None:
        """Reboot servos that are in shutdown at opening, if a reboot is due soon enough."""
        for unit in self.units:
            unit.error = unit.servo.hardware_error()
            if not _is_shutdown(unit.error):
                unit.error = 0
        broken = [unit for unit in self.units if unit.error]
        if not broken:
            return
        # do not count the fault of the last exchange or opening again
        if self._phase is not _Phase.FAULT:
            self.statistics.faults += 1
            self._policy.fault(self._clock.now())
        self._phase = _Phase.FAULT
        if self._policy.delay <= _MAX_RESTART_WAIT:
            self._clock.sleep_until(self._clock.now() + self._policy.delay)
        for unit in broken:
            temperature = unit.servo.temperature()
            limit = unit.servo.bus.read_item(unit.servo.id, mx64.TEMPERATURE_LIMIT)
            if not self._policy.due(self._clock.now(), unit.error, temperature, limit):
                raise HandFault(
                    f"the servo is in shutdown: {describe(unit.error)} ({temperature} degC)",
                    bits=(motor_error(unit.error, 0.0, 0.0, 0.0),),
                    hint="let it cool down, free the fingers, and try again",
                )
        self._reboot(self._clock.now())
        deadline = self._clock.now() + BOOT_TIME
        for unit in broken:
            while not unit.servo.answers():
                if self._clock.now() > deadline:
                    raise HandTimeout(f"servo {unit.servo.id} does not come back after its restart")
            error = unit.servo.hardware_error()
            if _is_shutdown(error):
                raise HandFault(
                    f"the servo is in shutdown and a restart does not help: {describe(error)}",
                    bits=(motor_error(error, 0.0, 0.0, 0.0),),
                )
