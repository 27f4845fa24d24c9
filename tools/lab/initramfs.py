"""The guest's first files: busybox, the kernel's modules that are needed, and a script.

The guest's root is this machine's own file tree, shared read-only, under a layer in the guest's
memory that takes what is written. So Python, dexkit and libusb are those of the checkout.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterable
from pathlib import Path

from dexkit.errors import UsageError
from tools.lab.packages import Kernel

__all__ = ["MODULES", "archive", "in_order", "write_initramfs"]

MODULES = (
    "virtio_pci",
    "virtio_net",
    "virtio_rng",
    "9p",
    "9pnet_virtio",
    "overlay",
    "usbcore",
    "vhci-hcd",
    "usbserial",
    "ftdi_sio",
)
"""Without ``.ko``. What they depend on is found in them."""

_SCRIPT = """#!/bin/busybox sh
/bin/busybox --install -s /bin
mkdir -p /proc /sys /dev /host /programs /layer /new
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in $(cat /modules.order); do
    insmod /modules/$module.ko || echo "lab: cannot load $module"
done
share=trans=virtio,version=9p2000.L,msize=262144,cache=loose,ro
mount -t 9p -o $share host /host || exec sh
mount -t 9p -o $share programs /programs || exec sh
mount -t tmpfs -o mode=755 layer /layer
mkdir /layer/upper /layer/work
mount -t overlay -o lowerdir=/programs:/host,upperdir=/layer/upper,workdir=/layer/work lab /new
umount /proc /sys
mkdir -p /new/proc /new/sys /new/dev
cp /bin/busybox /new/busybox
exec switch_root /new /busybox sh -c "$(cat /start)"
"""

_START = """
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8
/busybox mount -t proc proc /proc
/busybox mount -t sysfs sys /sys
/busybox mount -t devtmpfs dev /dev
/busybox mount -t tmpfs -o mode=755 tmpfs /run
mkdir -p /dev/pts /dev/shm
/busybox mount -t devpts devpts /dev/pts
/busybox mount -t tmpfs -o mode=1777 tmpfs /dev/shm
/busybox ip link set lo up
/busybox ip link set lo multicast on
/busybox ip address add 10.0.2.15/24 dev eth0
/busybox ip link set eth0 up
{commands}
/busybox poweroff -f
"""


def write_initramfs(path: Path, kernel: Kernel, commands: str) -> None:
    """Write a gzip-compressed initramfs.

    :param commands: shell commands that the guest carries out before it switches itself off.
    :raises UsageError: the kernel's package lacks a module.
    """
    modules = in_order(kernel.modules, MODULES)
    entries: list[tuple[str, int, bytes]] = [
        ("bin", 0o40755, b""),
        ("bin/busybox", 0o100755, (kernel.programs / "usr/bin/busybox").read_bytes()),
        ("modules", 0o40755, b""),
        ("modules.order", 0o100644, "\n".join(m.stem for m in modules).encode()),
        ("start", 0o100644, _START.format(commands=commands).encode()),
        ("init", 0o100755, _SCRIPT.encode()),
        *((f"modules/{m.name}", 0o100644, m.read_bytes()) for m in modules),
    ]
    path.write_bytes(gzip.compress(archive(entries), compresslevel=1, mtime=0))


def in_order(folder: Path, wanted: Iterable[str]) -> list[Path]:
    """Modules and those that they depend on, each behind those that it needs.

    A module that is built into the kernel is left out.

    :raises UsageError: one is neither there nor built in.
    """
    there = {path.stem.replace("_", "-"): path for path in folder.rglob("*.ko")}
    built_in = {
        Path(line).stem.replace("_", "-")
        for line in (folder / "modules.builtin").read_text().splitlines()
    }
    ordered: dict[str, Path] = {}

    def add(name: str) -> None:
        key = name.replace("_", "-")
        if key in ordered or key in built_in:
            return
        path = there.get(key)
        if path is None:
            raise UsageError(
                f"the kernel's package has no module {name}",
                hint="the lab needs Debian's linux-image-amd64, not the cloud kernel",
            )
        for depended in _depends(path.read_bytes()):
            add(depended)
        ordered[key] = path

    for name in wanted:
        add(name)
    return list(ordered.values())


def _depends(module: bytes) -> list[str]:
    """The modules that a module names in its section ``.modinfo``."""
    found = re.search(rb"\0depends=([^\0]*)\0", module)
    return [name for name in found[1].decode().split(",") if name] if found else []


def archive(entries: Iterable[tuple[str, int, bytes]]) -> bytes:
    """A cpio archive in the kernel's format ("newc") of (path, mode, contents)."""
    out = bytearray()
    for number, (name, mode, data) in enumerate([*entries, ("TRAILER!!!", 0, b"")], 1):
        encoded = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(encoded), 0)
        out += b"070701" + b"".join(b"%08x" % field for field in fields) + encoded
        out += bytes(-len(out) % 4)
        out += data
        out += bytes(-len(out) % 4)
    return bytes(out)
