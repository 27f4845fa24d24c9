"""Check that this process may open the files and sockets that a task needs, before it begins.

Without descriptors, CycloneDDS 0.10 crashes with a segmentation fault.
"""

from __future__ import annotations

import contextlib
import os
import resource

from dexkit.errors import DexkitError

__all__ = ["require_open_files"]


class _TooFew(DexkitError):
    exit_code = 2


def require_open_files(count: int, what: str) -> None:
    """Make sure that ``count`` more files can be opened, by raising the soft limit if need be.

    :param what: who needs them.
    :raises DexkitError: they cannot.
    """
    found = _free(count)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if found < count and soft != resource.RLIM_INFINITY:
        wanted = soft + count - found
        limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        found = _free(count)
    if found < count:
        raise _TooFew(
            f"{what} needs {count} more open files, and this process may have {found}",
            hint="raise the limit on open files: ulimit -n 1024",
        )


def _free(count: int) -> int:
    """Number of descriptors that can still be opened, up to ``count``."""
    taken: list[int] = []
    try:
        while len(taken) < count:
            taken.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
    except OSError:
        pass
    finally:
        for descriptor in taken:
            os.close(descriptor)
    return len(taken)
