"""Driver of the Dex3-1 on USB (docs/dex3-usb.md).

``Dex3Usb`` is the hand, ``backend`` what ``dexkit serve dex3-usb`` opens. It uses :mod:`discovery`
(which device), :mod:`link` (bulk transfers, on PyUSB) and :mod:`settings`. USB/IP is in
:mod:`dexkit.usbip`, the frames in :mod:`dexkit.wire.dex3_usb`.
"""

from dexkit.drivers.dex3_usb.discovery import Server, find_hand, list_hands
from dexkit.drivers.dex3_usb.hand import Dex3Statistics, Dex3Usb, backend
from dexkit.drivers.dex3_usb.settings import Dex3Settings

__all__ = [
    "Dex3Settings",
    "Dex3Statistics",
    "Dex3Usb",
    "Server",
    "backend",
    "find_hand",
    "list_hands",
]
