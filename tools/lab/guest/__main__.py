"""``python -m tools.lab.guest``: the session, inside the guest."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from tools.lab.guest.bench import Bench, attach_times, udevd
from tools.lab.guest.dex3 import run_dex3
from tools.lab.guest.programs import with_programs
from tools.lab.guest.serial_lines import run_serial

_PREFIX = "lab."
_START_TIME = 19  # of the fields behind a process's name in its stat, man 5 proc


_GROUPS = {"dex3": run_dex3, "serial": run_serial}


def main() -> None:
    """Do the group that the kernel's command line names."""
    words = dict(
        word.removeprefix(_PREFIX).split("=", 1)
        for word in Path("/proc/cmdline").read_text().split()
        if word.startswith(_PREFIX)
    )
    bench = Bench(words)
    uptime = float(Path("/proc/uptime").read_text().split()[0])
    ready = f"{_started():.1f} s; Python's modules imported after {uptime:.1f} s"
    bench.fact(guest=platform.release(), **{"ready after": ready})
    clocks = _clocks(bench)
    with udevd():
        _whole(bench, words["group"], _GROUPS[words["group"]])
    if attach_times:
        middle = statistics.median(attach_times)
        bench.fact(**{"usbip attach": f"{len(attach_times)} times, median {middle:.2f} s"})
    host, guest = (later - before for before, later in zip(clocks, _clocks(bench), strict=True))
    bench.fact(**{"guest's seconds in one of the host": f"{guest / host:.4f}"})
    bench.ask(do="finished")


def _clocks(bench: Bench) -> tuple[float, float]:
    """The host's time and the guest's."""
    return bench.ask(do="now", device="left")["t"], time.monotonic()


def _whole(bench: Bench, name: str, do: Callable[[Bench], None]) -> None:
    def all_of_it() -> str:
        do(bench)
        return "all cases were tried"

    bench.case(name, "session", all_of_it)


def _started() -> float:
    """When the process that forked this one was started, seconds after the guest."""
    fields = Path(f"/proc/{os.getppid()}/stat").read_text().rsplit(")", 1)[1].split()
    return int(fields[_START_TIME]) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    # an ordinary user's programs are in this folder, too; the change stays in the guest
    os.chmod("/root", 0o755)
    with_programs(main)
