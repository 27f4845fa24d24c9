"""The requirements as data: the TOML files of :mod:`dexkit.conformance.behaviours`, one for each
behaviour, read into :class:`Requirement`.

A ``[[requirement]]`` is written once for all hands and robots that have to meet it. ``ids`` names
it for each of them, by the prefix of its model (:data:`PREFIXES`); the keys below, explained in
:class:`Requirement`, are those of the first id. ``DEX3.sentence`` is what differs for that model;
tolerances are taken one by one. Ids and topics of the first model in the texts are turned into the
other's. Keys at the head of a file are those of the requirements that do not give them.

``"DEX5-RATE-01 as DEX3"`` says that nobody knows it of that hand itself: it takes all that it does
not give from DEX3-RATE-01, is judged by its check, and is an inference from it where it names no
source of its own. A hand of another package has a file of such requirements, in which each entry
names the one that it is ``like``.

``"model:X"`` takes a tolerance from the hand's model, and ``"DEX1-MOVE-04:x"`` the tolerance x of
another requirement, so that no fact is written down twice. ``dialects`` restricts the models that
have them. Lengths that end in ``_stroke`` are parts of the joint's full range. An id is never used
again for something else.

All other parts take the requirements from here: checks (which read their tolerances), pytest ids,
selection, reports and the pages of the site.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec

from dexkit.conformance.behaviours import AREAS, BEHAVIOURS
from dexkit.conformance.hands import BUILT_IN, under_test
from dexkit.conformance.kit.plots import Plot
from dexkit.conformance.layers import layer
from dexkit.documents import parse_toml, read_text, read_toml
from dexkit.errors import ConformanceError, ModelBroken, UsageError
from dexkit.models import DIALECTS, HandModel, model, model_plugins
from dexkit.records import to_record
from dexkit.robots import RobotModel, robot

__all__ = [
    "CAPABILITIES",
    "CONFIDENCE",
    "PREFIXES",
    "Kind",
    "Level",
    "Requirement",
    "catalogue",
    "models",
    "parse",
    "renamed",
    "select",
]

CONFIDENCE = ("vendor document", "vendor code", "measured", "inferred")
"""Confidence of a requirement's source, from best to least."""

_NEEDS = "^(nothing|endpoints|state|commands|session|motion|(other-)?phase:.+)$"

CAPABILITIES: Mapping[str, str] = {
    "force": "tau_est shows the force that the hand applies",
    "velocity": "dq is measured",
    "acceleration": "ddq is measured",
    "temperature": "temperatures are measured",
    "voltage": "the supply voltage is measured",
    "pressure": "fingers and palm measure pressure",
    "imu": "the hand measures its attitude",
    "low_rate": "a second, slow topic with the state",
    "timeout": "motors that ask for it brake when commands end (bit 7 of the mode byte)",
}
"""Optional units of a hand, and what a claim of each means; see
:mod:`dexkit.conformance.kit.claims`."""

PREFIXES: Mapping[str, tuple[str, str]] = {
    prefix: (each.model.name, layer_name)
    for each in BUILT_IN
    for prefix, layer_name in each.prefixes.items()
}
"""Model and layer of dexkit's own ids, by their prefix; those like ``DEX1-CLIENT-01`` are of the
layer ``client``."""


class Level(str, Enum):
    """Level of a requirement; only a MUST can fail a hand."""

    MUST = "MUST"
    SHOULD = "SHOULD"
    INFO = "INFO"

    def __str__(self) -> str:
        return self.value


