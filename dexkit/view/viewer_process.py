"""The viewer beside another command, in a separate process, which takes none of that one's time."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dexkit.child_processes import Tool
from dexkit.errors import ExtraMissing

__all__ = ["viewer"]


@contextmanager
def viewer(
    domain: int,
    interface: str,
    stop: threading.Event | None = None,
    report: Callable[[str], object] = lambda text: None,
) -> Iterator[None]:
    """Run ``dexkit view`` on a domain meanwhile.

    :param stop: ends the wait until the page is up, when set.
    :param report: told where the page is.
    :raises ExtraMissing: the package of the page is not installed.
    :raises DexkitError: it cannot be started; its last lines are the hint.
    """
    if importlib.util.find_spec("viser") is None:
        raise ExtraMissing("the page needs the package viser", hint="pip install 'dexkit[view]'")
    with Tool("view", "--domain", str(domain), "--interface", interface) as tool:
        tool.wait_ready(stop or threading.Event())
        report(f"view: {tool.place}")
        yield
