"""Curves of recordings: sparklines, the pages of ``info``, ``diff`` and ``compare``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.cli.info_plot import plot_lines
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.result_file import write_json
from dexkit.conformance.report.curves import page, recorded
from dexkit.digests import sha256_of_file
from dexkit.messages import message_type
from dexkit.sparkline import ASCII, sparkline
from dexkit.traces import Recorder, Trace, open_trace
from tests.watch_helpers import COMMAND, STATE, dex3_command, dex3_state, ns


def test_sparkline_shows_values_on_their_scale() -> None:
    values = np.array([0.0, 0.5, 1.0, np.nan, 2.0, -1.0])
    assert sparkline(values, 0.0, 1.0, ASCII) == "_+@ @_"
    assert sparkline(np.array([3.0]), 3.0, 3.0, ASCII) == "_"


def trace_of(path: Path, shift: float, reach: float) -> Trace:
    """A left Dex3-1 that follows its commands for two seconds."""
    with Recorder(path) as recorder:
        for i in range(200):
            t = i * 0.01
            q = [reach * np.sin(3 * t)] * 7
            at = ns(shift + t)
            recorder.put("rt/dex3/left/state", STATE, dex3_state(q), at, at)
            recorder.put("rt/dex3/left/cmd", COMMAND, dex3_command([0.5 * v for v in q]), at, at)
    return open_trace(path)


@pytest.fixture(scope="module")
def traces(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trace, Trace]:
    folder = tmp_path_factory.mktemp("curves")
    return trace_of(folder / "a.mcap", 0.0, 0.5), trace_of(folder / "b.mcap", 7.0, 0.4)


def test_joints_and_rates_are_drawn_in_the_terminal(traces: tuple[Trace, Trace]) -> None:
    lines = plot_lines(traces[0], 80, ASCII)
    assert max(map(len, lines)) <= 80
    (q,) = (line for line in lines if line.startswith("left thumb_1 q"))
    assert "@" in q
    assert q.endswith("-0.50 to 0.50 rad")
    (rate,) = (line for line in lines if line.startswith("rt/dex3/left/state"))
    assert rate.endswith(" Hz")


def test_recordings_are_drawn_beside_each_other_on_equal_axes(
    traces: tuple[Trace, Trace],
) -> None:
    text = page([recorded(trace) for trace in traces])
    assert text.count("thumb_2: command and state") >= 2
    assert text.count('class="beside"') == 7 + 2  # joints and topics
    assert "<script" not in text


def test_info_takes_several_files_and_writes_a_page(
    traces: tuple[Trace, Trace], tmp_path: Path
) -> None:
    a, b = (str(t.path) for t in traces)
    runner = CliRunner()
    out = tmp_path / "page.html"
    result = runner.invoke(cli, ["info", a, b, "--json", "--html", str(out)])
    assert result.exit_code == 0
    told = json.JSONDecoder().raw_decode(result.output)[0]
    assert [Path(each["file"]).name for each in told] == ["a.mcap", "b.mcap"]
    assert "<title>a.mcap, b.mcap</title>" in out.read_text()
    plotted = runner.invoke(cli, ["info", a, "--plot"])
    assert "left thumb_1 q" in plotted.output
    refused = runner.invoke(cli, ["info", a, "--html", a])
    assert "is also an input" in str(refused.exception)


def test_diff_draws_the_largest_differences_first(
    traces: tuple[Trace, Trace], tmp_path: Path
) -> None:
    a, b = (str(t.path) for t in traces)
    out = tmp_path / "diff.html"
    result = CliRunner().invoke(cli, ["diff", a, b, "--html", str(out)])
    assert "they differ" in result.output
    text = out.read_text()
    # states differ by 0.1 rad, commands by half of it
    assert text.index("thumb_1</b> state: rms") < text.index("thumb_1</b> command: rms")
    assert "B is +7.0000 s later than A" in text


def test_diff_says_why_recordings_without_a_common_joint_differ(
    traces: tuple[Trace, Trace], tmp_path: Path
) -> None:
    """A page without a curve has the reason."""
    out, other = tmp_path / "diff.html", tmp_path / "other.mcap"
    kind = message_type("unitree_go::msg::dds_::MotorStates_")
    payload = kind.encode(kind.of_motors([kind.motor_type.cls()]))
    with Recorder(other) as recorder:
        for i in range(100):
            at = traces[0].first_ns + 10_000_000 * i
            recorder.put("rt/dex1/left/state", kind.name, payload, at)
    result = CliRunner().invoke(
        cli, ["diff", str(traces[0].path), str(other), "--offset", "0", "--html", str(out)]
    )
    for text in (result.output, out.read_text()):
        assert "hey differ: only A has rt/dex3/left/" in text
        assert "no joint could be compared" in text


def test_diff_of_recordings_years_apart_draws_each_on_its_own_time(
    traces: tuple[Trace, Trace], tmp_path: Path
) -> None:
    """And not a curve of the years between them."""
    out, later = tmp_path / "diff.html", tmp_path / "later.mcap"
    years = 20 * 365 * 86_400 * 10**9
    with Recorder(later) as recorder:
        for topic, some in traces[0].load().items():
            for at, payload in zip(some.log_time_ns, some.payloads, strict=True):
                recorder.put(topic, some.type_name, payload, int(at) + years)
    result = CliRunner().invoke(
        cli, ["diff", str(traces[0].path), str(later), "--offset", "0", "--html", str(out)]
    )
    assert "no joint could be compared" in result.output
    assert out.stat().st_size < 1_000_000


def test_compare_draws_recordings_that_were_judged(
    traces: tuple[Trace, Trace], tmp_path: Path
) -> None:
    few = select(catalogue("dex3-1", None), prefixes=["DEX3-TOPIC-01"])
    results = []
    for trace in traces:
        path = tmp_path / trace.path.name
        path.write_bytes(trace.path.read_bytes())
        subject = {"recording": path.name, "recording_sha256": sha256_of_file(path)}
        view = recording_of(open_trace(path), None, ())
        result = judge(view, requirements=few, subject=subject)
        results.append(tmp_path / f"{path.stem}.json")
        write_json(result, results[-1])
    out = tmp_path / "compare.html"
    arguments = ["compare", *map(str, results), "--html", str(out)]
    CliRunner().invoke(cli, arguments)
    assert "What they did" in out.read_text()
    (tmp_path / "b.mcap").write_bytes(b"another")
    CliRunner().invoke(cli, arguments)
    assert "Not beside its result: the recording of" in out.read_text()
