"""What ``make pins`` keeps is known by keys of everything that it depends on."""

from __future__ import annotations

import functools
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from click.testing import CliRunner

from dexkit.conformance.checks import Check, Outcome, check_of
from dexkit.conformance.faults import Mutant, mutants
from dexkit.conformance.faults.trials import cost, run_of
from dexkit.conformance.kit import judge as judge_module
from dexkit.conformance.kit.judge import judge_layer
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.layers import layer
from dexkit.conformance.stimuli.phases import parts_of
from tests.each import each
from tools.pins.__main__ import main
from tools.pins.keys import (
    JUDGES_ONLY,
    PROSE,
    ROOT,
    SPLIT,
    check_place,
    data_of,
    judging,
    played_by,
    recording_key,
    sources,
)
from tools.pins.matrix import tasks
from tools.pins.pinned import Pins
from tools.pins.recordings import pack, unpack
from tools.pins.sources import Place, Sources
from tools.pins.trial import Task, known, same_again, work
from tools.pins.verdicts import verdicts_of

# of a tool for developers; make test has test_pinned_verdicts
pytestmark = pytest.mark.slow


@functools.cache
def cheapest(layer_name: str, model: str) -> Mutant:
    found = [m for m in mutants(layer_name) if m.model == model]
    return min(found, key=lambda m: (cost(m), not m.brief))


# ---------------------------------------------------------------------------------- sources

TREE = {
    "kit/__init__.py": "",
    "kit/whole.py": '"""Doc."""\nfrom kit.deep import LIMIT\ndef f():\n    return LIMIT\n',
    "kit/deep.py": "LIMIT = 3\n",
    "kit/judge.py": "from kit.whole import f\nJUDGED = f()\n",
    "kit/parts/__init__.py": "",
    "kit/parts/one.py": (
        "from typing import TYPE_CHECKING\n"
        "from kit.parts import two\n"
        "from kit.whole import f\n"
        "if TYPE_CHECKING:\n    from kit.judge import JUDGED\n"
        "SOME = 1\nOTHER = 2\nTABLE = {}\nTABLE['x'] = 5\n"
        "def helper():\n    return SOME\n"
        "@declared('a')\nclass A:\n    def m(self):\n        return helper()\n"
        "class B(two.Base):\n    x: int = OTHER\n"
        "class C:\n    def m(self):\n        from kit.judge import JUDGED\n        return JUDGED\n"
    ),
    "kit/parts/two.py": "class Base:\n    pass\nclass Unused:\n    pass\n",
}


class Edited(Sources):
    """Sources with a text replaced in one of the files."""

    def __init__(self, root: Path, *more: object, edit: tuple[str, str, str]) -> None:
        super().__init__(root, *more)  # type: ignore[arg-type]
        self._edit = edit

    def text(self, path: Path) -> str:
        text = super().text(path)
        name, old, new = self._edit
        if path != self.root / name:
            return text
        assert old in text, f"{name} has no {old!r}"
        return text.replace(old, new)


@each(
    ("file", "old", "new", "changed"),
    [
        ("kit/parts/one.py", "SOME = 1", "SOME = 7", "A"),
        ("kit/parts/one.py", "return SOME", "return SOME + 1", "A"),
        ("kit/parts/one.py", "OTHER = 2", "OTHER = 7", "B"),
        ("kit/parts/one.py", "return helper()", "return 1 + helper()", "A"),
        ("kit/parts/one.py", "= 5", "= 6", "ABC"),  # runs at every import
        ("kit/parts/one.py", "declared('a')", "declared('b')", ""),
        ("kit/parts/one.py", "class C:", "class New:\n    pass\n# what\nclass C:", ""),
        ("kit/parts/two.py", "class Base:\n    pass", "class Base:\n    y = 1", "B"),
        ("kit/parts/two.py", "class Unused:\n    pass", "class Unused:\n    y = 1", ""),
        ("kit/deep.py", "3", "4", "C"),  # through an import in a function, and two modules
        ("kit/judge.py", "f()", "f() + 1", "C"),
        ("kit/whole.py", "Doc.", "Other words.", ""),
        ("kit/whole.py", "return LIMIT", "return (LIMIT)  # why", ""),
        ("kit/whole.py", "return LIMIT", "return -LIMIT", "C"),
    ],
)
def test_a_digest_has_what_is_named_and_nothing_else(
    tmp_path: Path, file: str, old: str, new: str, changed: str
) -> None:
    for name, text in TREE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    given = (("kit",), ("kit.parts",), ("declared",))
    before, after = Sources(tmp_path, *given), Edited(tmp_path, *given, edit=(file, old, new))
    found = ""
    for name in "ABC":
        place = before.place("kit.parts.one", f"{name}.m")
        assert place == ("kit.parts.one", name)
        found += name * (before.digest([place]) != after.digest([place]))
    assert found == changed


