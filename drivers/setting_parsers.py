"""Read the settings of a backend, for the drivers."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dexkit.errors import UsageError

__all__ = ["Parsers", "parse_settings"]

Parsers = Mapping[str, tuple[Callable[[str], object], str]]
"""Of each setting, how it is read and what it means."""


def parse_settings(texts: Mapping[str, str], parsers: Parsers) -> dict[str, object]:
    """The values of settings.

    :raises UsageError: one cannot be read.
    """
    values: dict[str, object] = {}
    for name, text in texts.items():
        parse, meaning = parsers[name]
        try:
            values[name] = parse(text)
        except (ValueError, OSError) as error:
            raise UsageError(f"{name}={text}: {error}", hint=f"{name} is {meaning}") from error
    return values
