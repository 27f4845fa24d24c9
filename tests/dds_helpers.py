"""Shared by tests that use DDS: a domain of one's own, and waiting without sleeping.

Importing this skips the test module where CycloneDDS is not installed.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10 (CPython 3.10)")

from dexkit.dds import DdsNode, Reader, Sample

__all__ = ["dds_domain", "dds_node", "free_domain", "take_until", "wait_until"]

_random = random.Random(os.getpid() ^ time.time_ns())
_given: set[int] = set()


def free_domain() -> int:
    """A domain from 100 to 200 that this process has not used, random to avoid other processes.

    The tests of several checkouts or workers may run at once on one machine.
    """
    left = sorted(set(range(100, 201)) - _given)
    domain = _random.choice(left)
    _given.add(domain)
    return domain


@pytest.fixture(scope="module")
def dds_domain() -> int:
    """One random domain for the tests of a module."""
    return free_domain()


@pytest.fixture
def dds_node(dds_domain: int) -> Iterator[DdsNode]:
    """A node on loopback, on the module's domain."""
    with DdsNode(dds_domain, "lo") as node:
        yield node


def take_until(
    reader: Reader, enough: Callable[[list[Sample]], bool], timeout: float = 10.0
) -> list[Sample]:
    """Samples taken until ``enough`` says so; fails the test on time-out."""
    samples: list[Sample] = []
    deadline = time.monotonic() + timeout
    while not enough(samples):
        left = deadline - time.monotonic()
        if left <= 0:
            pytest.fail(f"{reader!r}: only {len(samples)} samples within {timeout} s")
        reader.wait(left)
        samples += reader.take()
    return samples


def wait_until(condition: Callable[[], object], timeout: float = 10.0) -> None:
    """Poll ``condition`` every 5 ms; for state that no event announces."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"condition not met within {timeout} s")
        time.sleep(0.005)
