"""Real-time priority: the reported result is true, and a refusal changes nothing."""

from __future__ import annotations

import os
import threading

import pytest

from dexkit.service import real_time
from dexkit.service.realtime import go_first


def policy() -> int:
    return os.sched_getscheduler(0)


def policy_of_new_thread() -> int:
    seen: list[int] = []
    thread = threading.Thread(target=lambda: seen.append(policy()))
    thread.start()
    thread.join()
    return seen[0]


def test_result_equals_the_scheduling_policy_of_the_thread() -> None:
    before = policy()
    with real_time() as granted:
        assert (policy() == os.SCHED_RR) == granted
        assert policy_of_new_thread() == policy()
    assert policy() == before


def test_refused_priority_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(pid: int, policy: int, param: os.sched_param) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    before = policy()
    with real_time() as granted:
        assert not granted
        assert policy() == before


def test_publishing_thread_has_priority_only_within_the_service() -> None:
    go_first()
    assert policy() == os.SCHED_OTHER
    with real_time() as granted:
        before = os.sched_getparam(0).sched_priority
        go_first()
        assert os.sched_getparam(0).sched_priority == before + granted
