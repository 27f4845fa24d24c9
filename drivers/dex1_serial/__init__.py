"""Driver of the Dex1-1 on its serial line (docs/dex1-serial.md).

``Dex1Serial`` is the hand, ``backend`` what ``dexkit serve dex1-serial`` opens. It uses
:mod:`discovery` (which port), :mod:`line` (the port, shared by the motors on it) and
:mod:`settings`. The frames are in :mod:`dexkit.wire.m4010`.
"""

from dexkit.drivers.dex1_serial.discovery import find_motor
from dexkit.drivers.dex1_serial.hand import Dex1Serial, Dex1Statistics, backend
from dexkit.drivers.dex1_serial.settings import Dex1Settings

__all__ = ["Dex1Serial", "Dex1Settings", "Dex1Statistics", "backend", "find_motor"]
