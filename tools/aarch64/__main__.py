"""``python -m tools.aarch64``: exit code 0 if dexkit works on the emulated processor."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.aarch64 import Emulated, missing
from tools.platforms import report_table


def main() -> int:
    """Try it, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.aarch64", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("platforms-out/aarch64"), help="folder")
    parser.add_argument(
        "--mirror", default="http://deb.debian.org/debian", help="of Debian's packages"
    )
    options = parser.parse_args()
    if lacking := missing():
        print(f"error: missing on this machine: {', '.join(lacking)}", file=sys.stderr)
        print(f"  on Debian and Ubuntu: sudo apt install {' '.join(lacking)}", file=sys.stderr)
        return 2
    report = Emulated(
        options.out.resolve(), options.mirror, lambda text: print(text, flush=True)
    ).run()
    print(report_table([report]))
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
