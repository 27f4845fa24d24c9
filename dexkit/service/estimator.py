"""Predict joint positions between the measurements of a slow link.

Unitree's clients steer by the newest reported position: xr_teleoperate clips each command to
0.18 rad from it, so a gripper that reports at 5 Hz is driven at a crawl
(docs/sources/mx64-ezgripper.md#d7). Where the link is slower than that, the service publishes what
a velocity-limited model predicts and lets the measurements correct the model.

The model and its thresholds are those of docs/sources/mx64-ezgripper.md#d8. In that model a
measurement behind the prediction pulls the prediction back. Here the two are kept apart. The
*model* runs to the command at the calibrated speed, each measurement moves it by 10 % of the
difference, and a difference above 10 % of the stroke puts it on the measurement. The *prediction*
that is published follows the model, and these hold of it, between two resynchronisations, for one
standing command:

V  it never moves faster than the calibrated speed of the direction in which it moves;
O  it never passes the command in the direction in which it came to it, not even when the hand
   does (docs/sources/mx64-ezgripper.md#d8-1);
R  travelling, it never moves away from the command: it waits until the model has caught up.

A resynchronisation (difference above the threshold) is the one jump, onto what was measured:
the truth outranks smoothness. If the hand was not moving, the joint counts as *stalled*:
nothing is predicted in that direction until the hand is seen to move or the command turns
round, so a gripper that holds an object is not reported to creep through it.

Travelling ends when the model arrives. From then on the velocity model has nothing to add, and
the prediction follows the measurements alone, up to the command (the model of the source would
return to the command after each correction and so report an arrival that never happened).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dexkit.errors import UsageError
from dexkit.hand import Floats, HandCommand, HandSpec, HandState, JointSpec

__all__ = ["CORRECTION", "STALL_THRESHOLD", "JointEstimator", "StateEstimator"]

STALL_THRESHOLD = 0.1  # of the stroke (docs/sources/mx64-ezgripper.md#d8-2)
CORRECTION = 0.1  # of the difference, per measurement (docs/sources/mx64-ezgripper.md#d8-2)
_MOVING = 0.005  # of the stroke between two measurements: the hand moves, it is not stuck


class JointEstimator:
    """The prediction for one joint. Times in seconds, positions in rad.

    :param joint: its limits; the stroke is the unit of the thresholds.
    :param speed: calibrated speeds toward larger and toward smaller q, rad/s.
    :raises UsageError: a speed is not positive.
    """

    def __init__(self, joint: JointSpec, speed: tuple[float, float] | None = None) -> None:
        up, down = speed if speed is not None else (joint.dq_max, joint.dq_max)
        if not (0 < up < math.inf and 0 < down < math.inf):
            raise UsageError(f"joint {joint.name}: speeds must be positive, got {up} and {down}")
        self._joint = joint
        self._speed = {1: up, -1: down}
        self._threshold = STALL_THRESHOLD * joint.stroke
        self._moving = _MOVING * joint.stroke
        self._target: float | None = None
        self._heading = 0  # of the last travel; 0 without one
        self._travelling = False
        self._blocked = 0  # direction in which the joint is stalled
        self._measured = math.nan
        self._model = math.nan
        self._time = -math.inf
        self.q = math.nan  #: the prediction, rad; NaN before the first measurement
        self.dq = 0.0  #: its velocity over the last step, rad/s
        self.resyncs = 0  #: measurements that were more than the threshold away

    @property
    def travelling(self) -> bool:
        """Whether the model is on its way to the command."""
        return self._travelling

    @property
    def blocked(self) -> int:
        """Direction in which the joint is stalled, +1 or -1; 0 where it is not."""
        return self._blocked

    @property
    def stalled(self) -> bool:
        """Whether the joint was found stuck on its way to the command."""
        return self._blocked != 0

    def follow(self, target: float | None, now: float) -> None:
        """Take a command; None stands for brake or zero stiffness, which move nothing."""
        self.predict(now)
        if target is not None:
            target = min(max(target, self._joint.q_min), self._joint.q_max)
        if target == self._target:
            return
        self._target = target
        self._choose_direction()

    def predict(self, now: float) -> float:
        """Advance to ``now`` and return the prediction, rad."""
        dt = now - self._time
        if dt <= 0 or math.isnan(self.q):
            return self.q
        self._time = now
        before = self.q
        if self._travelling:
            assert self._target is not None
            self._model = self._step_toward(self._model, self._target, dt)
            if self._model == self._target:
                self._travelling = False
        ahead = (self._model - self.q) * self._heading
        if not (self._travelling and ahead < 0):  # R: wait rather than reverse
            self.q = self._step_toward(self.q, self._model, dt)
        self.dq = (self.q - before) / dt
        return self.q

    def measure(self, q: float, now: float) -> None:
        """Take a measurement."""
        self.predict(now)
        previous, self._measured = self._measured, q
        if math.isnan(self.q):
            self.q = self._model = q
            self._time = now
            self._choose_direction()
            return
        if self._blocked:
            if (q - previous) * self._blocked > self._moving:
                self._blocked = 0
            self._resync(q)
        elif self._target is None:
            self._model = q
        elif abs(q - self._model) > self._threshold:
            self.resyncs += 1
            direction = _sign(self._target - q)
            behind = (q - self._model) * direction < 0
            if behind and not (q - previous) * direction > self._moving:
                self._blocked = direction
            self._resync(q)
        else:
            self._model += CORRECTION * (q - self._model)
            if (self._model - self._target) * self._heading > 0:  # O
                self._model = self._target
                self._travelling = False

    def _resync(self, q: float) -> None:
        self.q = self._model = q
        self._choose_direction()

    def _choose_direction(self) -> None:
        """Decide whether, and which way, the model travels to the target."""
        self._travelling = False
        self._heading = 0
        if self._target is None:
            self._blocked = 0
            return
        if math.isnan(self.q):
            return
        direction = _sign(self._target - self._model)
        if self._blocked and _sign(self._target - self._measured) != self._blocked:
            self._blocked = 0
        if direction and direction != self._blocked:
            self._heading = direction
            self._travelling = True

    def _step_toward(self, q: float, goal: float, dt: float) -> float:
        distance = goal - q
        step = self._speed[_sign(distance) or 1] * dt
        return goal if abs(distance) <= step else q + math.copysign(step, distance)


class StateEstimator:
    """The prediction for a whole hand.

    :param spec: of the hand.
    :param speeds: per joint, speeds toward larger and toward smaller q, rad/s; without it each
        joint's ``dq_max`` both ways.
    :param stall_tau: magnitude of tau_est of a joint that is stalled, N·m, where less was
        measured; 0 leaves what was measured.
    """

    def __init__(
        self,
        spec: HandSpec,
        speeds: Sequence[tuple[float, float]] | None = None,
        *,
        stall_tau: float = 0.0,
    ) -> None:
        if speeds is not None and len(speeds) != spec.n_joints:
            raise UsageError(f"{len(speeds)} pairs of speeds for {spec.n_joints} joint(s)")
        self.joints = [
            JointEstimator(joint, speeds[i] if speeds is not None else None)
            for i, joint in enumerate(spec.joints)
        ]
        self._stall_tau = stall_tau
        self._last: HandState | None = None

    @property
    def stalled(self) -> bool:
        """Whether any joint is stalled."""
        return any(joint.stalled for joint in self.joints)

    @property
    def resyncs(self) -> int:
        """Jumps onto a measurement, over all joints."""
        return sum(joint.resyncs for joint in self.joints)

    def follow(self, command: HandCommand, now: float) -> None:
        """Take the command that the hand is given."""
        for i, joint in enumerate(self.joints):
            moves = command.mode[i] != 0 and command.kp[i] > 0
            joint.follow(float(command.q[i]) if moves else None, now)

    def measure(self, state: HandState, now: float) -> None:
        """Take a measured state."""
        self._last = state
        for i, joint in enumerate(self.joints):
            joint.measure(float(state.q[i]), now)

    def predict(self, now: float) -> HandState | None:
        """The state at ``now``: q and dq predicted, all else as last measured; None before
        the first measurement.
        """
        last = self._last
        if last is None:
            return None
        q = np.array([joint.predict(now) for joint in self.joints])
        dq = np.array([joint.dq for joint in self.joints])
        return replace(last, q=q, dq=dq, tau_est=self._torques(last.tau_est), measured=False)

    def _torques(self, measured: Floats) -> Floats:
        """Those measured, and of stalled joints at least ``stall_tau`` toward their goal."""
        if not self._stall_tau or not self.stalled:
            return measured
        blocked = np.array([joint.blocked for joint in self.joints])
        least = blocked * self._stall_tau
        return np.where(np.abs(np.nan_to_num(measured)) < np.abs(least), least, measured)


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
