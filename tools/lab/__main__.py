"""``python -m tools.lab``: exit code 0 if everything that was tried in the guest passed."""

from __future__ import annotations

import argparse
import compileall
import platform
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

from dexkit.errors import DexkitError
from tools.lab.control import Control
from tools.lab.devices import Devices
from tools.lab.initramfs import write_initramfs
from tools.lab.machine import command_line, run_guest
from tools.lab.packages import fetch, missing
from tools.lab.report import Case, write_reports

ROOT = Path(__file__).resolve().parents[2]
_PATIENCE = 600.0  # seconds for the whole session in the guest


def main() -> int:
    """Boot the guest, run the session, write the report; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.lab", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build/lab", help="folder")
    parser.add_argument("--only", default="", help="groups to run, with commas [default: all]")
    parser.add_argument("--accel", choices=("tcg", "kvm"), default="tcg")
    parser.add_argument("--patience", type=float, default=_PATIENCE, help="seconds for the guest")
    parser.add_argument("--cores", type=int, default=2, help="of the guest")
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
        print(f"{case.status:8}{case.group:10} {case.name}: {case.said}", flush=True)

    devices = Devices()
    control = Control(devices, report_case)
    try:
        initramfs = out / "initramfs.gz"
        python = Path(sys.prefix) / "bin/python"
        write_initramfs(initramfs, kernel, f"cd {ROOT} && {python} -m tools.lab.guest")
        words = {
            "control": control.port,
            "hands": devices.hands.port,
            "adapters": devices.adapters.port,
            "only": options.only,
            "program": program,
        }
        console = out / "console.log"
        command = command_line(
            kernel, initramfs, console, words, accelerator=options.accel, cores=options.cores
        )
        print(f"booting {kernel.release} ({options.accel}); console: {console}", flush=True)
        ended = run_guest(command, options.patience)
    finally:
        control.close()
        devices.close()
    if not (ended and control.finished):
        why = "the session did not end" if ended else f"it did not end in {options.patience:.0f} s"
        report_case(
            Case("lab", "the guest's session", "failed", f"{why}; see {out / 'console.log'}")
        )
    if devices.failure is not None:
        report_case(Case("lab", "the emulators", "failed", repr(devices.failure)))
    facts = {
        "kernel": f"{kernel.release} ({kernel.version})",
        "packages": ", ".join(kernel.packages),
        "accelerator": f"{options.accel}, {options.cores} cores",
        "host": f"{platform.platform()}, Python {platform.python_version()}",
        **control.facts,
        "whole run": f"{time.monotonic() - started:.0f} s",
    }
    write_reports(out, cases, facts)
    failed = sum(case.status == "failed" for case in cases)
    skipped = sum(case.status == "skipped" for case in cases)
    print(f"report: {out / 'report.md'}, {out / 'junit.xml'}; {facts['whole run']}")
    print(f"{len(cases) - failed - skipped} passed, {failed} failed, {skipped} skipped")
    return 1 if failed or not cases else 0


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
