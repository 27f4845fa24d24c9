"""``dexkit backends``: the hands that can be served."""

from __future__ import annotations

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dexkit.backends import list_backends


@click.command("backends")
def command() -> None:
    """List the hands that can be served: name, model, origin, and what each needs."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("backend", "model", "origin", "needs", "what it is"):
        table.add_column(heading, overflow="fold")
    for row in list_backends():
        if row.backend is None:
            problem = f"[red]unusable: {escape(row.error)}[/red]"
            table.add_row(row.name, "?", row.origin, "", problem)
            continue
        b = row.backend
        table.add_row(row.name, b.model, row.origin, b.needs or "nothing", b.summary)
        for key, text in b.settings.items():
            table.add_row("", "", "", f"[dim]--set {key}=...[/dim]", f"[dim]{escape(text)}[/dim]")
    Console().print(table)
    click.echo("\nYour own: dexkit serve package.module:Object (docs/backends.md).")
