"""``python -m tools.generate_archive DIR``: make an archive with known faults; ``--score OUT``
compares an audit of it (``dexkit audit DIR --out OUT``) with what is true.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tools.generate_archive import generate
from tools.generate_archive.score import score


def main() -> int:
    """Generate, or score; returns the exit code, 1 if the score is not perfect."""
    parser = argparse.ArgumentParser(prog="python -m tools.generate_archive", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--files", type=int, default=100)
    parser.add_argument("--faults", type=int, default=20, help="how many files have a fault")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a session")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--score", type=Path, metavar="OUT", help="folder of an audit")
    options = parser.parse_args()
    if options.score is not None:
        found = score(options.folder, options.score)
        print(found.text())
        return 0 if found.perfect else 1
    options.folder.mkdir(parents=True, exist_ok=True)
    answers = generate(
        options.folder, options.files, options.faults, seconds=options.seconds, seed=options.seed
    )
    print(f"{len(answers)} files, {sum(bool(a.fault) for a in answers)} with a fault")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
