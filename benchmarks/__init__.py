"""Benchmarks: each prints a ratio against a named peer and is saved as JSON.

A module ``benchmarks/bench_*.py`` has ``run() -> list[Result]``; ``python -m benchmarks``
runs all of them, or those named.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """One figure.

    :param name: what was measured.
    :param value: the figure of dexkit, in ``unit``.
    :param peer: what it is compared with.
    :param peer_value: the peer's figure, in ``unit``.
    :param ratio: how many times better than the peer (above 1: dexkit is better), or for a
        limit, which part of it is reached.
    :param target: what the project asks for, as text, or empty.
    :param met: whether ``target`` was met; None without a target.
    """

    name: str
    value: float
    unit: str
    peer: str
    peer_value: float
    ratio: float
    target: str = ""
    met: bool | None = None
    note: str = ""
