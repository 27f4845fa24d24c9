"""``python -m tools.platforms``: exit code 0 if every Python that was found passes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.platforms import VERSIONS, report_table, try_all


def main() -> int:
    """Try them, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.platforms", description=__doc__)
    parser.add_argument("--only", action="append", choices=VERSIONS, help="only this Python")
    parser.add_argument(
        "--out", type=Path, default=Path("platforms-out"), help="environments, logs"
    )
    parser.add_argument("--all", action="store_true", help="one that is missing is a failure, too")
    options = parser.parse_args()
    reports = try_all(
        options.only or VERSIONS, options.out.resolve(), lambda text: print(text, flush=True)
    )
    print(report_table(reports))
    counted = [r for r in reports if r.python or options.all]
    return 0 if counted and all(r.passed for r in counted) else 1


if __name__ == "__main__":
    sys.exit(main())
