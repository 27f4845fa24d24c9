"""Test the checks of torque, stiffness and the course of q, and the length of runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexkit.conformance.checks import Context
from dexkit.conformance.checks.contacts import contacts
from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.faults.generated import parse
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.kit.selection import length
from dexkit.conformance.stimuli import CommandSession, phases_for
from dexkit.conformance.virtual import Sample, Service, run_virtual
from dexkit.conformance.virtual.gripper import ReferenceHand, ReferenceService
from dexkit.hand import Side
from dexkit.models import BUILT_IN


def judged(service: type[Service], *ids: str) -> list[Result]:
    """The results of these requirements in a run of the stimuli that they need, and more steps."""
    wanted = select(catalogue("dex1-1"), prefixes=ids)
    plan = replace(plan_for(sides=(Side.RIGHT,)), phases=phases_for(wanted) | {"fingerprint"})
    return [r for r in run_mutant(service, plan).results if r.requirement.id in ids]


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


class AlwaysOpening(ReferenceService):
    """Publishes the torque's size while it moves, and the true one on the object."""

    def fields(self, side: Side) -> dict[str, Any]:
        found, hand = super().fields(side), self.hands[side]
        tau = found["tau_est"]
        return {**found, "tau_est": tau if hand.contact() else abs(tau)}


class _Strong(ReferenceHand):
    tau_max = 20.0

    def accept(self, motor: Any) -> Any:
        accepted = super().accept(motor)
        return replace(accepted, kp=4.0 * accepted.kp)


class Servo(ReferenceService):
    """Is four times as stiff as it is commanded."""

    hand = _Strong


def test_stiffer_servo_passes_the_check_of_grip_strength() -> None:
    (strength,) = judged(Servo, "DEX1-FORCE-09")
    assert strength.verdict is Verdict.PASS


def test_torque_that_only_opens_passes_the_check_of_torque_commands() -> None:
    class _Clamped(ReferenceHand):
        def accept(self, motor: Any) -> Any:
            return replace(super().accept(motor), tau=max(motor.tau, 0.0))

    class Clamped(ReferenceService):
        hand = _Clamped

    (result,) = judged(Clamped, "DEX1-GAIN-03")
    assert result.verdict is Verdict.PASS


def test_a_gap_at_the_end_of_a_step_is_no_failure_of_the_step() -> None:
    class Pauses(ReferenceService):
        """Publishes nothing for 72 ms in every 0.45 s, and so at the end of a step."""

        def publish(self) -> list[Sample]:
            samples = super().publish()
            return [] if self.now > 1.0 and (self.now + 0.15) % 0.45 < 0.072 else samples

    wanted = select(catalogue("dex1-1"), prefixes=["DEX1-SIDE-03"])
    results = run_mutant(Pauses, replace(plan_for(), phases=phases_for(wanted))).results
    found = [r.verdict for r in results if r.requirement.id == "DEX1-SIDE-03"]
    assert found == [Verdict.PASS] * 2


@pytest.mark.parametrize("name", [m.name for m in BUILT_IN])
def test_a_default_run_of_hands_is_short_enough(name: str) -> None:
    """90 s, less 4 s for start and judgement, and 9 s in which the slowest hand arrives."""
    stimuli = length(name, phases_for(catalogue(name)))
    session = CommandSession.default(name).duration if under_test(name).session else 0.0
    assert stimuli + session <= 77.0


@pytest.mark.parametrize("name", ["stronger", "stronger+latency-20"])
def test_force_follows_a_goal_that_changes_in_contact(name: str) -> None:
    """What is asked for then is the largest of the goals that the hand may follow."""
    wanted = next(r for r in catalogue("dex1-1") if r.id == "DEX1-FORCE-18")
    hand = parse(f"dex1-1/unitree_go:{name}")
    phases = phases_for([wanted]) | {"replay"}
    plan = replace(plan_for("unitree_go", sides=(Side.RIGHT,)), phases=phases)
    recording = recording_of(run_virtual(plan, hand.service()), "unitree_go", plan.sides)
    felt, asked, most = [], [], []
    for settle in np.arange(0.4, 0.6, 0.02).tolist():  # wherever a piece of contact begins
        shifted = replace(wanted, tolerances={**wanted.tolerances, "settle_s": settle})
        ctx = Context(recording, recording.sides[Side.RIGHT], shifted)
        touch = ctx.object_at
        assert touch is not None
        for p in contacts(ctx, touch):
            felt.append(float(np.abs(ctx.states.tau[ctx.states.between(p.begin, p.end), 0]).max()))
            asked.append(p.kp * (p.q - p.goal))
            most.append(p.most)
    assert np.any(np.array(felt) > 1.6 * np.array(asked))
    assert np.all(np.array(felt) <= 1.1 * np.array(most))
