"""Read a vendor's capability claims from ``capabilities.toml``.

Not every hand has every unit (:data:`~dexkit.conformance.kit.requirements.CAPABILITIES`). A file
says which this one has::

    [hand]
    name = "Example gripper"
    vendor = "Example Ltd"
    firmware = "1.2.0"
    model = "dex1-1"

    [claims]
    force = true
    velocity = false

What is claimed must pass: its SHOULDs count as MUSTs, unless they are inferred, for then no source
says that the unit is broken without them. What is not, false or left out, is reported as not
claimed. Without a file every unit is judged at the catalogue's level.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from dexkit import documents
from dexkit.conformance.kit.requirements import CAPABILITIES, Level, Requirement
from dexkit.errors import UsageError
from dexkit.models import model
from dexkit.records import as_plain, to_record

__all__ = ["Claims"]

_About = Annotated[str, msgspec.Meta(pattern="^(name|vendor|firmware|model)$")]
_Units = msgspec.defstruct(
    "_Units",
    [(unit, bool, False) for unit in CAPABILITIES],
    forbid_unknown_fields=True,
    frozen=True,
)
_HINT = (
    "[hand] has texts: name, vendor, firmware, model; [claims] has true or false for units: "
    f"{', '.join(CAPABILITIES)}"
)


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The form of the file; each member may be left out."""

    hand: dict[_About, str] = {}
    claims: _Units = _Units()  # type: ignore[valid-type]  # made above


@dataclass(frozen=True)
class Claims:
    """The capability claims for one hand.

    :param units: by unit, whether it is claimed; None without a file: nothing is said.
    :param hand: ``name``, ``vendor``, ``firmware``, ``model``, as far as they are given.
    """

    units: Mapping[str, bool] | None = None
    hand: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str, origin: str = "capabilities.toml") -> Claims:
        """Parse a TOML text.

        :raises UsageError: it is no TOML, or holds what is not known: a misspelt claim must not
            silently be none.
        """
        return cls.of_document(documents.parse_toml(text, origin), origin)

    @classmethod
    def of_document(cls, document: Mapping[str, Any], origin: str) -> Claims:
        """The claims of a document that was parsed; raises as :meth:`parse`."""
        file = to_record(document, _File, origin, hint=_HINT)
        if "model" in file.hand:
            model(file.hand["model"])
        return cls(as_plain(file.claims), file.hand)

    @classmethod
    def load(cls, path: Path | None, model_name: str | None) -> Claims:
        """Read a file; without one, nothing is claimed or disclaimed.

        :param model_name: the model that it must be about; None for any.

        :raises UsageError: as :meth:`parse`, or the file is about another model, or unreadable.
        """
        if path is None:
            return cls()
        claims = cls.of_document(documents.read_toml(path), path.name)
        about = claims.hand.get("model")
        if about and model_name and about != model_name:
            raise UsageError(
                f"{path.name} is about a {about}, and a {model_name} is to be judged",
                hint="--backend or --dialect of that model, or another file",
            )
        return claims

    def claimed(self, requirement: Requirement) -> bool | None:
        """Whether its unit is claimed; None if it has none, or nothing is said."""
        if self.units is None or not requirement.capability:
            return None
        return self.units[requirement.capability]

    def apply(self, requirements: Iterable[Requirement]) -> tuple[Requirement, ...]:
        """Raise every SHOULD about a claimed unit to a MUST, unless it is inferred."""
        return tuple(
            replace(r, level=Level.MUST)
            if self.claimed(r) and r.level is Level.SHOULD and r.confidence != "inferred"
            else r
            for r in requirements
        )

    @property
    def subject(self) -> dict[str, str]:
        """The hand's name, vendor and firmware, for a result's ``subject``."""
        return {("hand" if k == "name" else k): v for k, v in self.hand.items() if k != "model"}
