"""``sim-twofinger``: the hand as simulated mechanics, without a device."""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.emulators.finger_mechanics import SETTINGS, STEP, FingerMechanics, MotorModel
from dexkit.emulators.simulated_hand import SimulatedHand, number
from dexkit.hand import Side
from twofinger_hand.profile import TWOFINGER_1

__all__ = ["SimTwoFinger", "sim_twofinger"]

_MOTOR = MotorModel(
    "two-finger motor",
    gear_ratio=108.0,
    dq_max=12.0,
    tau_max=1.4,
    tau_driving=1.4,
    tau_holding=1.4,
    inertia=1e-3,
    brake=0.2,
    coulomb=0.005,
    viscous=0.002,
)


class SimTwoFinger(SimulatedHand):
    """A simulated two-finger hand.

    :param object_at: percent of closing at which the fingers touch an object; None for none.
    :param start: percent of closing at ``open``; None for the resting pose.
    """

    def __init__(
        self, side: Side, *, object_at: float | None = None, start: float | None = None
    ) -> None:
        motors = [_MOTOR] * len(TWOFINGER_1.joints[side])
        self.mechanics = FingerMechanics(
            TWOFINGER_1, side, motors, object_at=object_at, start=start
        )
        spec = TWOFINGER_1.spec(side, io_rate=TWOFINGER_1.state_rate, simulated=True)
        super().__init__(spec, self.mechanics, STEP, None)


def _make(options: BackendOptions) -> SimTwoFinger:
    return SimTwoFinger(
        options.side, object_at=number(options, "object"), start=number(options, "start")
    )


sim_twofinger = Backend(
    summary="Simulated two-finger hand, no device",
    model=TWOFINGER_1.name,
    make=_make,
    settings=SETTINGS,
)
