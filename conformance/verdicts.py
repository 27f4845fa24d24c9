"""Make a verdict of a requirement and its check's outcome; the same for DDS and USB.

**Machine or hand?** A machine that is short of processor time makes a correct hand look late. Only
requirements of real time can suffer from it, and only as far as the machine is shown to have been
late while it was judged:

1. Each failure has a size: the delay, in seconds, that would make a correct hand fail in the same
   way (:class:`~dexkit.conformance.checks.Late`). A rate of 150 Hz where 200 are asked for is
   1.7 ms late each time; 50 Hz is 15 ms; a gap of 0.3 s where 0.1 s are allowed is 0.2 s late once.
2. The kit's own timer is measured all the time (:mod:`~dexkit.conformance.heartbeat`). What it was
   late by at the failure's place, beyond what is usual on an idle machine, is what the machine has
   demonstrably lost.
3. The hand's process may have been hit harder: up to :data:`HARDEST` times that, and up to twice as
   much again in proportion to the time in which programs waited for a processor (Linux' pressure
   stall information). Pressure alone excuses nothing: it only scales what was lost.
4. Load varies. Of what recurs (a rate, a delay), the best quarter of the hand's values must be
   explained by the best quarter of the timer's as well: a hand that is slow even where the timer is
   on time is slow by itself.
5. On an overloaded machine, where the kit's own timer is late by :data:`OVERLOADED` on average over
   the whole run, single events and motion cannot be judged: how much a computing process was held
   up is not known there. What 4 does not explain, and what is wrong without moving, still fails.
6. A failure that is no larger than that at any of its places is *blocked*: the run is done again.
   A larger one is the hand's, and its result says what the machine does not explain. A run that
   fails by nothing but such results is done once more, and the second run counts.

7. Where the hand's processes run on this machine, what they waited for a processor is measured as
   well (:mod:`~dexkit.conformance.run_queue`), and explains a failure by itself: up to
   :data:`AGAIN` times what they waited at its place; a single event up to :data:`HOPS` times their
   longest wait; of all waits the part of which other programs are the cause. To wait is not to
   compute: a process that is slow by itself is not excused. This holds for motion that is not of
   real time, too: there a failure without a size is as large as its place is long. Where they
   waited for :data:`OVERLOADED` in each sample on average over the whole run, no requirement of
   real time can be judged, but for what 4 does not explain; the direction of motion can.
8. Apart from load, a MUST that fails by less than the kit's measurement error
   (:mod:`~dexkit.conformance.measurement_error`) is *blocked* as well: its figure is nearer to the
   limit than the kit can tell. A pass by less than that remains a pass, and says so.

So a gross failure fails on a busy machine, too; one at the border is blocked there; every failure
fails on an idle machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from dexkit.conformance.checks import Late, Outcome
from dexkit.conformance.claims import Claims
from dexkit.conformance.lateness import IDLE, Lateness
from dexkit.conformance.measurement_error import Measure
from dexkit.conformance.processor_waits import Starvation
from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.results import UNDISTURBED, Disturbance, Load, Result, Verdict
from dexkit.hand import Subject

__all__ = ["Excuse", "Judgement", "Machine", "excuse"]

HARDEST = 2.0
"""Assumed lateness of a hand's process as a multiple of that of the kit's timer: it has several
threads, and waits for its device."""
BUSY_SHARE = 0.5
"""Part of a failure's time with programs waiting for a processor that makes a machine busy."""
OVERLOADED = 3e-3
"""Seconds by which the kit's own timer, of 10 ms, is late on average on an overloaded machine; or
for which a hand's processes wait on average in a sample of 10 ms."""
AGAIN = 2.0
"""Largest delay of a hand as a multiple of what its processes waited: a thread that is late finds
its turn gone, and waits for the next one, or asks its device again."""
HOPS = 6
"""Times that a hand waits for a processor from a command to the state that shows it: to receive it,
to pass it to the device, there, to pass the answer back, to read it, to publish. A single event is
late by so many of the longest wait at most, however often there are short ones."""
AFTERMATH = 1.0
"""Seconds before a failure from which a wait can still show: in a motion that began late, or in
that of a driver that has to reach its device again."""
_STILL = ("nothing", "endpoints", "state")
"""Needs of requirements that a hand cannot fail for lack of processor time, unless they are
real-time requirements."""
NOTABLE = 0.1
"""Part of a failure that the machine must explain to be mentioned."""
SHORT = 1.0
"""Seconds before a failure that has no end, in which the machine may have caused it."""

