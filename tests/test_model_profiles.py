"""Profiles: everything about a hand is in one, and a package can add its own.

Other packages are distributions on ``sys.path`` with an ``entry_points.txt``, as pip leaves them.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
import subprocess
import sys
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

import dexkit.models
from dexkit.cli import cli
from dexkit.conformance.faults import mutants, plan_for, run_mutant
from dexkit.conformance.faults.matrix import chosen, cost, try_one
from dexkit.conformance.hands import BUILT_IN as UNDER_TEST
from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Overall
from dexkit.dds import DdsNode
from dexkit.errors import ModelBroken, UsageError
from dexkit.hand import Side
from dexkit.lazy import Lazy
from dexkit.models import BUILT_IN, DIALECTS, MODELS, model, model_plugins, short_names
from dexkit.robots import ROBOTS
from tests.dds_helpers import free_domain, take_until
from tests.optional import UV
from tests.patience import PATIENCE

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "twofinger-hand"
EXAMPLE_PACKAGE = "twofinger_hand"
NAME, DIALECT, BACKEND = "twofinger-1", "twofinger", "sim-twofinger"
STATE_TYPE = "unitree_hg::msg::dds_::HandState_"
ENTRIES = """\
[dexkit.models]
twofinger-1 = twofinger_hand.profile:TWOFINGER_1
[dexkit.conformance_hands]
twofinger-1 = twofinger_hand.under_test:UNDER_TEST
[dexkit.backends]
sim-twofinger = twofinger_hand.simulated:sim_twofinger
"""

# ------------------------------------------------------------------------ no tables elsewhere

NAMES = {m.name for m in BUILT_IN} | set(short_names()) | set(ROBOTS)
NAMES |= {d.name for m in BUILT_IN for d in m.dialects} | {"unitree_go", "unitree_hg"}
CONSTANTS = {
    "DEX1_1",
    "DEX3_1",
    "DEX5_1",
    "BRAINCO_REVO2",
    "INSPIRE_DFX",
    "INSPIRE_FTP",
    "H1",
    "G1",
}
NAMED = re.compile(rf"[\"']({'|'.join(NAMES)})[\"']|\b({'|'.join(CONSTANTS)})\b")
# what was measured is stated a model each
HOMES = (
    *("dexkit/models/", "dexkit/robots.py"),
    *("conformance/kit/catch_rates.py", "tools/consequences/"),
)
# wrong hands are declared for the models on which they are tried
WRONG_HANDS = "conformance/faults/"
# names of subcommands, with the module or the arguments of each
COMMANDS = ("dexkit/cli/emulate/__init__.py",)
# the lab's cases are about its own devices, one of each kind
# each set is made with a hand
SETS = "tools/spoiled_sets/"
LAB = "tools/lab/"


def names_a_model(node: ast.expr) -> bool:
    """Whether it is a model, as ``DEX1_1`` or ``robots.H1``, or its name or that of a dialect, as
    text or as ``DEX1_1.name``.
    """
    if isinstance(node, ast.Constant):
        return node.value in NAMES
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return any(names_a_model(e) for e in node.elts)
    if isinstance(node, ast.Attribute):
        return node.attr in CONSTANTS or (node.attr == "name" and names_a_model(node.value))
    return isinstance(node, ast.Name) and node.id in CONSTANTS


def by_name(source: str) -> list[int]:
    """Lines that compare with a name, or have a table with names as keys."""
    lines: list[int] = []
    if not NAMED.search(source):  # parsing every file takes seconds
        return lines
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            hit = any(names_a_model(part) for part in (node.left, *node.comparators))
        elif isinstance(node, ast.Dict):
            hit = any(names_a_model(key) for key in node.keys if key is not None)
        else:
            continue
        if hit:
            lines.append(node.lineno)
    return lines


def test_nothing_outside_the_profiles_depends_on_the_name_of_a_model_or_dialect() -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "dexkit/*.py", "drivers", "emulators", "conformance", "traces",
         "tools", "benchmarks"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    found = [
        f"{path}:{line}"
        for path in tracked
        if path.endswith(".py") and not path.startswith((*HOMES, WRONG_HANDS, *COMMANDS, LAB, SETS))
        for line in by_name((ROOT / path).read_text(encoding="utf-8"))
    ]
    assert not found, "make it a field of the profile: " + ", ".join(found)


def test_every_reference_of_a_profile_can_be_loaded() -> None:
    owners = [*UNDER_TEST, *(d for m in BUILT_IN for d in m.dialects)]
    references = [
        value
        for owner in owners
        for field in dataclasses.fields(owner)
        if isinstance(value := getattr(owner, field.name), Lazy)
    ]
    assert len(references) > 15
    assert all(reference.load() is not None for reference in references)


def test_a_reference_that_cannot_be_loaded_names_the_cause() -> None:
    with pytest.raises(ModelBroken, match="no_such_module"):
        Lazy[object]("no_such_module:x").load()
    with pytest.raises(ModelBroken, match=r"there is no 'nope' in dexkit\.models"):
        Lazy[object]("dexkit.models:nope").load()


def test_profiles_load_no_code_that_they_refer_to() -> None:
    code = "import sys, dexkit.models, dexkit.robots; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    early = ("conformance", "emulators", "service", "teleop", "messages", "family")
    assert not [m for m in loaded if m.startswith(tuple(f"dexkit.{name}" for name in early))]


# ---------------------------------------------------------------------- models of other packages


class Packages:
    """Installs packages into a folder on ``sys.path``."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def install(self, dist: str, entries: str, **modules: str) -> None:
        info = self.path / f"{dist.replace('-', '_')}-0.1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {dist}\nVersion: 0.1.0\n")
        (info / "entry_points.txt").write_text(entries)
        for name, code in modules.items():
            (self.path / f"{name}.py").write_text(code)
        forget()


