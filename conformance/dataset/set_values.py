"""Compare what the numbers of the episodes of a set mean, and what its metadata say of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dexkit.conformance.dataset.checks.grasps import CLOSED, CLOSINGS, HOLDS
from dexkit.conformance.dataset.checks.metadata import differs
from dexkit.conformance.dataset.findings import Finding, Judgement, Use
from dexkit.conformance.dataset.whole_set import WholeSet
from dexkit.hand import Floats

__all__ = ["grasps_of_set", "statistics_of_set", "units_of_set"]

_OTHERS = 4  # episodes with this hand closing, from which it is usual to hold something
_USUAL = 0.8  # of them, that hold something
_HELD_S = 0.4  # s: less is not held
_BRIEF = 0.25  # of the time that others hold it: a hand that turns at once is short of its action
_WORKS = 0.33  # of a set's episodes, in which a hand holds something that does a part of its task
_FURTHER = 8.0  # % of its way that a hand closes further on nothing than on what others hold
_ONE = (0.93, 1.05)  # where a joint that counts 0 to 1 ends
_RADIANS = 1.8  # least end of the same joint in the other episodes, where it does not count so
_SAME_END = 0.1  # of that end, by which the others differ: they all open wholly

_Found = Iterator[tuple[str, Finding]]


def grasps_of_set(judgements: Mapping[str, Judgement]) -> _Found:
    """Episodes in which a hand closes on nothing, and holds something in all others.

    Two hands that hold nothing are meant so. Where the other hand does the task, so is one that
    opens and closes again and again; a hand that the set needs alone has not done it.
    """
    hands = dict.fromkeys(
        name.removesuffix(HOLDS)
        for j in judgements.values()
        for name in j.figures
        if name.endswith(HOLDS)
    )
    times = {h: [j.figures.get(h + HOLDS, 0.0) for j in judgements.values()] for h in hands}
    works = {h for h in hands if np.mean(np.array(times[h]) > _HELD_S) > _WORKS}
    for hand in hands:
        held = {
            name: (j.figures[hand + HOLDS], j.figures.get(hand + CLOSED, 0.0))
            for name, j in judgements.items()
            if hand + HOLDS in j.figures
        }
        usual = [found for found in held.values() if found[0] > _HELD_S]
        if len(held) <= _OTHERS or len(usual) < _USUAL * (len(held) - 1):
            continue
        time, depth = np.median(usual, axis=0).tolist()
        others = works - {hand}
        for name, (seconds, closed) in held.items():
            figures = judgements[name].figures
            if (
                seconds > _BRIEF * time
                or closed < depth + _FURTHER
                or any(figures.get(other + HOLDS) == 0 for other in others)
                or (others and figures.get(hand + CLOSINGS) != 1)
                or judgements[name].use is Use.DROP
            ):
                continue
            yield (
                name,
                Finding(
                    "grasp",
                    Use.REVIEW,
                    f"the {hand} closes on nothing, to {closed:.0f} % of its way; it holds "
                    f"something at {depth:.0f} % in {len(usual)} of {len(held)} episodes",
                    part=hand.replace(" ", "_"),
                    value=round(closed, 1),
                    limit=round(depth + _FURTHER, 1),
                    unit="%",
                ),
            )


def units_of_set(judgements: Mapping[str, Judgement]) -> _Found:
    """Episodes in which joints count 0 to 1 that go to 2 rad or more in all others."""
    tables = {name: j.sums for name, j in judgements.items() if len(j.sums) > 1}
    names = list(tables)
    if len(names) <= _OTHERS:
        return
    features = [f for f in next(iter(tables.values())) if all(f in t for t in tables.values())]
    suspects: dict[str, set[str]] = {}
    for feature in features:
        rows = [tables[name][feature] for name in names]
        if len({len(row[0]) for row in rows}) > 1:
            continue
        low, high = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
        one = (high >= _ONE[0]) & (high <= _ONE[1]) & (low > -0.1)
        # others end where the joint does; a few may have the same fault
        middle = np.median(high, axis=0)
        same = np.abs(high - middle) < _SAME_END * middle
        usual = (middle > _RADIANS) & (same.sum(axis=0) >= _USUAL * (len(names) - 1))
        for i in np.flatnonzero((one & usual).any(axis=1)).tolist():
            suspects.setdefault(names[i], set()).add(feature)
    for name, where in suspects.items():
        if {"observation.state", "action"} <= where and not any(
            f.check == "units" for f in judgements[name].reasons
        ):
            yield (
                name,
                Finding(
                    "units",
                    Use.REVIEW,
                    "joints go from 0 to 1 that go further than 1.8 rad in the other episodes of "
                    "the set: they are in parts of their way, not in radians (likely)",
                ),
            )


def statistics_of_set(judgements: Mapping[str, Judgement], whole: WholeSet) -> Iterator[Finding]:
    """What the metadata state of all frames, against the frames."""
    if whole.refused or len(judgements) != len(whole.episodes):
        return  # of some frames nothing is known
    for feature, stated in whole.stated.items():
        sums = [j.sums[feature] for j in judgements.values() if feature in j.sums]
        if len(sums) != len(judgements) or len({len(s[0]) for s in sums}) > 1:
            continue
        true, count = _joined(sums)
        told = stated.get("count")
        if told is not None and told.size and int(told.flat[0]) != count:
            yield Finding(
                "statistics",
                Use.REVIEW,
                f"the metadata count {int(told.flat[0])} frames of {feature} in the set, there "
                f"are {count}",
            )
            continue
        wrong = {n: text for n in true if (text := differs(stated.get(n), true[n], true))}
        if wrong:
            yield Finding(
                "statistics",
                Use.REVIEW,
                f"the metadata state other numbers of {feature} than the set has: "
                + "; ".join(f"{n} {text}" for n, text in wrong.items()),
            )


def _joined(sums: list[list[list[float]]]) -> tuple[dict[str, Floats], int]:
    """Minimum, maximum, mean and standard deviation of all frames, and their number."""
    low, high, mean, std = (np.array([s[i] for s in sums]) for i in range(4))
    counts = np.array([s[4][0] for s in sums])[:, None]
    total = counts.sum()
    middle = (counts * mean).sum(axis=0) / total
    square = (counts * (std**2 + (mean - middle) ** 2)).sum(axis=0) / total
    return (
        {
            "min": low.min(axis=0),
            "max": high.max(axis=0),
            "mean": middle,
            "std": np.sqrt(square),
        },
        int(total),
    )
