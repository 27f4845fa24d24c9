"""The pinned verdicts, and how those that were found differ from them.

They are what a change of structure must not change: of each wrong hand the requirements that find
fault with it, of each sample every verdict and figure. A difference is either a mistake or a change
of what the kit demands; the commit that makes it says which.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dexkit.conformance.faults.trials import BLAMES
from dexkit.documents import read_bytes, write_file
from dexkit.errors import UsageError
from tools.pins.verdicts import Verdicts

__all__ = ["FOLDER", "Pins", "blamed_of", "figures_of"]

FOLDER = Path(__file__).parents[2] / "tests" / "pinned"


def blamed_of(verdicts: Verdicts) -> list[str]:
    """The requirements that find fault with a wrong hand."""
    blames = {str(verdict) for verdict in BLAMES}
    return sorted(
        name for name, sides in verdicts.items() if any(v in blames for v, _ in sides.values())
    )


def figures_of(verdicts: Verdicts) -> dict[str, str]:
    """Verdict and figure of a sample, by requirement and side."""
    return {
        f"{name} {side}": f"{verdict}: {figure}"
        for name, sides in verdicts.items()
        for side, (verdict, figure) in sides.items()
    }


@dataclass
class Pins:
    """The content of the two files.

    :ivar hands: ids of the requirements that find fault with a wrong hand, by its name.
    :ivar samples: by the sample's name, verdict and figure by requirement and side.
    """

    hands: dict[str, list[str]] = field(default_factory=dict)
    samples: dict[str, dict[str, str]] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path = FOLDER) -> Pins:
        """Read them.

        :raises UsageError: a file is missing, or is not as :meth:`save` writes it.
        """
        found = cls()
        try:
            hands = read_bytes(folder / "blamed.json")
            found.hands = msgspec.json.decode(hands, type=dict[str, list[str]])
            samples = read_bytes(folder / "samples.json")
            found.samples = msgspec.json.decode(samples, type=dict[str, dict[str, str]])
        except msgspec.MsgspecError as error:
            hint = "restore it with git, then write it anew: make pins ARGS=--update"
            raise UsageError(f"{folder}: not the pinned verdicts: {error}", hint=hint) from error
        return found

    def save(self, folder: Path = FOLDER) -> None:
        """Write them, the wrong hands by name."""
        for name, data in (("blamed", dict(sorted(self.hands.items()))), ("samples", self.samples)):
            write_file(folder / f"{name}.json", json.dumps(data, indent=1) + "\n")

    def updated(self, found: Pins, *, everything: bool) -> Pins:
        """These, with what was found.

        :param everything: what was not found is no longer there.
        """
        if everything:
            return found
        return Pins({**self.hands, **found.hands}, {**self.samples, **found.samples})

    def differences(self, found: Pins, *, everything: bool) -> Iterator[str]:
        """A line for each wrong hand and each verdict of a sample that is not as it is pinned.

        :param everything: what was not found is no longer there.
        """
        for name, ids in found.hands.items():
            pinned = self.hands.get(name)
            if pinned is None:
                yield f"{name}: not pinned; blamed for {', '.join(ids) or 'nothing'}"
            elif changed := list(_changed(pinned, ids)):
                yield f"{name}: {' '.join(changed)}"
        for name, figures in found.samples.items():
            old: Mapping[str, str] = self.samples.get(name, {})
            for about in dict.fromkeys([*old, *figures]):
                before, after = old.get(about, "nothing"), figures.get(about, "nothing")
                if before != after:
                    yield f"{name}: {about}: {before} -> {after}"
        if everything:
            for gone in [
                *(self.hands.keys() - found.hands),
                *(self.samples.keys() - found.samples),
            ]:
                yield f"{gone}: pinned, but there is none of that name"


def _changed(pinned: Collection[str], found: Collection[str]) -> Iterator[str]:
    yield from (f"+{name}" for name in found if name not in pinned)
    yield from (f"-{name}" for name in pinned if name not in found)
