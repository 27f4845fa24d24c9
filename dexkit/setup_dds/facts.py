"""Facts about a machine on which ``dexkit setup-dds`` bases its plan."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "BINDING",
    "Distribution",
    "Installed",
    "Interpreter",
    "Library",
    "Machine",
    "is_supported",
]

BINDING = "0.10.5"
"""Release of the Python binding that is installed. Its source builds against every CycloneDDS
library 0.10.x."""


@dataclass(frozen=True)
class Interpreter:
    """The Python that dexkit runs in, and its environment.

    :ivar version: major, minor, micro.
    :ivar processor: what its own file is compiled for: ``"x86_64"``, ``"aarch64"``, ... The
        machine's may differ, in an emulator or a 32-bit system.
    :ivar kind: ``"venv"``, ``"conda"``, ``"system"`` (the distribution's own) or ``"own"``
        (an interpreter of the user's without an environment).
    :ivar packages: folder that packages are installed into.
    :ivar not_writable: why nothing can be installed there; empty if it can.
    :ivar headers: folder with ``Python.h``; empty if there is none.
    :ivar compiler: command of the C compiler, with its options; empty if none was found.
    :ivar uv: path of the program uv; empty if it was not found.
    :ivar made_by_uv: uv made the environment.
    """

    executable: str
    version: tuple[int, int, int]
    implementation: str
    free_threaded: bool
    system: str
    processor: str
    kind: str
    prefix: str
    packages: str
    not_writable: str
    headers: str
    compiler: str
    pip: bool
    ensurepip: bool
    uv: str
    made_by_uv: bool

    @property
    def short(self) -> str:
        """Version as ``3.12``."""
        return f"{self.version[0]}.{self.version[1]}"


@dataclass(frozen=True)
class Installed:
    """The Python package cyclonedds that an environment has, as a child process found it.

    :ivar version: of the package; empty if none is installed.
    :ivar error: why it does not import; empty if it does.
    :ivar libraries: the files of libddsc that the process had loaded after the import.
    :ivar round_trip: why a message did not come back; empty if it did, or was not sent.
    """

    version: str = ""
    error: str = ""
    libraries: tuple[str, ...] = ()
    round_trip: str = ""


@dataclass(frozen=True)
class Library:
    """A CycloneDDS C library with its headers.

    :ivar origin: how it was found: ``"CYCLONEDDS_HOME"``, ``"ROS 2 jazzy"``, ...
    :ivar include: folder that has ``dds/``; empty if it has no headers.
    :ivar folder: folder of ``libddsc.so``.
    :ivar file: the name by which programs load it, in that folder.
    :ivar real: path of the file that it is in the end.
    :ivar header_version: as its headers say; empty without headers.
    :ivar version: as the name of its file says; empty if that says nothing.
    :ivar processor: what it is compiled for.
    """

    origin: str
    include: str
    folder: str
    file: str
    real: str
    header_version: str
    version: str
    processor: str


@dataclass(frozen=True)
class Distribution:
    """The Linux distribution, from ``os-release``.

    :ivar id: ``"debian"``, ``"ubuntu"``, ...; of a derivative, what it is derived from.
    :ivar release: ``"12"``, ``"24.04"``; empty where it says none.
    :ivar name: for messages.
    """

    id: str = ""
    release: str = ""
    name: str = "this system"


@dataclass(frozen=True)
class Machine:
    """Everything that a plan rests on.

    :ivar free: bytes that can be written to the temporary folder and the folder of packages.
    :ivar elsewhere: files of libddsc that LD_LIBRARY_PATH or LD_PRELOAD offers to every program,
        without links.
    :ivar needs_variables: the installed package works only with these variables of the shell.
    :ivar cmake: path of cmake; empty if there is none.
    """

    interpreter: Interpreter
    installed: Installed
    libraries: tuple[Library, ...]
    distribution: Distribution
    temporary: str
    free: tuple[int, int]
    elsewhere: tuple[str, ...]
    needs_variables: tuple[str, ...]
    cmake: str


def is_supported(version: str) -> bool:
    """Whether it is a CycloneDDS 0.10.x: the only ones that do no harm to a robot
    (docs/sources/unitree-dex.md#f).
    """
    return version == "0.10" or version.startswith("0.10.")
