"""Translate one gripper's command or state from one Dex1 dialect to another. Pure functions.

A *part* is that: one motor of a ``MotorCmds_`` or ``MotorStates_``, or a whole ``HandCmd_`` or
``HandState_``, which is of one gripper anyway. Between dialects of the same types a part passes
as it is, every field. Between 0 .. 5.4 rad (``unitree_go``, ``unitree_actuator``) and 0 .. 2 pi
(``unitree_hg``, as the interface specification has it), with s = 2 pi / 5.4:

=============  =====================================  =============================================
what           to unitree_hg                          from unitree_hg
=============  =====================================  =============================================
q, dq, ddq     times s; see "near the ends"           by s; a command at or below 0.1 closes, at
                                                      or above 6.0 opens
tau            as it is                               of a command: 0, it is unused
kp, kd         by s                                   5.0 and 0.05, whatever the command has, as
                                                      ``dexkit serve`` takes them
tau_est        grip strength: without its sign        with the sign of closing
temperature    0 (not filled) becomes 25              the first of the two, 0 .. 127
vol            12.0: there is no field                dropped
mode           0: it means "position"                 of a command 1 (drive), of a state 0
fault, lost    motorstate and error                   reserve[0] and lost
predicted      reserve[0]                             reserve[1]
=============  =====================================  =============================================

**Near the ends.** A gripper of unitree_hg closes fully at q <= 0.1 and opens fully at q >= 6.0,
so 0 .. 0.086 and 5.157 .. 5.4 rad of the other scale cannot be commanded there, but for the ends
themselves. :class:`Reachable` chooses between both.

**Without a gain.** unitree_hg knows no gains, so a command that does not pull towards its q
(kp <= 0: limp, or driven by velocity or torque) cannot be expressed in it; obeyed as it is, q = 0
of a client that lets go would close the gripper. :class:`~dexkit.bridge.forwarding.Commands` puts
the gripper's own position there instead.

**Why gains shrink and torques do not.** Torques of both dialects are those of the joint that
runs from 0 to 5.4 rad (``dexkit serve`` publishes one tau_est in both). A radian of unitree_hg is
1 / s of that joint's, so a command that is to press as hard for the same displacement of the
jaws, kp_hg * (s dq) = kp * dq, needs kp_hg = kp / s; likewise kd.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from dexkit.hand import HandState, Side
from dexkit.messages import MessageType, message_type, unitree_go, unitree_hg
from dexkit.models import Dialect, dialect, model
from dexkit.service.dialects import StateView, dialect_map

__all__ = ["PartCodec", "Reachable", "Translator", "loses_gains", "translator"]

_HG = dialect("unitree_hg")
_DEX1 = model(_HG.model)
_FLOAT_MAX = (2 - 2**-23) * 2.0**127
# of the numbers of a motor, those that are acted upon
_NUMBERS = {
    "cmd": ("q", "dq", "tau", "kp", "kd"),
    "state": ("q", "dq", "ddq", "tau_est"),
}

Translator = Callable[[Any], Any]
"""A part in one dialect to the same in another."""


class PartCodec:
    """Takes a gripper's part out of a dialect's messages, and puts parts into one.

    :param kind: ``"cmd"`` or ``"state"``.
    """

    def __init__(self, spoken: Dialect, kind: str) -> None:
        self.type: MessageType = message_type(
            spoken.cmd_type if kind == "cmd" else spoken.state_type
        )
        self._sequence = self.type.motor_sequence
        self._motor: type[Any] = self.type.motor_type.cls
        # the message has other members beside the motors
        self._whole = len(self.type.layout.fields) > 1
        self._index = spoken.index
        self._numbers = _NUMBERS[kind]
        self.length = spoken.length

    def count(self, message: Any) -> int:
        """The number of motors in a message."""
        return len(getattr(message, self._sequence))

    def take(self, message: Any, side: Side) -> Any | None:
        """The side's part, or None where the message is too short for it."""
        motors = getattr(message, self._sequence)
        if len(motors) <= self._index[side]:
            return None
        return message if self._whole else motors[self._index[side]]

    def put(self, parts: Mapping[Side, Any]) -> Any:
        """A message of these parts; the place of a side that is not given is blank."""
        if self._whole:
            (part,) = parts.values()
            return part
        motors = [self.blank() for _ in range(self.length)]
        for side, part in parts.items():
            motors[self._index[side]] = part
        return self.type.cls(motors)

    def blank(self) -> Any:
        """A motor with every field 0."""
        return self._motor()

    def is_finite(self, part: Any) -> bool:
        """Whether every number that a peer acts upon is finite."""
        motor = self.motor(part)
        return all(math.isfinite(getattr(motor, name)) for name in self._numbers)

    def motor(self, part: Any) -> Any:
        """The motor in a part."""
        return getattr(part, self._sequence)[0] if self._whole else part


def translator(source: Dialect, target: Dialect, kind: str) -> Translator:
    """The function that makes of a part in ``source`` the same in ``target``.

    Parts must be finite (:meth:`PartCodec.is_finite`).
    """
    if source.cmd_type == target.cmd_type:
        return lambda part: part
    if target.cmd_type == _HG.cmd_type:
        return _command_to_hg if kind == "cmd" else _state_to_hg
    return _command_from_hg if kind == "cmd" else _state_from_hg


