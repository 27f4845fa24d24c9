"""An emulated ROBOTIS MX-64(2.0) with SAKE's EZGripper on its shaft.

From the inside out: :mod:`settings` (uncertain points and mechanics), :mod:`drive` (controllers and
physics), :mod:`servo` (control table and instructions), :mod:`bus` (several servos, line time,
faults) are sans-IO; :mod:`dexkit.emulators.serial_port` puts a bus on a pseudo-terminal;
:mod:`gripper` has the helper :func:`emulated_ezgripper` for tests.
"""

from dexkit.emulators.mx64.bus import Bus
from dexkit.emulators.mx64.gripper import EmulatedProcess, EmulatedThread, emulated_ezgripper
from dexkit.emulators.mx64.servo import Servo
from dexkit.emulators.mx64.settings import Firmware, GripperMechanics, Physics
from dexkit.emulators.mx64.wiring import Wiring
from dexkit.emulators.serial_port import Port

__all__ = [
    "Bus",
    "EmulatedProcess",
    "EmulatedThread",
    "Firmware",
    "GripperMechanics",
    "Physics",
    "Port",
    "Servo",
    "Wiring",
    "emulated_ezgripper",
]
