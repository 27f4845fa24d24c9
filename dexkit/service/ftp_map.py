"""Translate the messages of Inspire's FTP hands: lists of integers, and mode bits
(docs/sources/unitree-dex.md#j3).

What a command does not write keeps its value, as in the registers of the device: ``angle_set``
counts with mode bit 1, where -1 leaves a joint's goal as it is, and ``speed_set`` with bit 8.
``pos_set`` (bit 2) and ``force_set`` (bit 4) are not used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dexkit.hand import Floats, HandCommand, HandSpec, Side
from dexkit.messages import message_type
from dexkit.messages.inspire import inspire_hand_state
from dexkit.messages.integer_lists import IntegerLists
from dexkit.models import Dialect
from dexkit.service.dialects import DialectMap, Fill, Remark, StateView
from dexkit.wire.rh56 import FAULTS, FULL, UNCHANGED, Status

__all__ = ["FtpMap"]

_ANGLE, _SPEED = 1, 8
_STILL = 0.01  # full travels a second
_PRESSES = 0.9  # of the full force


class FtpMap(DialectMap):
    """One FTP hand: goals and speeds in thousandths.

    A command that leaves a joint without any goal is not obeyed.
    """

    def __init__(
        self, dialect: Dialect, specs: Mapping[Side, HandSpec], fill: Fill = Fill.KNOWN
    ) -> None:
        super().__init__(dialect, specs, fill)
        ((_, self._spec),) = specs.items()
        n = self._spec.n_joints
        self._full: Floats = np.array([joint.dq_max for joint in self._spec.joints])
        self._goals: Floats = np.full(n, math.nan)
        self._speeds: Floats = np.ones(n)
        self._touch = IntegerLists(
            message_type(dialect.touch_type), {area.member: area.elements for area in dialect.areas}
        )
        # which of the elements of a state's pressures there are
        there = [range(area.elements) for area in dialect.areas]
        self._areas = np.repeat(np.arange(len(dialect.areas)), [len(r) for r in there])
        self._elements = np.concatenate([np.array(r) for r in there])

    def command(self, message: Any, side: Side) -> HandCommand | None:
        """The command for the hand; None where a list is too short or a joint has no goal yet."""
        n = self._spec.n_joints
        written = {bit: _list(message, bit) for bit in (_ANGLE, _SPEED) if message.mode & bit}
        if not written or any(len(values) < n for values in written.values()):
            return None
        if _SPEED in written:
            asked = np.clip(written[_SPEED][:n], 0, FULL) / FULL
            self._speeds = np.asarray(asked)
        if _ANGLE in written:
            angles = np.array(written[_ANGLE][:n])
            self._goals = np.where(angles == UNCHANGED, self._goals, angles / FULL)
        if np.isnan(self._goals).any():
            return None
        return HandCommand.position(self._goals.tolist(), dq=(self._speeds * self._full).tolist())

    def remarks(self, message: Any, side: Side) -> Sequence[Remark]:
        """Mode bits that are not used."""
        if not message.mode & ~(_ANGLE | _SPEED):
            return ()
        text = (
            f"of mode {message.mode:#x} only the bits 1 (angle_set) and 8 (speed_set) are used; "
            "send goals in angle_set"
        )
        return (Remark("unknown_status", text),)

    def state(self, views: Mapping[Side, StateView]) -> inspire_hand_state:
        """The state message; actuator positions and currents are 0."""
        (view,) = views.values()
        s, n = view.state, self._spec.n_joints
        closing = np.array([joint.closing for joint in self._spec.joints])
        force = np.nan_to_num(s.tau_est) * closing
        return inspire_hand_state(
            pos_act=[0] * n,
            angle_act=_thousandths(s.q),
            force_act=_thousandths(force),
            current=[0] * n,
            err=[_error(fault) for fault in view.fault],
            status=[
                int(_status(speed, f, fault))
                for speed, f, fault in zip(
                    np.nan_to_num(s.dq) * closing, force, view.fault, strict=True
                )
            ],
            temperature=[round(min(max(t, 0), 255)) for t in np.nan_to_num(s.temperature)],
        )

    def encode_touch(self, views: Mapping[Side, StateView]) -> bytes | None:
        """Readings of the tactile areas, device counts; None if they are not measured."""
        (view,) = views.values()
        if view.state.pressure is None:
            return None
        return self._touch.encode(view.state.pressure[self._areas, self._elements])


def _list(message: Any, bit: int) -> list[int]:
    found: list[int] = message.angle_set if bit == _ANGLE else message.speed_set
    return found


def _thousandths(values: Floats) -> list[int]:
    found: list[int] = (
        np.clip(np.rint(np.nan_to_num(values) * FULL), -32768, 32767).astype(int).tolist()
    )
    return found


def _error(fault: int) -> int:
    return sum(int(bit) for bit, meaning in FAULTS.items() if fault & meaning)


def _status(speed: float, force: float, fault: int) -> Status:
    """The status of a joint, from its speed toward closed."""
    if fault:
        return Status.FAULT
    if force > _PRESSES:
        return Status.FORCE_REACHED
    if abs(speed) < _STILL:
        return Status.ARRIVED
    return Status.CLOSING if speed > 0 else Status.OPENING
