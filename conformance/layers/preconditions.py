"""What is asked before a check of any layer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dexkit.conformance.checks import BaseContext
    from dexkit.conformance.kit.results import Result
    from dexkit.conformance.kit.verdicts import Judgement

__all__ = ["claimed", "not_blocked", "not_spoiled"]


def claimed(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: the vendor does not disclaim the unit that the requirement is about."""
    return judgement.not_claimed()


def not_blocked(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: nothing has failed that the requirement depends on."""
    return judgement.blocked()


def not_spoiled(judgement: Judgement, context: BaseContext[Any, Any]) -> Result | None:
    """A precondition: the client's commands allow to judge it."""
    return judgement.spoiled()
