"""Put together what several measurements say about one requirement: one that has two limits, the
lower of which only warns, or one about several members of a thing that goes wrong as a whole.

A part is an :class:`~dexkit.conformance.checks.Outcome`. What fails says so first; a part that is
:attr:`~dexkit.conformance.checks.Outcome.tolerated` only warns; what cannot be judged is left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from dexkit.conformance.checks import Outcome

__all__ = ["all_of", "warning"]


def warning(part: Outcome, *, unless_claimed: bool = False) -> Outcome:
    """The part with what it does not meet turned into a warning, whatever the level.

    :param unless_claimed: where the vendor claims the requirement's unit, it fails all the same.
    """
    if part.met is not False:
        return part
    return replace(part, tolerable=True, unless_claimed=unless_claimed)


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
        # each place has the delay of its own part, so only the first part's can stay
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