class Kind(str, Enum):
    """Purpose of a requirement; each kind has its own grade in every report."""

    DROP_IN = "drop-in"
    """A client that was built for the original relies on it, and the original meets it."""
    SAFETY = "safety"
    """It asks for more than the original does, so that bad input or an end does no harm."""

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
        own stimulus (``other-phase:NAME``: one in which the other side is moved), or any of
        several, with blanks between their names.
    :param after: requirements that must not have failed, or this one is blocked.
    :param dialects: the dialects that it applies to.
    :param tolerances: the figures that the check compares with.
    :param layer: one of :data:`~dexkit.conformance.layers.LAYERS`.
    :param realtime: a machine that is short of processor time can make a good hand fail it; a
        failure is then not blamed on the hand.
    :param cause: likely cause of a failure: the usual mistake of vendors.
    :param advice: what to try after a failure.
    :param expected: the norm in a few words for reports, tolerances filled in; the sentence
        where no shorter text is given.
    :param capability: one of :data:`CAPABILITIES`, where it is about a unit that a hand may lack.
    :param negative: whether it is about what a hand must not do, or about its reaction to bad
        input or another participant.
    :param repeat: how often its stimulus is applied.
    :param plots: what shows a failure, unless its check names other plots.
    :param like: the requirement of another model that it is taken from, and whose check judges
        it; empty if it stands for itself.
    :param lineage: that one, the one which it is like, and so on.
    :param spoils: of a requirement about the client, how the ids begin of those requirements of
        the hand that cannot be judged where the client does not meet it.
    :param kind: drop-in, unless the catalogue says safety.
    :param original: of a safety requirement, what the original does instead, with its source;
        empty for drop-in.
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
    negative: bool = False
    repeat: int = 1
    like: str = ""
    lineage: tuple[str, ...] = ()
    plots: tuple[Plot, ...] = ()
    spoils: tuple[str, ...] = ()
    kind: Kind = Kind.DROP_IN
    original: str = ""

    @property
    def phases(self) -> tuple[str, ...]:
        """The stimulus phases that it is judged in, if any."""
        return tuple(self.needs.partition(":")[2].split())

    @property
    def phase(self) -> str | None:
        """The first of them."""
        return next(iter(self.phases), None)

    @property
    def moves_other_side(self) -> bool:
        """Whether it is judged while only the other side is commanded."""
        return self.needs.startswith("other-")

    @property
    def needs_discovery(self) -> bool:
        """Whether it needs what discovery saw of readers and writers."""
        return self.needs == "endpoints"

    @property
    def about_client(self) -> bool:
        """Whether it is about the client's commands, and not about the hand."""
        return self.layer == "client"

    @property
    def needs_commands(self) -> bool:
        """Whether it needs commands to the hand in the recording."""
        return self.needs in ("commands", "session")

    def tolerance(self, name: str) -> float:
        """The figure called ``name``.

        :raises ConformanceError: the data have none: check and catalogue disagree.
        """
        try:
            return self.tolerances[name]
        except KeyError:
            raise ConformanceError(f"{self.id} has no tolerance {name!r}") from None


