"""What ``examples/lerobot-robot-dexkit`` uses of LeRobot, where LeRobot is not installed.

Only names and rules that a plug-in meets, the same in LeRobot 0.4.0 to 0.6.1: abstract members of
``Robot``, the registry of ``RobotConfig``, two errors, and how the class of a robot is found from
that of its configuration. ``tests/test_lerobot_soak.py`` runs the same tests with LeRobot itself.
"""

from __future__ import annotations

import abc
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

__all__ = ["lerobot_modules", "make_robot"]


@dataclass(kw_only=True)
class RobotConfig:
    id: str | None = None
    calibration_dir: Path | None = None
    choices: ClassVar[dict[str, type]] = {}

    @classmethod
    def register_subclass(cls, name: str) -> Callable[[type], type]:
        def register(found: type) -> type:
            cls.choices[name] = found
            return found

        return register

    @property
    def type(self) -> str:
        return next(name for name, found in self.choices.items() if found is type(self))


class Robot(abc.ABC):
    config_class: type[RobotConfig]
    name: str

    def __init__(self, config: RobotConfig) -> None:
        self.robot_type = self.name
        self.id = config.id

    def __str__(self) -> str:
        return f"{self.id} {type(self).__name__}"

    @property
    @abc.abstractmethod
    def observation_features(self) -> dict[str, Any]: ...
    @property
    @abc.abstractmethod
    def action_features(self) -> dict[str, Any]: ...
    @property
    @abc.abstractmethod
    def is_connected(self) -> bool: ...
    @property
    @abc.abstractmethod
    def is_calibrated(self) -> bool: ...
    @abc.abstractmethod
    def connect(self, calibrate: bool = True) -> None: ...
    @abc.abstractmethod
    def calibrate(self) -> None: ...
    @abc.abstractmethod
    def configure(self) -> None: ...
    @abc.abstractmethod
    def get_observation(self) -> dict[str, Any]: ...
    @abc.abstractmethod
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]: ...
    @abc.abstractmethod
    def disconnect(self) -> None: ...


class DeviceNotConnectedError(ConnectionError):
    def __init__(self, message: str = "not connected") -> None:
        self.message = message
        super().__init__(message)


class DeviceAlreadyConnectedError(ConnectionError):
    def __init__(self, message: str = "already connected") -> None:
        self.message = message
        super().__init__(message)


@contextmanager
def lerobot_modules() -> Iterator[None]:
    """``lerobot.robots`` and ``lerobot.utils.errors`` to import, until the end."""
    here = sys.modules[__name__]
    before = dict(sys.modules)
    for name in ("lerobot", "lerobot.robots", "lerobot.utils", "lerobot.utils.errors"):
        module = sys.modules[name] = ModuleType(name)
        module.__path__ = []
    for name in ("Robot", "RobotConfig"):
        setattr(sys.modules["lerobot.robots"], name, getattr(here, name))
    for name in ("DeviceNotConnectedError", "DeviceAlreadyConnectedError"):
        setattr(sys.modules["lerobot.utils.errors"], name, getattr(here, name))
    try:
        yield
    finally:
        for name in set(sys.modules) - set(before):
            if name.partition(".")[0] in ("lerobot", "lerobot_robot_dexkit"):
                del sys.modules[name]


def make_robot(config: Any) -> Any:
    """The robot of a configuration, found by its name as LeRobot's factory does."""
    kind = type(config)
    assert kind.__name__.endswith("Config")
    package = importlib.import_module(kind.__module__.rpartition(".")[0])
    return getattr(package, kind.__name__.removesuffix("Config"))(config)
