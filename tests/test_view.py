"""The page of ``dexkit view``: its time line, its tables, and what it shows, without a browser."""

from __future__ import annotations

import importlib.util
import re
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dexkit.cli.view import _skeletons
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.recording_marks import phase_marks, verdict_marks
from dexkit.errors import ExtraMissing, UsageError
from dexkit.hand import MotorError
from dexkit.messages import encode, message_type, unitree_hg
from dexkit.models import DEX3_1
from dexkit.traces import open_trace, sample_path
from dexkit.view.html_tables import hand_table, time_strip, topics_table
from dexkit.view.sources import Recorded
from dexkit.view.transport import Transport
from dexkit.watch import Collector, Mark
from tests.cli_helpers import running
from tests.dds_helpers import dds_domain, wait_until
from tests.patience import PATIENCE
from tests.watch_helpers import closing_hands, ns

if TYPE_CHECKING:
    from dexkit.view.browser_page import Page

__all__ = ["dds_domain"]

# found, not imported: every worker of a run would spend a quarter of a second on it
if importlib.util.find_spec("viser") is None:
    pytest.skip("the page needs viser: pip install 'dexkit[view]'", allow_module_level=True)

# -- the time line ---------------------------------------------------------------------------------


def test_a_live_page_follows_until_it_is_paused() -> None:
    line = Transport(live=True)
    assert line.advance(100.0, 0.0, 5.0) == 5.0
    assert line.following
    line.toggle()
    assert line.advance(101.0, 0.0, 6.0) == 5.0
    line.seek(2.0)
    assert line.advance(102.0, 3.0, 7.0) == 3.0  # the history no longer reaches back to 2 s
    line.toggle()
    assert line.advance(103.0, 3.0, 8.0) == 8.0
    line.step(-1.0)
    assert line.advance(104.0, 3.0, 9.0) == 7.0
    line.restart()
    assert line.advance(105.0, 3.0, 10.0) == 10.0


def test_a_recording_plays_at_its_speed_to_its_end_and_again() -> None:
    line = Transport(live=False, end=10.0)
    assert line.advance(0.0, 0.0, 10.0) == 0.0
    assert line.advance(2.0, 0.0, 10.0) == 2.0
    line.speed = 0.5
    assert line.advance(4.0, 0.0, 10.0) == 3.0
    line.hold()
    assert line.advance(50.0, 0.0, 10.0) == 3.0  # nobody looked meanwhile
    line.speed = 5.0
    assert line.advance(60.0, 0.0, 10.0) == 10.0
    assert line.paused
    line.toggle()
    assert line.advance(60.1, 0.0, 10.0) == pytest.approx(0.5)
    line.seek(99.0)
    assert line.at == 10.0
    line.restart()
    assert (line.at, line.paused) == (0.0, False)
    line.step(1.0)
    assert (line.at, line.paused) == (1.0, True)


# -- tables ----------------------------------------------------------------------------------------


def test_names_from_the_wire_are_escaped() -> None:
    evil = "<img src=x onerror=alert(1)>"
    collector = closing_hands(0.2)
    collector.endpoint("k", "rt/dex3/left/cmd", "writer", evil)
    collector.endpoint("l", f"rt/{evil}", "writer", evil)
    picture = collector.picture(0.1)
    marks = [(0.0, 1.0, "phase", evil), (0.0, 1.0, "fail", evil)]
    for html in (
        hand_table(picture.subjects[0], evil),
        topics_table(picture.topics, evil),
        time_strip(marks, 1.0, 0.5, evil),
    ):
        assert "<img" not in html
        assert "&lt;img" in html


def test_page_shows_faults_and_second_client_of_a_hand() -> None:
    collector = closing_hands(1.0, faults=lambda t: {1: int(MotorError.OVERCURRENT)})
    collector.endpoint("k", "rt/dex3/right/cmd", "writer", "one (pid 1)")
    collector.endpoint("l", "rt/dex3/right/cmd", "writer", "two (pid 2)")
    left, right = collector.picture(0.9).subjects
    html = hand_table(right, "right")
    assert "thumb_1: overcurrent" in html
    assert "commanded by 2: one (pid 1), two (pid 2)" in html
    assert "overcurrent" not in hand_table(left, "left")
    near = replace(left, near=np.array([0, 1, 0, 0, 0, 0, -1]))
    assert "at a limit: thumb_1 upper, index_1 lower" in hand_table(near, "left")
    old = collector.picture(60.0).subjects[0]
    assert "the state is 59.0 s old" in hand_table(old, "left")


# -- marks -----------------------------------------------------------------------------------------


def test_failed_requirements_are_marked_where_they_show() -> None:
    trace = open_trace(sample_path("dex1_hand_dropout"))
    result = judge(Recording.decode(trace))
    marks = verdict_marks(result)
    failed = {r.requirement.id for r in result.results if str(r.verdict) == "fail" and r.evidence}
    assert failed
    assert failed <= {m.title.split()[0] for m in marks}
    assert [m.kind for m in marks] == sorted((m.kind for m in marks), key=lambda k: k != "fail")
    for mark in marks:
        assert trace.first_ns <= mark.time_ns <= mark.end_ns + 1
    assert phase_marks(trace) == []
    titles = {r.requirement.id: r.requirement.title for r in result.results}
    assert all(titles[m.title.split()[0]] in m.title for m in marks if m.kind == "fail")


# -- the page, without a browser -------------------------------------------------------------------


