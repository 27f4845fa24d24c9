"""Decide what ``dexkit setup-dds`` does, from facts alone.

The order: a cyclonedds 0.10.x that works stays; a wheel of the package index; the binding, built
against the first usable library that was found. A given source comes before a wheel.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from dexkit.errors import DdsLibraryMissing, InterpreterRefused
from dexkit.setup_dds.advice import how_to_get_library, system_packages
from dexkit.setup_dds.facts import BINDING, Interpreter, Library, Machine, is_supported

__all__ = ["Build", "BuildSource", "FromIndex", "Keep", "Options", "Plan", "make_plan"]

_OLDEST, _NEWEST = (3, 10), (3, 13)
_WHEELS = {((3, 10), "x86_64")}  # of those versions; the index has older ones, too
_MB = 1_000_000
# measured: 60 MB for the binding with setuptools and pip, 110 MB with the C library
_NEEDED = {"binding": 150 * _MB, "library": 300 * _MB, "install": 30 * _MB}


@dataclass(frozen=True)
class Options:
    """The user's options.

    :ivar source: checkout of the C library that is to be built.
    :ivar source_version: its version; empty if the folder is no such checkout.
    :ivar replace: whether a cyclonedds is replaced that works, or is not 0.10.x.
    :ivar keep_wheel: a wheel is wanted, also where a working cyclonedds is installed.
    :ivar install: False where only the wheel is wanted.
    """

    source: str = ""
    source_version: str = ""
    replace: bool = False
    keep_wheel: bool = False
    install: bool = True


@dataclass(frozen=True)
class Keep:
    """A cyclonedds 0.10.x that works is installed."""

    def __str__(self) -> str:
        return "nothing: CycloneDDS 0.10 is installed and imports"


@dataclass(frozen=True)
class FromIndex:
    """Install the wheel of the package index."""

    def __str__(self) -> str:
        return f"install the wheel of cyclonedds {BINDING} from the package index"


@dataclass(frozen=True)
class Build:
    """Build the binding against a library."""

    library: Library

    def __str__(self) -> str:
        return (
            f"build cyclonedds {BINDING} against {self.library.folder}/{self.library.file} "
            f"({self.library.origin}, {self.library.header_version})"
        )


@dataclass(frozen=True)
class BuildSource:
    """Build the C library, then the binding with that library inside."""

    folder: str
    version: str

    def __str__(self) -> str:
        return (
            f"build CycloneDDS {self.version} of {self.folder}, and cyclonedds {BINDING} with it "
            "inside"
        )


@dataclass(frozen=True)
class Plan:
    """The steps to be done.

    :ivar examined: what was found on the way, one line each, with the reason why it is not used.
    :ivar notes: what the user should know, such as a library that must not be moved.
    """

    action: Keep | FromIndex | Build | BuildSource
    examined: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def make_plan(machine: Machine, options: Options | None = None) -> Plan:
    """Decide what to install or build, and from what.

    :raises InterpreterRefused: nothing may or can be installed for this interpreter.
    :raises DdsLibraryMissing: there is no library to build against.
    """
    options = options or Options()
    interpreter = machine.interpreter
    _check_interpreter(interpreter)
    examined = []
    installed = machine.installed
    if installed.version and options.install:
        problem = _installed_problem(machine, options)
        if not problem and not options.source and not options.keep_wheel:
            examined.append(f"installed: cyclonedds {installed.version}")
            return Plan(Keep(), tuple(examined), _notes(machine))
        examined.append(f"installed: cyclonedds {installed.version}: {problem or 'it works'}")
    _check_environment(machine, options.install)
    if options.source:
        _check_source(options)
        action: FromIndex | Build | BuildSource = BuildSource(
            options.source, options.source_version
        )
        if not machine.cmake:
            raise DdsLibraryMissing(
                "building CycloneDDS needs cmake, which is not installed",
                hint=f"{system_packages(machine.distribution, 'cmake')}; or: pip install cmake",
            )
        _check_build(machine, _NEEDED["library"])
        return Plan(action, tuple(examined), _notes(machine))
    if (interpreter.version[:2], interpreter.processor) in _WHEELS:
        _check_space(machine, _NEEDED["install"])
        return Plan(FromIndex(), tuple(examined), _notes(machine))
    examined.append(
        f"package index: no wheel of cyclonedds 0.10 for Python {interpreter.short} on "
        f"{interpreter.processor}"
    )
    for library in machine.libraries:
        problem = _library_problem(library, interpreter)
        where = f"{library.origin}: {library.folder}/{library.file}"
        if not problem:
            examined.append(f"{where}: CycloneDDS {library.header_version}")
            _check_build(machine, _NEEDED["binding"])
            notes = (*_endurance(library, machine), *_notes(machine, library))
            return Plan(Build(library), tuple(examined), notes)
        examined.append(f"{where}: {problem}")
    raise DdsLibraryMissing(
        "there is no CycloneDDS library 0.10.x to build against"
        + "".join(f"; {line}" for line in examined),
        hint=how_to_get_library(machine.distribution),
    )


def _check_interpreter(interpreter: Interpreter) -> None:
    oldest, newest = (f"{v[0]}.{v[1]}" for v in (_OLDEST, _NEWEST))
    use = f"make an environment with one: uv venv --python 3.12, or python{newest} -m venv env"
    if interpreter.system != "linux":
        raise InterpreterRefused(
            f"dexkit uses DDS on Linux only; this is {interpreter.system}",
            hint="codecs, recordings and offline checks work without DDS",
        )
    if interpreter.implementation != "cpython" or interpreter.free_threaded:
        what = "free-threaded Python" if interpreter.free_threaded else interpreter.implementation
        raise InterpreterRefused(f"CycloneDDS's binding does not support {what}", hint=use)
    if not _OLDEST <= interpreter.version[:2] <= _NEWEST:
        raise InterpreterRefused(
            f"this is Python {interpreter.short}; CycloneDDS 0.10 is known to work on {oldest} to "
            f"{newest}",
            hint=use,
        )
    if interpreter.processor not in ("x86_64", "aarch64"):
        raise InterpreterRefused(
            f"this Python is for the processor {interpreter.processor or 'of an unknown kind'}; "
            "DDS was tested on x86_64 and aarch64",
            hint="on a 64-bit machine, install a 64-bit Python",
        )


def _installed_problem(machine: Machine, options: Options) -> str:
    """Why the installed package cannot stay; empty if it can."""
    installed = machine.installed
    if not is_supported(installed.version):
        if not options.replace:
            raise InterpreterRefused(
                f"cyclonedds {installed.version} is installed in this environment. A program that "
                "uses it crashes every CycloneDDS 0.10 program on its network, the robot's "
                "included",
                hint=f"'dexkit setup-dds --replace' puts {BINDING} in its place; if another "
                "package here needs the newer one, give dexkit an environment of its own: "
                "python3 -m venv env",
            )
        return "it is to be replaced"
    if installed.error:
        return installed.error
    if len(installed.libraries) > 1:
        return (
            f"its process has two CycloneDDS libraries ({' and '.join(installed.libraries)}), "
            "which crash it sooner or later"
        )
    if options.replace:
        return "it is to be replaced"
    for file in installed.libraries:
        version = file_version(file)
        if version and not version.startswith("0."):
            return f"it uses the library {file}, whose participants crash CycloneDDS 0.10 programs"
    return ""


def file_version(path: str) -> str:
    """Version in the name of a library's file; empty if it has none."""
    match = re.search(r"\.so\.(\d+\.\d+(?:\.\d+)?)$", path)
    return match[1] if match else ""


