"""``python -m tools.aarch64``: exit code 0 if dexkit works on the emulated processor."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.aarch64 import Emulated, missing, own_mirror
from tools.platforms import report_table


def main() -> int:
    """Try it, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.aarch64", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("platforms-out/aarch64"), help="folder")
    parser.add_argument("--mirror", help="of Debian's packages [default: this machine's]")
    options = parser.parse_args()
    if lacking := missing():
        print(f"error: missing on this machine: {', '.join(lacking)}", file=sys.stderr)
        print(f"  on Debian and Ubuntu: sudo apt install {' '.join(lacking)}", file=sys.stderr)
        return 2
    mirror = options.mirror or own_mirror()
    if not mirror:
        print("error: this machine has no source of Debian's packages", file=sys.stderr)
        print("  name one: --mirror URL; on Debian: sudo apt update first", file=sys.stderr)
        return 2
    report = Emulated(options.out.resolve(), mirror, lambda text: print(text, flush=True)).run()
    print(report_table([report]))
    return 0 if report.passed else 1


if __name__ == "__main__":
    sys.exit(main())
