"""Does dexkit work on every Python that this machine has? ``make platforms``.

For each of 3.10 to 3.13: an environment, ``dexkit setup-dds``, the conformance suite on a simulated
Dex1-1, and both directions with Unitree's Python SDK on the cyclonedds wheel 0.10.2 in another
process (:mod:`tools.platforms.peer`). An interpreter that is missing is reported, not passed over.
``make wheels`` does the same with wheels that it has built, and without the libraries of this
machine.
"""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

from tools.platforms.interpreters import UV, find_python
from tools.platforms.steps import ROOT, Report, Step, Trial

__all__ = ["VERSIONS", "Report", "Step", "report_table", "try_all"]

VERSIONS = ("3.10", "3.11", "3.12", "3.13")
_CHECK_WHEEL = ROOT / "packaging" / "wheels" / "check_wheel.py"
_TRIES = 4  # of the suite


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


class _Trial(Trial):
    def __init__(
        self,
        version: str,
        python: str,
        out: Path,
        progress: Callable[[str], object],
        wheels: Path | None,
        enter: Sequence[str],
    ) -> None:
        super().__init__(Report(version, python), out, out / f"{version}.log", progress)
        self._env = out / f"env-{version}"
        self._wheels = wheels
        self._enter = list(enter)

    def run(self) -> Report:
        """Do the steps, to the first that fails."""
        self.report.exact = self.output([self.report.python, "-V"]).strip().removeprefix("Python ")
        serve: list[str | Path] = [*self._enter, self._env / "bin/dexkit", "serve", "sim-dex1"]
        _ = (
            self.step("environment", self._make_environment)
            and (self._wheels is None or self.step("wheel", self._install_wheel))
            and self.step("setup-dds", self._setup_dds)
            and self.step("conformance", self._conformance)
            and self.step("both ways", lambda: self.both_ways(serve))
        )
        return self.report

    def _make_environment(self) -> str:
        shutil.rmtree(self._env, ignore_errors=True)
        self.output([UV, "venv", "--quiet", "--python", self.report.python, self._env])
        self.output([UV, "pip", "install", "--quiet", "--python", self._env,
                      "-e", f"{ROOT}[conformance]"])  # fmt: skip
        return self.output([self._env / "bin/dexkit", "--version"]).strip()

    def _install_wheel(self) -> str:
        assert self._wheels is not None
        self.output([UV, "pip", "install", "--quiet", "--python", self._env, "--no-deps",
                      "--no-index", "--reinstall", "--find-links", self._wheels,
                      "cyclonedds"])  # fmt: skip
        return self.output([*self._enter, self._env / "bin/python", _CHECK_WHEEL]).strip()

    def _setup_dds(self) -> str:
        command: list[str | Path] = [*self._enter, self._env / "bin/dexkit", "setup-dds"]
        return self.last_line(command, "DDS works")

    def _conformance(self) -> str:
        """The suite; again, where the machine was too busy for a verdict."""
        command: list[str | Path] = [*self._enter, self._env / "bin/pytest", "conformance/",
                                     "--backend", "sim-dex1", "--quick",
                                     "-p", "no:cacheprovider"]  # fmt: skip
        for left in reversed(range(_TRIES)):
            try:
                return self.last_line(command, "drop-in: ")
            except RuntimeError:
                log = self.log.read_text().splitlines()
                verdict = next((x for x in reversed(log) if x.startswith("drop-in: ")), "")
                if not verdict.startswith("drop-in: INCONCLUSIVE") or not left:
                    raise RuntimeError(verdict or "the suite did not come to a verdict") from None
                self.progress("the machine was too busy for a verdict; again")
        raise AssertionError("there is a first try")
