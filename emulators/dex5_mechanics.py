"""The mechanics of a Dex5-1: 20 joints, each moved alone.

:mod:`dexkit.emulators.finger_mechanics` has the mechanics. From Unitree's URDF: the joints' limits,
speeds and torques, which look like place-holders in part (docs/sources/unitree-dex.md#b5). The rest
is assumed, so that the joints follow xr_teleoperate's gains without swinging: inertia, friction,
brake, heat.

Not modelled: that 16 motors move the 20 joints, pressure sensors, IMU and supply, of which no
source says what a Dex5-1 publishes.
"""

from __future__ import annotations

from dexkit.emulators.finger_mechanics import FingerMechanics, MotorModel
from dexkit.hand import JointSpec, Side
from dexkit.models import DEX5_1

__all__ = ["Dex5Mechanics"]


def _motor(spec: JointSpec, *, inertia: float, brake: float, coulomb: float) -> MotorModel:
    return MotorModel(
        f"Dex5-1 {spec.name}",
        gear_ratio=spec.gear_ratio,
        dq_max=spec.dq_max,
        tau_max=spec.tau_max,
        # nothing is known of losses in the gearing that grow with the load
        tau_driving=spec.tau_max,
        tau_holding=spec.tau_max,
        inertia=inertia,
        brake=brake,
        coulomb=coulomb,
        viscous=0.1 * brake,
    )


class Dex5Mechanics(FingerMechanics):
    """A Dex5-1 hand without its electronics.

    :param object_at: how far the flexing joints close before they touch an object; see
        :class:`~dexkit.emulators.finger_mechanics.FingerMechanics`.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self, side: Side, *, object_at: float | None = None, start: float | None = None
    ) -> None:
        motors = [
            # the thumb has ten times the fingers' gains, and so its motors' size
            _motor(joint, inertia=5e-5, brake=0.2, coulomb=0.005)
            if i in DEX5_1.joint_gains
            else _motor(joint, inertia=1e-5, brake=0.04, coulomb=0.0005)
            for i, joint in enumerate(DEX5_1.joints[side])
        ]
        super().__init__(DEX5_1, side, motors, object_at=object_at, start=start)
