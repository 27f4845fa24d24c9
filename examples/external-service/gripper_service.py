"""A gripper on Unitree's Dex1 topics that knows nothing of dexkit: plain CycloneDDS 0.10.

    python gripper_service.py left --domain 1

The whole contract of a Dex1 is in :class:`Gripper` and :func:`serve`. Replace the pretended motor
by yours, or write the same in your language: types and topics are those below.
"""

import argparse
import math
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import array, float32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

OPEN = 5.4  # rad of q; closed is 0
RATE = 500.0  # states a second
SILENCE = 1.0  # s without a command after which it brakes
TOP_SPEED = 8.0  # rad/s
RELIABLE = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)))
NETWORK = (
    '<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface name="{}" '
    'priority="default" multicast="default"/></Interfaces></General></Domain></CycloneDDS>'
)


@dataclass
@final
@autoid("sequential")
class MotorCmd(IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    """What a client asks of one motor: tau = kp (q - q_now) + kd (dq - dq_now) + tau."""

    mode: uint8
    q: float32
    dq: float32
    tau: float32
    kp: float32
    kd: float32
    reserve: array[uint32, 3]


@dataclass
@final
@autoid("sequential")
class MotorCmds(IdlStruct, typename="unitree_go.msg.dds_.MotorCmds_"):
    """A command: one motor for a gripper."""

    cmds: sequence[MotorCmd]


@dataclass
@final
@autoid("sequential")
class MotorState(IdlStruct, typename="unitree_go.msg.dds_.MotorState_"):
    """One motor: rad, rad/s, N m; what is not known is 0, never NaN."""

    mode: uint8
    q: float32
    dq: float32
    ddq: float32
    tau_est: float32
    q_raw: float32
    dq_raw: float32
    ddq_raw: float32
    temperature: uint8
    lost: uint32
    reserve: array[uint32, 2]


@dataclass
@final
@autoid("sequential")
class MotorStates(IdlStruct, typename="unitree_go.msg.dds_.MotorStates_"):
    """A state: one motor for a gripper."""

    states: sequence[MotorState]


class Gripper:
    """A pretended gripper: it follows q with a limited speed and meets nothing on its way."""

    def __init__(self) -> None:
        self.q, self.dq = 0.2 * OPEN, 0.0
        self._command: MotorCmd | None = None
        self._since = -math.inf

    def obey(self, message: MotorCmds, now: float) -> None:
        """Take a command, unless it is empty or not finite: then the one before stays in force."""
        if message.cmds:
            c = message.cmds[0]
            if all(map(math.isfinite, (c.q, c.dq, c.tau, c.kp, c.kd))):
                self._command, self._since = c, now

    def live(self, now: float, dt: float) -> MotorState:
        """Move on by ``dt`` seconds, and say where it is."""
        driven = self._command is not None and now - self._since < SILENCE
        self.dq = 0.0
        if driven and self._command is not None:
            self.dq = min(max(self._speed(self._command), -TOP_SPEED), TOP_SPEED)
        before, self.q = self.q, min(max(self.q + self.dq * dt, 0.0), OPEN)
        self.dq = (self.q - before) / dt
        return MotorState(int(driven), self.q, self.dq, 0, 0, 0, 0, 0, 25, 0, [0, 0])

    def _speed(self, c: MotorCmd) -> float:
        """Speed towards q; without kp, that at which kd balances dq and tau; without both, 0."""
        if c.kp > 0:
            return 30.0 * (min(max(c.q, 0.0), OPEN) - self.q)
        return c.dq + c.tau / c.kd if c.kd > 0 else 0.0


def serve(side: str, domain: int, interface: str) -> None:
    """Publish the state at a fixed rate, from the first moment on, whoever listens."""
    network = Domain(domain, NETWORK.format(interface))  # alive as long as it is referred to
    participant = DomainParticipant(domain)
    states = DataWriter(
        participant, Topic(participant, f"rt/dex1/{side}/state", MotorStates), RELIABLE
    )
    # best effort, as Unitree's readers: a reader must not ask for more than clients offer
    commands = DataReader(participant, Topic(participant, f"rt/dex1/{side}/cmd", MotorCmds))
    gripper, due = Gripper(), time.monotonic()
    print(f"ready: {side} gripper on domain {domain}, {interface}", flush=True)
    while network:
        for message in commands.take(10):
            if isinstance(message, MotorCmds):  # a client that leaves sends an "invalid sample"
                gripper.obey(message, time.monotonic())
        states.write(MotorStates([gripper.live(due, 1 / RATE)]))
        due += 1 / RATE  # deadlines, not pauses: lateness does not add up
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A pretended Dex1 gripper on DDS.")
    parser.add_argument("side", choices=["left", "right"])
    parser.add_argument("--domain", type=int, default=1)
    parser.add_argument("--interface", default="lo")
    options = parser.parse_args()
    try:
        serve(options.side, options.domain, options.interface)
    except KeyboardInterrupt:
        pass