def forget() -> None:
    """What was found out about installed packages."""
    from dexkit import lazy
    from dexkit.conformance.faults import registry
    from dexkit.conformance.kit import requirements

    importlib.invalidate_caches()
    dexkit.models._plugins = None
    registry._declared[:] = [
        d for d in registry._declared if d.made.__module__.startswith("dexkit")
    ]
    for cached in (requirements.catalogue, mutants, lazy._load, dexkit.models.registered_record):
        cached.cache_clear()


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield Packages(tmp_path)
    for name in {n for n in set(sys.modules) - before if not n.startswith("dexkit")}:
        del sys.modules[name]
    monkeypatch.undo()
    forget()


@pytest.fixture
def example(packages: Packages, monkeypatch: pytest.MonkeyPatch) -> Packages:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    packages.install("twofinger-hand", ENTRIES)
    return packages


def run(*arguments: str) -> str:
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    return result.output


def test_the_entry_points_are_those_of_the_example() -> None:
    project = (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")
    for line in ENTRIES.splitlines():
        if "=" in line:
            name, target = line.split(" = ")
            assert f'{name} = "{target}"' in project


def test_a_model_of_another_package_is_listed(example: Packages) -> None:
    assert (NAME in MODELS, DIALECT in DIALECTS) == (True, True)
    assert list(MODELS)[: len(BUILT_IN)] == [m.name for m in BUILT_IN]
    (plugin,) = model_plugins()
    assert (plugin.name, plugin.origin, plugin.error) == (NAME, "twofinger-hand 0.1.0", None)
    assert "Two-finger hand" in run("models")
    described = run("models", NAME)
    assert "rt/twofinger/{left,right}/cmd" in described
    assert "dexkit serve sim-twofinger" in described
    assert [r.id for r in catalogue("dex5-1")] == [
        r.id for r in catalogue(None) if r.model == "dex5-1"
    ]


@pytest.mark.slow
def test_the_reference_of_the_example_meets_every_requirement(example: Packages) -> None:
    result = run_mutant(under_test(NAME).reference.load(), plan_for(DIALECT))
    bad = [r.explain() for r in result.results if str(r.verdict) not in ("pass", "n/a")]
    assert result.overall is Overall.PASS, "\n".join(bad)
    assert {r.requirement.id for r in result.results} == {r.id for r in catalogue(NAME)}


@pytest.mark.slow
def test_every_requirement_of_the_example_has_a_wrong_hand(example: Packages) -> None:
    requirements, trials = chosen(NAME)
    assert {r.id for r in requirements} <= {t.kills for t in trials}
    own = {"SwapsFingers", "Degrees"}
    assert own <= {t.name for t in trials}
    inherited = min((t for t in trials if t.kills.endswith("FIELD-01")), key=cost)
    for trial in (inherited, *(t for t in trials if t.name in own)):
        assert try_one(trial, short=True).good, trial.name


def test_the_simulated_example_is_driven_by_the_model_of_the_client(example: Packages) -> None:
    from dexkit.backends import BackendOptions, backend
    from dexkit.service.dialects import dialect_map
    from dexkit.teleop import client_for, profiles_for

    hand = backend(BACKEND).create(BackendOptions(Side.RIGHT))
    codec = dialect_map(DIALECTS[DIALECT], {Side.RIGHT: hand.spec})
    assert codec.length == 6
    client = client_for(DIALECT)
    rest = {s: model(NAME).rest_q[s] for s in Side}
    commands = client.step(0.0, rest, dict.fromkeys(Side, (0.1,) * 6))
    assert {m.mode for m in commands[Side.LEFT]} == {1}
    assert "pinch" in {p.name for p in profiles_for(NAME)}


WRONG_TYPES = """
    dialects=(
        replace(DEX5_1.dialects[0], name="bad", model="bad-1", state_type="a::B_"),
    ),
"""
BAD_PROFILE = """
from dataclasses import replace
from dexkit.models import DEX5_1, DEX3_1
MODEL = replace(DEX5_1, name="bad-1", {change})
"""


def test_profiles_of_dexkit_meet_what_is_asked_of_others() -> None:
    for hand in BUILT_IN:
        assert dexkit.models._checked(hand, hand.name) is hand


@pytest.mark.parametrize(
    ("name", "code", "why"),
    [
        ("bad-1", "raise RuntimeError('boom')", "RuntimeError: boom"),
        ("bad-1", "import no_such_module_at_all", "ModuleNotFoundError"),
        ("bad-1", "x = 1", "there is no 'MODEL' in bad_hand"),
        ("bad-1", "MODEL = 42", "is a int, not a hand model"),
        ("bad-1", "from dexkit.models import DEX3_1 as MODEL", "its profile is named 'dex3-1'"),
        ("dex3-1", "from dexkit.models import DEX3_1 as MODEL", "registers dex3-1"),
        ("bad-1", BAD_PROFILE.format(change="dialects=()"), "it has no dialect"),
        ("bad-1", BAD_PROFILE.format(change=""), "its dialect dex5 is of 'dex5-1'"),
        ("bad-1", BAD_PROFILE.format(change="joints={}"), "it has no joints"),
        ("bad-1", BAD_PROFILE.format(change="rest_q=DEX3_1.rest_q"), "rest_q of the left hand"),
        ("bad-1", BAD_PROFILE.format(change=WRONG_TYPES), "has to use the types unitree_hg"),
    ],
)
def test_a_broken_model_says_why_and_affects_no_other(
    example: Packages, name: str, code: str, why: str
) -> None:
    example.install("broken-hand", f"[dexkit.models]\n{name} = bad_hand:MODEL\n", bad_hand=code)
    errors = {p.name: p.error for p in model_plugins() if p.error}
    assert set(errors) == {name}
    assert why in str(errors[name])
    assert list(MODELS) == [*(m.name for m in BUILT_IN), NAME]
    listing = run("models")
    assert "Two-finger hand" in listing
    assert why.split()[0] in listing
    if name not in MODELS:
        with pytest.raises(ModelBroken):
            model(name)


REQUIREMENTS = """
from dataclasses import replace
from pathlib import Path
from twofinger_hand.profile import TWOFINGER_1
from twofinger_hand.under_test import UNDER_TEST as FIRST
dialect = replace(TWOFINGER_1.dialects[0], name="second", model="second-1",
    cmd_topic="rt/second/{side}/cmd", state_topic="rt/second/{side}/state")
MODEL = replace(TWOFINGER_1, name="second-1", dialects=(dialect,))
UNDER_TEST = replace(FIRST, model=MODEL, requirements=(Path(__file__).with_name("second.toml"),))
"""


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('model = "second-1"\n[[requirement', "second.toml"),
        ('model = "second-1"\nprefix = "S"\n[[requirement]]\nlike = "NO-01"\n', "no requirement"),
        ('model = "dex3-1"\nprefix = "S"\n[[requirement]]\nlike = "DEX3-TOPIC-01"\n', "of dex3-1"),
        (None, "second.toml"),
    ],
)
def test_a_broken_requirement_file_affects_no_other_model(
    example: Packages, text: str | None, why: str
) -> None:
    entries = "[dexkit.models]\nsecond-1 = second_hand:MODEL\n"
    entries += "[dexkit.conformance_hands]\nsecond-1 = second_hand:UNDER_TEST\n"
    example.install("second-hand", entries, second_hand=REQUIREMENTS)
    if text is not None:
        (example.path / "second.toml").write_text(text)
    assert {r.model for r in catalogue()} == {*(m.name for m in BUILT_IN), NAME}
    with pytest.raises(UsageError, match=why):
        catalogue("second-1")


