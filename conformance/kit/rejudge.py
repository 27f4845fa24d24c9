"""Compare a result with its recording: judge the recording again, and compare the two documents.

All of a result follows from its recording, and so all of it is compared, member by member, except
:data:`STATED`: a member that a later version adds is compared without a word here. What is an
input of judging is taken as follows:

* dialect and sides from the result; sides of the recording that it leaves out are named;
* the vendor's claims from the run record; in a session, which has none, from the result, and they
  are then named as stated;
* the requirements: all that apply, whatever the result lists. A result that lists fewer is
  compared with a judging of that part, and the others are named with the verdicts that they get.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.result_file import as_document, parse_result
from dexkit.conformance.kit.results import SEVERITY, Result, RunResult, Verdict, grouped, worst
from dexkit.conformance.kit.run_record import recorded_claims
from dexkit.conformance.kit.selection import RunKind
from dexkit.digests import sha256_of_file
from dexkit.escaping import one_line
from dexkit.traces import open_trace

__all__ = [
    "STATED",
    "STATED_WITHOUT_RUN",
    "Comparison",
    "Difference",
    "compare_with_recording",
    "document_differences",
]

STATED = ("subject.recording", "environment.python", "environment.system")
"""Members of a result that no recording tells: the name its file had, and where it was judged."""
STATED_WITHOUT_RUN = ("claims", "subject.hand", "subject.vendor", "subject.firmware")
"""What is taken from the result where the recording has no run record: the vendor's claims."""

_ABSENT = object()
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_LONGEST = 160  # characters of a value that a line shows


@dataclass(frozen=True)
class Difference:
    """A member of a result that is not what follows from the recording.

    :param path: of the member in the result's JSON, as ``results[12].verdict``.
    :param stated: its value in the result, as JSON text; empty if it is not there.
    :param judged: likewise of the new judging.
    :param about: the requirement and side that it belongs to, or empty.
    """

    path: str
    stated: str
    judged: str
    about: str = ""

    def __str__(self) -> str:
        about = f" ({self.about})" if self.about else ""
        return one_line(
            f"{self.path}{about}: {self.stated or 'nothing'} in the result, "
            f"{self.judged or 'nothing'} when judged again",
            3 * _LONGEST,
        )


@dataclass(frozen=True)
class Comparison:
    """A result beside a new judging of its recording.

    :param stated: members that are not verified, by path, with their values.
    :param whole: the judging of all sides' requirements that apply.
    :param left_out: requirements that the result does not list, with the verdicts they get now.
    :param left_out_sides: hands of the recording that the result is not about.
    :param kind: ``quick`` where the part is that of such a run; else empty.
    :param remarks: damage of the recording, and choices of the result that show in nothing else.
    """

    differences: tuple[Difference, ...]
    stated: Mapping[str, Any]
    whole: RunResult
    left_out: Mapping[str, Verdict]
    left_out_sides: tuple[str, ...]
    kind: str
    remarks: tuple[str, ...]

    @property
    def is_part(self) -> bool:
        """Whether the result is about a chosen part only, and so proves no drop-in."""
        return bool(self.left_out or self.left_out_sides)

    def part(self) -> list[str]:
        """The part and what it leaves out, as lines; none for a whole result."""
        if not self.is_part:
            return []
        every = len(_by_id(self.whole))
        count = f"{every - len(self.left_out)} of {every} requirements"
        if self.whole.client:
            count += " (those about the client included)"
        name = f"those of a {self.kind} run" if self.kind else "a chosen part"
        lines = [f"a part only: {count}, {name}" if self.left_out else f"a part only: all {count}"]
        lines += [f"left out: the {side} hand" for side in self.left_out_sides]
        for verdict in sorted(set(self.left_out.values()), key=SEVERITY.index):
            names = [name for name, v in self.left_out.items() if v is verdict]
            lines.append(f"left out, {verdict} when judged: {', '.join(names)}")
        lines.append(f"all requirements together: {self.whole.sentence()}")
        return lines


def compare_with_recording(document: Mapping[str, Any], recording: Path) -> Comparison:
    """Judge a recording again, and compare everything that follows from it with a result.

    :param document: the JSON of a result file.
    :raises UsageError: it is no result file of this version.
    :raises DexkitError: the recording cannot be read, or is not of that kind of hand.
    """
    found = parse_result(document, "the result")
    trace = open_trace(recording)
    remarks = [f"the recording is damaged: {text}" for text in trace.damage]
    usual = recording_of(trace, None, ())
    view, about = usual, found.subject
    if (about["dialect"], about["sides"]) != (usual.dialect.name, _sides(usual)):
        view = recording_of(trace, about["dialect"], found.hands)
    left_out_sides: tuple[str, ...] = ()
    if view.dialect.name == usual.dialect.name:
        left_out_sides = tuple(str(s) for s in usual.judged if s not in view.judged)
    else:
        remarks.append(
            f"judged as {view.dialect.name}, as the result says; without being told dexkit judges "
            f"this recording as {usual.dialect.name}"
        )
    stated = list(STATED)
    if "claims" in view.run:
        claims = recorded_claims(view.run)
    else:
        claims = _stated_claims(found)
        stated += STATED_WITHOUT_RUN
    subject = {"recording": recording.name, "recording_sha256": sha256_of_file(trace.path)}
    whole = judge(view, claims=claims, subject=subject)
    every, listed = _by_id(whole), _by_id(found)
    again = whole
    if not every.keys() <= listed.keys():
        some = [results[0].requirement for name, results in every.items() if name in listed]
        again = judge(view, requirements=some, claims=claims, subject=subject)
    return Comparison(
        differences=tuple(document_differences(document, again, STATED)),
        stated={p: v for p in stated if (v := _member_of(document, p)) not in (_ABSENT, None, "")},
        whole=whole,
        left_out={
            name: worst(r.verdict for r in results)
            for name, results in every.items()
            if name not in listed
        },
        left_out_sides=left_out_sides,
        kind=_kind(every, listed),
        remarks=tuple(remarks),
    )


