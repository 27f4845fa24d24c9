"""From a requirement and what its check found to a verdict; the same for topics and USB."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from dexkit.conformance.checks import Outcome
from dexkit.conformance.claims import Claims
from dexkit.conformance.requirements import Level, Requirement
from dexkit.conformance.results import Result, Verdict
from dexkit.hand import Side

__all__ = ["Judgement"]

_OPEN = (Verdict.FAIL, Verdict.BLOCKED, Verdict.ERROR)


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
            evidence=outcome.evidence,
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
        if outcome.met:
            return self.result(Verdict.PASS, outcome)
        if outcome.met is None and not (outcome.absent and self._claimed):
            return self.result(Verdict.NOT_APPLICABLE, outcome)
        if outcome.met is None:
            claim = f"{outcome.reason}, but the unit '{self.requirement.capability}' is claimed"
            outcome = replace(outcome, figure="absent", observed=claim, reason="")
        busy = excuse(outcome)
        if busy:
            return self.result(Verdict.BLOCKED, replace(outcome, reason=busy))
        must = self.requirement.level is Level.MUST
        return self.result(Verdict.FAIL if must else Verdict.WARN, outcome)
