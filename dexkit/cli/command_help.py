"""Commands whose help lists their settings and ends with their exit codes."""

from __future__ import annotations

from collections.abc import Mapping

import click

from dexkit.cli.settings import SettingsOption

__all__ = ["Command"]

_USUAL = {
    0: "done",
    1: "the operation failed",
    2: "wrong usage, or something that is needed cannot be used",
    130: "interrupted",
}


class Command(click.Command):
    """A command of dexkit.

    :param exit_codes: what its exit codes mean where that differs from the usual.
    """

    def __init__(
        self, *args: object, exit_codes: Mapping[int, str] | None = None, **attributes: object
    ) -> None:
        super().__init__(*args, **attributes)  # type: ignore[arg-type]
        self.exit_codes = {**_USUAL, **(exit_codes or {})}

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and the settings of ``--set``."""
        super().format_options(ctx, formatter)
        for option in self.params:
            if isinstance(option, SettingsOption):
                with formatter.section("Settings (--set)"):
                    formatter.write_dl(
                        [(f"{s.key}={s.value}", s.description) for s in option.known]
                    )

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the exit codes."""
        super().format_epilog(ctx, formatter)
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(code), text) for code, text in self.exit_codes.items()])
