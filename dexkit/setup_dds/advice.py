"""Texts for users: the packages to install on each system, and the meaning of a failed build's
output.
"""

from __future__ import annotations

import re

from dexkit.setup_dds.facts import Distribution, Interpreter

__all__ = ["SOURCE_STEPS", "Cause", "cause_of", "how_to_get_library", "system_packages"]

SOURCE_STEPS = (
    "git clone --branch 0.10.5 --depth 1 https://github.com/eclipse-cyclonedds/cyclonedds",
    "dexkit setup-dds --from-source cyclonedds",
)
"""Commands that work where no package has the library; they need git, cmake and a C compiler."""

_PACKAGED = {"debian": (12, 0), "ubuntu": (24, 4)}  # the first release with 0.10.x
_ROS = {"22.04": "humble", "24.04": "jazzy"}


def how_to_get_library(distribution: Distribution) -> str:
    """Commands, one a line, that install a CycloneDDS library 0.10.x."""
    known = _PACKAGED.get(distribution.id)
    lines = []
    if known is not None and _release(distribution) >= known:
        return (
            f"{distribution.name} packages it: sudo apt install cyclonedds-dev build-essential\n"
            "then type again: dexkit setup-dds"
        )
    if known is not None:
        lines.append(f"{distribution.name} packages no CycloneDDS 0.10; build it:")
        lines.append("sudo apt install git cmake build-essential")
    else:
        lines.append("build it; git, cmake and a C compiler are needed:")
    lines += SOURCE_STEPS
    if distribution.id == "ubuntu" and (ros := _ROS.get(distribution.release)):
        lines.append(f"or, with the packages of ROS 2: sudo apt install ros-{ros}-cyclonedds")
    return "\n".join(lines)


def _release(distribution: Distribution) -> tuple[int, int]:
    """As numbers; a release without one (testing, sid) is newer than every other."""
    match = re.fullmatch(r"(\d+)(?:\.(\d+))?", distribution.release)
    return (int(match[1]), int(match[2] or 0)) if match else (1 << 30, 0)


def system_packages(distribution: Distribution, *names: str) -> str:
    """The command that installs packages of Debian's names, or their names."""
    if distribution.id in _PACKAGED:
        return f"sudo apt install {' '.join(names)}"
    return f"install what this system calls {' and '.join(names)}"


class Cause:
    """Why a command failed.

    :ivar message: the cause, in one sentence.
    :ivar hint: what to do.
    """

    def __init__(self, message: str, hint: str) -> None:
        self.message = message
        self.hint = hint


def cause_of(output: str, interpreter: Interpreter, distribution: Distribution) -> Cause | None:
    """The cause that the output of pip, cmake or a compiler names; None if it names none."""

    def has(*patterns: str) -> bool:
        return any(re.search(p, output, re.IGNORECASE) for p in patterns)

    if has(r"no space left on device", r"disk quota exceeded", r"errno 28\b"):
        return Cause(
            "the disk is full", "make space, or have another temporary folder: TMPDIR=/path"
        )
    if has(r"read-only file system"):
        return Cause(
            "a folder that must be written is on a read-only file system",
            "use an environment that can be written: python3 -m venv env",
        )
    if has(r"\bPython\.h: No such file", r"'Python\.h' file not found"):
        return Cause(
            f"Python {interpreter.short} has no C headers",
            system_packages(distribution, f"python{interpreter.short}-dev"),
        )
    if has(r"\bdds/\S+\.h: No such file", r"'dds/\S+\.h' file not found"):
        return Cause("the CycloneDDS library has no headers", how_to_get_library(distribution))
    if has(r"skipping incompatible \S*ddsc", r"file in wrong format", r"wrong ELF class",
           r"error adding symbols: file"):  # fmt: skip
        return Cause(
            f"a library is for another processor than this Python ({interpreter.processor})",
            how_to_get_library(distribution),
        )
    if has(r"THESE PACKAGES DO NOT MATCH THE HASHES", r"hash mismatch"):
        return Cause(
            "the package index gave a cyclonedds that is not the published one",
            "use another package index or mirror: PIP_INDEX_URL=https://pypi.org/simple",
        )
    if has(r"name resolution", r"name or service not known", r"NewConnectionError",
           r"ConnectTimeout", r"Read timed out", r"Network is unreachable", r"ProxyError",
           r"SSLError", r"dns error", r"error sending request", r"ConnectionResetError",
           r"No matching distribution found", r"No solution found"):  # fmt: skip
        return Cause(
            "the package index cannot be reached, or has no such package",
            "connect, or name a mirror (PIP_INDEX_URL); or on another machine with the same "
            "system and Python: 'dexkit setup-dds --wheel DIR', and here: "
            "pip install --no-deps DIR/*.whl",
        )
    if has(r"unable to execute '", r"command '\S+' failed: No such file",
           r"No CMAKE_C_COMPILER could be found", r"CMAKE_MAKE_PROGRAM is not set"):  # fmt: skip
        return Cause("there is no C compiler", system_packages(distribution, "build-essential"))
    if has(r"command '\S+' failed with exit", r"is not able to compile a simple test program",
           r"internal compiler error", r"linker command failed", r"ld returned \d"):  # fmt: skip
        return Cause(
            "the C compiler fails",
            f"its messages are in the log; a working one: "
            f"{system_packages(distribution, 'build-essential')}",
        )
    return None