_TOO_BUSY = "the machine was too busy"
_BUSY = "the machine was busy"

MOST_PLACES = 5
"""Places that a result names; all of them are looked at before a failure is excused."""

_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)
_NOT_MET = (Verdict.FAIL, Verdict.WARN)


class Machine(Protocol):
    """Data in a recording about the machine that the kit ran on."""

    def starved(self, begin: float, end: float) -> float:
        """Part of [begin, end], 0 to 1, in which programs waited for a processor."""
        ...

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
    :param final: no load, however heavy, makes a good hand look like this.
    """

    disturbance: Disturbance = UNDISTURBED
    text: str = ""
    final: bool = False

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
        (e.time_s, e.end_s) if e.end_s is not None else (e.time_s - SHORT, e.time_s)
        for e in outcome.evidence
    ]
    if whole is not None and not spans:
        spans = [whole]
    failures = [
        _Failure(size, outcome.late, *span)
        for size, span in zip(_sizes(outcome, spans), spans, strict=True)
    ]
    overloaded = _overloaded(machine, whole)
    if requirement.realtime:
        by_timer = _least([_late(machine, f) for f in failures])
        overloaded = overloaded or _always_starved(machine, subject, whole)
        if overloaded and not by_timer.final:
            by_timer = overloaded
    else:
        by_timer = overloaded or Excuse()
    if by_timer.excused:
        return by_timer
    by_waits = _least([_starved(machine, subject, f) for f in failures])
    return by_waits if by_waits.excused or not by_timer.text else by_timer


def _least(found: Sequence[Excuse]) -> Excuse:
    """The excuse of all places of a failure: the one of that which is hardest to explain."""
    return min(found, key=lambda e: e.excused, default=Excuse())


@dataclass(frozen=True)
class _Failure:
    """A failure at one of its places.

    :param size: the delay, seconds, that would make a correct hand fail in the same way.
    """

    size: float
    late: Late | None
    begin: float
    end: float

    @property
    def how(self) -> str:
        return self.late.how if self.late else "total"

    @property
    def best(self) -> float:
        return self.late.best if self.late else 0.0

    @property
    def finite(self) -> float | None:
        return self.size if math.isfinite(self.size) else None


def _overloaded(machine: Machine, whole: tuple[float, float] | None) -> Excuse | None:
    """The excuse of a machine that was overloaded during the whole run; None if it was not."""
    lost = machine.excess_lateness(*whole) if whole is not None else None
    if lost is None or lost.mean < OVERLOADED:
        return None
    return Excuse(
        Disturbance(Load.TOO_BUSY, lost.mean),
        f"{_TOO_BUSY} to tell: the kit's own timer was late by {_ms(lost.mean)} each time, over "
        "the whole run; run again",
    )


def _always_starved(
    machine: Machine, subject: Subject, whole: tuple[float, float] | None
) -> Excuse | None:
    """The excuse of a hand whose processes lacked a processor all the time; None if they had it."""
    there = machine.starvation(subject, *whole) if whole is not None else None
    if there is None or there.lost.mean < OVERLOADED:
        return None
    return Excuse(
        Disturbance(Load.TOO_BUSY, there.lost.mean),
        f"{_TOO_BUSY} to tell: {there.worst.process} waited for a processor for "
        f"{there.worst.part:.0%} of the whole run; close other programs or use another machine",
    )


def _sizes(outcome: Outcome, spans: Sequence[tuple[float, float]]) -> Sequence[float]:
    """The delay, in seconds, that would make a correct hand fail at each place."""
    if outcome.late is None:
        return [end - begin for begin, end in spans]
    sizes = outcome.late.seconds
    return sizes if len(sizes) == len(spans) else [max(sizes)] * len(spans)


_HOW = {"total": "in all", "chain": "in all", "mean": "each time", "p99": "one time in a hundred"}


def _late(machine: Machine, failure: _Failure) -> Excuse:
    """Whether what the kit's own timer was late by explains a failure."""
    size, best = failure.size, failure.best
    lost = machine.excess_lateness(failure.begin, failure.end)
    share = min(machine.starved(failure.begin, failure.end), 1.0)
    if lost is None:
        return Excuse()
    measured = lost.figure(failure.how)
    harder = HARDEST * (1.0 + share)
    explained = harder * measured
    was = f"the kit's own timer was late by {_ms(measured)} {_HOW[failure.how]} there"
    by_fits = best > IDLE + harder * lost.best
    if not by_fits and measured > 0 and explained >= size:
        return Excuse(
            Disturbance(Load.TOO_BUSY, measured, explained, failure.finite),
            f"{_TOO_BUSY} to tell: {was}, so a good hand may have been {_ms(size)} late; run again",
        )
    final = by_fits or failure.finite is None
    if not (share >= BUSY_SHARE or explained >= NOTABLE * size):
        return Excuse(final=final)
    if by_fits:
        why = f"by fits, and the hand is {_ms(best)} late in its best quarter, too"
    elif failure.finite is None:
        why = "no delay makes a good hand look like this"
    else:
        why = f"{was}, which explains at most {_ms(explained)} of {_ms(size)}"
    disturbance = Disturbance(Load.BUSY, measured, explained, failure.finite)
    return Excuse(disturbance, f"{_BUSY}, but {why}", final)


