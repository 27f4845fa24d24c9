"""Offline checks: how many times faster than real time a recording is judged, on one core.

By processor time, for others may use the machine. The whole process is ``dexkit check`` from its
start to its end, with the bytecode that an installation has; in process is what it does between.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks import Result
from dexkit.conformance.hands.dex1 import DEX1_1
from dexkit.conformance.hands.dex3 import DEX3_1
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.traces import Recorder, open_trace, sample_path

_TARGET = 200.0
_HANDS = (DEX1_1, DEX3_1)
_LENGTHS = (600.0, 60.0)
"""Seconds that are made of a session. Of a minute Python itself and numpy take a good part."""


class _Spent(NamedTuple):
    seconds: float
    peak_mb: float


def run() -> list[Result]:
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(cores)})
        try:
            floor = _process(folder, "-c", "import numpy").seconds
            for hand in _HANDS:
                title, sample = hand.model.title.partition(" ")[0], str(hand.session)
                judge(Recording.decode(open_trace(sample_path(sample))))  # loads what it needs
                for wanted in _LENGTHS:
                    path = Path(folder) / f"{sample}_{wanted:g}.mcap"
                    _repeat(sample, path, wanted)
                    results += _both(title, path, folder, floor)
        finally:
            os.sched_setaffinity(0, cores)
    return results


def _both(title: str, path: Path, folder: str, floor: float) -> list[Result]:
    length = open_trace(path).duration
    whole = _process(folder, "-m", "dexkit", "check", str(path))
    begin = os.times()
    assert judge(Recording.decode(open_trace(path))).judged
    end = os.times()
    inside = end.user + end.system - begin.user - begin.system
    about = f"{length:.0f} s of both hands"
    short = length < _LENGTHS[0] / 2
    name = f"dexkit check, {title}, {'a minute' if short else 'ten minutes'}"
    note = f"{about} in {whole.seconds:.2f} s, of which Python and numpy {floor:.2f} s; at most "
    return [
        _result(f"{name}, in process", length, inside, f"{about} in {inside:.2f} s"),
        _result(
            f"{name}, whole process",
            length,
            whole.seconds,
            f"{note}{whole.peak_mb:.0f} MB",
            bound=not short,
        ),
    ]


def _result(name: str, length: float, taken: float, note: str, *, bound: bool = True) -> Result:
    ratio = length / taken
    return Result(
        name,
        ratio,
        "times real time",
        f"{_TARGET:g} times real time",
        _TARGET,
        ratio / _TARGET,
        f">= {_TARGET:g}" if bound else "",
        ratio >= _TARGET if bound else None,
        f"{note} (processor time on one core)",
    )


def _process(folder: str, *arguments: str) -> _Spent:
    """What Python needs for it, the second time, its modules compiled."""
    variables = {**os.environ, "PYTHONPYCACHEPREFIX": folder}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    for _ in range(2):
        process = subprocess.Popen(
            [sys.executable, *arguments], env=variables, stdout=subprocess.DEVNULL
        )
        peak = 0.0
        # the usage of a child counts the peak of who started it, too
        while not (found := os.wait4(process.pid, os.WNOHANG))[0]:
            peak = max(peak, _peak_mb(process.pid))
            time.sleep(0.02)
        _, status, usage = found
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode in (0, 1), arguments
    return _Spent(usage.ru_utime + usage.ru_stime, peak)


def _peak_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return max((int(x.split()[1]) / 1024 for x in lines if x.startswith("VmHWM")), default=0.0)


def _repeat(sample: str, path: Path, seconds: float) -> None:
    """A long recording: a genuine session again and again, while its client sends."""
    trace = open_trace(sample_path(sample))
    messages = list(trace.messages())
    sent = [m.log_time_ns for m in messages if m.topic.endswith("/cmd")]
    messages = [m for m in messages if sent[0] <= m.log_time_ns <= sent[-1]]
    length = messages[-1].log_time_ns - messages[0].log_time_ns + 2_000_000
    with Recorder(path, max_messages=10_000_000, max_bytes=2**33) as recorder:
        for turn in range(round(seconds * 1e9 / length)):
            for m in messages:
                later = turn * length
                recorder.put(
                    m.topic, m.type_name, m.data, m.log_time_ns + later, m.publish_time_ns + later
                )
        recorder.add_metadata("dds_endpoints", trace.metadata["dds_endpoints"])
    assert not recorder.dropped
