"""The requirements as data: TOML files in this folder, read into :class:`Requirement`.

Everything else takes them from here: checks (which look up their tolerances), pytest ids,
selection, reports and the catalogue in docs/conformance.md.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from dexkit.errors import ConformanceError, UsageError
from dexkit.models import DIALECTS, HandModel, model

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = [
    "CAPABILITIES",
    "CONFIDENCE",
    "LAYERS",
    "Level",
    "Requirement",
    "catalogue",
    "load",
    "models",
    "parse",
    "select",
]

CONFIDENCE = ("vendor document", "vendor code", "measured", "inferred")
"""How sure the source of a requirement is, from best to least."""

CAPABILITIES: Mapping[str, str] = {
    "force": "tau_est tells what the hand presses with",
    "velocity": "dq is measured",
    "acceleration": "ddq is measured",
    "temperature": "temperatures are measured",
    "voltage": "the supply voltage is measured",
    "pressure": "fingers and palm feel pressure",
    "imu": "the hand knows its attitude",
    "low_rate": "a second, slow topic with the state",
    "timeout": "motors that ask for it brake when commands end (bit 7 of the mode byte)",
}
"""Units that a hand may have or not, and what who claims them says; see
:mod:`dexkit.conformance.claims`."""

_ID = re.compile(r"^[A-Z0-9]+(-[A-Z]+)+-\d\d$")
_NEEDS = ("nothing", "endpoints", "state", "commands", "session", "motion")
_PHASES = ("phase:", "other-phase:")
LAYERS = ("dds", "usb")
"""Where a requirement is judged: on the topics, or on the hand's own USB device."""
_KEYS = {
    "id",
    "area",
    "level",
    "title",
    "sentence",
    "rationale",
    "source",
    "confidence",
    "needs",
    "after",
    "dialects",
    "tolerances",
    "advice",
    "realtime",
    "capability",
    "cause",
    "expected",
    "repeat",
}
_OPTIONAL = {
    "after",
    "dialects",
    "tolerances",
    "realtime",
    "capability",
    "cause",
    "expected",
    "repeat",
}


class Level(str, Enum):
    """How binding a requirement is; only a MUST can fail a hand."""

    MUST = "MUST"
    SHOULD = "SHOULD"
    INFO = "INFO"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Requirement:
    """One requirement.

    :param id: stable; never used again for something else.
    :param area: heading under which reports group it.
    :param sentence: the norm, tolerances filled in.
    :param confidence: one of :data:`CONFIDENCE`.
    :param needs: what a recording must hold to judge it: ``nothing`` (absence is the finding),
        ``endpoints`` (what discovery saw), ``state``, ``commands``, ``session`` (commands of
        some length; a live run replays one), ``motion``, or ``phase:NAME``, a phase of the kit's
        own stimulus (``other-phase:NAME``: one in which the other side is moved).
    :param after: requirements that must not have failed, or this one is blocked.
    :param dialects: the dialects that it applies to.
    :param tolerances: the figures that the check compares with.
    :param layer: one of :data:`LAYERS`; a file's ``layer``, ``dds`` where it says nothing.
    :param realtime: a machine that is short of processor time can make a good hand fail it; a
        failure is then not blamed on the hand.
    :param cause: likely cause of a failure: the mistake that makers make.
    :param advice: what to try then.
    :param expected: the norm in a few words for reports, tolerances filled in; the sentence
        where nothing shorter says it.
    :param capability: one of :data:`CAPABILITIES`, where it is about a unit that a hand may lack.
    :param repeat: how often its stimulus is applied.
    """

    id: str
    model: str
    area: str
    level: Level
    title: str
    sentence: str
    rationale: str
    source: str
    confidence: str
    needs: str
    advice: str
    after: tuple[str, ...] = ()
    dialects: tuple[str, ...] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)
    realtime: bool = False
    layer: str = "dds"
    cause: str = ""
    expected: str = ""
    capability: str = ""
    repeat: int = 1

    @property
    def phase(self) -> str | None:
        """The stimulus phase that it needs, if any."""
        return self.needs.partition(":")[2] or None

    def tolerance(self, name: str) -> float:
        """The figure called ``name``.

        :raises ConformanceError: the data have none: check and catalogue disagree.
        """
        try:
            return self.tolerances[name]
        except KeyError:
            raise ConformanceError(f"{self.id} has no tolerance {name!r}") from None


def _resolve(value: Any, hand: HandModel, where: str) -> float:
    if isinstance(value, str) and value.startswith("model:"):
        fact = getattr(hand, value.removeprefix("model:"), None)
        if isinstance(fact, int | float):
            return float(fact)
        raise UsageError(f"{where}: {hand.name} has no figure {value!r}")
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    raise UsageError(f"{where}: a tolerance is a number or 'model:NAME', not {value!r}")


