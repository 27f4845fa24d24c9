"""``python -m tools.scores``: write ``conformance/scores.json`` again; ``--check`` only looks
whether requirements or the phases of a run have changed since it was written.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from dexkit.conformance.scores import FILE, entries
from dexkit.conformance.selection import RunKind
from dexkit.documents import write_file
from tools.scores import as_text, counts_of, entries_of, is_current, scored_models


def main() -> int:
    """Try hands, or compare; returns the exit code, 1 if ``--check`` found a change."""
    names = scored_models()
    kinds = [str(kind) for kind in RunKind]
    parser = argparse.ArgumentParser(prog="python -m tools.scores", description=__doc__)
    parser.add_argument("--model", action="append", choices=names, help="only this model")
    parser.add_argument("--run", action="append", choices=kinds, help="only this kind of run")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--hands", type=int, help="not more hands than that in any kind of run")
    parser.add_argument(
        "--resume", type=Path, help="keep what is done in this file, and do not do it again"
    )
    parser.add_argument(
        "--check", action="store_true", help="try nothing; exit code 1 if a score is out of date"
    )
    options = parser.parse_args()
    kept = list(entries()) if FILE.exists() else []
    if options.check:
        old = dict.fromkeys(f"--model {e.model} --run {e.run}" for e in kept if not is_current(e))
        for which in old:
            print(f"what such a run judges has changed: python -m tools.scores {which}")
        return 1 if old else 0
    for name in options.model or names:
        chosen = options.run or kinds
        found = entries_of(
            name,
            hands={key: n for key, n in counts_of(name).items() if str(key[0]) in chosen},
            most=options.hands,
            keep=options.resume,
            jobs=options.jobs,
            report=print,
        )
        kept = [e for e in kept if e.model != name or e.run not in chosen] + found
        kept.sort(key=lambda e: (names.index(e.model), kinds.index(e.run)))
        write_file(FILE, as_text(kept))
        for entry in found:
            print(f"{entry.model} {entry.run} ({entry.setting}): {entry.score().sentence()}")
    return 0


if __name__ == "__main__":  # the worker processes import this module, too
    sys.exit(main())
