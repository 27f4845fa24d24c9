"""Hypothesis strategies for messages, made from the layouts."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from dexkit.messages import message_type
from dexkit.messages.layout import STRUCTS, Primitive, Struct

__all__ = ["NAMES", "messages"]

NAMES = list(STRUCTS)

_RANGES = {"uint8": (0, 255), "int16": (-(2**15), 2**15 - 1), "uint32": (0, 2**32 - 1)}


def _numbers(kind: Primitive) -> st.SearchStrategy[Any]:
    if kind.idl == "float":
        return st.floats(width=32, allow_nan=False)
    return st.integers(*_RANGES[kind.idl])


def _values(kind: Primitive | Struct) -> st.SearchStrategy[Any]:
    return messages(kind.dds_name) if isinstance(kind, Struct) else _numbers(kind)


def messages(name: str, max_elements: int = 9) -> st.SearchStrategy[Any]:
    """Messages of one type with any values that it can hold (NaN left out: it equals nothing)."""
    fields = {}
    for member in STRUCTS[name].fields:
        values = _values(member.type)
        if member.sequence:
            fields[member.name] = st.lists(values, max_size=max_elements)
        elif member.array is not None:
            fields[member.name] = st.tuples(*[values] * member.array)
        else:
            fields[member.name] = values
    return st.builds(message_type(name).cls, **fields)
