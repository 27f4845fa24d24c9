"""What the metadata say of an episode: its task, its statistics, and what could not be read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from dexkit.conformance.dataset.check import Check, Data
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.limits import rows_of
from dexkit.hand import Floats

__all__ = ["CHECKS", "differs", "sums_of"]

_OFF = 0.02  # of the range of a value: more than rounding, or a sample of the frames, makes
_ROUNDED = 2e-4  # of the size of a value, that files with few digits lose
_NO_TASK = frozenset(
    {"todo", "tbd", "none", "null", "nan", "n/a", "na", "-", "?", "unknown", "..."}
)
_NAMES_NOTHING = frozenset({"task", "test", "task description", "demo", "default", "debug"})

_LOST = (
    "cut or damaged",
    "is no list of numbers",
    "is no vector of numbers",
    "values instead of",
    "not finite",
    "no objects",
    "is no object",
    "other joints than elsewhere",
    "does not ascend",
    "do not ascend",
    "cannot be read",
    "are left out",
    "are too large",
    "by the list of episodes",
)
"""Words of the importer's sentences that say that data of joints are lost or in doubt."""
_PICTURES = ("picture", "video", "camera")
_ELSEWHERE = ("left and right hand",)  # judged by the checks of sides


def _task(episode: Episode) -> Iterator[Finding]:
    texts = [text.strip() for text in episode.tasks or ()]
    told = [text for text in texts if text and text.lower().strip("<>[]().") not in _NO_TASK]
    if not told:
        only = next((f", only {text!r}" for text in texts if text), "")
        yield Finding(
            "task", Use.REVIEW, f"it has no task text{only}, which policies with language need"
        )
    elif any("\ufffd" in text for text in told):
        yield Finding(
            "readable", Use.REVIEW, f"its task text is not UTF-8, and is damaged: {told[0]!r}"
        )
    elif all(text.lower().strip("<>[]().") in _NAMES_NOTHING for text in told):
        yield Finding("task", Use.KEEP, f"its task is called {told[0]!r}, which says nothing of it")


def _statistics(episode: Episode) -> Iterator[Finding]:
    for feature, stated in episode.stated.items():
        values = episode.features.get(feature)
        if values is None or not len(values):
            continue
        count = stated.get("count")
        if count is not None and count.size and int(count.flat[0]) != len(values):
            yield Finding(
                "statistics",
                Use.REVIEW,
                f"the metadata count {int(count.flat[0])} frames of {feature}, there are "
                f"{len(values)}",
                value=float(count.flat[0]),
                limit=float(len(values)),
            )
            continue
        true = numbers_of(episode).get(feature, {})
        wrong = {name: d for name in true if (d := differs(stated.get(name), true[name], true))}
        if wrong:
            yield Finding("statistics", Use.REVIEW, _sentence(feature, wrong, "the episode"))


def _sentence(feature: str, wrong: dict[str, str], whose: str) -> str:
    what = "; ".join(f"{name} {text}" for name, text in wrong.items())
    return f"the metadata state other numbers of {feature} than {whose} has: {what}"


@lru_cache(maxsize=1)  # of the episode that is being judged: it is needed twice
def numbers_of(episode: Episode) -> dict[str, dict[str, Floats]]:
    """By feature ``min``, ``max``, ``mean`` and ``std`` of each element, shape (elements,), of the
    frames that are finite.
    """
    found = {}
    for feature, values in episode.features.items():
        rows = rows_of(values)
        if len(rows):
            found[feature] = {
                "min": rows.min(axis=0),
                "max": rows.max(axis=0),
                "mean": rows.mean(axis=0),
                "std": rows.std(axis=0),
            }
    return found


def sums_of(episode: Episode) -> dict[str, list[list[float]]]:
    """The same in few digits, with the number of frames, for :attr:`Judgement.sums`."""
    return {
        feature: [
            *([float(f"{v:.7g}") for v in numbers.tolist()] for numbers in found.values()),
            [float(len(episode.features[feature]))],
        ]
        for feature, found in numbers_of(episode).items()
    }


def differs(stated: Floats | None, true: Floats, all_true: dict[str, Floats]) -> str:
    """How a stated number of each element differs from the true one; empty if it does not.

    :param all_true: with ``min`` and ``max``, which say what a large difference is.
    """
    if stated is None:
        return ""
    stated = np.ravel(stated)
    if stated.shape != true.shape:
        return f"has {stated.size} elements instead of {true.size}"
    low, high = all_true["min"], all_true["max"]
    size = np.maximum(np.abs(low), np.abs(high))
    allowed = _OFF * (high - low) + _ROUNDED * size + 1e-6
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(stated - true) <= allowed)
    if not wrong.any():
        return ""
    worst = int(np.argmax(np.nan_to_num(np.abs(stated - true) / allowed, nan=np.inf)))
    return (
        f"of {int(wrong.sum())} of {true.size} elements, such as {stated[worst]:.4g} for "
        f"{true[worst]:.4g} of element {worst}"
    )


def _readable(episode: Episode) -> Iterator[Finding]:
    for text in episode.problems:
        if any(words in text for words in _ELSEWHERE):
            continue
        lost = any(words in text for words in _LOST) and not any(w in text for w in _PICTURES)
        yield Finding("readable", Use.REVIEW if lost else Use.KEEP, text)
    tracks = episode.tracks
    if not any(t.action is not None and np.isfinite(t.action).any() for t in tracks):
        yield Finding("readable", Use.REVIEW, "it has no action, so that nothing can be learnt")
    if not any(t.state is not None and np.isfinite(t.state).any() for t in tracks):
        yield Finding("readable", Use.REVIEW, "it has no observation of joints")


CHECKS = (
    Check("task", "No task text", frozenset({Data.TASK}), _task),
    Check(
        "statistics",
        "Statistics that are not those of the data",
        frozenset({Data.STATISTICS}),
        _statistics,
    ),
    Check("readable", "Data that cannot be read", frozenset(), _readable),
)
