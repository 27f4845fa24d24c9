"""Carry out a plan: everything in a temporary folder, and the finished wheel is installed last."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import zipfile
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path

from dexkit.child_processes import module_line
from dexkit.documents import write_file
from dexkit.errors import DdsBuildFailed, OutputError
from dexkit.setup_dds import pinned_wheel, probe
from dexkit.setup_dds.advice import Cause, cause_of
from dexkit.setup_dds.facts import BINDING, Installed, Library, Machine
from dexkit.setup_dds.inspect_machine import library_at
from dexkit.setup_dds.plan import Build, BuildSource, FromIndex, Keep, Plan
from dexkit.setup_dds.process_runner import Done, Runner
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["build_environment", "carry_out", "check", "try_compiler"]

_DIGESTS = (  # SHA-256 on the package index: the source, then wheels for CPython 3.10 on x86-64
    "63fc4d6fdb2fd35181c40f4e90757149f2def5f570ef19fb71edc4f568755f8a",
    "861d2ffd9513126d6a62ad9f842e85122518a7db1fb0a11d6e4fa86e3cacf61c",  # glibc
    "8276b2bc347540e3ca892adf976421dbce4c6d2672934a32409db121a1431b86",  # musl
)
_PIP = ("--disable-pip-version-check", "--no-input", "--progress-bar", "off")
_CMAKE = (
    "-DCMAKE_BUILD_TYPE=Release",
    "-DCMAKE_INSTALL_LIBDIR=lib",
    # the tools would need bison; the rest, libraries that a wheel cannot take along
    "-DBUILD_IDLC=OFF",
    "-DBUILD_DDSPERF=OFF",
    "-DBUILD_TESTING=OFF",
    "-DBUILD_EXAMPLES=OFF",
    "-DENABLE_SSL=OFF",
    "-DENABLE_SECURITY=OFF",
    "-DENABLE_SHM=OFF",
)


def carry_out(
    plan: Plan,
    machine: Machine,
    runner: Runner,
    progress: Callable[[str], object],
    wheel_folder: Path | None = None,
    *,
    install: bool = True,
) -> Installed:
    """Carry out a plan, and test the result.

    :param wheel_folder: where the wheel is also kept.
    :param install: False makes the wheel, and leaves the environment alone.
    :returns: what is installed at the end, or the unpacked wheel; tried.
    :raises DdsBuildFailed: a step failed; the environment is as it was, unless it says otherwise.
    :raises Interrupted: the user stopped it; the environment is as it was.
    """
    task = _Task(machine, runner, progress)
    if isinstance(plan.action, Keep):
        progress("sending a message to another process and back")
        return task.check("", "")
    with TemporaryFolder("setup-dds") as folder:
        task.folder = folder
        wheel = task.wheel(plan.action)
        progress("trying it: import, and a message to another process and back")
        trial = folder / "trial"
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(trial)
        tried = task.check(str(trial), "; nothing was installed")
        if wheel_folder is not None:
            _keep(wheel, wheel_folder)
            progress(f"kept: {wheel_folder / wheel.name}{_needs(plan)}")
        if not install:
            return tried
        progress(f"installing into {machine.interpreter.packages}")
        task.install(wheel)
    return task.check("", "; it is installed, and worked in a temporary folder")


class _Task:
    """One run of the command."""

    folder = Path()

    def __init__(self, machine: Machine, runner: Runner, progress: Callable[[str], object]) -> None:
        self._machine = machine
        self._interpreter = machine.interpreter
        self._runner = runner
        self._progress = progress
        self._pip: list[str] = []

    def wheel(self, action: FromIndex | Build | BuildSource) -> Path:
        """Get or build the wheel; returns it."""
        if isinstance(action, FromIndex):
            self._progress(f"getting the wheel of cyclonedds {BINDING} from the package index")
            return self._pip_wheel("--only-binary", os.environ)
        if isinstance(action, Build):
            module = pinned_wheel.outside(os.path.join(action.library.folder, action.library.file))
            return self._build(action.library, module, {}, action.library.folder)
        library, files = self._build_source(action)
        return self._build(
            library,
            pinned_wheel.inside(library.file),
            files,
            f"$ORIGIN/../{pinned_wheel.LIBRARY_FOLDER}",
        )

    def _build_source(self, action: BuildSource) -> tuple[Library, dict[str, bytes]]:
        self._progress(f"building CycloneDDS {action.version} of {action.folder} (a minute)")
        build, prefix = self.folder / "c-build", self.folder / "c-library"
        cmake = self._machine.cmake
        environment = {**os.environ, "CC": self._interpreter.compiler}
        for command in (
            [cmake, "-S", action.folder, "-B", str(build), f"-DCMAKE_INSTALL_PREFIX={prefix}",
             *_CMAKE],
            [cmake, "--build", str(build), "--parallel", str(os.cpu_count() or 1),
             "--target", "install"],
        ):  # fmt: skip
            self._run(command, environment, "CycloneDDS cannot be built")
        library = library_at(prefix, "source", self._interpreter.processor)
        if library is None:
            raise DdsBuildFailed(f"the build of {action.folder} did not make libddsc.so")
        files = {
            f"{pinned_wheel.LIBRARY_FOLDER}/{library.file}": (
                Path(library.folder, library.file).read_bytes()
            )
        }
        for name in ("LICENSE", "NOTICE.md"):
            try:
                text = Path(action.folder, name).read_bytes()
            except OSError as error:
                raise DdsBuildFailed(
                    f"{action.folder} has no {name}: {error.strerror}",
                    hint="the wheel must contain the licence; use a complete checkout",
                ) from error
            files[f"dist-info/licenses/cyclonedds/{name}"] = text
        return library, files

    def _build(self, library: Library, module: str, files: Mapping[str, bytes], rpath: str) -> Path:
        self._progress("trying the compiler")
        prefix = _prefix_of_links(self.folder / "prefix", library)
        try_compiler(self._machine, self._runner, self.folder, prefix)
        self._progress(f"building cyclonedds {BINDING} against {library.header_version} (10 s)")
        environment = build_environment(os.environ, self._machine, self.folder, prefix, rpath)
        if files:
            # a wheel for other machines names no folder of this Python's own link command
            environment["LDSHARED"] = f"{self._interpreter.compiler} -shared"
        built = self._pip_wheel("--no-binary", environment)
        (self.folder / "pinned").mkdir()
        pinned = self.folder / "pinned" / built.name
        pinned_wheel.rewrite(built, pinned, module, files)
        return pinned

    def _pip_wheel(self, kind: str, environment: Mapping[str, str]) -> Path:
        # no cache: pip keeps what it has built, and would not look at the library again
        out = self.folder / "wheel"
        wanted = self.folder / "wanted.txt"
        digests = " ".join(f"--hash=sha256:{digest}" for digest in _DIGESTS)
        write_file(wanted, f"cyclonedds=={BINDING} {digests}\n")
        command = [*self._with_pip(), "wheel", *_PIP, "--no-cache-dir", "--no-deps", kind,
                   "cyclonedds", "--wheel-dir", str(out), "--requirement", str(wanted)]  # fmt: skip
        self._run(command, environment, "the wheel of cyclonedds cannot be made")
        wheels = list(out.glob("cyclonedds-*.whl"))
        if len(wheels) != 1:
            raise DdsBuildFailed(f"pip made {len(wheels)} wheels of cyclonedds")
        return wheels[0]

    def _with_pip(self) -> list[str]:
        """A command that is pip: the environment's, or that of one made for this."""
        if self._interpreter.pip:
            return module_line("pip", python=self._interpreter.executable)
        if not self._pip:
            home = self.folder / "pip"
            command = (
                module_line("venv", str(home), python=self._interpreter.executable)
                if self._interpreter.ensurepip
                else [self._interpreter.uv, "venv", "--quiet", "--seed", "--python",
                      self._interpreter.executable, str(home)]
            )  # fmt: skip
            self._run(command, os.environ, "no pip can be made for the build")
            self._pip = module_line("pip", python=str(home / "bin" / "python"))
        return self._pip

    def install(self, wheel: Path) -> None:
        """Install the wheel as the last step, after its dependencies."""
        python = self._interpreter.executable
        if self._interpreter.pip:
            begin = module_line("pip", "install", *_PIP, python=python)
            again = ["--force-reinstall"]
        elif self._interpreter.uv:
            begin = [self._interpreter.uv, "pip", "install", "--python", python]
            again = ["--reinstall-package", "cyclonedds"]
        else:
            begin = [*self._with_pip(), "--python", python, "install", *_PIP]
            again = ["--force-reinstall"]
            if _pip_version(self._machine) < (22, 3):  # it knows no --python yet
                upgrade = [*self._with_pip(), "install", *_PIP, "--upgrade", "pip"]
                self._run(upgrade, os.environ, "pip cannot be renewed")
        try:
            metadata.version("rich-click")
        except metadata.PackageNotFoundError:
            self._run([*begin, "rich-click"], os.environ, "what cyclonedds needs is not to be had")
        self._run(
            [*begin, "--no-deps", *again, str(wheel)],
            os.environ,
            "the wheel of cyclonedds cannot be installed",
            to_the_end=True,
        )

    def check(self, folder: str, state: str) -> Installed:
        """Test the installed package, or the one unpacked in ``folder``."""
        command = probe.command(self._interpreter.executable, folder, send=True)
        done = self._runner.run(command)
        return check(probe.result_of(done.code, done.output), state)

    def _run(
        self,
        command: list[str],
        environment: Mapping[str, str],
        what: str,
        *,
        to_the_end: bool = False,
    ) -> None:
        done = self._runner.run(
            command, {**environment, "TMPDIR": str(self.folder)}, to_the_end=to_the_end
        )
        if done.code:
            raise _failure(what, done, self._machine)


