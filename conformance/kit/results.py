"""The result of a run: one object, from which every report is rendered.

:mod:`dexkit.conformance.kit.result_file` writes and reads it.

Verdicts (h2spec and Autobahn grade theirs likewise; a plain pass or fail hides too much):

============== ============================================================================
pass           judged, and met
fail           a MUST that is not met
warn           a SHOULD that is not met; does not fail the hand
not claimed    about a unit that the vendor does not claim (:mod:`~.claims`)
not applicable cannot be judged here, with the reason; never counts as a pass
blocked        another requirement failed first, the kit's own machine was too busy, or a MUST
               fails by less than the kit's measurement error (:mod:`~.measurement_error`)
error          the kit's own fault
============== ============================================================================
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

import msgspec

from dexkit import __version__
from dexkit.conformance.kit.measurement_error import Measure
from dexkit.conformance.kit.plots import Plot
from dexkit.conformance.kit.requirements import Kind, Level, Requirement
from dexkit.hand import Side

__all__ = [
    "SEVERITY",
    "UNDISTURBED",
    "Disturbance",
    "Evidence",
    "Grade",
    "Load",
    "Overall",
    "Result",
    "RunResult",
    "Stage",
    "Story",
    "Verdict",
    "counts_of",
    "environment",
    "grouped",
    "overall_of",
    "worst",
]


class Verdict(str, Enum):
    """The verdict on one requirement; see the module."""

    PASS = "pass"
    FAIL = "fail"
    WARN = "warn"
    NOT_CLAIMED = "not claimed"
    NOT_APPLICABLE = "not applicable"
    BLOCKED = "blocked"
    ERROR = "error"

    def __str__(self) -> str:
        return self.value

    @property
    def judged(self) -> bool:
        """Whether a check came to a finding about the hand."""
        return self in (Verdict.PASS, Verdict.FAIL, Verdict.WARN)


SEVERITY = [
    Verdict.FAIL,
    Verdict.ERROR,
    Verdict.BLOCKED,
    Verdict.WARN,
    Verdict.PASS,
    Verdict.NOT_CLAIMED,
    Verdict.NOT_APPLICABLE,
]
"""The verdicts, from that which counts most where several sides have one each."""


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The verdict that counts when several sides have one each."""
    return min(verdicts, key=SEVERITY.index, default=Verdict.NOT_APPLICABLE)


class Overall(str, Enum):
    """The verdict on the whole run, with its exit code."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"

    def __str__(self) -> str:
        return self.value

    @property
    def exit_code(self) -> int:
        """0 pass, 1 fail, 2 not usable."""
        return {Overall.PASS: 0, Overall.FAIL: 1, Overall.INCONCLUSIVE: 2}[self]


class Stage(str, Enum):
    """The stage that a hand reached."""

    NO_PARTICIPANT = "no participant"
    PARTICIPANT_SEEN = "participant seen"
    TOPIC_SEEN = "topic seen"
    TYPE_MATCHED = "type matched"
    SAMPLES_FLOWING = "samples flowing"
    MOVING = "moving"

    def __str__(self) -> str:
        return self.value


_Seconds = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
_Delay = Annotated[float, msgspec.Meta(ge=0, le=1e9)]


class Evidence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place in the recording.

    :param topic: topic of the samples.
    :param time_s: seconds from the beginning of the recording.
    :param log_time_ns: the same as a log time of the recording.
    :param end_s: end of the stretch, if it is one.
    """

    topic: str
    time_s: _Seconds
    log_time_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    end_s: _Seconds | None = None


class Load(str, Enum):
    """Whether the load of the machine that made the recording can have caused a failure."""

    NONE = "none"
    BUSY = "busy"
    """The machine was busy, but the failure is larger than its load explains."""
    TOO_BUSY = "too busy"
    """The load may have caused the failure."""

    def __str__(self) -> str:
        return self.value


