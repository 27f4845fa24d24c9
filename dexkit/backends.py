"""Backends by name: the entry-point group ``dexkit.backends``, the simulated hands of dexkit, and
``package.module:Object``.

A backend is a :class:`Backend`: a description and a factory that makes a
:class:`~dexkit.hand.Hand` from :class:`BackendOptions`. A plug-in package registers one under
its name::

    [project.entry-points."dexkit.backends"]
    my-gripper = "my_package.hand:backend"

A backend called ``sim-`` and the name of a model simulates that model, without a device and with a
setting ``object``: the conformance kit and ``dexkit emulate all`` start it (:func:`simulators`).

``package.module:Class`` also takes a plain callable ``(options) -> Hand`` or a Hand class whose
constructor takes the side. The module is installed, or lies in the working directory.
"""

from __future__ import annotations

import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexkit import __version__
from dexkit.errors import BackendBroken, BackendConflict, DexkitError, UnknownBackend, UsageError
from dexkit.hand import Hand, HandSpec, Side
from dexkit.lazy import Lazy
from dexkit.models import short_names
from dexkit.plugins import entry_points, import_object, is_own, origin, where

if TYPE_CHECKING:
    from dexkit.bringup import Bench

__all__ = [
    "GROUP",
    "SHARED_MACHINE",
    "Backend",
    "BackendInfo",
    "BackendOptions",
    "Emulator",
    "backend",
    "list_backends",
    "simulators",
]

GROUP = "dexkit.backends"
_SIMULATED = {
    "sim-dex1": "dexkit.emulators.sim_dex1:sim_dex1",
    "sim-dex3": "dexkit.emulators.sim_dex3:sim_dex3",
    "sim-dex5": "dexkit.emulators.sim_dex5:sim_dex5",
    "sim-brainco": "dexkit.emulators.sim_brainco:sim_brainco",
    "sim-inspire-dfx": "dexkit.emulators.sim_inspire:sim_inspire_dfx",
    "sim-inspire-ftp": "dexkit.emulators.sim_inspire:sim_inspire_ftp",
}
"""The simulated hands of dexkit itself."""


@dataclass(frozen=True)
class BackendOptions:
    """The options with which a user chooses and configures a hand.

    :param side: which hand.
    :param device: path, serial number or address of the device; None where none is needed.
    :param settings: ``KEY=VALUE`` settings of the particular backend (``--set`` on the command
        line); a backend refuses those it does not know.
    """

    side: Side
    device: str | None = None
    settings: dict[str, str] = field(default_factory=dict)

    def refuse_unknown(self, known: Iterable[str]) -> None:
        """Raise when ``settings`` has a key that is not ``known``.

        :raises UsageError: naming the key and the known ones.
        """
        names = sorted(known)
        for key in self.settings:
            if key not in names:
                raise UsageError(
                    f"this backend has no setting {key!r}",
                    hint=f"known: {', '.join(names)}" if names else "it has no settings",
                )


@dataclass(frozen=True)
class Emulator:
    """How ``dexkit emulate`` emulates a backend's device: one process a hand.

    :param arguments: of ``dexkit emulate``, without object; ``{side}`` is the hand's.
    :param linked: whether its path is given by ``--link``. Otherwise it prints its address as the
        first word after ``ready:``, and gets ``--side``.
    :param settings: those with which the backend has to be served then, by key.
    """

    arguments: tuple[str, ...]
    linked: bool
    settings: Mapping[str, str] = field(default_factory=dict)

    def command(self, side: Side, path: Path) -> tuple[str, ...]:
        """The arguments of ``dexkit`` for one hand.

        :param path: of the link, where there is one.
        """
        place = ("--link", str(path)) if self.linked else ("--side", str(side))
        arguments = [argument.format(side=side) for argument in self.arguments]
        return ("emulate", *arguments, *place)


SHARED_MACHINE: Mapping[str, str] = {"timeout": "0.3"}
"""The setting of a driver whose emulated device shares the machine with other processes, and may
answer late."""


