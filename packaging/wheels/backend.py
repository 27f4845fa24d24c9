"""Build backend (PEP 517) of the self-contained wheels; ``dexkit setup-dds`` makes them.

``CYCLONEDDS_SOURCE`` names a checkout of the CycloneDDS C library 0.10.x; README.md beside this
file. dexkit is that of the checkout that this file is in.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """What dexkit needs to run, but for the binding itself, and cmake where there is none."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [str(x) for x in project["dependencies"] if not str(x).startswith("cyclonedds")]
    return needed + ([] if shutil.which("cmake") else ["cmake<4"])


def build_wheel(
    wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None
) -> str:
    """Build it for the Python that runs this; returns its name."""
    source = os.environ.get("CYCLONEDDS_SOURCE", "")
    if not source:
        sys.exit("error: CYCLONEDDS_SOURCE must name a checkout of CycloneDDS 0.10.x")
    python_path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as made:
        done = subprocess.run(
            [sys.executable, "-m", "dexkit", "setup-dds", "--from-source", source,
             "--wheel", made, "--no-install", "--log", str(Path(made, "log"))],
            env={**os.environ, "PYTHONPATH": python_path},
            check=False,
        )  # fmt: skip
        if done.returncode:
            log = Path(made, "log")
            sys.stderr.write(log.read_text(errors="replace")[-20_000:] if log.exists() else "")
            sys.exit("error: no wheel was made")
        (wheel,) = Path(made).glob("*.whl")
        shutil.move(wheel, wheel_directory)
        return wheel.name


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """There is none: the binding's own source is on the package index."""
    raise NotImplementedError("only wheels are built here: pip wheel, or build --wheel")
