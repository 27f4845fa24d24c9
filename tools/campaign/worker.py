"""A process that runs batches, one after the other, as its parent sends them.

A task is a line of JSON on standard input, its outcome a line on the file that was standard
output; what the code under test prints goes to the log.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from types import FrameType
from typing import Any

from tools.campaign import isolation
from tools.campaign.case import Batch, Skip
from tools.campaign.children import scratch_root, sweep
from tools.campaign.registry import case

__all__ = ["main"]


class _Stop(BaseException):
    """The parent wants an end."""


def _stop(signum: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _Stop


def run_task(task: dict[str, Any]) -> dict[str, Any]:
    """Run one batch: ``outcome`` is ok, skipped or failed."""
    scratch = Path(tempfile.mkdtemp(prefix="dexkit-campaign-", dir=scratch_root()))
    only = task.get("only")
    batch = Batch(
        task["case"],
        task["seed"],
        task["batch"],
        scratch,
        domain=task.get("domain", 50),
        sample=task.get("sample", False),
        seconds=task.get("seconds", 1.0),
        only=only if only is not None and only >= 0 else None,
        trace=Path(task["trace"]) if task.get("trace") else None,
    )
    outcome, text = "ok", ""
    began = time.monotonic()
    try:
        chosen = case(task["case"])
        if task.get("data") is not None:
            chosen.repeat(batch, bytes.fromhex(task["data"]))
        else:
            chosen.run(batch)
    except Skip as reason:
        outcome, text = "skipped", str(reason)
    except Exception:
        outcome, text = "failed", traceback.format_exc()
    finally:
        left = sweep()
        shutil.rmtree(scratch, ignore_errors=True)
    if left and outcome == "ok" and not batch.findings:
        batch.found("left behind", "process", "\n".join(left))
    return {
        "outcome": outcome,
        "text": text,
        "units": batch.units,
        "seconds": time.monotonic() - began,
        "notes": batch.notes,
        "findings": [f.as_dict() for f in batch.findings],
    }


def main() -> int:
    """Serve until standard input ends."""
    isolation.die_with_parent()
    isolation.subreaper()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    tasks = os.fdopen(os.dup(0), "r")
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    if "--own-network" in sys.argv:
        isolation.new_network()
    if "--nice" in sys.argv:
        os.nice(5)
    try:
        for line in tasks:
            answer = run_task(json.loads(line))
            out.write(json.dumps(answer) + "\n")
    except (_Stop, BrokenPipeError):
        pass
    finally:
        with contextlib.suppress(Exception):
            sweep()
    return 0


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    os._exit(code)  # threads of a batch that was interrupted must not hold this up
