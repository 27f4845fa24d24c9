"""``python -m tools.scores``: write ``conformance/scores.json`` again; ``--check`` only compares
the digests of the requirements with those of the file.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from dexkit.conformance.scores import FILE, catalogue_digest, entries
from dexkit.documents import write_file
from tools.scores import as_text, entries_of, scored_models


def main() -> int:
    """Try hands, or compare; returns the exit code, 1 if ``--check`` found changed requirements."""
    names = scored_models()
    parser = argparse.ArgumentParser(prog="python -m tools.scores", description=__doc__)
    parser.add_argument("--model", action="append", choices=names, help="only this model")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--hands", type=int, help="not more hands than that in any kind of run")
    parser.add_argument(
        "--resume", type=Path, help="keep what is done in this file, and do not do it again"
    )
    parser.add_argument(
        "--check", action="store_true", help="try nothing; exit code 1 if requirements have changed"
    )
    options = parser.parse_args()
    kept = list(entries()) if FILE.exists() else []
    if options.check:
        old = {e.model for e in kept if e.catalogue != catalogue_digest(e.model)}
        for name in sorted(old):
            print(f"the requirements of {name} have changed: run python -m tools.scores")
        return 1 if old else 0
    for name in options.model or names:
        found = entries_of(
            name, most=options.hands, keep=options.resume, jobs=options.jobs, report=print
        )
        kept = [e for e in kept if e.model != name] + found
        kept.sort(key=lambda e: names.index(e.model))
        write_file(FILE, as_text(kept))
        for entry in found:
            print(f"{entry.model} {entry.run} ({entry.setting}): {entry.score().sentence()}")
    return 0


if __name__ == "__main__":  # the worker processes import this module, too
    sys.exit(main())
