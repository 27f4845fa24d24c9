"""Test that hands which a client can use in place of the original are not failed.

Each is a change of a model's reference hand that its maker may make: another motor, other sensors,
less of what is optional. Makers claim what such a hand has, and nothing else.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import pytest

from dexkit.conformance.checks import Outcome
from dexkit.conformance.faults.generated import Fault, Generated
from dexkit.conformance.faults.trials import plan_for
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.kit.requirements import CAPABILITIES, catalogue
from dexkit.conformance.kit.results import Result, RunResult, Verdict
from dexkit.conformance.kit.verdicts import Excuse, Judgement
from dexkit.conformance.virtual import MemoryTrace, Service, run_virtual
from dexkit.conformance.virtual.dex5 import Dex5Hand, Dex5Service
from dexkit.conformance.virtual.fingers import Dex3Hand, Dex3Service, FingerHand
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.conformance.virtual.inspire import FtpHand, FtpService, InspireService
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import dialect
from dexkit.traces import open_trace, sample_path
from tests.each import each

BOTH = (Side.LEFT, Side.RIGHT)
RIGHT = (Side.RIGHT,)
FTP = dialect("inspire_ftp")
BY_ID = {r.id: r for r in catalogue(None, None)}


# ---------------------------------------------------------------------------------------- grippers


class ServoHand(ReferenceHand):
    """A position servo: only q of a command counts, and kp of 0 lets go."""

    kp, kd, tau_max = 20.0, 0.7, 0.9

    def accept(self, motor: Motor) -> Motor:
        """The command with the servo's own gains."""
        on = motor.kp > 0
        return Motor(super().accept(motor).q, kp=self.kp if on else 0.0, kd=self.kd if on else 0.0)


class Servo(ReferenceService):
    """Such a gripper, which measures its force."""

    hand = ServoHand


class WeakServo(Servo):
    """As the guide's gripper: 30 N, which are 0.5 N m at the joint whose stroke 90 mm are."""

    class hand(ServoHand):
        """Its motor."""

        tau_max = 0.5


class NoForce(Servo):
    """Such a gripper that measures no force."""

    measured_members = frozenset(("q", "dq", "ddq"))

    def fields(self, side: Side) -> dict[str, Any]:
        """The state without tau_est."""
        return {**super().fields(side), "tau_est": 0.0}


class Acme(ReferenceService):
    """The guide's gripper: a top speed, a slow approach, an exact stop at the object."""

    class hand(ReferenceHand):
        """Its mechanics, those of ``acme_gripper.emulator``."""

        force, top, approach = 0.5, 1.4 * 5.4, 30.0

        def step(self, dt: float) -> None:
            """Advance by one step."""
            self.now += dt
            self.dq = self.tau = 0.0
            if self.goal is None or self.braking or not self.goal.kp:
                return
            self.dq = min(max(self.approach * (self.goal.q - self.q), -self.top), self.top)
            floor = -math.inf if self.touch is None else self.touch
            if self.q >= floor > self.q + self.dq * dt:
                self.q, self.dq, self.tau = floor, 0.0, -self.force
            self.q += self.dq * dt


class NoVelocity(ReferenceService):
    """Measures q and force alone."""

    measured_members = frozenset(("q", "tau_est"))

    def fields(self, side: Side) -> dict[str, Any]:
        """The state without velocities."""
        return {**super().fields(side), "dq": 0.0, "ddq": 0.0}


class DryDex1(ReferenceService):
    """Has 0.1 N m of dry friction more."""

    class hand(ReferenceHand):
        """Its mechanics."""

        coulomb = ReferenceHand.coulomb + 0.1


# ------------------------------------------------------------------------------------------- hands


class DryDex3(Dex3Service):
    """Has 20 mN m of dry friction more."""

    class hand(Dex3Hand):
        """Its mechanics."""

        coulomb = Dex3Hand.coulomb + 0.02


class Bare(Dex3Service):
    """Has neither tactile arrays nor an IMU."""

    sensors = 0
    attitude = (0.0, 0.0, 0.0, 0.0)


class RawTorque(Dex3Service):
    """Reports torque in raw counts, as published of real hands; thumb_0 idles at 5861."""

    counts, idle = 60000.0, 5861.0

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """The state with its counts."""
        super().fill(motors, hand)
        motors["tau_est"] *= self.counts
        motors["tau_est"][:1] += self.idle


class DryDex5(Dex5Service):
    """Has 1 mN m of dry friction more."""

    class hand(Dex5Hand):
        """Its mechanics."""

        coulomb = Dex5Hand.coulomb + 0.001


class VendorsDfx(InspireService):
    """Publishes as often as Unitree's service can."""

    tick = 0.0025
    period = 0.0225


