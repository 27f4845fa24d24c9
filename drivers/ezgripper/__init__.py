"""Driver of SAKE's EZGripper (ROBOTIS MX-64 servo, Protocol 2.0) as a Dex1-1.

``EZGripper`` is the hand, ``backend`` what ``dexkit serve ezgripper`` opens. Below it:
:mod:`servo` (one write and one read an exchange, laid out in :mod:`block`), :mod:`bus` (the
serial line), :mod:`settings` (registers); beside it the pure parts :mod:`control`,
:mod:`contact`, :mod:`force`, :mod:`recovery`, :mod:`calibration`, :mod:`scaling`; and
:mod:`discovery` and :mod:`config` for finding grippers and remembering them.
"""

from dexkit.drivers.ezgripper.gripper import (
    Calibrate,
    EZGripper,
    GripperSettings,
    GripperStatistics,
    backend,
)

__all__ = ["Calibrate", "EZGripper", "GripperSettings", "GripperStatistics", "backend"]