def document_differences(
    document: Mapping[str, Any], judged: RunResult, but: Sequence[str] = ()
) -> Iterator[Difference]:
    """Every difference between the JSON of a result and that of a judging.

    :param but: paths of members that are not compared.
    """
    written = json.loads(json.dumps(as_document(judged)))
    for difference in _differences(document, written, "", ""):
        if difference.path not in but:
            yield difference


def _differences(stated: Any, judged: Any, path: str, about: str) -> Iterator[Difference]:
    if isinstance(stated, dict) and isinstance(judged, dict):
        for name in dict.fromkeys([*judged, *stated]):
            yield from _differences(
                stated.get(name, _ABSENT), judged.get(name, _ABSENT), _join(path, name), about
            )
    elif isinstance(stated, list) and isinstance(judged, list):
        if _are_results([*stated, *judged]):
            yield from _results_differences(stated, judged, path)
            return
        for i in range(max(len(stated), len(judged))):
            here, now = (v[i] if i < len(v) else _ABSENT for v in (stated, judged))
            yield from _differences(here, now, f"{path}[{i}]", about)
    elif stated != judged or isinstance(stated, bool) is not isinstance(judged, bool):
        yield Difference(path, _shown(stated), _shown(judged), about)


def _results_differences(
    stated: Sequence[Mapping[str, Any]], judged: Sequence[Mapping[str, Any]], path: str
) -> Iterator[Difference]:
    """Differences of results, each compared with that of the same requirement and side."""
    left = {_about(row): row for row in judged}
    order = [name for row in stated if (name := _about(row)) in left]
    for i, row in enumerate(stated):
        other = left.pop(_about(row), _ABSENT)
        yield from _differences(row, other, f"{path}[{i}]", _about(row))
    for name, row in left.items():
        yield Difference(path, "", _shown(row), name)
    now = [name for row in judged if (name := _about(row)) in order]
    if order != now and sorted(order) == sorted(now):
        yield Difference(path, "another order", "the catalogue's order")


def _are_results(rows: Sequence[Any]) -> bool:
    return bool(rows) and all(isinstance(r, dict) and {"id", "side"} <= r.keys() for r in rows)


def _about(row: Mapping[str, Any]) -> str:
    return f"{row['id']} {row['side']}"


def _join(path: str, name: str) -> str:
    if _PLAIN.fullmatch(name):
        return f"{path}.{name}" if path else name
    return f"{path}[{json.dumps(name)}]"


def _shown(value: Any) -> str:
    if value is _ABSENT:
        return ""
    if isinstance(value, dict) and "verdict" in value:
        return f"a result of the verdict {json.dumps(value['verdict'])}"
    return one_line(json.dumps(value, ensure_ascii=False), _LONGEST)


def _member_of(document: Any, path: str) -> Any:
    for name in path.split("."):
        document = document.get(name, _ABSENT) if isinstance(document, dict) else _ABSENT
    return document


def _sides(view: Recording) -> str:
    return ", ".join(str(s) for s in view.judged)


def _stated_claims(found: RunResult) -> Claims:
    """The claims of a result; none where it has none.

    :raises UsageError: about a unit that there is not.
    """
    if found.claims is None:
        return Claims()
    about = {"hand": "name", "vendor": "vendor", "firmware": "firmware"}
    return Claims.of_document(
        {
            "hand": {key: found.subject[n] for n, key in about.items() if n in found.subject},
            "claims": found.claims,
        },
        "the claims of the result",
    )


def _by_id(result: RunResult) -> dict[str, list[Result]]:
    every: Iterable[Result] = (*result.results, *result.client)
    return {requirement.id: results for requirement, results in grouped(every)}


def _kind(every: Mapping[str, Sequence[Result]], listed: Mapping[str, Any]) -> str:
    """``quick`` where the results are those of such a run; else empty."""
    quick = RunKind.QUICK.requirements([r[0].requirement for r in every.values()])
    return str(RunKind.QUICK) if {r.id for r in quick} == set(listed) else ""
