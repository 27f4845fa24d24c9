"""Simulate motor temperatures and the battery from the motors' torques, ten times a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dexkit.emulators.robot.joints import Joints
from dexkit.emulators.robot.settings import Settings
from dexkit.robots import RobotModel

__all__ = ["Supply"]

Array = NDArray[np.float64]

PERIOD = 0.1
"""Seconds between two updates."""
_CELL_FULL, _CELL_EMPTY = 4.15, 3.3  # V
_COPPER_LOSS = 60.0  # W that a motor turns into heat at full torque


class Supply:
    """Temperatures of the motors and the state of the battery.

    :ivar cells: of the battery, in series.
    :ivar temperature: shape (n,), degrees Celsius.
    :ivar charge: percent.
    :ivar power: W drawn at the last update.
    """

    def __init__(self, model: RobotModel, joints: Joints, settings: Settings) -> None:
        self.cells = model.battery_cells
        self._joints = joints
        self._settings = settings
        self.temperature: Array = np.full(len(joints.q), settings.ambient)
        self.charge = settings.charge
        self.power = settings.idle_power

    def step(self) -> None:
        """Advance by :data:`PERIOD` seconds with the present torques."""
        joints, s = self._joints, self._settings
        load = np.square(joints.tau / joints.tau_max)
        goal = s.ambient + s.heating * load
        self.temperature += (goal - self.temperature) * (PERIOD / s.warm_up)
        mechanical = float(np.maximum(joints.tau * joints.dq, 0.0).sum())
        self.power = s.idle_power + _COPPER_LOSS * float(load.sum()) + mechanical
        used = self.power * PERIOD / 3600.0  # W·h
        self.charge = max(0.0, self.charge - 100.0 * used / s.capacity)

    @property
    def cell_voltage(self) -> float:
        """V."""
        return _CELL_EMPTY + (_CELL_FULL - _CELL_EMPTY) * self.charge / 100.0

    @property
    def voltage(self) -> float:
        """V of the battery."""
        return self.cells * self.cell_voltage

    @property
    def current(self) -> float:
        """A drawn from the battery."""
        return self.power / self.voltage
