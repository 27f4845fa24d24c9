"""``python -m tools.lab``: exit code 0 if everything that was tried in the guest passed."""

from __future__ import annotations

import argparse
import compileall
import contextlib
import platform
import subprocess
import sys
import sysconfig
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dexkit.errors import DexkitError
from tools.lab.control import Control
from tools.lab.devices import Devices
from tools.lab.initramfs import write_initramfs
from tools.lab.machine import command_line, run_guest
from tools.lab.packages import Kernel, fetch, missing
from tools.lab.report import Case, write_report

ROOT = Path(__file__).resolve().parents[2]
_PATIENCE = 600.0  # seconds for the whole session in a guest
_GROUPS = ("dex3", "serial")
"""Each has a guest of its own; they run at the same time."""


def main() -> int:
    """Boot the guests, run the session, write the report; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.lab", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build/lab", help="folder")
    parser.add_argument("--only", choices=_GROUPS, help="the group to run [default: all]")
    parser.add_argument("--accel", choices=("tcg", "kvm"), default="tcg")
    parser.add_argument("--patience", type=float, default=_PATIENCE, help="seconds for a guest")
    parser.add_argument("--cores", type=int, default=1, help="of each guest")
    options = parser.parse_args()
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        print("error: the lab needs Linux on x86-64", file=sys.stderr)
        return 2
    if lacking := missing():
        print(f"error: missing on this machine: {', '.join(lacking)}", file=sys.stderr)
        print(
            f"  on Debian: sudo apt install --no-install-recommends {' '.join(lacking)}",
            file=sys.stderr,
        )
        return 2
    try:
        return _session(options.out.resolve(), options)
    except DexkitError as error:
        print(f"error: {error.message}", file=sys.stderr)
        if error.hint:
            print(f"  {error.hint}", file=sys.stderr)
        return 2


def _session(out: Path, options: argparse.Namespace) -> int:
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    kernel = fetch(out, print)
    _compile()
    program, why_not = _compile_c(out)
    cases: list[Case] = []
    if why_not:
        print(f"no C program: {why_not}")

    def report_case(case: Case) -> None:
        cases.append(case)
        took = f"{case.seconds:.1f} s"
        print(f"{case.status:8}{case.group:18} {case.name} ({took}): {case.said}", flush=True)

    initramfs = out / "initramfs.gz"
    python = Path(sys.prefix) / "bin/python"
    write_initramfs(initramfs, kernel, f"cd {ROOT} && {python} -m tools.lab.guest")
    names = [options.only] if options.only else list(_GROUPS)
    with contextlib.closing(Devices()) as devices, contextlib.ExitStack() as ended:
        guests = []
        for name in names:
            control = ended.enter_context(contextlib.closing(Control(devices, report_case)))
            words = {
                "control": control.port,
                "hands": devices.hands.port,
                "adapters": devices.adapters.port,
                "group": name,
                "program": program,
            }
            guests.append(_Guest(name, control, out / f"console-{name}.log", words))
        print(f"booting {kernel.release} ({options.accel}); consoles: {out}/console-*.log")
        with ThreadPoolExecutor(len(guests)) as pool:
            for done in pool.map(partial(_run, kernel, initramfs, options), guests):
                if done:
                    report_case(done)
        if devices.failure is not None:
            report_case(Case("lab", "the emulators", "failed", repr(devices.failure)))
    facts = {
        "kernel": f"{kernel.release} ({kernel.version})",
        "packages": ", ".join(kernel.packages),
        "accelerator": f"{options.accel}; {len(guests)} guests, cores of each: {options.cores}",
        "host": f"{platform.platform()}, Python {platform.python_version()}",
        **{f"{g.name}: {name}": fact for g in guests for name, fact in g.control.facts.items()},
        "whole run": f"{time.monotonic() - started:.0f} s",
    }
    write_report(out, cases, facts)
    failed = sum(case.status == "failed" for case in cases)
    skipped = sum(case.status == "skipped" for case in cases)
    print(f"report: {out / 'report.md'}; {facts['whole run']}")
    print(f"{len(cases) - failed - skipped} passed, {failed} failed, {skipped} skipped")
    return 1 if failed or not cases else 0


@dataclass(frozen=True)
class _Guest:
    """One guest: the group that it runs, its connection, its console, its kernel's words."""

    name: str
    control: Control
    console: Path
    words: Mapping[str, object]


def _run(
    kernel: Kernel, initramfs: Path, options: argparse.Namespace, guest: _Guest
) -> Case | None:
    """Run a guest until it ends; what went wrong, as a case, if it did not end by itself."""
    command = command_line(
        kernel,
        initramfs,
        guest.console,
        guest.words,
        accelerator=options.accel,
        cores=options.cores,
    )
    ended = run_guest(command, options.patience)
    if ended and guest.control.finished:
        return None
    why = "the session did not end" if ended else f"it did not end in {options.patience:.0f} s"
    said = f"{why}; see {guest.console}"
    return Case("lab", f"the session of the guest {guest.name}", "failed", said)


def _compile() -> None:
    """Compile Python's files here: the guest would take several times as long, at each start."""
    for place in (sysconfig.get_path("purelib"), *(str(ROOT / n) for n in _FOLDERS)):
        compileall.compile_dir(place, quiet=2, maxlevels=12)


def _compile_c(out: Path) -> tuple[str, str]:
    """Compile the C program on libusb: its path, or an empty one and why there is none."""
    path = out / "exchange"
    source = Path(__file__).with_name("exchange.c")
    command = ["cc", "-O2", "-Wall", "-o", str(path), str(source), "-l:libusb-1.0.so.0"]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError:
        return "", "there is no C compiler (cc)"
    if done.returncode:
        return "", f"cc failed: {done.stderr.strip().splitlines()[-1]}"
    return str(path), ""


_FOLDERS = ("dexkit", "drivers", "emulators", "traces", "conformance", "tools")


if __name__ == "__main__":
    sys.exit(main())
