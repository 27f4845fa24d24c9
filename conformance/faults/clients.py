"""Wrong clients: each sends one thing wrong to good hands, and only that must be found.

The hands' requirements that a wrong client spoils are blocked; none of them fails.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dexkit.conformance.faults.registry import Call, changes, takes_floats, wrong_hand
from dexkit.conformance.kit.motor_messages import LIMP, Motor
from dexkit.conformance.kit.recording import joints_of
from dexkit.conformance.virtual.client import ReferenceClient
from dexkit.hand import Side
from dexkit.models import ModeByte
from dexkit.teleop import Dex1Client, Pose, TeleopClient

# ------------------------------------------------------------------------------ form and values


@changes(ReferenceClient, "encoded", "DEX1-CLIENT-01", where=takes_floats)
def OneMotorTooMany(self: Any, encoded: Call, hands: Mapping[Side, list[Motor]]) -> Any:
    """Sends one motor more than the hand has."""
    return self.codec.encode_longer(hands, [LIMP])


@changes(ReferenceClient, "encoded", "DEX1-CLIENT-01")
def EmptyNowAndThen(self: Any, encoded: Call, hands: Mapping[Side, list[Motor]]) -> Any:
    """Sends every fiftieth command without a motor in it."""
    if self.turn % 50 == 0:
        return self.codec.encode_empty(list(hands))
    return encoded(hands)


@changes(ReferenceClient, "change", "DEX1-CLIENT-02")
def DividesByZero(self: Any, change: Call, side: Side, motors: list[Motor]) -> list[Motor]:
    """Sends NaN as the velocity of the last joint when the target rests."""
    if self.turn % 40:
        return motors
    return [*motors[:-1], replace(motors[-1], dq=math.nan)]


@changes(ReferenceClient, "change", "DEX1-CLIENT-03")
def SendsPercent(self: Any, change: Call, side: Side, motors: list[Motor]) -> list[Motor]:
    """Sends q as percent of each joint's range."""
    joints = joints_of(self.dialect, side)
    return [
        replace(m, q=100.0 * (m.q - j.q_min) / j.stroke)
        for m, j in zip(motors, joints, strict=True)
    ]


@changes(ReferenceClient, "change", "DEX1-CLIENT-03")
def SendsDegrees(self: Any, change: Call, side: Side, motors: list[Motor]) -> list[Motor]:
    """Sends q in degrees."""
    return [replace(m, q=math.degrees(m.q)) for m in motors]


@wrong_hand("DEX1-CLIENT-04")
class SendsNormalised(ReferenceClient):
    """Sends q from 0 to 1, and interprets states in the same way."""

    course = ((0, 0.0), (2.0, 1.0), (3.2, 0.0), (4.4, 1.0), (5.9, 1.0))

    def receive(self, now: float, q: Mapping[Side, Pose]) -> None:
        stroke = self.dialect.q_open
        super().receive(now, {s: tuple(stroke * x for x in pose) for s, pose in q.items()})

    def change(self, side: Side, motors: list[Motor]) -> list[Motor]:
        return [replace(m, q=m.q / self.dialect.q_open) for m in motors]


@wrong_hand("DEX1-CLIENT-09")
class SoftGains(ReferenceClient):
    """Sends a tenth of the usual gains."""

    factor = 0.1

    def change(self, side: Side, motors: list[Motor]) -> list[Motor]:
        return [replace(m, kp=self.factor * m.kp, kd=self.factor * m.kd) for m in motors]


@wrong_hand("DEX1-CLIENT-09")
class NoGains(SoftGains):
    """Leaves the gains 0."""

    factor = 0.0


@wrong_hand("DEX1-CLIENT-09")
class GainsOfTheMotor(SoftGains):
    """Sends ten times the usual gains."""

    factor = 10.0


@changes(ReferenceClient, "change", "DEX1-CLIENT-14", dialect="unitree_hg")
def GainsWithoutUse(self: Any, change: Call, side: Side, motors: list[Motor]) -> list[Motor]:
    """Sends gains in a dialect whose clients send 0."""
    return [replace(m, kp=5.0, kd=0.05) for m in motors]


@changes(ReferenceClient, "change", "DEX1-CLIENT-10")
def ModeOfAnotherProduct(self: Any, change: Call, side: Side, motors: list[Motor]) -> list[Motor]:
    """Sends the mode byte of another product."""
    kind = self.dialect.mode_byte
    return [
        replace(m, mode={ModeByte.UNUSED: 10, ModeByte.STATUS: 0x10 | i}.get(kind, 1))
        for i, m in enumerate(motors)
    ]


# ----------------------------------------------------------------------------------------- time


@changes(ReferenceClient, "sends", "DEX1-CLIENT-05")
def FiveHertz(self: Any, sends: Call, now: float) -> Any:
    """Sends 5 commands a second."""
    return self.turn % round(self.rate / 5) == 0


@changes(ReferenceClient, "sends", "DEX1-CLIENT-05")
def SlowsDown(self: Any, sends: Call, now: float) -> bool:
    """Sends 10 commands a second for 1.5 s; the mean of the session is good."""
    return not 2.3 <= now < 3.8 or self.turn % round(self.rate / 10) == 0


@changes(ReferenceClient, "sends", "DEX1-CLIENT-05")
def HalfRateClient(self: Any, sends: Call, now: float) -> Any:
    """Sends every second command."""
    return self.turn % 2 == 0


@changes(ReferenceClient, "sends", "DEX1-CLIENT-05")
def Stutters(self: Any, sends: Call, now: float) -> bool:
    """Sends nothing for 0.25 s, twice."""
    return not (2.0 <= now < 2.25 or 4.5 <= now < 4.75)


# --------------------------------------------------------------------------------------- motion


@changes(ReferenceClient, "make_client", "DEX1-CLIENT-08")
def JumpsToTheTarget(self: Any, make_client: Call) -> TeleopClient:
    """Sends the operator's target without a limit to the step."""
    return Dex1Client(self.dialect, self.sides, simulated=True)


@changes(ReferenceClient, "messages", "DEX1-CLIENT-11")
def TwoClients(self: Any, messages: Call, now: float) -> Any:
    """A second client commands the same hands to another pose, alternating with the first."""
    first = messages(now)
    if not first:
        return []
    rival = {
        side: [
            # on the other side of the last state
            replace(m, q=m.q - math.copysign(0.03 * joint.stroke, m.q - state))
            for m, joint, state in zip(
                motors, joints_of(self.dialect, side), self.q[side], strict=True
            )
        ]
        for side, motors in self.motors(now).items()
    }
    return [*first, *self.encoded(rival)]


# -------------------------------------------------------------------------------- begin and end


@wrong_hand("DEX1-CLIENT-12")
class Blind(ReferenceClient):
    """Sends to the right hand before that has published a state."""

    right_up_s = 1.5

    def receive(self, now: float, q: Mapping[Side, Pose]) -> None:
        self.q.update(q)
        if len(self.q) == len(self.sides):
            self.client.receive(now, q)

    def motors(self, now: float) -> dict[Side, list[Motor]]:
        found = super().motors(now)
        left = self.q.get(Side.LEFT)
        if found or left is None:
            return found
        twin = self.make_client()
        twin.receive(now, {Side.LEFT: left, Side.RIGHT: left})
        joints = twin.step(now, {}, {})
        return {s: [Motor(**j._asdict()) for j in command] for s, command in joints.items()}


@wrong_hand("DEX1-CLIENT-13")
class Killed(ReferenceClient):
    """Ends while the hands close."""

    seconds = 3.9
