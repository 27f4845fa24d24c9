"""What the benchmarks show: 80 columns in a terminal, and the trend over the saved runs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from benchmarks import Result
from benchmarks.show import page, saved, terminal_lines

LONG = Result(
    "decoding a state of a hand with all its sensors, as it comes from the wire, in a batch",
    1234567.0, "messages/s", "another library that has quite a long name, version 1.2.3",
    3456.0, 357.2, "at least twice as many as the other library", False, "with a remark " * 12,
)  # fmt: skip
SHORT = Result("encode <fast>", 2.0, "us", "peer", 4.0, 2.0, "twice", True)


def test_terminal_lines_fit_80_columns() -> None:
    lines = [line.plain for line in terminal_lines([LONG, SHORT])]
    assert max(map(len, lines)) <= 80
    assert lines[0].endswith("357.20 x missed")
    assert any(line.endswith("2.00 x    met") for line in lines)
    assert "  peer: 4 us; target: twice" in lines


def test_page_has_the_newest_figure_and_the_trend(tmp_path: Path) -> None:
    for name, ratio in (("20260101-000000", 1.5), ("20260102-000000", 2.0)):
        row = {"benchmark": "codec", **dataclasses.asdict(dataclasses.replace(SHORT, ratio=ratio))}
        about = {"python": "3.10", "machine": "x", "cores": 2, "results": [row]}
        (tmp_path / f"{name}.json").write_text(json.dumps(about))
    (tmp_path / "20260103-000000.json").write_text("{")
    runs = saved(tmp_path)
    assert [run.name for run in runs] == ["20260101-000000", "20260102-000000"]
    text = page(runs)
    assert "encode &lt;fast&gt;: ratio in each run" in text
    assert text.count(">2.00<") == 1
    assert "<script" not in text
