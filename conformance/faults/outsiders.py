"""Wrong and good hands of other people, from a file or module of theirs.

A hand is a class with the decorator :func:`hand`: a change of a model's reference service. It is
judged by every requirement in a whole conformance run on the virtual clock.
"""

from __future__ import annotations

import gc
import importlib.util
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from rich.markup import escape

from dexkit.conformance.faults.matrix import in_processes
from dexkit.conformance.faults.registry import mix
from dexkit.conformance.faults.trials import plan_for, run_mutant
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.recording import sides_of
from dexkit.conformance.kit.requirements import CAPABILITIES, catalogue
from dexkit.conformance.kit.results import RunResult, Verdict
from dexkit.conformance.virtual import Service
from dexkit.console import Console
from dexkit.documents import write_file
from dexkit.errors import ConformanceError, DexkitError, ModelBroken, UsageError
from dexkit.hand import Side
from dexkit.models import MODELS, Dialect, dialect
from dexkit.plugins import import_object, where

__all__ = [
    "GRADES",
    "Blame",
    "Outsider",
    "Verdicts",
    "blame",
    "hand",
    "load",
    "print_verdicts",
    "try_all",
    "try_hand",
    "write_verdicts",
]

GRADES = ("must-breaking", "lesser", "good")
"""Class of a hand: it breaks something that clients rely on, has a tolerable fault, or is good."""

C = TypeVar("C", bound=type[Any])
_MARK = "_dexkit_hand"


@dataclass(frozen=True)
class _Declared:
    grade: str
    expects: tuple[str, ...]
    dialects: tuple[str, ...]
    lacks: tuple[str, ...]
    sides: tuple[Side, ...]


@dataclass(frozen=True)
class Outsider:
    """One hand of other people.

    :param made: its service.
    :param grade: one of :data:`GRADES`.
    :param expects: prefixes of the ids of requirements, one of which is the right reason.
    :param claims: what its maker claims of it.
    :param sides: those that are served.
    """

    name: str
    made: type[Service]
    dialect: Dialect
    grade: str
    expects: tuple[str, ...] = ()
    claims: Claims = field(default_factory=Claims)
    sides: tuple[Side, ...] = tuple(Side)


@dataclass(frozen=True)
class Verdicts:
    """Verdicts of the checks on a hand.

    :param failed: ids of MUSTs that fail; ``warned`` of other requirements that fail or warn;
        ``errors`` of those that could not be judged for a fault of the kit.
    :param problem: why there are none: the hand's own code failed, and where. Empty otherwise.
    :param story: what the run shows first; empty where nothing fails or warns.
    """

    name: str
    summary: str
    dialect: str
    grade: str
    expects: tuple[str, ...]
    failed: tuple[str, ...]
    warned: tuple[str, ...]
    errors: tuple[str, ...]
    problem: str = ""
    story: str = ""

    @property
    def right(self) -> bool:
        """Whether the checks agree: a good hand is not blamed, a wrong one for a right reason."""
        if self.errors or self.problem:
            return False
        if self.grade == "good":
            return not self.failed and not self.warned
        found = self.failed if self.grade == "must-breaking" else self.failed + self.warned
        return any(r.startswith(self.expects or "") for r in found)


def hand(
    grade: str,
    *,
    expects: str | tuple[str, ...] = (),
    dialects: str | tuple[str, ...] = (),
    lacks: str | tuple[str, ...] = (),
    sides: str = "both",
) -> Callable[[C], C]:
    """Mark a class as a hand to be tried.

    :param grade: one of :data:`GRADES`.
    :param expects: requirement ids, or their beginnings (``DEX1-MOVE``), of which one is the right
        reason to find it; none for any.
    :param dialects: those that it is tried in; none for the first of each model whose reference it
        changes.
    :param lacks: units that the hand does not have: its maker claims all others, as in a file of
        claims (docs/capabilities.md). Without it nothing is claimed or disclaimed.
    :param sides: those that are served: ``left``, ``right`` or ``both``.
    :raises ConformanceError: the grade or a unit is not known, or what it decorates is no class.
    :raises UsageError: there is no such side.
    """
    if grade not in GRADES:
        raise ConformanceError(f"{grade!r} is no grade of a hand", hint=", ".join(GRADES))
    for unit in _tuple(lacks):
        if unit not in CAPABILITIES:
            raise ConformanceError(
                f"{unit!r} is no unit that a hand can lack", hint=", ".join(CAPABILITIES)
            )
    declared = _Declared(grade, _tuple(expects), _tuple(dialects), _tuple(lacks), sides_of(sides))

    def declare(made: C) -> C:
        if not isinstance(made, type) or not issubclass(made, Service):
            raise ConformanceError(
                f"{getattr(made, '__name__', made)!r} is no service of hands",
                hint="derive it from a reference service; see docs/mutants.md",
            )
        setattr(made, _MARK, declared)
        return made

    return declare


