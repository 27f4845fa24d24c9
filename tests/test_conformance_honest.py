"""Test that hands within the limits do not fail, also on a busy machine."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dexkit.conformance.behaviours.bad_commands import fastest
from dexkit.conformance.checks.steps import Step
from dexkit.conformance.faults import any_model, gripper, plan_for, run_mutant
from dexkit.conformance.faults.generated import parse
from dexkit.conformance.faults.registry import mix
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.results import Load, Overall, RunResult, Verdict
from dexkit.conformance.stimuli import phases_for
from dexkit.conformance.virtual import MemoryTrace, Sample, Service, run_virtual
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Floats, Side
from tests.conformance_helpers import copy_of, result_of, short_run, with_beats
from tests.each import each

PHASES = frozenset(
    {"step", "ends", "nan", "out-of-range", "limp", "silence", "resume", "load", "burst"}
)


class JustFastEnough(ReferenceService):
    """Publishes state at exactly 200 Hz."""

    tick = period = 0.005


class Slowish(ReferenceService):
    """State at 180 Hz."""

    tick = period = 1 / 180


class FarTooSlow(ReferenceService):
    """State at 50 Hz."""

    tick = period = 0.02


class Plain(ReferenceService):
    """Reports only its position; publishes best effort."""

    writer_reliability = "best_effort"

    def fields(self, side: Side) -> dict[str, Any]:
        return {"q": super().fields(side)["q"]}


class _Unhurried(ReferenceHand):
    def motor_torque(self) -> float:
        if self.goal is None or self.goal.kp <= 0:
            return super().motor_torque()
        wanted = min(max(12.0 * (self.goal.q - self.q), -1.2), 1.2)
        torque = min(max(0.5 * (wanted - self.dq) + self.viscous * wanted, -2.0), 2.0)
        return 0.0 if self.braking else torque


class _Quick(ReferenceHand):
    tau_max = 5.0
    viscous = 0.11


class Quick(ReferenceService):
    """Goes from one end to the other in a sixth of a second."""

    hand = _Quick


class Hesitates(ReferenceService):
    """Repeats its position for a tenth of a second more when it begins to move."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.stood = (0.0, 0.0, b"")  # position, until when it is repeated, the repeated state

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        fresh, here = super().payload(sides, length), self.positions(sides[0])[-1]
        if abs(here - self.stood[0]) < 1e-3:
            self.stood = (here, self.now + 0.1, fresh)
        elif self.now >= self.stood[1]:
            self.stood = (here, 0.0, fresh)
        return self.stood[2]


class HesitatesInAGrip(ReferenceService):
    """Repeats its position for 0.08 s more when it leaves an object."""

    gripped = (-1.0, b"")  # when it was last held, and the state then

    def payload(self, sides: tuple[Side, ...], length: int | None = None) -> bytes:
        fresh, here = super().payload(sides, length), self.positions(sides[0])[-1]
        if here < 1.99:
            self.gripped = (self.now, self.gripped[1] or fresh)
        return self.gripped[1] if self.now - self.gripped[0] < 0.08 else fresh


class Coarse(ReferenceService):
    """Measures q in steps of 1.5 % of the range, from another place on after a restart."""

    def fields(self, side: Side) -> dict[str, Any]:
        fields = super().fields(side)
        step = 0.015 * self.dialect.q_open
        off = 0.03 if self.restarted else 0.0
        return {**fields, "q": off + step * round((fields["q"] - off) / step)}


class CoarseAndStale(Coarse):
    """Measures such a q 17 times a second."""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self.measured: dict[Side, tuple[float, dict[str, Any]]] = {}

    def fields(self, side: Side) -> dict[str, Any]:
        if self.now - self.measured.get(side, (-1.0, {}))[0] >= 0.06:
            self.measured[side] = self.now, super().fields(side)
        return self.measured[side][1]


class Unhurried(ReferenceService):
    """Takes four and a half seconds from one end to the other."""

    hand = _Unhurried


def judged(service: type[Service], claims: Claims | None = None) -> RunResult:
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=PHASES)
    return judge(Recording.decode(run_virtual(plan, service)), claims=claims)


