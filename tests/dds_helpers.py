"""Shared by tests that use DDS: a domain of one's own, and waiting without sleeping.

Importing this skips the test module where CycloneDDS is not installed.
"""

from __future__ import annotations

import os
import random
import time
from collections import deque
from collections.abc import Callable, Iterator

import pytest

from tests.patience import PATIENCE

pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10 (CPython 3.10)")

from dexkit.dds import DdsNode, Reader, Sample

__all__ = ["dds_domain", "dds_node", "free_domain", "take_until", "wait_until"]

_random = random.Random(os.getpid() ^ time.time_ns())


def _of_this_worker() -> list[int]:
    """The domains from 100 to 200 that fall to this worker of pytest-xdist, in random order.

    Two workers on one domain would be taken for two robots. Those of other checkouts, which may
    be tested at once on this machine, are avoided by chance.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    domains = [d for d in range(100, 201) if d % count == worker % count]
    _random.shuffle(domains)
    return domains


_domains = deque(_of_this_worker())


def free_domain() -> int:
    """A domain from 100 to 200 that no other worker uses, and this one has not used for long."""
    domain = _domains.popleft()
    _domains.append(domain)
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
