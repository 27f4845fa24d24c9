"""From a requirement and what its check found to a verdict; the same for topics and USB."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol

from dexkit.conformance.checks import Outcome
from dexkit.conformance.claims import Claims
from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.results import TOO_BUSY, Result, Verdict
from dexkit.hand import Side

__all__ = ["Judgement", "Machine", "excuse"]

STARVED = 0.5
"""Part of a failure's time that must be starved for it not to be blamed on the hand."""
LATE = 0.5
"""Part of the time that a requirement allows by which the kit may be late itself."""

MOST_PLACES = 5
"""Places that a result names; all of them are looked at before a failure is excused."""

_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)


class Machine(Protocol):
    """What a recording says of the machine that the kit ran on."""

    def starved(self, begin: float, end: float) -> float:
        """Part of [begin, end], 0 to 1, in which it lacked processor time."""
        ...

    def lateness(self, begin: float, end: float) -> tuple[float, float] | None:
        """Median and 99th percentile, seconds, by which the kit was late; None if not known."""
        ...


def excuse(
    machine: Machine,
    requirement: Requirement,
    outcome: Outcome,
    whole: tuple[float, float] | None = None,
) -> str:
    """Why a failure is not blamed on the hand, or nothing: at every place of it the machine was
    starved, or the kit's own timers were as late as the hand is blamed for.

    :param whole: the run, for failures that have no place.
    """
    if not requirement.realtime:
        return ""
    spans = [(e.time_s, e.end_s) for e in outcome.evidence if e.end_s is not None]
    if whole is not None and not spans:
        spans = [whole]
    reasons = [_excuse(machine, requirement, *span) for span in spans]
    if not reasons or not all(reasons):
        return ""
    return f"{TOO_BUSY} to tell: {reasons[0]}; run again"


def _excuse(machine: Machine, requirement: Requirement, begin: float, end: float) -> str:
    share = machine.starved(begin, end)
    if share >= STARVED:
        return f"it lacked processor time for {share:.0%} of it"
    late = machine.lateness(begin, end)
    if late is None:
        return ""
    # what is late now and then moves the extremes; a mean rate suffers only from what is typical
    for name, limit in requirement.tolerances.items():
        extreme = name.startswith("max_") and name.endswith("_s")
        if not extreme and name != "min_rate_hz":
            continue
        allowed, by = (limit, late[1]) if extreme else (1 / limit, late[0])
        if by > LATE * allowed:
            which = "99th percentile" if extreme else "median"
            return (
                f"the kit was itself late by {by * 1e3:.1f} ms ({which}), where "
                f"{allowed * 1e3:.1f} ms are allowed"
            )
    return ""


class Judgement:
    """One requirement on one side, on its way to a :class:`Result`.

    :param requirement: at the level that the claims give it.
    :param found: the results of this side so far, by requirement.
    """

    def __init__(
        self, requirement: Requirement, side: Side, claims: Claims, found: Mapping[str, Result]
    ) -> None:
        self.requirement = requirement
        self._side = side
        self._claimed = claims.claimed(requirement)
        self._found = found

    def result(self, verdict: Verdict, outcome: Outcome, blocked_by: str = "") -> Result:
        """The result of that verdict."""
        cause = outcome.cause or self.requirement.cause
        return Result(
            requirement=self.requirement,
            side=str(self._side),
            verdict=verdict,
            figure=outcome.figure,
            observed=outcome.observed,
            reason=outcome.reason,
            evidence=outcome.evidence[:MOST_PLACES],
            values=outcome.values,
            cause=cause if verdict in (Verdict.FAIL, Verdict.WARN) else "",
            blocked_by=blocked_by,
        )

    def not_applicable(self, reason: str) -> Result:
        """It cannot be judged here."""
        return self.result(Verdict.NOT_APPLICABLE, Outcome(None, reason=reason))

    def not_claimed(self) -> Result | None:
        """The result, if it is about a unit that is not claimed."""
        if self._claimed is not False:
            return None
        unit = self.requirement.capability
        return self.result(
            Verdict.NOT_CLAIMED, Outcome(None, reason=f"the unit '{unit}' is not claimed")
        )

    def blocked(self) -> Result | None:
        """The result, if something failed that it depends on."""
        for before in self.requirement.after:
            if self._found[before].verdict in _OPEN:
                reason = f"blocked by {before}"
                return self.result(Verdict.BLOCKED, Outcome(None, reason=reason), before)
        return None

    def of(self, check: Callable[[], Outcome], excuse: Callable[[Outcome], str]) -> Result:
        """What the check finds.

        :param excuse: why a failure is not blamed on the hand, or empty.
        """
        try:
            outcome = check()
        except Exception as error:  # a check that breaks must not look like a hand that does
            text = f"the check itself failed: {type(error).__name__}: {error}"
            return self.result(Verdict.ERROR, Outcome(None, reason=text))
        if outcome.absent and self._claimed:
            unit = self.requirement.capability
            claim = f"{outcome.reason or outcome.observed}, but the unit '{unit}' is claimed"
            outcome = replace(outcome, met=False, figure="absent", observed=claim, reason="")
        if outcome.met is None:
            return self.result(Verdict.NOT_APPLICABLE, outcome)
        if outcome.met:
            return self.result(Verdict.PASS, outcome)
        busy = excuse(outcome)
        if busy:
            return self.result(Verdict.BLOCKED, replace(outcome, reason=busy))
        must = self.requirement.level is Level.MUST
        return self.result(Verdict.FAIL if must else Verdict.WARN, outcome)
