"""The interface of a driver for a bring-up: motors by address, and the joints to be assigned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol

from dexkit.hand import Side
from dexkit.models import HandModel

if TYPE_CHECKING:
    from dexkit.bringup.findings import Findings

__all__ = [
    "Bench",
    "Drive",
    "JointChoice",
    "Plan",
    "Reading",
    "Snapshot",
    "Zero",
    "gripper_choices",
]


@dataclass(frozen=True)
class Reading:
    """State of one motor.

    :param q: position, rad at a joint with the plan's reference ratio, in the motor's direction
        (see :class:`JointChoice`).
    :param fault: :class:`~dexkit.hand.MotorError` bits.
    :param temperature: °C, the highest that the motor reports.
    """

    q: float
    fault: int = 0
    temperature: float = math.nan


@dataclass(frozen=True)
class Snapshot:
    """One answer of the hand.

    :param motors: by address; those that are silent are left out.
    :param pressure: values of each sensor, Pa, by address. Slots without an element never change.
    """

    motors: Mapping[str, Reading]
    pressure: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """Drive one motor towards ``q`` and lock all others; units as of :class:`Reading`.

    :param torque: N·m that it may give at most, for motors that take a limit. Those that follow kp
        need none: ``q`` is never further ahead of the motor than torque / kp.
    """

    motor: str
    q: float
    kp: float
    kd: float
    torque: float


class Zero(str, Enum):
    """How a joint's zero follows from the travel between its stops."""

    MIDDLE = "middle"
    """The range of q lies in the middle of the travel; the limits keep off the stops."""
    LOW_STOP = "low stop"
    """q is the lower of :attr:`JointChoice.stops` at that stop: a closed gripper."""


@dataclass(frozen=True)
class JointChoice:
    """A joint that a motor may move: its unknown properties, and how they are found.

    A motor reports ``ratio / reference * (sign * q + offset)``.

    :param rising: what is seen while q rises; ``falling`` while it falls: one word each.
    :param ratios: what its gear ratio may be; the lowest and the highest if it is ``measured``.
    :param zero: what the joint looks like at q = 0; empty if that is not asked.
    :param first: sign of dq towards the stop that is looked for first: the open one, unless there
        may be none.
    :param stops: q at its stops; None where they are near the limits.
    :param zero_from: how the travel gives the zero.
    :param measured: the ratio is any that makes the travel that between ``stops``, and not one of
        a few.
    :param motors: how many motors may move it, each a part of it: two servos of one gripper.
    :param most_travel: rad, at the reference ratio, that it goes from the first stop at most. If
        there is no second stop up to there, the ratio is the reference. None: it has two stops.
    :param wanted: it is of this hand. Others are only told apart from it, and their travel is not
        measured.
    """

    name: str
    q_min: float
    q_max: float
    rising: str
    falling: str
    ratios: tuple[float, ...]
    zero: str = ""
    first: int = -1
    stops: tuple[float, float] | None = None
    zero_from: Zero = Zero.MIDDLE
    measured: bool = False
    motors: int = 1
    most_travel: float | None = None
    wanted: bool = True


def gripper_choices(
    hand: HandModel,
    wanted: Side,
    ratios: tuple[float, ...],
    *,
    travel: float | None = None,
    **more: Any,
) -> tuple[JointChoice, ...]:
    """The grippers of both sides, whose motors may be on one line.

    :param wanted: the side that is brought up.
    :param ratios: the lowest and the highest gear ratio.
    :param travel: rad between the stops; by default the joint's stroke.
    :param more: other values of each :class:`JointChoice`.
    """
    return tuple(
        JointChoice(
            str(side),
            spec.q_min,
            spec.q_max,
            "opened",
            "closed",
            ratios,
            "closed",
            stops=(spec.q_min, spec.q_max if travel is None else spec.q_min + travel),
            zero_from=Zero.LOW_STOP,
            measured=True,
            wanted=side is wanted,
            **more,
        )
        for side, (spec,) in hand.joints.items()
    )


@dataclass(frozen=True)
class Plan:
    """The properties to be found on a hand, and the limits of torque and speed.

    :param joints: in the order in which their travel is measured.
    :param reference: gear ratio in whose radians motors are read and driven.
    :param places: where a person can press the hand, one pressure sensor each.
    :param travel: whether to go to the stops.
    :param part: what a joint is called in questions.
    :param nudge: rad of the first motion, at a joint with the reference ratio; less with more
        gears.
    :param torque: N·m at a joint that is enough, as far as is known, and ``most_torque`` that is
        allowed.
    :param speed: rad/s of a joint.
    """

    joints: tuple[JointChoice, ...]
    reference: float
    places: tuple[str, ...] = ()
    travel: bool = True
    part: str = "joint"
    nudge: float = 0.14
    torque: float = 0.25
    most_torque: float = 0.5
    speed: float = 0.2

    @property
    def widest(self) -> float:
        """Largest ratio of a possible gearing to the reference: how much stronger a joint may be
        than its motor's torque says.
        """
        return max(r for joint in self.joints for r in joint.ratios) / self.reference


class Bench(Protocol):
    """One hand, prepared for a bring-up.

    ``open`` connects and finds out what answers; it moves nothing. ``facts`` then says on which
    hand: serial number, versions, what answered. ``exchange`` drives at most one motor and locks
    all others. ``settings`` turns findings into settings of the backend, ``store`` keeps them.
    """

    @property
    def plan(self) -> Plan:
        """The plan of the bring-up."""
        ...

    @property
    def motors(self) -> tuple[str, ...]:
        """Addresses of the motors that answer; after ``open``."""
        ...

    @property
    def facts(self) -> Mapping[str, Any]:
        """Identity of the hand and what its protocol does; after ``open``."""
        ...

    @property
    def emulated(self) -> bool:
        """Whether the open hand is where only emulated ones are: behind a USB/IP server of this
        machine, or on a pseudo-terminal.
        """
        ...

    def open(self) -> None:
        """Connect, and find what answers. No motion.

        :raises HandError: it is not there, or does not answer as any reading of its manual says.
        """
        ...

    def close(self) -> None:
        """Lock every motor and release the hand."""
        ...

    def exchange(self, drive: Drive | None) -> Snapshot:
        """Send one frame and return the hand's answer.

        :param drive: the one motor that may move; None locks all.
        :raises HandError: as :meth:`dexkit.hand.Hand.exchange`.
        """
        ...

    def settings(self, findings: Findings) -> dict[str, str]:
        """Settings of the backend, as ``--set`` takes them, that follow from the findings."""
        ...

    @property
    def where(self) -> str:
        """Path of the settings file, for messages."""
        ...

    def load(self) -> Findings:
        """Load the findings of an earlier bring-up of this hand; empty if there was none.

        :raises UsageError: the file cannot be read.
        """
        ...

    def store(self, findings: Findings) -> None:
        """Keep findings, and the settings that follow from them.

        :raises UsageError: the file cannot be written.
        """
        ...
