"""Settings of the Dex3-1 driver, which ``--set`` changes on the command line."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import platformdirs

from dexkit.backends import BackendOptions
from dexkit.drivers.dex3_usb.discovery import Server, parse_server
from dexkit.drivers.setting_parsers import Parsers, parse_settings
from dexkit.errors import UsageError, WireError
from dexkit.hand import JointSpec, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import (
    COMMAND_1234,
    COMMAND_HEAD,
    COMMAND_LAYOUTS,
    DEFAULT_BUS_MAP,
    BusMap,
    CommandLayout,
    Mounting,
)

__all__ = [
    "MEASURED",
    "OF_THE_HAND",
    "SETTINGS",
    "Dex3Settings",
    "default_path",
    "format_places",
    "from_options",
    "parse_places",
    "with_stored",
]

ENVIRONMENT = "DEXKIT_DEX3_CONFIG"
"""Environment variable with the path of another settings file."""
_N = len(DEX3_1.joints[Side.LEFT])


def default_path() -> Path:
    """Return ``$DEXKIT_DEX3_CONFIG``, or dex3.json in the user's configuration."""
    named = os.environ.get(ENVIRONMENT)
    return Path(named) if named else platformdirs.user_config_path("dexkit") / "dex3.json"


@dataclass(frozen=True)
class Dex3Settings:
    """Settings of :class:`~dexkit.drivers.dex3_usb.hand.Dex3Usb`.

    :param serial: serial number, or None for the only hand of its side.
    :param server: USB/IP server to search, or None for this machine's USB.
    :param local: without a server, also search the local one if USB has no such hand.
    :param layout: layout of the command frame; the manual gives two sizes
        (docs/sources/unitree-dex.md#c5).
    :param head: first two bytes of the command frame, which the manual does not give.
    :param bus_map: bus and id of each motor and sensor; the manual's figure of it is lost
        (docs/sources/unitree-dex.md#c7).
    :param signs: +1 for each joint whose motor turns as the joint does, else -1.
    :param offsets: the motor's position where its joint is at 0, rad at the joint.
    :param ratios: turns of the rotor for one of the joint; None for the model's.
    :param limits: lowest and highest q of each joint, rad; None for the model's. Commands beyond
        are clamped by the driver, whatever sends them.
    :param poll_sensors: whether command frames address the sensors, too; None to poll them if none
        answers otherwise (docs/dex3-protocol.md).
    :param config: file with settings of single hands, by serial number (docs/bringup.md); None to
        read none.
    :param given: names of settings that those in the file do not replace.
    :param guesses: with a file, open also a hand for which it lacks :data:`MEASURED`.
    :param protect: enable the motors' time-out protection, which stops them 1 s after a command.
    :param timeout: seconds to wait for an answer.
    :param send_timeout: seconds that the hand may take to accept a command.
    :param out_endpoint: address; None for the first bulk OUT endpoint.
    :param in_endpoint: likewise IN.
    """

    serial: str | None = None
    server: Server | None = None
    local: bool = True
    layout: CommandLayout = COMMAND_1234
    head: bytes = COMMAND_HEAD
    bus_map: BusMap = DEFAULT_BUS_MAP
    signs: tuple[int, ...] = (1,) * _N
    offsets: tuple[float, ...] = (0.0,) * _N
    ratios: tuple[float, ...] | None = None
    limits: tuple[tuple[float, float], ...] | None = None
    poll_sensors: bool | None = None
    config: Path | None = None
    given: frozenset[str] = frozenset()
    guesses: bool = False
    protect: bool = True
    timeout: float = 0.1
    send_timeout: float = 0.1
    out_endpoint: int | None = None
    in_endpoint: int | None = None

    def __post_init__(self) -> None:
        for name in ("timeout", "send_timeout"):
            if not 1e-3 <= getattr(self, name) <= 5:
                raise UsageError(f"{name} must be 0.001 to 5 s, not {getattr(self, name):g}")
        if len(self.head) != 2:
            raise UsageError(
                f"head is two bytes, not {self.head.hex() or 'none'}",
                hint=f"in hex; the default is {COMMAND_HEAD.hex()}",
            )
        for name, places, wanted in (
            ("motors", self.bus_map.motors, _N),
            ("sensors", self.bus_map.sensors, len(DEX3_1.sensors)),
            ("signs", self.signs, _N),
            ("offsets", self.offsets, _N),
            ("ratios", self.ratios or (1.0,) * _N, _N),
            ("limits", self.limits or ((0.0, 0.0),) * _N, _N),
        ):
            if len(places) != wanted:
                raise UsageError(
                    f"{name}: the hand has {wanted}, here are {len(places)} value(s)",
                    hint=f"{name} is {_PARSERS[name][1]}",
                )
        self.mounting(Side.LEFT)  # refuses values that cannot be

    def mounting(self, side: Side) -> Mounting:
        """Direction, zero and gearing of the motors."""
        ratios = self.ratios or tuple(joint.gear_ratio for joint in DEX3_1.joints[side])
        return Mounting(self.signs, self.offsets, ratios)

    def joints(self, side: Side) -> tuple[JointSpec, ...]:
        """The joints with these limits and ratios.

        :raises UsageError: a limit is not within the model's.
        """
        joints = DEX3_1.joints[side]
        limits = self.limits or tuple((joint.q_min, joint.q_max) for joint in joints)
        for joint, (low, high) in zip(joints, limits, strict=True):
            if not joint.q_min - _ROUNDING <= low < high <= joint.q_max + _ROUNDING:
                raise UsageError(
                    f"limits: {joint.name} of a {side} hand has {joint.q_min:.4f} to "
                    f"{joint.q_max:.4f} rad, not {low:g} to {high:g}",
                    hint="limits may only be narrower than the model's",
                )
        return tuple(
            replace(joint, q_min=low, q_max=high, gear_ratio=ratio)
            for joint, (low, high), ratio in zip(
                joints, limits, self.mounting(side).ratios, strict=True
            )
        )


