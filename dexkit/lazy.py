"""References to objects that are imported on first use.

A record of a hand or a driver names code that must not be loaded with it, such as a dialect's codec
or a bring-up, as ``package.module:attribute``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeVar, cast

from dexkit.errors import ModelBroken
from dexkit.plugins import import_object

__all__ = ["Lazy"]

T = TypeVar("T")


@dataclass(frozen=True)
class Lazy(Generic[T]):
    """An object of type ``T`` that is imported by :meth:`load`.

    :param target: ``package.module:attribute``, or ``package.module`` for the module itself.
    """

    target: str

    def load(self) -> T:
        """The object.

        :raises ModelBroken: its module cannot be imported, or has no such attribute.
        """
        return cast("T", _load(self.target))


@cache
def _load(target: str) -> object:
    return import_object(
        target, ModelBroken, hint="a hand's profile refers to it as package.module:attribute"
    )
