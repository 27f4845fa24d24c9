"""The servo's drive: profile, controllers, motor, gripper, heat and supply, in 1 ms periods.

Everything here is in the motor's own direction (Drive Mode's reverse bit is undone by the
servo), positions in ticks of the *multi-turn* counter as floats, SI units elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dexkit.emulators.joint_mechanics import Joint, Wall
from dexkit.emulators.mx64.settings import Physics
from dexkit.wire import mx64
from dexkit.wire.mx64 import MovingStatus, OperatingMode

__all__ = ["PERIOD", "Demand", "Drive", "Profile"]

PERIOD = 1e-3
"""Control period and integration step, seconds."""
SLOW = 10
"""Heat and supply are stepped once in so many periods."""

_STILL = 1e-6  # rad/s
_TICK = mx64.TICK
# plain integers: an enum's attribute look-up costs more than the sum it guards
_CURRENT, _VELOCITY = int(OperatingMode.CURRENT), int(OperatingMode.VELOCITY)
_PWM, _CURRENT_BASED_POSITION = (
    int(OperatingMode.PWM),
    int(OperatingMode.CURRENT_BASED_POSITION),
)
_DUTY = 1.0 / mx64.PWM_MAX
_VELOCITY_TICKS = mx64.VELOCITY_UNIT / mx64.TICK  # ticks/s of one velocity unit
_ACCELERATION_TICKS = mx64.ACCELERATION_UNIT / mx64.TICK  # ticks/s² of one acceleration unit


@dataclass
class Demand:
    """Setpoints and gains from the registers, updated when they change; register units."""

    torque: bool = False
    mode: int = int(OperatingMode.POSITION)
    pwm: int = mx64.PWM_MAX
    current: int = 1941
    velocity: int = 0
    position_p: int = 850
    position_i: int = 0
    position_d: int = 0
    feedforward_1: int = 0
    feedforward_2: int = 0
    velocity_p: int = 100
    velocity_i: int = 1920
    stopped: bool = False  # the bus watchdog has tripped


class Profile:
    """Trajectory from where it is to a goal: step, rectangle, trapezoid or triangle
    (docs/sources/mx64-ezgripper.md#b5).

    A new goal while moving keeps position and velocity continuous.

    :ivar position: ticks.
    :ivar velocity: ticks/s.
    :ivar acceleration: ticks/s² in the last period.
    """

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0
        self.goal = 0.0
        self.running = False
        self.shape = MovingStatus.NONE
        self._speed = 0.0
        self._ramp = math.inf

    def hold(self, position: float) -> None:
        """Stand at ``position``."""
        self.position = self.goal = position
        self.velocity = self.acceleration = 0.0
        self.running = False
        self.shape = MovingStatus.NONE

    def start(self, goal: float, velocity: int, acceleration: int, *, timed: bool = False) -> None:
        """Head for ``goal`` with the register values of Profile Velocity and Acceleration.

        :param timed: they are the times of the whole motion and of its ramp, in ms.
        """
        self.goal = goal
        distance = abs(goal - self.position)
        if velocity <= 0:
            self.hold(goal)
            return
        if timed:
            total = velocity * 1e-3
            ramp_time = min(acceleration * 1e-3, total / 2)
            speed = distance / (total - ramp_time)
            ramp = speed / ramp_time if ramp_time > 0 else math.inf
        else:
            speed = velocity * _VELOCITY_TICKS
            ramp = acceleration * _ACCELERATION_TICKS if acceleration > 0 else math.inf
        if distance == 0.0 and self.velocity == 0.0:
            self.hold(goal)
            return
        self._speed = max(speed, 1e-6)
        self._ramp = ramp
        self.running = True
        if math.isinf(ramp):
            self.shape = MovingStatus.PROFILE_RECTANGLE
        elif speed * speed / ramp > distance:
            self.shape = MovingStatus.PROFILE_TRIANGLE
        else:
            self.shape = MovingStatus.PROFILE_TRAPEZOID

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        if not self.running:
            self.acceleration = 0.0
            return
        remaining = self.goal - self.position
        ramp = self._ramp
        before = self.velocity
        if math.isinf(ramp):
            wanted = math.copysign(self._speed, remaining)
            change = wanted - before
        else:
            # the fastest from which it can still stop at the goal, counted at the period's end
            reach = math.sqrt(2.0 * ramp * abs(remaining) + (ramp * dt / 2) ** 2) - ramp * dt / 2
            wanted = math.copysign(min(self._speed, reach), remaining)
            change = max(-ramp * dt, min(ramp * dt, wanted - before))
        velocity = before + change
        move = velocity * dt
        slow = math.isinf(ramp) or abs(velocity) <= ramp * dt * 1.5
        if slow and abs(remaining) <= max(abs(move), 1e-3):
            self.hold(self.goal)
            return
        self.velocity = velocity
        self.acceleration = change / dt
        self.position += move


class Drive:
    """Motor, controllers and gripper of one servo.

    :ivar counter: multi-turn encoder value that reads as zero, ticks (folding changes it).
    :ivar current: A, positive drives toward larger positions.
    :ivar duty: part of the supply on the motor, -1 to 1.
    :ivar temperature: °C.
    :ivar voltage: V at the servo's terminals.
    :ivar supply: V of the source; a brown-out lowers it.
    """

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        mechanics = physics.gripper
        opens = -1 if mechanics.mirrored else 1
        stroke = self._stroke = opens * mechanics.stroke * _TICK
        walls = []
        if not mechanics.bare:
            walls = [
                Wall(0.0, opens, mechanics.closed_stiffness, 0.6),
                Wall(stroke, -opens, mechanics.open_stiffness, 1.0),
            ]
        if mechanics.object_pct is not None:
            walls.append(
                Wall(stroke * mechanics.object_pct / 100, opens, mechanics.object_stiffness, 1.0)
            )
        self.joint = Joint(
            inertia=physics.inertia + mechanics.inertia,
            coulomb=physics.coulomb + mechanics.coulomb,
            viscous=physics.viscous + mechanics.viscous,
            walls=tuple(walls),
            q=stroke * mechanics.start / 100,
            spring=mechanics.spring,
            spring_rest=stroke * 1.2,
        )
        self.demand = Demand()
        self.profile = Profile()
        self.current = 0.0
        self.duty = 0.0
        self.supply = physics.supply_voltage
        self.voltage = physics.supply_voltage
        # initial temperature: heated by its own electronics
        self.temperature = physics.ambient + self._temperature_rise(physics.idle_power)
        self._integral = 0.0
        self._last_error = 0.0
        self._ramped = 0.0  # velocity trajectory of mode 1, ticks/s
        self._heat = 0.0  # J since the last slow step
        self._phase = 0
        self._still = 0  # periods
        self.counter = 0
        self.fold()

    # --- encoder

    def _temperature_rise(self, power: float) -> float:
        return power * self.physics.cooling_time / self.physics.heat_capacity

    @property
    def encoder(self) -> float:
        """Shaft angle, ticks, not folded; 0 at the encoder's zero of turn 0."""
        return self.joint.q / _TICK + self.physics.gripper.closed_at

    def fold(self, *, reverse: bool = False) -> None:
        """Forget whole turns: the position becomes 0 to 4095 (0 to -4095 if ``reverse``)."""
        turns = self.encoder / mx64.TICKS_PER_TURN
        whole = math.ceil(turns) if reverse else math.floor(turns)
        self.counter = whole * mx64.TICKS_PER_TURN

    @property
    def position(self) -> int:
        """Multi-turn position, ticks."""
        return math.floor(self.encoder) - self.counter

    @property
    def velocity(self) -> float:
        """Shaft speed, rad/s."""
        return self.joint.dq

    @property
    def opening(self) -> float:
        """Percent of the stroke: 0 closed, 100 open; a little beyond where the stops give."""
        return 100.0 * self.joint.q / self._stroke

    # --- control

    def reset_control(self) -> None:
        """Clear integrators and stand still: at torque on or off and on a change of mode."""
        self._integral = 0.0
        self._last_error = 0.0
        self._ramped = 0.0
        self.profile.hold(float(self.position))

    @property
    def ramped_velocity(self) -> float:
        """Velocity trajectory, ticks/s, of mode 1 or of the position profile."""
        if self.demand.mode == _VELOCITY:
            return self._ramped
        return self.profile.velocity

    @property
    def resting(self) -> bool:
        """Nothing would change but the temperature."""
        # one period without motion may be the turning point of a rebound
        return self._still >= SLOW and not self.demand.torque

    def _pid(self, limit: float) -> float:
        """Output of the position controller, clamped to ``limit``, with anti-windup."""
        d = self.demand
        error = self.profile.position - self.position
        change = error - self._last_error
        self._last_error = error
        feedforward = 0.0
        if d.feedforward_1 or d.feedforward_2:
            # the manual gives the scale of the gain, not of its input: ticks a period
            feedforward = (
                d.feedforward_1 / 4 * self.profile.velocity * PERIOD
                + d.feedforward_2 / 4 * self.profile.acceleration * PERIOD * PERIOD
            )
        output = d.position_p / 128 * error + d.position_d / 16 * change + feedforward
        if d.position_i:
            integral = self._integral + d.position_i / 65536 * error
            if abs(output + integral) <= limit or integral * error < 0:
                self._integral = integral
            output += self._integral
        return max(-limit, min(limit, output))

    def _current_duty(self, amperes: float) -> float:
        """Duty that makes ``amperes`` flow at the present speed."""
        p = self.physics
        return (amperes * p.resistance + p.kt * self.joint.dq) / max(self.voltage, 1.0)

    def _control(self) -> float:
        """Duty that the active mode asks for."""
        d = self.demand
        mode = d.mode
        if mode == _CURRENT_BASED_POSITION:
            units = self._pid(abs(d.current))
            return self._current_duty(units * mx64.CURRENT_UNIT)
        if mode == _CURRENT:
            return self._current_duty(0.0 if d.stopped else d.current * mx64.CURRENT_UNIT)
        if mode == _PWM:
            return 0.0 if d.stopped else d.pwm * _DUTY
        if mode == _VELOCITY:
            error = (self._ramped - self.joint.dq / _TICK) / _VELOCITY_TICKS
            output = d.velocity_p / 128 * error
            integral = self._integral + d.velocity_i / 65536 * error
            if abs(output + integral) <= abs(d.pwm) or integral * error < 0:
                self._integral = integral
            return (output + self._integral) * _DUTY
        return self._pid(abs(d.pwm)) * _DUTY

    def ramp_velocity(self, acceleration: int) -> None:
        """Move the velocity trajectory of mode 1 by one period."""
        target = 0.0 if self.demand.stopped else self.demand.velocity * _VELOCITY_TICKS
        if acceleration <= 0:
            self._ramped = target
            return
        most = acceleration * _ACCELERATION_TICKS * PERIOD
        self._ramped += max(-most, min(most, target - self._ramped))

    def step(self, profile_acceleration: int = 0) -> None:
        """Advance by one control period (:data:`PERIOD` seconds).

        :param profile_acceleration: units of the register; used in velocity mode.
        """
        p = self.physics
        d = self.demand
        joint = self.joint
        if d.torque:
            self._still = 0
            if d.mode == _VELOCITY:
                self.ramp_velocity(profile_acceleration)
            else:
                self.profile.step(PERIOD)
            limit = 1.0 if d.mode == _PWM else abs(d.pwm) * _DUTY
            duty = max(-limit, min(limit, self._control()))
            current = (duty * self.voltage - p.kt * joint.dq) / p.resistance
            self.duty = duty
            self.current = current
            torque = p.kt * current
            joint.step(torque, PERIOD, p.gear_loss * abs(torque))
            self._heat += current * current * p.resistance * PERIOD
        else:
            self.duty = self.current = 0.0
            joint.step(0.0, PERIOD, self.physics.gear_loss * abs(joint.contact))
            still = abs(joint.dq) < _STILL and not joint.locked
            self._still = self._still + 1 if still else 0
        self._phase += 1
        if self._phase >= SLOW:
            self._step_slowly(self._phase * PERIOD)

    def rest(self, periods: int) -> None:
        """Let time pass for a drive that is :attr:`resting`."""
        self._step_slowly((self._phase + periods) * PERIOD)

    def _step_slowly(self, dt: float) -> None:
        p = self.physics
        self._phase = 0
        power = p.idle_power + (p.drive_power if self.demand.torque else 0.0)
        cooling = (self.temperature - p.ambient) * p.heat_capacity / p.cooling_time
        self.temperature += (self._heat + (power - cooling) * dt) / p.heat_capacity
        self._heat = 0.0
        drawn = p.idle_current + max(0.0, self.duty * self.current)
        self.voltage = max(0.0, self.supply - p.supply_resistance * drawn)
