"""The loop over small cases of a test."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from tests.each import each


def test_each_runs_all_cases_and_names_those_that_failed() -> None:
    seen = []

    @each(("value", "limit"), [(1, 2), (5, 2), pytest.param(2, 2), (9, 2)])
    def check(value: int, limit: int) -> None:
        seen.append(value)
        if value == 9:
            pytest.fail("nine is not allowed")
        assert value <= limit

    with pytest.raises(AssertionError, match="2 of 4 cases failed") as caught:
        check()
    assert seen == [1, 5, 2, 9]
    text = str(caught.value)
    assert "[1] value=5, limit=2" in text
    assert "[3] value=9, limit=2" in text
    assert "nine is not allowed" in text
    assert f"{__file__}:" in text


def test_each_leaves_fixtures_and_instances_to_pytest(tmp_path: Path) -> None:
    class Example:
        @each("value", [1, 2], ids=["one", "two"])
        def check(self, value: int, tmp_path: Path) -> None:
            assert isinstance(self, Example)
            assert not list(tmp_path.iterdir())
            (tmp_path / "file").touch()

    assert list(inspect.signature(Example.check).parameters) == ["self", "tmp_path"]
    Example().check(tmp_path=tmp_path)  # type: ignore[call-arg]


def test_each_without_cases_is_an_error() -> None:
    with pytest.raises(AssertionError, match="no case for value"):
        each("value", [])
