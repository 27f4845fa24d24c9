"""Open a recording or a ROS 2 bag as it can be judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dexkit.errors import SessionError
from dexkit.traces.reader import Trace, open_trace

__all__ = ["judgeable"]


@contextmanager
def judgeable(source: Path) -> Iterator[tuple[Trace, Sequence[str] | None]]:
    """A recording, and None; or a bag that was imported, and what the import changed or left out.

    A bag of SQLite, of several files or of packed messages is imported into a temporary folder,
    which is removed at the end.

    :raises DexkitError: it cannot be read.
    """
    is_bag = (source / "metadata.yaml").is_file() or any(source.glob("*.mcap"))
    if source.is_dir() and not is_bag:
        raise SessionError(
            f"{source} is no recording",
            hint="'dexkit import' makes recordings of datasets, episodes and tables; 'dexkit "
            "audit' judges the episodes of datasets as they are",
        )
    trace = None if _is_bag_to_import(source) else open_trace(source)
    if trace is not None and not _has_packed_messages(trace):
        yield trace, None
        return
    from dexkit.temporary_folder import TemporaryFolder  # few recordings are such bags
    from dexkit.traces.sessions.rosbag import import_bag

    with TemporaryFolder("bag") as folder:
        path = folder / f"{source.stem}.mcap"
        _, corrections, problems = import_bag(source, path)
        yield open_trace(path), [*corrections, *problems.sentences()]


def _is_bag_to_import(source: Path) -> bool:
    if not (source / "metadata.yaml").is_file():
        return source.suffix == ".db3"
    files = [p for p in source.iterdir() if p.suffix in (".mcap", ".db3", ".zstd")]
    return len(files) > 1 or any(p.suffix != ".mcap" for p in files)


def _has_packed_messages(trace: Trace) -> bool:
    if trace.library.startswith("dexkit"):
        return False
    from dexkit.traces.sessions.bag_checks import is_packed

    first = next(trace.messages(), None)
    return first is not None and is_packed(first.data)
