"""Driver of BrainCo's Revo2 on a serial port of its own, Modbus RTU (docs/brainco.md).

Each exchange writes goals and speeds where they have changed, and reads position, speed, current
and status of every motor in one request. The registers are in :mod:`dexkit.wire.revo2`.

The device has no time-out that any source tells of: it goes to its last goal and stays there. A
joint that is to hold gets the position at which it was measured last as its goal.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel, SerialChannel
from dexkit.drivers.modbus_answers import accept
from dexkit.drivers.request_line import LATE, RequestLine, RequestStatistics
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import (
    HandError,
    HandLost,
    HandNotFound,
    HandRefused,
    HandTimeout,
    UsageError,
)
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, Side
from dexkit.models import BRAINCO_REVO2
from dexkit.wire import revo2
from dexkit.wire.modbus import Adu, Function, Request, RtuParser, signed
from dexkit.wire.revo2 import Holding, Input, UnitMode

__all__ = ["SETTINGS", "Revo2Serial", "Revo2Settings", "backend"]

log = logging.getLogger(__name__)

_ATTEMPTS = 3  # to prepare a hand that is opened
_FULL = revo2.FULL
_N = revo2.JOINTS


@dataclass(frozen=True)
class Revo2Settings:
    """Settings of :class:`Revo2Serial`.

    :param device: path of the serial port or USB serial number of its adapter.
    :param id: Modbus unit; None for that of the side.
    :param baudrate: bits a second.
    :param speed: most of every joint, a part of the full speed; commands are limited to it.
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