class Disturbance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The load of the recording machine during a failure, and how much of it the load explains.

    :param late_s: by how much the kit's own timer was late at the failure's place, or for how long
        the hand's processes waited for a processor, seconds; None if it was not measured.
    :param explained_s: delay of a conforming hand that this load can cause, seconds.
    :param failure_s: delay of a conforming hand that would cause this failure, seconds; None if
        no delay can.
    """

    load: Load
    late_s: _Delay | None = None
    explained_s: _Delay | None = None
    failure_s: _Delay | None = None


UNDISTURBED = Disturbance(Load.NONE)


@dataclass(frozen=True)
class Result:
    """The result of one requirement on one side.

    :param figure: the measured figure in a few characters, for tables.
    :param observed: what was seen, in words.
    :param reason: why it was not judged, or empty.
    :param values: measured figures by name.
    :param cause: the cause of a failure, where its check could determine it.
    :param blocked_by: id of the requirement that failed first, or empty.
    :param joints: indices of the joints that the finding is about; empty if it is about none in
        particular.
    :param disturbance: what the load of the machine has to do with a failure.
    :param plots: what shows the finding.
    :param retry: whether another run may come to another finding.
    :param measure: the figure that it rests on, with its limit and the kit's error; None if it
        rests on none.
    :param tolerated: not met without consequence, so that nothing else is spoiled; known only while
        a recording is judged.
    """

    requirement: Requirement
    side: str
    verdict: Verdict
    figure: str = ""
    observed: str = ""
    reason: str = ""
    evidence: tuple[Evidence, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    cause: str = ""
    blocked_by: str = ""
    joints: tuple[int, ...] = ()
    disturbance: Disturbance = UNDISTURBED
    plots: tuple[Plot, ...] = ()
    retry: bool = False
    measure: Measure | None = None
    tolerated: bool = field(default=False, compare=False)

    @property
    def id(self) -> str:
        """Of the requirement."""
        return self.requirement.id

    @property
    def expected(self) -> str:
        """The expected result, in a few words."""
        return self.requirement.expected or self.requirement.sentence

    @property
    def within_error(self) -> bool:
        """Whether a failure was left open because the kit's measurement error explains it; the
        reason then has the measure's sentence.
        """
        return (
            self.verdict is Verdict.BLOCKED
            and self.disturbance.load is not Load.TOO_BUSY
            and self.measure is not None
            and self.measure.explains_failure
        )

    @property
    def measured(self) -> str:
        """The measure in one sentence; empty without one, and where the reason has it."""
        if self.measure is None or self.within_error:
            return ""
        return self.measure.sentence()

    def explain(self) -> str:
        """The result as the lines of a card; see :mod:`dexkit.conformance.report.card`."""
        from dexkit.conformance.report.card import Card

        return Card.from_results([self]).as_text()


class Story(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fault, and the requirements that are not met because of it; :mod:`~.stories` tells them.

    :param sentence: what was seen, with its figures.
    :param sides: whose.
    :param shown_by: id of the requirement whose finding it is; empty for what the states show by
        themselves.
    :param explains: ids of the requirements, ``shown_by`` first.
    :param evidence: the first places in the recording.
    """

    sentence: str
    sides: tuple[str, ...]
    shown_by: str
    explains: tuple[str, ...]
    evidence: tuple[Evidence, ...]


