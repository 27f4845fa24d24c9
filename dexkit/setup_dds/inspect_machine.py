"""Find out what :mod:`dexkit.setup_dds.plan` needs to know; changes nothing.

Files are looked for below ``root``, ``/`` unless a test gives another one.
"""

from __future__ import annotations

import glob
import importlib.util
import os
import re
import shlex
import shutil
import struct
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from dexkit.dds_library import is_library
from dexkit.setup_dds.facts import Distribution, Installed, Interpreter, Library, Machine

__all__ = [
    "VARIABLES",
    "distribution",
    "inspect_machine",
    "interpreter",
    "libraries",
    "library_at",
    "offered_elsewhere",
    "processor_of",
    "source_version",
]

_PROCESSORS = {3: "i386", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
_WORKSPACES = (
    # Unitree's instructions, and where their other repositories build it
    "cyclonedds*/install",
    "cyclonedds_ws/install/cyclonedds",
    "cyclonedds_ws/install",
    "unitree_ros2/cyclonedds_ws/install/cyclonedds",
    "*/cyclonedds*/install",
    "*/cyclonedds_ws/install/cyclonedds",
)


VARIABLES = ("CYCLONEDDS_HOME", "LD_LIBRARY_PATH", "LD_PRELOAD")
"""Variables that decide which library a program loads."""


def inspect_machine(installed: Installed, without_variables: Installed | None = None) -> Machine:
    """Everything about this machine.

    :param installed: what a child process found of the installed package.
    :param without_variables: what one without :data:`VARIABLES` found; None if none is set.
    """
    found = interpreter()
    temporary = tempfile.gettempdir()
    return Machine(
        interpreter=found,
        installed=installed,
        libraries=tuple(libraries(os.environ, found.prefix, found.processor)),
        distribution=distribution(),
        temporary=temporary,
        free=(_free(temporary), _free(found.packages)),
        elsewhere=tuple(offered_elsewhere(os.environ)),
        needs_variables=tuple(v for v in VARIABLES if os.environ.get(v))
        if without_variables and without_variables.error and not installed.error
        else (),
        cmake=shutil.which("cmake") or _beside(found.executable, "cmake"),
    )


def interpreter() -> Interpreter:
    """The Python that runs this."""
    packages = sysconfig.get_path("platlib")
    include = sysconfig.get_path("include")
    pyvenv = Path(sys.prefix, "pyvenv.cfg")
    return Interpreter(
        executable=sys.executable,
        version=(sys.version_info.major, sys.version_info.minor, sys.version_info.micro),
        implementation=sys.implementation.name,
        free_threaded=bool(sysconfig.get_config_var("Py_GIL_DISABLED")),
        system=sys.platform,
        # the name may be that of a script that starts it
        processor=processor_of(Path(sys.executable)) or processor_of(Path("/proc/self/exe")),
        kind=_kind(),
        prefix=sys.prefix,
        packages=packages,
        not_writable=_not_writable(packages),
        headers=include if Path(include, "Python.h").exists() else "",
        compiler=_compiler(),
        pip=importlib.util.find_spec("pip") is not None,
        ensurepip=importlib.util.find_spec("ensurepip") is not None,
        uv=_uv(),
        made_by_uv=pyvenv.is_file() and "\nuv = " in f"\n{pyvenv.read_text(errors='replace')}",
    )


def _kind() -> str:
    if sys.prefix != sys.base_prefix:
        return "venv"
    marker = Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    # Ubuntu 22.04 has no marker yet
    if marker.exists() or sys.prefix == "/usr":
        return "system"
    return "conda" if Path(sys.prefix, "conda-meta").is_dir() else "own"


def _not_writable(folder: str) -> str:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _compiler() -> str:
    """The command that this Python compiles extensions with, or another compiler.

    A Python that was compiled on another machine names one that may not be here.
    """
    for command in (os.environ.get("CC"), sysconfig.get_config_var("CC"), "cc", "gcc", "clang"):
        words = shlex.split(command) if command else []
        if words and shutil.which(words[0]):
            return str(command)
    return ""


def _beside(executable: str, name: str) -> str:
    path = Path(executable).parent / name
    return str(path) if os.access(path, os.X_OK) else ""


def _uv() -> str:
    given = os.environ.get("UV", "")  # 'uv run' sets it
    if given and os.access(given, os.X_OK):
        return given
    return _beside(sys.executable, "uv") or shutil.which("uv") or ""


def _free(folder: str) -> int:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0


def processor_of(path: Path) -> str:
    """Which processor an ELF file is for; empty if it is no ELF file."""
    try:
        with path.open("rb") as file:
            head = file.read(20)
    except OSError:
        return ""
    if len(head) < 20 or not head.startswith(b"\x7fELF"):
        return ""
    little = head[5] == 1
    (number,) = struct.unpack_from("<H" if little else ">H", head, 18)
    return _PROCESSORS.get(number, f"ELF machine {number}")


def distribution(root: Path = Path("/")) -> Distribution:
    """From ``os-release``; a derivative counts as the known distribution that it names first."""
    fields: dict[str, str] = {}
    for place in ("etc/os-release", "usr/lib/os-release"):
        try:
            lines = (root / place).read_text(errors="replace").splitlines()
        except OSError:
            continue
        for line in lines:
            name, equals, value = line.partition("=")
            if equals:
                fields[name.strip()] = value.strip().strip("\"'")
        break
    name = fields.get("PRETTY_NAME") or fields.get("NAME") or "this system"
    own, release = fields.get("ID", ""), fields.get("VERSION_ID", "")
    if own in ("debian", "ubuntu"):
        return Distribution(own, release, name)
    # a derivative has release numbers of its own
    ubuntu = {"focal": "20.04", "jammy": "22.04", "noble": "24.04"}
    base = ubuntu.get(fields.get("UBUNTU_CODENAME", ""))
    if base and "ubuntu" in fields.get("ID_LIKE", "").split():
        return Distribution("ubuntu", base, name)
    return Distribution(own, release, name)


def libraries(
    environment: Mapping[str, str], prefix: str, processor: str, root: Path = Path("/")
) -> Iterator[Library]:
    """Every CycloneDDS library in the usual places, the most specific first.

    :param environment: variables, for CYCLONEDDS_HOME, HOME, ROS_DISTRO and the prefix paths.
    :param prefix: of the Python environment; conda has libraries there.
    :param processor: which a distribution's folder is named for.
    """
    seen: set[str] = set()
    for origin, place in _places(environment, prefix, root):
        library = library_at(place, origin, processor)
        if library is None:
            continue
        if library.real not in seen:
            seen.add(library.real)
            yield library


def _places(environment: Mapping[str, str], prefix: str, root: Path) -> Iterator[tuple[str, Path]]:
    if home := environment.get("CYCLONEDDS_HOME"):
        yield "CYCLONEDDS_HOME", Path(home)
    for variable in ("CMAKE_PREFIX_PATH", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH"):
        for place in filter(None, environment.get(variable, "").split(os.pathsep)):
            yield variable, Path(place)
            yield variable, Path(place) / "cyclonedds"
    sourced = environment.get("ROS_DISTRO", "")
    ros = sorted((root / "opt/ros").glob("*"), reverse=True)
    for folder in sorted(ros, key=lambda p: p.name != sourced):
        yield f"ROS 2 {folder.name}", folder
    yield "this environment", Path(prefix)
    user = environment.get("HOME", "")
    for pattern in _WORKSPACES if user else ():
        for found in sorted(glob.glob(os.path.join(glob.escape(user), pattern))):
            yield "your home", Path(found)
    yield "/usr/local", root / "usr/local"
    yield "the distribution", root / "usr"


def library_at(prefix: Path, origin: str, processor: str) -> Library | None:
    """The library below a prefix, usable or not; None if there is none."""
    for name in ("lib", f"lib/{processor}-linux-gnu", "lib64"):
        folder = prefix / name
        file = folder / "libddsc.so"
        if not file.exists():
            continue
        real = Path(os.path.realpath(file))
        include = prefix / "include"
        headers = (include / "dds" / "dds.h").exists()
        return Library(
            origin=origin,
            include=str(include) if headers else "",
            folder=str(folder),
            file=_runtime_name(folder, real),
            real=str(real),
            header_version=_header_version(include) if headers else "",
            version=_number(real.name),
            processor=processor_of(real),
        )
    return None


def _runtime_name(folder: Path, real: Path) -> str:
    """The name by which programs load it: with a number, but not with the whole version, which
    the next update changes. ``libddsc.so`` is the developers'.
    """
    names = sorted(
        path.name for path in folder.glob("libddsc.so.*") if os.path.realpath(path) == str(real)
    )
    return min(names, key=lambda name: (bool(_number(name)), len(name)), default="libddsc.so")


def _number(name: str) -> str:
    match = re.search(r"\.so\.(\d+\.\d+\.\d+)$", name)
    return match[1] if match else ""


def _header_version(include: Path) -> str:
    try:
        text = (include / "dds" / "version.h").read_text(errors="replace")
    except OSError:
        return ""
    match = re.search(r'#define\s+DDS_VERSION\s+"([^"]+)"', text)
    return match[1] if match else ""


def offered_elsewhere(environment: Mapping[str, str]) -> list[str]:
    """Files of libddsc that every program of this shell is offered, without links."""
    found = []
    for folder in filter(None, environment.get("LD_LIBRARY_PATH", "").split(":")):
        found += list(Path(folder).glob("libddsc.so*"))
    preloaded = re.split(r"[: ]", environment.get("LD_PRELOAD", ""))
    found += [Path(p) for p in preloaded if is_library(p)]
    return sorted({os.path.realpath(p) for p in found})


def source_version(folder: Path) -> str:
    """Version of a checkout of the C library; empty if it is none."""
    try:
        text = (folder / "CMakeLists.txt").read_text(errors="replace")
    except OSError:
        return ""
    match = re.search(r"project\s*\(\s*CycloneDDS\s+VERSION\s+([\d.]+)", text, re.IGNORECASE)
    return match[1] if match else ""
