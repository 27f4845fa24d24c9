"""Measure the full-stroke time under xr_teleoperate's limit, for several state rates.

The client clips each command to 0.18 rad from the last reported position and smooths it over
three values (docs/sources/unitree-dex.md#b1, docs/sources/unitree-dex.md#b7), so what is reported
late is commanded slowly. The gripper is the emulated MX-64 with an EZGripper on it, in virtual
time; between it and the client stand the service's own rules (HandCore) with exchanges at each
rate, with and without the predictor. The peer is the same gripper sent to the end of its stroke in
one command.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import count

from benchmarks import Result
from dexkit.clock import ManualClock
from dexkit.drivers.ezgripper.scaling import current_of_effort, joint_of_ticks, ticks_of_joint
from dexkit.emulators.mx64 import Firmware, GripperMechanics, Physics, Servo
from dexkit.hand import HandCommand, HandState, Side
from dexkit.models import DEX1_1
from dexkit.service.hand_core import Estimation, HandCore
from dexkit.wire import dynamixel as dxl
from dexkit.wire import mx64
from dexkit.wire.dynamixel import Instruction, Packet

_ZERO = 1510
_EFFORT = 50.0  # percent, the driver's default while moving
_LEAD = 0.18  # rad (docs/sources/unitree-dex.md#b3)
_WEIGHTS = (0.5, 0.3, 0.2)  # newest first (docs/sources/unitree-dex.md#b1)
_FROM, _TO = 0.05, 0.95  # of the stroke: where the time is taken
_STROKE = DEX1_1.joints[Side.LEFT][0].stroke
_TICK = 0.5e-3  # seconds of virtual time
_GIVE_UP = 60.0


class VirtualGripper:
    """The emulated servo without a line: registers are written and read at once."""

    def __init__(self, clock: ManualClock) -> None:
        self._clock = clock
        self.servo = Servo(
            1,
            baudrate=1_000_000,
            firmware=Firmware(current_noise=0.0),
            physics=Physics(gripper=GripperMechanics(closed_at=_ZERO, start=0.0)),
        )
        for item, value in (
            (mx64.OPERATING_MODE, mx64.OperatingMode.CURRENT_BASED_POSITION),
            (mx64.CURRENT_LIMIT, current_of_effort(100)),
            (mx64.TORQUE_ENABLE, 1),
            (mx64.GOAL_CURRENT, current_of_effort(_EFFORT)),
        ):
            self._write(item, value)
        self._origin = clock.now() - self.servo.now

    def _write(self, item: mx64.Item, value: int) -> None:
        params = item.address.to_bytes(2, "little") + item.encode(value)
        status = self.servo.handle(Packet(1, Instruction.WRITE, params))
        assert status is not None
        assert dxl.decode(status).error == 0, item

    @property
    def q(self) -> float:
        """Position now, rad."""
        self.servo.advance_to(self._clock.now() - self._origin)
        params = bytes([mx64.PRESENT_POSITION.address, 0, mx64.PRESENT_POSITION.size, 0])
        status = self.servo.handle(Packet(1, Instruction.READ, params))
        assert status is not None
        ticks = mx64.PRESENT_POSITION.decode(dxl.decode(status).data)
        return joint_of_ticks(ticks - _ZERO)

    def exchange(self, command: HandCommand) -> HandState:
        """As the driver does: a goal in, a position out."""
        q = self.q
        if not command.is_brake:
            self._write(mx64.GOAL_POSITION, _ZERO + ticks_of_joint(float(command.q[0])))
        return HandState.from_values(q, stamp=self._clock.now())


class TeleopClient:
    """The command rule of xr_teleoperate's Dex1 controller."""

    def __init__(self, target: float) -> None:
        self._target = target
        self._recent: deque[float] = deque(maxlen=len(_WEIGHTS))

    def command(self, reported: float) -> float:
        """The next command, 200 times a second, from the last reported position."""
        goal = min(max(self._target, reported - _LEAD), reported + _LEAD)
        # an equal value is skipped (docs/sources/unitree-dex.md#b7)
        if not self._recent or goal != self._recent[0]:
            self._recent.appendleft(goal)
        if len(self._recent) < len(_WEIGHTS):
            return goal
        return sum(w * x for w, x in zip(_WEIGHTS, self._recent, strict=True))


def direct_time(target: float = _STROKE) -> float:
    """Seconds from 5 to 95 % when the end is commanded at once."""
    clock = ManualClock()
    gripper = VirtualGripper(clock)
    gripper.exchange(HandCommand.position(target))
    return _stroke_time(clock, gripper, lambda step: None)


def teleop_time(exchange_rate: float, estimation: Estimation, speed: float | None = None) -> float:
    """Seconds from 5 to 95 % under the client's rule.

    :param exchange_rate: exchanges a second between service and gripper.
    :param speed: calibrated speed for the estimator, rad/s.
    """
    clock = ManualClock()
    gripper = VirtualGripper(clock)
    spec = DEX1_1.spec(Side.LEFT, io_rate=exchange_rate)
    core = HandCore(spec, DEX1_1, clock, estimation=estimation, soft_start=False)
    core.opened(spec, [(speed, speed)] if speed is not None else None)
    client = TeleopClient(_STROKE)
    every = {
        name: round(1 / rate / _TICK)
        for name, rate in (
            ("exchange", exchange_rate),
            ("publish", DEX1_1.state_rate),
            ("command", DEX1_1.command_rate),
        )
    }
    reported = [gripper.q]

    def step(i: int) -> None:
        if i % every["exchange"] == 0:
            core.measured(gripper.exchange(core.next_command()))
        if i % every["publish"] == 0:
            view = core.view()
            assert view is not None
            reported[0] = float(view.state.q[0])
        if i % every["command"] == 0:
            core.submit(HandCommand.position(client.command(reported[0])))

    return _stroke_time(clock, gripper, step)


def _stroke_time(
    clock: ManualClock, gripper: VirtualGripper, step: Callable[[int], object]
) -> float:
    started: float | None = None
    for i in count():
        step(i)
        clock.advance(_TICK)
        if i % 2:
            continue
        q = gripper.q
        if started is None and q >= _FROM * _STROKE:
            started = clock.now()
        if started is not None and q >= _TO * _STROKE:
            return clock.now() - started
        if clock.now() > _GIVE_UP:
            return float("inf")
    raise AssertionError


def run() -> list[Result]:
    limit = direct_time()
    speed = (_TO - _FROM) * _STROKE / limit
    rows: list[tuple[str, float, Estimation]] = [
        ("5 Hz feedback, as it comes", 5.0, Estimation.OFF),
        ("30 Hz feedback, as it comes", 30.0, Estimation.OFF),
        ("200 Hz feedback, as it comes", 200.0, Estimation.OFF),
        ("400 Hz feedback, as it comes", 400.0, Estimation.OFF),
        ("5 Hz feedback, predicted between", 5.0, Estimation.PREDICT),
        ("30 Hz feedback, predicted between", 30.0, Estimation.PREDICT),
    ]
    results: list[Result] = []
    for name, rate, estimation in rows:
        seconds = teleop_time(rate, estimation, speed)
        results.append(
            Result(
                name=f"full stroke, {name}",
                value=seconds,
                unit="s",
                peer="the gripper alone",
                peer_value=limit,
                ratio=limit / seconds,
                note="" if results else f"5 to 95 % of the stroke; predictor at {speed:.1f} rad/s",
            )
        )
    return results
