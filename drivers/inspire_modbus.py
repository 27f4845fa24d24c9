"""Driver of an Inspire RH56 with a network port, by Modbus on TCP (docs/inspire.md).

The registers are those of the serial line; :mod:`dexkit.drivers.inspire_hand` uses them. A Modbus
register is the two bytes from its address on, the first one low
(docs/sources/unitree-dex.md#j2).

A refusal or an unexpected answer fails one exchange, as a time-out does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexkit.backends import SHARED_MACHINE, Backend, BackendOptions, Emulator
from dexkit.clock import Clock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel, TcpChannel, tcp_address
from dexkit.drivers.inspire_hand import COMMON_SETTINGS, InspireHand, InspireSettings
from dexkit.drivers.modbus_answers import accept
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import HandLost, HandNotFound
from dexkit.hand import Side
from dexkit.models import INSPIRE_DFX
from dexkit.wire.modbus import Adu, Function, Request, TcpParser
from dexkit.wire.rh56 import Register

__all__ = ["PARSERS", "PORT", "SETTINGS", "InspireModbus", "InspireModbusSettings", "backend"]

PORT = 6000
"""Default address of the hand (docs/sources/unitree-dex.md#j2)."""
_CONNECT = 1.0  # s to wait for a connection


@dataclass(frozen=True)
class InspireModbusSettings(InspireSettings):
    """Settings of :class:`InspireModbus`: ``device`` is HOST[:PORT], ``id`` Modbus' unit."""

    timeout: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.device is not None:
            tcp_address(self.device, PORT)

    @property
    def ids(self) -> range:
        """Valid units."""
        return range(256)


class InspireModbus(InspireHand):
    """An RH56 on the network."""

    def __init__(
        self,
        side: Side,
        configuration: InspireModbusSettings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self._settings = configuration or InspireModbusSettings()
        super().__init__(side, self._settings, clock=clock)
        self._parser = TcpParser()
        self._transaction = 0

    def _connect(self) -> Channel:
        if self._settings.device is None:
            raise HandNotFound(
                "no address of the hand is given", hint=f"--device HOST, with port {PORT}"
            )
        self._parser.reset()
        return TcpChannel(*tcp_address(self._settings.device, PORT), _CONNECT)

    def _absent(self, place: str) -> HandNotFound:
        return HandNotFound(
            f"{place} accepts connections, but no hand answers there as unit {self._settings.id}",
            hint="does another program use the hand? Other units: --set id=255",
        )

    def _write(
        self, channel: Channel, register: Register, data: bytes, before: WriteDeadline | None
    ) -> None:
        values = np.frombuffer(data, "<u2").tolist()
        self._exchange(channel, Request.write(register, values), before)

    def _read(self, channel: Channel, register: int, count: int) -> bytes:
        request = Request(Function.READ_HOLDING, register, (count + 1) // 2)
        return np.array(self._exchange(channel, request, None), "<u2").tobytes()[:count]

    def _exchange(
        self, channel: Channel, request: Request, before: WriteDeadline | None
    ) -> tuple[int, ...]:
        # an answer names its request, so that a late one is not taken for another's
        self._transaction = (self._transaction + 1) & 0xFFFF
        adu = Adu(self._settings.id, request.pack(), self._transaction)

        def match(answer: Adu) -> tuple[int, ...] | None:
            return accept(answer, request) if answer.transaction == adu.transaction else None

        try:
            return self._line.ask(channel, adu.pack_tcp(), self._parser, match, before)
        finally:
            if self._parser.broken:
                raise HandLost(
                    f"{channel.place} does not send Modbus", hint="is it the hand's address?"
                )


PARSERS: Parsers = {
    "id": (int, "Modbus' unit (default 1)"),
    **COMMON_SETTINGS,
    "timeout": (float, "seconds to wait for an answer (default 0.1)"),
}
SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in PARSERS.items()}
"""Name and help of each setting."""


def _make(options: BackendOptions) -> InspireModbus:
    values = parse_settings(options.settings, PARSERS)
    settings = InspireModbusSettings(device=options.device, **values)  # type: ignore[arg-type]
    return InspireModbus(options.side, settings)


backend = Backend(
    summary="Inspire RH56 hand on the network (Modbus TCP)",
    model=INSPIRE_DFX.name,
    make=_make,
    needs="--device left=HOST --device right=HOST",
    settings=SETTINGS,
    emulator=Emulator(
        ("rh56", "--link", "tcp://127.0.0.1:0"), linked=False, settings=SHARED_MACHINE
    ),
)
