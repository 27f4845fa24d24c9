"""Test the tactile areas of Inspire's FTP hands, and what the doctor says of these hands."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.clock import ManualClock
from dexkit.conformance.faults import plan_for
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.virtual.inspire import FtpService
from dexkit.conformance.virtual.topic_run import run_virtual
from dexkit.doctor.observations import DomainView, Endpoint, Observations, Participant, Stream
from dexkit.doctor.rules import diagnose
from dexkit.emulators.sim_inspire import SimInspireFtp
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, Side
from dexkit.messages import message_type
from dexkit.messages.inspire import inspire_hand_touch
from dexkit.messages.integer_lists import IntegerLists
from dexkit.models import INSPIRE_FTP, Dialect, dialect
from dexkit.monitor.bars import UNICODE
from dexkit.monitor.json_lines import json_line
from dexkit.monitor.screen import hand_lines
from dexkit.service import HandService
from dexkit.service.dialects import StateView, dialect_map
from dexkit.traces import open_trace, sample_path
from dexkit.traces.sessions.streams import _streams
from dexkit.traces.watched import feed
from dexkit.view.html_tables import hand_table
from dexkit.watch import Collector, Picture, SubjectView
from dexkit.watch.fields import parts_of
from tests.each import each
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


def test_service_of_a_hand_without_areas_has_no_touch_topic() -> None:
    hand = SimInspireFtp(RIGHT)
    hand._spec = replace(hand.spec, n_sensors=0)
    assert HandService(hand, node=FakeNode()).touch_topic == ""


# ---------------------------------------------------------------------------------- the conformance


def test_touch_in_a_recording_is_no_stream_of_joints() -> None:
    trace = run_virtual(
        replace(plan_for("inspire_ftp", sides=(RIGHT,)), phases=frozenset(["listen"])), FtpService
    )
    recording = Recording.decode(trace)
    assert recording.touch[RIGHT].values.shape[1:] == (17, 112)
    assert np.isnan(recording.touch[RIGHT].values[0, 0, 9:]).all()
    assert len(parts_of(FTP.touch_topic_of(RIGHT), TOUCH.name)[0].fields) == len(FTP.areas)
    for topic, count in ((FTP.touch_topic_of(RIGHT), 0), (FTP.topics(RIGHT)[1], 1)):
        assert len(list(_streams(topic, trace.load([topic])[topic]))) == count


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


# ----------------------------------------------------------------------------------------- doctor


def ends(spoken: Dialect, who: str, *, hand: bool) -> list[Endpoint]:
    """The endpoints of a hand, or of its client."""
    found = {}
    for side in Side:
        cmd, state = spoken.topics(side)
        for topic, kind, writes in (
            (cmd, spoken.cmd_type, not hand),
            (state, spoken.state_type, hand),
        ):
            key = f"{who} {topic}"
            found[key] = Endpoint(topic, kind, "writer" if writes else "reader", key, who)
    return list(found.values())


def found_in(*endpoints: Endpoint, streams: tuple[Stream, ...] = ()) -> dict[str, str]:
    people = tuple(
        Participant(key, version="0.10.5", process=f"{key}.py") for key in ("hand", "client")
    )
    flowing = streams or tuple(
        Stream(e.topic, e.key, 2.0, 200, 100.0, nonzero=True)
        for e in endpoints
        if e.kind == "writer"
    )
    view = DomainView(1, people, endpoints, flowing)
    return {f.id: f"{f.seen} | {f.fix}" for f in diagnose(Observations((view,)))}


@each(
    ("served", "asked", "option"),
    [
        ("inspire_ftp", "inspire_dfx", "inspire_ftp"),
        ("inspire_dfx", "inspire_ftp", "inspire_dfx"),
        ("brainco", "inspire_ftp", "brainco"),
        ("inspire_ftp", "dex3", "inspire_ftp"),
    ],
)
def test_doctor_reports_a_hand_of_another_model(served: str, asked: str, option: str) -> None:
    found = found_in(
        *ends(dialect(served), "hand", hand=True), *ends(dialect(asked), "client", hand=False)
    )
    assert f"--ee={option})" in found["DDS-OTHER-HAND"]
    assert dialect(served).topics(LEFT)[1] in found["DDS-OTHER-HAND"]
    assert not {"DDS-UNPUBLISHED", "DDS-NOBODY", "DDS-OTHER-STACK"} & set(found)


def test_doctor_reports_no_finding_for_a_matching_client() -> None:
    spoken = ends(FTP, "hand", hand=True), ends(FTP, "client", hand=False)
    assert not found_in(*spoken[0], *spoken[1])
    # a client of each: the hand that is missing is not taken for the one that is there
    both = found_in(*spoken[0], *spoken[1], *ends(dialect("inspire_dfx"), "client", hand=False))
    assert "DDS-OTHER-HAND" not in both
    assert "rt/inspire/state" in both["DDS-UNPUBLISHED"]


@each(
    ("state", "expected"),
    [
        # each from right to left, as both are commanded from 0.9 to 0.1 and from 0.3 to 0.7
        ((0.9, 0.3, 0.1, 0.7), set()),
        ((0.1, 0.7, 0.9, 0.3), {"DDS-REVERSED"}),
        ((0.3, 0.9, 0.7, 0.1), {"DDS-SIDES-SWAPPED"}),
    ],
)
def test_doctor_sees_swapped_sides_and_a_reversed_scale(
    state: tuple[float, float, float, float], expected: set[str]
) -> None:
    every = [*ends(FTP, "hand", hand=True), *ends(FTP, "client", hand=False)]
    values = {"state": state, "ctrl": (0.9, 0.3, 0.1, 0.7)}
    streams = []
    for end in every:
        if end.kind != "writer":
            continue
        right, left, now_right, now_left = values[end.topic.split("/")[2]]
        began, q = (right, now_right) if end.topic.endswith("/r") else (left, now_left)
        streams.append(
            Stream(
                end.topic, end.key, 2.0, 200, 100.0, q=(q,) * N, began=(began,) * N, nonzero=True
            )
        )
    found = found_in(*every, streams=tuple(streams))
    assert set(found) & {"DDS-REVERSED", "DDS-SIDES-SWAPPED"} == expected
