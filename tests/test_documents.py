"""Files given by a user are read or refused with their name; written files are complete."""

from __future__ import annotations

import json
import os
import random
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from dexkit import digests, documents
from dexkit.backends import BackendOptions, backend
from dexkit.cli.emulate.mx64 import _EepromFile
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.result_file import read_json, write_json
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.conformance.usb.record import UsbRecord
from dexkit.doctor.environment import uri_problem
from dexkit.drivers.ezgripper.calibration_file import Store
from dexkit.emulators.simulated_hand import Mechanics, SimulatedHand
from dexkit.errors import DexkitError, OutputError, UsageError
from dexkit.hand import Side
from dexkit.models import DEX1_1
from dexkit.traces import open_trace
from dexkit.traces.sessions.lerobot_format import read_parquet
from dexkit.traces.sessions.rosbag import import_bag
from dexkit.urdf import read_urdf
from tests import hostile
from tests.conformance_helpers import short_run
from tests.report_helpers import result_of_every_kind

JSON = (
    documents.read_json,
    read_json,
    _EepromFile,
    lambda path: Store(path).read("key"),
    lambda path: backend("ezgripper").create(
        BackendOptions(Side.LEFT, "/dev/null", {"force_table": str(path)})
    ),
)
TOML = (documents.read_toml, lambda path: Claims.load(path, None))


def refused(read: Callable[[Path], Any], path: Path, what: str) -> bool:
    """Whether it is refused, by an error that names the file."""
    try:
        read(path)
    except DexkitError as error:
        printed = str(error)
    else:
        return False
    assert path.name in printed or "force table" in printed, f"{what}: {printed}"
    assert len(printed) < 1000
    assert not hostile.raw(printed)
    return True


def test_any_file_content_is_read_or_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "given.file"
    count = 0
    for what, content in hostile.broken_files():
        path.write_bytes(content)
        for read in (*JSON, *TOML):
            count += refused(read, path, what)
    assert count > 200


