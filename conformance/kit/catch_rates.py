"""How many wrong hands a run catches, and how many legal ones it blames: measured for each model
and kind of run.

``python -m dexkit.conformance.faults --model MODEL --generated 12`` measures the first again on the
virtual clock, ``--generated 64 --good`` the second, and both with ``--quick`` those of quick runs
(docs/mutants.md). These are of the levels of 2026-11-29; thorough runs were not measured
with them. The numbers are about the kit, and not about the hand that a report is about.
"""

from __future__ import annotations

import math

__all__ = ["BLAME_RATES", "CATCH_RATES", "wilson"]

CATCH_RATES: dict[str, dict[str, tuple[int, int]]] = {
    "dex1-1": {"quick": (2, 8), "default": (7, 8)},
    "dex3-1": {"quick": (1, 4), "default": (3, 4)},
    "dex5-1": {"quick": (3, 3), "default": (3, 3)},
    "brainco-revo2": {"quick": (1, 2), "default": (2, 2)},
    "inspire-dfx": {"quick": (2, 3), "default": (3, 3)},
    "inspire-ftp": {"quick": (2, 3), "default": (3, 3)},
}
"""Of generated wrong hands that break a MUST: how many were caught, and how many were tried."""

BLAME_RATES: dict[str, dict[str, tuple[int, int]]] = {
    "dex1-1": {"quick": (0, 26), "default": (0, 26)},
    "dex3-1": {"quick": (0, 9), "default": (0, 9)},
    "dex5-1": {"quick": (0, 9), "default": (0, 9)},
    "brainco-revo2": {"quick": (0, 7), "default": (0, 7)},
    "inspire-dfx": {"quick": (0, 6), "default": (0, 6)},
    "inspire-ftp": {"quick": (0, 7), "default": (0, 7)},
}
"""Of generated legal hands: how many failed a MUST, and how many were tried."""


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """The confidence interval of a proportion by Wilson's score, 95 % by default.

    :returns: lower and upper bound, 0 to 1; the whole range where there is nothing to count.
    """
    if not count:
        return 0.0, 1.0
    p = hits / count
    scale = 1.0 + z * z / count
    middle = (p + z * z / (2 * count)) / scale
    half = z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count)) / scale
    return max(0.0, middle - half), min(1.0, middle + half)
