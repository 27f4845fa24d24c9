"""Simulate one joint with its stops and objects; all emulated hands use it.

A joint is an inertia with Coulomb and viscous friction, an optional spring, and walls: end
stops and objects, each a stiff spring with damping that can push but not pull. It is driven by
a torque (:meth:`Joint.step`) or by a motor with a feedback law (:meth:`Joint.drive`), in fixed
steps (:class:`FixedSteps`), so the same commands always give the same motion.

Not modelled: backlash, tendon stretch as a separate state, link dynamics of under-actuated
fingers, gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dexkit.errors import UsageError

__all__ = ["FixedSteps", "Joint", "Wall", "check_closing"]

_STILL = 1e-9  # rad/s; a slower joint rests


class FixedSteps:
    """How many fixed steps of mechanics are due to catch up with a clock.

    :param step: seconds.
    :param most: longest pause that is simulated, seconds; time before that is skipped.
    """

    def __init__(self, step: float, *, most: float = 0.5) -> None:
        self.step = step
        self.done = 0
        self._most = int(most / step)
        self._origin = 0.0

    def restart(self, now: float) -> None:
        """Count from ``now``."""
        self._origin = now
        self.done = 0

    def due(self, now: float) -> int:
        """Return the number of steps up to ``now`` and count them as done."""
        total = int((now - self._origin) / self.step + 1e-6)
        steps = min(total - self.done, self._most)
        if steps <= 0:
            return 0
        self.done = total
        return steps


@dataclass(frozen=True, slots=True)
class Wall:
    """A one-sided stop.

    :param q: where it begins, rad.
    :param push: +1 if it pushes the joint toward larger q (a lower stop, or an object between
        fingers that close toward smaller q), -1 if toward smaller q.
    :param stiffness: N·m/rad.
    :param damping: N·m·s/rad.
    """

    q: float
    push: int
    stiffness: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        if self.push not in (-1, 1):
            raise UsageError(f"push must be -1 or +1, not {self.push}")
        if self.stiffness <= 0 or self.damping < 0:
            raise UsageError("a wall needs a positive stiffness and no negative damping")


@dataclass(slots=True)
class Joint:
    """State and parameters of one joint; SI units.

    :param inertia: kg·m².
    :param coulomb: friction torque that must be overcome to move, and that opposes motion, N·m.
    :param viscous: N·m·s/rad.
    :param spring: stiffness of a spring between joint and frame, N·m/rad.
    :param spring_rest: where that spring is relaxed, rad.
    :param locked: jammed: no torque moves it.

    :ivar contact: torque of the walls on the joint in the last step, N·m.
    """

    inertia: float
    coulomb: float = 0.0
    viscous: float = 0.0
    walls: tuple[Wall, ...] = ()
    q: float = 0.0
    dq: float = 0.0
    spring: float = 0.0
    spring_rest: float = 0.0
    locked: bool = False
    contact: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if self.inertia <= 0:
            raise UsageError(f"inertia must be positive, not {self.inertia}")

    def step(self, torque: float, dt: float, friction: float = 0.0) -> None:
        """Advance by ``dt`` seconds under a motor torque.

        :param friction: Coulomb friction on top of :attr:`coulomb`, for losses that grow with
            the load, N·m.

        Semi-implicit Euler: damping and friction are taken at the end of the step, which keeps
        stiff walls stable and lets friction stop the joint exactly.
        """
        q = self.q
        velocity = self.dq
        damping = self.viscous
        contact = 0.0
        for wall in self.walls:
            depth = (wall.q - q) * wall.push
            if depth > 0.0:
                force = wall.stiffness * depth
                contact += wall.push * force
                # out of the wall, damping takes from its push but never pulls
                if wall.damping * velocity * wall.push < force:
                    damping += wall.damping
        self.contact = contact
        if self.locked:
            self.dq = 0.0
            return
        force = torque + contact - self.spring * (q - self.spring_rest)
        gain = dt / self.inertia
        velocity += gain * force
        stick = gain * (self.coulomb + friction)
        if velocity > stick:
            velocity -= stick
        elif velocity < -stick:
            velocity += stick
        else:
            velocity = 0.0
        velocity /= 1.0 + gain * damping
        self.dq = velocity
        self.q = q + dt * velocity

    def drive(
        self,
        torque: float,
        damping: float,
        most: float,
        most_along: float,
        dt: float,
        driving_loss: float = 0.0,
        holding_loss: float = 0.0,
    ) -> float:
        """Advance by ``dt`` seconds under a motor whose torque falls with speed.

        The motor gives ``torque - damping * dq`` with dq at the end of the step: however stiff
        its gains are, they stay stable, and blocked it gives exactly ``torque``. Walls are taken
        in the same way.

        :param torque: what it gives at standstill, N·m.
        :param damping: N·m·s/rad; for a position gain kp, kp * dt belongs to it.
        :param most: its largest torque, N·m.
        :param most_along: its largest torque in the direction in which it already turns.
        :param driving_loss: part of its torque that gearing takes while it drives the joint.
        :param holding_loss: part of its torque that gearing adds while the joint turns against
            it. At rest the joint is held for loads between the two.
        :returns: torque of the motor at the end of the step, before the gearing's losses.
        """
        q = self.q
        velocity = self.dq
        high = most_along if velocity > 0.0 else most
        low = -most_along if velocity < 0.0 else -most
        if self.locked:
            self.dq = 0.0
            return min(max(torque, low), high)
        resist = self.viscous
        contact = 0.0
        for wall in self.walls:
            depth = (wall.q - q) * wall.push
            if depth > 0.0:
                force = wall.stiffness * depth
                contact += wall.push * force
                resist += wall.stiffness * dt
                if wall.damping * velocity * wall.push < force:
                    resist += wall.damping
        self.contact = contact
        rate = dt / self.inertia
        load = contact - self.spring * (q - self.spring_rest)
        now = torque - damping * velocity
        now = low if now < low else high if now > high else now
        free = velocity + rate * (torque + load)
        slow = 1.0 + rate * (resist + damping)
        end = torque - damping * free / slow
        if not low <= end <= high:
            # saturated: the torque is at its limit and has no damping
            torque = low if end < low else high
            damping = 0.0
            free = velocity + rate * (torque + load)
            slow = 1.0 + rate * resist
        along = now * (velocity if velocity != 0.0 else free) > 0.0
        stick = rate * (self.coulomb + (driving_loss if along else holding_loss) * abs(now))
        if free > stick:
            velocity = (free - stick) / slow
        elif free < -stick:
            velocity = (free + stick) / slow
        else:
            velocity = 0.0
        if -_STILL < velocity < _STILL:
            velocity = 0.0  # rounding must not leave a residual speed
        self.dq = velocity
        self.q = q + dt * velocity
        end = torque - damping * velocity
        return low if end < low else high if end > high else end


def check_closing(object_at: float | None, start: float | None) -> None:
    """Check where a hand touches its object, and where it starts, in percent of closing.

    :raises UsageError: a value is out of range, or the hand would start inside the object.
    """
    if object_at is not None and not 0.0 < object_at < 100.0:
        raise UsageError(f"an object is touched between 0 and 100 % closed, not {object_at}")
    if start is not None and not 0.0 <= start <= 100.0:
        raise UsageError(f"start is a percentage of closing, not {start}")
    if start is not None and object_at is not None and start > object_at:
        raise UsageError(
            f"the hand would start inside the object: start {start:g} %, object {object_at:g} %"
        )
