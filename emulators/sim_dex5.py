"""``sim-dex5``: a simulated Dex5-1, 20 joints that move independently, without device or bus.

:mod:`dexkit.emulators.finger_mechanics` has the mechanics. From Unitree's URDF: the joints' limits,
speeds and torques, some of which look like placeholders (docs/sources/unitree-dex.md#b5). Inertia,
friction, brake and heat are assumed, such that the joints follow xr_teleoperate's gains without
oscillation.

Not modelled: that 16 motors move the 20 joints; pressure sensors, IMU and supply, of which no
source says what a Dex5-1 publishes.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.finger_mechanics import SETTINGS, STEP, FingerMechanics, MotorModel
from dexkit.emulators.simulated_hand import COMMON_SETTINGS, SimulatedHand, configured, number
from dexkit.hand import JointSpec, Side
from dexkit.models import DEX5_1

__all__ = ["Dex5Mechanics", "SimDex5", "sim_dex5"]


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
            if joint.finger == "thumb"
            else _motor(joint, inertia=1e-5, brake=0.04, coulomb=0.0005)
            for joint in DEX5_1.joints[side]
        ]
        super().__init__(DEX5_1, side, motors, object_at=object_at, start=start)


class SimDex5(SimulatedHand):
    """A simulated Dex5-1.

    :param side: which hand.
    :param object_at: how far the fingers close until they touch an object, percent; None for no
        object.
    :param start: how far they are closed at ``open``, percent; None for a relaxed pose.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_at: float | None = None,
        start: float | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.mechanics = Dex5Mechanics(side, object_at=object_at, start=start)
        spec = DEX5_1.spec(side, io_rate=DEX5_1.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, clock)


def _make(options: BackendOptions) -> SimDex5:
    hand = SimDex5(
        options.side, object_at=number(options, "object"), start=number(options, "start")
    )
    return configured(hand, options)


sim_dex5 = Backend(
    summary="Simulated Dex5-1 hand: 20 joints, mechanics and heat, no device",
    model=DEX5_1.name,
    make=_make,
    settings={**SETTINGS, **COMMON_SETTINGS},
)