@dataclass(frozen=True)
class Backend:
    """A driver or simulated hand, with its settings.

    :param summary: one line for ``dexkit backends``.
    :param model: hand model that it implements; empty where it is known only after the hand was
        made.
    :param needs: the device that is needed: ``"--device PATH or serial number"``, or empty.
    :param make: makes the hand, without opening it.
    :param needs_device: refuse to start without a device.
    :param settings: name and help of each ``--set`` setting.
    :param bringup: makes the :class:`~dexkit.bringup.Bench` of ``dexkit bringup``, or None.
    :param udev_rules: makes the udev rules that give users access to its USB device, or None.
    :param emulator: how its device is emulated, so that the conformance kit can start one; None
        where dexkit emulates none.
    :param usb_requirements: whether the USB requirements of the model apply to its device.
    :param settings_file: gives the path of the user's file with the settings of single hands, which
        the setting ``config`` replaces; None where there is none.
    """

    summary: str
    model: str
    make: Callable[[BackendOptions], Hand]
    needs: str = ""
    needs_device: bool = False
    settings: dict[str, str] = field(default_factory=dict)
    bringup: Lazy[Callable[[BackendOptions], Bench]] | None = None
    udev_rules: Lazy[Callable[[], str]] | None = None
    emulator: Emulator | None = None
    usb_requirements: bool = False
    settings_file: Lazy[Callable[[], Path]] | None = None

    def create(self, options: BackendOptions) -> Hand:
        """Make the hand; nothing is opened yet.

        :raises UsageError: a device is needed and missing, or a setting is unknown.
        :raises BackendBroken: the backend's own code failed, or did not make the hand asked for.
        """
        if self.needs_device and not options.device:
            raise UsageError("this backend needs a device", hint=f"give {self.needs}")
        options.refuse_unknown(self.settings)
        try:
            hand = self.make(options)
            _check(hand, options.side, self.model)
            return hand
        except DexkitError:
            raise
        except Exception as error:  # a plug-in may raise anything
            raise BackendBroken(
                f"the backend failed to make its hand: {type(error).__name__}: {error}",
                hint=_where(error),
            ) from error

    def model_of(self, options: BackendOptions) -> str:
        """The model of the hand that :meth:`create` makes.

        :raises DexkitError: it has to be asked, and as :meth:`create`.
        """
        return self.model or self.create(options).spec.model


@dataclass(frozen=True)
class BackendInfo:
    """One row of ``dexkit backends``.

    :param origin: distribution that registered it, with its version.
    :param error: why it cannot be used, or empty.
    """

    name: str
    origin: str
    target: str
    backend: Backend | None
    error: str = ""


@dataclass(frozen=True, order=True)
class _Registered:
    """A name and what it stands for; dexkit's own come first.

    :param origin: distribution that registered it, with its version.
    :param target: ``package.module:Object``.
    """

    foreign: bool
    name: str
    target: str
    origin: str


def _registered() -> list[_Registered]:
    """Every backend that has a name, once."""
    found = {_Registered(not is_own(e), e.name, e.value, origin(e)) for e in entry_points(GROUP)}
    own = f"dexkit {__version__}"
    found |= {_Registered(False, name, target, own) for name, target in _SIMULATED.items()}
    return sorted(found)


def simulators() -> dict[str, str]:
    """The backend that simulates each model, by the model's name: ``sim-`` and that name, whole or
    short. Nothing is loaded.
    """
    names = {entry.name for entry in _registered()}
    return {
        hand.name: name
        for short, hand in short_names().items()
        for name in (f"sim-{short}", f"sim-{hand.name}")
        if name in names
    }


def _select(name: str, registered: Iterable[_Registered]) -> _Registered | None:
    entries = [e for e in registered if e.name == name]
    own = [e for e in entries if not e.foreign]
    if own and len(entries) > len(own):
        others = ", ".join(e.origin for e in entries if e.foreign)
        raise BackendConflict(
            f"backend {name!r} is built in, and {others} registers the same name",
            hint=f"uninstall that package, or name its hand as package.module:Object "
            f"instead of {name!r}",
        )
    if len(entries) > 1 and not own:
        owners = ", ".join(e.origin for e in entries)
        raise BackendConflict(
            f"backend {name!r} is registered by more than one package: {owners}",
            hint="uninstall one, or name the hand as package.module:Object",
        )
    return entries[0] if entries else None


