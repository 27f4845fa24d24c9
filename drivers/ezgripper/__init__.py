"""Driver of SAKE's EZGripper (ROBOTIS MX-64 servo, Protocol 2.0) as a Dex1-1.

``EZGripper`` is the hand, ``backend`` what ``dexkit serve ezgripper`` opens. It uses
:mod:`servo` (one write and one read per exchange, laid out in :mod:`block`), :mod:`bus` (the
serial line) and :mod:`settings` (registers). A gripper has one :mod:`unit` or two;
:mod:`restart` stops it at a fault; :mod:`options` are its settings. :mod:`control`,
:mod:`contact`, :mod:`force`, :mod:`recovery`, :mod:`calibration` and :mod:`scaling` do no I/O.
:mod:`discovery` finds grippers, :mod:`config` stores their calibration, :mod:`bringup` finds how
they are wired.
"""

from dexkit.drivers.ezgripper.gripper import (
    Calibrate,
    EZGripper,
    GripperSettings,
    GripperStatistics,
    backend,
)

__all__ = ["Calibrate", "EZGripper", "GripperSettings", "GripperStatistics", "backend"]
