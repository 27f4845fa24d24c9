"""Print the warnings of a command on standard error, one line each."""

from __future__ import annotations

from collections.abc import Iterable

import click

from dexkit.escaping import REMARK, one_line

__all__ = ["remark", "remarks"]


def remark(kind: str, text: object, about: object = None) -> None:
    """Print ``KIND: ABOUT: TEXT``, cut to a line.

    :param kind: ``warning``, mostly.
    :param about: a file; None where it is clear which.
    """
    place = "" if about is None else f"{about}: "
    click.echo(one_line(f"{kind}: {place}{text}", REMARK), err=True)


def remarks(kind: str, texts: Iterable[object], about: object = None) -> None:
    """Print several of them."""
    for text in texts:
        remark(kind, text, about)
