"""Every hand model: those of dexkit, and those of other packages.

A profile (:class:`HandModel`) holds the facts of a hand. The built-in ones are the modules beside
this one. A package adds its own under the entry-point group
``dexkit.models``::

    [project.entry-points."dexkit.models"]
    my-hand = "my_package.profile:MY_HAND"

Sources are sections of docs/sources/unitree-dex.md and the gripper's DDS interface specification.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

from dexkit.errors import ModelBroken, UsageError
from dexkit.hand import Side
from dexkit.models.brainco import BRAINCO_REVO2
from dexkit.models.dex1 import DEX1_1
from dexkit.models.dex3 import DEX3_1
from dexkit.models.dex5 import DEX5_1
from dexkit.models.inspire import INSPIRE_DFX, INSPIRE_FTP
from dexkit.models.profile import (
    ClientCommand,
    Dialect,
    HandModel,
    ModeByte,
    PressureSensor,
    TouchArea,
)
from dexkit.plugins import entry_points, import_object, origin

__all__ = [
    "BRAINCO_REVO2",
    "BUILT_IN",
    "DEX1_1",
    "DEX3_1",
    "DEX5_1",
    "DIALECTS",
    "GROUP",
    "INSPIRE_DFX",
    "INSPIRE_FTP",
    "MODELS",
    "ClientCommand",
    "Dialect",
    "HandModel",
    "ModeByte",
    "ModelPlugin",
    "PressureSensor",
    "TouchArea",
    "dialect",
    "model",
    "model_plugins",
    "registered_record",
    "short_names",
]

GROUP = "dexkit.models"
BUILT_IN = (DEX1_1, DEX3_1, DEX5_1, BRAINCO_REVO2, INSPIRE_DFX, INSPIRE_FTP)
"""The models of dexkit itself."""

_lock = threading.RLock()


@dataclass(frozen=True)
class ModelPlugin:
    """A hand model that another package registers.

    :param name: of the entry point, which is that of the model.
    :param origin: distribution that registered it, with its version.
    :param target: ``package.module:attribute``.
    :param model: the profile; None if it cannot be used.
    :param error: why it cannot be used, or None.
    """

    name: str
    origin: str
    target: str
    model: HandModel | None
    error: ModelBroken | None = None


_plugins: tuple[ModelPlugin, ...] | None = None


def model_plugins() -> tuple[ModelPlugin, ...]:
    """Every model that other packages register, in the order of their names.

    They are loaded on the first call. One that cannot be used carries its error and is otherwise
    left out; it does not affect the others.
    """
    global _plugins  # read once for the process
    if _plugins is None:
        with _lock:
            if _plugins is None:
                _plugins = ()  # for a plug-in that asks for models while it is imported
                _plugins = _load_plugins()
    return _plugins


def _load_plugins() -> tuple[ModelPlugin, ...]:
    entries = {(e.name, e.value, origin(e)): e for e in entry_points(GROUP)}
    known = {m.name for m in BUILT_IN}
    dialects = {d.name for m in BUILT_IN for d in m.dialects}
    found = []
    for (name, target, owner), _ in sorted(entries.items()):
        loaded, error = None, None
        try:
            loaded = _checked(import_object(target, ModelBroken, hint="name a HandModel"), name)
            taken = {name} & known or {d.name for d in loaded.dialects} & dialects
            if taken:
                raise ModelBroken(
                    f"{owner} registers {', '.join(sorted(taken))}, which is there already",
                    hint="give the model and each of its dialects a name of its own",
                )
            known.add(name)
            dialects |= {d.name for d in loaded.dialects}
        except ModelBroken as broken:
            loaded, error = None, broken
        found.append(ModelPlugin(name, owner, target, loaded, error))
    return tuple(found)


def _types_of_hands(position_servo: bool) -> list[tuple[str, str]]:
    """The types of commands and states of those hands of several joints that dexkit has.

    Only these can be encoded: the conformance kit reads them by a table of its own, independently.
    """
    spoken = (d for m in BUILT_IN for d in m.dialects if not d.is_gripper)
    pairs = ((d.cmd_type, d.state_type) for d in spoken if d.position_servo == position_servo)
    return list(dict.fromkeys(pairs))


def _checked(value: object, name: str) -> HandModel:
    """The profile, if it can be used.

    :raises ModelBroken: naming the field that is wrong.
    """
    if not isinstance(value, HandModel):
        raise ModelBroken(
            f"{name} is a {type(value).__name__}, not a hand model",
            hint="name a dexkit.models.HandModel",
        )

    def require(met: bool, what: str) -> None:
        if not met:
            raise ModelBroken(f"the hand model {name}: {what}", hint="see docs/other-hands.md")

    require(value.name == name, f"its profile is named {value.name!r}")
    count = len(value.joints.get(Side.LEFT, ()))
    require(count > 0, "it has no joints")
    for side in Side:
        require(len(value.joints.get(side, ())) == count, f"its {side} hand lacks joints")
        require(len(value.rest_q.get(side, ())) == count, f"rest_q of the {side} hand lacks joints")
        require(not value.joints[side][0].coupled, f"the first joint of the {side} hand is coupled")
        require(any(value.rest_q[side]), "rest_q is all 0, which clients take for no state")
    require(len(value.gains) == count, "client_command lacks joints")
    require(bool(value.dialects), "it has no dialect")
    for each in value.dialects:
        require(each.model == name, f"its dialect {each.name} is of {each.model!r}")
        pairs = _types_of_hands(each.position_servo)
        require(
            each.is_gripper or (each.cmd_type, each.state_type) in pairs,
            f"its dialect {each.name} has to use the types "
            f"{', or '.join(' and '.join(pair) for pair in pairs)}",
        )
    if not value.dialects[0].is_gripper:
        for side in Side:
            require(
                all(j.finger for j in value.joints[side]),
                f"a joint of the {side} hand has no finger",
            )
    return value


T = TypeVar("T")


class _Known(Mapping[str, T]):
    """Models by name: built-in ones first, then those of other packages. The latter are loaded when
    a name is not built in, or when all names are requested.
    """

    def __init__(self, own: dict[str, T]) -> None:
        self._own = own

    def _others(self) -> dict[str, T]:
        raise NotImplementedError

    def __getitem__(self, name: str) -> T:
        found = self._own.get(name)
        return self._others()[name] if found is None else found

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self._others()

    def __len__(self) -> int:
        return len(self._own) + len(self._others())


class _Models(_Known[HandModel]):
    def _others(self) -> dict[str, HandModel]:
        return {p.name: p.model for p in model_plugins() if p.model is not None}


class _Dialects(_Known[Dialect]):
    def _others(self) -> dict[str, Dialect]:
        return {d.name: d for p in model_plugins() if p.model for d in p.model.dialects}


MODELS: Mapping[str, HandModel] = _Models({m.name: m for m in BUILT_IN})
"""Every usable model, by name."""
DIALECTS: Mapping[str, Dialect] = _Dialects({d.name: d for m in BUILT_IN for d in m.dialects})
"""Every dialect of a usable model, by name."""


def model(name: str) -> HandModel:
    """The model called ``name``.

    :raises UsageError: there is none.
    :raises ModelBroken: another package registers it, and it cannot be used.
    """
    try:
        return MODELS[name]
    except KeyError:
        for plugin in model_plugins():
            if plugin.name == name and plugin.error is not None:
                raise plugin.error from None
        raise UsageError(f"no hand model {name!r}", hint=f"known: {', '.join(MODELS)}") from None


def short_names() -> dict[str, HandModel]:
    """Every usable model by its name without the vendor's revision: ``dex3`` of ``dex3-1``; by its
    whole name where one before it has that.
    """
    found: dict[str, HandModel] = {}
    for hand in MODELS.values():
        short = hand.name.partition("-")[0]
        found[hand.name if short in found else short] = hand
    return found


@cache
def registered_record(group: str, model_name: str, kind: type[T]) -> T | None:
    """What another package registers about its model in an entry-point group, under the model's
    name; None if nothing.

    :param kind: of the object, which has the model as ``model``.
    :raises ModelBroken: it cannot be loaded, or is not about that model.
    """
    for entry in entry_points(group):
        if entry.name != model_name:
            continue
        found = import_object(entry.value, ModelBroken, hint=f"name a {kind.__name__}")
        if not isinstance(found, kind):
            raise ModelBroken(f"{entry.value} is a {type(found).__name__}, not a {kind.__name__}")
        about: HandModel = found.model  # type: ignore[attr-defined]
        if about.name != model_name:
            raise ModelBroken(f"{entry.value} is about {about.name}, not {model_name}")
        return found
    return None


def dialect(name: str) -> Dialect:
    """The dialect called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return DIALECTS[name]
    except KeyError:
        raise UsageError(f"no dialect {name!r}", hint=f"known: {', '.join(DIALECTS)}") from None
