"""The GitHub Action and the container file, as far as they run without GitHub or Docker.

The shell scripts of action.yml are run as a runner would: bash with its flags, the steps' ``env``
with the inputs put in, GITHUB_OUTPUT and GITHUB_STEP_SUMMARY as files. What is not run: the
actions of others that it uses (setup-python, upload-artifact), and a real build of the container.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from tests import test_package as package
from tests.dds_helpers import free_domain

ROOT = Path(__file__).parent.parent
ACME = ROOT / "examples" / "acme-gripper"
ACTION: dict[str, Any] = YAML(typ="safe").load(ROOT / "action.yml")
STEPS: list[dict[str, Any]] = ACTION["runs"]["steps"]


@dataclass
class Runner:
    """As much of GitHub's runner as a composite action's shell steps see."""

    home: Path
    path: str

    @property
    def workspace(self) -> Path:
        return self.home / "workspace"

    def __call__(self, name: str, **inputs: str) -> subprocess.CompletedProcess[str]:
        """Run the step of that name."""
        step = next(s for s in STEPS if s["name"] == name)
        assert step["shell"] == "bash"
        self.workspace.mkdir(exist_ok=True)
        script = self.home / "step.sh"
        script.write_text(step["run"])
        env = {k: v for k, v in os.environ.items() if k not in {"VIRTUAL_ENV", "PYTHONPATH"}}
        env |= {k: fill_in(v, inputs) for k, v in step.get("env", {}).items()}
        env |= {
            "PATH": self.path,
            "GITHUB_ACTION_PATH": str(ROOT),
            "GITHUB_WORKSPACE": str(self.workspace),
            "GITHUB_OUTPUT": str(self.home / "output"),
            "GITHUB_STEP_SUMMARY": str(self.home / "summary.md"),
        }
        return subprocess.run(
            ["bash", "--noprofile", "--norc", "-eo", "pipefail", script],
            cwd=self.workspace,
            env=env,
            capture_output=True,
            text=True,
            timeout=240,
        )

    @property
    def outputs(self) -> dict[str, str]:
        lines = (self.home / "output").read_text().splitlines()
        return dict(line.split("=", 1) for line in lines)

    @property
    def summary(self) -> str:
        return (self.home / "summary.md").read_text()


def fill_in(value: str, inputs: dict[str, str]) -> str:
    def of_input(match: re.Match[str]) -> str:
        name = match[1].replace("-", "_")
        return inputs[name] if name in inputs else str(ACTION["inputs"][match[1]]["default"])

    filled = re.sub(r"\$\{\{ inputs\.([a-z-]+) \}\}", of_input, value)
    assert "${{" not in filled
    return filled


def command(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


# ---------------------------------------------------------------------- what it is made of


def test_action_follows_the_metadata_syntax_of_composite_actions() -> None:
    assert set(ACTION) == {"name", "description", "branding", "inputs", "outputs", "runs"}
    assert ACTION["runs"]["using"] == "composite"
    assert set(ACTION["branding"]) == {"icon", "color"}
    for name, about in ACTION["inputs"].items():
        assert re.fullmatch(r"[a-z][a-z-]*", name)
        assert about["description"]
        # required inputs have no default, all others one that is a text
        assert about.get("required", False) != isinstance(about.get("default"), str), name
    ids = {step.get("id") for step in STEPS}
    for about in ACTION["outputs"].values():
        step, output = re.fullmatch(
            r"\$\{\{ steps\.(\w+)\.outputs\.([a-z-]+) \}\}", about["value"]
        ).groups()  # type: ignore[union-attr]
        assert step in ids
        assert f"{output}=" in next(s["run"] for s in STEPS if s.get("id") == step)
    for step in STEPS:
        allowed = {"name", "id", "if"} | (
            {"shell", "env", "run"} if "run" in step else {"uses", "with"}
        )
        assert set(step) <= allowed
        assert ("run" in step) != ("uses" in step)


def test_inputs_reach_the_shell_as_variables_only() -> None:
    for step in STEPS:
        assert "${{" not in step.get("run", "")  # would be pasted into the script
    used = re.findall(r"inputs\.([a-z-]+)", (ROOT / "action.yml").read_text())
    assert set(used) == set(ACTION["inputs"])


# -------------------------------------------------- its arguments and exit codes, on stand-ins


@pytest.fixture
def pretended(tmp_path: Path) -> Runner:
    """A python that notes its arguments and exits with the code in the file ``status``."""
    programs = tmp_path / "bin"
    programs.mkdir()
    note = f"""#!/bin/bash
