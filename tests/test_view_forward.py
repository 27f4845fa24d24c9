"""Hands in other people's viewers: what they are sent is what the recording holds."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from dexkit.cli.view import command, recorded
from dexkit.errors import UsageError
from dexkit.traces import open_trace, sample_path
from dexkit.view.forward import RATE, Moment, forward
from dexkit.view.sources import Source
from tests.patience import PATIENCE


class Kept:
    """A viewer that keeps what it is shown."""

    def __init__(self, most: int | None = None) -> None:
        self.shown: list[tuple[int, list[Moment]]] = []
        self.stop = threading.Event()
        self._most = most

    def show(self, time_ns: int, moments: Sequence[Moment]) -> None:
        self.shown.append((time_ns, list(moments)))
        if self._most is not None and len(self.shown) >= self._most:
            self.stop.set()


def pinch() -> Source:
    return recorded(sample_path("dex3_pinch"), judge=False)


def test_a_recording_is_shown_to_its_end_30_times_a_second() -> None:
    source, viewer = pinch(), Kept()
    progress: list[tuple[float, float]] = []
    forward([source], viewer, viewer.stop, paced=False, progress=lambda *p: progress.append(p))
    times = np.array([t for t, _ in viewer.shown])
    end = source.poll()
    assert len(times) == int(np.ceil(end * RATE)) + 1
    assert np.diff(times[:-1]) == pytest.approx(1e9 / RATE, abs=1)
    assert times[-1] == source.collector.origin_ns + round(end * 1e9)
    assert progress[-1] == (end, end)
    time_ns, moments = viewer.shown[len(times) // 2]
    seen = source.collector.picture((time_ns - source.collector.origin_ns) / 1e9)
    assert [m.name for m in moments] == ["left_hand", "right_hand"]
    for moment, view in zip(moments, seen.subjects, strict=True):
        names = [j.name for j in view.joints]
        assert moment.numbers()["q"] == dict(zip(names, view.q.tolist(), strict=True))
        assert moment.drawn.bodies.shape == (len(moment.sizes), 4, 4)
        assert len(moment.drawn.elements) == len(moment.drawn.element_colors) == 33
        # a rigid motion of the skeleton: distances stay
        placed = moment.placed(moment.drawn.bodies)[:, :3, 3]
        own = moment.drawn.bodies[:, :3, 3]
        assert np.linalg.norm(np.diff(placed, axis=0), axis=1) == pytest.approx(
            np.linalg.norm(np.diff(own, axis=0), axis=1)
        )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--allow-origin", "*"), "no origin"),
        (("--rerun", "x.rrd", "--allow-origin", "http://a"), "does not"),
    ],
)
def test_origins_that_cannot_be_allowed_are_refused(options: tuple[str, ...], said: str) -> None:
    pytest.importorskip("viser")
    result = CliRunner().invoke(command, [str(sample_path("dex3_pinch")), "--no-open", *options])
    assert isinstance(result.exception, UsageError)
    assert said in str(result.exception)


# the SDKs are large, and not among the tools of this project: pip install 'dexkit[rerun,foxglove]'


@pytest.mark.soak
def test_rerun_reads_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    out = tmp_path / "pinch.rrd"
    result = CliRunner().invoke(command, [str(sample_path("dex3_pinch")), "--rerun", str(out)])
    assert result.exit_code == 0, result.output
    assert [p.name for p in tmp_path.iterdir()] == ["pinch.rrd"]
    entities: dict[str, int] = {}
    for chunk in RrdReader(str(out)).stream():
        entities[chunk.entity_path] = entities.get(chunk.entity_path, 0) + chunk.num_rows
    frames = entities["/left_hand/q/thumb_0"]
    assert frames == entities["/scene/right_hand/bodies"]
    trace = open_trace(sample_path("dex3_pinch"))
    assert frames == pytest.approx((trace.last_ns - trace.first_ns) / 1e9 * RATE, abs=2)


@pytest.mark.soak
def test_foxglove_is_sent_scene_and_numbers() -> None:
    pytest.importorskip("foxglove")
    client = pytest.importorskip("websockets.sync.client")
    from dexkit.view.foxglove_viewer import SCENE, FoxgloveViewer, numbers_topic

    source, stop = pinch(), threading.Event()
    with closing(FoxgloveViewer("127.0.0.1", 0)) as viewer:
        thread = threading.Thread(target=forward, args=([source], viewer, stop))
        thread.start()
        try:
            with client.connect(viewer.url, subprotocols=["foxglove.sdk.v1"]) as socket:
                channels: dict[str, int] = {}
                numbers: dict[str, Any] = {}
                wanted = {SCENE, numbers_topic("left_hand"), numbers_topic("right_hand")}
                deadline = time.monotonic() + PATIENCE
                while not numbers:
                    assert time.monotonic() < deadline
                    message = socket.recv(PATIENCE)
                    if isinstance(message, str):
                        text = json.loads(message)
                        for channel in text.get("channels", []):
                            channels[channel["topic"]] = channel["id"]
                        if text["op"] == "advertise" and wanted <= set(channels):
                            subscriptions = [
                                {"id": i, "channelId": channels[t]}
                                for i, t in enumerate(sorted(wanted))
                            ]
                            socket.send(
                                json.dumps({"op": "subscribe", "subscriptions": subscriptions})
                            )
                    elif message[0] == 1 and message[13:14] == b"{":
                        numbers = json.loads(message[13:])
        finally:
            stop.set()
            thread.join(PATIENCE)
    assert set(numbers) >= {"q", "dq", "tau_est", "pressure", "faults"}
    assert len(numbers["q"]) == 7


@pytest.mark.soak
def test_foxglove_is_read_by_allowed_pages_only() -> None:
    pytest.importorskip("foxglove")
    client = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import InvalidStatus

    from dexkit.view.foxglove_viewer import ORIGINS, FoxgloveViewer

    with closing(FoxgloveViewer("127.0.0.1", 0, ["https://viewer.example"])) as viewer:
        for origin in (None, *ORIGINS, "https://viewer.example"):
            with client.connect(
                viewer.url, subprotocols=["foxglove.sdk.v1"], origin=origin
            ) as socket:
                assert json.loads(socket.recv(PATIENCE))["op"] == "serverInfo"
        for origin in ("http://evil.example", "null", "https://app.foxglove.dev.evil.example"):
            with pytest.raises(InvalidStatus, match="403"):
                client.connect(viewer.url, subprotocols=["foxglove.sdk.v1"], origin=origin)
