"""Hypothesis strategies for messages, made from the layouts."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import numpy as np
from hypothesis import strategies as st

from dexkit.messages import message_type
from dexkit.messages.layout import ALL, STRUCTS, Primitive, Struct

__all__ = ["NAMES", "SERVICE_NAMES", "messages"]

NAMES = list(STRUCTS)
SERVICE_NAMES = ["unitree_api::msg::dds_::Request_", "unitree_api::msg::dds_::Response_"]

_RANGES = {
    "int8": (-128, 127),
    "uint8": (0, 255),
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
}


def _numbers(kind: Primitive) -> st.SearchStrategy[Any]:
    if kind.idl == "float":
        return st.floats(width=32, allow_nan=False)
    if kind.idl == "boolean":
        return st.booleans()
    return st.integers(*_RANGES[kind.idl])


def _values(kind: Primitive | Struct) -> st.SearchStrategy[Any]:
    return messages(kind.dds_name) if isinstance(kind, Struct) else _numbers(kind)


def _filled(kind: Struct, random: Random) -> Any:
    """A message with random numbers, the ends of each type's range among them."""

    def number(primitive: Primitive) -> Any:
        if primitive.idl == "float":
            return np.float32(random.choice([0.0, -math.inf, random.gauss(0, 1e3)])).item()
        low, high = _RANGES[primitive.idl]
        return random.choice([low, high, random.randint(low, high)])

    def value(inner: Primitive | Struct) -> Any:
        return _filled(inner, random) if isinstance(inner, Struct) else number(inner)

    fields = {}
    for member in kind.fields:
        assert not member.sequence
        if member.array is None:
            fields[member.name] = value(member.type)
        else:
            items = [value(member.type) for _ in range(member.array)]
            fields[member.name] = items if member.is_structs else tuple(items)
    return message_type(kind.dds_name).cls(**fields)


def messages(name: str, max_elements: int = 9) -> st.SearchStrategy[Any]:
    """Messages of one type with any values that it can hold (NaN left out: it equals nothing)."""
    kind = ALL[name]
    if any(member.is_structs for member in kind.fields):
        # hundreds of numbers take too long to draw one by one
        return st.integers(0, 2**32).map(lambda seed: _filled(kind, Random(seed)))
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for member in kind.fields:
        if member.is_text:
            letters = st.characters(exclude_characters="\0", exclude_categories=["Cs"])
            fields[member.name] = st.text(letters, max_size=max_elements)
            continue
        values = _values(member.type)
        if member.is_bytes:
            fields[member.name] = st.binary(max_size=max_elements)
        elif member.sequence:
            fields[member.name] = st.lists(values, max_size=min(max_elements, member.most))
        elif member.array is not None:
            fields[member.name] = st.tuples(*[values] * member.array)
        else:
            fields[member.name] = values
    return st.builds(message_type(name).cls, **fields)
