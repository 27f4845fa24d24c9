"""``python -m tools.lab.guest``: the session, inside the guest."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from pathlib import Path

from tools.lab.guest.bench import Bench

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
    bench = Bench(words)
    uptime = Path("/proc/uptime").read_text().split()[0]
    bench.fact(guest=platform.release(), **{"guest ready after": f"{uptime} s"})
    for name, do in _groups().items():
        if not words.get("only") or name in words["only"].split(","):
            bench.case(name, "session", lambda do=do: do(bench) or "done")  # type: ignore[misc]
    bench.ask(do="finished")


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
