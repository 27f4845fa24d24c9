"""Files and texts of users: recordings, results, calibrations, claims, faults, settings."""

from __future__ import annotations

import io
import json
import math
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from dexkit.backends import BackendOptions
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.kit.result_file import as_document, read_json
from dexkit.conformance.kit.stimulus_record import Stimulus
from dexkit.conformance.report.badge import render_badge
from dexkit.conformance.report.compare import (
    Comparison,
    render_comparison,
    render_comparison_markdown,
)
from dexkit.conformance.report.html import render
from dexkit.conformance.report.junit import write_junit
from dexkit.conformance.report.markdown import render_markdown
from dexkit.conformance.report.terminal import print_result
from dexkit.conformance.usb.record import UsbRecord
from dexkit.console import Console
from dexkit.doctor.environment import uri_problem
from dexkit.drivers.dex1_serial import settings as dex1_settings
from dexkit.drivers.dex3_usb import discovery as dex3_discovery
from dexkit.drivers.dex3_usb import settings as dex3_settings
from dexkit.drivers.ezgripper.calibration_file import Store
from dexkit.emulators.faults import (
    DEX3_FAULTS,
    M4010_FAULTS,
    MX64_FAULTS,
    REVO2_FAULTS,
    RH56_FAULTS,
    parse_fault,
)
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.messages import message_type
from dexkit.models import model
from dexkit.traces import open_trace
from dexkit.traces.recorder import Recorder
from dexkit.traces.sessions.pictures import parse_picture
from dexkit.urdf import read_urdf
from tools.campaign.fuzz.case import Difference, FuzzCase, Target
from tools.campaign.fuzz.messages import filled
from tools.campaign.fuzz.recordings import TIME, TYPES
from tools.campaign.mutate import TextMutator, damaged_json, mutator

__all__ = ["cases"]


# --- recordings


def _record(opcode: int, content: bytes) -> bytes:
    return bytes((opcode,)) + struct.pack("<Q", len(content)) + content


_MAGIC = b"\x89MCAP0\r\n"


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _hostile(rng: random.Random) -> list[bytes]:
    """Recordings that are small and want much: chunks that unpack to a lot, schemas of nothing."""
    header = _MAGIC + _record(1, _text("") + _text("x"))
    found = []
    for size, count in ((1 << 20, 1), (1 << 24, 4), (1 << 28, 1), (1 << 28, 6)):
        packed = _zeros(size)
        chunk = struct.pack("<QQQI", 0, 1, size, 0) + _text("zstd") + struct.pack("<Q", len(packed))
        found.append(header + _record(6, chunk + packed) * count)
    for body in ("\n" * 200_000, " " * 200_000 + "x", "#" * 100_000, "float32 a\n" * 2_000):
        schema = struct.pack("<H", 1) + _text("a/msg/B") + _text("ros2msg") + _text(body)
        plain = _record(3, schema)
        packed = zstandard.compress(plain)
        chunk = struct.pack("<QQQI", 0, 1, len(plain), zlib.crc32(plain)) + _text("zstd")
        found.append(header + _record(6, chunk + struct.pack("<Q", len(packed)) + packed))
        found.append(header + plain)
    return found


@cache
def _zeros(size: int) -> bytes:
    return zstandard.compress(bytes(size))


def _greedy(rng: random.Random, scratch: Path) -> Target:
    """Small recordings that ask for much memory or time."""
    hostile = _hostile(rng)
    order = [rng.randrange(len(hostile)) for _ in range(64)]
    path = scratch / "x.mcap"

    def make() -> bytes:
        return hostile[order.pop() if order else 0]

    def run(data: bytes) -> None:
        path.write_bytes(data)
        trace = open_trace(path)
        list(trace.messages())
        trace.load()

    return Target(make, run)