@pytest.fixture
def page() -> Iterator[Page]:
    from dexkit.view.browser_page import Page

    marks = (Mark(ns(0), ns(1), "phase", "step left"), Mark(ns(1), ns(1), "fail", "DEX3-X-01 left"))
    recording = Recorded("one", closing_hands(2.0), marks)
    with Page([recording, Recorded("two", closing_hands(1.0))], port=0) as made:
        yield made


def test_page_shows_the_moment(page: Page) -> None:
    page.step(10.0)
    page.go_to(0, 1.0)
    page.step(11.0)
    first, second = page._shown
    assert first.transport.at == 1.0
    assert "1.00 s" in first.strip.content
    assert "DEX3-X-01 left" in first.strip.content
    assert "left Dex3-1 hand · one" in first.hands_html.content
    assert second.transport.at == 1.0 - 0.01  # it has gone on to its end
    assert len(first.figures) == len(second.figures) == 2
    assert "rt/dex3/right/state" in second.topics_html.content
    assert page._number.options[0] == "dex3/left/cmd  thumb_0 q  #1"
    assert [[c.name for c in chart.curves] for chart in page._charts] == [
        [f"dex3/{side}/{kind}  thumb_0 q  #1" for kind in ("cmd", "state")]
        for side in ("left", "right")
    ]


def test_page_is_bound_to_this_machine_and_to_a_free_port(page: Page) -> None:
    assert page.url == f"http://127.0.0.1:{page.port}"
    with pytest.raises(UsageError, match="cannot be bound"):
        type(page)([Recorded("x", Collector())], port=page.port)


def test_page_asks_nobody_for_a_share_link(page: Page) -> None:
    assert page._server.request_share_url() is None


def test_nothing_on_the_page_can_command_a_hand(
    dds_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client of its WebSocket changes every control to every value that it offers."""
    import msgspec
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    from dexkit.dds import DdsNode
    from dexkit.view.browser_page import Page
    from dexkit.view.sources import Live
    from dexkit.watch.listener import Listener

    topic, kind = "rt/dex3/left/state", message_type(DEX3_1.dialects[0].state_type)
    written: list[object] = []
    with (
        DdsNode(dds_domain) as hand,
        hand.writer(topic, kind) as writer,
        DdsNode(dds_domain) as node,
        Listener(node, Collector()) as listener,
        Page([Live("live", listener)], port=0) as page,
    ):
        monkeypatch.setattr(DdsNode, "writer", lambda *a, **k: written.append(a))

        def arrived() -> bool:
            writer.write_raw(encode(unitree_hg.HandState_([unitree_hg.MotorState_()] * 7)))
            page.step(0.0)
            return "-" not in page._choices and bool(page._choices)

        wait_until(arrived)
        controls = dict(page._server.gui._gui_input_handle_from_uuid)
        named = {uuid: type(c).__name__ for uuid, c in controls.items()}
        assert set(named.values()) == {
            *("GuiButtonGroupHandle", "GuiButtonHandle", "GuiSliderHandle", "GuiDropdownHandle")
        }
        camera = {
            **dict.fromkeys(("position", "look_at", "up_direction"), (0.0, 0.0, 1.0)),
            **dict.fromkeys(("image_height", "image_width"), 100),
            **dict.fromkeys(("fov", "near", "far"), 1.0),
            **{"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0)},
        }
        spoken = Subprotocol(f"viser-v{viser.__version__}")
        url = page.url.replace("http", "ws")
        with connect(url, subprotocols=[spoken], max_size=None) as client:
            client.send(msgspec.msgpack.encode(camera))  # its page is up
            wait_until(page._server.get_clients)
            for uuid, control in controls.items():
                values = getattr(control, "options", None) or [
                    getattr(control, "min", True),
                    getattr(control, "max", True),
                ]
                began = control.update_timestamp
                for value in values:
                    update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                    client.send(msgspec.msgpack.encode(update))
                wait_until(lambda c=control, b=began: c.update_timestamp > b)  # type: ignore[misc]
            wait_until(lambda: page._transports[0].paused)
        endpoints = node.discovery.endpoints()
    assert written == []
    assert {e.topic for e in endpoints if e.kind == "writer"} == {topic}


# -- the command -----------------------------------------------------------------------------------


def test_without_the_package_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "dexkit.view.browser_page", raising=False)
    with pytest.raises(ExtraMissing) as error:
        import dexkit.view.browser_page  # noqa: F401
    assert "dexkit[view]" in error.value.hint


def test_command_serves_the_page_until_it_is_stopped() -> None:
    with running("view", sample_path("dex3_pinch"), "--no-open", "--port", "0") as process:
        url = re.match(r"ready: http://127\.0\.0\.1:(\d+) shows dex3_pinch", process.ready())
        assert url is not None
        connection = HTTPConnection("127.0.0.1", int(url[1]), timeout=PATIENCE)
        connection.request("GET", "/")
        body = connection.getresponse().read()
        connection.close()
        # one file, which names no other place than the name space of SVG
        assert set(re.findall(rb"https?://[^\"' )]*", body)) <= {b"http://www.w3.org/2000/svg"}
        code, out, err = process.end(signal.SIGINT)
    assert (code, err) == (0, "")
    assert out == "stopped\n"


def test_a_urdf_is_for_the_hand_that_has_its_joints(tmp_path: Path) -> None:
    path = tmp_path / "left.urdf"
    path.write_text(
        '<robot name="x"><joint name="left_hand_thumb_0_joint" type="revolute">'
        '<parent link="a"/><child link="b"/></joint></robot>'
    )
    assert list(_skeletons([str(path)])) == [("dex3-1", "left")]
    with pytest.raises(UsageError, match="none of the hand's joints"):
        _skeletons([f"right={path}"])