def blamed(result: RunResult) -> set[str]:
    bad = (Verdict.FAIL, Verdict.WARN, Verdict.BLOCKED, Verdict.ERROR)
    return {r.requirement.id for r in result.results if r.verdict in bad}


@pytest.mark.parametrize(
    ("service", "warned"),
    [
        (JustFastEnough, {"DEX1-RATE-01"}),
        (Plain, {"DEX1-QOS-01"}),
        (Quick, set()),
        # slow, which gives warnings; but it arrives, opens, closes and obeys
        (Unhurried, {"DEX1-MOVE-04"}),
    ],
)
def test_hand_within_the_limits_never_fails(service: type[Service], warned: set[str]) -> None:
    result = judged(service)
    assert blamed(result) == warned
    assert result.overall is Overall.PASS


def test_steps_of_a_coarse_encoder_are_not_old_values() -> None:
    assert {r.verdict for r in judged(Coarse).results if "-FRESH-" in r.requirement.id} == {
        Verdict.PASS
    }
    assert result_of(judged(CoarseAndStale), "DEX1-FRESH-01").verdict is Verdict.FAIL


def test_speed_of_a_step_is_not_known_where_there_was_no_state() -> None:
    t = np.arange(0.0, 0.3, 0.002)
    course: Floats = np.asarray(np.minimum(t / 0.1, 1.0), dtype=float)

    def step(kept: NDArray[np.bool_]) -> Step:
        return Step(0, 5.4, 0.0, 0.3, 1.0, 0.0, 1.0, t[kept], course[kept], "rad")

    assert fastest(step(t >= 0.0)) == pytest.approx(10.0, rel=0.1)
    assert fastest(step(t >= 0.07)) is None
    assert fastest(step((t < 0.02) | (t >= 0.09))) is None


def test_hand_at_rest_at_its_command_is_not_frozen() -> None:
    fresh = result_of(judge(Recording.decode(listened(Hesitates))), "DEX1-FRESH-02")
    assert fresh.verdict is Verdict.PASS
    assert 0.08 < fresh.values["frozen_s"] < 0.15  # and not the second of rest before it


def test_hand_held_by_an_object_is_not_frozen() -> None:
    plan = replace(plan_for(sides=(Side.RIGHT,)), phases=frozenset({"step", "squeeze", "grip"}))
    recording = Recording.decode(run_virtual(plan, HesitatesInAGrip))
    fresh = result_of(judge(recording), "DEX1-FRESH-02", "right")
    assert fresh.verdict is Verdict.PASS
    assert 0.07 < fresh.values["frozen_s"] < 0.15  # and not the seconds of the grip before it


def test_fast_gripper_is_not_judged_as_percent() -> None:
    speed = result_of(judge(Recording.decode(listened(Quick))), "DEX1-FIELD-15")
    assert speed.verdict is Verdict.PASS
    assert 30 < speed.values["speed_rad_s"] < 60


def test_units_that_are_not_claimed_do_not_fail() -> None:
    result = judged(Plain, Claims.parse('[hand]\nmodel = "dex1-1"'))
    assert blamed(result) == {"DEX1-QOS-01"}
    assert result_of(result, "DEX1-FIELD-04").verdict is Verdict.NOT_CLAIMED


def test_restart_of_the_service_by_the_kit_is_not_a_gap() -> None:
    plan = replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"shutdown", "service-restart"}))
    found = judge(Recording.decode(run_virtual(plan, ReferenceService)))
    gap = result_of(found, "DEX1-RATE-03")
    assert gap.verdict is Verdict.PASS
    assert gap.values["max_gap_s"] < 0.1  # nor is it reported as the longest


# ------------------------------------------------------------- what a few requirements say of one


class InContact(ReferenceService):
    """Publishes a torque on the object alone."""

    def fields(self, side: Side) -> dict[str, Any]:
        found, hand = super().fields(side), self.hands[side]
        return {**found, "tau_est": found["tau_est"] if hand.contact() else 0.0}


class Turned(ReferenceService):
    """Publishes every torque with the other sign."""

    def fields(self, side: Side) -> dict[str, Any]:
        found = super().fields(side)
        return {**found, "tau_est": -found["tau_est"]}


