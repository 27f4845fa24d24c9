"""Does dexkit work on aarch64? ``make aarch64`` runs it on x86-64, under qemu-user.

Python, the CycloneDDS library and the headers are Debian 12's arm64 packages, unpacked into a
folder; the machine itself is not changed, and nothing here needs root. Nothing is timed: an
emulated processor is ten times slower.

1. an environment, whose Python is a script that starts qemu-user;
2. ``dexkit setup-dds``, by a cross compiler;
3. the tests of the codecs, with their property tests;
4. ``dexkit serve sim-dex1``, read and moved by a client on x86-64 with the cyclonedds wheel 0.10.2;
5. ``dexkit emulate mx64``, driven by ``dexkit serve ezgripper``, which the same client moves.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from tools.platforms.interpreters import UV
from tools.platforms.steps import ROOT, SDK, Command, Report, Trial

__all__ = ["Emulated", "missing", "own_mirror"]

_QEMU, _KEYRING = "qemu-aarch64-static", "/usr/share/keyrings/debian-archive-keyring.gpg"
_COMPILERS = ("aarch64-linux-gnu-gcc", "aarch64-linux-gnu-gcc-14", "aarch64-linux-gnu-gcc-12")
_SUITE, _PYTHON = "bookworm", "3.11"
_PACKAGES = (f"python{_PYTHON}", f"libpython{_PYTHON}-dev", "cyclonedds-dev")
_TRIES = 3
_PLATFORM = "aarch64-manylinux_2_36"
_TESTS = (
    "test_crc32",
    "test_dds_types",
    "test_dex3_usb_codec",
    "test_dynamixel",
    "test_low_level",
    "test_m4010",
    "test_messages",
    "test_messages_properties",
    "test_messages_schemas",
    "test_mx64_table",
    "test_packed",
)
# it opens DDS, and the tests' fixed environment leaves out the variable that qemu-user needs
_NOT_HERE = "tests/test_dds_types.py::test_two_threads_may_be_the_first_to_use_a_type"
_APT = """
APT::Architecture "arm64";
APT::Architectures "arm64";
APT::Install-Recommends "false";
Acquire::Languages "none";
Debug::NoLocking "true";
Dir::State "{0}/state";
Dir::State::status "{0}/state/status";
Dir::Cache "{0}/cache";
Dir::Etc::SourceList "{0}/sources.list";
Dir::Etc::SourceParts "/nonexistent";
Dir::Etc::Preferences "/nonexistent";
Dir::Etc::PreferencesParts "/nonexistent";
"""


def missing() -> list[str]:
    """Debian's names of the packages that this needs and the machine has not."""
    needed = {
        "apt": shutil.which("apt-get"),
        "dpkg": shutil.which("dpkg-deb"),
        "debian-archive-keyring": os.path.exists(_KEYRING),
        "qemu-user-static": shutil.which(_QEMU),
        "gcc-aarch64-linux-gnu": _compiler(),
    }
    return [name for name, there in needed.items() if not there]


def own_mirror() -> str:
    """From where this machine gets Debian's packages; empty if it is no Debian."""
    command = ["apt-get", "indextargets", "--format", "$(ORIGIN) $(REPO_URI)"]
    found = subprocess.run([*command, "Created-By: Packages"], capture_output=True, text=True)
    return next(
        (line.split()[1] for line in found.stdout.splitlines() if line.startswith("Debian ")), ""
    )


def _compiler() -> str:
    return next(filter(None, map(shutil.which, _COMPILERS)), "")


