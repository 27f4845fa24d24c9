"""Write the sets: ``python -m tools.spoiled_sets.author_f OUT``."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from tools.spoiled_sets.author_f.faults import spoil
from tools.spoiled_sets.author_f.motion import Episode, Library, Plan, make
from tools.spoiled_sets.author_f.plans import PLANS
from tools.spoiled_sets.author_f.wire import write_wire
from tools.spoiled_sets.author_f.writers import write_lerobot, write_xr


def _write(out: Path, plan: Plan, library: Library) -> list[dict[str, Any]]:
    made: list[Episode] = []
    for number, entry in enumerate(line.strip() for line in plan.entries.strip().splitlines()):
        e = make(plan, library, number, entry)
        if not entry.startswith("good"):
            spoil(e, plan, entry, made, number)
        made.append(e)
    root = out / plan.folder
    names: list[Any] = list(range(len(made)))
    if plan.form.startswith("xr"):
        for number, e in enumerate(made):
            names[number] = f"episode_{number:04d}"
            if e.broken == "name":
                names[number] += os.fsdecode(b"_caf\xe9")
            write_xr(root / names[number], plan, library, e)
    else:
        write_lerobot(root, plan, library, made)
    if plan.folder == "meta_gone":
        shutil.rmtree(root / "meta")
        say = "The folder meta of the dataset is gone."
        made[0].label |= {"expect": "spoiled", "fault": "broken_file", "say": say}
        made, names = made[:1], [None]
    return [
        {"dataset": plan.folder, "form": plan.form, "episode": name, **e.label}
        for name, e in zip(names, made, strict=True)
    ]


def main() -> None:
    """Write all sets and ``labels.json`` into the folder named on the command line.

    With names of sets behind it, those alone, into a folder that may have others.
    """
    out, wanted = Path(sys.argv[1]), sys.argv[2:]
    out.mkdir(parents=True, exist_ok=bool(wanted))
    file = out / "labels.json"
    known: list[dict[str, Any]] = json.loads(file.read_text()) if file.exists() else []
    labels: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as work:
        library = Library(Path(work))
        for plan in PLANS:
            if plan.folder in wanted or not wanted:
                labels += _write(out, plan, library)
            else:
                labels += [row for row in known if row["dataset"] == plan.folder]
        if "wire" in wanted or not wanted:
            labels += write_wire(out, Path(work))
    file.write_text(json.dumps(labels, indent=1))
    good = sum(label["expect"] == "good" for label in labels)
    print(f"{len(labels)} episodes, {good} good, {len(labels) - good} spoiled")


if __name__ == "__main__":
    main()