# ------------------------------------------------------------------------------------- keys

EDITS = [
    # a phase, a check beside a phase, a check, the facts of the model, a rule of all verdicts
    (
        "dexkit/conformance/behaviours/motion.py",
        "(joints, CLOSED)",
        "(joints, CLOSED + 1)",
        True,
        None,
    ),
    ("dexkit/conformance/behaviours/load.py", "count = 40", "count = 41", False, None),
    (
        "dexkit/conformance/behaviours/fields.py",
        "return c.passed",
        "return not c.passed",
        False,
        None,
    ),
    ("dexkit/models/dex3.py", "1.5", "1.6", True, True),
    ("dexkit/conformance/kit/verdicts.py", "LARGER = 4.0", "LARGER = 5.0", False, True),
    # neither
    ("dexkit/conformance/faults/robot.py", "class ", "class X", False, False),
]


class EditedHere(Edited):
    """This checkout's sources with an edit; the other modules are not read again."""

    def __init__(self, edit: tuple[str, str, str]) -> None:
        super().__init__(ROOT, ("dexkit", "tools"), SPLIT, ("wrong_hand",), edit=edit)

    def _module(self, name: str) -> Any:
        is_it = self._file(name) == self.root / self._edit[0]
        return super()._module(name) if is_it else sources()._module(name)

    def _digest_of(self, place: Place) -> str:
        is_it = self._file(place[0]) == self.root / self._edit[0]
        return super()._digest_of(place) if is_it else sources()._digest_of(place)


@each(("file", "old", "new", "plays", "judges"), EDITS)
def test_a_key_changes_with_the_code_that_it_is_about(
    file: str, old: str, new: str, plays: bool | None, judges: bool | None
) -> None:
    after = EditedHere((file, old, new))
    played, judged = played_by(cheapest("dds", "dex3-1")), judging(("dds",))
    changes = sources().digest(played, JUDGES_ONLY) != after.digest(played, JUDGES_ONLY)
    assert plays is None or changes == plays
    assert judges is None or (sources().digest(judged) != after.digest(judged)) == judges


@each(
    ("layer_name", "model"),
    [("dds", "dex1-1"), ("dds", "dex3-1"), ("robot", "g1"), ("usb", "dex3-1")],
)
def test_no_phase_depends_on_a_check(layer_name: str, model: str) -> None:
    phases = parts_of(layer(layer_name).script(model))
    places = [sources().place(p.play.__module__, p.play.__qualname__) for p in phases]
    reached = sources().reached(places, JUDGES_ONLY)
    assert not {place for place in reached if place[0].startswith("dexkit.conformance.checks")}


def test_a_changed_check_is_judged_anew_and_no_other() -> None:
    every = [r for r in catalogue("dex3-1") if check_place(r)[0].endswith(".fields")]
    places = {r.id: check_place(r) for r in every}
    module, name = places["DEX3-FIELD-01"]
    after = EditedHere((f"{module.replace('.', '/')}.py", f"def {name}(", f"def {name}(extra, "))
    changed = {i for i, p in places.items() if sources().digest([p]) != after.digest([p])}
    assert changed == {i for i, p in places.items() if p == places["DEX3-FIELD-01"]}
    assert len(changed) < len(places)