_ROUNDING = 1e-4  # rad, of limits that were written with four decimals


def parse_places(text: str) -> tuple[tuple[int, int], ...]:
    """Parse ``BUS.ID,BUS.ID,...``, one entry for each motor or sensor packet.

    :raises ValueError: the text has another form.
    """
    places = []
    for part in text.split(","):
        bus, dot, number = part.strip().partition(".")
        if not dot or not bus.isdecimal() or not number.isdecimal():
            raise ValueError(f"{part.strip()!r} is not BUS.ID")
        places.append((int(bus), int(number)))
    return tuple(places)


def _parse_seconds(text: str) -> float:
    return float(text)


def _parse_switch(text: str) -> bool:
    if text not in ("on", "off"):
        raise ValueError("on or off")
    return text == "on"


def _parse_guesses(text: str) -> bool:
    if text not in ("accept", "refuse"):
        raise ValueError("accept or refuse")
    return text == "accept"


def _parse_layout(text: str) -> CommandLayout:
    for layout in COMMAND_LAYOUTS:
        if layout.name == text:
            return layout
    raise ValueError(f"known: {', '.join(layout.name for layout in COMMAND_LAYOUTS)}")


def _parse_address(text: str) -> int:
    value = int(text, 0)
    if not 0 <= value <= 0xFF:
        raise ValueError("not an endpoint address")
    return value


