"""Entry points of installed packages: who registered what, and loading it with clear errors."""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from functools import lru_cache
from importlib.machinery import PathFinder
from typing import TYPE_CHECKING

from dexkit.errors import DexkitError

if TYPE_CHECKING:
    from importlib import metadata

__all__ = ["entry_points", "import_object", "is_own", "origin", "where"]

_OWN_DISTRIBUTION = "dexkit"


def entry_points(group: str) -> list[metadata.EntryPoint]:
    """Every entry point of a group."""
    if not _may_register(group):
        return []
    from importlib import metadata  # not above: it takes a dozen milliseconds to import

    return list(metadata.entry_points(group=group))


def _may_register(group: str) -> bool:
    """Whether an installed package may register something in a group.

    The answer is yes as well where that does not follow from ``entry_points.txt`` of the packages
    in the folders of :data:`sys.path`: in archives and with other finders.
    """
    for finder in sys.meta_path:
        if finder is not PathFinder and hasattr(finder, "find_distributions"):
            return True
    header = f"[{group}]".encode()
    for folder in dict.fromkeys(path or os.curdir for path in sys.path):
        try:
            names = os.listdir(folder)
        except NotADirectoryError:
            return True
        except OSError:
            continue  # a folder that is not there registers nothing
        for name in names:
            if name.endswith((".dist-info", ".egg-info")):
                try:
                    with open(os.path.join(folder, name, "entry_points.txt"), "rb") as file:
                        if header in file.read():
                            return True
                except OSError:
                    continue
            elif name.endswith(".egg"):
                return True
    return False


@lru_cache(maxsize=64)
def _registrant(dist: metadata.Distribution) -> tuple[str, str]:
    """Name and version of a distribution, whose metadata is parsed once."""
    about = dist.metadata
    return str(about["Name"]), str(about["Version"])


def origin(entry: metadata.EntryPoint) -> str:
    """Name and version of the distribution that registered it."""
    return " ".join(_registrant(entry.dist)) if entry.dist else "unknown"


def is_own(entry: metadata.EntryPoint) -> bool:
    """Whether dexkit itself registered it."""
    return entry.dist is not None and _registrant(entry.dist)[0].lower() == _OWN_DISTRIBUTION


def where(error: BaseException) -> str:
    """File and line that raised an error."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"at {frame.filename}:{frame.lineno}"


def import_object(target: str, error_class: type[DexkitError], *, hint: str) -> object:
    """The object at ``package.module:attribute``, or the module at ``package.module``.

    :param error_class: raised, naming the cause, when it cannot be imported.
    :param hint: what the target should be, for an attribute that is not there.
    """
    module_name, colon, attribute = target.partition(":")
    try:
        value: object = importlib.import_module(module_name)
    except Exception as error:  # a plug-in may raise anything while it is imported
        raise error_class(
            f"cannot load {target}: {type(error).__name__}: {error}",
            hint=_import_hint(error, module_name),
        ) from error
    for part in attribute.split(".") if colon else ():
        if not hasattr(value, part):
            raise error_class(
                f"cannot load {target}: there is no {part!r} in {module_name}", hint=hint
            )
        value = getattr(value, part)
    return value


def _import_hint(error: Exception, module_name: str) -> str:
    if isinstance(error, ModuleNotFoundError):
        missing = error.name or ""
        if module_name == missing or module_name.startswith(f"{missing}."):
            return "is it installed in this environment, or in the working directory?"
        return f"{module_name} needs it: is it installed in this environment?"
    return where(error)