def test_a_changed_wrong_hand_is_played_anew_and_no_other() -> None:
    given = [m for m in mutants("dds") if m.model == "dex1-1"]
    (chosen,) = (m for m in given if m.name == "BrakesEarly")
    module = next(c.__module__ for c in chosen.made.__mro__ if ".faults." in c.__module__)
    name = str(sys.modules[module].__file__).removeprefix(f"{ROOT}/")
    first = "from __future__ import annotations\n"
    after = EditedHere((name, first, f"{first}class More:\n    pass\n"))
    keys = [(m, played_by(m)) for m in given]
    added = {m.name for m, p in keys if sources().digest(p) != after.digest(p)}
    assert not added  # a wrong hand beside it
    (head,) = re.findall(rf"class {chosen.name}\(.*?:\n", (ROOT / name).read_text())
    after = EditedHere((name, head, f"{head}    more = 1\n"))
    without = JUDGES_ONLY
    changed = {m.name for m, p in keys if sources().digest(p, without) != after.digest(p, without)}
    assert changed == {
        m.name for m in given if any(c.__name__ == chosen.name for c in m.made.__mro__)
    }
    assert len(changed) < len(given) / 4


def test_the_plan_is_in_the_key() -> None:
    mutant = cheapest("dds", "dex3-1")
    other = replace(mutant, brief=not mutant.brief, whole=False)
    assert recording_key(mutant) != recording_key(other)
    assert recording_key(mutant) != recording_key(replace(mutant, sides=mutant.sides[:1] * 2))


def test_prose_of_a_requirement_is_not_in_the_key() -> None:
    (one, *_) = catalogue("dex3-1")
    assert data_of(replace(one, rationale="other", cause="other")) == data_of(one)
    assert data_of(replace(one, realtime=not one.realtime)) != data_of(one)
    assert data_of(replace(one, tolerances={"x": 1.0})) != data_of(one)


def test_no_verdict_depends_on_prose() -> None:
    usb = layer("usb")
    run = run_of(cheapest("usb", "dex3-1"))
    recording = usb.decode(run.play(run.made, run.about), None, ())
    every = catalogue("dex3-1", "usb")
    texts = dict.fromkeys(PROSE - {"plots", "kind"}, "x")
    other = [replace(r, **texts, plots=()) for r in every]
    ids = [r.id for r in every]
    found = verdicts_of(judge_layer(usb, recording, every), ids)
    assert found == verdicts_of(judge_layer(usb, recording, other), ids)


# ------------------------------------------------------------------- real runs, watched

WATCH = """
import sys
from tests.test_pins import watch

for name in sys.argv[1:]:
    watch(*name.split("/"))
    print(name)
"""
TABLES = frozenset(str(file) for file in (ROOT / "dexkit/conformance/layers").glob("*.py"))


