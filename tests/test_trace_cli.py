"""``dexkit info``, ``record`` and ``replay``."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from dexkit.traces import open_trace, sample_path
from tests.cli_helpers import running
from tests.dds_helpers import free_domain
from tests.session_helpers import dexkit
from tests.trace_helpers import (
    CMD,
    CMD_TYPE,
    STATE,
    STATE_TYPE,
    cmd,
    mcap_bytes,
    state,
    write,
)

RIGHT = "rt/dex1/right/cmd"


# -- info ------------------------------------------------------------------------------------------


def test_info_prints_topics_rates_and_gaps() -> None:
    code, output = dexkit("info", sample_path("dex1_hand_dropout"))
    assert code == 0
    (line,) = [x for x in output.splitlines() if x.startswith("rt/dex1/left/state")]
    assert line.split()[1:] == (
        ["8,998", "461.5", "2.00", "2.28", "1502.3", "0.00", "unitree_go", "MotorStates_", "omgidl"]
    )
    assert "controller_commit" in output
    assert "complete" in output


def test_info_as_json() -> None:
    data = json.loads(dexkit("info", "--json", sample_path("dex3_pinch"))[1])
    assert data["messages"] == 23165
    assert data["truncated"] is False
    assert data["duration_s"] == pytest.approx(19.494, abs=0.001)
    topics = {row["topic"]: row for row in data["topics"]}
    assert topics["rt/dex3/left/cmd"]["mean_hz"] == pytest.approx(99.0, abs=0.05)
    assert topics["rt/dex3/left/cmd"]["type"] == "unitree_hg::msg::dds_::HandCmd_"
    assert {e["reliability"] for e in data["endpoints"] if e["kind"] == "writer"} == {"reliable"}


def test_info_refuses_other_files(tmp_path: Path) -> None:
    code, output = dexkit("info", write(tmp_path / "a.mcap", b"SQLite format 3\0" + bytes(50)))
    assert code == 2
    assert "not an mcap file" in output
    assert "convert" in output


# -- record and replay, between processes ----------------------------------------------------------


def test_a_replayed_session_is_recorded_as_it_was(tmp_path: Path) -> None:
    """Sample -> replay (process 1) -> DDS -> record (process 2): same bytes, no faster."""
    domain = free_domain()
    # 2 s out of the middle, so that the test is short
    source = open_trace(sample_path("dex1_pick_place"))
    start = source.first_ns + 3_000_000_000
    part = [
        (m.topic, m.log_time_ns, m.publish_time_ns, m.data)
        for m in source.messages([CMD, RIGHT])
        if start <= m.log_time_ns < start + 2_000_000_000
    ]
    clip = write(tmp_path / "clip.mcap", mcap_bytes(part, types={CMD: CMD_TYPE, RIGHT: CMD_TYPE}))
    out = tmp_path / "out.mcap"
    options = ("--domain", domain)
    with running("record", out, "--topic", "/dex1/left/cmd", "--topic", RIGHT, *options) as rec:
        rec.ready()
        code, output = dexkit("publish", clip, *options)
        assert code == 0, output
        code, stdout, stderr = rec.end(signal.SIGINT)
        assert code == 0, stderr
    assert f"sent {len(part)} messages" in output
    assert f"{len(part)} messages" in stdout
    assert "0 dropped" in stdout
    trace = open_trace(out)
    assert (trace.truncated, trace.warnings) == (False, [])
    original = open_trace(clip).load()
    for topic, samples in trace.load().items():
        assert samples.payloads == original[topic].payloads
        # a busy machine sends late, which a benchmark measures, but nothing makes it send early
        assert np.ptp(samples.log_time_ns) > 0.8 * np.ptp(original[topic].log_time_ns)
        assert (samples.log_time_ns > samples.publish_time_ns).all()
    for channel in trace.channels:
        assert channel.schema_encoding == "ros2msg"
        assert channel.metadata["qos.reliability"] == "reliable"
        assert channel.metadata["dds.domain"] == str(domain)
    writers = {e.topic: e for e in trace.endpoints if e.kind == "writer"}
    assert sorted(writers) == [CMD, RIGHT]
    assert (writers[CMD].reliability, writers[CMD].history) == ("reliable", "KeepLast(depth=1)")
    assert writers[CMD].type_name == CMD_TYPE


def test_record_finds_topics_that_appear_later_and_ends_on_sigterm(tmp_path: Path) -> None:
    from dexkit.dds import DdsNode

    domain = free_domain()
    out = tmp_path / "out.mcap"
    with running("record", out, "--domain", domain) as rec, DdsNode(domain) as node:
        rec.ready()
        for topic, kind, data in ((STATE, STATE_TYPE, state(1.0)), ("rt/any", CMD_TYPE, cmd(2.0))):
            writer = node.writer(topic, kind)
            assert writer.wait_matched(60)
            for _ in range(10):
                writer.write_raw(data)
                time.sleep(0.005)
        code, _, stderr = rec.end(signal.SIGTERM)
        assert code == 0, stderr
    trace = open_trace(out)
    assert trace.topics == ["rt/any", STATE]
    assert trace.samples("rt/any").payloads[-1] == cmd(2.0)
    assert len(trace.samples(STATE)) == 10


def test_record_lists_endpoints_when_no_message_came(tmp_path: Path) -> None:
    from dexkit.dds import DdsNode

    domain = free_domain()
    out = tmp_path / "out.mcap"
    with DdsNode(domain) as node:
        node.writer(STATE, STATE_TYPE)
        code, output = dexkit("record", out, "--topic", CMD, "--domain", domain, "--duration", "1")
    assert code == 1
    assert f"domain {domain}, lo" in output
    assert CMD in output
    assert f"{STATE} ({STATE_TYPE})" in output
    assert not out.exists()


def test_publish_refuses_other_publishers_on_its_topics() -> None:
    from dexkit.dds import DdsNode

    domain = free_domain()
    sample = sample_path("dex1_pick_place")
    with DdsNode(domain) as node:
        node.writer(RIGHT, CMD_TYPE)
        code, output = dexkit("publish", sample, "--wait", 0, "--domain", domain)
        assert code == 1
        assert f"already publishes {RIGHT} on domain {domain}" in output
        forced = ("--wait", 0, "--force", "--pace", 40, "--domain", domain)
        code, output = dexkit("publish", sample, *forced)
    assert code == 0, output
    assert "sent 8052 messages" in output


@pytest.mark.parametrize(("options", "code"), [((), 130), (("--loop",), 0)])
def test_an_interrupted_publisher_ends_cleanly(options: tuple[str, ...], code: int) -> None:
    with running(
        "publish", sample_path("dex1_pick_place"), "--wait", 0, *options, "--domain", free_domain()
    ) as process:
        process.line_out()  # what it is going to send
        process.ready()
        ended, stdout, stderr = process.end(signal.SIGINT)
    assert ended == code
    assert "sent" in stdout
    assert stderr == ""