def _judged(rng: random.Random, scratch: Path) -> Target:
    """A recording of odd content, judged."""
    path = scratch / "x.mcap"

    def make() -> bytes:
        topic, name = rng.choice(list(TYPES.items()))
        kind = message_type(name)
        with Recorder(path, overwrite=True) as recorder:
            stamp = TIME
            for _ in range(rng.choice((1, 2, 3, 40))):
                message = filled(name, rng)
                if rng.random() < 0.3:
                    member = next(f for f in kind.layout.fields if f.sequence)
                    element = getattr(filled(name, rng), member.name)[:1]
                    setattr(message, member.name, element * rng.choice((64, 1000, 1024)))
                recorder.put(topic, name, kind.encode(message), stamp, stamp)
                stamp += rng.choice((0, 1, 2_000_000, 10**9, 10**12))
        return path.read_bytes()

    def run(data: bytes) -> None:
        path.write_bytes(data)
        result = judge(Recording.decode(open_trace(path)))
        render(result)

    return Target(make, run)


# --- results


@cache
def _result() -> dict[str, Any]:
    from dexkit.traces import sample_path

    result = judge(Recording.decode(open_trace(sample_path("dex1_hand_dropout"))))
    return as_document(result)


def _results(rng: random.Random, scratch: Path) -> Target:
    """A result file with wrong types, and all reports of it."""
    content = _result()
    small = {**content, "results": content["results"][:4]}
    path = scratch / "result.json"
    ways: list[Callable[[Any], object]] = [
        render,
        render_markdown,
        render_badge,
        lambda found: write_junit(found, scratch / "x.xml"),
        lambda found: print_result(found, Console(file=io.StringIO()), verbose=True, more=""),
        lambda found: render_comparison(Comparison([found, found], ["a", "b"])),
        lambda found: render_comparison_markdown(Comparison([found, found], ["a", "b"])),
    ]
    turn = [0]

    def run(text: str) -> None:
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        found = read_json(path)
        turn[0] += 1
        ways[turn[0] % len(ways)](found)

    return Target(lambda: damaged_json(small, rng), run)


# --- settings of users

_NUMBERS = ("0", "1", "-1", "1.5", "nan", "inf", "1e400", "9" * 5000, "0x10", "\u00b2", "1_0", "")


def _faults(rng: random.Random, scratch: Path) -> Target:
    words = ["@", "3s", "500ms", ":", "for=", "p=", "id=", "side=left", "ms=", ",", "c=", "volts="]
    words += [*_NUMBERS, "1" * 400 + "s", ".5", "e"]
    text = TextMutator(
        [
            "overload@3s",
            "drop:p=0.05",
            "unplug@5s:for=2s",
            "brown-out:volts=9,for=1s,id=1",
            "silent:id=3",
            "stray:before=1,after=2",
            "unplug:side=left,for=300ms",
        ],
        words,
        rng,
    )
    families = (MX64_FAULTS, DEX3_FAULTS, M4010_FAULTS, RH56_FAULTS, REVO2_FAULTS)

    def run(given: str) -> None:
        for family in families:
            try:
                fault = parse_fault(given, family)
            except DexkitError:
                continue
            if not (fault.at >= 0.0 and all(map(math.isfinite, fault.params.values()))):
                raise Difference(f"a fault that cannot be: {fault}")

    return Target(text, run)


def _store(rng: random.Random, scratch: Path) -> Target:
    path = scratch / "ezgripper.json"
    store = Store(path)
    content = {
        "zero_positions": {"a:1": 100, "b:2": -5},
        "speeds": {"a:1": {"opening": 90.0, "closing": 80.0}},
        "force_tables": {"a:1": {"0": 0.0, "100": 0.5}},
    }
    from dexkit.drivers.ezgripper import calibration_file

    names = [calibration_file._ZERO, calibration_file._SPEED, calibration_file._FORCE]
    plain = dict(zip(names, content.values(), strict=True))

    def run(text: str) -> None:
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        for key in store.keys():  # noqa: SIM118  # a file, not a dict
            try:
                store.read(key)
            except DexkitError:
                pass

    return Target(lambda: damaged_json(plain, rng), run)


def _eeprom(rng: random.Random, scratch: Path) -> Target:
    from dexkit.cli.emulate.mx64 import _EepromFile
    from dexkit.emulators.mx64 import Servo

    path = scratch / "eeprom.json"
    content = {"device": "mx64", "eeprom": [Servo(1).eeprom.hex(), Servo(2).eeprom.hex()]}

    def run(text: str) -> None:
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        kept = _EepromFile(path)
        for index in range(2):
            Servo(1, eeprom=kept.load(index))

    return Target(lambda: damaged_json(content, rng), run)