printf '%s\\n' "$@" > {tmp_path}/arguments
[[ ! -f {tmp_path}/result ]] || cp {tmp_path}/result dexkit-report/result.json
exit $(cat {tmp_path}/status)
"""
    command(programs / "python", note)
    command(programs / "dexkit", '#!/bin/bash\necho "table of $2"\n')
    (tmp_path / "status").write_text("0")
    (tmp_path / "result").write_text("{}")
    return Runner(tmp_path, f"{programs}:{os.environ['PATH']}")


def test_every_input_becomes_an_option(pretended: Runner) -> None:
    ran = pretended(
        "Judge the hand",
        backend="external",
        device="left=/dev/a b\nright=/dev/c\n",
        side="both",
        dialect="unitree_hg",
        domain="3",
        object="right=37",
        capabilities="my capabilities.toml",
        level="must",
        requirements="DEX1-RATE\nDEX1-MOVE-02",
        arguments="--quick --set 'force=12 N'",
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    arguments = (pretended.home / "arguments").read_text().splitlines()
    assert arguments[:3] == ["-m", "pytest", "--pyargs"]
    given = " ".join(shlex.quote(a) for a in arguments)
    for part in (
        "--backend external --device 'left=/dev/a b' --device right=/dev/c --side both",
        "--dialect unitree_hg --domain 3 --object right=37 --capabilities 'my capabilities.toml'",
        "--level must --require DEX1-RATE --require DEX1-MOVE-02 --quick --set 'force=12 N'",
        "--result dexkit-report/result.json --report dexkit-report/report.html",
        "--junitxml dexkit-report/junit.xml",
    ):
        assert part in given


@pytest.mark.parametrize("status", [0, 1, 2, 4, 5])
def test_the_exit_code_of_the_suite_is_the_steps(pretended: Runner, status: int) -> None:
    (pretended.home / "status").write_text(str(status))
    if status >= 2:
        (pretended.home / "result").unlink()
    assert pretended("Judge the hand", backend="acme").returncode == status
    assert pretended.outputs["exit-code"] == str(status)
    said = "nothing was judged" if status >= 2 else "table of dexkit-report/result.json"
    assert said in pretended.summary
    # an output names a file that is there, or nothing
    result = "dexkit-report/result.json" if status < 2 else ""
    assert pretended.outputs == {"exit-code": str(status), "result": result, "report": ""}


def test_inputs_of_the_action_are_trimmed(pretended: Runner) -> None:
    ran = pretended(
        "Judge the hand",
        backend=" acme\r\n",
        device="\tleft=/dev/a b \r\n  right=/dev/c\n \r\n",
        requirements="  DEX1-RATE  \r\n\r\n\tDEX1-MOVE-02\t",
        arguments="--quick\r\n --set 'force=12 N' \r\n",
        output=" mine \r\n",
    )
    assert ran.returncode == 2  # the pretended result is in the default's folder
    arguments = (pretended.home / "arguments").read_text().splitlines()
    first = arguments.index("--backend")
    assert arguments[first : first + 13] == [
        *("--backend", "acme", "--device", "left=/dev/a b", "--device", "right=/dev/c"),
        *("--require", "DEX1-RATE", "--require", "DEX1-MOVE-02"),
        *("--quick", "--set", "force=12 N"),
    ]
    assert arguments[-1] == "mine/junit.xml"


def test_a_quote_without_end_is_a_wrong_option_and_nothing_runs(pretended: Runner) -> None:
    ran = pretended("Judge the hand", backend="acme", arguments="--quick --set 'force=12")
    assert ran.returncode == 4
    assert pretended.outputs == {"exit-code": "4", "result": "", "report": ""}
    assert "a quote in it has no end" in ran.stdout
    assert "a quote in it has no end" in pretended.summary
    assert not (pretended.home / "arguments").exists()


def test_success_without_a_result_file_fails(pretended: Runner) -> None:
    (pretended.home / "result").unlink()
    ran = pretended("Judge the hand", backend="acme", arguments="--list")
    assert ran.returncode == 2
    assert pretended.outputs == {"exit-code": "2", "result": "", "report": ""}
    _, head, rest = ran.stdout.partition("::stop-commands::")
    token, _, printed = rest.partition("\n")
    assert head
    assert len(token) == 32
    assert "::error" in printed.partition(f"::{token}::\n")[2]
    assert "the suite ended without a result" in pretended.summary


def test_the_files_are_where_the_outputs_say_whatever_the_arguments_name(
    pretended: Runner,
) -> None:
    assert pretended("Judge the hand", backend="acme", arguments="--result m.json").returncode == 0
    arguments = (pretended.home / "arguments").read_text().splitlines()
    names = [b for a, b in pairwise(arguments) if a == "--result"]
    assert names == ["m.json", "dexkit-report/result.json"]  # the last one counts


def test_preparing_ends_at_the_first_command_that_fails(pretended: Runner) -> None:
    assert pretended("Prepare", prepare="echo $((40 + 2)) > it\r\ntrue").returncode == 0
    assert (pretended.workspace / "it").read_text() == "42\n"
    assert pretended("Prepare", prepare="(exit 3) | cat\nrm it").returncode == 3
    assert (pretended.workspace / "it").exists()


def test_the_result_of_a_run_before_is_not_taken_for_this_one(pretended: Runner) -> None:
    folder = pretended.home / "workspace" / "dexkit-report"
    folder.mkdir(parents=True)
    (folder / "result.json").write_text("{}")
    (pretended.home / "result").unlink()
    (pretended.home / "status").write_text("2")
    assert pretended("Judge the hand", backend="acme").returncode == 2
    assert "nothing was judged" in pretended.summary


def test_failed_installation_ends_the_action(pretended: Runner) -> None:
    (pretended.home / "status").write_text("1")
    ran = pretended("Install dexkit and the backend", install="nothing-of-this-name")
    assert ran.returncode != 0
    arguments = (pretended.home / "arguments").read_text().splitlines()
    assert arguments[-2:] == [f"{ROOT}[conformance]", "nothing-of-this-name"]


def test_listing_requirements_is_not_a_pass(tmp_path: Path) -> None:
    runner = Runner(tmp_path, f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    ran = runner("Judge the hand", backend="sim-dex1", arguments="--list")
    assert "DEX1-TOPIC-01" in ran.stdout
    assert ran.returncode == 2
    assert "nothing was judged" in runner.summary


# --------------------------------------------------------------------------- the whole of it


START = """
acme-emulator --port 0 > emulator.log 2>&1 &
echo $! > emulator.pid
until grep ready: emulator.log; do kill -0 $!; sleep 0.05; done
"""


@contextmanager
def emulator(runner: Runner) -> Iterator[str]:
    """An emulated Acme gripper, as docs/ci.md has it started; its address."""
    ran = runner("Prepare", prepare=START)
    try:
        assert ran.returncode == 0, ran.stderr
        yield ran.stdout.removeprefix("ready: ").strip()
    finally:  # it outlives its step; at the end of the job a runner ends it
        os.kill(int((runner.workspace / "emulator.pid").read_text()), signal.SIGTERM)


@pytest.fixture(scope="module")
def vendor(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    """A fresh environment, with dexkit and the Acme package put in by the action's own step.

    uv does what pip would: the same, faster.
    """
    home = tmp_path_factory.mktemp("vendor")
    package.run(package.UV, "venv", "--quiet", "--python", sys.executable, "env", cwd=home)
    shims = home / "shims"
    shims.mkdir()
    env, uv = home / "env", f"{package.UV} pip install --refresh-package dexkit --quiet"
    command(
        shims / "python",
        f"""#!/bin/bash
