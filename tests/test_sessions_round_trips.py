"""Every hand through every format, and back: compared as messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import MODELS, model
from dexkit.traces import open_trace
from dexkit.traces.sessions.streams import COMMAND, STATE, streams_of
from tests.session_helpers import dexkit, document, episode, streamed

pytest.importorskip("pyarrow")
pytest.importorskip("rosbags")

FORMATS = ("lerobot", "episodes", "rosbag2", "csv", "parquet")
BOTH = tuple(Side)
FRAMES = 12
CASES = [(hand, BOTH) for hand in MODELS]
# one hand alone where a message has both
CASES += [
    (hand, (side,))
    for hand in MODELS
    for side in Side
    if len({model(hand).dialects[0].topics(s) for s in Side}) == 1
]
each_hand = pytest.mark.parametrize(
    ("hand", "sides"), CASES, ids=[f"{hand} {'+'.join(sides)}" for hand, sides in CASES]
)

Messages = dict[tuple[str, int], bytes]


def imported(folder: Path, hand: str, sides: tuple[Side, ...] = BOTH) -> Path:
    """A recording of an episode of such hands."""
    found = document(frames=FRAMES, hand=hand, cameras=0)
    for item in found["data"]:
        for key in ("states", "actions"):
            item[key] = {n: v for n, v in item[key].items() if n.startswith(sides)}
    source = episode(folder / "e", streamed(found))
    code, output = dexkit("import", source, folder / "a.mcap", "--set", f"hand={hand}")
    assert code == 0, output
    return folder / "a.mcap"


def messages(path: Path) -> Messages:
    found = list(open_trace(path).messages())
    assert len({(m.topic, m.log_time_ns) for m in found}) == len(found), "two at one time"
    return {(m.topic, m.log_time_ns): m.data for m in found if "/frame/" not in m.topic}


@each_hand
def test_a_hand_comes_back_as_the_same_messages(
    tmp_path: Path, hand: str, sides: tuple[Side, ...]
) -> None:
    path = imported(tmp_path, hand, sides)
    expected = messages(path)
    dialect = model(hand).dialects[0]
    topics = {topic for side in sides for topic in dialect.topics(side)}
    for topic in topics:
        assert sum(t == topic for t, _ in expected) == FRAMES, "one message a frame"
    for form in FORMATS:
        code, output = dexkit("export", path, "--to", form, "--out", tmp_path / form)
        assert code == 0, output
        code, output = dexkit(
            "import",
            tmp_path / form,
            tmp_path / f"{form}.mcap",
            *(("--set", f"hand={hand}") if form == "episodes" else ()),
        )
        assert code == 0, output
        assert messages(tmp_path / f"{form}.mcap") == expected, form


@each_hand
def test_the_streams_of_a_hand_have_the_values_of_its_source(
    tmp_path: Path, hand: str, sides: tuple[Side, ...]
) -> None:
    """Neither a hand that the source has not, nor fields that it or the message has not."""
    source = document(frames=FRAMES, hand=hand, cameras=0)["data"]
    dialect = model(hand).dialects[0]
    found = {(s.part, s.kind): s for s in streams_of(open_trace(imported(tmp_path, hand, sides)))}
    hands = {key for key in found if key[0].endswith("_hand")}
    assert hands == {(f"{s}_hand", k) for s in sides for k in (STATE, COMMAND)}
    for side in sides:
        for key, kind, type_name in (
            ("states", STATE, dialect.state_type),
            ("actions", COMMAND, dialect.cmd_type),
        ):
            stream = found[f"{side}_hand", kind]
            assert not {"dq", "tau"} & set(stream.values)
            q = np.array([item[key][f"{side}_ee"]["qpos"] for item in source])
            assert np.array_equal(stream.q, message_type(type_name).motor_values_sent("q", q))
