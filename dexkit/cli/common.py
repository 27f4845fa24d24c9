"""What the sub-commands share: options, and stopping (:mod:`dexkit.stopping`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from dexkit.stopping import StopRequest, stop_on_signals

F = TypeVar("F", bound=Callable[..., Any])

__all__ = ["StopRequest", "dds_options", "stop_on_signals"]


def dds_options(*, default_domain: int | None) -> Callable[[F], F]:
    """``--domain`` and ``--interface``; the interface defaults to loopback."""

    def decorate(function: F) -> F:
        function = click.option(
            "--interface",
            default="lo",
            show_default=True,
            metavar="IF",
            help="Network interface. Traffic stays on this machine unless one is named.",
        )(function)
        domain_help = "DDS domain: 0 is the robot, 1 xr_teleoperate's simulation."
        return click.option(
            "--domain",
            type=click.IntRange(0, 230),
            default=default_domain,
            show_default=default_domain is not None,
            help=domain_help,
        )(function)

    return decorate
