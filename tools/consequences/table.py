"""The table of consequences: of each wrong hand, and of each requirement its level by them."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexkit.conformance.faults import mutants
from dexkit.conformance.kit.requirements import Level, Requirement, catalogue
from dexkit.documents import write_file
from dexkit.models import MODELS, model
from tools.consequences.kinds import FORCE, KINDS, NO_END, Consequence

__all__ = ["FILE", "Row", "Table", "sentence"]

FILE = Path(__file__).with_name("table.json")


@dataclass(frozen=True)
class Row:
    """A requirement by its consequences.

    :param hands: names of the wrong hands that fail it and were measured; ``missing`` is how many
        were not.
    :param own: the worst consequence of the hands that were made for it, or fail it alone, and the
        hand; None without any. ``shared`` likewise, of the others that fail it.
    """

    requirement: Requirement
    hands: tuple[str, ...]
    missing: int
    own: tuple[str, Consequence] | None
    shared: tuple[str, Consequence] | None

    @property
    def proposed(self) -> Level:
        """The level that follows: a MUST none of whose hands has a consequence is a SHOULD."""
        if self.own or self.shared or self.missing or self.requirement.level is not Level.MUST:
            return self.requirement.level
        return Level.SHOULD


@dataclass
class Table:
    """Consequences of wrong hands.

    :ivar hands: by a hand's name, its worst consequence of each kind; empty without any.
    :ivar revision: the code that measured them.
    """

    hands: dict[str, dict[str, Consequence]] = field(default_factory=dict)
    revision: str = ""

    @classmethod
    def load(cls, file: Path = FILE) -> Table:
        """Read the committed table."""
        data: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return cls(
            {
                name: {kind: Consequence(kind, *values) for kind, values in kinds.items()}
                for name, kinds in data["hands"].items()
            },
            data["revision"],
        )

    def save(self, file: Path = FILE) -> None:
        """Write it: a line for each hand and each requirement."""
        hands = {
            name: {
                kind: [*c[1:5], *(round(x, 3) for x in c[5:])] for kind, c in sorted(kinds.items())
            }
            for name, kinds in sorted(self.hands.items())
        }
        rows = {
            row.requirement.id: {
                "level": str(row.requirement.level),
                "proposed": str(row.proposed),
                "hands": len(row.hands),
                "missing": row.missing,
                "own": row.own and [row.own[0], row.own[1].kind],
                "shared": row.shared and [row.shared[0], row.shared[1].kind],
            }
            for row in self.rows()
            if row.hands
        }
        text = ",\n".join(
            f'"{title}": {{\n{_lines(values)}\n}}'
            for title, values in (("requirements", rows), ("hands", hands))
        )
        write_file(file, f'{{\n"revision": {json.dumps(self.revision)},\n{text}\n}}\n')

    def rows(self, model: str | None = None) -> list[Row]:
        """The requirements of hands on DDS, of a model or of all."""
        every = catalogue(model, "dds")
        failing = _failing()
        return [self._row(r, failing.get(r.id, ())) for r in every if r.model in MODELS]

    def _row(self, requirement: Requirement, failing: Sequence[tuple[str, bool]]) -> Row:
        measured = [(name, own) for name, own in failing if name in self.hands]
        own = self._worst(name for name, mine in measured if mine)
        shared = self._worst(name for name, mine in measured if not mine)
        names = tuple(name for name, _ in measured)
        return Row(requirement, names, len(failing) - len(names), own, shared)

    def _worst(self, names: Iterable[str]) -> tuple[str, Consequence] | None:
        found = [(name, c) for name in names for c in self.hands[name].values()]
        # of equals, that of the kind which is listed first
        order = list(KINDS)
        found.sort(key=lambda pair: order.index(pair[1].kind))
        return max(found, key=lambda pair: pair[1].size, default=None)


@functools.cache
def _failing() -> Mapping[str, tuple[tuple[str, bool], ...]]:
    """By requirement, the wrong hands that fail it; whether each was made for it, or fails no other
    one.
    """
    found: dict[str, list[tuple[str, bool]]] = {}
    for mutant in mutants("dds"):
        fails = (mutant.pinned or frozenset()) | {mutant.kills}
        for name in fails:
            own = name == mutant.kills or len(fails) == 1
            found.setdefault(name, []).append((mutant.pin, own))
    return {name: tuple(hands) for name, hands in found.items()}


def _lines(values: Mapping[str, object]) -> str:
    return ",\n".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in values.items())


# ------------------------------------------------------------------------------------ as text


@functools.cache
def _rows() -> Mapping[str, Row]:
    return {row.requirement.id: row for row in Table.load().rows()} if FILE.exists() else {}


def sentence(requirement_id: str) -> str:
    """What a client suffers from the worst hand that fails a requirement; "" if nobody knows."""
    row = _rows().get(requirement_id)
    if row is None or not row.hands:
        return ""
    worst = row.own or row.shared
    if worst is None and row.missing:
        return ""
    if worst is None:
        return (
            f"None of the {len(row.hands)} wrong hands that fail this has a consequence for a "
            "genuine client."
        )
    name, found = worst
    _, hand, fault, *_ = name.split()
    return f"With `{fault}` {told(found, hand)}."


def told(found: Consequence, hand: str) -> str:
    """A consequence in words, with both figures.

    :param hand: the hand's model, in whose units forces are.
    """
    kind = KINDS[found.kind]
    unit = model(hand).torque_unit if kind.unit == FORCE else kind.unit
    words = kind.words.format(found=_amount(found.found, unit), good=_amount(found.good, unit))
    joint = "" if found.kind == "starts" else f" joint {found.joint}"
    return f"{words} ({found.client}, {found.task}; {found.side}{joint})"


def _amount(value: float, unit: str) -> str:
    if value >= NO_END:
        return "for ever" if unit == "s" else "no end"
    if unit == "s":
        return f"{value:.2f} s"
    if unit.startswith("% "):
        return f"{100 * value:.0f} {unit}"
    return f"{value:.2g} {unit}"