def _claims(rng: random.Random, scratch: Path) -> Target:
    text = TextMutator(
        [
            '[hand]\nname = "x"\nvendor = "y"\nmodel = "dex1-1"\n[claims]\nforce = true\n',
            "[claims]\n",
            "",
        ],
        ["[hand]", "[claims]", "= true", "= [", "= {", '"""', "[[a]]", "[" * 5000, "nan",
         "a = " + "[" * 5000, "a." * 3000 + "b = 1", "1979-05-27", "\\u0000", "model = 'x'"],
        rng,
    )  # fmt: skip
    return Target(text, Claims.parse)


def _stimulus(rng: random.Random, scratch: Path) -> Target:
    phases = [
        {
            "name": "step", "sides": ["left"], "begin_ns": 1, "end_ns": 2,
            "targets": {"left": {"0": 1.0}}, "params": {"a": 1.0}, "observed": {"b": 1.0},
        }
    ]  # fmt: skip
    whole = {"phases": phases, "objects": {"left": 1.0}, "stalls": [[1, 2]], "beats": {}}
    process = {"name": "a", "pid": 1, "subjects": ["left"], "waited_us": [2], "longest_us": [2]}
    whole["waits"] = {"begin_ns": 1, "t_us": [1], "processes": [process]}

    def make() -> str:
        return damaged_json(whole, rng)

    def run(text: str) -> None:
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            content = {"phases": text, "objects": text, "stalls": text}
        if not isinstance(content, dict):
            return
        record = {k: v if isinstance(v, str) else json.dumps(v) for k, v in content.items()}
        Stimulus.from_metadata({"version": "1", **record})
        UsbRecord.from_metadata({"version": "1", **record, "left": text})

    return Target(make, run)


def _settings(rng: random.Random, scratch: Path) -> Target:
    backends: Sequence[tuple[Callable[[BackendOptions], object], Sequence[str]]] = [
        (dex1_settings.from_options, list(dex1_settings.SETTINGS)),
        (dex3_settings.from_options, list(dex3_settings.SETTINGS)),
    ]
    from dexkit.drivers.ezgripper import gripper

    backends = [*backends, (gripper._create_hand, list(gripper.backend.settings))]
    text = TextMutator(
        ["1", "auto", "0.5", "yes", "0:1,1:2", "usbip://127.0.0.1:3240/1", "1234", "0x81"],
        [*_NUMBERS, "usbip://", "[::1", ":99999", "/dev/null", "/", ",", "default", "no"],
        rng,
    )

    def run(given: str) -> None:
        for make, keys in backends:
            for key in keys:
                try:
                    make(BackendOptions(Side.LEFT, "/dev/null", {key: given}))
                except DexkitError:
                    pass
        try:
            dex3_discovery.parse_server(given)
        except DexkitError:
            pass

    return Target(text, run, ())


def _uri(rng: random.Random, scratch: Path) -> Target:
    text = TextMutator(
        ["<CycloneDDS><Domain/></CycloneDDS>", "file:///dev/null", "<?xml version='1.0'?><a/>"],
        [
            "<",
            ">",
            "<!DOCTYPE a [<!ENTITY b 'c'>]>",
            "&b;",
            "file://",
            "%00",
            "/proc",
            ",",
            "\udc80",
        ],
        rng,
    )
    # the environment holds no NUL
    return Target(lambda: text().replace("\0", ""), uri_problem, ())


_XML = (
    "<!DOCTYPE a [<!ENTITY b 'c'>]>", '<!DOCTYPE a SYSTEM "file:///etc/passwd">', "&b;", "&#0;",
    "<?xml version='1.0' encoding='utf-16'?>", "<?xml version='1.0' encoding='x'?>", "<![CDATA[",
    "<!--", "<robot>", "</robot>", "<link name='", "<joint name='", "<mimic joint='a'/>", "<axis/>",
    "<origin xyz='", "<parent link='base'/>", "<child link='base'/>", " multiplier='1e300'", "/>",
    "revolute", "prismatic", "continuous", "fixed", "xmlns:a='b'", "a:b", "0 0", "1e4 0 0",
    "<a>" * 3000, "<geometry>", "<box size='1 1 1'/>", "<sphere radius='-1'/>", "<cylinder/>",
)  # fmt: skip