def _failure(what: str, done: Done, machine: Machine) -> DdsBuildFailed:
    cause = cause_of(done.output, machine.interpreter, machine.distribution)
    if cause is None:
        last = [line.strip() for line in done.output.splitlines() if line.strip()][-1:]
        return DdsBuildFailed(
            f"{what}: {last[0] if last else f'exit code {done.code}'}",
            hint="the whole output is in the log",
        )
    return DdsBuildFailed(f"{what}: {cause.message}", hint=cause.hint)


def check(found: Installed, state: str) -> Installed:
    """Judge the findings of the child process.

    :param state: what the error adds: whether something was installed.
    :raises DdsBuildFailed: it cannot be used.
    """
    if found.error or not found.version:
        missing = "it is not there" if not found.version else found.error
        raise DdsBuildFailed(
            f"cyclonedds does not import: {missing}{state}",
            hint="where it says that a file cannot be found, the library needs another one: "
            "install it, or build the library with --from-source",
        )
    if len(found.libraries) > 1:
        raise DdsBuildFailed(
            f"one process loads two CycloneDDS libraries: {' and '.join(found.libraries)}{state}",
            hint="unset LD_PRELOAD and LD_LIBRARY_PATH and type this again",
        )
    if found.round_trip:
        raise DdsBuildFailed(
            f"cyclonedds imports, but DDS does not work: {found.round_trip}{state}",
            hint="'dexkit doctor' examines the network of this machine",
        )
    return found


