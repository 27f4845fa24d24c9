"""The stimulus for one hand on USB, as a script; see :mod:`dexkit.conformance.kit.phased_script`.

Commands that move something enable the time-out protection, except where its absence is tested. A
player that ends the script early sends :meth:`UsbScript.lock_frame`; one that is killed cannot
(docs/conformance-usb.md says in which state it leaves the hand).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dexkit.conformance.kit.phased_script import PhasedScript
from dexkit.conformance.stimuli.phases import parts_of
from dexkit.conformance.usb.frames import (
    Motor,
    Scale,
    motor_packet,
    pack_command,
    read_state,
)
from dexkit.conformance.usb.record import UsbPhase
from dexkit.hand import Side
from dexkit.models import DEX3_1

__all__ = [
    "BUSES",
    "DRIVEN",
    "FREE",
    "Action",
    "Alone",
    "In",
    "Observation",
    "Out",
    "Plan",
    "Reopen",
    "UsbScript",
    "UsbSteps",
    "Wait",
]

BUSES: tuple[tuple[int, int], ...] = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 1))
"""(bus, id) of each joint's motor: thumb, middle, index. The manual's figure of it is lost, and
this is assumed (docs/sources/unitree-dex.md#c7)."""
DRIVEN, FREE = 3, 5
"""Joints of the time-out test: middle_0 is driven with protection, index_0 without."""
ANSWER_TIMEOUT = 1.0  # s; IN timeout of the manual's code (the Dex3-1 manual receiveState)
_STEP = 0.2  # rad
_KP, _KD = 1.5, 0.1  # grip of the vendor's C++ example (docs/sources/unitree-dex.md#b1)
_GIVE_UP = 3  # commands in a row without an answer
_LONGEST = 4096  # room for an answer, bytes; BUF_SIZE of the manual


@dataclass(frozen=True)
class Observation:
    """Observations of the runner after an action.

    :param status: of the transfer: 0, or a negative errno.
    :param data: bytes from the device.
    """

    now_ns: int
    status: int = 0
    data: bytes = b""


@dataclass(frozen=True)
class Out:
    """Write to the bulk OUT endpoint."""

    data: bytes
    timeout: float = ANSWER_TIMEOUT


@dataclass(frozen=True)
class In:
    """Read from the bulk IN endpoint."""

    timeout: float = ANSWER_TIMEOUT
    length: int = _LONGEST


@dataclass(frozen=True)
class Wait:
    """Do nothing until a time."""

    until_ns: int


@dataclass(frozen=True)
class Reopen:
    """Release the interface, close the device, open and claim it again."""


@dataclass(frozen=True)
class Alone:
    """Wait until no other hand's script is alone; from then on, be it, or be it no more.

    Two hands that are timed at once would time the kit.
    """

    alone: bool


Action = Out | In | Wait | Reopen | Alone
UsbSteps = Generator[Action, Observation, None]


@dataclass(frozen=True)
class Plan:
    """The phases and parameters of a run.

    :param burst: commands of each phase ``burst``.
    :param period: s between the commands of the other phases.
    :param buses: (bus, id) of each joint's motor.
    """

    side: Side
    burst: int = 200
    period: float = 1 / DEX3_1.command_rate
    buses: tuple[tuple[int, int], ...] = BUSES


class _NoAnswer(Exception):
    """The device has stopped answering: the script ends."""


class UsbScript(PhasedScript[Action, Observation, UsbPhase]):
    """The stimulus for one hand.

    :ivar trouble: why it ended early, or empty.
    :ivar finished: it went through to its last command, which locks every motor.
    """

    def __init__(self, plan: Plan, report: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(Observation(0), report)
        self.plan = plan
        self.trouble = ""
        self.finished = False
        self.joints = DEX3_1.joints[plan.side]
        self.size = 1234
        self.q: list[float] = []
        self._missed = 0

    def run(self) -> UsbSteps:
        """The whole script."""
        yield from self.wait(0.0)
        try:
            for part in parts_of(UsbScript):
                yield from part.play(self)
                if not self.q:
                    self.trouble = "the states lack a motor that is to be moved, or its bus and id"
                    break
            yield from self.exchange(self.lock_frame())
            self.finished = True
        except _NoAnswer:
            self.trouble = f"{_GIVE_UP} commands in a row were not answered"
        for phase in self.phases:
            phase.end_ns = phase.end_ns or self.obs.now_ns

    def lock_frame(self) -> bytes:
        """A frame that locks every motor; it may be sent at any time."""
        return self.frame(Motor())

    # -- one transfer ---------------------------------------------------------------------------

    def wait(self, seconds: float) -> UsbSteps:
        """Do nothing for so long."""
        yield from self.do(Wait(self.obs.now_ns + round(seconds * 1e9)))

    def wait_for_tick(self) -> UsbSteps:
        """Wait for the next tick; missed ticks are skipped."""
        self.next_ns = max(self.next_ns + round(self.plan.period * 1e9), self.obs.now_ns)
        yield from self.do(Wait(self.next_ns))

    def exchange(self, frame: bytes) -> UsbSteps:
        """Send one command and read one answer."""
        seen = yield from self.do(Out(frame))
        if not seen.status:
            seen = yield from self.do(In())
        if seen.status:
            self._missed += 1
            if self._missed >= _GIVE_UP:
                raise _NoAnswer
            return
        self._missed = 0
        self._store_answer(seen.data)

    def _store_answer(self, data: bytes) -> None:
        motors = {(m.bus, m.id): m.position for m in read_state(data).motors}
        if set(self.plan.buses) <= motors.keys():
            self.q = [
                motors[place] / Scale(joint.gear_ratio).q
                for place, joint in zip(self.plan.buses, self.joints, strict=True)
            ]

    def count_silent_frames(self, seconds: float) -> Generator[Action, Observation, int]:
        """Read without sending; return the number of frames received."""
        end, frames = self.obs.now_ns + round(seconds * 1e9), 0
        while self.obs.now_ns < end:
            seen = yield from self.do(In((end - self.obs.now_ns) / 1e9))
            if seen.status:
                break
            frames += 1
        yield from self.do(Wait(end))
        return frames

    # -- frames ---------------------------------------------------------------------------------

    def frame(
        self,
        motors: Motor | Sequence[Motor],
        *,
        size: int = 0,
        head: bytes = b"\xfe\xee",
        wrong_crc: bool = False,
        extra: Mapping[int, Sequence[bytes]] | None = None,
        **frame: Any,
    ) -> bytes:
        """Encode a frame for all motors, in the order of the joints; one command goes to all.

        :param head: of the motor packets; ``wrong_crc`` likewise.
        :param extra: more packets, by bus.
        :param frame: see :func:`pack_command`.
        """
        if isinstance(motors, Motor):
            motors = [motors] * len(self.joints)
        buses: dict[int, list[bytes]] = {}
        for motor, joint, (bus, number) in zip(motors, self.joints, self.plan.buses, strict=True):
            packet = motor_packet(number, motor, joint, head=head, spoil=wrong_crc)
            buses.setdefault(bus, []).append(packet)
        for bus, packets in (extra or {}).items():
            buses[bus] = [*buses.get(bus, ()), *packets]
        return pack_command(buses, size or self.size, **frame)

    def hold_commands(self, *, protect: bool = True) -> list[Motor]:
        """Return commands that hold every joint at its position."""
        return [Motor(1, q=q, kp=_KP, kd=_KD, protect=protect) for q in self.q]

    def goal_inward(self, joint: int, step: float = _STEP) -> float:
        """Return a goal one step toward the middle of the joint's range, rad."""
        spec = self.joints[joint]
        return self.q[joint] + (step if self.q[joint] < (spec.q_min + spec.q_max) / 2 else -step)

    def goals_inward(self, motors: Sequence[Motor]) -> list[Motor]:
        """Return the same commands with every goal one step toward the middle."""
        return [replace(m, q=self.goal_inward(i)) for i, m in enumerate(motors)]

    # -- phases ---------------------------------------------------------------------------------

    def begin(self, name: str, **params: Any) -> UsbPhase:
        """Begin a phase."""
        return self.mark(UsbPhase(name, self.obs.now_ns, params=params))

    def send_for(self, seconds: float, frame: bytes) -> UsbSteps:
        """Send the same command, once a tick."""

        def exchange() -> UsbSteps:
            yield from self.exchange(frame)
            yield from self.wait_for_tick()

        self.next_ns = self.obs.now_ns
        yield from self.repeat(seconds, exchange)

    def hold_still(self, seconds: float) -> UsbSteps:
        """Hold every joint; a time-out that has tripped is cleared first."""
        yield from self.exchange(self.frame(self.hold_commands(protect=False)))
        yield from self.send_for(seconds, self.frame(self.hold_commands()))
