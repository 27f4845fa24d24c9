"""On a disk that is full no command ends with a traceback, or leaves a part under the name."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest

from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions.edit import Span, cut
from tests.session_helpers import dexkit

LIMIT = 20_000
"""Bytes that a file can take, as if the disk had no more; there is no disk to be filled."""


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("part") / "part.mcap"
    trace = open_trace(sample_path("dex3_pinch"))
    begin = trace.first_ns + 5 * 10**9
    cut(trace, out, spans=[Span(begin, begin + 10**9 // 2)])
    return out


COMMANDS = {
    "sqlite3": ("export", "{source}", "--to", "rosbag2", "--out", "{out}"),
    "mcap": ("export", "{source}", "--to", "rosbag2", "--set", "storage=mcap", "--out", "{out}"),
    "parquet": ("export", "{source}", "--to", "parquet", "--out", "{out}"),
    "csv": ("export", "{source}", "--to", "csv", "--out", "{out}"),
    "lerobot": ("export", "{source}", "--to", "lerobot", "--out", "{out}"),
    "episodes": ("export", "{source}", "--to", "episodes", "--out", "{out}"),
    "cut": ("cut", "{source}", "{out}.mcap"),
    "merge": ("merge", "{source}", "{source}", "{out}.mcap"),
    "import": ("import", "{bag}", "{out}.mcap"),
}


@pytest.fixture(scope="module")
def bag(part: Path) -> Path:
    out = part.with_name("bag")
    assert dexkit("export", part, "--to", "rosbag2", "--out", out)[0] == 0
    return out


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_told_and_leaves_nothing(
    tmp_path: Path, part: Path, bag: Path, name: str
) -> None:
    folder = tmp_path / "full"
    folder.mkdir()
    words = [w.format(source=part, bag=bag, out=folder / "x") for w in COMMANDS[name]]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, hard))
    try:
        code, output = dexkit(*words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 2, output
    assert "cannot write" in output
    assert list(folder.iterdir()) == []
