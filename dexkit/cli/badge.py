"""``dexkit badge``: the verdict of a result as a picture for a README."""

from __future__ import annotations

from pathlib import Path

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    output_option,
)
from dexkit.cli.report import write_text
from dexkit.documents import check_output_paths


@click.command(
    "badge",
    cls=Command,
    exit_codes={
        0: "the badge is written, whatever the verdict",
    },
)
@click.argument("result", type=LocalPath(exists=True), metavar="RESULT.json")
@output_option("FILE.svg", "Where to write it; - prints it.", "badge.svg")
def command(result: Path, output: Path) -> None:
    """Draw the badges of a result: drop-in and safety.

    A badge says if the hand was emulated, simulated or only recorded, and how many requirements
    could not be judged.
    """
    from dexkit.conformance.kit.result_file import read_json
    from dexkit.conformance.report.badge import badge_text, badges, render_badge

    check_output_paths([output], [result])
    found = read_json(result)
    write_text(output, render_badge(found))
    if str(output) != "-":
        for drawn in badges(found):
            click.echo(f"{output}: {' | '.join(badge_text(found, drawn))}")