def parse(text: str, origin: str = "requirements") -> tuple[Requirement, ...]:
    """Requirements of one TOML text.

    :raises UsageError: a key is unknown or missing, a value is not one of those allowed, an id
        occurs twice or is retired, or ``after`` names what does not come before.
    """
    document = tomllib.loads(text)
    unknown = set(document) - {"model", "layer", "retired", "requirement"}
    if unknown:
        raise UsageError(f"{origin}: unknown keys {sorted(unknown)}")
    retired = set(document.get("retired", ()))
    hand = model(str(document.get("model", "")))
    layer = str(document.get("layer", "dds"))
    if layer not in LAYERS:
        raise UsageError(f"{origin}: layer is one of {', '.join(LAYERS)}")
    dialect_names = tuple(d.name for d in hand.dialects)
    found: dict[str, Requirement] = {}
    for entry in document.get("requirement", []):
        where = f"{origin}: {entry.get('id', 'a requirement without id')}"
        unknown = set(entry) - _KEYS
        missing = _KEYS - _OPTIONAL - set(entry)
        if unknown or missing:
            raise UsageError(f"{where}: unknown keys {sorted(unknown)}, missing {sorted(missing)}")
        if not _ID.match(entry["id"]) or entry["id"] in found:
            raise UsageError(f"{where}: an id is like DEX1-RATE-01 and occurs once")
        if entry["id"] in retired:
            raise UsageError(f"{where}: is retired, and an id is never used again")
        if entry["confidence"] not in CONFIDENCE:
            raise UsageError(f"{where}: confidence is one of {', '.join(CONFIDENCE)}")
        if entry["level"] not in Level.__members__:
            raise UsageError(f"{where}: level is one of {', '.join(Level.__members__)}")
        if entry["needs"] not in _NEEDS and not entry["needs"].startswith(_PHASES):
            raise UsageError(f"{where}: needs is one of {', '.join(_NEEDS)} or phase:NAME")
        if entry.get("capability", "") not in ("", *CAPABILITIES):
            raise UsageError(f"{where}: capability is one of {', '.join(CAPABILITIES)}")
        if entry.get("repeat", 1) not in range(1, 100):
            raise UsageError(f"{where}: repeat is a number from 1 on")
        for before in entry.get("after", []):
            if before not in found:
                raise UsageError(f"{where}: {before} does not come before it")
        for name in entry.get("dialects", []):
            if name not in DIALECTS:
                raise UsageError(f"{where}: no dialect {name!r}")
        tolerances = {
            name: _resolve(value, hand, where)
            for name, value in entry.get("tolerances", {}).items()
        }
        found[entry["id"]] = Requirement(
            id=entry["id"],
            model=hand.name,
            area=entry["area"],
            level=Level[entry["level"]],
            title=entry["title"],
            sentence=entry["sentence"].format(**tolerances),
            rationale=entry["rationale"],
            source=entry["source"],
            confidence=entry["confidence"],
            needs=entry["needs"],
            advice=entry["advice"],
            after=tuple(entry.get("after", ())),
            dialects=tuple(entry.get("dialects", dialect_names)),
            tolerances=tolerances,
            realtime=bool(entry.get("realtime", False)),
            layer=layer,
            cause=entry.get("cause", ""),
            expected=entry.get("expected", entry["sentence"]).format(**tolerances),
            capability=entry.get("capability", ""),
            repeat=entry.get("repeat", 1),
        )
    return tuple(found.values())


def load(path: Path) -> tuple[Requirement, ...]:
    """Requirements of one TOML file.

    :raises UsageError: as :func:`parse`.
    """
    return parse(path.read_text(encoding="utf-8"), path.name)


@cache
def _shipped() -> tuple[Requirement, ...]:
    found: list[Requirement] = []
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        found += load(path)
    return tuple(found)


@cache
def catalogue(model: str | None = None, layer: str | None = "dds") -> tuple[Requirement, ...]:
    """The requirements that ship with dexkit, in their order.

    :param model: only those of that hand model; None for all.
    :param layer: only those judged there; None for all.
    """
    return tuple(
        r
        for r in _shipped()
        if (model is None or r.model == model) and (layer is None or r.layer == layer)
    )


def models() -> tuple[str, ...]:
    """The hand models that have requirements."""
    return tuple(dict.fromkeys(r.model for r in _shipped()))


def select(
    requirements: Iterable[Requirement],
    *,
    prefixes: Iterable[str] = (),
    level: str | None = None,
) -> tuple[Requirement, ...]:
    """Those whose id begins with one of ``prefixes`` and that are at least as binding as ``level``.

    :param prefixes: none means all.
    :param level: ``must``, ``should`` or ``info``; None means all.
    :raises UsageError: a prefix matches nothing, or the level is unknown.
    """
    everything = tuple(requirements)
    wanted = tuple(p.upper() for p in prefixes)
    for prefix in wanted:
        if not any(r.id.startswith(prefix) for r in everything):
            areas = sorted({r.id.rpartition("-")[0] for r in everything})
            raise UsageError(
                f"no requirement begins with {prefix!r}", hint=f"there are: {', '.join(areas)}"
            )
    order = [str(lv) for lv in Level]
    if level is not None and level.upper() not in order:
        raise UsageError(f"no level {level!r}", hint="levels: must, should, info")
    rank = order.index(level.upper()) if level else len(order)
    return tuple(
        r
        for r in everything
        if (not wanted or r.id.startswith(wanted)) and order.index(str(r.level)) <= rank
    )
