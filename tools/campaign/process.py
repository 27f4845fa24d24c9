"""A ``dexkit`` command as a process of a batch, with its output in a file."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tools.campaign import isolation
from tools.campaign.case import ROOT, Batch
from tools.campaign.children import command_of, descendants, wait_gone
from tools.campaign.waiting import WaitTimeout, until

__all__ = ["Program", "traceback_in"]

_TRACEBACK = re.compile(
    r"^(?:.*?)(Traceback \(most recent call last\):|Exception ignored in|"
    r"Exception in thread|Fatal Python error|Segmentation fault)",
    re.MULTILINE,
)


def traceback_in(text: str) -> tuple[str, str] | None:
    """Where a traceback in ``text`` came from (its last frame) and its last line."""
    found = _TRACEBACK.search(text)
    if found is None:
        return None
    rest = text[found.start() :]
    frames = re.findall(r'File "([^"]+)", line \d+, in (\S+)', rest)
    ours = [f for f in frames if str(ROOT) in f[0] and ".venv" not in f[0]] or frames
    place = f"{Path(ours[-1][0]).name}:{ours[-1][1]}" if ours else "unknown"
    last = re.search(r"^(\w[\w.]*(?:Error|Exception|Interrupt|Exit|Warning)\b.*)$", rest, re.M)
    return place, last[1] if last else rest.strip().splitlines()[0]


class Program:
    """One run of a command; its own session, its own temporary folder. A context manager, which
    kills it if it still runs.

    :param command: behind ``python -m``; mostly ``["dexkit", "serve", ...]``.
    """

    def __init__(
        self,
        batch: Batch,
        command: Sequence[str],
    ) -> None:
        self.command = list(command)
        self.temporary = batch.scratch / "tmp"
        self.temporary.mkdir(exist_ok=True)
        home = batch.scratch / "home"
        home.mkdir(exist_ok=True)
        self._output = Path(tempfile.mkstemp(prefix="output-", dir=batch.scratch)[1])
        environment = {k: v for k, v in os.environ.items() if not k.startswith("DEXKIT_")}
        environment |= {
            "TMPDIR": str(self.temporary),
            "HOME": str(home),
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",
        }
        self.below: set[int] = set()

        def prepare() -> None:
            isolation.die_with_parent()
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
                signal.signal(number, signal.SIG_DFL)

        with open(self._output, "ab") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *self.command],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                # not the checkout: some write where they are
                cwd=ROOT if self.command[0] == "pytest" else batch.scratch,
                env=environment,
                start_new_session=True,
                preexec_fn=prepare,
            )

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *exc: object) -> None:
        self.end()

    def __repr__(self) -> str:
        return " ".join(self.command)

    @property
    def output(self) -> str:
        """Its output so far."""
        return self._output.read_text(errors="replace")

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def wait_for(self, text: str, timeout: float = 60.0) -> None:
        """Wait until it has printed ``text``.

        :raises WaitTimeout: it has not, or has ended.
        """
        until(lambda: text in self.output or not self.running, f"{text!r} of {self!r}", timeout)
        if text not in self.output:
            raise WaitTimeout(
                f"{self!r} ended with {self.process.returncode}: {self.output[-1500:]}"
            )

    def note_children(self) -> None:
        """Remember what is below it now."""
        self.below |= set(descendants(self.process.pid))

    def signal(self, number: int) -> None:
        """Send it a signal."""
        self.note_children()
        if self.running:
            self.process.send_signal(number)

    def wait(self, timeout: float = 60.0) -> int | None:
        """Its exit code; None if it does not end."""
        try:
            return self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None

    def left_behind(self, timeout: float = 20.0) -> list[str]:
        """Those of its children that are not gone some time after it."""
        return [f"{pid}: {command_of(pid)}" for pid in wait_gone(sorted(self.below), timeout)]

    def check_output(self, batch: Batch) -> bool:
        """Report a traceback in its output, whatever else happens; whether there is one."""
        found = traceback_in(self.output)
        if found is not None:
            place, last = found
            batch.found("traceback", place, f"{last}\n{self!r}\n{self.output[-3000:]}")
        return found is not None

    def end(self) -> None:
        """Kill it, if it still runs."""
        if self.running:
            self.process.kill()
            self.process.wait()
