"""Find the Pythons of this machine: on the path, pyenv's, uv's."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from uv import find_uv_bin

__all__ = ["UV", "find_python"]

UV = find_uv_bin()  # of the dev group, wherever the program was started from


def find_python(version: str) -> str | None:
    """A Python of this machine; pyenv's shims do not run what pyenv has not switched on.

    :param version: ``"3.12"``.
    :returns: its path; None if there is none.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = os.get_exec_path() + [str(p / "bin") for p in pyenv.glob(f"{version}.*")]
    for place in places:
        found = Path(place) / f"python{version}"
        if found.exists() and not subprocess.run([found, "-c", ""], capture_output=True).returncode:
            return str(found)
    env = {k: v for k, v in os.environ.items() if k not in {"VIRTUAL_ENV", "PYTHONPATH"}}
    asked = subprocess.run(
        [UV, "python", "find", "--no-project", version],
        env=env | {"UV_PYTHON_DOWNLOADS": "never", "UV_NO_PROGRESS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    return None if asked.returncode else asked.stdout.strip()
