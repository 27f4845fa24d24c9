"""Asking for real-time priority never fails, and says truly what came of it."""

from __future__ import annotations

import os
import threading

import pytest

from dexkit.service import ask_for_real_time


def in_new_thread() -> tuple[bool, int, list[int]]:
    """(what was answered, the thread's policy, the policy of a thread it started)."""
    inherited: list[int] = []

    def ask() -> tuple[bool, int]:
        granted = ask_for_real_time()
        child = threading.Thread(target=lambda: inherited.append(os.sched_getscheduler(0)))
        child.start()
        child.join()
        return granted, os.sched_getscheduler(0)

    answers: list[tuple[bool, int]] = []
    thread = threading.Thread(target=lambda: answers.append(ask()))
    thread.start()
    thread.join()
    return (*answers[0], inherited)


def test_the_answer_is_the_policy_of_this_thread_and_those_it_starts() -> None:
    granted, policy, inherited = in_new_thread()
    assert (policy == os.SCHED_RR) == granted
    assert inherited == [policy]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER  # nobody else is touched


def test_where_it_is_not_permitted_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(pid: int, policy: int, param: os.sched_param) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    granted, policy, _ = in_new_thread()
    assert (granted, policy) == (False, os.SCHED_OTHER)
