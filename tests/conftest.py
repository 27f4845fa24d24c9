"""What holds for every test."""

from __future__ import annotations

import gc
import os

import pytest
from hypothesis import HealthCheck, settings

from tests import surroundings
from tests.optional import header

# A machine that is busy with something else makes examples slow, not wrong.
# An eighth of the usual number of examples: the campaign goes on where the tests end.
settings.register_profile(
    "dexkit", deadline=None, max_examples=12, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("dexkit")


# What is made while modules are imported and tests collected stays: to look through it again and
# again would take 1.5 of 5.2 s of processor time, in each worker.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    config.add_cleanup(surroundings.settle())


def pytest_xdist_auto_num_workers() -> int:
    """Six workers for two cores: a test waits for other processes for half of its time."""
    return 3 * (os.cpu_count() or 1)


def pytest_report_header() -> str | None:
    # the workers of a distributed run print none
    return None if "PYTEST_XDIST_WORKER" in os.environ else header()
