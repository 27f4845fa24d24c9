"""The screen of ``dexkit monitor``, its events and its JSON, without a terminal."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dexkit.cli import cli
from dexkit.hand import MotorError
from dexkit.monitor.bars import ASCII, bar
from dexkit.monitor.json_lines import json_line
from dexkit.monitor.keys import keys
from dexkit.monitor.screen import Shown, screen
from dexkit.watch import Collector
from dexkit.watch.events import Event, Events
from tests.each import each
from tests.watch_helpers import STATE, closing_hands, dex3_state, ns

SHOWN = Shown("domain 1 on lo", "12:00:00")
OVERCURRENT = int(MotorError.OVERCURRENT)
nan = math.nan


def text_of(collector: Collector, at: float, width: int, height: int, **more: object) -> list[str]:
    shown = replace(SHOWN, **more)  # type: ignore[arg-type]
    return [line.plain for line in screen(collector.picture(at), [], shown, width, height)]


# -- bars ------------------------------------------------------------------------------------------


@each(
    "q, target, expected",
    [
        (0.0, nan, "[-----#----]"),
        (-1.0, 1.0, "[#----+---o]"[:12]),
        (0.5, 0.5, "[-----+-@--]"),
        (2.0, -2.0, "o-----+----#"),
        (nan, nan, "[-----+----]"),
    ],
)
def test_bar_shows_a_joint_between_its_limits(q: float, target: float, expected: str) -> None:
    found = "".join(text for text, _ in bar(ASCII, 12, -1.0, 1.0, q, target))
    assert len(found) == 12
    assert found == expected


# -- the screen ------------------------------------------------------------------------------------


def test_two_hands_fit_a_small_terminal() -> None:
    collector = closing_hands(1.0, faults=lambda t: {1: OVERCURRENT})
    lines = text_of(collector, 0.5, 80, 24)
    assert len(lines) == 24
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert lines[0].startswith("dexkit monitor  domain 1 on lo  12:00:00")
    assert "left Dex3-1 hand" in lines[1]
    assert "right Dex3-1 hand" in lines[1]
    assert "! thumb_1: overcurrent" in text
    assert "index_1" in text
    assert "rt/dex3/right/state" in text
    assert lines[-1].startswith("q quit")


def test_hidden_lines_are_counted_and_can_be_scrolled_to() -> None:
    collector = closing_hands(1.0)
    narrow = text_of(collector, 0.5, 50, 16)
    assert any("lines below" in line for line in narrow)
    assert not any("right Dex3-1" in line for line in narrow)
    down = text_of(collector, 0.5, 50, 16, scroll=99)
    assert any("lines above" in line for line in down)
    assert any("index_1" in line for line in down)


@given(width=st.integers(1, 200), height=st.integers(1, 60), scroll=st.integers(0, 100))
def test_screen_of_any_size_is_filled(width: int, height: int, scroll: int) -> None:
    lines = text_of(HANDS, 0.1, width, height, scroll=scroll)
    assert len(lines) == height
    assert max(map(len, lines)) <= width


HANDS = closing_hands(0.2)


def test_names_from_dds_cannot_send_escapes_to_the_terminal() -> None:
    evil = "\x1b[2J\x07\nx"
    collector = closing_hands(0.2)
    collector.endpoint("k", "rt/dex3/left/cmd", "writer", evil)
    collector.endpoint("l", f"rt/{evil}", "writer", evil)
    told = [("12:00:00", Event(0.0, "bad", evil))]
    for line in screen(collector.picture(0.1), told, replace(SHOWN, title=evil), 100, 40):
        assert line.plain.isprintable()


# -- events ----------------------------------------------------------------------------------------


def test_a_change_is_reported_once() -> None:
    collector = closing_hands(4.0, faults=lambda t: {1: OVERCURRENT} if 1.0 < t < 2.0 else {})
    collector.endpoint("k", "rt/dex3/left/cmd", "writer", "xr (pid 7)")
    events = Events(collector)
    found = [
        e.text
        for at in (0.5, 0.6, 1.5, 1.6, 2.5, 9.0)
        for e in events.update(collector.picture(at))
    ]
    hand = [text for text in found if text.startswith("right Dex3-1 hand")]
    assert hand == [
        "right Dex3-1 hand: states come",
        "right Dex3-1 hand: commands come",
        "right Dex3-1 hand: thumb_1: overcurrent",
        "right Dex3-1 hand: thumb_1: overcurrent is over",
        "right Dex3-1 hand: no state for 5.0 s",
        "right Dex3-1 hand: no command for 5.0 s",
    ]
    assert "rt/dex3/left/cmd: published by xr (pid 7)" in found
    assert "left Dex3-1 hand: commanded by xr (pid 7)" in found
    collector.endpoint("l", "rt/dex3/left/cmd", "writer", "?")
    assert [e.text for e in events.update(collector.picture(9.0))] == [
        "rt/dex3/left/cmd: published by xr (pid 7), a process without a name"
    ]
    collector.endpoint_gone("k")
    collector.endpoint_gone("l")
    (last,) = events.update(collector.picture(9.0))
    assert (last.kind, last.text) == ("warn", "rt/dex3/left/cmd: nobody publishes it any more")


def test_gaps_and_broken_messages_are_reported() -> None:
    collector = Collector()
    times = [i * 0.01 for i in range(100)]
    late = [1.5 + i * 0.01 for i in range(10)]
    events = Events(collector)
    for some, payload in (
        (times, dex3_state([0.0] * 7)),
        (late, dex3_state([0.0] * 7)),
        ([1.6], b"x"),
    ):
        stamps = [ns(t) for t in some]
        collector.take("rt/dex3/left/state", STATE, [payload] * len(some), stamps, stamps)
        found = [e.text for e in events.update(collector.picture(collector.last))]
    assert found == ["rt/dex3/left/state: 1 messages cannot be decoded"]
    assert "rt/dex3/left/state: a gap of up to 0.5 s, 50 cycles missed" in [
        e.text for e in events.recent
    ]


# -- JSON and keys ---------------------------------------------------------------------------------


def test_json_has_no_nan() -> None:
    collector = closing_hands(0.2)
    collector.take("rt/dex3/left/state", STATE, [dex3_state([nan] * 7)], [ns(0.3)], [ns(0.3)])
    events = [Event(0.2, "bad", "x")]
    line = json_line(collector.picture(0.3), events, 5)
    assert "\n" not in line
    told = json.loads(line, parse_constant=lambda name: 1 / 0)
    assert told["time_ns"] == 5
    left = told["subjects"][0]
    assert (left["subject"], left["model"], left["q"][0]) == ("left", "dex3-1", None)
    assert len(left["target"]) == len(left["joints"]) == 7
    assert told["topics"][1]["topic"] == "rt/dex3/left/state"
    assert told["events"] == [{"kind": "bad", "text": "x", "ago": 0.1}]


@each(
    "data, expected",
    [
        (b"q", ["q"]),
        (b" r\x1b[A\x1bOBc", [" ", "r", "up", "down", "c"]),
        (b"\x1b[5~\x1b[6~\x0c", ["page up", "page down", "\x0c"]),
        (b"\x1b[?1;2c\x1b\xc3\xa4", []),
    ],
)
def test_terminal_bytes_are_decoded_to_keys(data: bytes, expected: list[str]) -> None:
    assert keys(data) == expected


def test_a_log_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.touch()
    result = CliRunner().invoke(cli, ["monitor", "--record", str(path)])
    assert "a.mcap exists" in str(result.exception)
