"""Emulate a Unitree Dex3-1 on USB/IP: the hand's processor and motors.

From the inside out: :mod:`settings` (uncertain points), :mod:`wiring` (where the motors are),
:mod:`device` (the processor: frames, motors, time-outs, faults) and :mod:`answer` (its state as
bytes) are sans-IO, over the mechanics of :mod:`dexkit.emulators.dex3_mechanics`; :mod:`usb` gives
it descriptors and endpoints; :mod:`server` exports those on TCP; :mod:`hands` has the helper
:func:`emulated_dex3` for tests.
"""

from dexkit.emulators.dex3_mcu.device import Counters, Dex3Mcu
from dexkit.emulators.dex3_mcu.hands import Dex3Hands, Dex3Process, emulated_dex3
from dexkit.emulators.dex3_mcu.server import Server
from dexkit.emulators.dex3_mcu.settings import Firmware
from dexkit.emulators.dex3_mcu.usb import SERIAL, Dex3Usb
from dexkit.emulators.dex3_mcu.wiring import Wiring

__all__ = [
    "SERIAL",
    "Counters",
    "Dex3Hands",
    "Dex3Mcu",
    "Dex3Process",
    "Dex3Usb",
    "Firmware",
    "Server",
    "Wiring",
    "emulated_dex3",
]
