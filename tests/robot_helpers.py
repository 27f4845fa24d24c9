"""Commands for emulated robots, and a robot that is driven by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dexkit.emulators.robot import RobotMechanics, Settings
from dexkit.messages import message_type, unitree_go, unitree_hg
from dexkit.robots import RobotModel
from dexkit.wire.low_level import encode_with_crc

__all__ = ["Bench", "low_cmd"]


def low_cmd(
    model: RobotModel,
    q: Mapping[int, float] | None = None,
    *,
    mode: Sequence[int] | None = None,
    change: Mapping[int, Mapping[str, Any]] | None = None,
    **members: Any,
) -> Any:
    """The command that xr_teleoperate would send: hold the rest position, but for ``q``.

    :param mode: by slot; default the model's.
    :param change: members of the commands of single slots.
    :param members: of the message.
    """
    family = unitree_go if model.family == "unitree_go" else unitree_hg
    motors = []
    for slot in range(model.slots):
        kp, kd = model.client_gains[slot]
        values = {
            "mode": (mode or model.enable)[slot],
            "q": (q or {}).get(slot, model.rest_q[slot]),
            "kp": kp,
            "kd": kd,
            **((change or {}).get(slot, {})),
        }
        motors.append(family.MotorCmd_(**values))
    if model.mode_machine is None:
        head: dict[str, Any] = {"head": (0xFE, 0xEF), "level_flag": 0xFF}
    else:
        head = {"mode_machine": model.mode_machine}
    return family.LowCmd_(motor_cmd=motors, **{**head, **members})


class Bench:
    """A robot on a clock that only the test moves."""

    def __init__(self, model: RobotModel, settings: Settings | None = None) -> None:
        self.model = model
        self.reports: list[str] = []
        self.robot = RobotMechanics(model, settings, report=self.reports.append)
        self.now = 0.0

    def send(self, message: Any) -> bool:
        """Give it a command with the right CRC; whether it is obeyed."""
        return self.robot.command(encode_with_crc(message), self.now)

    def run(self, seconds: float, message: Any = None, hz: float = 250.0) -> Any:
        """Let time pass, a command repeated meanwhile; the state at the end, decoded."""
        data = None if message is None else encode_with_crc(message)
        for _ in range(round(seconds * hz)):
            if data is not None:
                assert self.robot.command(data, self.now)
            self.now += 1.0 / hz
            self.robot.advance(self.now)
        return self.state()

    def state(self) -> Any:
        """The state, decoded."""
        return message_type(self.model.state_type).decode(self.robot.state(self.now))
