"""Find out which command frame a Dex3-1 accepts, without motion.

The frames lock motors or leave one limp; with zero gains nothing is driven. Frame sizes and heads
that the manual allows are tried in turn until one is both answered and obeyed. A motor shows that
it obeys by the status in its next state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from dexkit.errors import HandRefused, HandTimeout, WireError
from dexkit.hand import JointMode
from dexkit.wire.dex3_usb import (
    BROADCAST_ID,
    COMMAND_HEAD,
    COMMAND_LAYOUTS,
    N_BUSES,
    CommandFrame,
    CommandLayout,
    MotorCmd,
    SensorCmd,
    StateFrame,
    pack_command,
    parse_state,
)

__all__ = ["Found", "Wire", "probe"]

Wire = Callable[[bytes], bytes]
"""Sends a frame and returns the answer; raises :class:`~dexkit.errors.HandTimeout` without one."""

Place = tuple[int, int]

HEADS = (COMMAND_HEAD, b"\xfc\xfd", b"\xeb\x90")
"""Heads of the command frame that are tried: by analogy, as in the state frame, and of a public
sample (docs/sources/unitree-dex.md#c5)."""
_TRIES = 3
_IDS_AT_ONCE = 7
"""Packets of 20 bytes that fit the smaller bus buffer."""
_POLLED_IDS = range(4)
"""Sensors of a bus, if the manual's "3+4" means three motors and four sensors."""


@dataclass
class Found:
    """Result of the probe.

    :ivar obeyed: a motor took the status that it was sent.
    :ivar model_code: ``mode[0]`` of the state frame.
    :ivar poll_sensors: sensors answer only where they are addressed; None if none answers.
    """

    layout: CommandLayout
    head: bytes
    motors: tuple[Place, ...] = ()
    sensors: tuple[Place, ...] = ()
    poll_sensors: bool | None = None
    obeyed: bool = False
    model_code: int = 0
    tried: list[str] = field(default_factory=list)

    def frame(
        self, motors: Mapping[Place, MotorCmd], sensors: Iterable[Place] | None = None
    ) -> bytes:
        """A command frame; by default it addresses the sensors if they have to be."""
        buses: list[list[MotorCmd | SensorCmd]] = [[] for _ in range(N_BUSES)]
        for (bus, _), packet in motors.items():
            buses[bus].append(packet)
        if sensors is None:
            sensors = self.sensors if self.poll_sensors else ()
        for bus, number in sensors:
            buses[bus].append(SensorCmd(number))
        return pack_command(CommandFrame(buses, head=self.head), self.layout)


def lock(number: int) -> MotorCmd:
    """The packet that locks a motor and clears a protection that has tripped."""
    return MotorCmd(number, int(JointMode.BRAKE), False, 0, 0, 0, 0, 0)


def _limp(number: int) -> MotorCmd:
    # without bit 7: a motor that is not driven needs no protection
    return MotorCmd(number, int(JointMode.FOC), False, 0, 0, 0, 0, 0)


def probe(wire: Wire) -> Found:
    """Find frame, head, motors and sensors of a hand.

    :raises HandTimeout: no frame is answered.
    :raises HandRefused: it answers, and no motor obeys.
    :raises HandLost: it goes away meanwhile.
    """
    tried: list[str] = []
    silent = True
    for layout in COMMAND_LAYOUTS:
        for head in HEADS:
            found = Found(layout, head)
            text = f"{layout.name} bytes, head {head.hex()}"
            try:
                _find_motors(wire, found)
            except HandTimeout:
                tried.append(f"{text}: no answer")
                continue
            silent = False
            if found.motors and _obeys(wire, found):
                found.obeyed = True
                tried.append(f"{text}: obeyed")
                _find_sensors(wire, found)
                found.tried = tried
                return found
            tried.append(f"{text}: answered, {'not obeyed' if found.motors else 'no motor'}")
    if silent:
        raise HandTimeout(
            "the hand answers no command frame: " + "; ".join(tried),
            hint="is its power on? docs/first-contact.md",
        )
    raise HandRefused(
        "the hand answers, and no motor obeys: " + "; ".join(tried),
        hint="please report this line: the frame differs from all readings of the manual",
    )


def _exchange(wire: Wire, frame: bytes) -> StateFrame | None:
    """Send a frame and return its answer; repeat if it was lost or damaged.

    :raises HandTimeout: there is none.
    """
    for left in reversed(range(_TRIES)):
        try:
            wire(frame)
            # an answer may have been made before its command was obeyed: the second tells
            return parse_state(wire(frame))
        except HandTimeout:
            if not left:
                raise
        except WireError:
            continue
    return None


def _find_motors(wire: Wire, found: Found) -> None:
    """Lock every id of every bus, and collect those that answer."""
    heard: set[Place] = set()
    for first in range(0, BROADCAST_ID, _IDS_AT_ONCE):
        ids = range(first, min(first + _IDS_AT_ONCE, BROADCAST_ID))
        packets = {(bus, number): lock(number) for bus in range(N_BUSES) for number in ids}
        answer = _exchange(wire, found.frame(packets))
        if answer is not None:
            heard |= {(bus, motor.id) for bus, motor in answer.motors}
            found.model_code = answer.model
    found.motors = tuple(sorted(heard))


def _obeys(wire: Wire, found: Found) -> bool:
    """Whether the status of a motor follows the frame: limp, then locked again."""
    place = found.motors[0]
    locked = {(bus, number): lock(number) for bus, number in found.motors}
    seen = []
    for packet in (_limp(place[1]), lock(place[1])):
        answer = _exchange(wire, found.frame({**locked, place: packet}))
        states = {} if answer is None else {(b, m.id): m.status for b, m in answer.motors}
        seen.append(states.get(place))
    return seen == [int(JointMode.FOC), int(JointMode.BRAKE)]


def _find_sensors(wire: Wire, found: Found) -> None:
    """Find the sensors that answer: first unasked, then when they are addressed."""
    locked = {(bus, number): lock(number) for bus, number in found.motors}
    every = [(bus, number) for bus in range(N_BUSES) for number in _POLLED_IDS]
    for polled, asked in ((False, []), (True, every)):
        answer = _exchange(wire, found.frame(locked, asked))
        heard = {(bus, s.id) for bus, s in answer.sensors} if answer is not None else set()
        if heard:
            found.sensors, found.poll_sensors = tuple(sorted(heard)), polled
            return
