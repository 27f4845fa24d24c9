"""``python -m tools.wheels --source DIR``: exit code 0 if every wheel was built and works."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.platforms import VERSIONS, report_table, try_all
from tools.wheels import build_all, hiding_libraries


def main() -> int:
    """Build them, try them, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.wheels", description=__doc__)
    parser.add_argument(
        "--source", type=Path, required=True, help="checkout of the CycloneDDS C library 0.10.x"
    )
    parser.add_argument("--only", action="append", choices=VERSIONS, help="only this Python")
    parser.add_argument("--out", type=Path, default=Path("dist/wheels"), help="for the wheels")
    parser.add_argument("--no-trial", action="store_true", help="build only")
    options = parser.parse_args()
    out = options.out.resolve()

    def say(text: str) -> None:
        print(text, flush=True)

    try:
        built = build_all(options.only or VERSIONS, options.source.resolve(), out, say)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if options.no_trial or not built:
        return 0 if built else 1
    enter, files = hiding_libraries()
    say(f"{'hidden' if enter else 'NOT hidden'}: {', '.join(files) or 'no other library is here'}")
    reports = try_all(built, out / "trial", say, out, enter)
    print(report_table(reports))
    return 0 if all(report.passed for report in reports) else 1


if __name__ == "__main__":
    sys.exit(main())
