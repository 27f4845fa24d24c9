"""Test when position servos are taken to press on an object."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dexkit.conformance.faults import plan_for
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.virtual import run_virtual
from dexkit.conformance.virtual.brainco import BrainCoHand, BrainCoService
from dexkit.conformance.virtual.inspire import FtpHand, FtpService
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.hand import Side

IDS = ("BRAINCO-FORCE-01", "BRAINCO-FORCE-05")


class _Relaxes(BrainCoHand):
    def expire(self) -> None:
        self.place = list(self.q)
        self.goal = np.array(self.place)


class Relaxes(BrainCoService):
    """Stops pressing when commands end, and holds the joints where they are."""

    hand = _Relaxes


@pytest.fixture(scope="module")
def relaxed() -> MemoryTrace:
    """A run that ends a silence with the goal from before it: beyond the object."""
    plan = plan_for("brainco")
    return run_virtual(replace(plan, phases=frozenset({"silence", "squeeze"})), Relaxes)


@pytest.mark.parametrize("later", [0.0, 0.01, 0.02, 0.03, 0.04])
def test_grip_begins_anew_with_the_first_command_after_a_silence(
    relaxed: MemoryTrace, later: float
) -> None:
    """Wherever the stretches lie in which the force is taken."""
    plan = plan_for("brainco")
    commands = plan.dialect.cmd_type
    first = min(rows[0][0] for (_, kind), rows in relaxed.rows.items() if kind == commands)
    rows = {
        (topic, kind): [r for r in rows if kind != commands or r[0] >= first + later * 1e9]
        for (topic, kind), rows in relaxed.rows.items()
    }
    wanted = select(catalogue(plan.dialect.model), prefixes=IDS)
    recording = recording_of(replace(relaxed, rows=rows), plan.dialect.name, plan.sides)
    found = [r for r in judge(recording, requirements=wanted).results if r.requirement.id in IDS]
    assert [r.observed for r in found if r.verdict is Verdict.FAIL] == []
    assert any(r.verdict is Verdict.PASS for r in found)


class _Peaks(FtpHand):
    """On contact the force rises with the speed, and settles there; without commands, it stops."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.part = np.ones(len(self.q))
        self.pressed = np.zeros(len(self.q), np.bool_)

    def expire(self) -> None:
        self.place = list(self.q)
        self.goal = np.array(self.place)

    def step(self, dt: float) -> None:
        fast = np.abs(self.dq) > 0.3
        super().step(dt)
        presses = np.abs(self.contact) > 0.05
        began = presses & ~self.pressed
        self.part[began] = np.where(fast[began], 1.0, 1.0 / 3.0)
        self.pressed = presses


class Peaks(FtpService):
    """Presses with a third of the force on an object that it touches already."""

    hand = _Peaks

    def fill(self, motors: Any, hand: Any) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= hand.part


class WeakerEachTime(FtpService):
    """Reports two fifths of the force from the second client on."""

    later = False

    def receive(self, topic: str, payload: bytes, client: int) -> None:
        self.later = self.later or client > 0
        super().receive(topic, payload, client)

    def fill(self, motors: Any, hand: Any) -> None:
        super().fill(motors, hand)
        motors["tau_est"] *= 0.4 if self.later else 1.0


@pytest.mark.parametrize(
    ("hand", "verdict"), [(Peaks, Verdict.PASS), (WeakerEachTime, Verdict.WARN)]
)
def test_squeezes_are_compared_that_begin_away_from_the_object(
    hand: type[FtpService], verdict: Verdict
) -> None:
    plan = plan_for("inspire_ftp", sides=(Side.RIGHT,))
    plan = replace(plan, phases=frozenset({"joint", "restart", "silence", "squeeze", "touch"}))
    wanted = select(catalogue("inspire-ftp"), prefixes=("FTP-FORCE-05",))
    recording = recording_of(run_virtual(plan, hand), plan.dialect.name, plan.sides)
    (found,) = (
        r
        for r in judge(recording, requirements=wanted).results
        if r.requirement.id == "FTP-FORCE-05"
    )
    assert found.verdict is verdict, found.observed
    assert len(recording.phases("squeeze", Side.RIGHT)) == 3
