"""Test that hands which a client can use in place of the original are not failed.

Each is a change of a model's reference hand that its maker may make: another motor, other sensors,
less of what is optional. Makers claim what such a hand has, and nothing else.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from dexkit.conformance.checks import Outcome
from dexkit.conformance.checks.combined import warning
from dexkit.conformance.faults.generated import parse
from dexkit.conformance.faults.generated.campaign import try_generated
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.requirements import CAPABILITIES, catalogue
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.kit.verdicts import Excuse, Judgement
from dexkit.conformance.virtual import MemoryTrace
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import dialect
from dexkit.traces import open_trace, sample_path
from tests.each import each

FTP = dialect("inspire_ftp")
BY_ID = {r.id: r for r in catalogue(None, None)}


HANDS = [
    "dex1-1/unitree_go:right-alone",
    "dex1-1/unitree_go:servo-hard+claims",
    "dex1-1/unitree_go:servo-of-speed+claims",
    "dex1-1/unitree_go:no-force+servo-soft+claims",
    "dex1-1/unitree_go:no-force",
    "dex1-1/unitree_go:no-velocity",
    "dex1-1/unitree_go:backlash-more+soft-start",
    "dex1-1/unitree_go:friction-10",
    "dex3-1/dex3:bare",
    "dex3-1/dex3:friction-10",
    "dex3-1/dex3:servo-hard",
    "dex3-1/dex3:stroke-1.6",
    "dex3-1/dex3:torque-in-counts",
    "dex5-1/dex5:friction-5",
    "brainco-revo2/brainco:half-speed",
    "inspire-dfx/inspire_dfx:rate-44",
    "inspire-dfx/inspire_dfx:slow-line",
    "inspire-dfx/inspire_dfx:friction-20",
    "inspire-ftp/inspire_ftp:slow-line",
    "inspire-ftp/inspire_ftp:force-offset",
]
"""What makers do that once failed a MUST, or looked as if it would."""
QUICKEST = {HANDS[0], HANDS[2], "inspire-dfx/inspire_dfx:rate-44"}


@pytest.mark.parametrize(
    "name", [pytest.param(h, marks=() if h in QUICKEST else pytest.mark.soak) for h in HANDS]
)
def test_legal_hand_fails_nothing(name: str) -> None:
    trial = try_generated(parse(name))
    assert trial.caught, (trial.failed, trial.blamed, trial.errors)


# -------------------------------------------------------------------------- claims and warnings


def concluded(outcome: Outcome, requirement: str, claims: Claims) -> Result:
    (applied,) = claims.apply([BY_ID[requirement]])
    return Judgement(applied, Side.LEFT, claims, {}).run_check(lambda: outcome, lambda _: Excuse())


CLAIMED = Claims(dict.fromkeys(CAPABILITIES, True))


def test_what_cannot_be_judged_of_a_claimed_unit_is_no_failure() -> None:
    """Only a unit that nothing fills is: most hands lack what some requirement asks for."""
    own = Outcome(None, reason="this gripper has a force of its own")
    assert concluded(own, "DEX1-FORCE-11", CLAIMED).verdict is Verdict.NOT_APPLICABLE
    absent = concluded(replace(own, absent=True), "DEX1-FORCE-11", CLAIMED)
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


def test_a_part_that_warns_fails_where_its_unit_is_claimed() -> None:
    part = warning(Outcome(False, "1.2 N m", "more than asked for"), unless_claimed=True)
    assert concluded(part, "DEX1-FORCE-11", Claims()).verdict is Verdict.WARN
    assert concluded(part, "DEX1-FORCE-11", CLAIMED).verdict is Verdict.FAIL


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
