"""Driver of BrainCo's Revo2 on a serial port, Modbus RTU (docs/brainco.md).

Each exchange writes goals and speeds where they have changed, and reads position, speed, current
and status of every motor in one request. The registers are in :mod:`dexkit.wire.revo2`.

No source mentions a command time-out of the device.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.clock import Clock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel, SerialChannel
from dexkit.drivers.goal_hand import GoalHand
from dexkit.drivers.modbus_answers import accept
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import HandNotFound, HandRefused, UsageError
from dexkit.hand import HandCommand, HandState, JointMode, Side
from dexkit.models import BRAINCO_REVO2
from dexkit.wire import revo2
from dexkit.wire.modbus import Adu, Function, Request, RtuParser, signed
from dexkit.wire.revo2 import Holding, Input, UnitMode

__all__ = ["SETTINGS", "Revo2Serial", "Revo2Settings", "backend"]

log = logging.getLogger(__name__)

_FULL = revo2.FULL
_N = revo2.JOINTS


@dataclass(frozen=True)
class Revo2Settings:
    """Settings of :class:`Revo2Serial`.

    :param device: path of the serial port or USB serial number of its adapter.
    :param id: Modbus unit; None for that of the side.
    :param baudrate: bits a second.
    :param speed: speed limit of every joint, as a part of the full speed.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    id: int | None = None
    baudrate: int = revo2.BAUD_RATE
    speed: float = 1.0
    timeout: float = 0.03

    def __post_init__(self) -> None:
        if self.id is not None and self.id not in revo2.IDS:
            raise UsageError(f"id must be 1 to {revo2.IDS[-1]}, not {self.id}")
        if not 0.001 <= self.speed <= 1:
            raise UsageError(f"speed must be 0.001 to 1, not {self.speed:g}")
        if not 1e-3 <= self.timeout <= 1:
            raise UsageError(f"timeout must be 0.001 to 1 s, not {self.timeout:g}")
        if not 9600 <= self.baudrate <= 5_000_000:
            raise UsageError(f"baudrate must be 9600 to 5000000, not {self.baudrate}")


class Revo2Serial(GoalHand):
    """A Revo2.

    :param side: which hand.
    :param configuration: port, id, speed and time-out.

    ``open`` checks the side, sets the unit of the registers, and reads the positions. No motion.
    ``close`` has every joint hold where it is.
    """

    def __init__(
        self,
        side: Side,
        configuration: Revo2Settings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration or Revo2Settings()
        super().__init__("Revo2", BRAINCO_REVO2, side, self.configuration.timeout, clock)
        self._side = side
        own = self.configuration.id
        self._unit = revo2.UNITS[side] if own is None else own
        self._parser = RtuParser(answers=True)
        joints = self.spec.joints
        self._full_speed = np.array([joint.dq_max for joint in joints])
        self._full_current = np.array([joint.tau_max for joint in joints])

    def _connect(self) -> Channel:
        if self.configuration.device is None:
            raise HandNotFound("no serial port is given", hint="--device PATH or USB serial number")
        return SerialChannel(self.configuration.device, self.configuration.baudrate)

    def _absent(self, place: str) -> HandNotFound:
        return HandNotFound(
            f"no hand with id {self._unit} answers on {place} at "
            f"{self.configuration.baudrate} baud",
            hint="is its supply on, and its switch at Modbus? Left hands are 126, right ones "
            "127 by default",
        )

    def _prepare(self) -> None:
        """Check the side, set the registers' unit, read the positions.

        :raises HandRefused: it is the other hand.
        """
        (number,) = self._read(Function.READ_HOLDING, Holding.SIDE, 1)
        if revo2.SIDES.get(number, self._side) is not self._side:
            raise HandRefused(
                f"the hand on this port is a {revo2.SIDES[number]} one, not the {self._side} one",
                hint="swap the ports of --device, or --side",
            )
        (mode,) = self._read(Function.READ_HOLDING, Holding.UNIT_MODE, 1)
        if mode != UnitMode.NORMALISED:
            log.warning("the hand was set to degrees; it is set to parts of the travel")
            self._request(Request(Function.WRITE_ONE, Holding.UNIT_MODE, 1, (UnitMode.NORMALISED,)))
        self._read_motors()

    def _measure(self, command: HandCommand) -> HandState:
        position, speed, current, _ = self._read_motors()
        driven = command.mode == JointMode.FOC
        return HandState.from_values(
            position / _FULL,
            stamp=self._clock.now(),
            dq=speed / _FULL * self._full_speed,
            tau_est=current / _FULL * self._full_current,
            mode=driven.astype(int).tolist(),
        )

    def _goals(self, command: HandCommand) -> list[int]:
        positions, speeds = [], []
        rows = zip(
            command.mode.tolist(),
            command.q.tolist(),
            (command.dq / self._full_speed).tolist(),
            strict=True,
        )
        for i, (mode, q, part) in enumerate(rows):
            # 0 is the highest speed to the device, and no motion in a command
            if mode == JointMode.FOC and part >= 1 / _FULL:
                self._held[i] = None
                positions.append(round(min(max(q, 0.0), 1.0) * _FULL))
                speeds.append(max(1, round(min(part, self.configuration.speed) * _FULL)))
            else:
                positions.append(self._hold(i))
                speeds.append(_FULL)
        return revo2.position_and_speed(positions, speeds)

    def _holding_goals(self) -> list[int]:
        self._read_motors()
        return revo2.position_and_speed(self._positions, [_FULL] * _N)

    def _put_goals(self, goals: list[int], before: WriteDeadline | None = None) -> None:
        self._request(Request.write(Holding.POSITION_AND_SPEED, goals), before)

    # --- the registers

    def _read_motors(self) -> npt.NDArray[np.int64]:
        """Positions, speeds, currents and status, shape (4, 6)."""
        found = self._read(Function.READ_INPUT, Input.POSITION, 4 * _N)
        table = np.array(signed(found), np.int64).reshape(4, _N)
        table[0] = np.clip(table[0], 0, _FULL)
        self._positions = table[0].tolist()
        return table

    def _read(self, function: Function, address: int, count: int) -> tuple[int, ...]:
        return self._request(Request(function, address, count))

    def _request(self, request: Request, before: WriteDeadline | None = None) -> tuple[int, ...]:
        data = Adu(self._unit, request.pack()).pack_rtu()

        def match(answer: Adu) -> tuple[int, ...] | None:
            return accept(answer, request) if answer.unit == self._unit else None

        return self._ask(lambda to: self._line.ask(to, data, self._parser, match, before))


_PARSERS: Parsers = {
    "id": (int, "Modbus unit (default 126 left, 127 right)"),
    "baudrate": (int, f"bits a second (default {revo2.BAUD_RATE})"),
    "speed": (float, "most of every joint, a part of the full speed (default 1)"),
    "timeout": (float, "seconds to wait for an answer (default 0.03)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> Revo2Serial:
    values = parse_settings(options.settings, _PARSERS)
    settings = Revo2Settings(device=options.device, **values)  # type: ignore[arg-type]
    return Revo2Serial(options.side, settings)


backend = Backend(
    summary="BrainCo Revo2 hand on a serial port (Modbus RTU)",
    model=BRAINCO_REVO2.name,
    make=_make,
    needs="--device left=PATH --device right=PATH",
    settings=SETTINGS,
    emulator=Emulator(("revo2", "--side", "{side}"), linked=True, settings=SHARED_MACHINE),
)
