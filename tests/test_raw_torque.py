"""Hands whose tau_est is in raw counts, as programs of real hands read it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexkit.conformance.faults import mutants
from dexkit.conformance.faults.matrix import try_one
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.results import Result, Verdict
from dexkit.conformance.virtual.fingers import Dex3Service
from dexkit.traces import open_trace, sample_path
from tests.each import each

SAMPLES = {
    "dex1_pick_place": "DEX1-FORCE-04",
    "dex3_pinch": "DEX3-FORCE-02",
    "dex5_synthetic": "DEX5-FORCE-02",
    "brainco_grip": "BRAINCO-FORCE-02",
    "inspire_ftp_grip": "FTP-FORCE-02",
}
COUNTS = 5861.0  # at rest, as published of a thumb
TO_COUNTS = 1e5  # of the joint's full torque


def with_torque(name: str, scale: float, offset: float, *, part: float = 1.0) -> Recording:
    """A sample whose first states have another unit of tau_est, in parts of each joint's torque.

    :param part: of the states.
    """
    recording = recording_of(open_trace(sample_path(name)), None, ())
    sides = {}
    for side, view in recording.sides.items():
        tau, n = view.states.tau.copy(), round(part * len(view.states))
        limits = np.array([j.tau_max for j in view.joints])
        tau[:n] = tau[:n] / limits * scale + offset
        sides[side] = replace(view, states=replace(view.states, tau=tau), known={})
    return replace(recording, sides=sides)


def about_force(results: list[Result]) -> list[Result]:
    return [r for r in results if r.requirement.area == "Force"]


@each("name", SAMPLES)
def test_raw_counts_fail_nobody_and_are_told_once(name: str) -> None:
    result = judge(with_torque(name, TO_COUNTS, COUNTS))
    told = [r for r in about_force(result.results) if r.verdict is not Verdict.NOT_APPLICABLE]
    assert {r.requirement.id for r in told} == {SAMPLES[name]}
    assert {r.verdict for r in told} == {Verdict.WARN}
    assert all("looks like raw counts" in r.observed for r in told)
    assert result.exit_code() == 0


def test_thousandths_warn_and_are_judged() -> None:
    """A few times too much is another unit of torque, or another joint's."""
    result = judge(with_torque("dex3_pinch", 10.0, 0.0))
    (one, *_) = [r for r in result.results if r.requirement.id == "DEX3-FORCE-02"]
    assert one.verdict is Verdict.WARN
    assert "raw counts" not in one.observed


@pytest.mark.parametrize("part", [0.0, 0.1])
def test_single_wrong_values_do_not_end_the_judgement_of_force(part: float) -> None:
    recording = with_torque("dex3_pinch", TO_COUNTS, COUNTS, part=part)
    assert not any(view.has_raw_torque for view in recording.sides.values())


def test_a_whole_run_with_raw_counts_warns_of_nothing_else() -> None:
    class MilliNewtonMetres(Dex3Service):
        def fill(self, motors: Any, hand: Any) -> None:
            super().fill(motors, hand)
            motors["tau_est"] = TO_COUNTS * motors["tau_est"] + COUNTS

    (hand,) = [m for m in mutants("dds") if m.pin.startswith("dds dex3-1 MilliNewtonMetres")]
    result = try_one(replace(hand, made=MilliNewtonMetres, brief=False, whole=True))
    assert (result.missed, result.wrongly) == ((), ())