class Stiff(ReferenceService):
    """Is four times as stiff as it is commanded."""

    class hand(ReferenceHand):
        """Its motor."""

        tau_max = 20.0

        def accept(self, motor: Any) -> Any:
            """The command with other gains."""
            accepted = super().accept(motor)
            return replace(accepted, kp=4.0 * accepted.kp)


class OpensOnly(ReferenceService):
    """Takes a commanded torque only if it opens."""

    class hand(ReferenceHand):
        """Its motor."""

        def accept(self, motor: Any) -> Any:
            """The command with another torque."""
            return replace(super().accept(motor), tau=max(motor.tau, 0.0))


class Pauses(ReferenceService):
    """Publishes nothing for 72 ms in every 0.45 s, and so at the end of a step."""

    def publish(self) -> list[Sample]:
        samples = super().publish()
        return [] if self.now > 1.0 and (self.now + 0.15) % 0.45 < 0.072 else samples


class AsFastAsRequired(ReferenceService):
    """Moves at :attr:`top` rad/s at most."""

    top = 3.1

    def __init__(self, *args: object) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        for side, hand in self.hands.items():
            hand = gripper.Slow.hand(hand.stroke, hand.touch)
            hand.top = self.top  # type: ignore[attr-defined]
            self.hands[side] = hand


class Faster(AsFastAsRequired):
    """Moves a little faster."""

    top = 3.6


class Saturated(ReferenceService):
    """Publishes its largest torque, which float32 rounds up, or a part of it."""

    part = 1.0

    def fields(self, side: Side) -> dict[str, Any]:
        tau = float(np.nextafter(np.float32(15.0), np.float32(16.0)))
        return {**super().fields(side), "tau_est": -self.part * tau}


class NearlySaturated(Saturated):
    """A tenth more is allowed."""

    part = 1.09


class TooMuch(Saturated):
    """And no more."""

    part = 1.11


STRONGER = parse("dex1-1/unitree_go:stronger+latency-20").service()
LEFT, RIGHT, BOTH = (Side.LEFT,), (Side.RIGHT,), (Side.LEFT, Side.RIGHT)
PASS, WARN, FAIL = Verdict.PASS, Verdict.WARN, Verdict.FAIL


@each(
    ("service", "sides", "expected"),
    [
        # tau_est may have either sign
        (Turned, RIGHT, {"FORCE-01": PASS}),
        (InContact, RIGHT, {"FORCE-01": PASS}),
        (Stiff, RIGHT, {"FORCE-09": PASS}),
        (OpensOnly, RIGHT, {"GAIN-03": PASS}),
        (Pauses, BOTH, {"SIDE-03": PASS}),
        # what is asked for is the largest of the goals that it may follow
        (STRONGER, RIGHT, {"FORCE-18": PASS}),
        # TRACK allows for the top speed of a hand that meets MOVE-04
        (AsFastAsRequired, LEFT, {"MOVE-04": PASS, "TRACK-01": PASS}),
        (Faster, LEFT, {"MOVE-04": PASS, "TRACK-01": PASS}),
        (mix(any_model.WaitsForRest, Faster), LEFT, {"MOVE-04": PASS, "TRACK-01": FAIL}),
        (Saturated, LEFT, {"FORCE-04": PASS}),
        (NearlySaturated, LEFT, {"FORCE-04": PASS}),
        (TooMuch, LEFT, {"FORCE-04": WARN}),
    ],
)
def test_requirement_allows_what_it_should(
    service: type[Service], sides: tuple[Side, ...], expected: dict[str, Verdict]
) -> None:
    wanted = select(catalogue("dex1-1"), prefixes=[f"DEX1-{name}" for name in expected])
    plan = replace(plan_for(sides=sides), phases=phases_for(wanted) | {"step", "fingerprint"})
    ids = {r.id for r in wanted}
    found = [r for r in run_mutant(service, plan).results if r.requirement.id in ids]
    assert len(found) == len(expected) * len(sides)
    for result in found:
        verdict = expected[result.requirement.id.removeprefix("DEX1-")]
        assert result.verdict is verdict, result.explain()


# ------------------------------------------------------------------------------- a busy machine


