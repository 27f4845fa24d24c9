"""Two runs that start at once never share a DDS domain."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dexkit import domains
from dexkit.dds import DdsNode
from dexkit.dds.domain import MAX_PARTICIPANT_INDEX
from dexkit.domains import AUTOMATIC_DOMAINS, ReservedDomain, reserve_free_domain
from dexkit.errors import DexkitError
from tests.dds_helpers import free_domain
from tests.trace_helpers import STATE, STATE_TYPE

_RESERVE = """
import sys
from dexkit.domains import ReservedDomain
try:
    ReservedDomain(int(sys.argv[1]))
except OSError:
    sys.exit(3)
"""


def reserve_elsewhere(domain: int) -> int:
    return subprocess.run([sys.executable, "-c", _RESERVE, str(domain)]).returncode


def test_a_domain_is_chosen_from_the_automatic_ones() -> None:
    with reserve_free_domain() as reserved:
        assert reserved.domain in AUTOMATIC_DOMAINS


def test_a_reserved_domain_is_refused_to_other_processes_until_it_is_closed() -> None:
    domain = AUTOMATIC_DOMAINS[0] - 1  # the tests beside this one choose automatic ones
    with ReservedDomain(domain):
        assert reserve_elsewhere(domain) == 3
    assert reserve_elsewhere(domain) == 0


def test_reservations_differ() -> None:
    with reserve_free_domain() as one, reserve_free_domain() as other:
        assert one.domain != other.domain


def test_a_domain_with_a_participant_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    domain = free_domain()
    # this process holds the domain already; only what is discovered there counts here
    monkeypatch.setattr("dexkit.domains.AUTOMATIC_DOMAINS", range(domain, domain + 1))
    monkeypatch.setattr("dexkit.domains._PORT", 246)
    with reserve_free_domain() as reserved:
        assert reserved.domain == domain
    with DdsNode(domain) as node:
        node.writer(STATE, STATE_TYPE)
        with pytest.raises(DexkitError, match="no DDS domain"):
            reserve_free_domain()


def test_no_participant_of_ours_uses_the_reserved_port() -> None:
    assert domains._PORT > 10 + 2 * MAX_PARTICIPANT_INDEX
    assert 7400 + 250 * AUTOMATIC_DOMAINS[-1] + domains._PORT < 65536
