"""One joint and what it runs into: the body under every emulated hand.

A joint is an inertia with Coulomb and viscous friction, an optional spring, and walls: end
stops and objects, each a stiff spring with damping that can push but not pull. It is driven by
a torque and stepped in fixed steps, so the same torques always give the same motion.

Not modelled: backlash, tendon stretch as a separate state, link dynamics of under-actuated
fingers, gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dexkit.errors import UsageError

__all__ = ["Joint", "Wall"]


@dataclass(frozen=True)
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


@dataclass
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
