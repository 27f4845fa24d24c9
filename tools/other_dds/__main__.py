"""``python -m tools.other_dds``: exit code 0 if the client on Fast DDS reads and moves the hand."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.other_dds import FastDds, missing
from tools.platforms import report_table


def main() -> int:
    """Try it, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.other_dds", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("platforms-out/other-dds"), help="folder")
    options = parser.parse_args()
    if lacking := missing():
        print(f"error: missing: sudo apt install {' '.join(lacking)}", file=sys.stderr)
        return 2
    report = FastDds(options.out.resolve(), lambda text: print(text, flush=True)).run()
    print(report_table([report]))
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
