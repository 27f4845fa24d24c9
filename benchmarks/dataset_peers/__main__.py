"""``python -m benchmarks.dataset_peers SET...``: every program on every set, and who found what."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.dataset_peers import LEVELS, Run
from benchmarks.dataset_peers.labels import Label, labels, scores
from benchmarks.dataset_peers.programs import (
    Program,
    dexkit_audit,
    lerobot_doctor,
    lerobot_lint,
    measured,
)
from benchmarks.dataset_peers.tables import runs_table, scores_table, totals_table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print and save; 2 if there is nothing to run."""
    parser = argparse.ArgumentParser("python -m benchmarks.dataset_peers", description=__doc__)
    parser.add_argument("sets", nargs="*", type=Path, help="folders; default: those of --labels")
    parser.add_argument("--doctor", metavar="COMMAND", help="lerobot-doctor of an environment")
    parser.add_argument("--lint", metavar="COMMAND", help="lelint of an environment")
    parser.add_argument("--labels", type=Path, metavar="FILE", help="labels.json of known faults")
    parser.add_argument("--level", choices=LEVELS, default="warning", help="milder ones: left out")
    parser.add_argument("--json", type=Path, metavar="FILE", help="everything, for programs")
    parser.add_argument("--timeout", type=float, default=1800.0, help="seconds for one set")
    given = parser.parse_args(arguments)
    known = labels(given.labels) if given.labels else []
    sets = given.sets or sorted({label.dataset for label in known})
    programs = [dexkit_audit()]
    programs += lerobot_doctor(given.doctor) if given.doctor else []
    programs += [lerobot_lint(given.lint)] if given.lint else []
    if not sets:
        print("nothing to judge: no sets", file=sys.stderr)
        return 2
    runs = []
    for i, folder in enumerate(sets):
        print(f"{i + 1} of {len(sets)}: {folder}", file=sys.stderr)
        runs += _on_set(folder, programs, given.timeout)
    _show(runs, known, given.level)
    if given.json:
        found = scores(known, runs, given.level)
        saved = {"runs": [run.to_json() for run in runs], "scores": found}
        given.json.write_text(json.dumps(saved, indent=1))
    return 0


def _on_set(folder: Path, programs: Sequence[Program], timeout: float) -> list[Run]:
    """One after the other; the set's files are read once before, so that all find them cached."""
    for file in folder.rglob("*") if folder.is_dir() else [folder]:
        if file.is_file():
            file.read_bytes()
    return [measured(program, folder, timeout) for program in programs]


def _show(runs: Sequence[Run], known: Sequence[Label], level: str) -> None:
    print("\n".join([*runs_table(runs), "", *totals_table(runs)]))
    if known:
        print("\nepisodes found / named for another reason / only in the set / set not read:")
        print("\n".join(scores_table(scores(known, runs, level))))


if __name__ == "__main__":
    sys.exit(main())
