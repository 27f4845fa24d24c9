"""Does a client on another DDS than CycloneDDS 0.10 work? ``python -m tools.other_dds``.

Fast DDS of the distribution (``libfastrtps-dev``): a client in C++ reads the states of
``dexkit serve sim-dex1`` and moves the gripper.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from tools.platforms.steps import Report, Trial

__all__ = ["FastDds", "missing"]

_SOURCE = Path(__file__).with_name("fastdds_peer.cpp")
_HEADER = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")


def missing() -> list[str]:
    """Debian's names of the packages that this needs and the machine has not."""
    needed = {"g++": shutil.which("g++"), "libfastrtps-dev": _HEADER.exists()}
    return [name for name, there in needed.items() if not there]


class FastDds(Trial):
    """The trial.

    :param out: folder for the client and the log.
    """

    def __init__(self, out: Path, progress: Callable[[str], object]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        report = Report("Fast DDS", sys.executable, "Fast DDS")
        super().__init__(report, out, out / "fastdds.log", progress)
        self._client = out / "fastdds_peer"

    def run(self) -> Report:
        """Compile the client, and let it move the gripper."""
        serve = [sys.executable, "-m", "dexkit", "serve", "sim-dex1"]
        _ = self.step("compile", self._compile) and self.step(
            "both ways", lambda: self.both_ways(serve, [self._client])
        )
        return self.report

    def _compile(self) -> str:
        self.output(["g++", "-std=c++17", "-O1", "-o", self._client, _SOURCE,
                     "-lfastrtps", "-lfastcdr"])  # fmt: skip
        return str(self._client)
