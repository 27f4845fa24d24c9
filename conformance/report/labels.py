"""Names that all reports share: verdicts, hands, quantities, real or emulated hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone

from dexkit.conformance.kit.catch_rates import BLAME_RATES, CATCH_RATES, wilson
from dexkit.conformance.kit.requirements import Kind
from dexkit.conformance.kit.results import Grade, Overall, RunResult, Verdict, worst
from dexkit.hand import ROBOT
from dexkit.models import MODELS
from dexkit.robots import ROBOTS

__all__ = [
    "ANSWERS",
    "VERDICTS",
    "Tally",
    "Word",
    "about_harness",
    "answer_of",
    "capital",
    "catch_sentence",
    "count_verdicts",
    "device_kind",
    "hand_name",
    "model_title",
    "part",
    "quantity",
    "subject",
    "utc_date",
    "verdicts_by_area",
    "whose",
]


@dataclass(frozen=True)
class Word:
    """Text of a verdict.

    :param css: class of the page that colours it.
    :param mark: one sign, for tables in Markdown.
    """

    text: str
    css: str
    mark: str


VERDICTS = {
    Verdict.PASS: Word("pass", "ok", "✅"),
    Verdict.FAIL: Word("fail", "bad", "❌"),
    Verdict.WARN: Word("warn", "warn", "⚠️"),
    Verdict.NOT_CLAIMED: Word("not claimed", "na", "➖"),
    Verdict.NOT_APPLICABLE: Word("not applicable", "na", "➖"),
    Verdict.BLOCKED: Word("blocked", "open", "⛔"),
    Verdict.ERROR: Word("error", "open", "💥"),
}
ANSWERS = {
    Overall.PASS: Word("Pass", "ok", "✅"),
    Overall.FAIL: Word("Fail", "bad", "❌"),
    Overall.INCONCLUSIVE: Word("Inconclusive", "open", "❔"),
}
_NOT_JUDGED = Word("Not judged", "open", "❔")
_UNITS = {
    "s": "s",
    "ms": "ms",
    "hz": "Hz",
    "rad": "rad",
    "travel": "of the full travel",
    "nm": "N m",
    "stroke": "of the stroke",
    "part": "",
    "v": "V",
}


@dataclass(frozen=True)
class Tally:
    """Requirements by verdict, sides together, those of other dialects left out.

    :param applicable: all that apply to this hand's dialect and claims.
    """

    passed: int
    failed: int
    warned: int
    open: int
    not_judged: int
    not_claimed: int

    @property
    def applicable(self) -> int:
        """Requirements that apply to the hand."""
        return self.passed + self.failed + self.warned + self.open + self.not_judged


def answer_of(grade: Grade) -> Word:
    """Text of a grade; *not judged* if the run tested nothing of its kind."""
    return ANSWERS[grade.overall] if grade.judged else _NOT_JUDGED


def count_verdicts(result: RunResult, kind: Kind | None = None) -> Tally:
    """Count the requirements of a run.

    :param kind: only those of that kind.
    """
    spoken = result.subject.get("dialect")
    found = [
        worst(r.verdict for r in group)
        for requirement, group in result.by_requirement()
        if (not spoken or spoken in requirement.dialects) and kind in (None, requirement.kind)
    ]
    return Tally(
        passed=found.count(Verdict.PASS),
        failed=found.count(Verdict.FAIL),
        warned=found.count(Verdict.WARN),
        open=found.count(Verdict.BLOCKED) + found.count(Verdict.ERROR),
        not_judged=found.count(Verdict.NOT_APPLICABLE),
        not_claimed=found.count(Verdict.NOT_CLAIMED),
    )


def verdicts_by_area(result: RunResult) -> dict[str, list[Verdict]]:
    """The verdicts of the requirements of each area, sides together."""
    found: dict[str, list[Verdict]] = {}
    for requirement, group in result.by_requirement():
        found.setdefault(requirement.area, []).append(worst(r.verdict for r in group))
    return found


def model_title(result: RunResult) -> str:
    """``Dex1-1``, or ``hand`` where the model is not known."""
    name = result.subject.get("model", "")
    known = MODELS.get(name) or ROBOTS.get(name)
    return known.title if known else "hand"


def catch_sentence(result: RunResult) -> str:
    """How many wrong hands of that model runs of the kit catch, and how many legal ones they blame,
    whatever this run has found.
    """
    model = result.subject.get("model", "")
    caught, blamed = _of_each_kind(CATCH_RATES, model), _of_each_kind(BLAME_RATES, model)
    if not caught:
        return "A run does not find every fault; how many has not been measured for this model."
    return (
        "A run does not find every fault: of generated wrong hands that break a MUST of a "
        f"{model_title(result)}, caught {caught}. Of generated legal ones, failed {blamed}."
    )


def _of_each_kind(rates: Mapping[str, Mapping[str, tuple[int, int]]], model: str) -> str:
    parts = []
    for kind, (hits, tried) in rates.get(model, {}).items():
        low, high = (f"{100 * bound:.0f}" for bound in wilson(hits, tried))
        parts.append(f"a {kind} run {hits} of {tried} (95 % interval {low} to {high} %)")
    return " and ".join(parts)


def subject(result: RunResult, *, many: bool = False) -> str:
    """``hand`` or ``robot``: the subject; with ``many``, ``hands`` where there may be two."""
    if result.subject.get("model") in ROBOTS:
        return "robot"
    return "hands" if many else "hand"


def whose(side: str) -> str:
    """``left hand``, or ``robot`` where there are no sides."""
    return "robot" if side == ROBOT else f"{side} hand"


def hand_name(result: RunResult) -> str:
    """The hand's name: from its vendor, the backend, or the recording."""
    about = result.subject
    name = about.get("hand") or about.get("backend") or about.get("recording") or "unnamed hand"
    if about.get("hand") and about.get("firmware"):
        name += f" {about['firmware']}"
    return name


