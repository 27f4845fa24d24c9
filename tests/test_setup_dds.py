"""``dexkit setup-dds``: what is found, what is decided, what each failure says.

Nothing is built here but in the test at the end, which takes a minute.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import struct
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from dexkit.cli import main
from dexkit.errors import (
    DdsBuildFailed,
    DdsInstallError,
    DdsLibraryMissing,
    DexkitError,
    InterpreterRefused,
)
from dexkit.setup_dds import execute, inspect_machine, pinned_wheel, plan, probe
from dexkit.setup_dds.facts import Distribution, Installed, Interpreter, Library, Machine
from dexkit.setup_dds.process_runner import Done, Interrupted, ProcessRunner
from dexkit.stop_signals import StopRequest
from tests import optional
from tests.each import each

DEBIAN_12 = Distribution("debian", "12", "Debian GNU/Linux 12 (bookworm)")
LIBRARY = Library(
    "the distribution",
    "/usr/include",
    "/usr/lib/x86_64-linux-gnu",
    "libddsc.so.0",
    "/usr/lib/x86_64-linux-gnu/libddsc.so.0.10.5",
    header_version="0.10.5",
    version="0.10.5",
    processor="x86_64",
)
PYTHON = Interpreter(
    executable="/env/bin/python",
    version=(3, 12, 1),
    implementation="cpython",
    free_threaded=False,
    system="linux",
    processor="x86_64",
    kind="venv",
    prefix="/env",
    packages="/env/lib/python3.12/site-packages",
    not_writable="",
    headers="/usr/include/python3.12",
    compiler="/usr/bin/cc",
    pip=True,
    ensurepip=True,
    uv="",
    made_by_uv=False,
)
MACHINE = Machine(
    interpreter=PYTHON,
    installed=Installed(),
    libraries=(LIBRARY,),
    distribution=DEBIAN_12,
    temporary="/tmp",
    free=(1 << 40, 1 << 40),
    elsewhere=(),
    needs_variables=(),
    cmake="/usr/bin/cmake",
)


def with_python(**changes: Any) -> Machine:
    return dataclasses.replace(MACHINE, interpreter=dataclasses.replace(PYTHON, **changes))


def with_library(**changes: Any) -> Machine:
    return dataclasses.replace(MACHINE, libraries=(dataclasses.replace(LIBRARY, **changes),))


def refusal(
    machine: Machine, options: plan.Options | None = None, kind: type[DexkitError] = DdsInstallError
) -> str:
    """Message and hint of the one error that a plan raises."""
    with pytest.raises(kind) as caught:
        plan.make_plan(machine, options)
    assert caught.value.hint
    assert caught.value.exit_code == 2
    return f"{caught.value.message}\n{caught.value.hint}"


# --- what is decided


def test_a_cyclonedds_that_works_stays() -> None:
    machine = dataclasses.replace(MACHINE, installed=Installed("0.10.2", "", ("/x/libddsc.so.0",)))
    assert isinstance(plan.make_plan(machine).action, plan.Keep)


def test_working_cyclonedds_is_replaced_on_request_only() -> None:
    installed = Installed("0.10.5", "", ("/x/libddsc.so.0",))
    machine = dataclasses.replace(
        MACHINE, installed=installed, needs_variables=("LD_LIBRARY_PATH",)
    )
    (note,) = plan.make_plan(machine).notes
    assert "LD_LIBRARY_PATH" in note
    replaced = plan.make_plan(machine, plan.Options(replace=True))
    assert replaced.action == plan.Build(LIBRARY)
    assert not replaced.notes


@each("problem", ["libddsc.so: cannot open shared object file", ""])
def test_cyclonedds_that_does_not_work_is_built_again(problem: str) -> None:
    libraries = () if problem else ("/opt/ros/jazzy/lib/libddsc.so.0", "/x/libddsc.so.0.10.5")
    installed = Installed("0.10.5", problem, libraries)
    found = plan.make_plan(dataclasses.replace(MACHINE, installed=installed))
    assert found.action == plan.Build(LIBRARY)
    assert (problem or "two CycloneDDS libraries") in found.examined[0]


def test_cyclonedds_that_loads_library_11_is_built_again() -> None:
    installed = Installed("0.10.5", "", ("/usr/local/lib/libddsc.so.11.0.1",))
    found = plan.make_plan(dataclasses.replace(MACHINE, installed=installed))
    assert isinstance(found.action, plan.Build)
    # the wheel 0.10.2 of the package index has a library of this name; it is a 0.10
    wheel = Installed("0.10.2", "", ("/env/cyclonedds.libs/libddsc-1f.so.0.11.0",))
    kept = plan.make_plan(dataclasses.replace(MACHINE, installed=wheel))
    assert isinstance(kept.action, plan.Keep)


def test_cyclonedds_11_is_refused_and_explained_and_replaced_only_on_request() -> None:
    machine = dataclasses.replace(MACHINE, installed=Installed("11.0.1"))
    said = refusal(machine, kind=InterpreterRefused)
    assert "11.0.1" in said
    assert "crashes" in said
    assert "--replace" in said
    found = plan.make_plan(machine, plan.Options(replace=True))
    assert isinstance(found.action, plan.Build)


@each("version", [(3, 10, 13), (3, 11, 7), (3, 12, 1), (3, 13, 0)])
def test_a_wheel_is_taken_where_the_index_has_one(version: tuple[int, int, int]) -> None:
    for processor in ("x86_64", "aarch64"):
        machine = dataclasses.replace(
            with_python(version=version, processor=processor),
            libraries=(dataclasses.replace(LIBRARY, processor=processor),),
        )
        has_wheel = version[:2] == (3, 10) and processor == "x86_64"
        kind = plan.FromIndex if has_wheel else plan.Build
        assert isinstance(plan.make_plan(machine).action, kind), (version, processor)


def test_libraries_that_cannot_be_used_are_passed_over_with_their_reason() -> None:
    others = (
        dataclasses.replace(LIBRARY, origin="a", header_version="11.0.1", version="11.0.1"),
        dataclasses.replace(LIBRARY, origin="b", header_version="0.8.2", version="0.8.2"),
        dataclasses.replace(LIBRARY, origin="c", include=""),
        dataclasses.replace(LIBRARY, origin="d", processor="aarch64"),
        dataclasses.replace(LIBRARY, origin="e", version="11.0.1"),  # headers of another one
        dataclasses.replace(LIBRARY, origin="f", header_version=""),
    )
    found = plan.make_plan(dataclasses.replace(MACHINE, libraries=(*others, LIBRARY)))
    assert found.action == plan.Build(LIBRARY)
    reasons = "\n".join(found.examined)
    for reason in (
        "11.0.1, not 0.10.x",
        "0.8.2, not 0.10.x",
        "no headers",
        "is for aarch64, not x86_64",
        "no version",
    ):
        assert reason in reasons
    said = refusal(dataclasses.replace(MACHINE, libraries=others), kind=DdsLibraryMissing)
    assert "sudo apt install cyclonedds-dev" in said
    for library in others:
        assert f"; {library.origin}: " in said


@each("folder", ["/home/u/cyclonedds/install/lib", "/tmp/x/lib", "/var/tmp/x/lib"])
def test_a_library_in_a_folder_that_may_go_away_is_pointed_out(folder: str) -> None:
    notes = " ".join(plan.make_plan(with_library(folder=folder)).notes)
    assert folder in notes
    assert ("temporary" in notes) == ("tmp" in folder)


def test_another_library_that_every_program_is_offered_is_pointed_out() -> None:
    machine = dataclasses.replace(MACHINE, elsewhere=("/opt/ros/humble/lib/libddsc.so.0",))
    (note,) = plan.make_plan(machine).notes
    assert "/opt/ros/humble/lib/libddsc.so.0" in note
    assert "crashes" in note
    mine = dataclasses.replace(MACHINE, elsewhere=(LIBRARY.real,))
    assert not plan.make_plan(mine).notes


# --- what cannot be done here: each is refused before anything is done


SOURCE = plan.Options(source="/home/u/c", source_version="0.10.5")
FULL = 1_000_000
REFUSED: dict[str, tuple[Machine, plan.Options | None, type[DexkitError]]] = {
    "this is Python 3.9;": (with_python(version=(3, 9, 18)), None, InterpreterRefused),
    "this is Python 3.14;": (with_python(version=(3, 14, 0)), None, InterpreterRefused),
    "does not support pypy": (with_python(implementation="pypy"), None, InterpreterRefused),
    "free-threaded": (
        with_python(free_threaded=True, version=(3, 13, 0)),
        None,
        InterpreterRefused,
    ),
    "the processor arm": (with_python(processor="arm"), None, InterpreterRefused),
    "on Linux only": (with_python(system="darwin"), None, InterpreterRefused),
    "PEP 668": (with_python(kind="system"), None, InterpreterRefused),
    "Read-only": (with_python(not_writable="Read-only file system"), None, InterpreterRefused),
    "python3.12-venv": (with_python(pip=False, ensurepip=False), None, InterpreterRefused),
    "no C compiler": (with_python(compiler=""), None, DdsLibraryMissing),
    "python3.12-dev": (with_python(headers=""), None, DdsLibraryMissing),
    "1 MB are free": (dataclasses.replace(MACHINE, free=(1 << 40, FULL)), None, DdsInstallError),
    "TMPDIR": (dataclasses.replace(MACHINE, free=(FULL, 1 << 40)), None, DdsInstallError),
    "no checkout": (MACHINE, plan.Options(source="/c", source_version=""), DdsLibraryMissing),
    "is CycloneDDS 11.0.1": (
        MACHINE,
        plan.Options(source="/c", source_version="11.0.1"),
        DdsLibraryMissing,
    ),
    "apt install cmake": (dataclasses.replace(MACHINE, cmake=""), SOURCE, DdsLibraryMissing),
}


@each("words", list(REFUSED))
def test_what_cannot_be_done_here_is_refused(words: str) -> None:
    machine, options, kind = REFUSED[words]
    assert words in refusal(machine, options, kind)


# --- what is found


def elf(path: Path, machine: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HH", 3, machine) + bytes(9))


def make_library(
    prefix: Path, folder: str = "lib", version: str = "0.10.5", machine: int = 62
) -> None:
    elf(prefix / folder / f"libddsc.so.{version}", machine)
    (prefix / folder / "libddsc.so.0").symlink_to(f"libddsc.so.{version}")
    (prefix / folder / "libddsc.so").symlink_to("libddsc.so.0")
    headers = prefix / "include" / "dds"
    headers.mkdir(parents=True, exist_ok=True)
    (headers / "dds.h").write_text("")
    (headers / "version.h").write_text(f'#define DDS_VERSION "{version}"\n')


def found(root: Path, **environment: str) -> list[Library]:
    given = {"HOME": str(root / "home"), **environment}
    return list(inspect_machine.libraries(given, str(root / "env"), "x86_64", root))


def test_libraries_are_found_in_their_usual_places_and_in_order(tmp_path: Path) -> None:
    make_library(tmp_path / "usr", "lib/x86_64-linux-gnu", "0.10.2")
    make_library(tmp_path / "home/cyclonedds_ws/install/cyclonedds")
    make_library(tmp_path / "home/cyclonedds/install")
    make_library(tmp_path / "opt/ros/humble", "lib/x86_64-linux-gnu")
    make_library(tmp_path / "opt/ros/jazzy")
    make_library(tmp_path / "env")
    make_library(tmp_path / "given", "lib64", "11.0.1")
    libraries = found(tmp_path, CYCLONEDDS_HOME=str(tmp_path / "given"), ROS_DISTRO="humble")
    assert [(x.origin, os.path.relpath(x.folder, tmp_path)) for x in libraries] == [
        ("CYCLONEDDS_HOME", "given/lib64"),
        ("ROS 2 humble", "opt/ros/humble/lib/x86_64-linux-gnu"),
        ("ROS 2 jazzy", "opt/ros/jazzy/lib"),
        ("this environment", "env/lib"),
        ("your home", "home/cyclonedds/install/lib"),
        ("your home", "home/cyclonedds_ws/install/cyclonedds/lib"),
        ("the distribution", "usr/lib/x86_64-linux-gnu"),
    ]
    assert [x.header_version for x in libraries] == ["11.0.1", *["0.10.5"] * 5, "0.10.2"]
    assert {x.file for x in libraries} == {"libddsc.so.0"}


def test_the_processor_of_a_library_is_read_from_the_file(tmp_path: Path) -> None:
    make_library(tmp_path / "usr", machine=183)
    (library,) = found(tmp_path)
    assert library.processor == "aarch64"
    assert inspect_machine.processor_of(Path(sys.executable)) == os.uname().machine
    assert inspect_machine.processor_of(Path(__file__)) == ""


def test_a_library_without_headers_is_found_as_such(tmp_path: Path) -> None:
    make_library(tmp_path / "usr")
    shutil.rmtree(tmp_path / "usr/include")
    (library,) = found(tmp_path)
    assert (library.include, library.header_version) == ("", "")


@each(
    "text, known",
    [
        ('ID=debian\nVERSION_ID="12"\nPRETTY_NAME="Debian 12"\n', ("debian", "12")),
        ('ID=ubuntu\nVERSION_ID="24.04"\n', ("ubuntu", "24.04")),
        (
            'ID=linuxmint\nID_LIKE="ubuntu debian"\nVERSION_ID="22"\nUBUNTU_CODENAME=noble\n',
            ("ubuntu", "24.04"),
        ),
        ("ID=fedora\nVERSION_ID=41\n", ("fedora", "41")),
        ("", ("", "")),
    ],
)
def test_the_distribution_is_read(tmp_path: Path, text: str, known: tuple[str, str]) -> None:
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/os-release").write_text(text)
    distribution = inspect_machine.distribution(tmp_path)
    assert (distribution.id, distribution.release) == known


def test_a_child_that_dies_is_a_finding() -> None:
    assert "signal 11" in probe.result_of(-signal.SIGSEGV, "noise\n").error
    assert "no module" in probe.result_of(1, "Traceback\nImportError: no module\n").error
    good = '{"version": "0.10.5", "error": "", "libraries": ["/x"], "round_trip": ""}'
    assert probe.result_of(0, f"noise\n{good}\n") == Installed("0.10.5", "", ("/x",))


# --- what is done


def is_trial(command: Sequence[str]) -> bool:
    return any("import probe" in word for word in command)


class Script:
    """A runner that answers instead of running, and leaves what pip would leave.

    :param failing: (word of a command, what it prints, exit code).
    :param probes: what the children that try it find, one after another.
    """

    def __init__(
        self, *, failing: tuple[str, str] | None = None, probes: Sequence[Installed] = ()
    ) -> None:
        self.commands: list[list[str]] = []
        self.environments: list[Mapping[str, str]] = []
        self._failing = failing
        self._probes = list(probes)
        self.to_the_end: list[bool] = []

    def run(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        to_the_end: bool = False,
    ) -> Done:
        words = list(command)
        self.commands.append(words)
        self.environments.append(environment or {})
        self.to_the_end.append(to_the_end)
        if self._failing and self._failing[0] in words[:4] + words[-1:]:
            return Done(1, self._failing[1])
        if is_trial(words):
            default = Installed("0.10.5", "", ("/usr/lib/x86_64-linux-gnu/libddsc.so.0",))
            found = self._probes.pop(0) if self._probes else default
            text = probe.json.dumps(dataclasses.asdict(found))
            return Done(0, text)
        if "wheel" in words[:4]:
            make_wheel(Path(words[words.index("--wheel-dir") + 1]))
        return Done(0, "")


def make_wheel(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    wheel = folder / "cyclonedds-0.10.5-cp312-cp312-linux_x86_64.whl"
    with zipfile.ZipFile(wheel, "w") as packed:
        packed.writestr("cyclonedds/__init__.py", "")
        packed.writestr("cyclonedds/__library__.py", "in_wheel = False\nlibrary_path = '/tmp/x'")
        packed.writestr("cyclonedds-0.10.5.dist-info/METADATA", "Name: cyclonedds\n")
        packed.writestr("cyclonedds-0.10.5.dist-info/RECORD", "old")
    return wheel


def carry_out(script: Script, machine: Machine = MACHINE, wheel: Path | None = None) -> Installed:
    return execute.carry_out(plan.make_plan(machine), machine, script, lambda text: None, wheel)


def installs(script: Script) -> list[list[str]]:
    return [c for c in script.commands if "install" in c and c[-1].endswith(".whl")]


def test_the_wheel_is_tried_before_it_is_installed_and_that_is_the_last_step(
    tmp_path: Path,
) -> None:
    script = Script()
    assert carry_out(script, wheel=tmp_path / "kept").version == "0.10.5"
    kinds = ["try" if is_trial(c) else c[-1].rpartition(".")[2] for c in script.commands]
    assert kinds[-3:] == ["try", "whl", "try"]
    assert len(installs(script)) == 1
    assert script.to_the_end == [c in installs(script) for c in script.commands]
    (kept,) = (tmp_path / "kept").iterdir()
    with zipfile.ZipFile(kept) as packed:
        module = packed.read("cyclonedds/__library__.py").decode()
    assert "in_wheel = True" in module
    assert "'/usr/lib/x86_64-linux-gnu/libddsc.so.0'" in module


def test_a_wheel_alone_is_made_for_an_interpreter_that_nothing_may_be_installed_into(
    tmp_path: Path,
) -> None:
    system = dataclasses.replace(
        with_python(kind="system", not_writable="Read-only file system"),
        installed=Installed("11.0.1"),
    )
    wanted = plan.make_plan(system, plan.Options(keep_wheel=True, install=False))
    assert wanted.action == plan.Build(LIBRARY)
    script = Script()
    execute.carry_out(wanted, system, script, lambda text: None, tmp_path, install=False)
    assert not [c for c in script.commands if "install" in c]
    assert is_trial(script.commands[-1])
    assert len(list(tmp_path.glob("*.whl"))) == 1


class SourceScript(Script):
    """Leaves also what cmake would install."""

    def run(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        to_the_end: bool = False,
    ) -> Done:
        for word in command:
            if word.startswith("-DCMAKE_INSTALL_PREFIX="):
                prefix = Path(word.partition("=")[2])
                (prefix / "lib").mkdir(parents=True)
                (prefix / "lib/libddsc.so").write_bytes(b"library")
                (prefix / "include/dds").mkdir(parents=True)
                (prefix / "include/dds/dds.h").touch()
        return super().run(command, environment, to_the_end=to_the_end)


def test_a_library_from_source_is_in_the_wheel_with_its_licences(tmp_path: Path) -> None:
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    options = plan.Options(source=str(source), source_version="0.10.5", keep_wheel=True)
    wanted = plan.make_plan(MACHINE, options)
    (source / "LICENSE").write_text("EPL")
    with pytest.raises(DdsBuildFailed, match=r"NOTICE\.md"):
        execute.carry_out(wanted, MACHINE, SourceScript(), lambda text: None, out)
    (source / "NOTICE.md").write_text("notice")
    script = SourceScript()
    execute.carry_out(wanted, MACHINE, script, lambda text: None, out)
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        names = packed.namelist()
        licence = packed.read("cyclonedds-0.10.5.dist-info/licenses/cyclonedds/LICENSE")
    assert "cyclonedds.libs/libddsc.so" in names
    assert "cyclonedds-0.10.5.dist-info/licenses/cyclonedds/NOTICE.md" in names
    assert licence == b"EPL"
    # no folder of this Python's own link command, which a wheel for other machines must not name
    (number,) = [n for n, c in enumerate(script.commands) if "--no-binary" in c]
    environment = script.environments[number]
    assert environment["LDSHARED"] == f"{PYTHON.compiler} -shared"
    assert environment["LDFLAGS"].endswith("-Wl,-rpath,$ORIGIN/../cyclonedds.libs")


@each(
    "changes, word",
    [
        ({"pip": True}, "--force-reinstall"),
        ({"pip": False, "uv": "/bin/uv"}, "/bin/uv"),
        ({"pip": False}, "--python"),
    ],
)
def test_environments_without_pip_are_installed_into(changes: dict[str, Any], word: str) -> None:
    script = Script()
    carry_out(script, with_python(**changes))
    (command,) = installs(script)
    assert word in command
    made = any("venv" in " ".join(c[:4]) for c in script.commands)
    assert made == (not changes["pip"])
    assert "--no-deps" in command


@each(
    "failing, words",
    [
        (("wheel", "OSError: [Errno 28] No space left on device"), "the disk is full"),
        (("wheel", "error: Read-only file system: '/env'"), "read-only"),
        (
            ("wheel", "NewConnectionError: Temporary failure in name resolution"),
            "cannot be reached",
        ),
        (("wheel", "ERROR: THESE PACKAGES DO NOT MATCH THE HASHES"), "not the published one"),
        (("wheel", "fatal error: Python.h: No such file or directory"), "no C headers"),
        (("wheel", "fatal error: dds/dds.h: No such file or directory"), "no headers"),
        (("wheel", "error: command 'gcc' failed: No such file or directory"), "no C compiler"),
        (("wheel", "error: command '/usr/bin/gcc' failed with exit code 1"), "compiler fails"),
        (
            ("wheel", "/usr/bin/ld: skipping incompatible lib/libddsc.so when searching"),
            "another processor",
        ),
        (("wheel", "Traceback\nValueError: odd\n"), "ValueError: odd"),
        (("/usr/bin/cc", "cc: internal compiler error: Killed"), "C compiler fails"),
        (("/usr/bin/cc", ""), "cannot compile an empty program"),
    ],
)
def test_a_step_that_fails_says_why_and_nothing_is_installed(
    failing: tuple[str, str], words: str
) -> None:
    script = Script(failing=failing)
    with pytest.raises(DdsBuildFailed) as caught:
        carry_out(script)
    assert words in caught.value.message
    assert caught.value.hint
    assert caught.value.exit_code == 1
    assert not installs(script)


@each(
    "found, words",
    [
        (Installed("0.10.5", "undefined symbol: _Py_IsFinalizing"), "undefined symbol"),
        (Installed("?", "a process that imports it dies of signal 11"), "signal 11"),
        (Installed("0.10.5", "", ("/a/libddsc.so.0", "/b/libddsc.so.0")), "two CycloneDDS"),
        (Installed("0.10.5", "", ("/a/libddsc.so.0",), "no interface"), "no interface"),
    ],
)
def test_a_wheel_that_does_not_work_is_not_installed(found: Installed, words: str) -> None:
    script = Script(probes=[found])
    with pytest.raises(DdsBuildFailed, match="nothing was installed") as caught:
        carry_out(script)
    assert words in caught.value.message
    assert not installs(script)


def test_wheel_is_rewritten_with_a_correct_record(tmp_path: Path) -> None:
    wheel, target = make_wheel(tmp_path), tmp_path / "new.whl"
    files = {"cyclonedds.libs/libddsc.so.0": b"library", "dist-info/licenses/LICENSE": b"EPL"}
    pinned_wheel.rewrite(wheel, target, pinned_wheel.inside("libddsc.so.0"), files)
    with zipfile.ZipFile(target) as packed:
        assert packed.testzip() is None
        names = packed.namelist()
        record = packed.read("cyclonedds-0.10.5.dist-info/RECORD").decode().splitlines()
        module = packed.read("cyclonedds/__library__.py").decode()
        packed.extractall(tmp_path / "unpacked")
    assert len(names) == len(set(names)) == len(record)
    assert [row.split(",")[0] for row in record] == names
    assert "cyclonedds-0.10.5.dist-info/licenses/LICENSE" in names
    scope: dict[str, Any] = {"__file__": str(tmp_path / "unpacked/cyclonedds/__library__.py")}
    exec(module, scope)
    assert scope["library_path"].read_bytes() == b"library"
    for broken in (b"no zip", b""):
        wheel.write_bytes(broken)
        with pytest.raises(DdsBuildFailed):
            pinned_wheel.rewrite(wheel, target, "", {})


# --- children


def test_a_request_to_stop_ends_a_running_command_but_not_the_installation(
    tmp_path: Path,
) -> None:
    for to_the_end in (False, True):
        stop = StopRequest()
        script = tmp_path / "script"
        # asks for the stop by what it prints; the log is written before the next look
        script.write_text("echo started\nsleep 0.3\necho ended\n" + "" if to_the_end else
                          "echo started\nsleep 1000 & wait\n")  # fmt: skip

        class Log:
            def write(self, text: str) -> None:
                if "started" in text:
                    stop.set()  # noqa: B023

            def flush(self) -> None:
                pass

        runner = ProcessRunner(Log(), stop)  # type: ignore[arg-type]
        if to_the_end:
            assert "ended" in runner.run(["sh", str(script)], to_the_end=True).output
        else:
            with pytest.raises(Interrupted):
                runner.run(["sh", str(script)])


# --- the command


def run_command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["setup-dds", *map(str, arguments)])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_the_command_says_what_it_would_do_and_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cyclonedds", reason="DDS needs cyclonedds 0.10")
    log = tmp_path / "log"
    assert run_command("--dry-run", "--log", log) == 0
    out = capsys.readouterr().out
    assert "nothing: CycloneDDS 0.10 is installed" in out
    assert "dry run" in out
    assert "import sys" in log.read_text()


def test_a_broken_log_or_source_is_one_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (("--log", tmp_path / "none" / "log"), ("--from-source", tmp_path)):
        assert run_command("--dry-run", *arguments) == 2
        assert capsys.readouterr().err.startswith("error: ")


def test_a_wheel_alone_needs_a_place(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command("--no-install", "--dry-run") == 2
    assert "--wheel DIR" in capsys.readouterr().err


@each("version", ["3.8", "3.9", "3.14"])
def test_make_setup_refuses_a_python_that_cannot_be_used(version: str) -> None:
    if not shutil.which("make"):
        pytest.skip("needs make")
    done = subprocess.run(
        ["make", "-n", "setup", f"PYTHON_VERSION={version}", "PYENV_ROOT=/none", "HOME=/none"],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert f"Python {version} cannot be used: dexkit needs 3.10 to 3.13" in done.stderr
    assert "uv sync" not in done.stdout


# --- a real build


@pytest.mark.soak
@each("version", ["3.11", "3.12", "3.13"])
def test_the_binding_is_built_and_works_in_a_new_environment(version: str, tmp_path: Path) -> None:
    """Needs a library on this machine (cyclonedds-dev), and the package index."""
    python = optional.python(version)
    if python is None:
        pytest.skip(f"no Python {version} on this machine")
    if not list(inspect_machine.libraries(os.environ, sys.prefix, os.uname().machine)):
        pytest.skip("no CycloneDDS library on this machine: apt install cyclonedds-dev")
    env, root = tmp_path / "env", Path(__file__).parent.parent
    for command in (
        [optional.UV, "venv", "--quiet", "--python", python, str(env)],
        [optional.UV, "pip", "install", "--quiet", "--python", str(env), "-e", str(root)],
        [str(env / "bin/dexkit"), "setup-dds"],
        [str(env / "bin/dexkit"), "setup-dds"],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    assert "nothing: CycloneDDS 0.10 is installed" in done.stdout
