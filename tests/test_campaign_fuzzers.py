"""Some inputs of the fuzzers of devices, drivers, recordings and sources, with a fixed seed."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tools.campaign.case import Batch, Case, Skip
from tools.campaign.fuzz import Difference, devices, drivers, recordings, sources
from tools.campaign.fuzz.ground import ELSEWHERE, Ground

FOLDERS = sources.cases()
CASES = [*devices.cases(), *drivers.cases(), *recordings.cases(), *FOLDERS]
_SLOW = {"fuzz:mcap"}  # 'make campaign-sample' runs it, too


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=pytest.mark.soak if c.name in _SLOW else pytest.mark.slow)
        for c in CASES
    ],
)
def test_fuzzer_has_no_finding(case: Case, tmp_path: Path) -> None:
    batch = Batch(case.name, "0", 0, tmp_path)
    try:
        case.run(batch)
    except Skip as reason:
        pytest.skip(str(reason))
    assert batch.findings == []
    assert batch.units > 0


def _read(ground: Ground) -> None:
    (ground.root / ELSEWHERE / "secret").read_bytes()


def _read_through_a_link(ground: Ground) -> None:
    (ground.sources / "a" / "link").read_bytes()


def _overwrite(ground: Ground) -> None:
    (ground.root / ELSEWHERE / "secret").write_bytes(b"x")


def _write_beside(ground: Ground) -> None:
    (ground.out / ".." / "x").write_bytes(b"x")


def _write_elsewhere(ground: Ground) -> None:
    (ground.root / ELSEWHERE / "x").write_bytes(b"x")


def _write_into_the_source(ground: Ground) -> None:
    (ground.sources / "a" / "x").write_bytes(b"x")


def _leave_a_temporary_file(ground: Ground) -> None:
    tempfile.mkdtemp()


def _recording_of_nothing(ground: Ground) -> None:
    (ground.out / "x.mcap").write_bytes(b"x")
    ground.read_outputs()


@pytest.mark.parametrize(
    "fault",
    [
        _read,
        _read_through_a_link,
        _overwrite,
        _write_beside,
        _write_elsewhere,
        _write_into_the_source,
        _leave_a_temporary_file,
        _recording_of_nothing,
    ],
)
def test_what_a_command_touches_is_watched(
    fault: Callable[[Ground], object], tmp_path: Path
) -> None:
    links = {"a/link": f"../../{ELSEWHERE}/secret"}
    try:
        ground = Ground(tmp_path, {"a/b": b"1"}, {"secret": b"2"}, links)
    except Skip as reason:
        pytest.skip(str(reason))
    seen = []

    def commands(ground: Ground, top: str, number: int) -> None:
        seen.append((ground.sources / top / "b").read_bytes())

    try:
        ground.run(b"a/b\nchanged", commands)
        with pytest.raises(Difference):
            ground.run(b"a/b\nchanged", lambda ground, top, number: fault(ground))
        # all is as it was before the next input
        ground.run(b"a/b\nagain", commands)
    finally:
        ground.close()
    assert seen == [b"changed", b"again"]