def _prefix_of_links(folder: Path, library: Library) -> Path:
    """A folder as the binding's build looks for it: include, bin and lib with libddsc.so.

    Distributions and ROS have the library in ``lib/<processor>-linux-gnu``.
    """
    (folder / "lib").mkdir(parents=True)
    (folder / "bin").mkdir()
    (folder / "include").symlink_to(library.include)
    # Debian has some headers in a folder of the processor, which only its own compiler looks into
    own = Path(library.include, f"{library.processor}-linux-gnu")
    (folder / "own-include").symlink_to(own if (own / "dds").is_dir() else library.include)
    source = Path(library.folder)
    (folder / "lib" / "libddsc.so").symlink_to(source / "libddsc.so")
    idl = source / "libcycloneddsidl.so"
    if idl.exists() and Path(library.include, "idl", "processor.h").exists():
        (folder / "lib" / idl.name).symlink_to(idl)
    return folder


def build_environment(
    environment: Mapping[str, str], machine: Machine, folder: Path, prefix: Path, rpath: str
) -> dict[str, str]:
    """The variables of the binding's build.

    :param rpath: where its compiled part looks for the library.
    """
    found = {k: v for k, v in environment.items() if k not in ("STANDALONE_WHEELS", "LDSHARED")}
    flags = [found.get("CFLAGS", ""), f"-I{prefix}/own-include"]
    if machine.interpreter.version >= (3, 13):
        # public under its new name; with the old one it compiles and does not import
        flags.append("-D_Py_IsFinalizing=Py_IsFinalizing")
    links = [found.get("LDFLAGS", ""), f"-Wl,-rpath,{rpath}"]
    found.update(
        CYCLONEDDS_HOME=str(prefix),
        CFLAGS=" ".join(filter(None, flags)),
        LDFLAGS=" ".join(filter(None, links)),
        TMPDIR=str(folder),
    )
    if not shutil.which(_words(environment.get("CC", ""))[0]):
        found["CC"] = machine.interpreter.compiler
    return found


