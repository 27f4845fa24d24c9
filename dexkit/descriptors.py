"""Wait for file descriptors, also in a process that has more than 1024 of them open."""

from __future__ import annotations

import errno
import math
import os
import select
from collections.abc import Sequence

__all__ = ["wait_readable", "wait_writable"]

_SELECT_LIMIT = 1024
"""``FD_SETSIZE`` of the C library: select(2) takes only descriptors below it."""


def wait_readable(descriptors: Sequence[int], seconds: float) -> list[int]:
    """Wait until one of the descriptors can be read, at its end, or broken; return those.

    :param seconds: to wait at most, 0 or more. From descriptor 1024 on they are rounded up to
        milliseconds.
    :raises OSError: a descriptor is not open.
    """
    if max(descriptors) < _SELECT_LIMIT:
        return select.select(descriptors, [], [], seconds)[0]
    return _poll(descriptors, select.POLLIN | select.POLLPRI, seconds)


def wait_writable(descriptor: int, seconds: float) -> bool:
    """Wait until a descriptor can be written to, or is broken; return whether it is.

    :param seconds: see :func:`wait_readable`.
    :raises OSError: the descriptor is not open.
    """
    if descriptor < _SELECT_LIMIT:
        return bool(select.select([], [descriptor], [], seconds)[1])
    return bool(_poll([descriptor], select.POLLOUT, seconds))


def _poll(descriptors: Sequence[int], events: int, seconds: float) -> list[int]:
    poll = select.poll()
    for descriptor in descriptors:
        poll.register(descriptor, events)
    ready = poll.poll(math.ceil(seconds * 1e3))
    if any(event & select.POLLNVAL for _, event in ready):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    return [descriptor for descriptor, _ in ready]