def _parse_list(part: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    return lambda text: tuple(part(value.strip()) for value in text.split(","))


def _parse_sign(text: str) -> int:
    if text not in _SIGNS:
        raise ValueError(f"{text!r} is neither + nor -")
    return _SIGNS[text]


_SIGNS = {"+": 1, "+1": 1, "1": 1, "-": -1, "-1": -1}


def _parse_number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _parse_limits(text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    if not colon:
        raise ValueError(f"{text!r} is not LOW:HIGH")
    return _parse_number(low), _parse_number(high)


def _parse_polling(text: str) -> bool | None:
    if text not in ("auto", "on", "off"):
        raise ValueError("auto, on or off")
    return None if text == "auto" else text == "on"


def format_places(places: tuple[tuple[int, int], ...]) -> str:
    """The text that :func:`parse_places` parses."""
    return ",".join(f"{bus}.{number}" for bus, number in places)


_PARSERS: Parsers = {
    "timeout": (_parse_seconds, "seconds to wait for an answer (default 0.1)"),
    "send_timeout": (
        _parse_seconds,
        "seconds that a command may take to be accepted (default 0.1)",
    ),
    "protect": (_parse_switch, "on: motors stop after 1 s without a command; off (default on)"),
    "frame": (_parse_layout, "bytes of the command frame, 1234 or 734 (default 1234)"),
    "head": (bytes.fromhex, f"two bytes that start it, in hex (default {COMMAND_HEAD.hex()})"),
    "motors": (
        parse_places,
        "BUS.ID of each motor, in the joints' order "
        f"(default {format_places(DEFAULT_BUS_MAP.motors)})",
    ),
    "sensors": (
        parse_places,
        f"BUS.ID of each sensor packet (default {format_places(DEFAULT_BUS_MAP.sensors)})",
    ),
    "signs": (
        _parse_list(_parse_sign),
        "+ or - for each joint: does its motor turn as the joint does? (default all +)",
    ),
    "offsets": (
        _parse_list(_parse_number),
        "rad at the joint: each motor's position where its joint is at 0 (default all 0)",
    ),
    "ratios": (
        _parse_list(_parse_number),
        "turns of each rotor for one of its joint (default 214, then six times 108)",
    ),
    "limits": (
        _parse_list(_parse_limits),
        "LOW:HIGH of each joint, rad, within the model's (default the model's)",
    ),
    "poll_sensors": (
        _parse_polling,
        "on: command frames address the sensors, too; off; auto: if none answers otherwise "
        "(default auto)",
    ),
    "guesses": (
        _parse_guesses,
        "accept: command also a hand whose wiring nobody has found; refuse (default refuse)",
    ),
    "config": (Path, "file with settings of single hands (default the user's)"),
    "out_endpoint": (_parse_address, "address such as 0x02 (default the first bulk OUT)"),
    "in_endpoint": (_parse_address, "address such as 0x81 (default the first bulk IN)"),
}
_USB = (
    "where: auto (this machine's USB, then the USB/IP server on 127.0.0.1), system (its USB "
    "only), or usbip://HOST[:PORT] (default auto)"
)

OF_THE_HAND = (
    *("frame", "head", "motors", "sensors", "signs", "offsets", "ratios", "limits"),
    "poll_sensors",
)
"""Settings of one hand that the settings file stores by serial number."""
MEASURED = {
    "motors": "the place of each motor",
    "signs": "the direction of each joint",
    "offsets": "the zero of each joint",
    "ratios": "the gear of each joint",
}
"""Settings of one hand whose defaults are guesses, and what they say: no source gives them, and
with a wrong one a command moves another joint, the other way, or too far."""
SETTINGS: dict[str, str] = {"usb": _USB} | {
    name: meaning for name, (_, meaning) in _PARSERS.items()
}
"""Name and help of each setting."""


def from_options(options: BackendOptions) -> Dex3Settings:
    """Build the settings from command-line options.

    :raises UsageError: a value cannot be parsed or is out of range, or two contradict each other.
    """
    texts = {name: text for name, text in options.settings.items() if name != "usb"}
    values = {"config": default_path()} | _parse_values(texts)
    return Dex3Settings(**_parse_location(options), given=frozenset(texts), **values)  # type: ignore[arg-type]


def with_stored(settings: Dex3Settings, texts: Mapping[str, str]) -> Dex3Settings:
    """Merge the settings of a file into these; the given ones take precedence.

    :raises UsageError: a setting is unknown, or cannot be parsed.
    """
    for name in texts:
        if name not in OF_THE_HAND:
            raise UsageError(
                f"{name} is no setting of a single hand", hint=f"known: {', '.join(OF_THE_HAND)}"
            )
    chosen = {name: text for name, text in texts.items() if name not in settings.given}
    return replace(settings, **_parse_values(chosen, settings.bus_map))  # type: ignore[arg-type]


def _parse_values(texts: Mapping[str, str], bus_map: BusMap = DEFAULT_BUS_MAP) -> dict[str, object]:
    """Fields of :class:`Dex3Settings`.

    :raises UsageError: a value cannot be parsed.
    """
    values = parse_settings(texts, _PARSERS)
    for name in ("motors", "sensors"):
        if name in values:
            try:
                bus_map = replace(bus_map, **{name: values.pop(name)})  # type: ignore[arg-type]
            except (UsageError, WireError) as error:
                meaning = f"{name} is {_PARSERS[name][1]}"
                raise UsageError(f"{name}={texts[name]}: {error}", hint=meaning) from error
    if "frame" in values:
        values["layout"] = values.pop("frame")
    return values | {"bus_map": bus_map}


def _parse_location(options: BackendOptions) -> dict[str, object]:
    usb = options.settings.get("usb", "auto")
    server: Server | None = None
    serial: str | None = None
    if usb not in ("auto", "system"):
        try:
            server, serial = parse_server(usb)
        except UsageError as error:
            raise UsageError(error.message, hint=f"usb is {_USB}") from error
    device = options.device
    if device is not None and "://" in device:
        other, number = parse_server(device)
        if server not in (None, other) or usb == "system":
            raise UsageError(
                f"--device {device} and usb={usb} name different places",
                hint="say once where the hand is",
            )
        server, device = other, number
    if serial is not None and device not in (None, serial):
        raise UsageError(
            f"--device {device} and usb={usb} name different serial numbers",
            hint="give the serial number once",
        )
    return {"serial": device or serial, "server": server, "local": usb != "system"}
