"""``python -m tools.generate``: write the generated files; ``--check`` only compares them."""

from __future__ import annotations

import argparse
import sys

from tools.generate import BUILT, ROOT, stale_files, write_pages


def main() -> int:
    """Write or compare; returns the exit code, 1 if ``--check`` found a file out of date."""
    parser = argparse.ArgumentParser(prog="python -m tools.generate", description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit code 1 if a file is out of date"
    )
    options = parser.parse_args()
    stale = stale_files()
    for path, content in stale.items():
        if not options.check:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding="utf-8")
        print(f"{'out of date' if options.check else 'written'}: {path.relative_to(ROOT)}")
    if not stale:
        print("all generated files are up to date")
    if not options.check:
        write_pages()
        print(f"pages: {BUILT.relative_to(ROOT)}")
    return 1 if options.check and stale else 0


sys.exit(main())
