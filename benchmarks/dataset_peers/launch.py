"""``launch.py SECONDS REPORT COMMAND...``: run a command, and write as JSON what it took.

This is a program of its own, and a small one: the peak memory that Linux states for a process is
not less than what the process that started it had.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from contextlib import suppress


def main(seconds: float, report: str, command: list[str]) -> None:
    """Run it for at most ``seconds``, then end it and what it has started."""
    began = time.perf_counter()
    child = os.posix_spawnp(command[0], command, os.environ, setpgroup=0)

    def end(*_: object) -> None:
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)

    signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        _, status, usage = os.wait4(child, 0)
        wall = time.perf_counter() - began
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        end()
    with open(report, "w") as file:
        json.dump(
            {
                "wall_s": wall,
                "cpu_s": usage.ru_utime + usage.ru_stime,
                "peak_mib": usage.ru_maxrss / 1024,
                "exit": os.waitstatus_to_exitcode(status),
            },
            file,
        )


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2], sys.argv[3:])
