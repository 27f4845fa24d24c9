"""Programs with faults on purpose, for tests/campaign_cases.py."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

FAULT = sys.argv[1] if len(sys.argv) > 1 else ""


def _stop(signum: int, frame: object) -> None:
    if FAULT == "traceback":
        raise ValueError("no good end")
    sys.exit(0)


def _main() -> None:
    signal.signal(signal.SIGTERM, _stop)
    if FAULT == "child":
        subprocess.Popen(["sleep", "300"], start_new_session=True)
    print("ready: to fail", flush=True)
    kept = []
    while True:
        if FAULT == "leak":
            kept.append(bytearray(b"x" * 2_000_000))
        time.sleep(0.02)


if __name__ == "__main__":
    _main()
