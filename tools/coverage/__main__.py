"""Measure what the requirements cover, and write it as a page: ``make coverage``."""

from __future__ import annotations

import sys

from dexkit.models import BUILT_IN
from tools.coverage.measure import measure
from tools.coverage.page import page
from tools.generate import ROOT


def main() -> int:
    """Write build/coverage.md."""
    found = []
    for model in BUILT_IN:
        print(f"{model.title}: its reference in all phases, and each check", flush=True)
        found.append(measure(model.dialects[0]))
    target = ROOT / "build" / "coverage.md"
    target.parent.mkdir(exist_ok=True)
    target.write_text(page(found), encoding="utf-8")
    print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
