"""Settings of the Dex3-1 driver, which ``--set`` changes on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from dexkit.backends import BackendOptions
from dexkit.drivers.dex3_usb.discovery import Server, parse_server
from dexkit.errors import UsageError, WireError
from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import (
    COMMAND_1234,
    COMMAND_HEAD,
    COMMAND_LAYOUTS,
    DEFAULT_BUS_MAP,
    BusMap,
    CommandLayout,
)

__all__ = ["SETTINGS", "Dex3Settings", "from_options", "parse_places"]


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
            ("motors", self.bus_map.motors, len(DEX3_1.joints[Side.LEFT])),
            ("sensors", self.bus_map.sensors, len(DEX3_1.sensors)),
        ):
            if len(places) != wanted:
                raise UsageError(
                    f"{name}: the hand has {wanted}, here are {len(places)} place(s)",
                    hint=f"{name} is {_PARSERS[name][1]}",
                )


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


def _format_places(places: tuple[tuple[int, int], ...]) -> str:
    return ",".join(f"{bus}.{number}" for bus, number in places)


_PARSERS: dict[str, tuple[Callable[[str], object], str]] = {
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
        f"(default {_format_places(DEFAULT_BUS_MAP.motors)})",
    ),
    "sensors": (
        parse_places,
        f"BUS.ID of each sensor packet (default {_format_places(DEFAULT_BUS_MAP.sensors)})",
    ),
    "out_endpoint": (_parse_address, "address such as 0x02 (default the first bulk OUT)"),
    "in_endpoint": (_parse_address, "address such as 0x81 (default the first bulk IN)"),
}
_USB = (
    "where: auto (this machine's USB, then the USB/IP server on 127.0.0.1), system (its USB "
    "only), or usbip://HOST[:PORT] (default auto)"
)

SETTINGS: dict[str, str] = {"usb": _USB} | {
    name: meaning for name, (_, meaning) in _PARSERS.items()
}
"""Name and help of each setting."""


def from_options(options: BackendOptions) -> Dex3Settings:
    """Build the settings from command-line options.

    :raises UsageError: a value cannot be parsed or is out of range, or two contradict each other.
    """
    values: dict[str, object] = {}
    for name, text in options.settings.items():
        if name == "usb":
            continue
        parse, meaning = _PARSERS[name]
        try:
            values[name] = parse(text)
        except ValueError as error:
            raise UsageError(f"{name}={text}: {error}", hint=f"{name} is {meaning}") from error
    bus_map = DEFAULT_BUS_MAP
    for name in ("motors", "sensors"):
        if name in values:
            try:
                bus_map = replace(bus_map, **{name: values.pop(name)})  # type: ignore[arg-type]
            except (UsageError, WireError) as error:
                meaning = f"{name} is {_PARSERS[name][1]}"
                raise UsageError(
                    f"{name}={options.settings[name]}: {error}", hint=meaning
                ) from error
    if "frame" in values:
        values["layout"] = values.pop("frame")
    return Dex3Settings(bus_map=bus_map, **_parse_location(options), **values)  # type: ignore[arg-type]


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
            raise UsageError(f"--device {device} and usb={usb} are two places")
        server, device = other, number
    if serial is not None and device not in (None, serial):
        raise UsageError(f"serial number {device} or {serial}?")
    return {"serial": device or serial, "server": server, "local": usb != "system"}
