"""``python -m tools.spoiled_sets FOLDER``: audit the sets in FOLDER, compare with their labels."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from dexkit.conformance.audit.audit import Audit, Limits
from tools.spoiled_sets.score import read_rows, score


def main() -> int:
    """Score; returns 1 if a good episode is blamed."""
    parser = argparse.ArgumentParser(prog="python -m tools.spoiled_sets", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, help="folder of the audit; a temporary one by default")
    parser.add_argument("--jobs", type=int, default=None)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        folder = options.folder.resolve()
        Audit([str(folder)], out, parquet=False).run(Limits().pool(options.jobs))
        found = score(folder, read_rows(out), str(folder))
    print(found.text())
    return int(bool(found.blamed))


if __name__ == "__main__":
    raise SystemExit(main())
