"""Test the interpreter's settings for threads with deadlines."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator

import pytest

from dexkit.interpreter import SWITCH_INTERVAL, pause_collection, timely_threads


@pytest.fixture
def unfrozen() -> Iterator[None]:
    """Nothing is frozen before, and afterwards what was."""
    frozen = gc.get_freeze_count() > 0
    gc.unfreeze()
    yield
    if frozen:
        gc.freeze()


def in_force() -> tuple[float, bool]:
    """The switch interval in ms, and whether objects are left out of garbage collection."""
    return round(sys.getswitchinterval() * 1e3, 2), gc.get_freeze_count() > 0


@pytest.mark.usefixtures("unfrozen")
def test_settings_are_put_back() -> None:
    before = in_force()
    with timely_threads():
        assert in_force() == (SWITCH_INTERVAL * 1e3, True)
    assert in_force() == before


def interrupted() -> None:
    with timely_threads():
        raise KeyboardInterrupt


@pytest.mark.usefixtures("unfrozen")
def test_settings_are_put_back_after_an_error() -> None:
    before = in_force()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert in_force() == before


@pytest.mark.usefixtures("unfrozen")
def test_settings_of_a_caller_stay() -> None:
    """A service has shorter turns, and has frozen its objects for good."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    gc.freeze()
    try:
        before = in_force()
        with timely_threads():
            assert in_force() == before
        assert in_force() == before
    finally:
        gc.unfreeze()
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("before", [True, False])
def test_garbage_collection_is_as_before_after_a_pause(before: bool) -> None:
    enabled = gc.isenabled()
    try:
        (gc.enable if before else gc.disable)()
        with pause_collection():
            assert not gc.isenabled()
        assert gc.isenabled() == before
    finally:
        (gc.enable if enabled else gc.disable)()
