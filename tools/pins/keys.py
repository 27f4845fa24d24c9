"""Keys of what is kept: two recordings or verdicts with the same key are the same.

A recording's key has all that can change it: the code that plays it, the wrong hand's class and its
bases with what they name, the plan by value, and the versions of Python and of the packages below.
A verdict's key has the recording's, and of the requirement and of all those that decide whether it
is judged at all: their figures and conditions, the checks with what they name; and all other code
that judges.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dexkit import messages
from dexkit.conformance import layers
from dexkit.conformance.checks import check_of
from dexkit.conformance.faults import Mutant, trials
from dexkit.conformance.faults.trials import run_of
from dexkit.conformance.kit.judge import deciding
from dexkit.conformance.kit.phased_script import PhasedScript
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.layers import layer
from dexkit.conformance.stimuli import Plan
from dexkit.conformance.stimuli.phases import parts_of
from tools.pins.sources import WHOLE, Place, Sources

__all__ = [
    "JUDGES_ONLY",
    "PROSE",
    "ROOT",
    "SPLIT",
    "judging",
    "played_by",
    "recording_key",
    "run_key",
    "sample_key",
    "verdict_keys",
]

ROOT = Path(__file__).parents[2]
SPLIT = (
    "dexkit.conformance.behaviours",
    "dexkit.conformance.checks",
    "dexkit.conformance.faults",
    "dexkit.conformance.kit.recording",
    "dexkit.conformance.usb.context",
)
"""Modules of many independent parts; see :mod:`tools.pins.sources`."""
JUDGES_ONLY: Mapping[str, str] = {
    "dexkit.conformance.layers": "names script and reference, both of which are in the key",
    "dexkit.conformance.behaviours:CHECKS": "the phases that are played are in the key",
    "dexkit.conformance.kit.recording:Recording": "has read the session: a value in the key",
    "dexkit.conformance.kit.recording:TopicDecoder": "reads recordings; a robot has no session",
    "dexkit.conformance.kit.requirements": "has chosen the phases, which are in the key by value",
}
"""What the code that plays names, but does not need while it plays, with the reason. Only the first
is called at all while a run is played."""
PROSE = frozenset(
    (
        *("title", "sentence", "rationale", "source", "confidence", "advice", "cause"),
        *("expected", "area", "original", "plots", "kind"),
    )
)
"""What a requirement says to a reader: no verdict depends on it."""
_FORMAT = 1
"""Of the keys and files; another number makes all old ones unknown."""


@cache
def sources() -> Sources:
    """The sources of this checkout."""
    return Sources(ROOT, ("dexkit", "tools"), SPLIT, ("wrong_hand",))


def _digest(*values: object) -> str:
    text = json.dumps([_plain(value) for value in values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: object) -> Any:
    """A value as JSON that is different for different values.

    :raises TypeError: it has a part whose value cannot be told.
    """
    if value is None or (isinstance(value, bool | int | str) and not isinstance(value, Enum)):
        return value
    if isinstance(value, Enum):
        return [type(value).__qualname__, value.name]
    if isinstance(value, float):
        return ["float", value.hex() if math.isfinite(value) else str(value)]
    if isinstance(value, np.ndarray):
        data = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return ["array", str(value.dtype), list(value.shape), data]
    if is_dataclass(value) and not isinstance(value, type):
        parts = [[f.name, _plain(getattr(value, f.name))] for f in fields(value)]
        return [type(value).__qualname__, *parts]
    if isinstance(value, Mapping):
        return ["map", [[_plain(k), _plain(v)] for k, v in value.items()]]
    if isinstance(value, frozenset | set):
        return ["set", sorted((_plain(v) for v in value), key=repr)]
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    raise TypeError(f"{type(value).__qualname__} has no value that a key could hold")


@cache
def _environment() -> str:
    """Digest of the versions that figures can depend on: Python's and the packages'."""
    needed = [text for text in metadata.requires("dexkit") or () if ";" not in text]
    names = sorted(re.split(r"[^\w.-]", text)[0] for text in needed)
    versions = [[name, metadata.version(name)] for name in names]
    machine = [platform.python_implementation(), platform.machine(), *platform.libc_ver()]
    return _digest(_FORMAT, platform.python_version_tuple()[:2], machine, versions)


# --------------------------------------------------------------------------------- recordings


_OF_EVERY_CLASS = frozenset(
    ("__module__", "__doc__", "__abstractmethods__", "_abc_impl", "__parameters__")
)


@cache
def _messages() -> frozenset[Place]:
    """The modules of the messages, which are imported by names in the messages' layouts."""
    return _modules_of(messages)


def _modules_of(package: ModuleType) -> frozenset[Place]:
    """All modules of a package that are not packages themselves."""
    folder = Path(str(package.__file__)).parent
    return frozenset((f"{package.__name__}.{f.stem}", WHOLE) for f in folder.glob("[!_]*.py"))