def _urdf_text() -> str:
    """A skeleton with the joints of a hand."""
    joints = model("dex3-1").joints[Side.LEFT]
    parts = ["<?xml version='1.0'?>\n<robot name='a'>\n<link name='base'/>"]
    before = "base"
    for i, joint in enumerate(joints):
        shape = ("box size='1 1 1'", "sphere radius='1'", "cylinder radius='1' length='2'")[i % 3]
        kind = ("revolute", "prismatic")[i % 2]
        parts.append(
            f"<link name='l{i}'><visual><origin xyz='0 0 1'/><geometry><{shape}/></geometry>"
            f"</visual></link>\n<joint name='{joint.urdf or joint.name}' type='{kind}'>"
            f"<parent link='{before}'/><child link='l{i}'/><origin xyz='0 0 0.1' rpy='0 0 1'/>"
            "<axis xyz='0 1 0'/></joint>"
        )
        before = f"l{i}"
    mimic = f"<mimic joint='{joints[0].urdf or joints[0].name}' multiplier='2' offset='1'/>"
    parts.append(
        f"<link name='m'/><joint name='other' type='revolute'><parent link='{before}'/>"
        f"<child link='m'/>{mimic}</joint>\n</robot>"
    )
    return "\n".join(parts)


def _urdf(rng: random.Random, scratch: Path) -> Target:
    """Skeletons, drawn."""
    path = scratch / "hand.urdf"
    hand = model("dex3-1")
    joints = hand.joints[Side.LEFT]
    names = [n for j in joints for n in (j.name, j.urdf) if n]
    text = TextMutator([_urdf_text()], [*_XML, *_NUMBERS, *names], rng)
    bytewise = mutator([_urdf_text().encode(), _urdf_text().encode("utf-16")], rng)

    def make() -> bytes:
        if rng.getrandbits(2) == 0:
            return bytewise()
        form = rng.choice(("utf-8", "utf-8", "utf-8-sig", "utf-16", "utf-32", "utf-7"))
        return text().encode(form, "backslashreplace")

    def run(data: bytes) -> None:
        path.write_bytes(data)
        found = read_urdf(path, joints)
        poses = found.poses([0.5] * found.joints)
        drawn = [poses, found.sizes, found.box_poses(poses), found.pin_poses(poses)]
        if not all(np.isfinite(d).all() for d in drawn):
            raise Difference("a skeleton with a place that is no number")

    return Target(make, run)


def _png() -> bytes:
    head = struct.pack(">I4sIIBBBBB", 13, b"IHDR", 8, 6, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + head + bytes(40)


def _picture(rng: random.Random, scratch: Path) -> Target:
    """The heads of pictures."""
    size = struct.pack(">BHHB", 8, 6, 8, 3) + bytes(9)
    jpeg = b"\xff\xd8\xff\xe0\x00\x10JFIF" + bytes(10) + b"\xff\xc0\x00\x11" + size + b"\xff\xda"
    damaged = mutator([jpeg, _png(), jpeg + bytes(60)], rng)

    def run(data: bytes) -> None:
        found = parse_picture(data)
        if found is not None and not (found.width > 0 and found.height > 0):
            raise Difference("a picture without a size")

    return Target(damaged, run)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    return [
        FuzzCase("urdf", "skeletons of hands in XML", _urdf),
        FuzzCase("picture", "heads of JPEG and PNG", _picture),
        FuzzCase("mcap.greedy", "small recordings that want much", _greedy),
        FuzzCase("check", "recordings of odd content, judged", _judged),
        FuzzCase("result", "result files, and the reports of them", _results),
        FuzzCase("faults", "fault specifications of three families", _faults),
        FuzzCase("ezgripper.json", "calibration files", _store),
        FuzzCase("eeprom", "EEPROM files of the emulator", _eeprom),
        FuzzCase("capabilities.toml", "claims", _claims),
        FuzzCase("stimulus", "records of stimuli in a recording", _stimulus),
        FuzzCase("settings", "settings of the backends", _settings),
        FuzzCase("cyclonedds-uri", "configurations, as the doctor reads them", _uri),
    ]  # fmt: skip
