"""Driver of Inspire's RH56DFX on a serial port (docs/inspire.md).

The frames are in :mod:`dexkit.wire.rh56`, their use in :mod:`dexkit.drivers.inspire_hand`.
"""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.clock import Clock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel, SerialChannel
from dexkit.drivers.inspire_hand import COMMON_SETTINGS, InspireHand, InspireSettings
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import HandNotFound, UsageError
from dexkit.hand import Side
from dexkit.models import INSPIRE_DFX
from dexkit.wire import rh56
from dexkit.wire.rh56 import Frame, FrameParser, Operation, Register

__all__ = ["SETTINGS", "InspireSerial", "InspireSerialSettings", "backend"]


@dataclass(frozen=True)
class InspireSerialSettings(InspireSettings):
    """Settings of :class:`InspireSerial`: ``device`` is a path, or an adapter's USB serial number.

    :param baudrate: bits a second.

    Both hands of a G1 have id 1, each on its own line.
    """

    baudrate: int = rh56.BAUD_RATE

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 9600 <= self.baudrate <= 1_000_000:
            raise UsageError(f"baudrate must be 9600 to 1000000, not {self.baudrate}")


class InspireSerial(InspireHand):
    """An RH56DFX on a serial port."""

    def __init__(
        self,
        side: Side,
        configuration: InspireSerialSettings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self._settings = configuration or InspireSerialSettings()
        super().__init__(side, self._settings, clock=clock)
        self._parser = FrameParser(answers=True)

    def _connect(self) -> Channel:
        if self._settings.device is None:
            raise HandNotFound("no serial port is given", hint="--device PATH or USB serial number")
        return SerialChannel(self._settings.device, self._settings.baudrate)

    def _absent(self, place: str) -> HandNotFound:
        return HandNotFound(
            f"no hand with id {self._settings.id} answers on {place} at "
            f"{self._settings.baudrate} baud",
            hint="is its 24 V supply on, and is it the serial (DFX) model?",
        )

    def _write(
        self, channel: Channel, register: Register, data: bytes, before: WriteDeadline | None
    ) -> None:
        if register is Register.CLEAR_ERROR:
            data = data[:1]  # one byte, as Unitree's service has it
        request = Frame(self._settings.id, Operation.WRITE, register, data)
        self._exchange(channel, request, 1, before)

    def _read(self, channel: Channel, register: int, count: int) -> bytes:
        return self._exchange(channel, rh56.read(self._settings.id, register, count), count, None)

    def _exchange(
        self, channel: Channel, request: Frame, count: int, before: WriteDeadline | None
    ) -> bytes:
        """Send a request and return the ``count`` data bytes of its answer."""
        wanted = (request.device, request.operation, request.address)

        def match(answer: Frame) -> bytes | None:
            same = (answer.device, answer.operation, answer.address) == wanted
            return answer.data if same and len(answer.data) == count else None

        return self._line.ask(channel, request.pack(), self._parser, match, before)


_PARSERS: Parsers = {
    "id": (int, "of the hand on its line (default 1)"),
    "baudrate": (int, f"bits a second (default {rh56.BAUD_RATE})"),
    **COMMON_SETTINGS,
    "timeout": (float, "seconds to wait for an answer (default 0.03)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> InspireSerial:
    values = parse_settings(options.settings, _PARSERS)
    settings = InspireSerialSettings(device=options.device, **values)  # type: ignore[arg-type]
    return InspireSerial(options.side, settings)


backend = Backend(
    summary="Inspire RH56DFX hand on a serial port",
    model=INSPIRE_DFX.name,
    make=_make,
    needs="--device left=PATH --device right=PATH",
    settings=SETTINGS,
    emulator=Emulator(("rh56", "--side", "{side}"), linked=True, settings=SHARED_MACHINE),
)
