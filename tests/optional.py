"""What some tests need and not every machine has; a run begins by saying what is missing."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from tools.browser import chromium
from tools.platforms.interpreters import UV, find_python

__all__ = [
    "OPTIONAL",
    "UNSHARE",
    "UV",
    "Optional",
    "access_times",
    "chromium",
    "header",
    "namespaces",
    "python",
]

UNSHARE = ["unshare", "--user", "--map-root-user", "--net"]


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
def namespaces() -> bool:
    """Whether this user may make a network namespace."""
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return False
    probe = [*UNSHARE, "ip", "link", "set", "lo", "up"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


@functools.cache
def access_times() -> bool:
    """Whether reading a file is noted in its times here."""
    with tempfile.NamedTemporaryFile() as file:
        os.utime(file.name, ns=(1, 1))
        Path(file.name).read_bytes()
        return os.stat(file.name).st_atime_ns > 1


@functools.cache
def python(version: str) -> str | None:
    """A Python of this machine."""
    return find_python(version)


def _package(name: str) -> Callable[[], object]:
    return lambda: importlib.util.find_spec(name)


OPTIONAL = (
    Optional("Chromium", chromium, ("conformance_report_browser", "view_browser", "view_soak")),
    Optional(
        "user and network namespaces",
        namespaces,
        ("dds_multicast", "docs_run", "lan", "lerobot_soak", "networks"),
    ),
    Optional("/proc/PID/schedstat", Path("/proc/self/schedstat").exists, ("conformance_waits",)),
    Optional("Python 3.10 in this run", lambda: sys.version_info < (3, 11), ("vendor_action",)),
    Optional("Python 3.11", lambda: python("3.11"), ("package", "setup_dds")),
    Optional("Python 3.13", lambda: python("3.13"), ("package", "setup_dds")),
    Optional(
        "CycloneDDS 0.10",
        _package("cyclonedds"),
        ("campaign", "demo", "prefixes", "ros2", "everything on DDS"),
    ),
    Optional(
        "the package unitree-sdk2",
        _package("unitree_sdk2py"),
        (
            *("dds_multicast", "dds_sdk", "dds_types", "motion_switcher"),
            *("sdk_examples", "service_sdk"),
        ),
    ),
    Optional("the package far-unitree-sdk", _package("unitree_interface"), ("robot_sdk",)),
    Optional("the package rerun-sdk", _package("rerun"), ("view_forward",)),
    Optional("the package foxglove-sdk", _package("foxglove"), ("view_forward",)),
    Optional("bash", lambda: shutil.which("bash") is not None, ("cli_options",)),
    Optional("systemd-analyze", lambda: shutil.which("systemd-analyze"), ("install_service",)),
    Optional("access times of files", access_times, ("campaign_fuzzers",)),
    Optional("root", lambda: os.geteuid() == 0, ("files", "install_service")),
    Optional(
        "LeRobot in .tools/lerobot",
        (Path(__file__).parent.parent / ".tools" / "lerobot" / "bin" / "python").exists,
        ("cleaned_soak", "lerobot_soak"),
    ),
    Optional("pyzmq", _package("zmq"), ("lerobot_ports",)),
    Optional("pyte", _package("pyte"), ("monitor_terminal",)),
    Optional("viser", _package("viser"), ("view", "view_browser", "view_soak", "web_pages")),
    Optional("aiohttp", _package("aiohttp"), ("audit_objects", "redaction")),
    Optional("ray", _package("ray"), ("audit_ray",)),
    Optional(
        "pyarrow",
        _package("pyarrow"),
        ("cleaned_soak", "dataset_cameras", "sessions_round_trips"),
    ),
    Optional("PyAV", _package("av"), ("dataset_cameras",)),
    Optional("Pillow", _package("PIL"), ("dataset_cameras",)),
    Optional("jsonschema", _package("jsonschema"), ("conformance_schema",)),
)


def header(optional: Iterable[Optional] = OPTIONAL) -> str:
    """The line at the start of a run."""
    missing = [o for o in optional if not o.there()]
    if not missing:
        return "optional: everything is here, no test is skipped"
    printed = ", ".join(f"{o.name} (tests of {', '.join(o.tests)})" for o in missing)
    return f"not on this machine, so their tests are skipped: {printed}"