READERS: dict[str, Callable[[Path], object]] = {
    "urdf": lambda path: read_urdf(path, DEX1_1.joints[Side.LEFT]),
    "recording": open_trace,
    "digest": digests.sha256_of_file,
    "settings, to be changed": lambda path: documents.update_file(path, lambda text: text or ""),
    "pose": lambda path: SimulatedHand(
        DEX1_1.spec(Side.LEFT, io_rate=100.0), cast(Mechanics, None), 0.01
    ).keep_pose(path),
    "table": read_parquet,
    "bag": lambda path: import_bag(path, path.with_name("out.mcap")),
    "capabilities": documents.read_toml,
}
SPECIAL = ("pipe", "socket", "folder", "device")


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("reader", READERS)
def test_only_ordinary_files_are_opened_to_be_read(
    tmp_path: Path, reader: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket is short
    path = tmp_path / f"{kind}.db3"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(DexkitError):
        READERS[reader](path)


def test_a_configuration_of_dds_is_an_ordinary_file_without_entities(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert "not an ordinary file" in uri_problem(f"file://{tmp_path}/pipe")
    laughs = '<!DOCTYPE x [<!ENTITY a "ha">]><CycloneDDS>&a;</CycloneDDS>'
    (tmp_path / "laughs.xml").write_text(laughs)
    assert uri_problem(f"file://{tmp_path}/laughs.xml")


def test_duplicate_key_and_non_finite_number_are_refused() -> None:
    for text, why in (
        ('{"a": 1, "a": 2}', "the key 'a' occurs twice"),
        ('{"a": NaN}', "NaN is not a number"),
        ('{"a": -1e400}', "-1e400 is not a finite number"),
        ('{"a": ' + "9" * 40 + "}", "has more than 20 digits"),
        ("[" * 33 + "]" * 33, "nested more than 32 levels"),
    ):
        with pytest.raises(UsageError, match=why):
            documents.parse_json(text, "it")
    documents.parse_json("[" * 32 + "]" * 32, "it")
    for text in ("a = nan", "a = 1e400", f"a = {'9' * 40}", f"a = 0x{'f' * 40}"):
        with pytest.raises(UsageError, match="it is not valid TOML"):
            documents.parse_toml(text, "it")


def test_valid_result_renders_and_invalid_one_is_refused_with_its_place(tmp_path: Path) -> None:
    """Every node of a result replaced by every kind of value; a fuzzer's part of it."""
    result = result_of_every_kind()
    write_json(result, tmp_path / "good.json")
    good = json.loads((tmp_path / "good.json").read_text())
    good["results"] = good["results"][2:3]  # one that failed
    path = tmp_path / "given.json"
    rendered = 0
    places = list(hostile.nodes(good))
    values = (hostile.MISSING, None, True, -1, 1.5, 10**18, "text", "<script>\x1b", [], {}, [[]])
    rng = random.Random(3)
    for place in places:
        # each kind at each place costs too long here; the soak does it
        for value in rng.sample(values, 1):
            path.write_text(json.dumps(hostile.replaced(good, place, value)))
            if not refused(read_json, path, str(place)):
                rendered += 1
                hostile.render_all(path, tmp_path)
    assert len(places) > 70
    assert rendered > 8


@pytest.mark.soak
def test_every_kind_of_value_at_every_place_of_a_result(tmp_path: Path) -> None:
    result = result_of_every_kind()
    write_json(result, tmp_path / "good.json")
    good = json.loads((tmp_path / "good.json").read_text())
    good["results"] = good["results"][:3]
    path = tmp_path / "given.json"
    for place in hostile.nodes(good):
        for value in (hostile.MISSING, *hostile.VALUES):
            path.write_text(json.dumps(hostile.replaced(good, place, value)))
            if not refused(read_json, path, str(place)):
                hostile.render_all(path, tmp_path)


def test_error_names_the_place_and_the_expected_value(tmp_path: Path) -> None:
    result = result_of_every_kind()
    write_json(result, tmp_path / "r.json")
    good = json.loads((tmp_path / "r.json").read_text())
    for place, value, printed in (
        (("results", 2, "evidence", 0, "time_s"), "soon", "time_s: Expected float, got str"),
        (("results", 2, "verdict"), "good", "results[2].verdict: Invalid enum value 'good'"),
        (("results", 2, "side"), hostile.MISSING, "results[2]: Object missing required field side"),
        (("duration_s",), -1, "duration_s: Expected float >= 0.0"),
        (("claims",), [], "claims: Expected object | null, got array"),
        (("notes",), {}, "notes: Expected array, got object"),
        (("format",), "other", "is not a result file of dexkit"),
        (("version",), 5, "version 5 of dexkit-conformance-result is not read"),
        ((), [], "is not a result file of dexkit"),
    ):  # fmt: skip
        (tmp_path / "r.json").write_text(json.dumps(hostile.replaced(good, place, value)))
        with pytest.raises(UsageError) as caught:
            read_json(tmp_path / "r.json")
        assert printed in str(caught.value)


def test_records_in_a_recording_are_read_or_refused() -> None:
    rng = random.Random(2)
    stimulus = dict(short_run().metadata[RECORD])
    usb = UsbRecord().to_metadata()
    for _ in range(120):
        for record, read in ((stimulus, Stimulus.from_metadata), (usb, UsbRecord.from_metadata)):
            key = rng.choice(list(record))
            text = json.dumps(hostile.mutated(json.loads(record[key]), rng))
            for value in (text, text[: rng.randint(0, len(text))], "[" * 5000):
                try:
                    read({**record, key: value})
                except DexkitError:
                    pass


# ---------------------------------------------------------------------------------- writing


def left_behind(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir() if p.name.startswith(".dexkit-")]


def test_unwritable_paths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name, why in (
        ("/dev/full", "No space left"),
        (str(tmp_path / "folder"), "Is a directory"),
        (str(tmp_path / "none" / "x"), "No such file"),
        ("/proc/x", "No such file|denied|Permission"),
        ("a\0b", "null"),
        (str(tmp_path / ("x" * 300)), "too long"),
    ):
        with pytest.raises(OutputError, match=why) as caught:
            documents.write_file(Path(name), "text")
        assert caught.value.exit_code == 2
    assert not left_behind(tmp_path)
    documents.write_file(Path("/dev/null"), "text")