def _coerce(target: str, value: object) -> Backend:
    if isinstance(value, Backend):
        return value
    if inspect.isclass(value):
        factory: Callable[[Side], Any] = value

        def make_from_class(options: BackendOptions) -> Hand:
            hand: Hand = factory(options.side)  # create() looks whether it is one
            return hand

        return Backend(
            summary=(value.__doc__ or target).strip().splitlines()[0],
            model="",
            make=make_from_class,
        )
    if callable(value):
        return Backend(
            summary=(value.__doc__ or target).strip().splitlines()[0], model="", make=value
        )
    raise BackendBroken(
        f"{target} is a {type(value).__name__}, not a backend",
        hint="give a dexkit.backends.Backend, a Hand class, or a function that makes a Hand",
    )


_PARTS = ("spec", "open", "close", "exchange")


def _check(hand: object, side: Side, model: str) -> None:
    """Check that the object made by a backend is a hand of the right side and model.

    :raises BackendBroken: naming what is missing or wrong.
    """
    name = type(hand).__name__
    # a property that raises AttributeError exists, and its own error is more precise
    absent = object()
    missing = [
        part
        for part in _PARTS
        if inspect.getattr_static(hand, part, absent) is absent and not hasattr(hand, part)
    ]
    if missing:
        raise BackendBroken(
            f"the backend made a {name}, which is not a Hand: it has no {' and no '.join(missing)}",
            hint=f"a Hand has {', '.join(_PARTS)} (docs/backends.md)",
        )
    spec: object = hand.spec  # type: ignore[attr-defined]
    if not isinstance(spec, HandSpec):
        raise BackendBroken(
            f"{name}.spec is a {type(spec).__name__}, not a HandSpec",
            hint="spec is a property, not a method; DEX1_1.spec(side, io_rate=...) makes one",
        )
    if spec.side is not side:
        raise BackendBroken(
            f"{name} was made for the {side} hand, but its spec has {spec.side}",
            hint="pass the given side to the spec",
        )
    if model and spec.model != model:
        raise BackendBroken(f"the backend declares the model {model}, but {name} has {spec.model}")


def _where(error: BaseException) -> str:
    if traceback.extract_tb(error.__traceback__)[-1].filename == __file__:
        return (  # the backend's own code was not even reached
            "a Hand class is called with the side alone, a function with BackendOptions "
            "(docs/backends.md)"
        )
    return where(error)


def _load(target: str) -> Backend:
    value = import_object(
        target,
        BackendBroken,
        hint="package.module:Object names a Backend, a Hand class, or a function that makes a Hand",
    )
    return _coerce(target, value)


def backend(name: str) -> Backend:
    """The backend called ``name``, or the object at ``package.module:Object``.

    :raises UnknownBackend: no such name.
    :raises BackendConflict: more than one package claims the name.
    :raises BackendBroken: it cannot be loaded.
    """
    if ":" in name:
        # As `python -m` does: a hand that is being written need not be installed. Last, so that
        # nothing that lies here replaces what is installed.
        here = os.getcwd()
        if here not in sys.path and "" not in sys.path:
            sys.path.append(here)
        return _load(name)
    registered = _registered()
    entry = _select(name, registered)
    if entry is None:
        known = ", ".join(sorted({e.name for e in registered})) or "none"
        raise UnknownBackend(
            f"no backend {name!r}",
            hint=f"installed: {known}; see 'dexkit backends', or give package.module:Object",
        )
    return _load(entry.target)


def list_backends() -> list[BackendInfo]:
    """Every registered backend, built-in and plug-in, with its error if it cannot be used."""
    rows = []
    registered = _registered()
    for entry in registered:
        loaded: Backend | None = None
        error = ""
        try:
            _select(entry.name, registered)
            loaded = _load(entry.target)
        except (BackendBroken, BackendConflict) as exc:
            error = exc.message
        rows.append(BackendInfo(entry.name, entry.origin, entry.target, loaded, error))
    return rows
