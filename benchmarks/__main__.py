"""Run the benchmarks: ``python -m benchmarks [NAME ...]``."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import pkgutil
import platform
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

import benchmarks

RESULTS = Path(__file__).parent / "results"


def main(argv: list[str]) -> int:
    """Run, print and save; 2 for an unknown name."""
    names = [
        m.name.removeprefix("bench_")
        for m in pkgutil.iter_modules(benchmarks.__path__)
        if m.name.startswith("bench_")
    ]
    unknown = [n for n in argv if n not in names]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; known: {', '.join(names)}", file=sys.stderr)
        return 2
    console = Console()
    rows = []
    for name in argv or names:
        console.print(f"[dim]{name} ...[/dim]")
        module = importlib.import_module(f"benchmarks.bench_{name}")
        results: list[benchmarks.Result] = module.run()
        table = Table(
            box=None, pad_edge=False, header_style="bold", title=name, title_justify="left"
        )
        for heading in ("measured", "dexkit", "peer", "peer's", "ratio", "target", ""):
            table.add_column(heading, overflow="fold")
        for r in results:
            verdict = {None: "", True: "[green]met[/green]", False: "[red]missed[/red]"}[r.met]
            table.add_row(
                r.name,
                f"{r.value:,.4g} {r.unit}",
                r.peer,
                f"{r.peer_value:,.4g} {r.unit}",
                f"{r.ratio:.2f}",
                r.target,
                verdict,
            )
            if r.note:
                table.add_row(f"[dim]{r.note}[/dim]")
        console.print(table)
        rows += [{"benchmark": name, **dataclasses.asdict(r)} for r in results]
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / time.strftime("%Y%m%d-%H%M%S.json")
    path.write_text(
        json.dumps(
            {
                "python": platform.python_version(),
                "machine": platform.machine(),
                "cores": os.cpu_count(),
                "results": rows,
            },
            indent=1,
        )
    )
    console.print(f"saved {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