class Reachable:
    """Replaces a goal that unitree_hg cannot express by the nearest one that it can.

    To the nearer end of the gap. But if it rests there, and for ``DWELL`` the command has been
    ``ELSEWHERE`` and not there, to the other end, until the command changes. xr_teleoperate needs
    that: it commands no more than 0.18 rad from where the gripper is, and its filter stops half
    way while nothing moves (traces/samples/README.md). So at 5.4 it commands "close" as 5.31, which
    is nearest to 5.4, and would do so for ever.
    """

    GAPS = ((0.0, _HG.ends[0] + 1e-3), (_HG.ends[1] - 1e-3, _HG.q_open))
    """Gaps in what can be commanded, rad of unitree_hg; their ends can be."""
    ELSEWHERE = 0.07
    """Rad of unitree_hg. Of xr_teleoperate's lead the filter lets half pass at least, 0.10 here;
    when it wants the end itself, it stops within 0.05."""
    DWELL = 0.2
    """Seconds; while the gripper moves the filter lags by 0.015."""

    def __init__(self) -> None:
        self._rests_since: float | None = None
        self._sent_across: tuple[float, float] | None = None  # the command, and where to

    def __call__(self, q: float, position: float | None, now: float) -> float:
        """A command that the gripper obeys as it is meant; all in rad of unitree_hg.

        :param position: where the gripper is, if known.
        :param now: seconds.
        """
        for low, high in self.GAPS:
            if low < q < high:
                near, far = (low, high) if q - low < high - q else (high, low)
                return self._in_gap(q, near, far, position, now)
        self._sent_across = self._rests_since = None
        return q

    def _in_gap(
        self, q: float, near: float, far: float, position: float | None, now: float
    ) -> float:
        if self._sent_across is not None and abs(q - self._sent_across[0]) <= self.ELSEWHERE:
            return self._sent_across[1]
        self._sent_across = None
        is_there = position is not None and abs(position - near) <= self.ELSEWHERE
        if not is_there or abs(q - near) <= self.ELSEWHERE:
            self._rests_since = None
        elif self._rests_since is None:
            self._rests_since = now
        elif now - self._rests_since >= self.DWELL:
            self._sent_across, self._rests_since = (q, far), None
            return far
        return near


def loses_gains(source: Dialect, target: Dialect) -> bool:
    """Whether a client of ``source`` sets gains that grippers of ``target`` ignore."""
    return source.cmd_type != target.cmd_type == _HG.cmd_type


_JOINT = _DEX1.joints[Side.LEFT][0]  # both sides' are alike
_SCALE = _HG.q_open / _JOINT.q_max
_MAP = dialect_map(_HG, {Side.LEFT: _DEX1.spec(Side.LEFT, io_rate=_DEX1.state_rate)})


def _command_to_hg(motor: unitree_go.MotorCmd_) -> unitree_hg.HandCmd_:
    return unitree_hg.HandCmd_(
        [
            unitree_hg.MotorCmd_(
                q=_to_float32(motor.q * _SCALE),
                dq=_to_float32(motor.dq * _SCALE),
                tau=motor.tau,
                kp=motor.kp / _SCALE,
                kd=motor.kd / _SCALE,
            )
        ]
    )


def _command_from_hg(message: unitree_hg.HandCmd_) -> unitree_go.MotorCmd_:
    command = _MAP.command(message, Side.LEFT)
    assert command is not None  # it has a motor: PartCodec.take
    return unitree_go.MotorCmd_(
        mode=int(command.mode[0]),
        q=float(command.q[0]),
        dq=float(command.dq[0]),
        tau=float(command.tau[0]),
        kp=float(command.kp[0]),
        kd=float(command.kd[0]),
    )


def _state_to_hg(motor: unitree_go.MotorState_) -> unitree_hg.HandState_:
    state = HandState.from_values(
        motor.q,
        stamp=0.0,  # goes into no message
        dq=motor.dq,
        ddq=motor.ddq,
        tau_est=motor.tau_est,
        temperature=motor.temperature or math.nan,
        measured=motor.reserve[1] != 1,
    )
    view = StateView(state, (motor.reserve[0],), motor.lost)
    message: unitree_hg.HandState_ = _MAP.state({Side.LEFT: view})
    return message


def _state_from_hg(message: unitree_hg.HandState_) -> unitree_go.MotorState_:
    motor = message.motor_state[0]
    return unitree_go.MotorState_(
        q=motor.q / _SCALE,
        dq=motor.dq / _SCALE,
        ddq=motor.ddq / _SCALE,
        tau_est=_JOINT.closing * abs(motor.tau_est) + 0.0,  # no -0.0
        temperature=min(max(motor.temperature[0], 0), 127),
        lost=message.error[1],
        reserve=(motor.motorstate, 1 if motor.reserve[0] == 1 else 0),
    )


def _to_float32(value: float) -> float:
    return min(max(value, -_FLOAT_MAX), _FLOAT_MAX)