class Watched:
    """Notes functions that are called and files that are opened while it is entered."""

    def __init__(self) -> None:
        self.called: set[tuple[str, int]] = set()
        self.opened: set[str] = set()
        self._on = False
        sys.addaudithook(self._audit)

    def __enter__(self) -> None:
        self.called.clear()
        self._on = True
        sys.setprofile(self._profile)

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        self._on = False

    def _profile(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>":
            self.called.add((code.co_filename, code.co_firstlineno))

    def _audit(self, event: str, arguments: tuple[object, ...]) -> None:
        if self._on and event == "open":
            self.opened.add(str(arguments[0]))

    def outside(self, allowed: Mapping[Path, set[int] | None]) -> list[tuple[str, int]]:
        """Functions of dexkit that are none of these lines."""
        assert self.called, "nothing was watched"
        found = []
        for file, line in sorted(self.called):
            lines = allowed.get(Path(file), set())
            if file.startswith(f"{ROOT}/dexkit/") and lines is not None and line not in lines:
                found.append((file, line))
        return found

    @property
    def data(self) -> list[str]:
        """Files of the checkout that were opened, apart from code."""
        return [n for n in self.opened if n.startswith(str(ROOT)) and ".py" not in Path(n).suffix]


def watch(layer_name: str, model: str) -> None:
    """In a process of its own: fail where a run leaves the code that its keys are made of."""
    mutant = cheapest(layer_name, model)
    by = ("client", "dds") if layer_name == "client" else (layer_name,)
    every = [r for r in catalogue(model, None) if r.layer in by]
    for requirement in every:
        check_of(requirement)  # so that nothing is imported while it is watched
    run = run_of(mutant)
    watched = Watched()
    with watched:
        trace = run.play(run.made, run.about)
    left = watched.outside(sources().lines(played_by(mutant), JUDGES_ONLY))
    assert all(file in TABLES for file, _ in left), left
    assert not watched.data
    kept = unpack(pack(trace))
    of_check: dict[str, set[tuple[str, int]]] = {}

    def watched_check(requirement: Requirement) -> Check:
        def judge_it(context: object) -> Outcome:
            before, watched.called = watched.called, of_check.setdefault(requirement.id, set())
            try:
                return check_of(requirement)(context)
            finally:
                watched.called = before

        return judge_it

    judge_module.check_of = watched_check
    with watched:
        run.judge(kept, run.about, None)
    allowed = sources().lines(judging(by))
    assert not (left := watched.outside(allowed)), left
    assert not watched.data
    assert of_check, "no check was called"
    for requirement in every:
        watched.called = of_check.get(requirement.id, {("", 0)})
        left = watched.outside(sources().lines(judging(by) | {check_place(requirement)}))
        assert not left, (requirement.id, left)


@pytest.mark.soak
def test_a_real_run_stays_in_the_code_of_its_keys() -> None:
    # in one process of its own, which reads the sources once
    runs = ["dds/dex3-1", "dds/inspire-ftp", "client/dex1-1", "robot/h1", "usb/dex3-1"]
    command = [sys.executable, "-c", WATCH, *runs]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == runs


# ------------------------------------------------------------------------------ what is kept


@pytest.mark.parametrize(("layer_name", "model"), [("dds", "dex3-1"), ("usb", "dex3-1")])
def test_a_requirement_alone_is_judged_as_among_all(layer_name: str, model: str) -> None:
    run = run_of(cheapest(layer_name, model))
    trace = run.play(run.made, run.about)
    names = [r.id for r in catalogue(model, layer_name)]
    every = verdicts_of(run.judge(trace, run.about, None), names)
    kept = unpack(pack(trace))
    for name in names:
        assert verdicts_of(run.judge(kept, run.about, [name]), [name])[name] == every[name]


def task_for(folder: Path, layer_name: str = "usb", model: str = "dex3-1") -> Task:
    (task,) = tasks(folder, [cheapest(layer_name, model).pin])
    return task


@pytest.mark.parametrize(("layer_name", "model"), [("usb", "dex3-1"), ("client", "dex1-1")])
def test_what_is_kept_gives_the_same_verdicts(tmp_path: Path, layer_name: str, model: str) -> None:
    task = task_for(tmp_path, layer_name, model)
    first = work(task)
    assert (first.played, first.judged) == (True, len(task.verdicts))
    assert known(task) == first.verdicts
    again = work(task)
    assert (again.verdicts, again.played, again.judged) == (first.verdicts, False, 0)
    # a check has changed
    name = next(iter(task.verdicts))
    changed = replace(task, verdicts={**task.verdicts, name: "another"})
    third = work(changed)
    assert (third.verdicts, third.played, third.judged) == (first.verdicts, False, 1)
    assert known(task) == first.verdicts, "what was known of the check before it is kept as well"
    # all of them have
    changed = replace(task, verdicts={name: f"new {name}" for name in task.verdicts})
    last = work(changed)
    assert (last.verdicts, last.played, last.judged) == (first.verdicts, False, len(task.verdicts))
    assert same_again(task) is True


@pytest.mark.parametrize("damage", [b"", b"x" * 100, None])
def test_damaged_files_are_made_again(tmp_path: Path, damage: bytes | None) -> None:
    task = task_for(tmp_path)
    first = work(task)
    for path in tmp_path.glob("??/*"):
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] if damage is None else damage)
    assert same_again(task) is False
    again = work(task)
    assert again == first
    assert again.played