def _check_environment(machine: Machine, install: bool) -> None:
    interpreter = machine.interpreter
    if interpreter.kind == "system" and install:
        raise InterpreterRefused(
            f"{interpreter.executable} belongs to {machine.distribution.name}, and pip must not "
            "change it (PEP 668)",
            hint="make an environment, install dexkit there, and type this again: "
            "python3 -m venv env && . env/bin/activate",
        )
    if interpreter.not_writable and install:
        raise InterpreterRefused(
            f"nothing can be installed into {interpreter.packages}: {interpreter.not_writable}",
            hint="use an environment of your own: python3 -m venv env && . env/bin/activate",
        )
    if not (interpreter.pip or interpreter.uv or interpreter.ensurepip):
        raise InterpreterRefused(
            "this Python has no pip, no ensurepip and no uv",
            hint=system_packages(machine.distribution, f"python{interpreter.short}-venv"),
        )


def _check_source(options: Options) -> None:
    if not options.source_version:
        raise DdsLibraryMissing(
            f"{options.source} is no checkout of the CycloneDDS library",
            hint="give the folder with its CMakeLists.txt: git clone --branch 0.10.5 --depth 1 "
            "https://github.com/eclipse-cyclonedds/cyclonedds",
        )
    if not is_supported(options.source_version):
        raise DdsLibraryMissing(
            f"{options.source} is CycloneDDS {options.source_version}; it must be 0.10.x, because "
            "others crash or are crashed by the robot's",
            hint=f"git -C {options.source} checkout 0.10.5",
        )


