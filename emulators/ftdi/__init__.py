"""Emulated FTDI USB-serial adapter on USB/IP, for the serial drivers of a real kernel."""

from dexkit.emulators.ftdi.chip import FT232H, FT232R, ChipModel, FtdiChip, Request, baudrate_of
from dexkit.emulators.ftdi.port import FtdiPort
from dexkit.emulators.ftdi.usb import FtdiUsb

__all__ = [
    "FT232H",
    "FT232R",
    "ChipModel",
    "FtdiChip",
    "FtdiPort",
    "FtdiUsb",
    "Request",
    "baudrate_of",
]
