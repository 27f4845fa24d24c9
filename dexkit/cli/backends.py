"""``dexkit backends``: the hands that can be served."""

from __future__ import annotations

import shutil

import click
from rich.text import Text

from dexkit.backends import BackendInfo, list_backends
from dexkit.cli.command_help import Command
from dexkit.console import Console
from dexkit.escaping import one_line

_WIDEST = 100  # columns; longer lines are hard to read


@click.command(
    "backends",
    cls=Command,
)
def command() -> None:
    """List the backends that can be served: name, model, origin, device and settings."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    console = Console()
    for row in list_backends():
        name, _, rest = _describe(row, width).partition(" ")
        console.print(Text(one_line(name), "bold"), Text(rest), soft_wrap=True)
    click.echo("Your own: dexkit serve package.module:Object (docs/backends.md).")


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
