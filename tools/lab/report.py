"""The lab's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexkit.documents import write_file
from dexkit.escaping import visible

__all__ = ["REAL", "Case", "markdown", "write_report"]

REAL = """\
What is real: Debian's kernel and its drivers (usbcore, vhci_hcd, usbfs, usbserial, ftdi_sio), its
device nodes, sysfs and power management, libusb, udev, pyserial, DDS, and dexkit from its checkout.

What is not: the devices (dexkit's emulators, on the host, by USB/IP), the cable (TCP through QEMU's
user network: no packets on a bus, no bandwidth, no electrical faults), and time in the guest: its
processor is emulated, several times slower than the host's and shared with it. Rates are
therefore lower limits for this machine, not figures of a robot's computer. dexkit's programs are
forks of one process that has imported their modules before, so their start takes no imports.
"""


@dataclass(frozen=True)
class Case:
    """One trial.

    :ivar group: what it is about: ``dex3``, ``ezgripper``, ``dex1``, ...
    :ivar status: ``passed``, ``failed``, or ``skipped``.
    :ivar said: the figures, or what went wrong.
    """

    group: str
    name: str
    status: str
    said: str
    seconds: float = 0.0
    figures: Mapping[str, Any] = field(default_factory=dict)


def markdown(cases: Sequence[Case], facts: Mapping[str, Any]) -> str:
    """The report for people."""
    lines = ["# Lab report", "", REAL, "| | |", "| --- | --- |"]
    lines += [f"| {name} | {_cell(str(value))} |" for name, value in facts.items()]
    groups = list(dict.fromkeys(case.group for case in cases))
    for group in groups:
        lines += ["", f"## {group}", "", "| what | result | s | |", "| --- | --- | --- | --- |"]
        lines += [
            f"| {_cell(c.name)} | {c.status} | {c.seconds:.1f} | {_cell(c.said)} |"
            for c in cases
            if c.group == group
        ]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return visible(text).replace("|", "\\|").replace("\n", "<br>")


def write_report(folder: Path, cases: Sequence[Case], facts: Mapping[str, Any]) -> None:
    """Write ``report.md`` into ``folder``."""
    write_file(folder / "report.md", markdown(cases, facts))
