"""Find a network interface by its name, its address or a prefix of addresses; wait for it.

A robot's computer names its interface ``eth0``, a workstation ``enp0s31f6``: the network is the
same, 192.168.123.0/24. So that is accepted wherever an interface is named:

    find_interface("eth0"), find_interface("192.168.123.5"), find_interface("192.168.123.0/24"),
    find_interface("192.168.123.")
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import time
from collections.abc import Callable

from dexkit.errors import DdsSetupError, UsageError
from dexkit.interface_filter import (
    interface_address,
    interface_addresses,
    interface_flags,
    is_loopback,
)

__all__ = [
    "PEERS",
    "find_interface",
    "interface_towards",
    "named_peers",
    "resolve_peers",
    "wait_for_interface",
]

PEERS = "DEXKIT_PEERS"
"""Environment variable: other machines to call by unicast, separated by commas."""

_IFF_UP = 0x1
_WAITS = "'dexkit serve --wait-for-interface S' waits for one that comes later"
_POLL = 0.2  # seconds between two looks for an interface that is not there yet
_PARTIAL = re.compile(r"(\d{1,3}\.){1,3}|\d{1,3}(\.\d{1,3}){1,2}")  # 192.168.123. or 192.168.123


def _names() -> list[str]:
    return [name for _, name in socket.if_nameindex()]


def _list() -> str:
    """The interfaces of this machine, for a hint."""
    shown = []
    for name in _names():
        address = interface_address(name)
        shown.append(f"{name} ({address})" if address else name)
    return f"this machine has: {', '.join(shown)}"


def _network(text: str) -> ipaddress.IPv4Network | None:
    """The addresses that a text means, or None for a name."""
    if _PARTIAL.fullmatch(text):
        parts = text.rstrip(".").split(".")
        text = ".".join(parts + ["0"] * (4 - len(parts))) + f"/{8 * len(parts)}"
    elif not re.fullmatch(r"[0-9.]+(/\d+)?", text):
        return None
    try:
        return ipaddress.IPv4Network(text, strict=False)
    except ValueError as error:
        raise UsageError(
            f"{text!r} is no address and no prefix of addresses: {error}",
            hint=f"e.g. 192.168.123.5 or 192.168.123.0/24; {_list()}",
        ) from error


def find_interface(text: str) -> str:
    """Name of the interface that has a name, an IPv4 address, or an address with a prefix.

    :raises DdsSetupError: there is none, or more than one, or it has no IPv4 address.
    :raises UsageError: neither a name nor an address nor a prefix.
    """
    network = None if text in _names() else _network(text)
    if network is None:
        return _named(text)
    found = [
        name
        for name in _names()
        if any(ipaddress.IPv4Address(a) in network for a in interface_addresses(name))
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise DdsSetupError(
            f"several network interfaces have an address in {network}: {', '.join(found)}",
            hint=f"name one; {_list()}",
        )
    what = f"address {text}" if network.prefixlen == 32 else f"an address in {network}"
    raise DdsSetupError(
        f"no network interface has {what}",
        hint=f"is the cable plugged in? {_list()}; {_WAITS}",
    )


def _named(name: str) -> str:
    if name not in _names():
        raise DdsSetupError(
            f"there is no network interface {name!r}",
            hint=f"{_list()}; {_WAITS}",
        )
    if not interface_address(name) and not is_loopback(name):
        down = "" if interface_flags(name) & _IFF_UP else " and is down"
        raise DdsSetupError(
            f"network interface {name!r} has no IPv4 address{down}",
            hint=f"is the cable plugged in? {_list()}; {_WAITS}",
        )
    return name


def wait_for_interface(
    text: str,
    seconds: float,
    *,
    waiting: Callable[[str], object] = lambda reason: None,
    sleep: Callable[[float], object] = time.sleep,
    now: Callable[[], float] = time.monotonic,
) -> str:
    """Name of an interface, as soon as it is there, up and has an address.

    :param seconds: how long to wait at most.
    :param waiting: gets the reason once, when it is not there at first.
    :raises DdsSetupError: it did not come in time.
    """
    end = now() + seconds
    reported = False
    while True:
        try:
            name = find_interface(text)
            if interface_flags(name) & _IFF_UP:
                return name
            raise DdsSetupError(f"network interface {name!r} is down")
        except DdsSetupError as error:
            if now() >= end:
                raise
            if not reported:
                waiting(str(error))
                reported = True
        sleep(_POLL)


def interface_towards(address: str) -> str:
    """Name of the interface by which this machine reaches an address.

    :raises DdsSetupError: it has no route to it.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((address, 9))  # sends nothing
            own = sock.getsockname()[0]
        except OSError as error:
            raise DdsSetupError(
                f"this machine has no route to {address}: {error.strerror}",
                hint=f"{_list()}; give --interface",
            ) from error
    return find_interface(own)


def named_peers() -> tuple[str, ...]:
    """Addresses of the other machines that are called by unicast.

    :raises DdsSetupError: a name is not known.
    """
    return resolve_peers([p.strip() for p in os.environ.get(PEERS, "").split(",") if p.strip()])


def resolve_peers(texts: list[str]) -> tuple[str, ...]:
    """IPv4 addresses of other machines, by name or address, each once.

    :raises DdsSetupError: a name is not known.
    """
    found = []
    for text in texts:
        try:
            found.append(socket.getaddrinfo(text, None, socket.AF_INET)[0][4][0])
        except (OSError, UnicodeError) as error:
            raise DdsSetupError(
                f"the peer {text!r} is not known: {getattr(error, 'strerror', error) or error}",
                hint="give its IPv4 address",
            ) from error
    return tuple(dict.fromkeys(map(str, found)))
