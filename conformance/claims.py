"""Read a vendor's capability claims from ``capabilities.toml``.

Not every hand has every unit (:data:`~dexkit.conformance.requirements.CAPABILITIES`). A file says
which this one has::

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
from typing import Any

from dexkit import documents
from dexkit.conformance.requirements import CAPABILITIES, Level, Requirement
from dexkit.errors import UsageError
from dexkit.models import model

__all__ = ["Claims"]

_HAND = ("name", "vendor", "firmware", "model")


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
        hand, units = document.get("hand", {}), document.get("claims", {})
        unknown = sorted(set(document) - {"hand", "claims"})
        if unknown or not isinstance(hand, dict) or not isinstance(units, dict):
            raise UsageError(
                f"{origin}: {', '.join(unknown) or 'hand or claims'} is not understood",
                hint="its tables are [hand] and [claims]",
            )
        for key, value in hand.items():
            if key not in _HAND or not isinstance(value, str):
                raise UsageError(
                    f"{origin}: [hand] {key} is not understood",
                    hint=f"texts, each may be left out: {', '.join(_HAND)}",
                )
        for unit, claimed in units.items():
            if unit not in CAPABILITIES:
                raise UsageError(
                    f"{origin}: no unit {unit!r}", hint=f"units: {', '.join(CAPABILITIES)}"
                )
            if not isinstance(claimed, bool):
                raise UsageError(f"{origin}: {unit} is true or false, not {claimed!r}")
        if "model" in hand:
            model(hand["model"])
        claimed = {unit: units.get(unit, False) for unit in CAPABILITIES}
        return cls(claimed, hand)

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