def test_a_model_that_its_package_does_not_judge_has_no_requirements(example: Packages) -> None:
    example.install("second-hand", "[dexkit.models]\nsecond-1 = second_hand:MODEL\n",
                    second_hand=REQUIREMENTS)  # fmt: skip
    assert "second-1" in MODELS
    assert {r.model for r in catalogue()} == {*(m.name for m in BUILT_IN), NAME}
    with pytest.raises(UsageError, match="no requirements for second-1"):
        catalogue("second-1")


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("x = 1", "there is no 'UNDER_TEST'"),
        ("UNDER_TEST = 1", "is a int, not a ModelUnderTest"),
        ("from twofinger_hand.under_test import UNDER_TEST", "is about twofinger-1, not second-1"),
        (REQUIREMENTS + "UNDER_TEST = replace(UNDER_TEST, roles=None)", "needs joint roles"),
    ],
)
def test_a_broken_record_for_the_kit_says_why(example: Packages, code: str, why: str) -> None:
    entries = "[dexkit.conformance_hands]\nsecond-1 = second_hand:UNDER_TEST\n"
    example.install("second-hand", entries, second_hand=code)
    with pytest.raises(ModelBroken, match=why):
        under_test("second-1")


# ------------------------------------------------------------------------------- as a vendor would


