"""Disks that are full, read-only or taken away, under everything that writes.

``record``, ``check``, ``report``, ``badge`` and ``compare`` write to ``/dev/full``, to a file
system of 64 KiB, under a limit of the file's size, to a folder that is read-only or missing, and
to a file that is deleted meanwhile. What could not be written is reported and gives an exit
code that is not 0; a traceback is a finding, and so is a claim that does not hold.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import re
import resource
import signal
from pathlib import Path

from dexkit.errors import DexkitError
from tools.campaign.case import Batch, Case, Skip
from tools.campaign.process import Program
from tools.campaign.programs import Scene, _talk
from tools.campaign.waiting import WaitTimeout, until

__all__ = ["cases"]

_libc = ctypes.CDLL(None, use_errno=True)


def _small(folder: Path) -> None:
    """A file system of 64 KiB with room for one page.

    :raises Skip: mounting is not permitted.
    """
    folder.mkdir()
    if _libc.mount(b"tmpfs", str(folder).encode(), b"tmpfs", 0, b"size=64k"):
        raise Skip("small file systems cannot be mounted here")
    (folder / "filler").write_bytes(bytes(60_000))


def _release(folder: Path) -> None:
    _libc.umount2(str(folder).encode(), 2)


class WriteCase(Case):
    """A command that writes one file."""

    unit = "disks"

    def __init__(self, name: str, command: str) -> None:
        self.name = f"disk:{name}"
        self.what = f"{name}, on disks that do not take it"
        self._command = command

    def run(self, batch: Batch) -> None:
        logging.disable()
        result = batch.scratch / "result.json"
        sample = _sample()
        made = Program(batch, ["dexkit", "check", sample, "--result", str(result)])
        if made.wait() not in (0, 1):
            raise RuntimeError(made.output)
        for way in ("full", "limit", "read-only", "missing", "folder", "small"):
            if batch.sample and way != batch.random.choice(("full", "full")):
                continue
            place, limits = self._place(batch, way)
            places = {"out": place, "result": result, "sample": sample}
            words = [word.format(**places) for word in self._command.split()]
            with Program(batch, ["dexkit", *words], limits=limits) as program:
                code = program.wait(120.0)
            batch.units += 1
            about, text = f"{self.name} {way}", f"{code}: {program.output[-1000:]}"
            if program.check_output(batch):
                pass
            elif code is None or code < 0:
                batch.found("exit code", about, text)
            elif code == 0 and (way != "small" or not Path(place).stat().st_size):
                batch.found("reported as done", about, text)
            if way == "small":
                _release(batch.scratch / "small")

    @staticmethod
    def _place(batch: Batch, way: str) -> tuple[str, list[tuple[int, int]]]:
        folder = batch.scratch
        if way == "full":
            return "/dev/full", []
        if way == "limit":
            return str(folder / "limited"), [(resource.RLIMIT_FSIZE, 100)]
        if way == "read-only":
            # root writes where it may not; /proc takes nothing from anybody
            return "/proc/dexkit-campaign", []
        if way == "missing":
            return str(folder / "no" / "such" / "file"), []
        if way == "folder":
            return str(folder), []
        _small(folder / "small")
        return str(folder / "small" / "file"), []


class RecordCase(Case):
    """The recorder, whose disk fills up or whose file goes away."""

    unit = "disks"
    name = "disk:record"
    what = "record, while its disk fills up, its file goes, and two of them"

    def run(self, batch: Batch) -> None:
        logging.disable()
        ways = ("limit", "small", "deleted", "full", "force")
        scene = Scene(batch)
        with _talk(scene):
            for way in ways[:1] if batch.sample else ways:
                try:
                    self._one(batch, scene, way)
                except WaitTimeout as error:
                    batch.found("not ready", f"{self.name} {way}", str(error))
                finally:
                    if way == "small":
                        _release(batch.scratch / "small")

    def _one(self, batch: Batch, scene: Scene, way: str) -> None:
        path = batch.scratch / f"{way}.mcap"
        limits: list[tuple[int, int]] = []
        if way == "limit":
            limits = [(resource.RLIMIT_FSIZE, 4_000)]
        elif way == "small":
            _small(batch.scratch / "small")
            path = batch.scratch / "small" / "x.mcap"
        elif way == "full":
            path = Path("/dev/full")
        elif way == "force":
            self._force(batch, scene, path)
            return
        words = ["dexkit", "record", str(path), "--domain", scene.domain, "--overwrite"]
        with Program(batch, words, limits=limits) as program:
            until(lambda: "ready:" in program.output or not program.running, "the recorder")
            if way == "deleted" and program.running:
                until(lambda: path.exists() and path.stat().st_size > 5000, "something recorded")
                path.unlink()
            # it ends by itself when it cannot write, or goes on and reports it at the end
            with contextlib.suppress(WaitTimeout):
                until(lambda: not program.running, "its end", 5.0)
            program.signal(signal.SIGTERM)
            code = program.wait()
            batch.units += 1
            ended_badly = code is not None and code < 0 and "error:" not in program.output
            if not program.check_output(batch) and (code in (0, None) or ended_badly):
                text = f"{code}: {program.output[-2000:]}"
                batch.found("reported as done", f"{self.name} {way}", text)
            if way != "deleted" or code == 0:
                self._claims(batch, way, path, program.output)

    def _claims(self, batch: Batch, way: str, path: Path, output: str) -> None:
        """Check that it does not report more messages than can be read."""
        from dexkit.traces import open_trace

        claimed = re.search(r"([\d,]+) messages", output)
        if claimed is None or path == Path("/dev/full"):
            return
        readable = 0
        with contextlib.suppress(DexkitError):
            readable = len(list(open_trace(path).messages())) if path.exists() else 0
        claimed_count = int(claimed[1].replace(",", ""))
        if claimed_count > readable:
            batch.found(
                "claims too much",
                f"{self.name} {way}",
                f"{claimed_count} claimed, {readable} readable",
            )

    def _force(self, batch: Batch, scene: Scene, path: Path) -> None:
        """``--overwrite`` on a file that is being recorded: the first one keeps what it has."""
        words = ["dexkit", "record", str(path), "--domain", scene.domain]
        with Program(batch, words) as first:
            until(lambda: path.exists() and path.stat().st_size > 3000, "something recorded")
            with Program(batch, [*words, "--overwrite", "--duration", "1"]) as second:
                second.wait()
                first.signal(signal.SIGTERM)
                code = first.wait()
            batch.units += 1
            for program in (first, second):
                program.check_output(batch)
            if code == 0:
                self._claims(batch, "force", path, first.output)


def _sample() -> str:
    from dexkit.traces import sample_path

    return os.fspath(sample_path("dex1_hand_dropout"))


def cases() -> list[Case]:
    """Everything that writes."""
    return [
        RecordCase(),
        WriteCase("check-result", "check {sample} --result {out}"),
        WriteCase("check-junit", "check {sample} --junit {out}"),
        WriteCase("check-report", "check {sample} --report {out}"),
        WriteCase("report", "report {result} --report {out}"),
        WriteCase("report-markdown", "report {result} --markdown {out}"),
        WriteCase("report-junit", "report {result} --junit {out}"),
        WriteCase("badge", "badge {result} --output {out}"),
        WriteCase("compare", "compare {result} {result} --report {out}"),
    ]
