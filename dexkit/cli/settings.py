"""``--set KEY=VALUE`` of commands with settings of their own, which their help lists."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import click

from dexkit.errors import UsageError
from dexkit.escaping import one_line

__all__ = [
    "YES_OR_NO",
    "Setting",
    "Settings",
    "SettingsOption",
    "key_and_value",
    "set_option",
    "settings_option",
]

F = TypeVar("F", bound=Callable[..., Any])

YES_OR_NO = click.BOOL


@dataclass(frozen=True)
class Setting:
    """One setting.

    :param value: what the help calls its value.
    :param type: makes the value of its text.
    :param help: its meaning; the help adds the default, unless it is None.
    """

    key: str
    value: str
    type: click.ParamType[Any]
    help: str
    default: Any = None

    @property
    def description(self) -> str:
        """What the help says of it."""
        default = self.default
        if default is None:
            return self.help
        if isinstance(default, bool):
            default = "yes" if default else "no"
        elif isinstance(default, tuple):
            default = ",".join(map(str, default))
        return f"{self.help}  [default: {default}]"


class Settings(dict[str, Any]):
    """The value of every setting by its key.

    :ivar texts: what was given on the command line.
    """

    texts: tuple[str, ...] = ()

    @property
    def given(self) -> set[str]:
        """The keys that were named."""
        return {key_and_value(text)[0] for text in self.texts}


class SettingsOption(click.Option):
    """The option; the command gets :class:`Settings` as ``settings``."""

    def __init__(self, names: Sequence[str], known: Sequence[Setting], **attributes: Any) -> None:
        super().__init__(
            names, multiple=True, metavar="KEY=VALUE", callback=self._read, **attributes
        )
        self.known = known

    def _read(
        self, ctx: click.Context, parameter: click.Parameter, texts: tuple[str, ...]
    ) -> Settings:
        known = {one.key: one for one in self.known}
        values = Settings({key: one.default for key, one in known.items()})
        for text in texts:
            key, value = key_and_value(text)
            if key not in known:
                raise UsageError(
                    f"there is no setting {one_line(key, 40)!r}", hint=f"known: {', '.join(known)}"
                )
            if key in values.given:
                raise UsageError(f"{key} is given twice")
            values.texts += (text,)
            try:
                values[key] = known[key].type.convert(value, parameter, ctx)
            except click.BadParameter as error:
                raise UsageError(f"--set {one_line(text, 80)}: {error.message}") from None
        return values


def settings_option(known: Sequence[Setting]) -> Callable[[F], F]:
    """``--set KEY=VALUE``, repeated, with these settings."""
    return click.option(
        "--set",
        "settings",
        cls=SettingsOption,
        known=known,
        help="Change one of the settings below; may be repeated.",
    )


def set_option(help: str) -> Callable[[F], F]:
    """``--set KEY=VALUE``, repeated, as ``settings``: texts, which a backend reads."""
    return click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="KEY=VALUE",
        help=help,
    )


def key_and_value(text: str) -> tuple[str, str]:
    """Key and value of a ``--set KEY=VALUE``.

    :raises UsageError: it is none.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise UsageError(f"--set {text} is not KEY=VALUE")
    return key, value