@pytest.mark.parametrize(
    ("service", "usual_ms", "pressed", "verdict"),
    [
        (ReferenceService, 0.1, False, Verdict.PASS),
        (ReferenceService, 5.0, True, Verdict.PASS),
        (Slowish, 0.1, False, Verdict.FAIL),
        (Slowish, 0.5, True, Verdict.FAIL),  # programs wait, but nothing is late
        (Slowish, 2.0, True, Verdict.BLOCKED),
        (FarTooSlow, 0.1, False, Verdict.FAIL),
        (FarTooSlow, 2.0, True, Verdict.FAIL),
        (FarTooSlow, 4.0, True, Verdict.FAIL),  # overloaded, but the rate is never high enough
        (FarTooSlow, 6.0, True, Verdict.BLOCKED),  # nothing is on time on such a machine
    ],
)
def test_busy_machine_explains_failures_up_to_its_lateness(
    service: type[Service], usual_ms: float, pressed: bool, verdict: Verdict
) -> None:
    recording = with_beats(
        copy_of(listened(service)), usual_us=int(usual_ms * 1e3), pressed=pressed
    )
    result = judge(recording)
    found = result_of(result, "DEX1-RATE-01")
    assert found.verdict is verdict
    if verdict is Verdict.BLOCKED:
        assert result.overall is Overall.INCONCLUSIVE
        assert result.disturbed_by
    elif verdict is Verdict.FAIL:
        assert result.overall is Overall.FAIL
        late = pressed and usual_ms > 0.5
        assert found.disturbance.load is (Load.BUSY if late else Load.NONE)


@pytest.mark.parametrize(("usual_ms", "verdict"), [(2.0, Verdict.FAIL), (6.0, Verdict.BLOCKED)])
def test_motion_is_blocked_on_overloaded_machine(usual_ms: float, verdict: Verdict) -> None:
    trace = copy_of(listened(ReferenceService))
    topic = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    still = trace.rows[topic][0][2]
    trace.rows[topic] = [(t, s, still) for t, s, _ in trace.rows[topic]]
    result = judge(with_beats(trace, usual_us=int(usual_ms * 1e3)))
    assert result_of(result, "DEX1-MOVE-02").verdict is verdict
    assert result_of(result, "DEX1-FIELD-03").verdict is Verdict.PASS
    percent = copy_of(listened(gripper.Percent))
    found = result_of(judge(with_beats(percent, usual_us=int(usual_ms * 1e3))), "DEX1-FIELD-03")
    assert found.verdict is Verdict.FAIL


@cache
def listened(service: type[Service]) -> MemoryTrace:
    return run_virtual(replace(plan_for(sides=(Side.LEFT,)), phases=frozenset({"step"})), service)


@pytest.mark.parametrize("off_s", [-3600.0, 0.4, 86400.0])
def test_wrong_clock_of_the_hand_does_not_change_verdicts(off_s: float) -> None:
    right = judge(Recording.decode(short_run()))
    trace = copy_of(short_run())
    topic = ("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
    trace.rows[topic] = [(t, s + round(off_s * 1e9), p) for t, s, p in trace.rows[topic]]
    found = judge(Recording.decode(trace))
    assert [r.verdict for r in found.results] == [r.verdict for r in right.results]
    gap, was = result_of(found, "DEX1-WDOG-02"), result_of(right, "DEX1-WDOG-02")
    assert gap.values["max_gap_s"] == pytest.approx(was.values["max_gap_s"], abs=1e-6)


@pytest.mark.parametrize(("lead_s", "verdict"), [(0.001, Verdict.FAIL), (0.5, Verdict.PASS)])
def test_state_that_leads_the_first_command_by_less_than_the_kit_can_tell(
    lead_s: float, verdict: Verdict
) -> None:
    """A busy kit receives its first command after the state that this command has set off."""
    trace = copy_of(short_run())
    command, state = (
        (f"rt/dex1/left/{kind}", f"unitree_go::msg::dds_::{name}")
        for kind, name in (("cmd", "MotorCmds_"), ("state", "MotorStates_"))
    )
    first = trace.rows[command][0][0]
    trace.rows[state] = [row for row in trace.rows[state] if row[0] > first - lead_s * 1e9]
    assert result_of(judge(Recording.decode(trace)), "DEX1-START-01").verdict is verdict
