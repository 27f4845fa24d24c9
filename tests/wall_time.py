"""Find assertions that bound how much time something takes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import pairwise

__all__ = ["upper_bounds"]

_CLOCKS = {
    f"time.{name}{suffix}"
    for name in ("monotonic", "perf_counter", "process_time", "thread_time", "time")
    for suffix in ("", "_ns")
}
_Function = (ast.FunctionDef, ast.Module)


def upper_bounds(source: str) -> list[int]:
    """Lines of the assertions that fail when something takes longer.

    Variables are followed through a function: those that a clock was read into, and what is
    computed from their differences. A wait that ends at a deadline is none: ``time.monotonic() <
    deadline`` ends a test that has failed.
    """
    if not any(clock in source for clock in _CLOCKS):  # parsing every file takes seconds
        return []
    found = {
        assertion.lineno
        for function in ast.walk(ast.parse(source))
        if isinstance(function, _Function)
        for durations in [_Durations(function)]
        for assertion in ast.walk(function)
        if isinstance(assertion, ast.Assert) and durations.are_bounded_by(assertion.test)
    }
    return sorted(found)


def _reads_a_clock(value: ast.expr) -> bool:
    return isinstance(value, ast.Call) and ast.unparse(value.func) in _CLOCKS


class _Durations:
    """What the variables of a function know of time."""

    def __init__(self, function: ast.AST) -> None:
        self._readings: set[str] = set()
        self._signs: dict[str, int] = {}
        for name, value in sorted(_assignments(function), key=lambda pair: pair[1].lineno):
            if self._is_reading(value):
                self._readings.add(name)
            elif sign := self._sign(value):
                self._signs[name] = sign

    def _is_reading(self, value: ast.expr) -> bool:
        named = isinstance(value, ast.Name) and value.id in self._readings
        return named or _reads_a_clock(value)

    def _sign(self, value: ast.expr) -> int:
        """1 if the value grows with a duration, -1 if it shrinks (a rate), 0 if it has none."""
        if isinstance(value, ast.Name):
            return self._signs.get(value.id, 0)
        if isinstance(value, ast.UnaryOp):
            return -self._sign(value.operand) if isinstance(value.op, ast.USub) else 0
        if isinstance(value, ast.Call):
            return next((sign for each in value.args if (sign := self._sign(each))), 0)
        if not isinstance(value, ast.BinOp):
            return 0
        left, right = value.left, value.right
        if isinstance(value.op, ast.Sub):
            began = isinstance(right, ast.Name) and self._is_reading(right)
            if began or self._is_reading(left):
                return 1
            return -1 if _reads_a_clock(right) else self._sign(left) or -self._sign(right)
        if isinstance(value.op, (ast.Div, ast.FloorDiv)):
            return self._sign(left) or -self._sign(right)
        return self._sign(left) or self._sign(right)

    def are_bounded_by(self, test: ast.expr) -> bool:
        """Whether a comparison in ``test`` fails when a duration is longer."""
        for compare in ast.walk(test):
            if isinstance(compare, ast.Compare):
                values = [compare.left, *compare.comparators]
                for (left, right), operator in zip(pairwise(values), compare.ops, strict=True):
                    signs = self._sign(left), self._sign(right)
                    if isinstance(operator, ast.Eq) and any(signs):
                        return True
                    if isinstance(operator, (ast.Lt, ast.LtE)) and (signs[0] > 0 or signs[1] < 0):
                        return True
                    if isinstance(operator, (ast.Gt, ast.GtE)) and (signs[1] > 0 or signs[0] < 0):
                        return True
        return False


def _assignments(function: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, (ast.AnnAssign, ast.NamedExpr)):
            targets = [node.target]
        else:
            continue
        for target in targets:
            pairs: list[tuple[ast.expr, ast.expr | None]] = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for variable, value in pairs:
                if isinstance(variable, ast.Name) and value is not None:
                    yield variable.id, value
