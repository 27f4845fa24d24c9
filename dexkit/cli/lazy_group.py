"""A group of commands that are imported only when they are called, in sections of its help."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping

import click

__all__ = ["LazyGroup", "Sections"]

Sections = Mapping[str, Mapping[str, tuple[str, str]]]
"""Heading -> name -> (``module`` or ``module:attribute``, one-line help). The attribute is
``command`` if none is named. The help is here so that ``--help`` imports nothing.
"""


class LazyGroup(click.Group):
    """A group whose commands are those of ``sections``, in that order."""

    def __init__(self, *args: object, sections: Sections, **attributes: object) -> None:
        super().__init__(*args, **attributes)  # type: ignore[arg-type]
        self.sections = sections
        self._entries = {
            name: entry for commands in sections.values() for name, entry in commands.items()
        }

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of all commands."""
        return list(self._entries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command ``cmd_name``; None if there is none."""
        if cmd_name not in self._entries:
            return None
        module, _, attribute = self._entries[cmd_name][0].partition(":")
        command = getattr(importlib.import_module(module), attribute or "command")
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that is called; an error names the one that was perhaps meant."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            if close := difflib.get_close_matches(args[0], self._entries, n=1):
                raise click.UsageError(
                    f"{error.message.rstrip('.')}. Did you mean {close[0]!r}?", ctx
                ) from None
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a section for each heading."""
        width = max(map(len, self._entries))
        for heading, commands in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [(name.ljust(width), text) for name, (_, text) in commands.items()]
                )