def live(*command: str, timeout: float = 400.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, cwd="/", check=False
    )


def serves_states(python: Path, *arguments: str) -> None:
    """``dexkit ARGUMENTS`` publishes states of both hands, and ends as it is asked to."""
    domain = free_domain()
    command = [str(python), "-m", "dexkit", *arguments, "--domain", str(domain)]
    with DdsNode(domain) as node, subprocess.Popen(command, cwd="/") as process:
        try:
            for side in Side:
                states = node.reader(f"rt/{DIALECT}/{side}/state", STATE_TYPE)
                take_until(states, lambda samples: len(samples) >= 10)
        finally:
            process.terminate()
        assert process.wait(PATIENCE) == 0


def site_packages(home: Path) -> Path:
    """The packages of an environment, among them dexkit as it is here."""
    (packages,) = home.glob("lib/python*/site-packages")
    own = [path for path in sys.path if path.endswith("site-packages")]
    # commands that the kit starts take no PYTHONPATH
    (packages / "dexkit.pth").write_text("\n".join([*own, str(ROOT)]))
    return packages


def test_robot_with_the_hands_of_another_package_publishes_states(tmp_path: Path) -> None:
    """``emulate all`` starts ``serve``; each finds the package by its entry points."""
    home = tmp_path / "env"
    venv.create(home, symlinks=True)
    packages = site_packages(home)
    Packages(packages).install("twofinger-hand", ENTRIES)
    (packages / EXAMPLE_PACKAGE).symlink_to(EXAMPLE / EXAMPLE_PACKAGE)
    serves_states(home / "bin" / "python", "emulate", "all", "--hands", DIALECT)


@pytest.mark.soak
def test_the_installed_example_is_served_and_judged(tmp_path: Path) -> None:
    """In an environment of its own, which has dexkit, and the example as pip installs it."""
    home = tmp_path / "env"
    python = home / "bin" / "python"
    for arguments in (
        ("venv", "--quiet", "--python", sys.executable, str(home)),
        ("pip", "install", "--quiet", "--no-deps", "--python", str(python), str(EXAMPLE)),
    ):
        done = live(str(UV), *arguments)
        assert done.returncode == 0, done.stderr
    site_packages(home)
    assert "Two-finger hand" in live(str(python), "-m", "dexkit", "models").stdout
    serves_states(python, "serve", BACKEND, "--side", "both")
    serves_states(python, "emulate", "all", "--hands", DIALECT)
    report = tmp_path / "report.html"
    suite = live(
        *(str(python), "-m", "pytest", "--pyargs", "dexkit.conformance", "-c", "/dev/null"),
        *("-p", "no:cacheprovider", "--backend", BACKEND, "--domain", str(free_domain())),
        *("--report", str(report)),
    )
    assert suite.returncode == 0, suite.stdout + suite.stderr
    assert "Two-finger hand" in report.read_text(encoding="utf-8")
    matrix = live(str(python), "-m", "dexkit.conformance.faults", "--model", NAME, "--jobs", "2")
    assert matrix.returncode == 0, matrix.stdout + matrix.stderr