# -------------------------------------------------------------------------------- the command

HANDS = {"usb m A (U-01)": ["U-01"], "usb m B (U-02)": ["U-02", "U-03"]}
SAMPLES = {"s": {"D-01 left": "pass: 3 ms", "D-02 left": "fail: 2"}}


@each(
    ("hands", "samples", "lines"),
    [
        ({}, {}, []),
        (
            {"usb m B (U-02)": ["U-01", "U-03"]},
            {},
            ["usb m B (U-02): +U-01 -U-02"],
        ),
        ({"usb m C (U-09)": ["U-09"]}, {}, ["usb m C (U-09): not pinned; blamed for U-09"]),
        (
            {},
            {"D-02 left": "pass: 2", "D-03 left": "pass: 1"},
            ["s: D-02 left: fail: 2 -> pass: 2", "s: D-03 left: nothing -> pass: 1"],
        ),
    ],
)
def test_differences_are_named(
    hands: dict[str, list[str]], samples: dict[str, str], lines: list[str]
) -> None:
    pins = Pins(HANDS, SAMPLES)
    found = Pins({**HANDS, **hands}, {"s": {**SAMPLES["s"], **samples}})
    assert list(pins.differences(found, everything=True)) == lines
    assert not list(found.differences(found, everything=True))


def test_what_is_gone_is_named_only_where_all_was_tried() -> None:
    pins, some = Pins(HANDS, SAMPLES), Pins({"usb m A (U-01)": ["U-01"]}, {})
    assert not list(pins.differences(some, everything=False))
    assert len(list(pins.differences(some, everything=True))) == 2
    assert pins.updated(some, everything=False) == pins
    assert pins.updated(some, everything=True) == some


def test_command_compares_and_writes(tmp_path: Path) -> None:
    mutant = cheapest("usb", "dex3-1")
    name, folder = mutant.pin, tmp_path / "pinned"
    folder.mkdir()
    wrong = Pins({name: ["DEX3USB-DESC-99"], "usb x Y (Z-01)": []}, {})
    wrong.save(folder)
    arguments = ["--cache", str(tmp_path / "cache"), "--only", f"usb-dex3-1-{mutant.name}"]
    arguments += ["--pinned", str(folder), "--jobs", "1"]
    run = CliRunner().invoke(main, arguments)
    assert run.exit_code == 1, run.output
    assert f"{name}: +{mutant.kills}" in run.output
    assert "-DEX3USB-DESC-99" in run.output
    assert "1 of those played" in run.output
    run = CliRunner().invoke(main, [*arguments, "--update"])
    assert run.exit_code == 0, run.output
    assert Pins.load(folder).hands == {name: sorted(mutant.pinned or ()), "usb x Y (Z-01)": []}
    run = CliRunner().invoke(main, arguments)
    assert run.exit_code == 0, run.output
    assert "0 of them judged" in run.output
    run = CliRunner().invoke(main, [*arguments, "--audit", "3"])
    assert run.exit_code == 0, run.output
    assert "1 recordings are still the same" in run.output


@each(
    ("arguments", "text"),
    [
        (["--only", "nobody"], "no wrong hand and no sample is called 'nobody'"),
        (["--jobs", "0"], "0"),
        (["--pinned", "/no/such"], "/no/such"),
    ],
)
def test_command_refuses(arguments: list[str], text: str, tmp_path: Path) -> None:
    run = CliRunner().invoke(main, ["--cache", str(tmp_path), *arguments])
    assert run.exit_code == 2, run.output
    assert text in run.output
