"""The C peers of the codec benchmarks."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

__all__ = ["compiled"]


def compiled(name: str, folder: str) -> ctypes.CDLL | None:
    """``name.c`` of this folder as a library in ``folder``, prepared; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    source, target = Path(__file__).with_name(f"{name}.c"), Path(folder) / f"{name}.so"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", target, source], check=True)
    library = ctypes.CDLL(str(target))
    library.crc_words.restype = ctypes.c_uint32
    library.prepare()
    return library
