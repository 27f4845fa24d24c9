"""The stimulus for one hand on USB, as a script; see :mod:`dexkit.conformance.kit.phased_script`.

Order of the phases: what may disturb a hand comes after what needs it undisturbed. Commands that
move something enable the time-out protection, except where its absence is tested. A player that
ends the script early sends :meth:`UsbScript.lock_frame`; one that is killed cannot
(docs/conformance-usb.md says in which state it leaves the hand).

============== =====================================================================================
quiet          no command is sent; nothing may come
exchange       20 commands to lock, at 100 Hz, each answered; then nothing more may come
burst          commands to lock as fast as they are answered; three times, at different moments
pair           two commands at once
move           each motor in turn to a new position, by 0.2 rad; the others hold
lock           position commands with status 0: nothing may move
malformed      damaged frames that ask every motor to move; their kind is ``params["kind"]``
broadcast      one packet with id 15 on the middle finger's bus
short          the other size of the command frame, with a small step of the index finger
pause          0.6 s without a command, protected: too short to trip
drive          the middle finger by a velocity, protected; the index finger slowly, unprotected
silence        1.5 s without a command
tripped        position commands with the protection still enabled
clear          the same with bit 7 = 0
reopen         the interface is released and claimed again; the hand holds
============== =====================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dexkit.conformance.kit.phased_script import PhasedScript
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
from dexkit.wire.dex3_usb import BROADCAST_ID

__all__ = [
    "BUSES",
    "DAMAGES",
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
    "Wait",
]

BUSES: tuple[tuple[int, int], ...] = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 1))
"""(bus, id) of each joint's motor: thumb, middle, index. The manual's figure of it is lost, and
this is assumed (docs/sources/unitree-dex.md#c7)."""
DAMAGES: dict[str, str] = {
    "frame-crc": "a frame with a wrong CRC",
    "packet-crc": "motor packets with a wrong CRC",
    "packet-head": "motor packets with a wrong head",
    "truncated": "the first 1000 bytes of a frame",
    "over-long": "a frame with 66 more bytes",
    "size-241": "a cmd_size one byte past its buffer",
    "size-huge": "a cmd_size of 4294967295",
    "wrong-id": "a packet for motor 9 of a bus with two motors",
}
"""The phases ``malformed`` by ``params["kind"]``."""
DRIVEN, FREE = 3, 5
"""Joints of the time-out test: middle_0 is driven with protection, index_0 without."""
ANSWER_TIMEOUT = 1.0  # s; IN timeout of the manual's code (the Dex3-1 manual receiveState)
_STEP = 0.2  # rad
_KP, _KD = 1.5, 0.1  # grip of the vendor's C++ example (docs/sources/unitree-dex.md#b1)
_SPEED = 0.4  # rad/s
_GIVE_UP = 3  # commands in a row without an answer
_SETTLE = 0.08  # s in which an accepted step is seen, and a late answer comes
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
Steps = Generator[Action, Observation, None]


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
        self._joints = DEX3_1.joints[plan.side]
        self._size = 1234
        self._q: list[float] = []
        self._missed = 0

    def run(self) -> Steps:
        """The whole script."""
        yield from self._wait(0.0)
        try:
            yield from self._exchange_phase()
            if self._all_motors_known():
                yield from self._motion()
                yield from self._damage()
                yield from self._protection()
                yield from self._burst()
                yield from self._reopen()
            yield from self._exchange(self.lock_frame())
            self.finished = True
        except _NoAnswer:
            self.trouble = f"{_GIVE_UP} commands in a row were not answered"
        for phase in self.phases:
            phase.end_ns = phase.end_ns or self.obs.now_ns

    def lock_frame(self) -> bytes:
        """A frame that locks every motor; it may be sent at any time."""
        return self._frame(Motor())

    # -- one transfer ---------------------------------------------------------------------------

    def _wait(self, seconds: float) -> Steps:
        yield from self.do(Wait(self.obs.now_ns + round(seconds * 1e9)))

    def _wait_for_tick(self) -> Steps:
        """Wait for the next tick; missed ticks are skipped."""
        self.next_ns = max(self.next_ns + round(self.plan.period * 1e9), self.obs.now_ns)
        yield from self.do(Wait(self.next_ns))

    def _exchange(self, frame: bytes) -> Steps:
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
            self._q = [
                motors[place] / Scale(joint.gear_ratio).q
                for place, joint in zip(self.plan.buses, self._joints, strict=True)
            ]

    def _count_silent_frames(self, seconds: float) -> Generator[Action, Observation, int]:
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

    def _frame(
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
            motors = [motors] * len(self._joints)
        buses: dict[int, list[bytes]] = {}
        for motor, joint, (bus, number) in zip(motors, self._joints, self.plan.buses, strict=True):
            packet = motor_packet(number, motor, joint, head=head, spoil=wrong_crc)
            buses.setdefault(bus, []).append(packet)
        for bus, packets in (extra or {}).items():
            buses[bus] = [*buses.get(bus, ()), *packets]
        return pack_command(buses, size or self._size, **frame)

    def _hold_commands(self, *, protect: bool = True) -> list[Motor]:
        """Return commands that hold every joint at its position."""
        return [Motor(1, q=q, kp=_KP, kd=_KD, protect=protect) for q in self._q]

    def _goal_inward(self, joint: int, step: float = _STEP) -> float:
        """Return a goal one step toward the middle of the joint's range, rad."""
        spec = self._joints[joint]
        return self._q[joint] + (step if self._q[joint] < (spec.q_min + spec.q_max) / 2 else -step)

    def _goals_inward(self, motors: Sequence[Motor]) -> list[Motor]:
        """Return the same commands with every goal one step toward the middle."""
        return [replace(m, q=self._goal_inward(i)) for i, m in enumerate(motors)]

    # -- phases ---------------------------------------------------------------------------------

    def _begin_phase(self, name: str, **params: Any) -> UsbPhase:
        return self.mark(UsbPhase(name, self.obs.now_ns, params=params))

    def _send_for(self, seconds: float, frame: bytes) -> Steps:
        """Send the same command, once a tick."""

        def exchange() -> Steps:
            yield from self._exchange(frame)
            yield from self._wait_for_tick()

        self.next_ns = self.obs.now_ns
        yield from self.repeat(seconds, exchange)

    def _exchange_phase(self) -> Steps:
        self.report("exchanging frames without motion")
        yield from self._count_silent_frames(0.1)  # reads what another program has left unread
        phase = self._begin_phase("quiet")
        yield from self._count_silent_frames(0.15)
        self.end(phase)
        yield from self._probe()

        frame = self._frame(Motor())
        phase = self._begin_phase("exchange", status=0, size=self._size)
        yield from self._send_for(20 * self.plan.period, frame)
        yield from self._count_silent_frames(0.05)
        self.end(phase)

        yield from self._burst()
        phase = self._begin_phase("pair")
        for _ in range(2):
            yield from self.do(Out(frame))
        phase.params["answers"] = yield from self._count_silent_frames(0.1)
        self.end(phase)
        yield from self._exchange(frame)

    def _burst(self) -> Steps:
        frame = self._frame(Motor())
        yield from self.do(Alone(True))
        phase = self._begin_phase("burst", status=0)
        for _ in range(self.plan.burst):
            yield from self._exchange(frame)
        self.end(phase)
        yield from self.do(Alone(False))

    def _probe(self) -> Steps:
        """Find the size of command frame that the hand answers."""
        for size in (1234, 734):
            self._size = size
            phase = self._begin_phase("probe", size=size)
            yield from self.do(Out(self._frame(Motor())))
            seen = yield from self.do(In())
            self.end(phase)
            if not seen.status:
                return
        self._size = 1234

    def _all_motors_known(self) -> bool:
        if not self._q:
            self.trouble = "the states lack a motor that is to be moved, or its bus and id"
        return bool(self._q)

    def _motion(self) -> Steps:
        self.report("moving one joint at a time by 0.2 rad")
        hold = self._hold_commands()
        yield from self._send_for(0.05, self._frame(hold))
        for joint in range(len(self._joints)):
            target = self._goal_inward(joint)
            phase = self._begin_phase(
                "move", joint=joint, begin=self._q[joint], target=target, status=1
            )
            hold[joint] = replace(hold[joint], q=target)
            yield from self._send_for(0.2, self._frame(hold))
            self.end(phase)

        locked = [replace(m, status=0) for m in self._goals_inward(self._hold_commands())]
        yield from self._send_for(0.05, self._frame(Motor(protect=True)))
        phase = self._begin_phase("lock", status=0)
        yield from self._send_for(0.2, self._frame(locked))
        self.end(phase)
        yield from self._burst()

    def _hold_still(self, seconds: float) -> Steps:
        """Hold every joint; a time-out that has tripped is cleared first."""
        yield from self._exchange(self._frame(self._hold_commands(protect=False)))
        yield from self._send_for(seconds, self._frame(self._hold_commands()))

    def _damaged(self, kind: str) -> bytes:
        hold = self._hold_commands()
        wish = self._goals_inward(hold)
        if kind == "frame-crc":
            return self._frame(wish, spoil=True)
        if kind == "packet-crc":
            return self._frame(wish, wrong_crc=True)
        if kind == "packet-head":
            return self._frame(wish, head=b"\xfe\xed")
        if kind == "truncated":
            whole = self._frame(wish)
            return whole[: min(1000, len(whole) - 34)]
        if kind == "over-long":
            return self._frame(wish) + bytes(66)
        bus, _ = self.plan.buses[DRIVEN]
        mine = [i for i, place in enumerate(self.plan.buses) if place[0] == bus]
        if kind == "wrong-id":
            joint = self._joints[DRIVEN]
            stray = motor_packet(9, wish[DRIVEN], joint)
            return self._frame(hold, extra={bus: [stray]})
        # the goals are on the bus whose size is wrong
        mixed = [wish[i] if i in mine else hold[i] for i in range(len(hold))]
        size = 0xFFFFFFFF if kind == "size-huge" else (240 if self._size == 1234 else 140) + 1
        return self._frame(mixed, sizes={bus: size})

    def _damage(self) -> Steps:
        self.report("damaged frames: nothing may move")
        for kind in DAMAGES:
            yield from self._hold_still(0.03)
            phase = self._begin_phase("malformed", kind=kind)
            yield from self.do(Out(self._damaged(kind)))
            phase.params["answers"] = yield from self._count_silent_frames(_SETTLE)
            hold = self._frame(self._hold_commands())
            for _ in range(3):
                yield from self._exchange(hold)
            self.end(phase)
        yield from self._broadcast()
        yield from self._short()

    def _broadcast(self) -> Steps:
        yield from self._hold_still(0.05)
        hold = self._hold_commands()
        bus, _ = self.plan.buses[DRIVEN]
        # one position for all motors of the bus: that of the first, a little inward
        target = self._goal_inward(DRIVEN, 0.15)
        begin = list(self._q)
        order = motor_packet(BROADCAST_ID, replace(hold[DRIVEN], q=target), self._joints[DRIVEN])
        elsewhere: dict[int, list[bytes]] = {bus: [order]}
        for i, (place, number) in enumerate(self.plan.buses):
            if place != bus:
                elsewhere.setdefault(place, []).append(
                    motor_packet(number, hold[i], self._joints[i])
                )
        phase = self._begin_phase("broadcast", bus=bus, target=target, begin=begin)
        yield from self.do(Out(pack_command(elsewhere, self._size)))
        phase.params["answers"] = yield from self._count_silent_frames(0.2)
        yield from self._exchange(self._frame(self._hold_commands()))
        self.end(phase)

    def _short(self) -> Steps:
        size = 734 if self._size == 1234 else 1234
        joint = len(self._joints) - 1
        yield from self._hold_still(0.05)
        hold = self._hold_commands()
        target = self._goal_inward(joint)
        phase = self._begin_phase(
            "short", size=size, joint=joint, begin=self._q[joint], target=target
        )
        hold[joint] = replace(hold[joint], q=target)
        yield from self.do(Out(self._frame(hold, size=size)))
        phase.params["answers"] = yield from self._count_silent_frames(0.2)
        yield from self._exchange(self._frame(self._hold_commands()))
        self.end(phase)

    def _protection(self) -> Steps:
        self.report("time-out protection: a pause, then 1.5 s of silence while a finger moves")
        spec = self._joints[DRIVEN]
        hold = self._hold_commands()
        yield from self._exchange(self._frame(self._hold_commands(protect=False)))
        # a place with room for what an unprotected hand would do in the silence
        open_end = spec.q_min if spec.closing > 0 else spec.q_max
        start = open_end + spec.closing * 0.25
        hold[DRIVEN] = replace(hold[DRIVEN], q=start)
        yield from self._send_for(0.35, self._frame(hold))

        yield from self._send_for(0.03, self._frame(self._hold_commands()))
        phase = self._begin_phase("pause", seconds=0.6)
        yield from self._wait(0.6)
        yield from self._exchange(self._frame(self._hold_commands()))
        self.end(phase)
        yield from self._exchange(self._frame(self._hold_commands(protect=False)))

        motors = self._hold_commands()
        motors[DRIVEN] = Motor(1, dq=spec.closing * _SPEED, kd=_KD, protect=True)
        motors[FREE] = Motor(1, dq=self._joints[FREE].closing * _SPEED / 2, kd=_KD)
        phase = self._begin_phase("drive")
        yield from self._send_for(0.4, self._frame(motors))
        self.end(phase)

        phase = self._begin_phase("silence", seconds=1.5)
        yield from self._wait(1.5)
        self.end(phase)

        # the first answer has the positions; goals elsewhere come after it
        phase = self._begin_phase("tripped")
        yield from self._exchange(self._frame(motors))
        motors = self._hold_commands()
        motors[FREE] = replace(motors[FREE], protect=False)
        for joint in (DRIVEN, FREE):
            motors[joint] = replace(motors[joint], q=self._goal_inward(joint))
        phase.params["begin"] = list(self._q)
        phase.params["targets"] = [m.q for m in motors]
        yield from self._send_for(0.25, self._frame(motors))
        self.end(phase)

        free = [replace(m, protect=False) for m in self._hold_commands()]
        free[DRIVEN] = replace(free[DRIVEN], q=self._goal_inward(DRIVEN))
        phase = self._begin_phase("clear", begin=self._q[DRIVEN], target=free[DRIVEN].q)
        yield from self._send_for(0.25, self._frame(free))
        self.end(phase)

    def _reopen(self) -> Steps:
        self.report("releasing the interface and claiming it again")
        hold = self._frame(self._hold_commands())
        yield from self._exchange(hold)
        phase = self._begin_phase("reopen")
        yield from self.do(Reopen())
        for _ in range(5):
            yield from self._exchange(hold)
            yield from self._wait_for_tick()
        self.end(phase)