def _starved(machine: Machine, subject: Subject, failure: _Failure) -> Excuse:
    """Whether the time that the hand's processes waited for a processor explains a failure."""
    # what happens once can be the end of what was held up before
    before = AFTERMATH if failure.how in ("total", "chain") else 0.0
    there = machine.starvation(subject, failure.begin - before, failure.end)
    if there is None:
        return Excuse()
    measured = there.lost.figure(failure.how)
    explained = AGAIN * measured
    if failure.how == "total":
        explained = min(explained, HOPS * there.longest)
    worst = there.worst
    was = (
        f"{worst.process} waited for a processor for {worst.part:.0%} of the time there, up to "
        f"{_ms(worst.longest)} at once"
    )
    by_fits = failure.best > IDLE + AGAIN * there.lost.best
    if not by_fits and measured > 0 and explained >= failure.size:
        return Excuse(
            Disturbance(Load.TOO_BUSY, measured, explained, failure.finite),
            f"{_TOO_BUSY} to tell: {was}, so a good hand may have been {_ms(failure.size)} late; "
            "close other programs or use another machine",
        )
    if failure.finite is None or explained < NOTABLE * failure.size:
        return Excuse()
    why = f"which explains at most {_ms(explained)} of {_ms(failure.size)}"
    if by_fits:
        why = f"but by fits, and the hand is {_ms(failure.best)} late in its best quarter, too"
    disturbance = Disturbance(Load.BUSY, measured, explained, failure.finite)
    return Excuse(disturbance, f"{_BUSY}: {was}, {why}")


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
        cause = outcome.cause or self.requirement.cause
        return Result(
            requirement=self.requirement,
            side=str(self.subject),
            verdict=verdict,
            figure=outcome.figure,
            observed=outcome.observed,
            reason=outcome.reason,
            evidence=outcome.evidence[:MOST_PLACES],
            values={name: float(value) for name, value in outcome.values.items()},
            cause=cause if verdict in (Verdict.FAIL, Verdict.WARN) else "",
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
                outcome, met=False, figure="absent", observed=claim, reason=""
            ).because(f"Nothing fills it: either do, or do not claim '{unit}'.")
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
        measure = weigh(outcome)
        if verdict is Verdict.FAIL and measure is not None and measure.explains_failure:
            verdict = Verdict.BLOCKED
            reason = f"{measure.sentence()}; a quieter machine or another run may decide it"
            outcome = replace(outcome, reason=reason, retry=True)
        return self.result(verdict, outcome, disturbance=busy.disturbance, measure=measure)
