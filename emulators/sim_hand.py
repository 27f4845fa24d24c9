"""``sim-dex1``: a Dex1-1 gripper that is only mechanics, with no device or wire under it.

The motor obeys ``tau = kp (q_des - q) + kd (dq_des - dq) + tau_ff`` as Unitree's motors do,
within its torque and speed limits, and brakes (shorted windings) in mode BRAKE. The command in
force stays in force until the next one, as in the real motor.

Inertia and friction are tuned, not measured: with the genuine xr_teleoperate rule (0.18 rad lead,
kp 5, kd 0.05, 500 Hz state) the gripper makes 6.5 rad/s and 10 to 90 % of the stroke in 0.68 s,
and blocked by an object feels -0.9 N·m, as in the recordings. It says nothing about temperature,
voltage or noise of the product; those stay NaN.
"""

from __future__ import annotations

import math

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.emulators.mechanics import FixedSteps, Joint, Wall
from dexkit.errors import HandLost, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, JointMode, Side
from dexkit.models import DEX1_1

__all__ = ["SimHand", "sim_dex1"]

STEP = 0.5e-3
"""Integration step, seconds."""
_MOST_CATCH_UP = 0.5  # seconds; a longer pause of the caller is not lived through
_HARD_STOP = math.radians(322)  # the vendor's calibrated stroke, beyond the 5.4 rad of clients
_INERTIA = 0.002
_COULOMB = 0.08
_VISCOUS = 0.041
_BRAKE_DAMPING = 1.0
_STOP_STIFFNESS, _STOP_DAMPING = 200.0, 1.0
_OBJECT_STIFFNESS, _OBJECT_DAMPING = 60.0, 0.5
_STIFF = 0.2  # beyond this part of a step, gains are applied implicitly


class SimHand:
    """A simulated Dex1-1.

    :param side: which hand.
    :param object_pct: opening at which the jaws touch an object, percent of 5.4 rad; None for
        no object.
    :param start_pct: opening at ``open``. Not 0 by default: some clients wait for a position
        that is not exactly zero.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a percentage is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_pct: float | None = None,
        start_pct: float = 20.0,
        clock: Clock | None = None,
    ) -> None:
        if object_pct is not None and not 0 < object_pct < 100:
            raise UsageError(f"an object is touched between 0 and 100 % open, not {object_pct}")
        if not 0 <= start_pct <= 100:
            raise UsageError(f"start is a percentage of opening, not {start_pct}")
        self._spec = DEX1_1.spec(side, io_rate=1000.0, exchange_timeout=0.1, simulated=True)
        self._limits = self._spec.joints[0]
        self._clock: Clock = clock or RealClock()
        walls = [
            Wall(0.0, +1, _STOP_STIFFNESS, _STOP_DAMPING),
            Wall(_HARD_STOP, -1, _STOP_STIFFNESS, _STOP_DAMPING),
        ]
        if object_pct is not None:
            at = self._limits.stroke * object_pct / 100
            walls.append(Wall(at, +1, _OBJECT_STIFFNESS, _OBJECT_DAMPING))
        self.joint = Joint(
            inertia=_INERTIA,
            coulomb=_COULOMB,
            viscous=_VISCOUS,
            walls=tuple(walls),
            q=self._limits.q_min + self._limits.stroke * start_pct / 100,
        )
        self._open = False
        self._torque = 0.0
        self._use(HandCommand.brake(1))
        self._steps = FixedSteps(STEP, most=_MOST_CATCH_UP)

    @property
    def spec(self) -> HandSpec:
        """What this hand is."""
        return self._spec

    def open(self) -> None:
        """Start to live; brakes until the first command."""
        self._use(HandCommand.brake(1))
        self._steps.restart(self._clock.now())
        self._open = True

    def close(self) -> None:
        """Stop where it is."""
        self._open = False
        self.joint.dq = 0.0

    def exchange(self, command: HandCommand) -> HandState:
        """Live up to now under the command before, take this one, and say where the jaws are.

        :raises HandLost: the hand is not open.
        """
        if not self._open:
            raise HandLost("the simulated hand is not open")
        now = self._clock.now()
        self._live(now)
        self._use(command)
        return HandState.of(
            self.joint.q,
            dq=self.joint.dq,
            tau_est=self._torque,
            mode=self._mode,
            stamp=now,
        )

    def _use(self, command: HandCommand) -> None:
        self._mode = JointMode.FOC if command.mode[0] else JointMode.BRAKE
        if self._mode is JointMode.BRAKE:
            self._q = self._dq = self._tau = self._kp = 0.0
            self._kd = _BRAKE_DAMPING
        else:
            self._q, self._dq = float(command.q[0]), float(command.dq[0])
            self._tau = float(command.tau[0])
            self._kp, self._kd = float(command.kp[0]), float(command.kd[0])

    def _live(self, now: float) -> None:
        for _ in range(self._steps.due(now)):
            self._torque = self._motor()
            self.joint.step(self._torque, STEP)

    def _motor(self) -> float:
        """Torque of the motor, N·m."""
        joint = self.joint
        stiffness, damping = self._kp, self._kd
        torque = stiffness * (self._q - joint.q) + damping * (self._dq - joint.dq) + self._tau
        implicit = (STEP * damping + STEP * STEP * stiffness) / _INERTIA
        if implicit > _STIFF:
            # gains too stiff for the step: what they would give at its end keeps it stable
            torque = (torque - stiffness * STEP * joint.dq) / (1.0 + implicit)
        most = self._limits.tau_max
        if torque * joint.dq > 0.0:
            # the faster it turns, the less it can push on: nothing is left at the top speed
            most *= max(0.0, 1.0 - abs(joint.dq) / self._limits.dq_max)
        return max(-most, min(most, torque))


def _percent(options: BackendOptions, key: str) -> float | None:
    text = options.settings.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{key}={text} is not a percentage") from None


def _make(options: BackendOptions) -> SimHand:
    start = _percent(options, "start")
    return SimHand(
        options.side,
        object_pct=_percent(options, "object"),
        start_pct=20.0 if start is None else start,
    )


sim_dex1 = Backend(
    summary="Simulated Dex1-1 gripper: mechanics only, no device",
    model=DEX1_1.name,
    make=_make,
    settings={
        "object": "percent of opening at which an object is touched (default: no object)",
        "start": "percent of opening at first (default: 20)",
    },
)