def part(result: RunResult) -> str:
    """A note for a run with only a part of the catalogue selected, else an empty text."""
    if not result.partial:
        return ""
    n = len(result.by_requirement())
    return f"Only {n} of {result.catalogue} requirements were selected"


def device_kind(result: RunResult) -> str:
    """``emulated``, ``simulated``, ``recorded``, or empty for a real hand."""
    name = result.subject.get("backend", "")
    if result.subject.get("device") == "emulated":
        return "emulated"
    if name.startswith("sim-") or result.subject.get("device") == "virtual":
        return "simulated"
    return "" if name else "recorded"


def about_harness(result: RunResult) -> str:
    """The load of the kit's machine, or empty where the kit made no run."""
    parts = []
    figures = result.harness
    if "jitter_p50_ms" in figures and "jitter_p99_ms" in figures:
        parts.append(
            f"itself late by {figures['jitter_p50_ms']:.2f} ms (median), "
            f"{figures['jitter_p99_ms']:.2f} ms (99 of 100)"
        )
    if "starved" in figures:
        parts.append(f"programs waited for a processor in {figures['starved']:.1%} of the run")
    if "waited" in figures and "longest_wait_ms" in figures:
        parts.append(
            f"a process of the hand in {figures['waited']:.1%}, up to "
            f"{figures['longest_wait_ms']:.3g} ms at once"
        )
    return "; ".join(parts)


def capital(text: str) -> str:
    """``text`` with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def utc_date(time_ns: int) -> datetime:
    """A log time as a date."""
    return datetime.fromtimestamp(time_ns / 1e9, tz=timezone.utc)


def quantity(name: str, value: float) -> tuple[str, str]:
    """A measured figure as (name, value with unit), from a key such as ``max_gap_s``."""
    head, _, tail = name.rpartition("_")
    if head and tail in _UNITS:
        return head.replace("_", " "), f"{value:.4g} {_UNITS[tail]}".strip()
    return name.replace("_", " "), f"{value:.4g}"
