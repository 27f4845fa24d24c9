"""Find Dex3-1 hands on USB in /sys, without opening them."""

from __future__ import annotations

import os
from pathlib import Path

from dexkit.doctor.observations import UsbDevice
from dexkit.doctor.proc_files import command_line, holders
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

__all__ = ["devices"]


def devices(sysfs: Path = Path("/sys"), dev: Path = Path("/dev")) -> tuple[UsbDevice, ...]:
    """The Dex3-1 hands on this machine's USB, without opening any."""
    sides = {product: side for side, product in PRODUCT_ID.items()}
    found = []
    for folder in sorted((sysfs / "bus/usb/devices").glob("*")):
        if _hex(folder / "idVendor") != VENDOR_ID:
            continue
        side = sides.get(_hex(folder / "idProduct"))
        if side is None:
            continue
        node = (
            dev / "bus/usb" / f"{_text(folder / 'busnum'):0>3}" / f"{_text(folder / 'devnum'):0>3}"
        )
        drivers = {
            os.path.basename(os.readlink(link))
            for link in folder.parent.glob(f"{folder.name}:*/driver")
            if link.is_symlink()
        }
        found.append(
            UsbDevice(
                where=folder.name,
                side=str(side),
                serial=_text(folder / "serial"),
                node=str(node),
                writable=os.access(node, os.R_OK | os.W_OK),
                drivers=tuple(sorted(drivers)),
                holders=tuple(
                    f"{command_line(pid) or 'a process'} (pid {pid})" for pid in holders(str(node))
                ),
            )
        )
    return tuple(found)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def _hex(path: Path) -> int:
    try:
        return int(_text(path), 16)
    except ValueError:
        return -1
