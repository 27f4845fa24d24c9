"""A service that behaves as Unitree's dex1_1_service: it guards nothing.

It meets every drop-in requirement of the Dex1-1's catalogue, and fails those safety requirements
that the original does not meet. Sources: docs/sources/unitree-dex.md#b2 for the service,
docs/sources/unitree-dex.md#g for the motor library, docs/sources/unitree-dex.md#h for what both do
with bad input.
"""

from __future__ import annotations

import math

from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.conformance.virtual.service import Sample
from dexkit.errors import WireError

__all__ = ["OriginalHand", "OriginalService"]

_GEAR = 25.0  # docs/sources/unitree-dex.md#g
_TURN = 2.0 * math.pi
_POSITION = 32768.0 / _TURN  # counts per radian of the rotor; docs/sources/unitree-dex.md#g
_VELOCITY = 256.0 / _TURN
_TORQUE = 2560.0  # counts per N m of the rotor
_GAIN = 12800.0  # counts per unit of kp and kd of the rotor
_TORQUE_MAX = 15.0  # N m; the library clamps the feed-forward to 0..15
_DOES_NOT_FIT = -(2**31)


def _counts(value: float, bits: int) -> int:
    """A number as the library puts it into a field: cut off, and wrapped if the field is smaller.

    :param bits: 32, or 16 for an unsigned field.
    """
    fits = math.isfinite(value) and abs(value) < 2**31
    whole = int(value) if fits else _DOES_NOT_FIT
    return whole if bits == 32 else whole % 2**16


def _signed(count: int) -> int:
    """A 16 bit count as the motor reads it."""
    return count - 2**16 if count >= 2**15 else count


def _as_sent(motor: Motor) -> Motor:
    """The command that reaches the motor, at the joint: in counts of the rotor, with no check."""
    square = _GEAR * _GEAR
    # a comparison with NaN is false, so that NaN passes the library's clamp
    tau = motor.tau / _GEAR
    tau = 0.0 if tau < 0.0 else _TORQUE_MAX if tau > _TORQUE_MAX else tau
    return Motor(
        q=_counts(motor.q * _GEAR * _POSITION, 32) / _POSITION / _GEAR,
        dq=_signed(_counts(motor.dq * _GEAR * _VELOCITY, 16)) / _VELOCITY / _GEAR,
        tau=_signed(_counts(tau * _TORQUE, 16)) / _TORQUE * _GEAR,
        kp=_counts(motor.kp / square * _GAIN, 16) / _GAIN * square,
        kd=_counts(motor.kd / square * _GAIN, 16) / _GAIN * square,
    )


class OriginalHand(ReferenceHand):
    """A Dex1-1 behind the vendor's motor library: every command is put in force as it is.

    Its stop is at the calibrated 5.62 rad (docs/sources/unitree-dex.md#b2), not at the 5.4 rad that
    clients use.
    """

    tau_max = _TORQUE_MAX
    stiffness = 375.0  # N m/rad: with all of its torque it is 0.04 rad past its stop, as measured
    dq_max = 24.0  # rad/s, where no torque is left; docs/sources/unitree-dex.md#b3, derived
    substeps = 6  # of a step, for the stiffer stops

    def __init__(self, stroke: float, touch: float | None = None) -> None:
        super().__init__(stroke, touch)
        self.stroke = math.radians(322.0)

    def command(self, motor: Motor) -> None:
        """Put a command in force, whatever is in it."""
        self.goal = _as_sent(motor)
        self.heard = self.now

    def repeat(self) -> None:
        """An empty command: the time-out starts again, and the motor's data are the last ones."""
        self.heard = self.now

    def motor_torque(self) -> float:
        """The motor's torque, N m; the faster it turns, the less it can push on."""
        tau = super().motor_torque()
        if tau * self.dq <= 0.0:
            return tau
        most = self.tau_max * max(0.0, 1.0 - abs(self.dq) / self.dq_max)
        return min(max(tau, -most), most)

    def step(self, dt: float) -> None:
        """Advance by one step."""
        for _ in range(self.substeps):
            super().step(dt / self.substeps)

    def fields(self) -> dict[str, float]:
        """The fields that the vendor's service fills: q, dq and tau_est."""
        return {"q": self.q, "dq": self.dq, "tau_est": self.tau}


class OriginalService(ReferenceService):
    """Grippers on their topics, as dex1_1_service serves them."""

    hand = OriginalHand
    exit_s = 0.01  # it handles no signal
    gone_s = None  # and deletes no writer: it stays announced until its lease has run out

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        """Take a command message; an empty one has the values of the last one, which are still in
        memory.
        """
        super().receive(topic, payload, client)
        for side in self.sides:
            if self.codec.command_topics[side] != topic:
                continue
            try:
                motors = self.codec.read_command(payload, side)
            except WireError:
                continue
            hand = self.hands[side]
            if motors is None and isinstance(hand, OriginalHand):
                hand.repeat()

    def fields(self, side: object) -> dict[str, object]:
        """The state of a side's motor, by member; the others stay 0."""
        return dict(self.hands[side].fields())  # type: ignore[index]

    def end(self) -> list[Sample]:
        """End at once: no brake, and no last state."""
        return []
