"""Shared by tests that use DDS: a domain of one's own, and waiting without sleeping.

Importing this skips the test module where CycloneDDS is not installed.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterator

import pytest

from tests.patience import PATIENCE

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10: dexkit setup-dds")

from dexkit.dds import DdsNode, Reader, Sample
from dexkit.domains import AUTOMATIC_DOMAINS, ReservedDomain

__all__ = ["dds_domain", "dds_node", "free_domain", "take_until", "wait_until"]

_reserved: list[ReservedDomain] = []


@functools.cache
def _of_this_process() -> deque[int]:
    """Domains that this worker of pytest-xdist reserves for its life, in random order.

    Two workers on one domain would be taken for two robots; so would two checkouts that are
    tested at once, or a test and a program that chooses its domain itself.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    wanted = max(48 // workers, 3)  # others of this machine test, too
    for domain in random.Random(os.urandom(8)).sample(AUTOMATIC_DOMAINS, len(AUTOMATIC_DOMAINS)):
        if len(_reserved) == wanted:
            break
        with contextlib.suppress(OSError):
            _reserved.append(ReservedDomain(domain))
    assert _reserved, "no DDS domain is free on this machine: other runs of the tests have them"
    return deque(reserved.domain for reserved in _reserved)


def free_domain() -> int:
    """A domain that no other process uses, and this one has not used for long."""
    domains = _of_this_process()
    domains.rotate(-1)
    return domains[-1]


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
    reader: Reader, enough: Callable[[list[Sample]], bool], timeout: float = PATIENCE
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


def wait_until(condition: Callable[[], object], timeout: float = PATIENCE) -> None:
    """Poll ``condition`` every 5 ms; for state that no event announces."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"condition not met within {timeout} s")
        time.sleep(0.005)