class Revo2Serial:
    """A Revo2.

    :param side: which hand.
    :param configuration: port, id, speed and time-out.

    ``open`` checks the side, sets the unit of the registers, and reads the positions. No motion.
    ``close`` has every joint hold where it is.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds."""

    def __init__(
        self,
        side: Side,
        configuration: Revo2Settings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration or Revo2Settings()
        self.statistics = RequestStatistics()
        self._side = side
        own = self.configuration.id
        self._unit = revo2.UNITS[side] if own is None else own
        self._line = RequestLine(self.statistics, self.configuration.timeout)
        self._parser = RtuParser(answers=True)
        self._clock: Clock = clock or RealClock()
        self._channel: Channel | None = None
        self._written: list[int] | None = None
        """Goals and speeds that the device has acknowledged."""
        self._position = [0] * _N
        self._held: list[int | None] = [None] * _N
        """Where joints hold, while they do."""
        joints = BRAINCO_REVO2.joints[side]
        self._full_speed = np.array([joint.dq_max for joint in joints])
        self._full_current = np.array([joint.tau_max for joint in joints])
        self._spec = BRAINCO_REVO2.spec(
            side,
            io_rate=BRAINCO_REVO2.state_rate,
            exchange_timeout=2 * (self.configuration.timeout + LATE),
        )

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    # --- opening and closing

    def open(self) -> None:
        """Open the port, check the side, set the registers' unit, read the positions. No motion.

        :raises HandNotFound: no port was named or there is none, or the hand does not answer.
        :raises HandRefused: another program uses the port, or it is the other hand.
        :raises HandLost: the port goes away.
        """
        if self._channel is not None:
            return
        settings = self.configuration
        if settings.device is None:
            raise HandNotFound(
                "which serial port is the hand on?", hint="--device PATH or USB serial number"
            )
        self._channel = SerialChannel(settings.device, settings.baudrate)
        self._line.restart()
        self._written, self._held = None, [None] * _N
        place = self._channel.place
        try:
            self._prepare()
        except HandTimeout as error:
            self._close_channel()
            raise HandNotFound(
                f"no hand with id {self._unit} answers on {place} at {settings.baudrate} baud",
                hint="is its supply on, and its switch at Modbus? Left hands are 126, right ones "
                "127 by default",
            ) from error
        except BaseException:
            self._close_channel()
            raise
        log.info("Revo2 on %s: id %d, at %s", place, self._unit, self._position)

    def _prepare(self) -> None:
        """Check the side, set the registers' unit, read the positions; an answer may be lost.

        :raises HandRefused: it is the other hand.
        :raises HandTimeout: several answers were lost.
        """
        for left in reversed(range(_ATTEMPTS)):
            try:
                (number,) = self._read(Function.READ_HOLDING, Holding.SIDE, 1)
                if revo2.SIDES.get(number, self._side) is not self._side:
                    raise HandRefused(
                        f"the hand on this port is a {revo2.SIDES[number]} one, not the "
                        f"{self._side} one",
                        hint="swap the ports of --device, or --side",
                    )
                (mode,) = self._read(Function.READ_HOLDING, Holding.UNIT_MODE, 1)
                if mode != UnitMode.NORMALISED:
                    log.warning("the hand was set to degrees; it is set to parts of the travel")
                    self._ask(
                        Request(Function.WRITE_ONE, Holding.UNIT_MODE, 1, (UnitMode.NORMALISED,))
                    )
                self._position = self._read_motors()[0].tolist()
                return
            except HandTimeout:
                if not left:
                    raise

    def close(self) -> None:
        """Hold every joint and release the port. Failures are logged, not raised."""
        channel = self._channel
        if channel is None:
            return
        try:
            self._position = self._read_motors()[0].tolist()
            self._write(revo2.position_and_speed(self._position, [_FULL] * _N))
        except HandError as error:
            log.warning("could not hold: %s; the hand goes to its last goal", error)
        finally:
            self._close_channel()
            log.info("Revo2 on %s closed: %s", channel.place, self.statistics)

    def _close_channel(self) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def __enter__(self) -> Revo2Serial:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Write goals and speeds if they have changed, and read what is measured.

        :raises HandLost: the port has gone away, or the hand is not open.
        :raises HandTimeout: no intact answer in time, or this program was paused before the goals
            were written.
        """
        deadline = WriteDeadline(self._clock)
        if self._channel is None:
            raise HandLost("the hand is not open", hint="call open() first")
        goals = self._goals(command)
        if goals != self._written:
            self._written = None
            self._write(goals, deadline)
            self._written = goals
        position, speed, current, _ = self._read_motors()
        self._position = position.tolist()
        driven = command.mode == JointMode.FOC
        return HandState.from_values(
            position / _FULL,
            stamp=self._clock.now(),
            dq=speed / _FULL * self._full_speed,
            tau_est=current / _FULL * self._full_current,
            mode=driven.astype(int).tolist(),
        )

    def _goals(self, command: HandCommand) -> list[int]:
        """The goal and speed of each joint, of one that holds where it was when that began."""
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
                continue
            held = self._held[i]
            if held is None:
                held = self._held[i] = self._position[i]
            positions.append(held)
            speeds.append(_FULL)
        return revo2.position_and_speed(positions, speeds)

    # --- the registers

    def _read_motors(self) -> npt.NDArray[np.int64]:
        """Positions, speeds, currents and status, shape (4, 6)."""
        found = self._read(Function.READ_INPUT, Input.POSITION, 4 * _N)
        table = np.array(signed(found), np.int64).reshape(4, _N)
        table[0] = np.clip(table[0], 0, _FULL)
        return table

    def _read(self, function: Function, address: int, count: int) -> tuple[int, ...]:
        return self._ask(Request(function, address, count))

    def _write(self, values: list[int], before: WriteDeadline | None = None) -> None:
        self._ask(Request.write(Holding.POSITION_AND_SPEED, values), before)

    def _ask(self, request: Request, before: WriteDeadline | None = None) -> tuple[int, ...]:
        """Do one request; a device that has gone is closed."""
        channel = self._channel
        if channel is None:
            raise HandLost("the hand is not open", hint="call open() first")

        def match(answer: Adu) -> tuple[int, ...] | None:
            return accept(answer, request) if answer.unit == self._unit else None

        data = Adu(self._unit, request.pack()).pack_rtu()
        try:
            return self._line.ask(channel, data, self._parser, match, before)
        except HandTimeout:
            raise
        except HandError:
            self._close_channel()
            raise


_PARSERS: Parsers = {
    "id": (int, "Modbus unit (default 126 left, 127 right)"),
    "baudrate": (int, f"bits a second (default {revo2.BAUD_RATE})"),
    "speed": (float, "most of every joint, a part of the full speed (default 1)"),
    "timeout": (float, "seconds to wait for an answer (default 0.03)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> Revo2Serial:
    values = parse_settings(options, _PARSERS)
    settings = Revo2Settings(device=options.device, **values)  # type: ignore[arg-type]
    return Revo2Serial(options.side, settings)


backend = Backend(
    summary="BrainCo Revo2 hand on a serial port (Modbus RTU)",
    model=BRAINCO_REVO2.name,
    make=_make,
    needs="--device left=PATH --device right=PATH",
    settings=SETTINGS,
)