def _class_places(made: type[Any]) -> Iterable[Place]:
    """Where a class and its bases are defined.

    :raises TypeError: one of them was made at run time, and not just mixed of others.
    """
    for base in made.__mro__:
        own = [value for name, value in vars(base).items() if name not in _OF_EVERY_CLASS]
        if own and base.__module__.startswith("dexkit."):
            yield sources().place(base.__module__, base.__qualname__)
        elif own and getattr(sys.modules[base.__module__], base.__name__, None) is not base:
            # mixed of its bases, and perhaps given another class that is
            for value in own:
                if not isinstance(value, type):
                    raise TypeError(f"{base.__qualname__} was made at run time of unknown code")
                yield from _class_places(value)


def played_by(mutant: Mutant) -> frozenset[Place]:
    """The places of the code that plays a wrong hand; all that plays it is reached from them."""
    run = run_of(mutant)
    functions: list[Any] = [run.play]
    drives: type[Any]
    if mutant.layer == "client":
        drives = layer("dds").reference(mutant.model)
    else:
        script: type[PhasedScript[Any, Any, Any]] = layer(mutant.layer).script(mutant.model)
        parts = parts_of(script)
        if isinstance(run.about, Plan):
            parts = tuple(part for part in parts if part.wanted(run.about))
        functions += [part.play for part in parts]
        drives = script
    found = {place for made in (mutant.made, drives) for place in _class_places(made)}
    found |= {sources().place(f.__module__, f.__qualname__) for f in functions}
    return frozenset(found | _messages())


def recording_key(mutant: Mutant) -> str:
    """The key of a wrong hand's recording."""
    bases = [f"{c.__module__}.{c.__qualname__}" for c in mutant.made.__mro__]
    code = sources().digest(played_by(mutant), JUDGES_ONLY)
    return _digest("recording", _environment(), mutant.key, bases, run_of(mutant).about, code)


def run_key(
    made: type[Any],
    model: str,
    play: Callable[..., Any],
    about: object,
    without: Mapping[str, str],
) -> str:
    """The key of what another program plays with a service of hands.

    :param model: of the hands.
    :param play: what plays it.
    :param about: all values that it depends on besides.
    :param without: what the code names, but does not need, with the reason.
    """
    places = set(_messages()) | {sources().place(play.__module__, play.__qualname__)}
    for each in (made, layer("dds").reference(model)):
        places.update(_class_places(each))
    code = sources().digest(frozenset(places), {**JUDGES_ONLY, **without})
    return _digest("run", _environment(), about, [c.__qualname__ for c in made.__mro__], code)


def sample_key(path: Path) -> str:
    """The key of a sample."""
    return _digest("sample", hashlib.sha256(path.read_bytes()).hexdigest())


# ----------------------------------------------------------------------------------- verdicts


@cache
def judging(judged_by: tuple[str, ...]) -> frozenset[Place]:
    """The places of the code that judges by some layers, apart from the checks."""
    judges = (trials.judge_topics, trials.judge_usb, trials.judge_client)
    found = {sources().place(judge.__module__, judge.__qualname__) for judge in judges}
    found |= {("tools.pins.recordings", WHOLE), ("tools.pins.verdicts", WHOLE)}
    found |= {sources().place(*layer(name).context.target.split(":")) for name in judged_by}
    return frozenset(found | _modules_of(layers) | _messages())


def check_place(requirement: Requirement) -> Place:
    """Where a requirement's check is defined."""
    check: Any = check_of(requirement)
    return sources().place(check.__module__, check.__qualname__)


def data_of(requirement: Requirement) -> Mapping[str, object]:
    """The data of a requirement that its verdict can depend on."""
    values = {f.name: getattr(requirement, f.name) for f in fields(requirement)}
    return {name: value for name, value in values.items() if name not in PROSE}


@cache
def _requirement_digest(requirement_id: str, model: str) -> str:
    """Digest of a requirement's data and of its check."""
    (requirement,) = (r for r in catalogue(model, None) if r.id == requirement_id)
    return _digest(data_of(requirement), sources().digest([check_place(requirement)]))


@cache
def verdict_keys(model: str, judged_by: tuple[str, ...]) -> Mapping[str, str]:
    """The key of each requirement's verdicts on a recording that has a key itself.

    :param judged_by: the layers that the recording is judged by.
    """
    code = _digest(_environment(), sources().digest(judging(judged_by)))
    found = {}
    for requirement in catalogue(model, None):
        if requirement.layer in judged_by:
            about = [
                [r.id, _requirement_digest(r.id, model)] for r in deciding(model, requirement.id)
            ]
            found[requirement.id] = _digest(code, about)
    return found
