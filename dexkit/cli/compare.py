"""``dexkit compare``: several results side by side."""

from __future__ import annotations

from pathlib import Path

import click

from dexkit.cli.options import html_option, markdown_option
from dexkit.cli.report import write_text
from dexkit.documents import check_output_paths


@click.command("compare")
@click.argument(
    "results",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, path_type=Path),
    metavar="A.json B.json ...",
)
@html_option()
@markdown_option(default="print it")
def command(results: tuple[Path, ...], html_path: Path | None, markdown_path: Path | None) -> None:
    """Put results of several hands, or of several versions of one, side by side.

    Runs of the same hand (its name in capabilities.toml, else the backend) are taken in the order
    of their time; what became worse from one to the next is named as a regression.

    Exit code: 0 no regression, 1 there is one, 2 the results cannot be compared.
    """
    from dexkit.conformance.report.compare import (
        Comparison,
        render_comparison,
        render_comparison_markdown,
    )
    from dexkit.conformance.result_file import read_json

    check_output_paths([html_path, markdown_path], results)
    comparison = Comparison([read_json(path) for path in results], [path.stem for path in results])
    if html_path:
        write_text(html_path, render_comparison(comparison))
        click.echo(f"report: {html_path}", err=True)
    if markdown_path or not html_path:
        write_text(markdown_path or Path("-"), render_comparison_markdown(comparison))
    regressions = comparison.regressions
    if regressions:
        names = ", ".join(dict.fromkeys(c.requirement.id for c in regressions))
        what = "regression" if len(regressions) == 1 else "regressions"
        click.echo(f"{len(regressions)} {what}: {names}", err=True)
        raise click.exceptions.Exit(1)