def _check_build(machine: Machine, bytes_needed: int) -> None:
    interpreter, distribution = machine.interpreter, machine.distribution
    _check_space(machine, bytes_needed)
    if not interpreter.compiler:
        raise DdsLibraryMissing(
            "there is no C compiler to build the binding with",
            hint=system_packages(distribution, "build-essential"),
        )
    if not interpreter.headers:
        raise DdsLibraryMissing(
            f"Python {interpreter.short} has no C headers (Python.h)",
            hint=system_packages(distribution, f"python{interpreter.short}-dev"),
        )


def _check_space(machine: Machine, temporary: int) -> None:
    for folder, free, needed in (
        (machine.temporary, machine.free[0], temporary),
        (machine.interpreter.packages, machine.free[1], _NEEDED["install"]),
    ):
        if free < needed:
            raise InterpreterRefused(
                f"the disk of {folder} is full: {free / _MB:.0f} MB are free, "
                f"{needed / _MB:.0f} MB are needed",
                hint="make space there"
                + ("" if folder != machine.temporary else ", or name another folder: TMPDIR=/path"),
            )


def _library_problem(library: Library, interpreter: Interpreter) -> str:
    if not library.include:
        return "it has no headers (include/dds)"
    for version in (library.header_version, library.version):
        if version and not is_supported(version):
            return f"it is CycloneDDS {version}, not 0.10.x"
    if not library.header_version:
        return "its headers name no version"
    if library.processor != interpreter.processor:
        return f"it is for {library.processor or 'no processor'}, not {interpreter.processor}"
    return ""


def _endurance(library: Library, machine: Machine) -> tuple[str, ...]:
    """Explain how long an environment that uses a library in place will work."""
    folder = PurePosixPath(library.folder)
    safe = ("/usr", "/lib", "/opt", machine.interpreter.prefix)
    if any(folder.is_relative_to(place) for place in safe):
        return ()
    if any(folder.is_relative_to(place) for place in ("/tmp", "/var/tmp", "/run", "/dev/shm",
                                                      machine.temporary)):  # fmt: skip
        return (
            f"{library.folder} is a temporary folder: when it is emptied, DDS stops working here. "
            "Install the library elsewhere and type this again, or use --from-source",
        )
    return (
        f"this environment needs {library.folder} from now on; if it is moved or removed, type "
        "'dexkit setup-dds' again",
    )


def _notes(machine: Machine, library: Library | None = None) -> tuple[str, ...]:
    notes = []
    if library is None and machine.needs_variables:
        notes.append(
            f"it works only with {' and '.join(machine.needs_variables)} set as now; "
            "'dexkit setup-dds --replace' builds one that needs no variables"
        )
    mine = {library.real} if library else set(machine.installed.libraries)
    for file in machine.elsewhere:
        if file not in mine:
            notes.append(
                f"LD_LIBRARY_PATH or LD_PRELOAD offers another CycloneDDS library, {file}: a "
                "program that loads both, such as one with ROS 2's rclpy and dexkit, crashes"
            )
    if machine.interpreter.made_by_uv and not machine.installed.version:
        notes.append(
            "'uv sync' removes what its lock does not name: afterwards type 'dexkit setup-dds' "
            "again, or use 'uv sync --inexact'"
        )
    return tuple(notes)
