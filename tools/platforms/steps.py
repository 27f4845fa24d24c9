"""What the trials of Pythons and processors have in common: steps, their log, and the client."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.domains import reserve_free_domain
from tools.platforms.interpreters import UV, find_python

__all__ = ["ROOT", "SDK", "Command", "Report", "Step", "Trial"]

ROOT = Path(__file__).resolve().parents[2]
Command = Sequence[str | Path]

_PEER = Path(__file__).with_name("peer.py")
SDK = "unitree-sdk2==1.0.1"
_WHEEL = "cyclonedds==0.10.2"
_PATIENCE = 900.0  # seconds for any one step; the longest, the suite, takes two minutes


@dataclass
class Step:
    """One step of one interpreter.

    :ivar passed: whether it did what it should.
    :ivar said: the line that shows it, or the error.
    :ivar seconds: how long it took.
    """

    name: str
    passed: bool
    said: str
    seconds: float


@dataclass
class Report:
    """One interpreter.

    :ivar python: its path; empty if it is missing.
    :ivar exact: its whole version.
    """

    version: str
    python: str = ""
    exact: str = ""
    steps: list[Step] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether all steps were done and passed; False for one that is missing."""
        return bool(self.steps) and all(step.passed for step in self.steps)


class Trial:
    """Steps of one interpreter.

    :param report: gets the steps.
    :param out: folder for the environments.
    :param log: gets commands and their output; emptied.
    """

    def __init__(
        self, report: Report, out: Path, log: Path, progress: Callable[[str], object]
    ) -> None:
        self.report = report
        self.out = out
        self.log = log
        self.progress = progress
        log.write_text("")

    def step(self, name: str, do: Callable[[], str]) -> bool:
        """Do one; returns whether it passed.

        :param do: returns the line that shows it, or raises.
        """
        self.progress(f"{self.report.exact}: {name}")
        begin = time.monotonic()
        try:
            said, passed = do(), True
        except (OSError, RuntimeError, subprocess.SubprocessError, ValueError) as error:
            said, passed = " ".join(str(error).split()), False
        self.report.steps.append(Step(name, passed, said, round(time.monotonic() - begin, 1)))
        return passed

    def _peer(self) -> Path:
        """The Python of the SDK's environment; made once."""
        home = self.out / "peer"
        python = home / "bin" / "python"
        if not python.exists():
            base = find_python("3.10")
            if base is None:
                raise RuntimeError("needs Python 3.10, for which the wheel 0.10.2 is")
            self.output([UV, "venv", "--quiet", "--python", base, home])
            self.output([UV, "pip", "install", "--quiet", "--python", home, "--no-deps",
                          _WHEEL, SDK, "rich-click", "click", "rich"])  # fmt: skip
        return python

    def both_ways(self, serve: Command, peer: Command = ()) -> str:
        """A client reads states of a service and moves the gripper by commands.

        :param serve: command of the service, but for side and domain.
        :param peer: command of the client, but for the domain; the SDK unless one is given.
        :raises RuntimeError: it does not come up, or does not move.
        """
        peer = peer or [self._peer(), "-I", _PEER]
        with reserve_free_domain() as reserved:
            domain = str(reserved.domain)
            service = subprocess.Popen(
                [*map(str, serve), "--side", "left", "--domain", domain],
                cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            try:
                assert service.stdout is not None
                said: list[str] = []  # notes come before it, of priorities for example
                while not (said and said[-1].startswith("ready:")):
                    said.append(service.stdout.readline())
                    if not said[-1]:
                        raise RuntimeError(f"dexkit serve does not come up: {' '.join(said)}")
                found = json.loads(self.output([*peer, domain]).splitlines()[-1])
            finally:
                service.send_signal(signal.SIGTERM)
                service.communicate(timeout=30)
        return (
            f"{found['dds']} read {found['states']} states and moved it from "
            f"{found['first']:.2f} to {found['last']:.2f} rad (asked: {found['target']})"
        )

    def last_line(self, command: Command, word: str, **variables: str) -> str:
        """Run a command, and return the last line that it prints with that word.

        :param variables: more variables of its environment.
        :raises RuntimeError: it fails, or prints no such line.
        """
        lines = [line for line in self.output(command, **variables).splitlines() if word in line]
        if not lines:
            raise RuntimeError(f"it did not print {word!r}")
        return lines[-1].strip(" =")

    def output(self, command: Command, **variables: str) -> str:
        """Run a command to its end, and return what it prints.

        :param variables: more variables of its environment.
        :raises RuntimeError: it fails.
        """
        kept = {"VIRTUAL_ENV", "PYTHONPATH"}
        env = {k: v for k, v in os.environ.items() if k not in kept} | variables
        done = subprocess.run(
            [str(word) for word in command],
            cwd=ROOT, env=env | {"UV_NO_PROGRESS": "1", "UV_PYTHON_DOWNLOADS": "never"},
            capture_output=True, text=True, timeout=_PATIENCE, check=False,
        )  # fmt: skip
        with self.log.open("a") as log:
            log.write(f"$ {' '.join(map(str, command))}\n{done.stdout}{done.stderr}\n")
        if done.returncode:
            lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
            errors = [line for line in lines if line.startswith("error: ")]
            raise RuntimeError((errors or lines or [f"exit code {done.returncode}"])[-1])
        return done.stdout
