"""``python -m tools.lab.guest.probe dex3`` or ``mx64 PATH``: use a device once, in its own process,
as its own user, and print what happened.
"""

from __future__ import annotations

import sys

from dexkit.errors import DexkitError

__all__ = ["ping", "probe"]


def probe(device: str, path: str = "") -> str:
    """Open a device without moving it; what happened."""
    if device == "mx64":
        return ping(path)
    from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
    from dexkit.hand import HandCommand, Side

    with Dex3Usb(Side.LEFT, Dex3Settings(local=False)) as hand:
        hand.exchange(HandCommand.brake(7))
    return "opened the left hand"


def ping(path: str) -> str:
    """Ask for the servo on a serial port."""
    from dexkit.drivers.ezgripper.bus import ServoBus

    bus = ServoBus(path, 1_000_000, timeout=0.2, retries=2)
    bus.open()
    try:
        return f"model {bus.ping(1).model} answers on {path}"
    finally:
        bus.close()


if __name__ == "__main__":
    try:
        print(probe(*sys.argv[1:]))
    except DexkitError as error:
        print(f"{type(error).__name__}: {error.message}; {error.hint}")
