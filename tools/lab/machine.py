"""The guest: a QEMU process with this machine's files, and nothing but its own network."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path

from tools.lab.packages import QEMU, Kernel

__all__ = ["command_line", "run_guest"]

_MEMORY = 1280  # MiB
_EMULATED = "Nehalem"
"""The processor that QEMU emulates: wider vectors and newer page tables take it more time."""
_GRACE = 5.0  # seconds to end after being asked


def command_line(
    kernel: Kernel,
    initramfs: Path,
    console: Path,
    words: Mapping[str, object],
    *,
    accelerator: str,
    cores: int,
) -> list[str]:
    """QEMU's command line.

    :param console: gets what the guest prints.
    :param words: added to the kernel's command line, as ``lab.NAME=VALUE``.
    """
    # The guest has an address and no route: it reaches its host and nothing else.
    append = ["console=ttyS0", "quiet", "panic=-1", "mitigations=off", "random.trust_cpu=on"]
    # an emulated time-stamp counter is not checked against the HPET, each read of which leaves the
    # guest's processor
    append += ["tsc=reliable", "clocksource=tsc"] if accelerator == "tcg" else []
    append += [f"lab.{name}={value}" for name, value in words.items()]
    return [
        QEMU,
        *("-name", "dexkit-lab,debug-threads=on"),
        *("-accel", "tcg,thread=multi" if accelerator == "tcg" else accelerator),
        *("-cpu", _EMULATED if accelerator == "tcg" else "max", "-smp", str(cores)),
        *("-m", str(_MEMORY)),
        *("-nodefaults", "-no-reboot", "-display", "none"),
        # not stdio: QEMU would poll this process's /dev/null without a pause
        *("-serial", f"file:{console}"),
        *("-kernel", str(kernel.image), "-initrd", str(initramfs), "-append", " ".join(append)),
        *("-netdev", "user,id=net", "-device", "virtio-net-pci,netdev=net,romfile="),
        *("-device", "virtio-rng-pci"),
        *_share("host", Path("/")),
        *_share("programs", kernel.programs),
    ]


def _share(name: str, path: Path) -> list[str]:
    how = f"local,id={name},path={path},security_model=none,readonly=on,multidevs=remap"
    return ["-fsdev", how, "-device", f"virtio-9p-pci,fsdev={name},mount_tag={name}"]


def run_guest(command: list[str], patience: float) -> bool:
    """Run the guest until it switches itself off.

    :param patience: seconds after which it is ended.
    :returns: whether it ended by itself.
    """
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        process.wait(patience)
        return True
    except subprocess.TimeoutExpired:
        return False
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
