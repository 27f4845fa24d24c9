"""Driver of an Inspire RH56DFTP, the hand with tactile areas, by Modbus on TCP (docs/inspire.md).

:mod:`dexkit.drivers.inspire_modbus` has the connection and the registers of the joints. Here speeds
are commanded as well, and forces, states of the motors and the tactile areas are read
(docs/sources/unitree-dex.md#j3).

An area takes one request, and a hand that answers some hundred requests a second has no time for
all of them between two states: each exchange reads some, in turn, and a state holds the newest of
each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.clock import Clock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.inspire_modbus import PARSERS, InspireModbus, InspireModbusSettings
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import UsageError
from dexkit.hand import Floats, HandCommand, HandState, JointMode, Side
from dexkit.models import INSPIRE_FTP
from dexkit.wire import rh56
from dexkit.wire.rh56 import FULL, JOINTS, Register, Status

__all__ = ["SETTINGS", "InspireFtpModbus", "InspireFtpModbusSettings", "backend"]

_AREAS = INSPIRE_FTP.dialects[0].areas
_PLACES = tuple(
    Register.TOUCH + 2 * before
    for before in accumulate((area.elements for area in _AREAS), initial=0)
)[: len(_AREAS)]
"""Address of each area."""
_FELT = int(Register.TEMPERATURE) + JOINTS - int(Register.FORCE_ACT)
"""Bytes from the forces to the end of the temperatures."""


@dataclass(frozen=True)
class InspireFtpModbusSettings(InspireModbusSettings):
    """Settings of :class:`InspireFtpModbus`.

    :param speed: most of every joint, 1 to 1000, also before a client sets one.
    :param areas: tactile areas that an exchange reads; with 0 none is, and there is no touch topic.
    """

    speed: int | None = FULL
    areas: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.speed:
            raise UsageError(f"speed must be 1 to {FULL}, not {self.speed}")
        if not 0 <= self.areas <= len(_AREAS):
            raise UsageError(f"areas must be 0 to {len(_AREAS)}, not {self.areas}")


class InspireFtpModbus(InspireModbus):
    """An RH56DFTP on the network."""

    model = INSPIRE_FTP
    health_every = 1

    def __init__(
        self,
        side: Side,
        configuration: InspireFtpModbusSettings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self._own = configuration or InspireFtpModbusSettings()
        super().__init__(side, self._own, clock=clock)
        if not self._own.areas:
            self._spec = replace(self._spec, n_sensors=0)
        self._full = np.array([joint.dq_max for joint in self._spec.joints])
        self._most = self._own.speed or FULL
        self._speeds = [self._most] * JOINTS
        """What the device has."""
        self._forces: Floats = np.zeros(JOINTS)
        self._moving: NDArray[np.bool_] = np.zeros(JOINTS, dtype=np.bool_)
        self._stamp = math.nan
        self._next_area = 0
        self._pressure: Floats = np.full((len(_AREAS), max(a.elements for a in _AREAS)), np.nan)

    def _prepare(self) -> None:
        self._speeds = [self._most] * JOINTS
        self._stamp = math.nan
        super()._prepare()
        if self._own.areas:
            self._read_areas(len(_AREAS))

    def _goals(self, command: HandCommand) -> list[int]:
        parts = np.clip(np.nan_to_num(command.dq) / self._full, 0.0, 1.0)
        asked = np.rint(parts * self._most).astype(int)
        # what a speed of 0 means to the device is in no source: such a joint holds
        driven = (command.mode == JointMode.FOC) & (asked > 0)
        mode = np.where(driven, JointMode.FOC, JointMode.BRAKE).astype(np.uint8)
        speeds = np.where(driven, asked, self._speeds)
        return [*super()._goals(replace(command, mode=mode)), *speeds.tolist()]

    def _put_goals(self, goals: list[int], before: WriteDeadline | None = None) -> None:
        speeds = goals[JOINTS:]
        if speeds and speeds != self._speeds:
            self._put(Register.SPEED_SET, speeds, before)
            self._speeds = speeds
        super()._put_goals(goals[:JOINTS], before)

    def _measure(self, command: HandCommand) -> HandState:
        positions, stamp = self._positions, self._stamp
        state = super()._measure(command)
        self._read_areas(self._own.areas)
        self._stamp = state.stamp
        moved = (np.array(self._positions) - positions) / FULL
        passed = state.stamp - stamp
        return replace(
            state,
            # the device says whether a joint moves: a last digit that changes is no speed
            dq=np.where(self._moving, moved / passed, 0.0) if passed > 0 else np.zeros(JOINTS),
            tau_est=-self._forces / FULL,  # in the registers a force that closes is positive
            pressure=self._pressure.copy() if self._own.areas else None,
        )

    def _read_health(self) -> None:
        data = self._ask(lambda to: self._read(to, Register.FORCE_ACT, _FELT))
        self._forces = np.array(rh56.numbers(data[: 2 * JOINTS]), dtype=float)
        status = data[Register.STATUS - Register.FORCE_ACT :][:JOINTS]
        self._moving = np.array([code in (Status.OPENING, Status.CLOSING) for code in status])
        self._take_health(data[Register.ERROR - Register.FORCE_ACT :])

    def _read_areas(self, count: int) -> None:
        """Read so many tactile areas, the next ones in turn."""
        for _ in range(count):
            i = self._next_area
            self._read_area(_PLACES[i], self._pressure[i, : _AREAS[i].elements])
            self._next_area = (i + 1) % len(_AREAS)

    def _read_area(self, address: int, into: Floats) -> None:
        data = self._ask(lambda to: self._read(to, address, 2 * len(into)))
        into[:] = np.frombuffer(data, "<i2")


_PARSERS: Parsers = {
    **PARSERS,
    "areas": (int, f"tactile areas read in an exchange, 0 to {len(_AREAS)}; 0: none (default 3)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> InspireFtpModbus:
    values = parse_settings(options.settings, _PARSERS)
    settings = InspireFtpModbusSettings(device=options.device, **values)  # type: ignore[arg-type]
    return InspireFtpModbus(options.side, settings)


backend = Backend(
    summary="Inspire RH56DFTP hand on the network (Modbus TCP), with tactile areas",
    model=INSPIRE_FTP.name,
    make=_make,
    needs="--device left=HOST --device right=HOST",
    settings=SETTINGS,
    emulator=Emulator(
        ("rh56", "--link", "tcp://127.0.0.1:0", "--set", "tactile=yes"),
        linked=False,
        settings=SHARED_MACHINE,
    ),
)