def _tuple(value: str | tuple[str, ...]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def load(source: str) -> tuple[Outsider, ...]:
    """Every marked hand of a Python file or of a module.

    :param source: path of a ``.py`` file, or a module's name.
    :raises UsageError: there is no such file, or nothing in it is marked.
    :raises ConformanceError: it cannot be imported, or a hand in it cannot be used.
    """
    module = _file(Path(source)) if source.endswith(".py") else _module(source)
    found = [o for made in _marked(module) for o in _outsiders(made)]
    if not found:
        raise UsageError(
            f"no hand in {source} is marked",
            hint='mark classes with @hand("must-breaking") or others; see docs/mutants.md',
        )
    return tuple(found)


def _file(path: Path) -> ModuleType:
    if not path.is_file():
        raise UsageError(f"no such file: {path}")
    name = f"dexkit_hands_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None, "a .py file always has a loader"
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except DexkitError:
        raise
    except Exception as error:  # a file of others may raise anything
        raise ConformanceError(
            f"cannot load {path}: {type(error).__name__}: {error}", hint=where(error)
        ) from error
    return module


def _module(name: str) -> ModuleType:
    found = import_object(name, ConformanceError, hint="name a module or a .py file")
    assert isinstance(found, ModuleType)
    return found


def _marked(module: ModuleType) -> list[type[Any]]:
    return [
        value
        for value in vars(module).values()
        if inspect.isclass(value) and _MARK in vars(value) and value.__module__ == module.__name__
    ]


def _outsiders(made: type[Any]) -> Iterator[Outsider]:
    declared: _Declared = vars(made)[_MARK]
    named = [dialect(d) for d in declared.dialects]
    spoken = named or [m.dialects[0] for m in MODELS.values() if _fits(made, m.name)]
    if not spoken:
        raise ConformanceError(
            f"{made.__name__} fits no model", hint="derive it from a model's reference service"
        )
    for each in spoken:
        if not _fits(made, each.model):
            raise ConformanceError(
                f"{made.__name__} does not change the reference of {each.model}, whose dialect "
                f"{each.name} it is tried in"
            )
        each.check_sides(declared.sides)
        known = [r.id for r in catalogue(each.model)]
        lost = [e for e in declared.expects if not any(r.startswith(e) for r in known)]
        if lost and (named or len(lost) == len(declared.expects)):
            areas = dict.fromkeys(i.rsplit("-", 1)[0] for i in known)
            raise ConformanceError(
                f"{made.__name__} expects {', '.join(lost)}: {each.model} has none",
                hint=f"it has {', '.join(areas)}",
            )
        name = made.__name__ if len(spoken) == 1 else f"{made.__name__} ({each.name})"
        reference: type[Any] = under_test(each.model).reference.load()
        yield Outsider(
            name,
            mix(made, reference),
            each,
            declared.grade,
            declared.expects,
            _claims(reference, declared.lacks),
            declared.sides,
        )


def _claims(reference: type[Any], lacks: tuple[str, ...]) -> Claims:
    """The claims of a hand that differs from a reference, and lacks these units."""
    if not lacks:
        return Claims()
    missing = {*lacks} if any(getattr(reference, "attitude", ())) else {*lacks, "imu"}
    return Claims({unit: unit not in missing for unit in CAPABILITIES})


def _fits(made: type[Any], model_name: str) -> bool:
    """Whether a class changes that model's reference service, or a base of it."""
    try:
        reference = under_test(model_name).reference.load()
    except (ModelBroken, UsageError):
        return False
    base = next(c for c in made.__mro__[1:] if c.__module__.startswith("dexkit.") or c is reference)
    return issubclass(reference, base) or issubclass(made, reference)


class Blame(NamedTuple):
    """Ids of MUSTs that fail, of other requirements that fail or warn, and of errors of the kit."""

    failed: tuple[str, ...]
    warned: tuple[str, ...]
    errors: tuple[str, ...]


def blame(result: RunResult) -> Blame:
    """The requirements that a hand fails in a result."""
    found: dict[str, set[str]] = {"failed": set(), "warned": set(), "errors": set()}
    for r in result.results:
        if r.verdict is Verdict.ERROR:
            found["errors"].add(r.requirement.id)
        elif r.verdict in (Verdict.FAIL, Verdict.WARN):
            found["failed" if r.verdict is Verdict.FAIL else "warned"].add(r.requirement.id)
    return Blame(**{key: tuple(sorted(ids)) for key, ids in found.items()})


def try_hand(each: Outsider) -> Verdicts:
    """Judge a hand by every requirement, in a run with an object in the right hand.

    :raises ConformanceError: the hand's own code failed.
    """
    plan = plan_for(each.dialect.name, sides=each.sides)
    try:
        result = run_mutant(each.made, plan, claims=each.claims)
    except Exception as error:  # the code of others may raise anything
        raise ConformanceError(
            f"{each.name} failed: {type(error).__name__}: {error}", hint=where(error)
        ) from error
    story = ""
    if result.stories:
        first = result.stories[0]
        story = f"{', '.join(first.sides)}: {first.sentence}"
    return _verdicts(each, blame(result), story=story)


def _verdicts(each: Outsider, found: Blame, problem: str = "", story: str = "") -> Verdicts:
    summary = (each.made.__doc__ or "").strip().partition("\n")[0]
    about = each.name, summary, each.dialect.name, each.grade, each.expects
    return Verdicts(*about, *found, problem, story)


def try_all(
    source: str, count: int, stop: object = None, jobs: int | None = None
) -> Iterator[tuple[int, Verdicts]]:
    """Judge every hand of a source in worker processes; yield each, with its index in
    :func:`load`, when it is done. One whose own code failed has a ``problem``.

    :param count: how many hands it has.
    :param stop: ends it early when it becomes true.
    :param jobs: processes; one per processor by default.
    :raises ConformanceError: a hand ended its process.
    """
    try:
        yield from in_processes(partial(_try_one, source), range(count), stop, jobs)
    except BrokenProcessPool:
        raise ConformanceError(
            "the code of a hand ended its worker process", hint="--jobs 1 shows after which hand"
        ) from None


_loaded = cache(load)


def _try_one(source: str, index: int) -> Verdicts:
    """The verdicts of a hand, or why there are none."""
    each = _loaded(source)[index]
    try:
        return try_hand(each)
    except ConformanceError as error:
        return _verdicts(each, Blame((), (), ()), f"{error.message} ({error.hint})")
    finally:
        # a hand and its service are a cycle that holds large arrays, of whose size Python's own
        # collector knows nothing
        gc.collect()


def print_verdicts(console: Console, found: Sequence[Verdicts]) -> None:
    """Print what became of each hand and its first story; those that the checks are wrong about
    first.
    """
    for v in sorted(found, key=lambda v: v.right):
        ids = v.problem or (", ".join(v.failed + v.warned + v.errors) or "nothing") + " found"
        state = "right" if v.right else "wrong"
        color = "green" if v.right else "red"
        console.print(
            f"[{color}]{state}[/]  {escape(v.name)} ({v.grade}): {escape(ids)}", soft_wrap=True
        )
        if v.story:
            console.print(f"       {escape(v.story)}", soft_wrap=True, highlight=False)
    right = sum(v.right for v in found)
    console.print(f"the checks are right about {right} of {len(found)} hands")


def write_verdicts(path: Path, found: Sequence[Verdicts]) -> None:
    """Write them to a file as JSON."""
    hands = [{**asdict(v), "right": v.right} for v in found]
    write_file(path, json.dumps({"hands": hands}, indent=2) + "\n")
