"""Settings of the Dex1-1 driver, which ``--set`` changes on the command line."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import platformdirs

from dexkit.backends import BackendOptions
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import UsageError
from dexkit.wire import m4010
from dexkit.wire.mounting import Mounting

__all__ = [
    "OF_THE_HAND",
    "PORTS",
    "SETTINGS",
    "Dex1Settings",
    "default_path",
    "from_options",
    "with_stored",
]

ENVIRONMENT = "DEXKIT_DEX1_CONFIG"
"""Environment variable with the path of another settings file."""

PORTS = ("/dev/ttyUSB*", "/dev/ttyCH343USB*")
"""Where the vendor's service looks for motors (docs/sources/unitree-dex.md#b2)."""


def default_path() -> Path:
    """Return ``$DEXKIT_DEX1_CONFIG``, or dex1.json in the user's configuration."""
    named = os.environ.get(ENVIRONMENT)
    return Path(named) if named else platformdirs.user_config_path("dexkit") / "dex1.json"


@dataclass(frozen=True)
class Dex1Settings:
    """Settings of :class:`~dexkit.drivers.dex1_serial.hand.Dex1Serial`.

    :param device: path of the serial port or USB serial number of its adapter; None to probe every
        port that matches ``ports``.
    :param ports: glob patterns.
    :param id: id of the motor; None for the one of the side.
    :param sign: +1 if the jaws open while the motor's position rises, else -1.
    :param offset: the motor's position where the jaws are closed, rad at the joint.
    :param ratio: turns of the rotor for one of the joint.
    :param adapter: USB serial number of the adapter on which these settings were found; a gripper
        on another one is refused. None for any.
    :param config: file with settings of each side's gripper (docs/bringup.md); None to read none.
    :param given: names of settings that those in the file do not replace.
    :param baudrate: bits a second.
    :param protect: enable the motor's time-out protection, which stops it 1 s after a command.
    :param timeout: seconds to wait for an answer.
    """

    device: str | None = None
    ports: tuple[str, ...] = PORTS
    id: int | None = None
    sign: int = 1
    offset: float = 0.0
    ratio: float = m4010.GEAR_RATIO
    adapter: str | None = None
    config: Path | None = None
    given: frozenset[str] = frozenset()
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
        _ = self.mounting  # which says what is wrong

    @property
    def mounting(self) -> Mounting:
        """Direction, zero and gearing of the motor."""
        return Mounting((self.sign,), (self.offset,), (self.ratio,))


def _parse_switch(text: str) -> bool:
    if text not in ("on", "off"):
        raise ValueError("on or off")
    return text == "on"


def _parse_patterns(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _parse_sign(text: str) -> int:
    if text not in ("+", "-"):
        raise ValueError("+ or -")
    return 1 if text == "+" else -1


_PARSERS: Parsers = {
    "ports": (
        _parse_patterns,
        f"where to look without --device, patterns with commas (default {','.join(PORTS)})",
    ),
    "id": (int, "of the motor (default 0 for the right hand, 1 for the left)"),
    "sign": (_parse_sign, "+: the jaws open while the motor's position rises; - (default +)"),
    "offset": (float, "rad at the joint: the motor's position of the closed jaws (default 0)"),
    "ratio": (float, f"turns of the rotor for one of the joint (default {m4010.GEAR_RATIO:g})"),
    "adapter": (str, "USB serial number of the adapter; a gripper on another one is refused"),
    "config": (Path, "file with settings of each side's gripper (default the user's)"),
    "baudrate": (int, f"bits a second (default {m4010.BAUD_RATE})"),
    "protect": (_parse_switch, "on: the motor stops after 1 s without a command; off (default on)"),
    "timeout": (float, f"seconds to wait for an answer (default {m4010.REPLY_TIMEOUT:g})"),
}

SETTINGS: dict[str, str] = {name: meaning for name, (_, meaning) in _PARSERS.items()}
"""Name and help of each setting."""


OF_THE_HAND = ("id", "sign", "offset", "ratio", "adapter")
"""Settings of one gripper that the settings file stores by side."""


def from_options(options: BackendOptions) -> Dex1Settings:
    """Build the settings from command-line options.

    :raises UsageError: a value cannot be parsed or is out of range.
    """
    values = {"config": default_path()} | parse_settings(options.settings, _PARSERS)
    given = frozenset(options.settings)
    return Dex1Settings(device=options.device, given=given, **values)  # type: ignore[arg-type]


def with_stored(settings: Dex1Settings, texts: Mapping[str, str]) -> Dex1Settings:
    """Merge the settings of a file into these; the given ones take precedence.

    Without a device, the adapter named in the file is used.

    :raises UsageError: a setting is unknown, or cannot be parsed.
    """
    for name in texts:
        if name not in OF_THE_HAND:
            raise UsageError(
                f"{name} is no setting of a single gripper",
                hint=f"known: {', '.join(OF_THE_HAND)}",
            )
    chosen = {name: text for name, text in texts.items() if name not in settings.given}
    values = parse_settings(chosen, _PARSERS)
    if settings.device is None and "ports" not in settings.given and "adapter" in values:
        values["device"] = values["adapter"]
    return replace(settings, **values)  # type: ignore[arg-type]
