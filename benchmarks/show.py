"""Show results: lines of a terminal, and a page with the trend over the saved runs."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from rich.text import Text

from benchmarks import Result
from dexkit.conformance.report.charts import Chart, Level, Line
from dexkit.conformance.report.pages import fill

__all__ = ["Run", "page", "saved", "terminal_lines"]

_VALUE, _RATIO, _VERDICT = 22, 10, 7
_NAMES = {field.name for field in fields(Result)}


@dataclass(frozen=True)
class Run:
    """A saved run.

    :param name: its time, from the file's name.
    :param about: Python, machine and cores.
    :param results: by (benchmark, measured, peer).
    """

    name: str
    about: str
    results: dict[tuple[str, str, str], Result]


def terminal_lines(results: Sequence[Result], width: int = 80) -> list[Text]:
    """A line for each figure with its ratio, and below it the peer, target and note.

    :param width: no line is longer.
    """
    lines = []
    name = width - _VALUE - _RATIO - _VERDICT
    for r in results:
        verdict = {None: "", True: "met", False: "missed"}[r.met]
        style = {"met": "green", "missed": "red"}.get(verdict, "")
        first, *rest = textwrap.wrap(r.name, name - 1) or [""]
        value = f"{r.value:,.4g} {r.unit}"
        lines.append(
            Text.assemble(
                (f"{first:{name}}", "bold"),
                f"{value:>{_VALUE - 1}} {r.ratio:>{_RATIO - 4}.2f} x ",
                (f"{verdict:>{_VERDICT - 1}}", style),
            )
        )
        lines += [Text(text, "bold") for text in rest]
        about = [f"{r.peer}: {r.peer_value:,.4g} {r.unit}"]
        about += [f"target: {r.target}"] if r.target else []
        about += [r.note] if r.note else []
        wrapped = textwrap.wrap("; ".join(about), width - 2, break_on_hyphens=False)
        lines += [Text(f"  {text}", "dim") for text in wrapped]
    return lines


def saved(folder: Path) -> list[Run]:
    """The runs in a folder, oldest first; a file that is none is left out."""
    runs = []
    for path in sorted(folder.glob("*.json")):
        try:
            data = json.loads(path.read_text())
            found = {
                (row["benchmark"], row["name"], row["peer"]): Result(
                    **{k: v for k, v in row.items() if k in _NAMES}
                )
                for row in data["results"]
            }
            about = f"Python {data['python']}, {data['machine']}, {data['cores']} cores"
        except (OSError, ValueError, KeyError, TypeError):
            continue
        runs.append(Run(path.stem, about, found))
    return runs


def page(runs: Sequence[Run]) -> str:
    """The newest figure of everything that was measured, and its ratio in each run."""
    newest: dict[tuple[str, str, str], tuple[Run, Result]] = {}
    for run in runs:
        newest.update({key: (run, result) for key, result in run.results.items()})
    groups: dict[str, list[tuple[Run, Result, Chart | None]]] = {}
    for key, (run, result) in newest.items():
        groups.setdefault(key[0], []).append((run, result, _trend(key, runs)))
    return fill("benchmarks.html", title="Benchmarks of dexkit", runs=runs, groups=groups)


def _trend(key: tuple[str, str, str], runs: Sequence[Run]) -> Chart | None:
    """The ratio over the runs that measured it; None with fewer than two."""
    found = [(i + 1.0, run.results[key].ratio) for i, run in enumerate(runs) if key in run.results]
    if len(found) < 2:
        return None
    x, y = (np.array(values, dtype=float) for values in zip(*found, strict=True))
    return Chart(
        f"{key[1]}: ratio in each run",
        [Line("ratio", "state", x, y), Line("ratio", "state", x, y, "dots")],
        span=(1.0, float(max(len(runs), 2))),
        y_unit="x",
        x_unit="run",
        levels=[Level(1.0, "as the peer")],
        height=90,
        include=(0.0,),
        bare=True,
    )
