"""Gaps, rates and encoders of the states, as several behaviours need them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.median import median, percentile
from dexkit.hand import Floats

COARSEST = 0.02
"""Coarsest encoder step of a good hand, as a part of the joint's range."""


_FEW_CHANGES = 10
"""Fewest changes of q that show an encoder's step."""


_ON_LATTICE = 0.9
"""Part of the changes that must be multiples of an encoder's step: noise makes others."""


_OFF_LATTICE = 0.05
"""Tolerance of a multiple of the encoder's step, as a part of the step, for rounded values."""


def state_clocks(ctx: Context) -> Iterator[Floats]:
    """The times of the states for gaps and jitter.

    Source timestamps, and reception times if the recording says how late the kit was.
    """
    yield ctx.states.clock
    if ctx.recording.stimulus is not None:
        yield ctx.states.t


def gaps(ctx: Context, longer_than: float, begin: float, end: float) -> list[tuple[float, float]]:
    """Intervals within [begin, end] without state, longer than ``longer_than`` seconds."""
    found: list[tuple[float, float]] = []
    for clock in state_clocks(ctx):
        inside = clock[(clock >= begin) & (clock <= end)]
        edges = np.concatenate(([begin], inside, [end]))
        where = np.flatnonzero(np.diff(edges) > longer_than)
        again = [(float(edges[i]), float(edges[i + 1])) for i in where]
        found += [(a, b) for a, b in again if not any(x < b and a < y for x, y in found)]
    return sorted(found)


def longest_gap(ctx: Context, limit: float, begin: float, end: float) -> Measure:
    """The longest interval without state within [begin, end] against a limit, s."""
    longest = 0.0
    for clock in state_clocks(ctx):
        inside = clock[(clock >= begin) & (clock <= end)]
        edges = np.concatenate(([begin], inside, [end]))
        longest = max(longest, float(np.diff(edges).max()))
    return Measure(longest, limit, span=(begin, end))


def gap_beside_states(times: Floats, states: Floats) -> tuple[float, float]:
    """The longest interval between times beyond pauses of the states, and its begin.

    A restarted service or a paused machine is silent on all topics.
    """
    times = np.concatenate((times, states[-1:]))
    found = (0.0, float(times[0]))
    for begin, end in pairwise(times.tolist()):
        if end - begin > found[0]:
            own = states[(states > begin) & (states < end)]
            quiet = float(np.diff(np.concatenate(([begin], own, [end]))).max())
            found = max(found, (end - begin - quiet, begin))
    return found


def survived(ctx: Context, outcome: Outcome, gap: float) -> Outcome:
    """The outcome of a gap in the state, seconds: at most a warning where it is no longer than the
    requirement's ``survived_s``.
    """
    if gap > ctx.requirement.tolerances.get("survived_s", 0.0):
        return outcome
    return outcome.tolerated().because(
        "Real hands of this model were seen to lose their state for about a second, again and "
        "again. A client that waits for it stands still meanwhile, with both hands; one that goes "
        "by the age of the state holds its targets."
    )


def gap_measures(found: Iterable[tuple[float, float]], limit: float) -> list[Measure]:
    """The gaps (begin, end) as measures against the longest allowed one, s."""
    return [Measure(b - a, limit, span=(a, b)) for a, b in found]


def slow(ctx: Context, rate: float) -> bool:
    """Whether a measured rate is below the least that is allowed.

    The limit has a margin: clocks differ, and a window may cut an interval.
    """
    return rate < least_rate(ctx)


def least_rate(ctx: Context) -> float:
    """The lowest measured rate of a hand that meets the limit, Hz."""
    return (1 - ctx.tolerance("slack_part")) * ctx.tolerance("min_rate_hz")


def too_slow(ctx: Context, outcome: Outcome, rate: float) -> Outcome:
    """The outcome with its size: the delay of each state beyond the limit."""
    period = 1 / ctx.tolerance("min_rate_hz")
    size = 1 / rate - period if rate > 0 else math.inf
    return outcome.if_late(size, how="mean")


def encoder_step(ctx: Context, joint: int) -> float:
    """The step of the encoder of a joint, rad; 0 where q shows none of up to 2 % of the range."""
    coarsest = COARSEST * ctx.joints[joint].stroke
    course = Positions.from_context(ctx, joint)
    return ctx.once(("encoder", joint), lambda: course.encoder_step(coarsest))


@dataclass(frozen=True, eq=False)
class Positions:
    """The positions of a joint that are numbers, and where they change.

    :param changes: rows that differ from the one before; ``steps``: by how much, rad.
    """

    t: Floats
    q: Floats
    changes: NDArray[np.intp]
    steps: Floats

    @classmethod
    def from_context(cls, ctx: Context, joint: int) -> Positions:
        """A joint's data, cached for all checks."""
        return ctx.once_of_joint("course", joint, lambda: cls._from_states(ctx, joint))

    @classmethod
    def _from_states(cls, ctx: Context, joint: int) -> Positions:
        good = ctx.known_states(joint, "q")
        return cls.of(ctx.states.t[good], ctx.states.q[:, joint][good])

    @classmethod
    def of(cls, t: Floats, q: Floats) -> Positions:
        """Those of a column of numbers."""
        steps = np.diff(q)
        rows = np.flatnonzero(steps != 0)  # comparing bits is several times as fast
        return cls(t, q, rows + 1, steps[rows])

    def encoder_step(self, coarsest: float) -> float:
        """The step of the encoder that these positions come from, rad; 0 where they show none.

        With an encoder, changes are multiples of its step, and the positions lie on a grid: on two,
        if it is homed again at a restart of the service. Old values of a finer encoder may change
        by equal amounts at constant speed, but do not lie on a grid.

        :param coarsest: the largest step that counts as an encoder's, rad.
        """
        size = np.abs(self.steps)
        if len(size) < _FEW_CHANGES:
            return 0.0
        step = percentile(size, 5)
        if not 0.0 < step <= (1 + _OFF_LATTICE) * coarsest:
            return 0.0
        times = np.rint(size / step)
        step = median(size[times == 1])
        times = np.rint(size / step)
        on = (times >= 1) & (np.abs(size - times * step) <= _OFF_LATTICE * step)
        if on.mean() < _ON_LATTICE:
            return 0.0
        step = float(size[on].sum() / times[on].sum())
        phases = np.mod(self.q[self.changes], step) / step
        bins = np.sort(np.bincount((20 * phases).astype(np.intp) % 20, minlength=20))
        return step if bins[-4:].sum() >= _ON_LATTICE * len(phases) else 0.0

    def is_finer_than(self, step: float) -> bool:
        """Whether :meth:`encoder_step` is certain to give no more than this; it takes a tenth of
        the time.

        It looks for the step among changes of 0.5 to 1.5 times their 5th percentile, and changes
        its mind by no more than :data:`_OFF_LATTICE` of it.
        """
        rounding = 1.001
        small = np.abs(self.steps) <= step / (1.5 * (1 + _OFF_LATTICE) * rounding)
        return bool(np.count_nonzero(small) > 0.05 * len(small) + 1)

    def held(self, samples: float, which: NDArray[np.bool_]) -> bool:
        """Whether one of these changes follows this many states of one position."""
        chosen = np.flatnonzero(which)
        before = np.where(chosen > 0, self.changes[chosen - 1], 0)
        return bool((self.changes[chosen] - before >= samples).any())
