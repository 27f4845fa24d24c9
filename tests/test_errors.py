"""The tree of errors is the one in the docstring, and each has a message and a hint."""

from __future__ import annotations

import inspect

from dexkit import errors
from dexkit.errors import DexkitError

CLASSES = {
    name: cls
    for name, cls in vars(errors).items()
    if inspect.isclass(cls) and issubclass(cls, DexkitError)
}


def test_each_has_a_message_and_a_hint() -> None:
    for name, kind in CLASSES.items():
        error = kind("what is wrong", hint="what to do")
        assert str(error) == error.message == "what is wrong", name
        assert error.hint == "what to do", name
        assert error.exit_code in (1, 2), name
        assert kind("x").hint == "", name


def test_a_fault_carries_its_bits() -> None:
    assert errors.HandFault("overload", bits=[1, 0x80]).bits == (1, 0x80)
    assert errors.HandFault("overload").bits == ()