case "$*" in
    "-m pip install --disable-pip-version-check --quiet "*)
        exec {uv} --python {env} "${{@:6}}" ;;
    *)  exec {env}/bin/python "$@" ;;
esac
""",
    )
    runner = Runner(home, f"{home}/env/bin:{os.environ['PATH']}")
    installer = Runner(home, f"{shims}:{runner.path}")
    ran = installer("Install dexkit and the backend", install=f"'{ACME}'")
    assert ran.returncode == 0, ran.stderr
    assert "acme (acme-gripper 0.1.0, dex1-1)" in ran.stdout
    return runner


@pytest.mark.soak
@pytest.mark.skipif(
    sys.version_info >= (3, 11), reason="CycloneDDS 0.10 has wheels up to Python 3.10"
)
def test_a_plug_in_is_judged_through_its_entry_point_outside_the_checkout(vendor: Runner) -> None:
    """Default options of a vendor's workflow, but for the requirements: it is one live run."""
    # a repository's own settings of pytest are not the suite's
    vendor.workspace.mkdir(exist_ok=True)
    (vendor.workspace / "pytest.ini").write_text("[pytest]\naddopts = --no-such-option\n")
    with emulator(vendor) as address:
        ran = vendor(
            "Judge the hand",
            backend="acme",
            device=address,
            domain=str(free_domain()),
            capabilities=str(ACME / "capabilities.toml"),
            # none that a busy machine leaves open
            requirements="DEX1-TOPIC\nDEX1-FIELD-01\nDEX1-MOVE-02\n",
        )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    out = vendor.workspace / "dexkit-report"
    result = json.loads((out / "result.json").read_text())
    assert result["subject"]["backend"] == "acme"
    verdicts = {r["id"]: r["verdict"] for r in result["results"]}
    asked = ("DEX1-TOPIC-01", "DEX1-TOPIC-02", "DEX1-FIELD-01", "DEX1-MOVE-02")
    assert verdicts == dict.fromkeys(asked, "pass")
    assert result["subject"]["hand"] == "Acme G2"  # of the capabilities
    assert "DEX1-MOVE-02" in (out / "junit.xml").read_text()
    assert "DEX1-MOVE-02" in (out / "report.html").read_text()
    assert (out / "recording.mcap").stat().st_size > 10_000
    assert "dex1" in vendor.summary.lower()
    assert vendor.outputs == {
        "exit-code": "0",
        "result": "dexkit-report/result.json",
        "report": "dexkit-report/report.html",
    }


# ------------------------------------------------------------------------------ the container


def test_the_container_is_built_from_all_that_the_wheel_needs() -> None:
    # podman reads it, too, as long as there is no .containerignore; docker knows only this one
    assert not (ROOT / ".containerignore").exists()
    left_out = (ROOT / ".dockerignore").read_text().splitlines()
    for needed in ("dexkit", "drivers", "emulators", "conformance", "traces", "packaging"):
        assert needed not in left_out
    for heavy in (".git", ".venv"):
        assert heavy in left_out
