"""Make a verdict of a requirement and its check's outcome; the same for DDS and USB.

**Machine or hand?** A machine that is short of processor time makes a correct hand look late. One
rule decides. Where the kit's own timer (:mod:`~dexkit.conformance.kit.heartbeat`) or the hand's own
processes (:mod:`~dexkit.conformance.kit.run_queue`: of all waits the part of which other programs
are the cause) waited for a processor at the place of a failure, and :data:`LARGER` times that is as
long as the failure is large, it is *blocked*, and the run is done again. Else it is the hand's.

A failure is as large as the delay that would make a correct hand fail in the same way
(:class:`~dexkit.conformance.checks.Late`): a rate of 150 Hz where 200 are asked for is 1.7 ms late
each time, a gap of 0.3 s where 0.1 s are allowed 0.2 s once, and the wrong direction is no matter
of delay. Without such a size it is as large as its place is long. It is blocked only if it is at
each of its places. A failure that the machine explains in part says so, and the run is done once
more; the second run counts.

Apart from load, a MUST that fails by less than the kit's measurement error
(:mod:`~dexkit.conformance.kit.measurement_error`) is *blocked* as well: its figure is nearer to the
limit than the kit can tell. A pass by less than that remains a pass, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from dexkit.conformance.checks import Late, Outcome
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.lateness import Lateness
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.processor_waits import Starvation
from dexkit.conformance.kit.requirements import Level, Requirement
from dexkit.conformance.kit.results import UNDISTURBED, Disturbance, Load, Result, Verdict
from dexkit.hand import Subject

__all__ = ["Excuse", "Judgement", "Machine", "excuse"]

LARGER = 4.0
"""Largest delay of a correct hand as a multiple of what was waited: it has several threads, one of
which finds its turn gone, and waits for its device."""
BEFORE = 1.0
"""Seconds before a failure from which a wait of the hand can still show: in a motion that began
late, or in that of a driver that has to reach its device again; and in which the kit may have been
late, if the failure has no end."""
_STILL = ("nothing", "endpoints", "state")
"""Needs of requirements that a hand cannot fail for lack of processor time, unless they are
real-time requirements."""
NOTABLE = 0.1
"""Part of a failure that the machine must explain to be mentioned."""

MOST_PLACES = 5
"""Places that a result names; all of them are looked at before a failure is excused."""

_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)
_NOT_MET = (Verdict.FAIL, Verdict.WARN)


class Machine(Protocol):
    """Data in a recording about the machine that the kit ran on."""

    def excess_lateness(self, begin: float, end: float) -> Lateness | None:
        """Lateness of the kit's own timer in it, s; None if unknown."""
        ...

    def starvation(self, subject: Subject, begin: float, end: float) -> Starvation | None:
        """How long the subject's processes waited for a processor in it; None if unknown."""
        ...


@dataclass(frozen=True)
class Excuse:
    """Whether load of the machine explains a failure.

    :param disturbance: its load, and what was measured of it.
    :param text: what it was like, where it was not idle; else empty.
    """

    disturbance: Disturbance = UNDISTURBED
    text: str = ""

    @property
    def excused(self) -> bool:
        """Whether the machine can have caused all of it."""
        return self.disturbance.load is Load.TOO_BUSY


def excuse(
    machine: Machine,
    requirement: Requirement,
    outcome: Outcome,
    subject: Subject,
    whole: tuple[float, float] | None = None,
) -> Excuse:
    """Decide whether load of the machine that the kit ran on can have caused a failure.

    :param subject: whose failure it is.
    :param whole: the run, for failures that have no place.
    """
    if requirement.needs in _STILL and not requirement.realtime:
        return Excuse()
    spans = [
        (e.time_s, e.end_s) if e.end_s is not None else (e.time_s - BEFORE, e.time_s)
        for e in outcome.evidence
    ]
    if whole is not None and not spans:
        spans = [whole]
    late = outcome.late or Late(tuple(end - begin for begin, end in spans))
    sizes = late.seconds
    if len(sizes) != len(spans):
        sizes = (max(sizes),) * len(spans)
    found = [
        _excuse(machine, subject, size, late.how, *span)
        for size, span in zip(sizes, spans, strict=True)
    ]
    # of all places the one that is hardest to explain
    return min(found, key=lambda e: e.excused, default=Excuse())


_HOW = {"total": "in all", "mean": "each time", "p99": "one time in a hundred"}


def _excuse(
    machine: Machine, subject: Subject, size: float, how: str, begin: float, end: float
) -> Excuse:
    """Whether waits for a processor explain a failure at one of its places.

    :param size: the delay, seconds, that would make a correct hand fail in the same way.
    """
    # what happens once can be the end of what was held up before
    since = begin - BEFORE if how == "total" else begin
    timer, hand = machine.excess_lateness(begin, end), machine.starvation(subject, since, end)
    lost, was = 0.0, ""
    if timer is not None:
        lost = timer.figure(how)
        was = f"the kit's own timer was late by {_ms(lost)} {_HOW[how]} there"
    if hand is not None and hand.lost.figure(how) > lost:
        lost, worst = hand.lost.figure(how), hand.worst
        was = (
            f"{worst.process} waited for a processor for {worst.part:.0%} of the time there, up to "
            f"{_ms(worst.longest)} at once"
        )
    explained = LARGER * lost
    if lost > 0 and explained >= size:
        return Excuse(
            Disturbance(Load.TOO_BUSY, lost, explained, size),
            f"the machine was too busy to tell: {was}, so a good hand may have been {_ms(size)} "
            "late; close other programs or use another machine",
        )
    if not lost or explained < NOTABLE * size or not math.isfinite(size):
        return Excuse()
    return Excuse(
        Disturbance(Load.BUSY, lost, explained, size),
        f"the machine was busy, but {was}, which explains at most {_ms(explained)} of {_ms(size)}",
    )


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds < 1 else f"{seconds:.2f} s"