class Emulated(Trial):
    """The trial.

    :param out: folder for packages, root, environment and log; what is downloaded stays there.
    :param mirror: of Debian's packages.
    """

    def __init__(self, out: Path, mirror: str, progress: Callable[[str], object]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        report = Report("aarch64", str(out / "env" / "bin" / "python"), f"{_PYTHON} (aarch64)")
        super().__init__(report, out, out / "aarch64.log", progress)
        self._root = out / "root"
        self._env = out / "env"
        self._mirror = mirror
        self._python = self._env / "bin" / "python"
        # qemu-user cannot read a socket's filter back; it sets it all the same
        os.environ["DEXKIT_ALL_INTERFACES"] = "1"

    def run(self) -> Report:
        """Do the steps; the later ones also where one of them fails."""
        dexkit: list[str | Path] = [self._python, "-m", "dexkit"]
        if (
            self.step("packages", self._unpack)
            and self.step("environment", self._make_environment)
            and self.step("setup-dds", self._setup_dds)
        ):
            self.step("codecs", self._test_codecs)
            self.step("sim-dex1", lambda: self.both_ways([*dexkit, "serve", "sim-dex1"]))
            self.step("mx64", lambda: self._mx64(dexkit))
        return self.report

    def _unpack(self) -> str:
        """Debian's packages with all that they depend on, unpacked."""
        apt = self.out / "apt"
        for folder in ("state/lists/partial", "cache/archives/partial"):
            (apt / folder).mkdir(parents=True, exist_ok=True)
        (apt / "state/status").touch()
        (apt / "apt.conf").write_text(_APT.format(apt))
        (apt / "sources.list").write_text(
            f"deb [signed-by={_KEYRING}] {self._mirror} {_SUITE} main\n"
        )
        command = ["apt-get", "--quiet", "--yes"]
        with_config = {"APT_CONFIG": str(apt / "apt.conf")}
        self.output([*command, "update"], **with_config)
        self.output([*command, "install", "--download-only", *_PACKAGES], **with_config)
        shutil.rmtree(self._root, ignore_errors=True)
        packages = sorted((apt / "cache/archives").glob("*.deb"))
        for package in packages:
            self.output(["dpkg-deb", "--extract", package, self._root])
        return f"{len(packages)} packages of Debian {_SUITE}, arm64"

    def _make_environment(self) -> str:
        """As ``python -m venv`` makes it, but for its Python."""
        shutil.rmtree(self._env, ignore_errors=True)
        packages = self._env / "lib" / f"python{_PYTHON}" / "site-packages"
        packages.mkdir(parents=True)
        self._python.parent.mkdir()
        binary = self._root / "usr/bin" / f"python{_PYTHON}"
        # Python gets the script's name: by that it finds pyvenv.cfg and starts its children
        self._python.write_text(
            f"#!/bin/sh\nexec {shutil.which(_QEMU)} -0 '{self._python}' -L '{self._root}' "
            f"'{binary}' \"$@\"\n"
        )
        self._python.chmod(0o755)
        (self._env / "pyvenv.cfg").write_text(
            f"home = {binary.parent}\ninclude-system-site-packages = false\n"
        )
        self.output([UV, "pip", "install", "--quiet", "--python-platform", _PLATFORM,
                     "--python-version", _PYTHON, "--target", packages, f"{ROOT}[conformance]",
                     "pip", "rich-click", "hypothesis", "pytest-xdist", "uv",
                     "mcap-ros2-support", "rosbags"])  # fmt: skip
        # the genuine SDK's types, whose bytes the tests compare with
        self.output([UV, "pip", "install", "--quiet", "--python-platform", _PLATFORM, "--no-deps",
                     "--python-version", _PYTHON, "--target", packages, SDK])  # fmt: skip
        processor = self.output([self._python, "-c", "import platform; print(platform.machine())"])
        version = self.output([self._python, "-m", "dexkit", "--version"])
        return f"{processor.strip()}: {version.strip()}"

    def _setup_dds(self) -> str:
        return self.last_line(
            [self._python, "-m", "dexkit", "setup-dds", "--log", self.out / "setup-dds.log"],
            "DDS works",
            CYCLONEDDS_HOME=str(self._root / "usr"),
            CC=f"{_compiler()} --sysroot={self._root}",
        )

    def _test_codecs(self) -> str:
        files = [f"tests/{name}.py" for name in _TESTS]
        return self.last_line(
            [self._python, "-m", "pytest", "-p", "no:cacheprovider", "-n", "2", "-m", "not soak",
             "--deselect", _NOT_HERE, *files],
            " passed",
        )  # fmt: skip

    def _mx64(self, dexkit: Command) -> str:
        """An emulated servo and its driver; again, where the machine was too busy for them.

        The driver waits at most a second for an answer.
        """
        for left in reversed(range(_TRIES)):
            try:
                return self._move_mx64(dexkit)
            except RuntimeError:
                if not left:
                    raise
                self.progress("the machine was too busy; again")
        raise AssertionError("there is a first try")

    def _move_mx64(self, dexkit: Command) -> str:
        link = self.out / "mx64"
        link.unlink(missing_ok=True)
        # neither the line's time nor the driver's 30 ms for an answer is for a slow processor
        servo = subprocess.Popen(
            [*map(str, dexkit), "emulate", "mx64", "--link", str(link), "--set", "line-time=no"],
            cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert servo.stdout is not None
            if not servo.stdout.readline().startswith("ready:"):
                raise RuntimeError("dexkit emulate mx64 does not come up")
            serve = [*dexkit, "serve", "ezgripper", "--device", link, "--set", "calibrate=yes",
                     "--set", "timeout=1"]  # fmt: skip
            return self.both_ways(serve)
        finally:
            servo.terminate()
            servo.communicate(timeout=60)
