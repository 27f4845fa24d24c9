"""Test ``dexkit models`` and the drawings."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from dexkit import model_facts as facts
from dexkit.cli import cli
from dexkit.cli.emulate import command as emulate
from dexkit.errors import UsageError
from dexkit.hand import JointSpec, Side
from dexkit.model_facts import describe, names
from dexkit.models import BUILT_IN, DEX3_1, MODELS
from dexkit.robots import ROBOTS
from tests.each import each
from tools.generate.hand_layouts import LAYOUTS
from tools.generate.model_drawing import draw_hand, draw_robot
from tools.generate.models_page import drawing
from tools.generate.svg_sheet import Box, Sheet

SVG = "{http://www.w3.org/2000/svg}"


def run(*arguments: str) -> str:
    result = CliRunner().invoke(cli, ["models", *arguments], env={"COLUMNS": "80"})
    assert result.exit_code == 0, result.output
    return result.output


def joints(name: str) -> Iterator[tuple[int, JointSpec]]:
    """Every joint of a model with its index, of both sides."""
    if name in MODELS:
        for side in Side:
            yield from enumerate(MODELS[name].joints[side])
    else:
        yield from ((i, ROBOTS[name].joint(i)) for i in ROBOTS[name].used)


def gap(a: Box, b: Box) -> float:
    """Px between two texts."""
    across = max(a.left - b.right, b.left - a.right, 0.0)
    return math.hypot(across, max(a.top - b.bottom, b.top - a.bottom, 0.0))


class TestCommandLine:
    def test_overview_lists_every_model_in_eighty_columns(self) -> None:
        lines = run().splitlines()
        assert max(map(len, lines)) <= 80
        for name in names():
            (line,) = (text for text in lines if text.startswith(f"{name} "))
            title = MODELS[name].title if name in MODELS else ROBOTS[name].title
            assert title in line
        for model in MODELS.values():
            assert f"{model.state_rate:g} Hz" in "\n".join(lines)

    @each("name", names())
    def test_model_page_fits_eighty_columns(self, name: str) -> None:
        output = run(name)
        assert max(map(len, output.splitlines())) <= 80
        for i, joint in joints(name):
            # no source says how much force a hand in parts of the travel has
            rad = name not in MODELS or MODELS[name].unit == "rad"
            last = f"{joint.tau_max:g}" if rad else f"{joint.dq_max:.4g}"
            row = rf"^ *{i} +{joint.name} .*{round(joint.q_max, 4):g} .*{last} "
            assert re.search(row, output, re.MULTILINE), row
        if name in MODELS:
            for dialect in MODELS[name].dialects:
                for text in (dialect.name, dialect.cmd_type, dialect.state_type):
                    assert text in output

    def test_all_models_are_printed(self) -> None:
        assert run(*names()) == "\n".join(run(name) for name in names())

    def test_unknown_model_is_refused(self) -> None:
        result = CliRunner().invoke(cli, ["models", "dex9"])
        error = result.exception
        assert isinstance(error, UsageError)
        assert error.exit_code == 2
        hands = ", ".join(hand.name for hand in BUILT_IN)
        assert error.hint == f"known: {hands}, h1, g1"

    def test_json_is_complete_and_documented(self) -> None:
        models = {m["name"]: m for m in json.loads(run("--json"))["models"]}
        assert list(models) == names()
        for name in names():
            assert models[name] == json.loads(json.dumps(describe(name)))
            assert json.loads(run(name, "--json"))["models"] == [models[name]]
        documented = set(re.findall(r'"(\w+)"', facts.__doc__ or ""))

        def keys(value: object) -> Iterator[str]:
            if isinstance(value, dict):
                yield from value
                for inner in value.values():
                    yield from keys(inner)
            elif isinstance(value, list):
                for inner in value:
                    yield from keys(inner)

        assert {*keys(models)} - set(names()) <= documented

    def test_printed_values_match_the_models(self) -> None:
        data = describe("dex3-1")
        for side in Side:
            rows = data["sides"][str(side)]["joints"]
            for row, joint in zip(rows, DEX3_1.joints[side], strict=True):
                assert (row["q_min_rad"], row["q_max_rad"]) == (joint.q_min, joint.q_max)
                assert row["q_max_deg"] == pytest.approx(math.degrees(joint.q_max), abs=0.01)
                assert row["closing"] == joint.closing
        assert {b["name"] for b in data["backends"]} >= {"sim-dex3", "dex3-usb"}
        assert sum(len(s["slots"]) for s in data["pressure_sensors"]) == 33

    def test_robot_pages_name_an_existing_command(self) -> None:
        listed = CliRunner().invoke(emulate, ["--help"]).output
        for name in ROBOTS:
            assert describe(name)["emulator"] == f"dexkit emulate {name}"
            assert f"  {name} " in listed


@pytest.mark.parametrize("name", names())
class TestDrawings:
    @pytest.fixture
    def sheet(self, name: str) -> Sheet:
        return draw_hand(MODELS[name]) if name in MODELS else draw_robot(ROBOTS[name])

    def test_every_joint_is_labelled_once_with_its_index(self, name: str, sheet: Sheet) -> None:
        texts = Counter(box.text for box in sheet.texts)
        expected = Counter(joint.name for _, joint in joints(name))
        assert {text: texts[text] for text in expected} == expected
        for i, joint in joints(name):
            boxes = [b for b in sheet.texts if b.text == joint.name]
            numbers = [b for b in sheet.texts if b.text == str(i)]
            assert any(gap(number, box) < 30 for number in numbers for box in boxes), joint.name

    def test_labels_do_not_overlap_or_leave_the_sheet(self, name: str, sheet: Sheet) -> None:
        for k, box in enumerate(sheet.texts):
            assert box.left >= 0, box
            assert box.right <= sheet.width, box
            assert 0 <= box.top < box.bottom <= sheet.height, box
            assert not [other.text for other in sheet.texts[k + 1 :] if box.overlaps(other)], box

    def test_drawing_has_light_and_dark_colours(self, name: str, sheet: Sheet) -> None:
        root = ElementTree.fromstring(drawing(name))
        assert root.tag == f"{SVG}svg"
        assert root.findtext(f"{SVG}title")
        assert "not to scale" in (root.findtext(f"{SVG}desc") or "")
        assert not [e for e in root.iter() if any("href" in key for key in e.attrib)]
        style = root.findtext(f"{SVG}style") or ""
        light, dark = style.split("@media (prefers-color-scheme: dark)")
        used = {e.get("class") for e in root.iter() if e.get("class")}
        for kind in used:
            assert f".{kind} {{" in light
            assert f".{kind} {{" in dark
        assert "schematic, not to scale" in {box.text for box in sheet.texts}


def test_sensors_are_drawn_where_the_model_has_them() -> None:
    root = ElementTree.fromstring(drawing("dex3-1"))
    taxels = [e for e in root.iter() if e.get("class") == "taxel"]
    badges = [e for e in root.iter(f"{SVG}text") if e.get("class") == "sensor"]
    assert len(taxels) == 2 * 33 + 4  # both hands, and the legend
    assert Counter(e.text for e in badges) == Counter([*map(str, range(9))] * 2 + ["0"])


def test_finger_joints_have_their_finger_in_the_name() -> None:
    for finger in LAYOUTS[DEX3_1.name].fingers:
        for i in finger.joints:
            assert DEX3_1.joints[Side.LEFT][i].name.startswith(f"{finger.name}_")
    for hand in BUILT_IN:
        fingers = LAYOUTS[hand.name].fingers if hand.name in LAYOUTS else ()
        covered = sorted(i for finger in fingers for i in finger.joints)
        assert covered == (list(range(len(hand.joints[Side.LEFT]))) if fingers else [])


def test_left_and_right_drawings_are_mirrored() -> None:
    """Fingers of the right hand are on the other side of the sheet than the left hand's."""
    sheet = draw_hand(DEX3_1)
    for joint in DEX3_1.joints[Side.LEFT]:
        left, right = sorted((b.left + b.right) / 2 for b in sheet.texts if b.text == joint.name)
        assert left + right == pytest.approx(sheet.width, abs=1)
