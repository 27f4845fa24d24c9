"""Suspending the guest, its processes and its USB devices."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tools.lab.guest.bench import Failed, kernel_log, wait_for

__all__ = ["autosuspend", "freeze_processes", "runtime_status", "suspend_refused"]

_POWER = Path("/sys/power")
_DELAY = Path("/sys/module/suspend/parameters/pm_test_delay")
_REFUSAL = r"vhci_hcd.*(Do not suspend|active connection)"


def suspend_refused(state: str) -> str:
    """Ask the kernel to suspend (``mem``, ``freeze``), which it must refuse: what it says.

    vhci_hcd refuses while a device is attached.

    :raises Failed: it suspended, or refused for another reason.
    """
    # one device after the other, so that the refusal comes before virtio's devices are reached:
    # the guest's root is on one, and 9p does not survive it
    (_POWER / "pm_async").write_text("0")
    before, started = len(kernel_log(_REFUSAL)), time.monotonic()
    try:
        (_POWER / "state").write_text(state)
    except OSError as error:
        said = kernel_log(_REFUSAL)[before:]
        if error.errno != errno.EBUSY or not said:
            raise Failed(f"{state}: {error}; the kernel does not say why") from error
        took = time.monotonic() - started
        reason = said[-1].split("] ", 1)[-1]
        return f"{state}: {errno.errorcode[error.errno]} after {took:.1f} s, {reason!r}"
    raise Failed(f"{state}: the kernel suspended with devices on vhci_hcd")


def freeze_processes(seconds: int) -> float:
    """Freeze all processes for a while, as suspending does first; how long it took.

    By the kernel's own test of suspending (``pm_test``), which goes no further.
    """
    (_POWER / "pm_test").write_text("freezer")
    _DELAY.write_text(str(seconds))
    started = time.monotonic()
    try:
        (_POWER / "state").write_text("freeze")
    finally:
        (_POWER / "pm_test").write_text("none")
    return time.monotonic() - started


def runtime_status(device: Path) -> str:
    """Whether a USB device is ``active`` or ``suspended`` now."""
    return (device / "power/runtime_status").read_text().strip()


@contextmanager
def autosuspend(device: Path) -> Iterator[float]:
    """Let the kernel suspend a USB device that nobody uses; the seconds until it did."""
    power = device / "power"
    (power / "autosuspend_delay_ms").write_text("0")
    (power / "control").write_text("auto")
    try:
        yield wait_for(lambda: runtime_status(device) == "suspended", "it is not suspended")
    finally:
        if device.exists():
            (power / "control").write_text("on")
