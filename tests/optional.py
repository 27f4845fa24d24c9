"""What some tests need and not every machine has; a run begins by saying what is missing."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from uv import find_uv_bin

__all__ = [
    "OPTIONAL",
    "UNSHARE",
    "Optional",
    "chromium",
    "header",
    "minisign",
    "namespaces",
    "python",
    "ssh_keygen",
]

UNSHARE = ["unshare", "--user", "--map-root-user", "--net"]
UV = find_uv_bin()  # of the dev group, wherever the tests were started from


class Optional(NamedTuple):
    """One thing that may be missing.

    :ivar name: what it is, for the line at the start.
    :ivar there: whether this machine has it.
    :ivar tests: files of the tests that are skipped without it, without ``test_`` and ``.py``.
    """

    name: str
    there: Callable[[], object]
    tests: tuple[str, ...]


@functools.cache
def chromium() -> str | None:
    """A browser."""
    names = ("chromium", "chromium-browser", "chrome", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


def ssh_keygen() -> str | None:
    """OpenSSH's tool that signs."""
    return shutil.which("ssh-keygen")


def minisign() -> str | None:
    """The other tool that signs."""
    return shutil.which("minisign")


@functools.cache
def namespaces() -> bool:
    """Whether this user may make a network namespace."""
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return False
    probe = [*UNSHARE, "ip", "link", "set", "lo", "up"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


@functools.cache
def python(version: str) -> str | None:
    """A Python of this machine; pyenv's shims do not run what pyenv has not switched on."""
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


def _package(name: str) -> Callable[[], object]:
    return lambda: importlib.util.find_spec(name)


OPTIONAL = (
    Optional("Chromium", chromium, ("conformance_report_browser",)),
    Optional("user and network namespaces", namespaces, ("dds_multicast", "lan")),
    Optional("Python 3.11", lambda: python("3.11"), ("package",)),
    Optional("Python 3.13", lambda: python("3.13"), ("package",)),
    Optional("CycloneDDS 0.10", _package("cyclonedds"), ("campaign", "demo", "everything on DDS")),
    Optional(
        "the package unitree-sdk2",
        _package("unitree_sdk2py"),
        ("dds_multicast", "dds_sdk", "dds_types", "service_sdk"),
    ),
    Optional("the package far-unitree-sdk", _package("unitree_interface"), ("robot_sdk",)),
    Optional("ssh-keygen", ssh_keygen, ("signing",)),
    Optional("minisign", minisign, ("signing",)),
    Optional("jsonschema", _package("jsonschema"), ("conformance_schema",)),
)


def header(optional: Iterable[Optional] = OPTIONAL) -> str:
    """The line at the start of a run."""
    missing = [o for o in optional if not o.there()]
    if not missing:
        return "optional: everything is here, no test is skipped"
    printed = ", ".join(f"{o.name} (tests of {', '.join(o.tests)})" for o in missing)
    return f"not on this machine, so their tests are skipped: {printed}"