class Judgement:
    """Makes the :class:`Result` of one requirement for one subject.

    :param requirement: at the level that the claims give it.
    :param found: the results of this subject so far, by requirement.
    :param client: the results of the requirements about the client that drives the subject.
    """

    def __init__(
        self,
        requirement: Requirement,
        subject: Subject,
        claims: Claims,
        found: Mapping[str, Result],
        client: Sequence[Result] = (),
    ) -> None:
        self.requirement = requirement
        self.subject = subject
        self._claimed = claims.claimed(requirement)
        self._found = found
        self._client = client

    def result(
        self,
        verdict: Verdict,
        outcome: Outcome,
        blocked_by: str = "",
        disturbance: Disturbance = UNDISTURBED,
        measure: Measure | None = None,
    ) -> Result:
        """The result of that verdict."""
        return Result(
            requirement=self.requirement,
            side=str(self.subject),
            verdict=verdict,
            figure=outcome.figure,
            observed=outcome.observed,
            reason=outcome.reason,
            evidence=outcome.evidence[:MOST_PLACES],
            values={name: float(value) for name, value in outcome.values.items()},
            cause=outcome.cause if verdict in (Verdict.FAIL, Verdict.WARN) else "",
            blocked_by=blocked_by,
            joints=outcome.joints,
            disturbance=disturbance,
            plots=outcome.plots or self.requirement.plots,
            retry=outcome.retry or disturbance.load is not Load.NONE,
            measure=measure,
            tolerated=outcome.tolerable,
        )

    def not_applicable(self, reason: str) -> Result:
        """The result *not applicable*, with its reason."""
        return self.result(Verdict.NOT_APPLICABLE, Outcome(None, reason=reason))

    def no_hand(self, reason: str) -> Result:
        """The result *blocked* where nothing that was recorded shows a hand."""
        return self.result(Verdict.BLOCKED, Outcome(None, reason=reason))

    def not_claimed(self) -> Result | None:
        """The result *not claimed*, if the requirement's unit is not claimed; else None."""
        if self._claimed is not False:
            return None
        unit = self.requirement.capability
        return self.result(
            Verdict.NOT_CLAIMED, Outcome(None, reason=f"the unit '{unit}' is not claimed")
        )

    def blocked(self) -> Result | None:
        """The result *blocked*, if a requirement that it depends on failed; else None."""
        for before in self.requirement.after:
            if self._found[before].verdict in _OPEN:
                reason = f"blocked by {before}"
                return self.result(Verdict.BLOCKED, Outcome(None, reason=reason), before)
        return None

    def spoiled(self) -> Result | None:
        """The result *blocked*, if the client's commands do not allow to judge it; else None."""
        for result in self._client:
            need = result.requirement
            if result.tolerated or result.verdict not in _NOT_MET:
                continue
            if self.requirement.id.startswith(need.spoils):
                reason = f"blocked by {need.id}, a fault of the client: {result.observed}"
                return self.result(Verdict.BLOCKED, Outcome(None, reason=reason), need.id)
        return None

    def run_check(
        self,
        check: Callable[[], Outcome],
        excuse: Callable[[Outcome], Excuse],
        weigh: Callable[[Outcome], Measure | None] = lambda _: None,
    ) -> Result:
        """Call the check and make a result of its outcome.

        :param excuse: decides whether load of the machine explains a failure.
        :param weigh: finds the figure that decides, and the kit's error of it.
        """
        try:
            outcome = check()
        except Exception as error:  # an error of the kit is no failure of the hand
            text = f"the check itself failed: {type(error).__name__}: {error}"
            return self.result(Verdict.ERROR, Outcome(None, reason=text))
        if outcome.absent and self._claimed:
            unit = self.requirement.capability
            claim = f"{outcome.reason or outcome.observed}, but the unit '{unit}' is claimed"
            outcome = replace(
                outcome, met=False, tolerable=False, figure="absent", observed=claim, reason=""
            ).because(f"Nothing fills it: either do, or do not claim '{unit}'.")
        if outcome.unless_claimed and self._claimed:
            outcome = replace(outcome, tolerable=False)
        if outcome.met is None:
            return self.result(Verdict.NOT_APPLICABLE, outcome)
        if outcome.met:
            return self.result(Verdict.PASS, outcome, measure=weigh(outcome))
        busy = excuse(outcome)
        if busy.text:
            outcome = replace(outcome, reason=busy.text)
        must = self.requirement.level is Level.MUST and not outcome.tolerable
        failed = Verdict.FAIL if must else Verdict.WARN
        verdict = Verdict.BLOCKED if busy.excused else failed
        if busy.excused and outcome.tolerable and self.requirement.level is Level.MUST:
            # the part that only warns is not known: the MUST is met as far as it was judged
            verdict = Verdict.NOT_APPLICABLE
        measure = weigh(outcome)
        if verdict is Verdict.FAIL and measure is not None and measure.explains_failure:
            verdict = Verdict.BLOCKED
            reason = f"{measure.sentence()}; a quieter machine or another run may decide it"
            outcome = replace(outcome, reason=reason, retry=True)
        return self.result(verdict, outcome, disturbance=busy.disturbance, measure=measure)
