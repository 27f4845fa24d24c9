"""Every hand through every format, and back: compared as messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexkit.hand import Side
from dexkit.models import MODELS, model
from dexkit.traces import open_trace
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
