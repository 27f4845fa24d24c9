"""``python -m tools.lab.guest``: the session, inside the guest."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from tools.lab.guest import programs
from tools.lab.guest.bench import Bench, attach_times, udevd

_PREFIX = "lab."


def main() -> None:
    """Do all groups, or those that the kernel's command line names."""
    words = dict(
        word.removeprefix(_PREFIX).split("=", 1)
        for word in Path("/proc/cmdline").read_text().split()
        if word.startswith(_PREFIX)
    )
    # an ordinary user's programs are in this folder, too; the change stays in the guest
    os.chmod("/root", 0o755)
    programs.prepare()
    bench = Bench(words)
    uptime = Path("/proc/uptime").read_text().split()[0]
    bench.fact(guest=platform.release(), **{"guest ready after": f"{uptime} s"})
    clocks = _clocks(bench)
    with udevd():
        for name, do in _groups().items():
            if not words.get("only") or name in words["only"].split(","):
                _whole(bench, name, do)
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


def _groups() -> dict[str, Callable[[Bench], None]]:
    def dex3(bench: Bench) -> None:
        from tools.lab.guest.dex3 import run_dex3

        run_dex3(bench)

    def serial(bench: Bench) -> None:
        from tools.lab.guest.serial_lines import run_serial

        run_serial(bench)

    return {"dex3": dex3, "serial": serial}


if __name__ == "__main__":
    main()
