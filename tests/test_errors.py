"""The tree of errors is the one in the docstring, and each has a message and a hint."""

from __future__ import annotations

import inspect
import re

from dexkit import errors
from dexkit.errors import DexkitError

CLASSES = {
    name: cls
    for name, cls in vars(errors).items()
    if inspect.isclass(cls) and issubclass(cls, DexkitError)
}


def drawn() -> dict[str, tuple[str | None, str | None]]:
    """Of each class in the drawing: its parent and the built-in in brackets."""
    tree: dict[str, tuple[str | None, str | None]] = {}
    path: list[tuple[int, str]] = []
    for line in (errors.__doc__ or "").splitlines():
        match = re.match(r"^([ │├└─]*)([A-Z]\w+)(?: \((\w+)\))?(?:  .*)?$", line)
        if not match or not line.startswith("    "):
            continue
        depth = len(match.group(1))
        while path and path[-1][0] >= depth:
            path.pop()
        tree[match.group(2)] = (path[-1][1] if path else None, match.group(3))
        path.append((depth, match.group(2)))
    return tree


def test_docstring_tree_lists_every_error() -> None:
    assert drawn().keys() == CLASSES.keys() == set(errors.__all__)


def test_error_bases_match_the_docstring_tree() -> None:
    for name, (parent, builtin) in drawn().items():
        bases = [base.__name__ for base in CLASSES[name].__bases__]
        assert bases == [b for b in (parent or "Exception", builtin) if b], name


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