class Aged(InspireService):
    """Measures each 0.13 s and obeys 0.2 s late, as the Inspire hands of a real G1."""

    measures, late = 0.13, 0.2

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._shown: dict[Side, tuple[float, list[float]]] = {}
        self._waiting: deque[tuple[float, Side, tuple[Motor, ...]]] = deque()

    def motors(self, side: Side, motors: tuple[Motor, ...]) -> None:
        """Take one side's part of a command message, later."""
        self._waiting.append((self.now + self.late, side, motors))

    def live(self, dt: float) -> None:
        """Advance the hands."""
        while self._waiting and self._waiting[0][0] <= self.now:
            _, side, motors = self._waiting.popleft()
            super().motors(side, motors)
        super().live(dt)

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """The state with the last measurement."""
        super().fill(motors, hand)
        at, q = self._shown.get(hand.side, (-math.inf, []))
        if self.now - at >= self.measures:
            at, q = self._shown[hand.side] = self.now, list(hand.q)
        motors["q"] = q[: len(motors)]


class AgedFtp(Aged, FtpService):
    """The same with measured forces."""

    hand = FtpHand
    measured_members = FtpService.measured_members

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """The state with the last measurement, and the forces."""
        FtpService.fill(self, motors, hand)
        at, q = self._shown.get(hand.side, (-math.inf, []))
        if self.now - at >= self.measures:
            at, q = self._shown[hand.side] = self.now, list(hand.q)
        motors["q"] = q[: len(motors)]


class Uncalibrated(FtpService):
    """Shows 330 g at rest, as a hand whose forces were never calibrated."""

    def fill(self, motors: Any, hand: FingerHand) -> None:
        """The state with the offset."""
        super().fill(motors, hand)
        motors["tau_est"] -= 0.33  # a positive force closes, towards smaller q


@dataclass(frozen=True)
class Legal:
    """A hand, and what its maker does with it.

    :param made: its service, or the deviations of generated good hands.
    :param spoken: the dialect.
    :param claims: the units that the maker claims; None for a hand without a file of claims.
    :param warned: requirements that may warn of it: what differs from the original, and matters to
        some clients.
    """

    made: type[Service] | str
    spoken: str
    claims: frozenset[str] | None = None
    sides: tuple[Side, ...] = BOTH
    warned: frozenset[str] = frozenset()
    soak: bool = False

    @property
    def name(self) -> str:
        """For the test's id."""
        made = self.made if isinstance(self.made, str) else self.made.__name__
        told = "" if self.claims is None else "-claims"
        return f"{self.spoken}-{made}{told}{'-right' if self.sides == RIGHT else ''}"

    def judged(self) -> RunResult:
        """A whole run of it."""
        made = self.made
        if isinstance(made, str):
            faults = tuple(Fault(what) for what in made.split("+"))
            made = Generated(dialect(self.spoken), faults).service()
        plan = plan_for(self.spoken, sides=self.sides)
        recording = recording_of(run_virtual(plan, made), self.spoken, plan.sides)
        units = None if self.claims is None else dict.fromkeys(CAPABILITIES, False)
        if units is not None:
            units |= dict.fromkeys(self.claims or (), True)
        return judge(recording, claims=Claims(units))


FORCE = frozenset({"force", "velocity", "temperature"})
GO = "unitree_go"
SERVO = frozenset({"DEX1-GAIN-02", "DEX1-GAIN-03"})
"""A servo uses neither the velocity nor the torque of a command."""
WEAK = SERVO | {"DEX1-FORCE-09"}
DRY_DEX3 = frozenset({"DEX3-MOVE-04", "DEX3-GAIN-02"})
DRY_DEX5 = frozenset({"DEX5-MOVE-04", "DEX5-GAIN-02", "DEX5-OPER-04"})
RAW = frozenset({"DEX3-FORCE-02", "DEX3-FORCE-05"})
HANDS = [
    Legal(ReferenceService, GO, sides=RIGHT),
    Legal(ReferenceService, GO, FORCE | {"acceleration"}, soak=True),
    Legal(Servo, GO, FORCE, warned=SERVO, soak=True),
    Legal(Servo, GO, warned=SERVO, soak=True),
    Legal(WeakServo, GO, FORCE, warned=WEAK, soak=True),
    Legal(Acme, GO, FORCE, warned=WEAK),
    Legal(NoForce, GO, frozenset({"velocity"}), warned=SERVO, soak=True),
    Legal(NoVelocity, GO, soak=True),
    Legal("backlash-more+soft-start", GO, soak=True),
    Legal(DryDex1, GO, soak=True),
    Legal(Bare, "dex3", soak=True),
    Legal(DryDex3, "dex3", warned=DRY_DEX3, soak=True),
    Legal(RawTorque, "dex3", warned=RAW, soak=True),
    Legal(DryDex5, "dex5", warned=DRY_DEX5, soak=True),
    Legal(VendorsDfx, "inspire_dfx"),
    Legal(Aged, "inspire_dfx", soak=True),
    Legal(AgedFtp, "inspire_ftp", soak=True),
    Legal(Uncalibrated, "inspire_ftp", warned=frozenset({"FTP-FORCE-04"}), soak=True),
]