def _words(command: str) -> list[str]:
    return shlex.split(command) or [""]


_TRIALS = (
    ("the C compiler fails", "int main(void) { return 0; }\n"),
    ("", "#include <Python.h>\nint main(void) { return 0; }\n"),
    (
        "",
        "#include <dds/dds.h>\nint main(void) { return dds_get_parent(0) == 0; }\n",
    ),
)


def try_compiler(machine: Machine, runner: Runner, folder: Path, prefix: Path) -> None:
    """Compile an empty program, one with Python's headers, one with the library.

    :raises DdsBuildFailed: with the cause.
    """
    interpreter = machine.interpreter
    output = ""
    for number, (_, text) in enumerate(_TRIALS):
        source = folder / f"trial{number}.c"
        write_file(source, text)
        command = [*_words(interpreter.compiler), str(source), "-o", str(folder / "trial.out")]
        if number == 1:
            command.append(f"-I{interpreter.headers}")
        if number == 2:
            command += [
                *(f"-I{prefix}/{name}" for name in ("include", "own-include")),
                f"-L{prefix}/lib",
                "-lddsc",
                "-Wl,--allow-shlib-undefined",
            ]
        done = runner.run(command, {**os.environ, "TMPDIR": str(folder)})
        if done.code:
            output = done.output
            what = ("it cannot compile an empty program", "it cannot compile with Python.h",
                    "it cannot link with libddsc")[number]  # fmt: skip
            cause = cause_of(output, interpreter, machine.distribution) or Cause(
                f"{interpreter.compiler} fails: {what}",
                "its messages are in the log; another compiler: CC=/path/to/gcc",
            )
            raise DdsBuildFailed(f"the binding cannot be built: {cause.message}", hint=cause.hint)


def _pip_version(machine: Machine) -> tuple[int, int]:
    """Version of the pip that an environment made by this Python gets."""
    try:
        import ensurepip

        match = re.match(r"(\d+)\.(\d+)", ensurepip.version())
    except ImportError:
        match = None
    return (int(match[1]), int(match[2])) if match else (99, 0)


def _needs(plan: Plan) -> str:
    if not isinstance(plan.action, Build):
        return ""
    library = plan.action.library
    return f"; a machine that installs it needs {library.folder}/{library.file}, too"


def _keep(wheel: Path, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make {folder}: {error.strerror}", hint="give another folder: --wheel DIR"
        ) from error
    write_file(folder / wheel.name, wheel.read_bytes())
