"""Does dexkit work on every Python that this machine has? ``make platforms``.

For each of 3.10 to 3.13: an environment, ``dexkit setup-dds``, the conformance suite on a simulated
Dex1-1, and both directions with Unitree's Python SDK on the cyclonedds wheel 0.10.2 in another
process (:mod:`tools.platforms.peer`). An interpreter that is missing is reported, not passed over.
``make wheels`` does the same with wheels that it has built, and without the libraries of this
machine.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from dexkit.domains import reserve_free_domain
from tools.platforms.interpreters import UV, find_python

__all__ = ["VERSIONS", "Report", "Step", "report_table", "try_all"]

ROOT = Path(__file__).resolve().parents[2]
VERSIONS = ("3.10", "3.11", "3.12", "3.13")
_PEER = Path(__file__).with_name("peer.py")
_CHECK_WHEEL = ROOT / "packaging" / "wheels" / "check_wheel.py"
_SDK = "unitree-sdk2==1.0.1"
_WHEEL = "cyclonedds==0.10.2"
_TRIES = 4  # of the suite
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


def try_all(
    versions: Iterable[str],
    out: Path,
    progress: Callable[[str], object],
    wheels: Path | None = None,
    enter: Sequence[str] = (),
) -> list[Report]:
    """Try each version, and write ``platforms.json`` into ``out``.

    :param out: folder for the environments and the logs of the steps; its environments are made
        anew.
    :param wheels: folder of self-contained wheels of cyclonedds, to be tried instead of what
        ``dexkit setup-dds`` would find or build.
    :param enter: put before the commands that run dexkit.
    """
    out.mkdir(parents=True, exist_ok=True)
    reports = []
    for version in versions:
        python = find_python(version)
        if python is None:
            progress(f"Python {version}: missing on this machine")
            reports.append(Report(version))
        else:
            reports.append(_Trial(version, python, out, progress, wheels, enter).run())
        about = {"machine": platform.machine(), "system": _system()}
        text = json.dumps({**about, "reports": [asdict(r) for r in reports]}, indent=1)
        (out / "platforms.json").write_text(text + "\n")
    return reports


def _system() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "Linux")
    except OSError:
        return "Linux"


def report_table(reports: Iterable[Report]) -> str:
    """The table at the end, with every interpreter that is missing."""
    lines = []
    for report in reports:
        if not report.python:
            lines.append(f"{report.version:7} MISSING on this machine, not tried")
            continue
        verdict = "pass" if report.passed else "FAIL"
        lines.append(f"{report.exact:7} {verdict}    {report.python}")
        lines += [
            f"        {'ok  ' if s.passed else 'FAIL'}  {s.name:12} {s.seconds:6.1f} s  {s.said}"
            for s in report.steps
        ]
    return "\n".join(lines)


class _Trial:
    def __init__(
        self,
        version: str,
        python: str,
        out: Path,
        progress: Callable[[str], object],
        wheels: Path | None,
        enter: Sequence[str],
    ) -> None:
        self._report = Report(version, python)
        self._out = out
        self._env = out / f"env-{version}"
        self._log = out / f"{version}.log"
        self._progress = progress
        self._wheels = wheels
        self._enter = list(enter)

    def run(self) -> Report:
        """Do the steps, to the first that fails."""
        self._log.write_text("")
        self._report.exact = self._output([self._report.python, "-V"]).split()[-1]
        _ = (
            self._step("environment", self._make_environment)
            and (self._wheels is None or self._step("wheel", self._install_wheel))
            and self._step("setup-dds", self._setup_dds)
            and self._step("conformance", self._conformance)
            and self._step("both ways", self._both_ways)
        )
        return self._report

    def _step(self, name: str, do: Callable[[], str]) -> bool:
        self._progress(f"Python {self._report.exact}: {name}")
        begin = time.monotonic()
        try:
            said, passed = do(), True
        except (OSError, RuntimeError, subprocess.SubprocessError, ValueError) as error:
            said, passed = " ".join(str(error).split()), False
        self._report.steps.append(Step(name, passed, said, round(time.monotonic() - begin, 1)))
        return passed

    def _make_environment(self) -> str:
        shutil.rmtree(self._env, ignore_errors=True)
        self._output([UV, "venv", "--quiet", "--python", self._report.python, self._env])
        self._output([UV, "pip", "install", "--quiet", "--python", self._env,
                      "-e", f"{ROOT}[conformance]"])  # fmt: skip
        return self._output([self._env / "bin/dexkit", "--version"]).strip()

    def _install_wheel(self) -> str:
        self._output([UV, "pip", "install", "--quiet", "--python", self._env, "--no-deps",
                      "--no-index", "--reinstall", "--find-links", self._wheels,
                      "cyclonedds"])  # fmt: skip
        return self._output([*self._enter, self._env / "bin/python", _CHECK_WHEEL]).strip()

    def _setup_dds(self) -> str:
        command = [*self._enter, self._env / "bin/dexkit", "setup-dds"]
        return self._last_line(command, "DDS works")

    def _conformance(self) -> str:
        """The suite; again, where the machine was too busy for a verdict."""
        command = [*self._enter, self._env / "bin/pytest", "conformance/", "--backend",
                   "sim-dex1", "--quick", "-p", "no:cacheprovider"]  # fmt: skip
        for left in reversed(range(_TRIES)):
            try:
                return self._last_line(command, "drop-in: ")
            except RuntimeError:
                log = self._log.read_text().splitlines()
                verdict = next((x for x in reversed(log) if x.startswith("drop-in: ")), "")
                if not verdict.startswith("drop-in: INCONCLUSIVE") or not left:
                    raise RuntimeError(verdict or "the suite did not come to a verdict") from None
                self._progress("the machine was too busy for a verdict; again")
        raise AssertionError("there is a first try")

    def _peer(self) -> Path:
        """The Python of the SDK's environment; made once."""
        home = self._out / "peer"
        python = home / "bin" / "python"
        if not python.exists():
            base = find_python("3.10")
            if base is None:
                raise RuntimeError("needs Python 3.10, for which the wheel 0.10.2 is")
            self._output([UV, "venv", "--quiet", "--python", base, home])
            self._output([UV, "pip", "install", "--quiet", "--python", home, "--no-deps",
                          _WHEEL, _SDK, "rich-click", "click", "rich"])  # fmt: skip
        return python

    def _both_ways(self) -> str:
        """The SDK reads states of ``dexkit serve`` and moves the gripper by commands."""
        peer = self._peer()
        with reserve_free_domain() as reserved:
            domain = str(reserved.domain)
            service = subprocess.Popen(
                [*self._enter, self._env / "bin/dexkit", "serve", "sim-dex1", "--side", "left",
                 "--domain", domain],
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            try:
                assert service.stdout is not None
                said: list[str] = []  # notes come before it, of priorities for example
                while not (said and said[-1].startswith("ready:")):
                    said.append(service.stdout.readline())
                    if not said[-1]:
                        raise RuntimeError(f"dexkit serve does not come up: {' '.join(said)}")
                found = json.loads(self._output([peer, "-I", _PEER, domain]).splitlines()[-1])
            finally:
                service.send_signal(signal.SIGTERM)
                service.communicate(timeout=30)
        return (
            f"cyclonedds {found['cyclonedds']} read {found['states']} states and moved it from "
            f"{found['first']:.2f} to {found['last']:.2f} rad (asked: {found['target']})"
        )

    def _last_line(self, command: Sequence[str | Path], word: str) -> str:
        lines = [line for line in self._output(command).splitlines() if word in line]
        if not lines:
            raise RuntimeError(f"it did not print {word!r}")
        return lines[-1].strip(" =")

    def _output(self, command: Sequence[str | Path]) -> str:
        kept = {"VIRTUAL_ENV", "PYTHONPATH"}
        env = {k: v for k, v in os.environ.items() if k not in kept}
        done = subprocess.run(
            [str(word) for word in command],
            cwd=ROOT, env=env | {"UV_NO_PROGRESS": "1", "UV_PYTHON_DOWNLOADS": "never"},
            capture_output=True, text=True, timeout=_PATIENCE, check=False,
        )  # fmt: skip
        with self._log.open("a") as log:
            log.write(f"$ {' '.join(map(str, command))}\n{done.stdout}{done.stderr}\n")
        if done.returncode:
            lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
            errors = [line for line in lines if line.startswith("error: ")]
            raise RuntimeError((errors or lines or [f"exit code {done.returncode}"])[-1])
        return done.stdout
