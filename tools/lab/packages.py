"""Get what the lab's guest needs from Debian's packages: downloaded and unpacked, never installed.

Everything is kept in one folder (``build/lab``), so that a second run downloads nothing.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dexkit.errors import UsageError

__all__ = ["QEMU", "Kernel", "fetch", "missing"]

QEMU = "qemu-system-x86_64"
_NEEDED = {
    QEMU: "qemu-system-x86",
    "apt-get": "apt",
    "apt-cache": "apt",
    "dpkg-deb": "dpkg",
}
_KERNEL = "linux-image-amd64"
_GUEST = ("busybox-static", "kmod", "udev", "usbip")
"""Programs of the guest. It has this machine's files; libraries that this machine lacks are
unpacked with them."""
_MERGED = ("bin", "sbin", "lib", "lib64")
"""Folders that are links into ``usr`` on this machine; a plain folder in the packages' tree would
hide what is behind the link."""
_READY = ".unpacked"
_PATIENCE = 300.0  # seconds for one call of apt


@dataclass(frozen=True)
class Kernel:
    """An unpacked kernel package.

    :ivar release: such as ``6.1.0-56-amd64``.
    :ivar version: the package's.
    :ivar image: the file to boot.
    :ivar modules: folder of its modules.
    :ivar programs: tree with the guest's programs, to be laid over this machine's files.
    :ivar packages: name and version of everything that was unpacked.
    """

    release: str
    version: str
    image: Path
    modules: Path
    programs: Path
    packages: tuple[str, ...]


def missing() -> list[str]:
    """Packages that must be installed on this machine and are not."""
    lacking = [package for program, package in _NEEDED.items() if shutil.which(program) is None]
    return list(dict.fromkeys(lacking))


def fetch(folder: Path, say: Callable[[str], object]) -> Kernel:
    """Download and unpack kernel and programs, unless they are there.

    :param folder: gets ``kernel`` and ``programs``.
    :raises UsageError: apt cannot get a package.
    """
    kernel, programs = folder / "kernel", folder / "programs"
    if not (kernel / _READY).exists():
        say(f"downloading {_KERNEL}")
        release = _concrete_kernel()
        names = _unpack([release], kernel, folder)
        _write_ready(kernel, names)
    if not _has(programs, _GUEST):
        say(f"downloading {', '.join(_GUEST)}")
        names = _unpack([*_GUEST, *_lacking(_GUEST)], programs, folder)
        for name in _MERGED:
            _merge_into_usr(programs, name)
        _write_ready(programs, names)
    image = next((kernel / "boot").glob("vmlinuz-*"))
    release = image.name.removeprefix("vmlinuz-")
    packages = [(place / _READY).read_text().split("\n") for place in (kernel, programs)]
    return Kernel(
        release,
        packages[0][0].partition(" ")[2],
        image,
        kernel / "lib/modules" / release,
        programs,
        tuple(name for names in packages for name in names if name),
    )


def _has(place: Path, packages: tuple[str, ...]) -> bool:
    """Whether all of them were unpacked there."""
    if not (place / _READY).exists():
        return False
    there = {line.partition(" ")[0] for line in (place / _READY).read_text().splitlines()}
    return there.issuperset(packages)


def _lacking(packages: tuple[str, ...]) -> list[str]:
    """What ``packages`` depend on and this machine lacks; another version of it will do."""
    text = _run(["apt-get", "-s", "install", "--no-install-recommends", *packages])
    new = re.findall(r"^Inst (\S+) \(", text, re.MULTILINE)
    return [name for name in new if name not in packages]


def _write_ready(place: Path, names: list[str]) -> None:
    (place / _READY).write_text("\n".join(names) + "\n")


def _concrete_kernel() -> str:
    """The package that the kernel's metapackage stands for now."""
    text = _run(["apt-cache", "depends", _KERNEL])
    found = re.search(r"Depends: (linux-image-\S+)", text)
    if found is None:
        raise UsageError(
            f"apt knows no {_KERNEL}", hint="the lab needs Debian's packages: sudo apt update"
        )
    return found[1]


def _unpack(packages: list[str] | tuple[str, ...], place: Path, folder: Path) -> list[str]:
    """Unpack packages into an emptied ``place``; their names and versions."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    downloads = folder / "downloads"
    shutil.rmtree(downloads, ignore_errors=True)
    downloads.mkdir(parents=True)
    _run(["apt-get", "download", *packages], cwd=downloads)
    names = []
    for package in sorted(downloads.glob("*.deb")):
        _run(["dpkg-deb", "-x", str(package), str(place)])
        shown = _run(["dpkg-deb", "-W", "--showformat=${Package} ${Version}", str(package)])
        names.append(shown.strip())
    shutil.rmtree(downloads)
    return names


def _merge_into_usr(tree: Path, name: str) -> None:
    if (tree / name).is_dir():
        shutil.copytree(tree / name, tree / "usr" / name, symlinks=True, dirs_exist_ok=True)
        shutil.rmtree(tree / name)


def _run(command: list[str], cwd: Path | None = None) -> str:
    try:
        done = subprocess.run(
            command, cwd=cwd, capture_output=True, text=True, timeout=_PATIENCE, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise UsageError(f"{command[0]} does not end", hint="is there a network?") from error
    if done.returncode:
        last = done.stderr.strip().splitlines()
        raise UsageError(
            f"{' '.join(command[:3])} failed: {last[-1] if last else done.returncode}",
            hint="the lab gets Debian's packages: sudo apt update, and is there a network?",
        )
    return done.stdout
