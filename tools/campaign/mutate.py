"""Damaged inputs, quickly: a few hundred nanoseconds each."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

__all__ = ["ODD", "TextMutator", "damaged_json", "mutator"]

ODD: tuple[Any, ...] = (
    None, True, 0, -1, 1.5, 10**30, 1e308, math.inf, "", "x", "\x1b[31m\x00", [], {}, [[]],
    [None], {"a": 1}, "left", ["left"], math.nan, 2**63, -(2**63) - 1, 1e-320, "\ud800", "\n",
)  # fmt: skip
"""Values of each JSON type, and at the limits of others."""

_EDGES = (0x00, 0x01, 0x7F, 0x80, 0xFE, 0xFF, 0x10, 0x20)
_WORDS = (
    b"\x00\x00",
    b"\xff\xff",
    b"\xff\x7f",
    b"\x00\x80",
    b"\x00\x00\x00\x00",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\x00\x00\xc0\x7f",  # NaN
    b"\x00\x00\x80\x7f",  # infinity
    b"\x00\x00\x00\x10",
    b"\x10\x00\x00\x00",
)
Fix = Callable[[bytearray], None]


def mutator(
    corpus: Sequence[bytes], rng: random.Random, fix: Fix | None = None
) -> Callable[[], bytes]:
    """A function that returns another damaged input at each call.

    :param fix: makes lengths and checksums right again; used on half of the inputs.
    """
    bits = rng.getrandbits
    seeds = [bytes(c) for c in corpus]
    count = len(seeds)

    def damaged() -> bytes:
        r = bits(64)
        data = bytearray(seeds[(r >> 40) % count])
        change(data, r)
        while r & 0x3000000000000000 == 0:  # one in four is damaged twice, one in 16 three times
            r = bits(64)
            change(data, r)
        if fix is not None and r >> 63:
            fix(data)
        return bytes(data)

    def change(data: bytearray, r: int) -> None:
        size = len(data)
        op = r & 15
        if not size or op == 15:
            data[(r >> 16) & 0xFF :] = rng.randbytes((r >> 8) & 0x3F)
        elif op < 5:
            data[(r >> 8) % size] = (r >> 32) & 0xFF
            if op == 4:
                data[(r >> 20) % size] = _EDGES[(r >> 4) & 7]
        elif op < 8:
            data[(r >> 8) % size] ^= 1 << ((r >> 4) & 7)
        elif op < 10:
            at = (r >> 8) % size
            word = _WORDS[(r >> 32) % 12]
            data[at : at + len(word)] = word
        elif op == 10:
            del data[(r >> 8) % size :]
        elif op == 11:
            at = (r >> 8) % size
            del data[at : at + 1 + ((r >> 4) & 7)]
        elif op == 12:
            at, length = (r >> 8) % size, 1 + ((r >> 32) & 31)
            data[at:at] = data[at : at + length] * (1 + ((r >> 4) & 3))
        elif op == 13:
            other = seeds[(r >> 32) % count]
            data[(r >> 8) % size :] = other[(r >> 48) % (len(other) or 1) :]
        else:
            at = (r >> 8) % size
            data[at:at] = rng.randbytes(1 + ((r >> 4) & 7))

    return damaged


class TextMutator:
    """Damaged texts of a grammar: pieces are replaced by others that the grammar knows, or not."""

    _ODD = (
        "",
        "\x00",
        "\u00b2",
        "\u0661",
        "\ud7ff",
        "\x1b[31m",
        "-1",
        "1e999",
        "nan",
        "inf",
        "9" * 40,
        "9" * 5000,
        "[" * 50,
        "{" * 50,
        '"',
        "\\",
        "\n",
        "\r",
        "\t",
        " " * 40,
        "#",
        "null",
        "true",
        "0x10",
        "1.5",
        "=",
        ":",
        ",",
        "@",
    )

    def __init__(self, corpus: Sequence[str], words: Sequence[str], rng: random.Random) -> None:
        self._corpus = list(corpus)
        self._words = [*words, *self._ODD]
        self._rng = rng

    def __call__(self) -> str:
        """Another one."""
        rng = self._rng
        text = rng.choice(self._corpus)
        for _ in range(1 + (rng.getrandbits(8) & 3)):
            at = rng.randrange(len(text) + 1)
            op = rng.getrandbits(3)
            if op < 2:
                text = text[:at] + rng.choice(self._words) + text[at:]
            elif op < 4:
                text = text[:at] + rng.choice(self._words) + text[at + 1 + rng.getrandbits(3) :]
            elif op == 4:
                text = text[:at] + text[at + 1 + rng.getrandbits(3) :]
            elif op == 5:
                text = text[:at] + chr(rng.choice((rng.getrandbits(7), 0xB2, 0x3B1, 0x1F600)))
            elif op == 6:
                piece = text[at : at + 1 + rng.getrandbits(5)]
                text = text[:at] + piece * (1 + rng.getrandbits(2)) + text[at:]
            else:
                other = rng.choice(self._corpus)
                text = text[:at] + other[rng.randrange(len(other) + 1) :]
        return text


def damaged_json(content: Any, rng: random.Random, words: Sequence[str] = ()) -> str:
    """JSON text of ``content`` with one to three places of another type, absent or too deep.

    :param words: of the grammar; in their place, or as a name.
    """
    copy = json.loads(json.dumps(content))
    for _ in range(1 + rng.getrandbits(1)):
        place: Any = copy
        parent: Any = None
        key: Any = None
        while isinstance(place, dict | list) and place and (parent is None or rng.random() < 0.8):
            parent = place
            key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
            place = place[key]
        if parent is None:
            continue
        if rng.random() < 0.15:
            del parent[key]
        elif words and rng.random() < 0.3:
            word = rng.choice(words)
            if isinstance(place, str) or not isinstance(parent, dict):
                parent[key] = word
            else:  # under another name, too or instead
                parent[word] = place if rng.random() < 0.5 else parent.pop(key)
        else:
            parent[key] = deepcopy(rng.choice(ODD))
    text = json.dumps(copy)
    if rng.random() < 0.01:
        deep = rng.choice((900, 20_000))
        return text[: rng.randrange(len(text))] + "[" * deep + "]" * deep
    if rng.random() < 0.02:
        return text[: rng.randrange(len(text))]
    return text
