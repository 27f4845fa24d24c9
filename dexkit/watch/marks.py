"""Moments of a recording that a viewer can go to."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Mark"]


@dataclass(frozen=True)
class Mark:
    """One moment.

    :param time_ns: log time at which it begins; ``end_ns`` that at which it ends.
    :param kind: ``phase`` of a stimulus, or the verdict on a requirement: ``fail``, ``warn``.
    :param title: name of the phase or id of the requirement, with its hand.
    :param text: what was found, or empty.
    """

    time_ns: int
    end_ns: int
    kind: str
    title: str
    text: str = ""
