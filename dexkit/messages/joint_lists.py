"""Messages that have a list for each quantity of the joints, seen as motors of ``unitree_go``.

Other hands' messages are sequences of motors. What reads or makes motors works on these as well,
by :meth:`~dexkit.messages.MessageType.motors` and :meth:`~dexkit.messages.MessageType.of_motors`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

__all__ = ["JOINT_LISTS", "JointLists", "to_int16"]

_GO = "unitree_go::msg::dds_::"


@dataclass(frozen=True)
class JointLists:
    """Location of the motors' values in such a message.

    :param motor: DDS name of the type that a motor is shown as.
    :param lists: for a member of it, the list that holds it and how many there are one.
    :param errors: the list of error bytes, if it has one.
    :param fixed: members of a message that is made of motors, as long as its lists are.
    :param whole: members of such a message that are one number.
    """

    motor: str
    lists: Mapping[str, tuple[str, int]]
    fixed: tuple[str, ...] = ()
    whole: Mapping[str, int] = field(default_factory=dict)
    errors: str = ""

    @property
    def sequence(self) -> str:
        """The list of positions, of which there is one for each motor."""
        return self.lists["q"][0]

    def motors(self, message: Any, kind: type[Any]) -> list[Any]:
        """The motors of a message; elements that a shorter list lacks are 0."""
        found = []
        for i in range(len(getattr(message, self.sequence))):
            motor = kind()
            for member, (name, scale) in self.lists.items():
                values = getattr(message, name)
                value = values[i] if i < len(values) else 0
                setattr(motor, member, value if scale == 1 else value / scale)
            if self.errors and i < len(errors := getattr(message, self.errors)):
                # where dexkit's services have them (docs/service.md)
                motor.reserve = (_fault(errors[i]), *motor.reserve[1:])
            found.append(motor)
        return found

    def message(self, motors: Sequence[Any], kind: type[Any]) -> Any:
        """A message of such motors."""
        lists = {name: [0] * len(motors) for name in self.fixed}
        for member, (name, scale) in self.lists.items():
            lists[name] = [to_int16(getattr(m, member, 0.0) * scale) for m in motors]
        return kind(**lists, **self.whole)


def _fault(error: int) -> int:
    from dexkit.wire.rh56 import FAULTS  # few messages have errors

    return sum(int(meaning) for bit, meaning in FAULTS.items() if error & bit)


def to_int16(value: float) -> int:
    """The nearest 16-bit integer; -1, which leaves a joint alone, for NaN."""
    return -1 if value != value else round(min(max(value, -32768.0), 32767.0))


JOINT_LISTS: Mapping[str, JointLists] = {
    "inspire::inspire_hand_ctrl": JointLists(
        _GO + "MotorCmd_",
        {"q": ("angle_set", 1000)},
        ("pos_set", "force_set", "speed_set"),
        {"mode": 1},
    ),
    "inspire::inspire_hand_state": JointLists(
        _GO + "MotorState_",
        {
            "q": ("angle_act", 1000),
            "tau_est": ("force_act", -1000),  # a positive force closes, and q opens
            "temperature": ("temperature", 1),
        },
        ("pos_act", "current", "err", "status"),
        errors="err",
    ),
}
"""Messages with joint lists by DDS name (docs/sources/unitree-dex.md#j3)."""
