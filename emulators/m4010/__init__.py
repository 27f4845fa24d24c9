"""An emulated M4010, the motor of the Dex1-1, with the gripper on its shaft.

From the inside out: :mod:`settings` (uncertain points, heat), :mod:`motor` (commands, protection,
calibration) and :mod:`bus` (motors on a line, faults) are sans-IO;
:mod:`dexkit.emulators.serial_port` puts a bus on a pseudo-terminal; :mod:`gripper` has
:class:`Dex1Motors` for the command line.
"""

from dexkit.emulators.m4010.bus import Bus
from dexkit.emulators.m4010.gripper import Dex1Motors, Dex1Process
from dexkit.emulators.m4010.motor import Motor
from dexkit.emulators.m4010.settings import Firmware, Heat
from dexkit.emulators.m4010.wiring import Wiring

__all__ = [
    "Bus",
    "Dex1Motors",
    "Dex1Process",
    "Firmware",
    "Heat",
    "Motor",
    "Wiring",
]
