"""States and commands of a G1's body as JSON, as LeRobot 0.4.4 to 0.6.1 exchanges them.

(docs/sources/lerobot.md#a2.) A state has what its client reads, a command mode and set values of
each motor; both name the DDS topic that they stand for.
"""

from __future__ import annotations

import base64
import json
from typing import Any

from dexkit.errors import OversizeError, WireError
from dexkit.messages.unitree_hg import LowCmd_, LowState_
from dexkit.robots import G1

__all__ = ["MOST", "command_from", "state_json"]

MOST = 1 << 16
"""Longest accepted command, bytes; LeRobot's have about 4000."""
_LARGEST = float.fromhex("0x1.fffffep127")
_NUMBERS = ("q", "dq", "kp", "kd", "tau")


def state_json(state: LowState_) -> bytes:
    """A state as LeRobot's client reads it: 35 motors, IMU, wireless remote, mode_machine."""
    imu = state.imu_state
    data = {
        "motor_state": [
            {
                "q": motor.q,
                "dq": motor.dq,
                "tau_est": motor.tau_est,
                "temperature": sum(motor.temperature) / len(motor.temperature),
            }
            for motor in state.motor_state
        ],
        "imu_state": {
            "quaternion": list(imu.quaternion),
            "gyroscope": list(imu.gyroscope),
            "accelerometer": list(imu.accelerometer),
            "rpy": list(imu.rpy),
            "temperature": float(imu.temperature),
        },
        "wireless_remote": base64.b64encode(bytes(state.wireless_remote)).decode("ascii"),
        "mode_machine": state.mode_machine,
    }
    return json.dumps({"topic": G1.state_topic, "data": data}).encode()


def command_from(payload: bytes) -> LowCmd_:
    """Parse a command of LeRobot's client; missing values are 0, as in LeRobot's server.

    :raises WireError: it is not such a command, or a number is not finite or out of range.
    """
    if len(payload) > MOST:
        raise OversizeError(f"a command of {len(payload)} bytes, at most {MOST} are read")
    try:
        found = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise WireError(f"not JSON: {error}") from None
    topic = _member(found, "topic", str, "")
    if topic != G1.cmd_topic:
        raise WireError(f"for the topic {topic[:80]!r}, not {G1.cmd_topic}")
    data = _member(found, "data", dict, {})
    motors = _member(data, "motor_cmd", list, [])
    if len(motors) > G1.slots:
        raise WireError(f"{len(motors)} motors, the {G1.name} has {G1.slots}")
    command = LowCmd_(mode_pr=_byte(data, "mode_pr"), mode_machine=_byte(data, "mode_machine"))
    for motor, values in zip(command.motor_cmd, motors, strict=False):
        motor.mode = _byte(values, "mode")
        for name in _NUMBERS:
            setattr(motor, name, _number(values, name))
    return command


def _member(found: Any, name: str, kind: type, default: Any) -> Any:
    if not isinstance(found, dict):
        raise WireError(f"a {type(found).__name__} where an object with {name!r} belongs")
    value = found.get(name, default)
    if not isinstance(value, kind):
        raise WireError(f"{name} is a {type(value).__name__}")
    return value


def _byte(found: Any, name: str) -> int:
    value = _member(found, name, int, 0)
    if isinstance(value, bool) or not 0 <= value <= 255:
        raise WireError(f"{name} = {str(value)[:20]} is no byte")
    return int(value)


def _number(found: Any, name: str) -> float:
    value = _member(found, name, int | float, 0.0)  # type: ignore[arg-type]
    if isinstance(value, bool) or not abs(value) <= _LARGEST:  # it goes on as a float32
        raise WireError(f"{name} = {str(value)[:20]} is no finite number")
    return float(value)
