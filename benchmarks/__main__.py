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

import benchmarks
from benchmarks.show import page, saved, terminal_lines

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
        console.print(f"[bold]{name}[/bold]")
        for line in terminal_lines(results, min(console.width, 80)):
            console.print(line, highlight=False, no_wrap=True)
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
    index = RESULTS / "index.html"
    index.write_text(page(saved(RESULTS)), encoding="utf-8")
    console.print(f"page  {index}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
