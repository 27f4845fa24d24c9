"""The tables of a comparison, as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from benchmarks.dataset_peers import Run

__all__ = ["runs_table", "scores_table", "totals_table"]

_Row = Sequence[str]


def runs_table(runs: Iterable[Run]) -> list[str]:
    """A line for each program on each set: what it took, and how much it found."""
    head = ("set", "program", "s", "cpu s", "MiB", "exit", "eps", "named", "found")
    rows = [
        (
            run.dataset.name,
            run.tool,
            f"{run.wall_s:.1f}",
            f"{run.cpu_s:.1f}",
            f"{run.peak_mib:.0f}",
            "-" if run.exit is None else str(run.exit),
            "-" if run.episodes is None else str(run.episodes),
            str(len({f.episode for f in run.findings if f.episode and f.level != "note"})),
            run.trouble or _counted(run),
        )
        for run in runs
    ]
    return _lines(head, rows)


def totals_table(runs: Sequence[Run]) -> list[str]:
    """A line for each program: all sets that it and every other program has judged."""
    tools = list(dict.fromkeys(run.tool for run in runs))
    judged = {tool: {r.dataset for r in runs if r.tool == tool and not r.trouble} for tool in tools}
    common = set.intersection(*judged.values()) if judged else set()
    rows = []
    for tool in tools:
        mine = [r for r in runs if r.tool == tool and r.dataset in common]
        recorded, cpu = sum(r.recorded_s or 0.0 for r in mine), sum(r.cpu_s for r in mine)
        rows.append(
            (
                tool,
                f"{len(judged[tool])}",
                f"{sum(r.wall_s for r in mine):.1f}",
                f"{cpu:.1f}",
                f"{max((r.peak_mib for r in mine), default=0.0):.0f}",
                f"{recorded / cpu:.0f}" if cpu else "-",
            )
        )
    title = f"the {len(common)} sets that every program has judged:"
    head = ("program", "judged", "s", "cpu s", "MiB at most", "recorded s / cpu s")
    return [title, *_lines(head, rows)]


def scores_table(found: Mapping[str, Mapping[str, Counter[str]]]) -> list[str]:
    """A line for each fault: of each program ``found/named/in the set/not read``."""
    tools = list(dict.fromkeys(tool for counts in found.values() for tool in counts))
    rows = [
        (
            fault,
            str(max(c["episodes"] for c in counts.values())),
            *(_outcomes(counts.get(tool, Counter())) for tool in tools),
        )
        for fault, counts in found.items()
    ]
    return _lines(("fault", "episodes", *tools), rows)


def _outcomes(counts: Counter[str]) -> str:
    if not counts:
        return "-"
    kinds = ("found", "named", "in the set", "not read")
    return "/".join(str(counts[kind]) for kind in kinds)


def _counted(run: Run) -> str:
    kinds = Counter(f.check for f in run.findings if f.level != "note")
    said = ", ".join(f"{check} {count}" for check, count in kinds.most_common(4))
    return said + (", ..." if len(kinds) > 4 else "") or "nothing"


def _lines(head: _Row, rows: Sequence[_Row]) -> list[str]:
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head) - 1)]
    return [
        "  ".join([*(f"{cell:{w}}" for cell, w in zip(row, widths, strict=False)), row[-1]])
        for row in (head, *rows)
    ]
