"""Offline checks: how many times faster than real time a recording is judged, on one core."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks import Result
from dexkit.conformance.judge import judge
from dexkit.conformance.view import Recording
from dexkit.traces import Recorder, open_trace, sample_path

_TARGET = 200.0
_SAMPLES = {"Dex1-1": ("dex1_pick_place", 600.0), "Dex3-1": ("dex3_pinch", 120.0)}
"""Sessions, and the seconds that are made of them."""


def run() -> list[Result]:
    return [
        result
        for title, (sample, seconds) in _SAMPLES.items()
        for result in _both(title, sample, seconds)
    ]


def _both(title: str, sample: str, wanted: float) -> list[Result]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        _repeat(sample, path, wanted)
        seconds = open_trace(path).duration
        command = [sys.executable, "-m", "dexkit", "check", str(path)]
        return [
            _result(title, "in process", seconds, _one_core(lambda: _judge(path))),
            _result(
                title,
                "whole process",
                seconds,
                _one_core(lambda: subprocess.run(command, stdout=subprocess.DEVNULL)),
            ),
        ]


def _result(title: str, how: str, seconds: float, taken: float) -> Result:
    ratio = seconds / taken
    return Result(
        f"dexkit check, {title}, {how}",
        ratio,
        "times real time",
        f"{_TARGET:g} times real time",
        _TARGET,
        ratio / _TARGET,
        f">= {_TARGET:g}" if title == "Dex1-1" else "",
        ratio >= _TARGET if title == "Dex1-1" else None,
        f"{seconds:.0f} s of both hands in {taken:.1f} s of processor time on one core",
    )


def _repeat(sample: str, path: Path, seconds: float) -> None:
    """A long recording: a genuine session again and again."""
    trace = open_trace(sample_path(sample))
    messages = list(trace.messages())
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


def _judge(path: Path) -> None:
    assert judge(Recording.of(open_trace(path))).judged


def _one_core(work: Callable[[], object]) -> float:
    """Processor time that it takes, seconds, its children's included: others may be busy."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        begin = _processor_time()
        work()
        return _processor_time() - begin
    finally:
        os.sched_setaffinity(0, cores)


def _processor_time() -> float:
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system
