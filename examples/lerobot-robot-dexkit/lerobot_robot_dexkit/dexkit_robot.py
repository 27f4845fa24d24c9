"""The robot: dexkit's hands behind LeRobot's interface."""

from __future__ import annotations

import logging
import math
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot

from dexkit.backends import Backend, BackendOptions, backend
from dexkit.hand import Floats, HandSpec, HandState, Side
from dexkit.service.local import LocalHand
from lerobot_robot_dexkit.config_dexkit_robot import DexkitRobotConfig
from lerobot_robot_dexkit.errors import (
    ActionRefused,
    AlreadyConnected,
    ConfigRefused,
    NotConnected,
    NotMeasured,
)

__all__ = ["DexkitRobot"]

_log = logging.getLogger(__name__)
_FIELDS = {"pos": "q", "vel": "dq", "torque": "tau_est"}  # observed, and its name in a HandState


class DexkitRobot(Robot):
    """One or two hands of dexkit, without cameras.

    Features are named ``SIDE_JOINT.pos``, in the hand model's unit: rad, or parts of the full
    travel (``dexkit models``). A thread of each hand keeps its exchanges going; an action is in
    force for the model's command time-out (one second) and the hand brakes after it, so it does not
    move on while LeRobot saves an episode or waits for a policy.

    :raises ConfigRefused: no such side or observation.
    :raises DexkitError: no such backend, device or setting.
    """

    config_class = DexkitRobotConfig
    name = "dexkit"

    def __init__(self, config: DexkitRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, Any] = {}
        self._hands: dict[Side, LocalHand] = {}
        self._backend: Backend = backend(config.backend)
        self._options = _options(config)
        self._specs: dict[Side, HandSpec] = {
            side: self._backend.create(options).spec for side, options in self._options.items()
        }

    # -- what there is

    @cached_property
    def observation_features(self) -> dict[str, type]:
        """``SIDE_JOINT.FIELD`` of all joints, all numbers."""
        return {
            f"{joint}.{field}": float
            for field in self.config.observe
            for side in self._specs
            for joint in self._joints(side)
        }

    @cached_property
    def action_features(self) -> dict[str, type]:
        """``SIDE_JOINT.pos`` of all joints."""
        return {f"{joint}.pos": float for side in self._specs for joint in self._joints(side)}

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """The range of each action. A gripper that is calibrated has its own ends at these."""
        return {
            f"{name}.pos": (joint.q_min, joint.q_max)
            for side, spec in self._specs.items()
            for name, joint in zip(self._joints(side), spec.joints, strict=True)
        }

    @property
    def is_connected(self) -> bool:
        """Whether :meth:`disconnect` has something to stop. A hand whose cable was pulled counts:
        it is opened again, and until then its observation raises HandLost.
        """
        return bool(self._hands)

    @property
    def is_calibrated(self) -> bool:
        """True: a hand that lacks a calibration refuses to connect, and says how to make it."""
        return True

    # -- connection

    def connect(self, calibrate: bool = True) -> None:
        """Open the hands, without motion.

        :raises AlreadyConnected: they are open.
        :raises HandError: one cannot be opened; none stays open then.
        :raises NotMeasured: a hand does not measure what is to be observed.
        """
        if self._hands:
            raise AlreadyConnected(f"{self} is connected")
        try:
            for side, options in self._options.items():
                hand = LocalHand(self._backend.create(options))
                hand.start()
                self._hands[side] = hand
                self._check_observed(side, hand.state())
        except BaseException:
            self.disconnect()
            raise

    def disconnect(self) -> None:
        """Brake and release all hands. May be called twice."""
        hands, self._hands = self._hands, {}
        for side, hand in hands.items():
            try:
                hand.stop()
            except Exception:  # the other hand must be released as well
                _log.exception("the %s hand could not be stopped", side)

    def calibrate(self) -> None:
        """Nothing: dexkit calibrates a hand where that is needed, with the hand empty."""
        _log.info("hands are calibrated with 'dexkit calibrate', not by LeRobot")

    def configure(self) -> None:
        """Nothing: a backend configures its device when it is opened."""

    # -- observations and actions

    def get_observation(self) -> dict[str, Any]:
        """The newest states.

        :raises NotConnected: not connected.
        :raises HandError: a hand is lost, does not answer, or reports a fault.
        """
        hands = self._connected()
        found = {}
        for side, hand in hands.items():
            state = hand.state()
            for field in self.config.observe:
                values = getattr(state, _FIELDS[field]).tolist()
                for joint, value in zip(self._joints(side), values, strict=True):
                    found[f"{joint}.{field}"] = value
        return {key: found[key] for key in self.observation_features}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Command all hands.

        :param action: a number for each of :attr:`action_features`.
        :returns: the positions that were commanded, within the limits. On its way to the first
            one a real hand moves slowly, one stroke a second.
        :raises NotConnected: not connected.
        :raises ActionRefused: a joint is missing, unknown, or its number is not finite; nothing is
            sent then.
        :raises HandError: a hand is lost, does not answer, or reports a fault.
        """
        hands = self._connected()
        goals = self._goals(action)
        for hand in hands.values():
            hand.state()  # before the first one is commanded: no hand of a pair moves alone
        sent: dict[str, Any] = {}
        for side, hand in hands.items():
            moved = hand.move_to(goals[side]).tolist()
            sent.update({f"{j}.pos": q for j, q in zip(self._joints(side), moved, strict=True)})
        return sent

    def _connected(self) -> dict[Side, LocalHand]:
        if not self._hands:
            raise NotConnected(f"{self} is not connected", hint="call connect() first")
        return self._hands

    def _joints(self, side: Side) -> list[str]:
        return [f"{side}_{joint.name}" for joint in self._specs[side].joints]

    def _goals(self, action: dict[str, Any]) -> dict[Side, Floats]:
        known = self.action_features
        if set(action) != set(known):
            missing = [key for key in known if key not in action]
            unknown = [key for key in action if key not in known]
            told = [f"missing: {', '.join(missing)}"] if missing else []
            told += [f"unknown: {', '.join(map(str, unknown))}"] if unknown else []
            raise ActionRefused(f"not an action of {self}: {'; '.join(told)}")
        numbers = {}
        for key, value in action.items():
            try:
                numbers[key] = float(value)
            except (TypeError, ValueError):
                raise ActionRefused(f"{key} = {value!r} is not a number") from None
            if not math.isfinite(numbers[key]):
                raise ActionRefused(f"{key} = {value!r} is not finite")
        return {
            side: np.array([numbers[f"{joint}.pos"] for joint in self._joints(side)])
            for side in self._specs
        }

    def _check_observed(self, side: Side, state: HandState) -> None:
        for field in self.config.observe:
            if not np.isfinite(getattr(state, _FIELDS[field])).all():
                raise NotMeasured(
                    f"the {side} {self._specs[side].model} of {self.config.backend} does not "
                    f"measure {field}",
                    hint="leave it out of --robot.observe",
                )


def _options(config: DexkitRobotConfig) -> dict[Side, BackendOptions]:
    """The backend's options for each side that is asked for."""
    names = [str(side) for side in Side]
    if config.side not in (*names, "both"):
        raise ConfigRefused(f"side {config.side!r}", hint=f"{', '.join(names)} or both")
    sides = [side for side in Side if config.side in (str(side), "both")]
    if not config.observe or set(config.observe) - set(_FIELDS):
        raise ConfigRefused(f"observe {config.observe}", hint=f"some of {', '.join(_FIELDS)}")
    used = [str(side) for side in sides]
    for side in config.devices:
        if side not in used:
            raise ConfigRefused(f"a device for {side!r}", hint=f"sides: {', '.join(used)}")
    settings: dict[Side, dict[str, str]] = {side: {} for side in sides}
    for key, value in config.settings.items():
        prefix, _, rest = key.partition(".")
        if prefix in names and prefix not in used:
            raise ConfigRefused(f"setting {key}, and there is no {prefix} hand")
        for side in sides:
            if prefix not in names:
                settings[side][key] = value
            elif prefix == str(side):
                settings[side][rest] = value
    return {side: BackendOptions(side, config.devices.get(side), settings[side]) for side in sides}
