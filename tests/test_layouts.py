"""The layouts of Foxglove and PlotJuggler name numbers that a ROS 2 reader finds in recordings."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dexkit.traces import Recorder
from tests.watch_helpers import COMMAND, STATE, dex3_command, dex3_state, ns

LAYOUTS = Path(__file__).parent.parent / "docs" / "layouts"


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A message of each topic of two Dex3-1, as a reader of ROS 2 bags decodes it."""
    path = tmp_path_factory.mktemp("layouts") / "a.mcap"
    with Recorder(path) as recorder:
        for side in ("left", "right"):
            q = [0.1 * i for i in range(7)]
            recorder.put(f"rt/dex3/{side}/state", STATE, dex3_state(q), ns(0), ns(0))
            recorder.put(f"rt/dex3/{side}/cmd", COMMAND, dex3_command(q), ns(0), ns(0))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return {channel.topic: m for _, channel, _, m in reader.iter_decoded_messages()}


def number(message: Any, steps: list[str]) -> float:
    for step in steps:
        message = message[int(step)] if step.isdecimal() else getattr(message, step)
    return float(message)


def test_foxglove_paths_are_in_the_recording(messages: dict[str, Any]) -> None:
    layout = json.loads((LAYOUTS / "foxglove-dex3-1.json").read_text())
    panels = layout["configById"]
    assert len(panels) == 14
    text = json.dumps(layout["layout"])
    for name, panel in panels.items():
        assert text.count(f'"{name}"') == 1
        for i, path in enumerate(panel["paths"]):
            topic, rest = re.fullmatch(r'"([^"]+)"\.(.+)', path["value"]).groups()  # type: ignore[union-attr]
            joint = int(re.findall(r"\[(\d+)\]", rest)[0])
            found = number(messages[topic], re.findall(r"\w+", rest))
            assert found == pytest.approx(0.1 * joint)
            assert topic.endswith(("cmd", "state")[i])


def test_plotjuggler_curves_are_in_the_recording(messages: dict[str, Any]) -> None:
    root = ElementTree.parse(LAYOUTS / "plotjuggler-dex3-1.xml").getroot()
    names = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(names) == 28
    for name in names:
        topic = next(t for t in messages if name.startswith(t))
        number(messages[topic], re.findall(r"\w+", name.removeprefix(topic)))
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.attrib["count"]) == len(splitter)
