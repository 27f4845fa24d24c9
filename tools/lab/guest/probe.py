"""Use a device once (``dex3``, or ``mx64 PATH``), in a process and as a user of its own."""

from __future__ import annotations

from dexkit.errors import DexkitError

__all__ = ["main", "ping", "probe"]


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


def main(*words: str) -> None:
    """Use a device, and print what happened."""
    try:
        print(probe(*words))
    except DexkitError as error:
        print(f"{type(error).__name__}: {error.message}; {error.hint}")
