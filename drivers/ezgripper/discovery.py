"""Find the gripper's servo on a serial line: its id and baud rate."""

from __future__ import annotations

from collections.abc import Callable

from dexkit.drivers.ezgripper.bus import Ping, ServoBus
from dexkit.drivers.serial_port import Device, find_device, latency_timer, latency_warning
from dexkit.errors import HandNotFound, HandRefused, HandTimeout
from dexkit.wire import mx64

__all__ = [
    "SCAN_BAUD_RATES",
    "Device",
    "find_device",
    "find_servo",
    "find_servos",
    "latency_timer",
    "latency_warning",
]

SCAN_BAUD_RATES = (1_000_000, 57_600, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600)
"""Most likely first: SAKE's driver, the factory setting of ROBOTIS and SAKE, the servo's others up
to 4 Mbaud (docs/sources/mx64-ezgripper.md#b3)."""

_UPGRADE = (
    "upgrade it to Protocol 2.0 with ROBOTIS DYNAMIXEL Wizard 2 (firmware recovery, model "
    "MX-64(2.0)); its registers are others, so it must not be driven as it is"
)


def find_servo(
    bus: ServoBus,
    servo_id: int | None,
    baudrate: int | None,
    progress: Callable[[str], None] = lambda text: None,
) -> Ping:
    """Find the gripper's servo and leave the bus open at its baud rate.

    :param servo_id: id, or None for the only servo on the line.
    :param baudrate: bits a second, or None to try all of :data:`SCAN_BAUD_RATES`.
    :param progress: called with a message for each attempt.
    :raises HandNotFound: no servo, or more than one, answers; the hint lists those that did.
    :raises HandRefused: the servo is no MX-64, or has Protocol 1.0 firmware.
    :raises HandLost: the port has gone away.
    """
    rates = SCAN_BAUD_RATES if baudrate is None else (baudrate,)
    if servo_id is not None:
        # a ping takes milliseconds, a broadcast about a second: ping all baud rates first
        for rate in rates:
            progress(f"looking for servo {servo_id} at {rate} baud")
            bus.set_baudrate(rate)
            try:
                return _check_model(bus.ping(servo_id), bus)
            except HandTimeout:
                pass
    others: list[str] = []
    old: list[str] = []
    for rate in rates:
        progress(f"looking for any servo at {rate} baud")
        bus.set_baudrate(rate)
        found = bus.ping_all()
        if len(found) == 1 and servo_id in (None, found[0].id):
            return _check_model(found[0], bus)
        if len(found) > 1 and servo_id is None:
            listed = ", ".join(f"id {p.id} (model {p.model})" for p in found)
            raise HandNotFound(
                f"more than one servo answers on {bus.path} at {rate} baud: {listed}",
                hint="say which: id=N",
            )
        others += [f"id {p.id} (model {p.model}) at {rate} baud" for p in found]
        for candidate in (1,) if servo_id is None else (servo_id,):
            model = bus.ping_protocol_1(candidate)
            if model is not None:
                old.append(f"id {candidate} (model {model}) at {rate} baud")
    if old:
        raise HandRefused(
            f"a servo on {bus.path} uses Protocol 1.0: {', '.join(old)}", hint=_UPGRADE
        )
    who = "any id" if servo_id is None else f"id {servo_id}"
    tried = ", ".join(str(rate) for rate in rates)
    hint = f"answering instead: {', '.join(others)}" if others else "nothing answers at all"
    if baudrate is not None:
        hint += "; baudrate=auto tries every baud rate (a new servo has 57600)"
    elif servo_id is not None:
        hint += "; id=auto takes any id"
    raise HandNotFound(
        f"no servo answers on {bus.path}: tried {who} at {tried} baud",
        hint=hint + "; is the 12 V supply on?",
    )


def find_servos(bus: ServoBus, baudrate: int | None) -> list[Ping]:
    """Find every servo on a line and leave the bus open at their baud rate.

    :param baudrate: bits a second, or None for the first of :data:`SCAN_BAUD_RATES` at which any
        answers.
    :raises HandNotFound: no servo answers.
    :raises HandRefused: one is no MX-64 with Protocol 2.0.
    :raises HandLost: the port has gone away.
    """
    rates = SCAN_BAUD_RATES if baudrate is None else (baudrate,)
    for rate in rates:
        bus.set_baudrate(rate)
        found = bus.ping_all()
        if found:
            return [_check_model(ping, bus) for ping in found]
    tried = ", ".join(str(rate) for rate in rates)
    raise HandNotFound(
        f"no servo answers on {bus.path}: tried {tried} baud",
        hint="is the 12 V supply on? baudrate=auto tries every baud rate (a new servo has 57600)",
    )


def _check_model(ping: Ping, bus: ServoBus) -> Ping:
    where = f"the servo with id {ping.id} on {bus.path}"
    if ping.model == mx64.MODEL:
        return ping
    if ping.model == mx64.MODEL_PROTOCOL_1:
        raise HandRefused(f"{where} is an MX-64 with Protocol 1.0 firmware", hint=_UPGRADE)
    raise HandRefused(
        f"{where} is model {ping.model}, not an MX-64(2.0) (model {mx64.MODEL})",
        hint="the EZGripper is an MX-64; is this another device's port or id?",
    )