def environment() -> dict[str, str]:
    """Versions and machine, for the report."""
    return {
        "dexkit": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


def overall_of(results: Iterable[Result]) -> Overall:
    """Fail if a MUST failed; inconclusive if one is open, or nothing was judged at all."""
    found = list(results)
    if any(r.verdict is Verdict.FAIL for r in found):
        return Overall.FAIL
    opened = (Verdict.BLOCKED, Verdict.ERROR)
    if not any(r.verdict.judged for r in found) or any(
        r.verdict in opened and r.requirement.level is Level.MUST for r in found
    ):
        return Overall.INCONCLUSIVE
    return Overall.PASS


def grouped(results: Iterable[Result]) -> list[tuple[Requirement, list[Result]]]:
    """Results by requirement, in their order."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.requirement.id, []).append(result)
    return [(group[0].requirement, group) for group in groups.values()]


def counts_of(results: Iterable[Result]) -> dict[Verdict, int]:
    """Requirements by verdict, sides taken together."""
    rows = [worst(r.verdict for r in group) for _, group in grouped(results)]
    return {v: rows.count(v) for v in Verdict}


@dataclass(frozen=True)
class Grade:
    """The verdict on the requirements of one kind: drop-in, or safety.

    :param counts: those requirements by verdict, sides taken together.
    :param partial: whether the run was about a part of the catalogue: then a pass is one of that
        part only.
    """

    kind: Kind
    overall: Overall
    counts: Mapping[Verdict, int]
    partial: bool = False

    @classmethod
    def from_results(cls, kind: Kind, results: Iterable[Result], *, partial: bool = False) -> Grade:
        """The grade of the results of that kind."""
        found = [r for r in results if r.requirement.kind is kind]
        return cls(kind, overall_of(found), counts_of(found), partial)

    @property
    def total(self) -> int:
        """Number of requirements of this kind in the run."""
        return sum(self.counts.values())

    @property
    def judged(self) -> bool:
        """Whether the run has a result of the kind; a blocked requirement counts."""
        left_out = (Verdict.NOT_APPLICABLE, Verdict.NOT_CLAIMED)
        return any(n for v, n in self.counts.items() if v not in left_out)

    def sentence(self) -> str:
        """The grade in one sentence."""
        heads = {
            Overall.PASS: "A PART PASSES: every selected MUST that could be judged is met"
            if self.partial
            else "PASS: every MUST that could be judged is met",
            Overall.FAIL: "FAIL: a MUST is not met",
            Overall.INCONCLUSIVE: "INCONCLUSIVE: a MUST could not be judged",
        }
        head = heads[self.overall] if self.judged else "NOT JUDGED: nothing of this kind was tested"
        parts = [f"{n} {v}" for v, n in self.counts.items() if n]
        return f"{self.kind}: {head} ({self.total} requirements{''.join(f', {p}' for p in parts)})"


@dataclass
class RunResult:
    """A whole run.

    :param subject: what was judged: ``backend``, ``recording``, ``dialect``, ``sides``, ...
    :param stage: per side how far it got.
    :param duration_s: seconds of the recording.
    :param notes: remarks on the recording.
    :param harness: how fair the kit's own machine was, where it made the run: ``jitter_p50_ms``
        and ``jitter_p99_ms``, by which it was late itself, and ``starved``, the part of the run,
        0 to 1, in which programs waited for a processor; ``waited``, that in which a process of a
        hand waited for one, and ``longest_wait_ms``, for how long at once.
    :param claims: by unit, whether the vendor claims it; None without claims.
    :param catalogue: how many requirements there are for such a run, selected or not; 0 if it is
        not known.
    :param client: results of the requirements about the client that commands the hands, each for
        the hand of that side. They do not count in the verdict on the hands. Empty in a run of
        the kit, which is its own client.
    :param stories: what failed, put together; empty where nothing did.
    :param run: the run record (:mod:`~.run_record`); empty where no live run was made.
    """

    subject: dict[str, str]
    results: list[Result]
    stage: dict[str, Stage] = field(default_factory=dict)
    duration_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=environment)
    recorded_at: str = ""
    harness: dict[str, float] = field(default_factory=dict)
    claims: dict[str, bool] | None = None
    catalogue: int = 0
    client: list[Result] = field(default_factory=list)
    run: dict[str, str] = field(default_factory=dict)
    stories: list[Story] = field(default_factory=list)

    @property
    def hands(self) -> tuple[Side, ...]:
        """The hands that were judged; none for a robot."""
        names = self.subject.get("sides", "").split(", ")
        return tuple(side for side in Side if str(side) in names)

    @property
    def partial(self) -> bool:
        """Whether only a part of the catalogue was selected: no proof of a drop-in."""
        return not self.client_only and sum(self.counts().values()) < self.catalogue

    @property
    def starved(self) -> float:
        """Part of the run, 0 to 1, in which programs waited for a processor on its machine."""
        return self.harness.get("starved", 0.0)

    def counts(self) -> dict[Verdict, int]:
        """Requirements by verdict, sides taken together."""
        return counts_of(self.results)

    def grade(self, kind: Kind) -> Grade:
        """The verdict on the requirements of that kind."""
        return Grade.from_results(kind, self.results, partial=self.partial)

    def exit_code(self, kind: Kind | None = None) -> int:
        """0 pass, 1 fail, 2 not usable: of one kind, or of the whole run."""
        return (self.overall if kind is None else self.grade(kind).overall).exit_code

    def by_requirement(self) -> list[tuple[Requirement, list[Result]]]:
        """Results about the hands by requirement, in the catalogue's order."""
        return grouped(self.results)

    @property
    def judged(self) -> int:
        """How many results came to a finding: about the hands, or about the client where only
        requirements about it were selected.
        """
        return sum(r.verdict.judged for r in self.results or self.client)

    @property
    def client_only(self) -> bool:
        """Whether only requirements about the client were selected."""
        return bool(self.client) and not self.results

    @property
    def disturbed_by(self) -> list[Result]:
        """The results because of which the run should be done again, as the kit's own machine was
        busy: all that failed, if each was seen while it was so, or what is open only for that.
        """
        failed = [r for r in self.results if r.verdict is Verdict.FAIL]
        if failed:
            return failed if all(r.retry for r in failed) else []
        if self.overall is not Overall.INCONCLUSIVE:
            return []
        opened = [r for r in self.results if r.verdict is Verdict.BLOCKED and r.retry]
        return [r for r in opened if r.requirement.level is Level.MUST] or opened

    @property
    def overall(self) -> Overall:
        """The verdict on the hands, see :func:`overall_of`; on their client where only requirements
        about it were selected.
        """
        return overall_of(self.results or self.client)

    def sentence(self) -> str:
        """The verdict in one sentence."""
        if self.client_only:
            return self.client_sentence()
        counts = self.counts()
        total = sum(counts.values())
        parts = [f"{n} {v}" for v, n in counts.items() if n]
        spoiled = self.spoiled_by
        heads = {
            Overall.PASS: "PASS: every MUST that could be judged is met",
            Overall.FAIL: "FAIL: a MUST is not met",
            Overall.INCONCLUSIVE: "INCONCLUSIVE: nothing can be said of the hand"
            if self.judged == 0
            else "INCONCLUSIVE: a MUST could not be judged"
            + (f", because of the client ({', '.join(spoiled)})" if spoiled else ""),
        }
        of = f"{total} of {self.catalogue}" if self.partial else f"{total}"
        return f"{heads[self.overall]} ({of} requirements: {', '.join(parts)})"

    @property
    def spoiled_by(self) -> list[str]:
        """Ids of the requirements about the client that block a MUST of the hand."""
        blocked = {
            r.blocked_by
            for r in self.results
            if r.verdict is Verdict.BLOCKED and r.requirement.level is Level.MUST
        }
        about_client = dict.fromkeys(r.requirement.id for r in self.client)
        return [name for name in about_client if name in blocked]

    def client_sentence(self) -> str:
        """The verdict on the client in one sentence; empty if it was not judged."""
        if not self.client:
            return ""
        rows = [worst(r.verdict for r in group) for _, group in grouped(self.client)]
        parts = [f"{rows.count(v)} {v}" for v in Verdict if v in rows]
        heads = {
            Overall.PASS: "PASS: every MUST that could be judged is met",
            Overall.FAIL: "FAIL: a MUST is not met",
            Overall.INCONCLUSIVE: "INCONCLUSIVE: a MUST could not be judged",
        }
        return (
            f"the client: {heads[overall_of(self.client)]} ({len(rows)} requirements: "
            f"{', '.join(parts)})"
        )
