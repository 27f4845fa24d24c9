"""Settings of the Dex1-1 driver, which ``--set`` changes on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dexkit.backends import BackendOptions
from dexkit.errors import UsageError
from dexkit.wire import m4010

__all__ = ["PORTS", "SETTINGS", "Dex1Settings", "from_options"]

PORTS = ("/dev/ttyUSB*", "/dev/ttyCH343USB*")
"""Where the vendor's service looks for motors (docs/sources/unitree-dex.md#b2)."""


@dataclass(frozen=True)
class Dex1Settings:
    """Settings of :class:`~dexkit.drivers.dex1_serial.hand.Dex1Serial`.

    :param device: path of the serial port or USB serial number of its adapter; None to probe every
        port that matches ``ports``.
    :param ports: glob patterns.
    :param id: id of the motor; None for the one of the side.
    :param baudrate: bits a second.
    :param protect: enable the motor's time-out protection, which stops it 1 s after a command.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    ports: tuple[str, ...] = PORTS
    id: int | None = None
    baudrate: int = m4010.BAUD_RATE
    protect: bool = True
    timeout: float = m4010.REPLY_TIMEOUT

    def __post_init__(self) -> None:
        if not 1e-3 <= self.timeout <= 1:
            raise UsageError(f"timeout must be 0.001 to 1 s, not {self.timeout:g}")
        if self.id is not None and not 0 <= self.id < m4010.BROADCAST_ID:
            raise UsageError(f"id must be 0 to {m4010.BROADCAST_ID - 1}, not {self.id}")
        if not 9600 <= self.baudrate <= 12_000_000:
            raise UsageError(f"baudrate must be 9600 to 12000000, not {self.baudrate}")
        if not self.ports or not all(self.ports):
            raise UsageError("ports must name at least one place to look")


def _parse_switch(text: str) -> bool:
    if text not in ("on", "off"):
        raise ValueError("on or off")
    return text == "on"


def _parse_patterns(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


_PARSERS: dict[str, tuple[Callable[[str], object], str]] = {
    "ports": (
        _parse_patterns,
        f"where to look without --device, patterns with commas (default {','.join(PORTS)})",
    ),
    "id": (int, "of the motor (default 0 for the right hand, 1 for the left)"),
    "baudrate": (int, f"bits a second (default {m4010.BAUD_RATE})"),
    "protect": (_parse_switch, "on: the motor stops after 1 s without a command; off (default on)"),
    "timeout": (float, f"seconds to wait for an answer (default {m4010.REPLY_TIMEOUT:g})"),
}

SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


def from_options(options: BackendOptions) -> Dex1Settings:
    """Build the settings from command-line options.

    :raises UsageError: a value cannot be parsed or is out of range.
    """
    values: dict[str, object] = {}
    for name, text in options.settings.items():
        parse, meaning = _PARSERS[name]
        try:
            values[name] = parse(text)
        except ValueError as error:
            raise UsageError(f"{name}={text}: {error}", hint=f"{name} is {meaning}") from error
    return Dex1Settings(device=options.device, **values)  # type: ignore[arg-type]
