"""Every case of the campaign."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from dexkit.errors import UsageError
from tools.campaign import devices, programs, soak
from tools.campaign.case import Case
from tools.campaign.fuzz import devices as fuzzed_devices
from tools.campaign.fuzz import (
    drivers,
    files,
    messages,
    packet_codecs,
    recordings,
    sessions,
    sources,
)

__all__ = ["all_cases", "case", "select"]


@cache
def all_cases() -> tuple[Case, ...]:
    """Every case, fuzzers first."""
    found: list[Case] = []
    fuzzers = (packet_codecs, messages, fuzzed_devices, drivers, recordings, sessions, files)
    for module in (*fuzzers, sources, devices, programs, soak):
        found += module.cases()
    return tuple(found)


def case(name: str) -> Case:
    """The case called ``name``; ``module::attribute`` is one that is not in the list.

    :raises UsageError: there is none.
    """
    module, _, attribute = name.partition("::")
    if attribute:
        import importlib

        found = getattr(importlib.import_module(module), attribute)
        made = found() if isinstance(found, type) else found
        assert isinstance(made, Case)
        made.name = name
        return made
    for known in all_cases():
        if known.name == name:
            return known
    raise UsageError(f"there is no case {name!r}", hint="python -m tools.campaign --list")


def select(only: Sequence[str]) -> list[Case]:
    """The cases whose names begin with one of ``only``; all if it is empty.

    :raises UsageError: one of them is no case's beginning.
    """
    if not only:
        return list(all_cases())
    chosen: dict[str, Case] = {}
    for wanted in only:
        found: list[Case] = []
        if "::" not in wanted:
            found = [c for c in all_cases() if c.name.startswith(wanted)]
        found = found or [case(wanted)]
        chosen |= {c.name: c for c in found}
    return list(chosen.values())
