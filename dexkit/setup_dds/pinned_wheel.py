"""Write into a built wheel of cyclonedds which library it loads.

The binding as it is built asks the system for any ``libddsc`` first, and its compiled part finds
one by itself, so that a process can get two of them. One that is "in a wheel" loads the file that
its module ``__library__`` names, and nothing else; the compiled part then finds it loaded.
"""

from __future__ import annotations

import base64
import hashlib
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

from dexkit.errors import DdsBuildFailed

__all__ = ["LIBRARY_FOLDER", "inside", "outside", "rewrite"]

LIBRARY_FOLDER = "cyclonedds.libs"
"""Suffix of the folder with a wheel's libraries, beside the package."""

_MODULE = "cyclonedds/__library__.py"


def outside(library: str) -> str:
    """The module of a wheel that uses a library where it is.

    :param library: absolute path.
    """
    return f"# by dexkit setup-dds\nin_wheel = True\nlibrary_path = {library!r}\n"


def inside(name: str) -> str:
    """The module of a wheel that holds its library.

    :param name: of the file in :data:`LIBRARY_FOLDER`.
    """
    return (
        "# by dexkit setup-dds\nfrom pathlib import Path\n\nin_wheel = True\n"
        f"library_path = Path(__file__).resolve().parent.parent / {LIBRARY_FOLDER!r} / {name!r}\n"
    )


def rewrite(wheel: Path, target: Path, module: str, files: Mapping[str, bytes]) -> None:
    """Copy a wheel with another module ``__library__``, more files, and a record of all.

    :param files: contents by name; a name that begins with ``dist-info/`` goes into that folder.
    :raises DdsBuildFailed: it is no wheel of the binding.
    """
    try:
        with zipfile.ZipFile(wheel) as old:
            names = old.namelist()
            record = next((n for n in names if n.endswith(".dist-info/RECORD")), "")
            if _MODULE not in names or not record:
                raise DdsBuildFailed(f"{wheel.name} is no wheel of cyclonedds")
            info = record.rpartition("/")[0]
            added = {
                (f"{info}/{n.removeprefix('dist-info/')}" if n.startswith("dist-info/") else n): c
                for n, c in files.items()
            }
            added[_MODULE] = module.encode()
            rows = []
            with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
                for entry in old.infolist():
                    if entry.filename not in added and entry.filename != record:
                        content = old.read(entry)
                        new.writestr(entry, content, zipfile.ZIP_DEFLATED)
                        rows.append(_row(entry.filename, content))
                for name, content in sorted(added.items()):
                    entry = zipfile.ZipInfo(name)
                    shared_library = ".so" in os.path.basename(name)
                    entry.external_attr = (0o100755 if shared_library else 0o100644) << 16
                    new.writestr(entry, content, zipfile.ZIP_DEFLATED)
                    rows.append(_row(name, content))
                rows.append(f"{record},,")
                entry = zipfile.ZipInfo(record)
                entry.external_attr = 0o100644 << 16
                new.writestr(entry, "\n".join(rows) + "\n", zipfile.ZIP_DEFLATED)
    except zipfile.BadZipFile as error:
        raise DdsBuildFailed(f"{wheel.name} is no wheel: {error}") from error


def _row(name: str, content: bytes) -> str:
    digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
    return f"{name},sha256={digest},{len(content)}"
