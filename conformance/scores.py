"""Describe, for every report, how many wrong hands a run like this one catches.

``scores.json`` beside this module holds what ``python -m tools.scores`` has found out: it tries
generated wrong hands (docs/mutants.md) in runs of each kind, on the virtual clock. A figure of the
file is about one model, one :class:`~dexkit.conformance.selection.RunKind` and one
:class:`Setting`. :func:`score_of` gives it to a run only if that was applied the same stimuli, was
judged on the same sides. A requirement that the run did not judge, as it was left out, blocked or
excused, catches nothing: the score is computed without it, and its sentence says so. Every other
run has no score, and says why.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from dexkit import documents
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.stimulus_record import Stimulus
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.models import MODELS
from dexkit.robots import ROBOTS

__all__ = [
    "FILE",
    "FORMAT",
    "NO_SCORE",
    "Caught",
    "Entry",
    "Score",
    "Setting",
    "catalogue_digest",
    "entries",
    "score_of",
    "wilson",
]

FILE = Path(__file__).with_name("scores.json")
FORMAT = "dexkit-scores"
_NAMED = 3
"""Requirements that a sentence names; it counts the others."""
_DIGESTED = (
    "id",
    "level",
    "kind",
    "needs",
    "after",
    "dialects",
    "tolerances",
    "realtime",
    "capability",
    "repeat",
    "like",
    "spoils",
)
"""Members of a requirement that change what it catches; the others are texts and plots."""


class Setting(str, Enum):
    """Setting of a run, besides its kind, that trials vary."""

    WHOLE = "whole"
    """The kit starts and ends the service, and there is an object in one hand."""
    EXTERNAL = "external"
    """The service runs already and is not restarted; nothing is in the hands."""

    def __str__(self) -> str:
        return self.value

    @property
    def remark(self) -> str:
        """Its description in a sentence; empty for a whole run."""
        whole = self is Setting.WHOLE
        return "" if whole else "; the service not restarted, nothing in the hands"


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """The confidence interval of a proportion by Wilson's score, 95 % by default.

    :returns: lower and upper bound, 0 to 1; the whole range where there is nothing to count.
    """
    if not count:
        return 0.0, 1.0
    p = hits / count
    scale = 1.0 + z * z / count
    middle = (p + z * z / (2 * count)) / scale
    half = z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count)) / scale
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Caught:
    """Number of caught hands of one grade.

    :param interval: 95 % confidence interval of their part, 0 to 1 (Wilson's score).
    """

    count: int
    caught: int
    interval: tuple[float, float]

    @classmethod
    def of(cls, found: Sequence[AbstractSet[str]], judged: AbstractSet[str]) -> Caught:
        """Count the hands of which a run catches some.

        :param found: for each hand, the requirements that catch it.
        :param judged: the requirements that the run judges.
        """
        caught = sum(bool(ids & judged) for ids in found)
        low, high = wilson(caught, len(found))
        return cls(len(found), caught, (round(low, 4), round(high, 4)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Caught:
        """Read it back from JSON."""
        low, high = values["interval"]
        return cls(values["count"], values["caught"], (low, high))

    def text(self) -> str:
        """``55 % (95 % interval 45 to 65 %)``."""
        low, high = self.interval
        part = self.caught / self.count
        return f"{100 * part:.0f} % (95 % interval {100 * low:.0f} to {100 * high:.0f} %)"


@dataclass(frozen=True)
class Score:
    """The score of a run, or why none is known.

    :param why: why none is known; empty where one is. The other members are then without meaning.
    :param run: the kind of the run.
    :param must_breaking: wrong hands that break a MUST, caught by a MUST that failed for a right
        reason; ``lesser`` those with lesser faults, noticed by a failure or a warning.
    :param seed: of the trial.
    :param catalogue: :func:`catalogue_digest` of the requirements that it was computed with.
    :param unjudged: requirements of such a run that this one did not judge on as many sides as the
        trial with a good hand; the hands that only they catch count as missed.
    """

    why: str = ""
    run: str = ""
    setting: str = ""
    must_breaking: Caught | None = None
    lesser: Caught | None = None
    seed: int = 0
    catalogue: str = ""
    unjudged: tuple[str, ...] = ()

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Score:
        """Read it back from a result file."""
        found = {name: value for name, value in values.items() if name != "sentence"}
        for name in ("must_breaking", "lesser"):
            if found[name] is not None:
                found[name] = Caught.from_dict(found[name])
        # files of earlier versions do not have it
        return cls(**{**found, "unjudged": tuple(found.get("unjudged", ()))})

    def sentence(self) -> str:
        """The score in one sentence, for people."""
        found = self.must_breaking
        if self.why or found is None or not found.count:
            return f"No score is known for this run: {self.why or 'no wrong hand was tried'}."
        remark = next((s.remark for s in Setting if str(s) == self.setting), "")
        without = ""
        if self.unjudged:
            without = f", without {_few(self.unjudged)}, not judged for each hand"
        return (
            f"In a trial of {found.count} generated wrong hands that break a MUST, a run like this "
            f"({self.run}{remark}) caught {found.text()}{without}."
        )

    def as_dict(self) -> dict[str, Any]:
        """The score as plain data."""
        return {"sentence": self.sentence(), **asdict(self)}


NO_SCORE = Score("the result holds none")
"""Of a result that was written before there were scores."""


@dataclass(frozen=True)
class Entry:
    """One entry of the file: hands of one model, tried in runs of one kind and setting.

    :param hands: how many were generated; those that cannot be distinguished from a good one are
        not counted.
    :param must_breaking: for each hand that breaks a MUST, the ids of the requirements that catch
        it, for a right reason; ``lesser`` for each of the others.
    :param phases: the phases of the stimulus that such a run asks for, and ``rounds`` how often.
    :param requirements: ids of those that such a run judges.
    :param fewer: by dialect, on how many sides of a good hand a requirement is judged in such a
        run: those that are not judged on both.
    """

    model: str
    run: str
    setting: str
    seed: int
    hands: int
    equivalent: int
    must_breaking: tuple[frozenset[str], ...]
    lesser: tuple[frozenset[str], ...]
    catalogue: str
    rounds: int
    phases: frozenset[str]
    requirements: tuple[str, ...]
    fewer: Mapping[str, Mapping[str, int]]

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Entry:
        """Read it back from JSON."""
        return cls(
            **{
                **values,
                "must_breaking": tuple(frozenset(ids) for ids in values["must_breaking"]),
                "lesser": tuple(frozenset(ids) for ids in values["lesser"]),
                "phases": frozenset(values["phases"]),
                "requirements": tuple(values["requirements"]),
            }
        )

    def as_dict(self) -> dict[str, Any]:
        """The entry as plain data."""
        return {
            **asdict(self),
            "must_breaking": [sorted(ids) for ids in self.must_breaking],
            "lesser": [sorted(ids) for ids in self.lesser],
            "phases": sorted(self.phases),
        }

    def score(self, unjudged: Sequence[str] = ()) -> Score:
        """The score of a run that the entry is about.

        :param unjudged: requirements of such a run that this one did not judge.
        """
        judged = frozenset(self.requirements) - frozenset(unjudged)
        return Score(
            run=self.run,
            setting=self.setting,
            must_breaking=Caught.of(self.must_breaking, judged),
            lesser=Caught.of(self.lesser, judged),
            seed=self.seed,
            catalogue=self.catalogue,
            unjudged=tuple(unjudged),
        )

    def unjudged(self, dialect: str, judged: Mapping[str, int]) -> list[str]:
        """Ids that are judged on fewer sides than in the trial."""
        fewer = self.fewer.get(dialect, {})
        return [r for r in self.requirements if judged.get(r, 0) < fewer.get(r, len(Side))]


@cache
def catalogue_digest(model: str) -> str:
    """Digest of a hand model's requirements on DDS: of their limits, not of their wording.

    It changes when a requirement comes or goes, or when its level, its limits, its stimulus or
    what it depends on changes.
    """
    found = [
        {name: value for name, value in asdict(r).items() if name in _DIGESTED}
        for r in sorted(catalogue(model), key=lambda r: r.id)
    ]
    text = json.dumps(found, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def entries(file: Path = FILE) -> tuple[Entry, ...]:
    """The entries of the file; none where there is no file: it is to be written first.

    :raises UsageError: it is another file.
    """
    if not file.exists():
        return ()
    data = documents.read_json(file)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise UsageError(f"{file} is no file of scores", hint="python -m tools.scores writes it")
    return tuple(Entry.from_dict(e) for e in data["scores"])


def score_of(
    model: str,
    dialect: str,
    sides: Sequence[str],
    stimulus: Stimulus | None,
    judged: Mapping[str, int],
    known: Sequence[Entry] | None = None,
) -> Score:
    """The score of a run.

    :param sides: of the hands that were judged.
    :param stimulus: the recording's stimulus record; None in a recording of a session.
    :param judged: on how many sides each requirement came to a finding, by its id.
    :param known: what there is to choose from; None for what the file has.
    """
    if stimulus is None:
        return Score("a recorded session was judged, and not a run of the conformance suite")
    of_model = [e for e in (entries() if known is None else known) if e.model == model]
    if not of_model:
        about = MODELS.get(model) or ROBOTS.get(model)
        return Score(
            f"no wrong {'robots' if model in ROBOTS else 'hands'} of the model "
            f"{about.title if about else model} have been tried"
        )
    if stimulus.planned is None:
        return Score("the recording does not say which stimuli were to be applied")
    of_kind = [
        e
        for e in of_model
        if (e.phases, e.rounds) == (stimulus.planned.phases, stimulus.planned.rounds)
    ]
    if not of_kind:
        return Score("its stimuli are those of no kind of run that was tried")
    if any(e.catalogue != catalogue_digest(model) for e in of_kind):
        return Score("the requirements have changed since wrong hands were tried on them")
    if len(sides) < len(Side):
        return Score(f"only the {' and '.join(sides)} hand was judged")
    held = any(place is not None for place in stimulus.objects.values())
    setting = Setting.WHOLE if held else Setting.EXTERNAL
    entry = next((e for e in of_kind if e.setting == setting), None)
    if entry is None:
        return Score("nothing was held, and the trial of such a run was with an object")
    return entry.score(entry.unjudged(dialect, judged))


def _few(ids: Sequence[str]) -> str:
    more = len(ids) - _NAMED
    return ", ".join(ids[:_NAMED]) + (f" and {more} more" if more > 0 else "")
