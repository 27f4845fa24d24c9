"""``dexkit compare``: several results side by side."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    html_option,
    json_option,
)
from dexkit.cli.report import recording_beside, write_text
from dexkit.digests import sha256_of_file
from dexkit.documents import check_output_paths
from dexkit.errors import UsageError

if TYPE_CHECKING:
    from dexkit.conformance.report.compare import Comparison
    from dexkit.conformance.report.curves import Recorded


@click.command(
    "compare",
    cls=Command,
    exit_codes={
        0: "no regression",
        1: "there is one",
        2: "the results cannot be compared",
    },
)
@click.argument(
    "results",
    nargs=-1,
    required=True,
    type=LocalPath(exists=True),
    metavar="A.json B.json ...",
)
@html_option()
@json_option("Print JSON instead of Markdown.")
def command(results: tuple[Path, ...], html_path: Path | None, as_json: bool) -> None:
    """Compare results of several hands, or of several versions of one; prints Markdown.

    Runs of the same hand (its name in capabilities.toml, else the backend) are compared in order of
    time; a worse verdict is listed as a regression. The page also shows the curves of their
    recordings side by side, if these are in the folders of the results.
    """
    from dexkit.conformance.kit.result_file import read_json
    from dexkit.conformance.report.compare import (
        Comparison,
        comparison_data,
        render_comparison,
        render_comparison_markdown,
    )

    if other := [path for path in results if path.suffix in (".mcap", ".bag", ".db3")]:
        raise UsageError(
            f"{other[0]} is a recording, not a result",
            hint="dexkit diff A B compares two recordings; dexkit check RECORDING --result FILE "
            "writes the result of one",
        )
    check_output_paths([html_path], results)
    comparison = Comparison([read_json(path) for path in results], [path.stem for path in results])
    if html_path:
        write_text(html_path, render_comparison(comparison, *_recordings(comparison, results)))
        click.echo(f"report: {html_path}", err=True)
    if as_json:
        click.echo(json.dumps(comparison_data(comparison), indent=1))
    elif not html_path:
        click.echo(render_comparison_markdown(comparison), nl=False)
    regressions = comparison.regressions
    if regressions:
        names = ", ".join(dict.fromkeys(c.requirement.id for c in regressions))
        what = "regression" if len(regressions) == 1 else "regressions"
        click.echo(f"{len(regressions)} {what}: {names}", err=True)
        raise click.exceptions.Exit(1)


def _recordings(
    comparison: Comparison, results: tuple[Path, ...]
) -> tuple[list[Recorded], list[str]]:
    """The recordings that lie beside the results, and the runs without theirs.

    A recording is taken only if it is the one that was judged.
    """
    from dexkit.conformance.report.curves import recorded
    from dexkit.traces import open_trace

    found: list[Recorded] = []
    missing: list[str] = []
    for run, name, path in zip(comparison.runs, comparison.names, results, strict=True):
        file = recording_beside(path, run.subject.get("recording", ""))
        wanted = run.subject.get("recording_sha256")
        if file is not None and wanted and sha256_of_file(file) == wanted:
            found.append(recorded(open_trace(file), name))
        else:
            missing.append(name)
    return found, missing
