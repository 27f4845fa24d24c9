"""Test the tactile areas of Inspire's FTP hands."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.emulators.sim_inspire import SimInspireFtp
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, Side
from dexkit.messages import message_type
from dexkit.messages.inspire import inspire_hand_touch
from dexkit.messages.integer_lists import IntegerLists
from dexkit.models import INSPIRE_FTP, dialect
from dexkit.monitor.bars import UNICODE
from dexkit.monitor.json_lines import json_line
from dexkit.monitor.screen import hand_lines
from dexkit.service import HandService
from dexkit.service.dialects import StateView, dialect_map
from dexkit.traces import open_trace, sample_path
from dexkit.traces.watched import feed
from dexkit.view.html_tables import hand_table
from dexkit.watch import Collector, Picture, SubjectView
from tests.service_helpers import FakeNode, wait_until

FTP = dialect("inspire_ftp")
TOUCH, STATE = message_type(FTP.touch_type), message_type(FTP.state_type)
LENGTHS = {area.member: area.elements for area in FTP.areas}
LEFT, RIGHT = Side.LEFT, Side.RIGHT
N = 6
FULL_SPEED = INSPIRE_FTP.joints[LEFT][0].dq_max

# ------------------------------------------------------------------------------------ on the wire


@given(st.lists(st.integers(-32768, 32767), min_size=1062, max_size=1062))
@settings(max_examples=3, deadline=None)
def test_bulk_encoding_is_that_of_the_codec(values: list[int]) -> None:
    lists = IntegerLists(TOUCH, LENGTHS)
    rest = iter(values)
    message = inspire_hand_touch(**{m: [next(rest) for _ in range(n)] for m, n in LENGTHS.items()})
    assert lists.encode(np.array(values)) == TOUCH.encode(message)


def test_bulk_encoding_keeps_to_the_range_and_the_type() -> None:
    values = np.zeros(1062)
    values[:4] = [1e9, -1e9, np.nan, 1.6]
    assert TOUCH.decode(IntegerLists(TOUCH, LENGTHS).encode(values)).fingerone_tip_touch[:4] == [
        *(32767, -32768, 0, 2)
    ]
    with pytest.raises(UsageError, match="lists of int16"):
        IntegerLists(STATE, {"pos_act": 6})
    with pytest.raises(UsageError, match="lists of int16"):
        IntegerLists(TOUCH, {"palm_touch": 112})


# ---------------------------------------------------------------------------------- the simulated


def felt(hand: SimInspireFtp, state: HandState) -> dict[str, int]:
    """The most that each area that feels something counts."""
    mapping = dialect_map(FTP, {hand.spec.side: hand.spec})
    data = mapping.encode_touch({hand.spec.side: StateView(state, (0,) * N)})
    assert data is not None
    message = TOUCH.decode(data)
    most = {area.place: max(getattr(message, area.member)) for area in FTP.areas}
    return {place: count for place, count in most.items() if count}


def test_only_the_pressing_finger_of_the_simulated_hand_reports_pressure() -> None:
    clock = ManualClock()
    hand = SimInspireFtp(RIGHT, clock=clock, object_at=60.0)
    hand.open()

    def hold(q: list[float], steps: int) -> dict[str, int]:
        for _ in range(steps):
            clock.advance(0.01)
            state = hand.exchange(HandCommand.position(q, dq=[FULL_SPEED] * N))
        return felt(hand, state)

    opened = [0.85] * N
    assert hold(opened, 20) == {}
    for joint, finger in ((0, "pinky"), (3, "index"), (4, "thumb"), (5, "thumb")):
        pose = [0.1 if i == joint else q for i, q in enumerate(opened)]
        assert hold(pose, 100) == {f"{finger} top": 1000, f"{finger} palm": 1000}
        assert hold(opened, 100) == {}


def test_hand_without_contact_reports_no_pressure_at_its_ends() -> None:
    clock = ManualClock()
    hand = SimInspireFtp(LEFT, clock=clock)
    hand.open()
    for q in (0.0, 1.0):
        for _ in range(120):
            clock.advance(0.01)
            state = hand.exchange(HandCommand.position([q] * N, dq=[FULL_SPEED] * N))
        assert felt(hand, state) == {}


# -------------------------------------------------------------------------------------- the service


def test_service_publishes_touch_with_every_second_state() -> None:
    node = FakeNode()
    with HandService(SimInspireFtp(RIGHT), node=node) as service:
        assert service.touch_topic == "rt/inspire_hand/touch/r"
        assert node.types[service.touch_topic] == TOUCH.name
        wait_until(lambda: service.counters.published >= 12)
        topics = [topic for topic, _ in node.sent]
    touched = [i for i, topic in enumerate(topics) if topic == service.touch_topic]
    between = [topics[a:b].count(service.state_topic) for a, b in pairwise(touched)]
    assert set(between) == {2}
    assert len(TOUCH.decode(node.sent[touched[0]][1]).palm_touch) == 112


# ---------------------------------------------------------------------------------- the conformance


def test_viewers_show_a_session_with_goals_alone_and_touch() -> None:
    collector = feed(open_trace(sample_path("inspire_ftp_grip")))
    picture = collector.picture(12.0)
    assert {t.name: (t.role, t.undecodable) for t in picture.topics if "/touch/" in t.name} == {
        FTP.touch_topic_of(side): ("touch", 0) for side in Side
    }
    for view in picture.subjects:
        assert np.isfinite(view.target).all()
        assert np.isfinite(view.q).all()
    felt_by = {view.subject: max(view.touched.values()) for view in picture.subjects}
    assert felt_by[LEFT] == 0
    _, counts = collector.curve(FTP.touch_topic_of(RIGHT), "fingerfour_palm_touch", 0.0, 14.0)
    assert (min(counts), max(counts)) == (0, 1000)


def looked_at(values: dict[str, list[int]]) -> SubjectView:
    """A hand of which one touch message was seen."""
    collector = Collector()
    message = inspire_hand_touch(**{m: [0] * n for m, n in LENGTHS.items()})
    for member, counts in values.items():
        setattr(message, member, counts)
    data = TOUCH.encode(message)
    collector.take(FTP.touch_topic_of(RIGHT), TOUCH.name, [data], [10**9], [10**9])
    (view,) = collector.picture(0.1).subjects
    assert not collector.picture(2.0).subjects[0].touched["palm"] >= 0  # it is old
    return view


def test_viewers_show_the_most_that_each_finger_counts() -> None:
    view = looked_at(
        {
            "fingerone_palm_touch": [0] * 79 + [-3],
            "fingerfour_tip_touch": [7, *[0] * 8],
            "fingerfour_top_touch": [0] * 40 + [812] + [0] * 55,
            "palm_touch": [-5] * 100,  # shorter than it should be
        }
    )
    assert view.touched == {
        **{"pinky": 0.0, "ring": 0.0, "middle": 0.0},
        **{"index": 812.0, "thumb": 0.0, "palm": -5.0},
    }
    lines = [line.plain for line in hand_lines(view, UNICODE, 39)]
    assert lines[-2:] == [
        "touch pinky 0  ring 0  middle 0",
        "      index 812  thumb 0  palm -5",
    ]
    assert "index 812 · thumb 0" in hand_table(view, "right")
    shown = json.loads(json_line(Picture(0.1, (), (view,)), (), 0))["subjects"][0]["touch"]
    assert dict(zip([a.place for a in FTP.areas], shown, strict=True))["index top"] == 812