class _Entry(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A requirement as it is written, with all that it takes from others."""

    id: Annotated[str, msgspec.Meta(pattern=r"^[A-Z0-9]+(-[A-Z]+)+-\d\d$")]
    area: str
    level: Level
    title: str
    sentence: str
    rationale: str
    source: str
    confidence: Annotated[str, msgspec.Meta(pattern=f"^({'|'.join(CONFIDENCE)})$")]
    needs: Annotated[str, msgspec.Meta(pattern=_NEEDS)]
    advice: str
    after: tuple[str, ...] = ()
    dialects: tuple[str, ...] = ()
    tolerances: Mapping[str, float | str] = {}
    realtime: bool = False
    cause: str = ""
    expected: str = ""
    capability: Annotated[str, msgspec.Meta(pattern=f"^({'|'.join(CAPABILITIES)})?$")] = ""
    negative: bool = False
    repeat: Annotated[int, msgspec.Meta(ge=1, lt=100)] = 1
    like: str = ""
    plots: tuple[Plot, ...] | None = None
    spoils: tuple[str, ...] = ()
    kind: Kind = Kind.DROP_IN
    original: str = ""


_Part = msgspec.defstruct(
    "_Part",
    [
        (f.name, Any if f.name == "plots" else f.type | msgspec.UnsetType, msgspec.UNSET)
        for f in msgspec.structs.fields(_Entry)
    ],
    forbid_unknown_fields=True,
)
"""Some keys of an entry."""
_AS_WRITTEN = {f.name for f in fields(Requirement)} & set(_Entry.__struct_fields__) - {
    *("dialects", "tolerances", "sentence", "expected", "plots")
}
"""What a requirement takes from its entry as it is."""


def _resolve(
    value: float | str,
    hand: HandModel | RobotModel,
    before: Mapping[str, Requirement],
    where: str,
) -> float:
    """A tolerance: a number, a figure of the model, or a tolerance of a requirement before it."""
    if isinstance(value, str) and (name := value.partition(":")[0]) in before:
        return before[name].tolerance(value.partition(":")[2])
    if isinstance(value, str) and value.startswith("model:"):
        fact = getattr(hand, value.removeprefix("model:"), None)
        if isinstance(fact, int | float):
            return float(fact)
        raise UsageError(f"{where}: {hand.name} has no figure {value!r}")
    if not isinstance(value, str):
        return float(value)
    raise UsageError(f"{where}: a tolerance is a number, 'model:NAME' or 'ID:NAME', not {value!r}")


def renamed(text: str, theirs: str, ours: str) -> str:
    """``text`` with one prefix' ids and topics in place of another's."""
    return text.replace(f"{theirs}-", f"{ours}-").replace(
        f"rt/{theirs.lower()}/", f"rt/{ours.lower()}/"
    )


def _with_prefix(value: Any, theirs: str, ours: str) -> Any:
    """A value with all its texts :func:`renamed`."""
    if isinstance(value, str):
        return renamed(value, theirs, ours)
    if isinstance(value, dict):
        return {name: _with_prefix(v, theirs, ours) for name, v in value.items()}
    return [_with_prefix(v, theirs, ours) for v in value] if isinstance(value, list) else value


def _changed(entry: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """An entry with the keys of ``own`` in place of its; tolerances one by one."""
    tolerances = {**entry.get("tolerances", {}), **own.get("tolerances", {})}
    return {**entry, **own, **({"tolerances": tolerances} if tolerances else {})}


def _taken(
    own: Mapping[str, Any], prefix: str, others: Mapping[str, Any], origin: str
) -> dict[str, Any]:
    """An entry with what it takes from the one that it is like.

    :param others: complete entries, by id.
    """
    if own["like"] not in others:
        raise UsageError(f"{origin}: no requirement {own['like']!r} to be like")
    theirs = others[own["like"]]
    taken = _with_prefix(theirs, own["like"].partition("-")[0], prefix)
    source = theirs["source"]
    taken["source"] = source if "like" in theirs else f"as {own['like']}: {source}"
    taken["confidence"] = "inferred"
    return _changed(taken, own)


def _lineage(entry: Mapping[str, Any], others: Mapping[str, Any]) -> tuple[str, ...]:
    """Ids of the requirement that this one is like, of the one which that is like, and so on."""
    found: list[str] = []
    while "like" in entry:
        found.append(entry["like"])
        entry = others[entry["like"]]
    return tuple(found)


def _filled(text: str, tolerances: Mapping[str, float], where: str) -> str:
    """``text`` with the tolerances that it names.

    :raises UsageError: it names others, or has a brace too many.
    """
    try:
        return text.format(**tolerances)
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise UsageError(f"{where}: {text!r} cannot be filled in: {error}") from error


def _check_kind(entry: _Entry, where: str) -> None:
    """A safety requirement also says what the original does; another one does not.

    :raises UsageError: it is otherwise.
    """
    if entry.kind is Kind.SAFETY and not entry.original:
        raise UsageError(
            f"{where}: a safety requirement needs the key original: what the original does"
        )
    if entry.kind is Kind.DROP_IN and entry.original:
        raise UsageError(
            f"{where}: only safety requirements have the key original: the original "
            "meets the others"
        )


def parse(
    text: str, origin: str = "requirements", others: Mapping[str, Any] | None = None
) -> tuple[Requirement, ...]:
    """Requirements of one hand, of a TOML text with its ``model``, its ``prefix`` and a
    ``[[requirement]]`` for each.

    :param others: complete entries by id, for what is ``like`` them; None for dexkit's own.
    :raises UsageError: a key is unknown or missing, a value is not one of those allowed, an id
        occurs twice, ``after`` names what does not come before, ``like`` what there is not, or
        ``kind`` and ``original`` contradict each other.
    """
    return _of_document(parse_toml(text, origin), origin, _written() if others is None else others)


def _of_document(
    document: Mapping[str, Any], origin: str, others: Mapping[str, Any]
) -> tuple[Requirement, ...]:
    unknown = set(document) - {"model", "prefix", "requirement"}
    if unknown:
        raise UsageError(f"{origin}: unknown keys {sorted(unknown)}")
    hand, prefix = model(str(document.get("model", ""))), str(document.get("prefix", ""))
    entries = document.get("requirement", [])
    if not isinstance(entries, list):
        raise UsageError(f"{origin}: requirements are [[requirement]] tables")
    by_layer: dict[str, list[Mapping[str, Any]]] = {}
    for entry in entries:
        name = entry.get("id", entry.get("like")) if isinstance(entry, dict) else "a requirement"
        to_record(entry, _Part, f"{origin}: {name}")
        complete = _taken(entry, prefix, others, origin) if "like" in entry else entry
        layer_name = _owner(entry["like"])[1] if "like" in entry else "dds"
        by_layer.setdefault(layer_name, []).append(complete)
    return tuple(
        requirement
        for layer_name, group in by_layer.items()
        for requirement in _parse(group, hand, layer_name, origin, others)
    )


def _parse(
    entries: Iterable[Mapping[str, Any]],
    hand: HandModel | RobotModel,
    layer_name: str,
    origin: str,
    others: Mapping[str, Any],
) -> tuple[Requirement, ...]:
    """The requirements of complete entries of one hand and one layer."""
    default_plots = layer(layer_name).plots
    dialect_names = (
        (hand.name,) if isinstance(hand, RobotModel) else tuple(d.name for d in hand.dialects)
    )
    found: dict[str, Requirement] = {}
    for written in entries:
        where = f"{origin}: {written.get('id', 'a requirement without id')}"
        entry = to_record(written, _Entry, where)
        if entry.id in found:
            raise UsageError(f"{where}: an id occurs once")
        _check_kind(entry, where)
        for before in entry.after:
            if before not in found:
                raise UsageError(f"{where}: {before} does not come before it")
            if entry.kind is Kind.DROP_IN and found[before].kind is Kind.SAFETY:
                raise UsageError(f"{where}: is drop-in, and cannot come after {before}: safety")
        if entry.spoils and layer_name != "client":
            raise UsageError(f"{where}: only a requirement about the client spoils others")
        for name in entry.dialects:
            if name not in DIALECTS:
                raise UsageError(f"{where}: no dialect {name!r}")
        tolerances = {
            name: _resolve(value, hand, found, where) for name, value in entry.tolerances.items()
        }
        own_dialects = tuple(d for d in entry.dialects if d in dialect_names)
        found[entry.id] = Requirement(
            **{name: getattr(entry, name) for name in _AS_WRITTEN},
            model=hand.name,
            layer=layer_name,
            dialects=own_dialects or dialect_names,
            tolerances=tolerances,
            sentence=_filled(entry.sentence, tolerances, where),
            expected=_filled(entry.expected or entry.sentence, tolerances, where),
            lineage=_lineage(written, others),
            plots=default_plots if entry.plots is None else entry.plots,
        )
    return tuple(found.values())


def _owner(name: str) -> tuple[str, str]:
    """Model and layer of a requirement of dexkit's own."""
    prefix, _, rest = name.partition("-")
    model_name, layer_name = PREFIXES[prefix]
    of_client = layer_name == "dds" and rest.startswith("CLIENT-")
    return model_name, "client" if of_client else layer_name


@cache
def _written() -> Mapping[str, Mapping[str, Any]]:
    """The complete entries of dexkit's own requirements by id, by area and behaviour."""
    found: dict[str, dict[str, Any]] = {}
    for name in BEHAVIOURS:
        path = Path(__file__).parent.parent / "behaviours" / f"{name}.toml"
        head = dict(read_toml(path))
        for table in head.pop("requirement"):
            for entry in _of_table({**head, **table}, path.name):
                if entry["id"] in found or entry["area"] not in AREAS:
                    raise UsageError(f"{path.name}: {entry['id']}: its id or area is no new one")
                found[entry["id"]] = entry
    return dict(sorted(found.items(), key=lambda item: AREAS.index(item[1]["area"])))


def _of_table(table: Mapping[str, Any], origin: str) -> list[dict[str, Any]]:
    """The complete entries of one table, in the order of its ids.

    :raises UsageError: an id is of no known model, or a value has another type.
    """
    ids = {name.partition("-")[0]: name.partition(" as ") for name in table["ids"]}
    common = {key: value for key, value in table.items() if key not in {"ids", *ids}}
    first = next(iter(ids))
    found: dict[str, dict[str, Any]] = {}
    for prefix, (name, _, like) in ids.items():
        own = table.get(prefix, {})
        to_record({**common, **own, "id": name}, _Part, f"{origin}: {name}")
        if prefix not in PREFIXES:
            raise UsageError(f"{origin}: {name} is of no known model")
        if like:
            own = {"like": ids[like][0], **own}
            found[name] = _taken(own, prefix, found, origin)
        else:
            found[name] = _changed(_with_prefix(common, first, prefix), own)
        found[name]["id"] = name
    return list(found.values())


def _named(entry: Mapping[str, Any]) -> list[str]:
    """The requirements that an entry comes after, or whose tolerances it takes."""
    tolerances = entry.get("tolerances", {}).values()
    return [*entry.get("after", []), *(v.partition(":")[0] for v in tolerances if type(v) is str)]


@cache
def _own(model_name: str, layer_name: str) -> tuple[Requirement, ...]:
    """Dexkit's own requirements of one model and layer, each after those that it names."""
    about = (model_name, layer_name)
    entries = {name: e for name, e in _written().items() if _owner(name) == about}
    ordered: list[Mapping[str, Any]] = []
    seen: set[str] = set()

    def place(name: str) -> None:
        if name in entries and name not in seen:
            seen.add(name)
            for before in _named(entries[name]):
                place(before)
            ordered.append(entries[name])

    for name in entries:
        place(name)
    hand = robot(model_name) if layer_name == "robot" else model(model_name)
    return _parse(ordered, hand, layer_name, "behaviours", _written())


def _of_plugin(hand: HandModel) -> tuple[Requirement, ...]:
    """The requirements of a model of another package.

    :raises UsageError: it has none, or a file cannot be read, or is wrong.
    :raises ModelBroken: what its package registers for the kit cannot be used.
    """
    found: list[Requirement] = []
    for path in map(Path, under_test(hand.name).requirements):
        for r in parse(read_text(path), path.name):
            if not r.like or r.model != hand.name:
                raise UsageError(
                    f"{path}: {r.id} is of {r.model} and like {r.like or 'nothing'}",
                    hint=f"each is of {hand.name} and like a requirement of dexkit, whose check "
                    "judges it",
                )
            found.append(r)
    return tuple(found)


@cache
def catalogue(model: str | None = None, layer: str | None = "dds") -> tuple[Requirement, ...]:
    """The requirements of every model, in their order; those of dexkit's own models first.

    :param model: only those of that hand model; None for all, without those of another package
        whose file cannot be read: it must not affect the others.
    :param layer: only those judged there; None for all.
    :raises UsageError: that model, of another package, has no requirements, or a file is wrong.
    :raises ModelBroken: what its package registers for the kit cannot be used.
    """
    found: list[Requirement] = []
    for own_model, own_layer in PREFIXES.values():
        for name in (own_layer, "client") if own_layer == "dds" else (own_layer,):
            if model in (None, own_model) and layer in (None, name):
                found += _own(own_model, name)
    for plugin in model_plugins():
        if plugin.model is not None and model in (None, plugin.name):
            with contextlib.suppress(*(() if model else (UsageError, ModelBroken))):
                found += [r for r in _of_plugin(plugin.model) if layer in (None, r.layer)]
    return tuple(found)


def models() -> tuple[str, ...]:
    """The hand models that have requirements."""
    return tuple(dict.fromkeys(r.model for r in catalogue(None, None) if r.layer != "robot"))


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
