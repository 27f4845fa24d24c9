"""Combine the outcomes of the parts of one requirement.

Some requirements have two limits, of which the stricter only warns, or cover several values that go
wrong together. Each part is measured by itself and gives an
:class:`~dexkit.conformance.checks.Outcome`: parts that fail come first, then parts that only warn
(:attr:`~dexkit.conformance.checks.Outcome.tolerable`); parts that cannot be judged are left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from dexkit.conformance.checks import Outcome

__all__ = ["all_of", "warning"]


def warning(part: Outcome, *, unless_claimed: bool = False) -> Outcome:
    """The part, which only warns where it is not met, whatever the requirement's level.

    :param unless_claimed: where the vendor claims the requirement's unit, it fails all the same.
    """
    if part.met is not False:
        return part
    return replace(part.tolerated(), unless_claimed=unless_claimed)


def all_of(*parts: Outcome) -> Outcome:
    """The outcome of a requirement with these parts.

    Met where each part is that could be judged. Where some are not, the first that fails is the
    outcome, or the first that warns, and what the others of that kind observed is added. With no
    part that could be judged, the first says why, or one that nothing fills. Then all of it is
    absent, whatever else is met.
    """
    judged = [part for part in parts if part.met is not None]
    if not judged:
        return next((part for part in parts if part.absent), parts[0])
    values = {name: value for part in judged for name, value in part.values.items()}
    worst = [part for part in judged if not part.met and not part.tolerable]
    worst = worst or [part for part in judged if not part.met]
    if not worst:
        return replace(
            judged[0],
            figure=_joined(part.figure for part in judged),
            observed=_joined(part.observed for part in judged),
            values=values,
            absent=any(part.absent for part in parts),
            measures=tuple(measure for part in judged for measure in part.measures),
        )
    return replace(
        worst[0],
        observed=_joined(part.observed for part in worst),
        evidence=tuple(place for part in worst for place in part.evidence),
        values=values,
        # of several parts, how long each place lasts says how late a good hand had to be
        late=worst[0].late if len(worst) == 1 else None,
        absent=any(part.absent for part in parts),
        joints=tuple(dict.fromkeys(joint for part in worst for joint in part.joints)),
        retry=any(part.retry for part in worst),
        # a part without one fails for certain, whatever the kit's error is
        measures=tuple(measure for part in worst for measure in part.measures)
        if all(part.measures for part in worst)
        else (),
    )


def _joined(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(text for text in texts if text))