@pytest.mark.parametrize(
    "given",
    [pytest.param(h, marks=pytest.mark.soak if h.soak else (), id=h.name) for h in HANDS],
)
def test_legal_hand_fails_nothing(given: Legal) -> None:
    results = given.judged().results
    wrong = [r.explain() for r in results if r.verdict in (Verdict.FAIL, Verdict.ERROR)]
    assert not wrong, "\n".join(wrong)
    assert {r.requirement.id for r in results if r.verdict is Verdict.WARN} <= given.warned
    assert sum(r.verdict is Verdict.PASS for r in results) >= 30


# -------------------------------------------------------------------------- claims and warnings


def concluded(outcome: Outcome, requirement: str, claims: Claims) -> Result:
    (applied,) = claims.apply([BY_ID[requirement]])
    return Judgement(applied, Side.LEFT, claims, {}).run_check(lambda: outcome, lambda _: Excuse())


CLAIMED = Claims(dict.fromkeys(CAPABILITIES, True))


def test_what_cannot_be_judged_of_a_claimed_unit_is_no_failure() -> None:
    """Only a unit that nothing fills is: most hands lack what some requirement asks for."""
    own = Outcome(None, reason="this gripper has a force of its own")
    assert concluded(own, "DEX1-FORCE-14", CLAIMED).verdict is Verdict.NOT_APPLICABLE
    absent = concluded(replace(own, absent=True), "DEX1-FORCE-14", CLAIMED)
    assert absent.verdict is Verdict.FAIL
    assert "Nothing fills it" in absent.cause


def test_a_claim_makes_no_must_of_what_is_inferred() -> None:
    bad = Outcome(False, "0.5 N m", "weaker than the original")
    assert BY_ID["DEX1-FORCE-09"].confidence == "inferred"
    assert concluded(bad, "DEX1-FORCE-09", CLAIMED).verdict is Verdict.WARN
    assert BY_ID["DEX1-FIELD-04"].confidence == "vendor code"
    assert concluded(bad, "DEX1-FIELD-04", CLAIMED).verdict is Verdict.FAIL


def test_what_real_hands_do_is_a_warning_of_a_must_too() -> None:
    gap = Outcome(False, "1.004 s", "a gap")
    assert concluded(gap, "DEX3-RATE-03", Claims()).verdict is Verdict.FAIL
    assert concluded(gap.tolerated(), "DEX3-RATE-03", Claims()).verdict is Verdict.WARN


@each(("seconds", "verdict"), [(0.08, Verdict.PASS), (1.004, Verdict.WARN), (1.6, Verdict.FAIL)])
def test_a_dex3_may_lose_its_state_for_a_second(seconds: float, verdict: Verdict) -> None:
    """One robot did, again and again: its recording is told what that does to a client."""
    trace = open_trace(sample_path("dex3_pinch"))
    topic = "rt/dex3/left/state"
    states = trace.samples(topic)
    begin = int(states.log_time_ns[len(states.log_time_ns) // 2])
    kept = MemoryTrace(endpoints=list(trace.endpoints))
    for name in trace.topics:
        rows = trace.samples(name)
        for log, sent, data in zip(
            rows.log_time_ns.tolist(), rows.publish_time_ns.tolist(), rows.payloads, strict=True
        ):
            if name != topic or not begin < log < begin + seconds * 1e9:
                kept.put(name, rows.type_name, log, sent, data)
    judged = judge(recording_of(kept, "dex3", (Side.LEFT,)))
    found = next(r for r in judged.results if r.requirement.id == "DEX3-RATE-03")
    assert found.verdict is verdict
    if verdict is Verdict.WARN:
        assert "A client that waits for it stands still" in found.cause


# ------------------------------------------------------------------------------ own sessions


def pressed_softly(grams: int) -> MemoryTrace:
    """An FTP hand that has reached its goal in a soft object, driven by a client of its own."""
    trace = MemoryTrace()
    state, ctrl = message_type(FTP.state_type), message_type(FTP.cmd_type)
    for i in range(800):
        at, t = 1_700_000_000_000_000_000 + i * 10_000_000, 0.01 * i
        angle = [round(1000 - 500 * min(1.0, max(0.0, t - 2.0)))] * 6
        force = [grams if t > 3.0 else 0] * 6
        zero = [0] * 6
        shown = state.cls(zero, angle, force, zero, zero, [1] * 6, [40] * 6)
        trace.put("rt/inspire_hand/state/r", FTP.state_type, at + 60_000, at, state.encode(shown))
        goal = [1000 if t < 2.0 else 500] * 6
        given = ctrl.cls(zero, goal, zero, zero, 1)
        trace.put("rt/inspire_hand/ctrl/r", FTP.cmd_type, at + 500_000, at, ctrl.encode(given))
    return trace


@each("grams", [0, 2600])
def test_a_client_may_press_a_soft_object(grams: int) -> None:
    """What a hand touches is known in runs of the kit alone; others are told of the cure."""
    result = judge(recording_of(pressed_softly(grams), "inspire_ftp", (Side.RIGHT,)))
    assert not [r.explain() for r in result.results if r.verdict is Verdict.FAIL]
    found = next(r for r in result.results if r.requirement.id == "FTP-FORCE-04")
    assert found.verdict is Verdict.NOT_APPLICABLE
    assert ("Calibrate the force sensors" in found.reason) == (grams > 300)
