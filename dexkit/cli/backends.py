"""``dexkit backends``: the hands that can be served."""

from __future__ import annotations

import json
import shutil
from typing import Any

import click
from rich.text import Text

from dexkit.backends import BackendInfo, list_backends
from dexkit.cli.command_help import Command
from dexkit.cli.options import json_option
from dexkit.console import Console
from dexkit.escaping import one_line

_WIDEST = 100  # columns; longer lines are hard to read


@click.command(
    "backends",
    cls=Command,
)
@json_option("Print JSON: a list of objects.")
def command(as_json: bool) -> None:
    """List the backends that can be served: name, model, origin, device and settings."""
    if as_json:
        click.echo(json.dumps([_data(row) for row in list_backends()], indent=1))
        return
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    console = Console()
    for row in list_backends():
        name, _, rest = _describe(row, width).partition(" ")
        console.print(Text(one_line(name), "bold"), Text(rest), soft_wrap=True)
    click.echo("Your own: dexkit serve package.module:Object (docs/backends.md).")


def _data(row: BackendInfo) -> dict[str, Any]:
    found: dict[str, Any] = {"name": row.name, "origin": row.origin, "error": row.error}
    if row.backend is not None:
        found["model"] = row.backend.model
        found["summary"] = row.backend.summary
        found["needs"] = row.backend.needs
        found["settings"] = dict(row.backend.settings)
    return found


def _describe(row: BackendInfo, width: int) -> str:
    model = f", {row.backend.model}" if row.backend is not None and row.backend.model else ""
    text = f"{row.name} ({row.origin}{model})\n"

    def paragraph(content: str, first: str = "", indent: str = "  ") -> None:
        nonlocal text
        start = f"  {first}"
        text += click.wrap_text(content, width, start, indent, preserve_paragraphs=False) + "\n"

    if row.backend is None:
        paragraph(row.error, "unusable: ")
        return text
    paragraph(row.backend.summary)
    if row.backend.needs:
        paragraph(row.backend.needs, "needs ")
    column = 2 + max((len(f"--set {key}=...  ") for key in row.backend.settings), default=0)
    for key, help_text in row.backend.settings.items():
        paragraph(help_text, f"--set {key}=...".ljust(column - 2), " " * column)
    return text
