"""Run a test for many small cases as one test that names every case that fails."""

from __future__ import annotations

import functools
import inspect
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest

__all__ = ["each"]

_Test = Callable[..., None]


def each(
    names: str | Sequence[str],
    cases: Iterable[Any],
    ids: Sequence[str] | Callable[[Any], str] | None = None,
) -> Callable[[_Test], _Test]:
    """A decorator with the arguments of ``pytest.mark.parametrize``, for cases of a millisecond.

    The test runs for all cases, also after one has failed. Each has a ``tmp_path`` of its own; the
    other fixtures are made once and shared.

    :param names: names of the arguments, in a sequence or separated by commas.
    :param cases: a value, or a tuple of as many values as there are names, for each case.
    :param ids: a name for each case; a function of the first value, or one for each case.
    """
    given = names.split(",") if isinstance(names, str) else names
    arguments = [name.strip() for name in given if name.strip()]
    table = [_values(case, len(arguments)) for case in cases]
    assert table, f"there is no case for {names}"
    labels = [_label(i, arguments, values, ids) for i, values in enumerate(table)]

    def decorate(test: _Test) -> _Test:
        signature = inspect.signature(test)
        assert set(arguments) <= set(signature.parameters), f"{test.__name__} does not take {names}"

        @functools.wraps(test)
        def run(*fixed: Any, **fixtures: Any) -> None:
            failures = []
            for number, (label, values) in enumerate(zip(labels, table, strict=True)):
                case = fixtures | dict(zip(arguments, values, strict=True))
                if "tmp_path" in fixtures:
                    case["tmp_path"] = fixtures["tmp_path"] / str(number)
                    case["tmp_path"].mkdir()
                try:
                    test(*fixed, **case)
                except (Exception, pytest.fail.Exception) as error:
                    failures.append((label, error))
            if failures:
                lines = [f"{label}\n{_explain(error)}" for label, error in failures]
                message = f"{len(failures)} of {len(table)} cases failed:\n" + "\n".join(lines)
                raise AssertionError(message) from failures[0][1]

        kept = [p for name, p in signature.parameters.items() if name not in arguments]
        run.__signature__ = signature.replace(parameters=kept)  # type: ignore[attr-defined]
        return run

    return decorate


def _values(case: Any, count: int) -> tuple[Any, ...]:
    if hasattr(case, "values") and hasattr(case, "marks"):  # pytest.param
        assert not case.marks, "a case of a loop cannot be marked"
        return tuple(case.values)
    if count == 1:
        return (case,)
    assert len(case) == count, f"{case!r} are not {count} values"
    return tuple(case)


def _label(
    index: int,
    arguments: Sequence[str],
    values: tuple[Any, ...],
    ids: Sequence[str] | Callable[[Any], str] | None,
) -> str:
    if ids is None:
        pairs = (f"{n}={_short(v)}" for n, v in zip(arguments, values, strict=True))
        return f"[{index}] " + ", ".join(pairs)
    return f"[{index}] {ids(values[0]) if callable(ids) else ids[index]}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _explain(error: BaseException) -> str:
    """The error, and the line of the test it came from."""
    where = [f for f in traceback.extract_tb(error.__traceback__) if "/tests/test_" in f.filename]
    place = f"{where[-1].filename}:{where[-1].lineno}: " if where else ""
    return "    " + f"{place}{type(error).__name__}: {error}".replace("\n", "\n    ")
