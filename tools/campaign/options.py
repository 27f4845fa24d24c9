"""Run commands with invalid and extreme values for every option.

The commands are asked what options they have, so that a new one is tried without being named
here. A traceback is a finding, and an exit code that is none of dexkit's.
"""

from __future__ import annotations

import contextlib
import logging
import resource
import shutil
import signal
from typing import Any

import click

from dexkit.cli.settings import SettingsOption
from tools.campaign.case import Batch, Case
from tools.campaign.process import Program
from tools.campaign.waiting import WaitTimeout, until

__all__ = ["cases", "command_lines"]

_NUMBERS = (
    "nan", "inf", "-inf", "-1", "0", "1e400", "1e-300", "1e18", "9" * 30, "9" * 5000, "0x10",
    "", "\u00b2", "1_0", "\u0661", "x",
)  # fmt: skip
_PATHS = (
    "/dev/full", "/", "/no/such/file", "/dev/null", "{scratch}", "{scratch}/" + "x" * 300, "",
    "{scratch}/new", "/proc/self/mem", "{scratch}/empty", "{sample}", "\u00e9\n", "-",
)  # fmt: skip
_TEXTS = (
    "",
    "x",
    "\x1b[31m",
    "*",
    "=",
    "a=b",
    "left.x=1",
    "a" * 5000,
    "\u00b2",
    "/",
    "-x",
    "usbip://",
)

# what makes a command otherwise right, and short
_BASE: dict[str, str] = {
    "backends": "",
    "badge": "{result} --output {scratch}/badge.svg",
    "bridge": "unitree_go unitree_hg",
    "bringup": "dex3-usb --side left --set usb=usbip://127.0.0.1:1",
    "calibrate": "ezgripper --device /dev/null",
    "check": "{sample}",
    "compare": "{result} {result}",
    "doctor": "--scan none --domain {domain} --seconds 0.2",
    "emulate all": "--duration 0.3 --domain {domain}",
    "emulate dex1-motor": "--link {scratch}/link",
    "emulate dex3-usb": "--link usbip://127.0.0.1:0",
    "emulate g1": "--domain {domain}",
    "emulate h1": "--domain {domain}",
    "emulate mx64": "--link {scratch}/link",
    "info": "{sample}",
    "install-service": "sim-dex1 --side left --user root --dry-run",
    "models": "",
    "record": "{scratch}/out.mcap --duration 0.3 --domain {domain}",
    "publish": "{sample} --wait 0 --pace 500 --domain {domain}",
    "rehearse": "{sample} --check",
    "report": "{result}",
    "serve": "sim-dex1 --side left --domain {domain}",
    "teleop": "full-stroke --domain {domain}",
}
_CODES = (0, 1, 2, 130)


def command_lines() -> dict[str, list[click.Option]]:
    """Every command that is tried, with its options."""
    from dexkit.cli import cli

    found: dict[str, list[click.Option]] = {}

    def walk(command: click.Command, path: str) -> None:
        context = click.Context(command)
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                below = command.get_command(context, name)
                if below is not None:
                    walk(below, f"{path} {name}".strip())
        elif path in _BASE:
            found[path] = [p for p in command.params if isinstance(p, click.Option)]

    walk(cli, "")
    return found


class OptionsCase(Case):
    """Command lines with one odd option each."""

    name = "options"
    what = "odd values for every option of every command"
    unit = "command lines"
    limit = 300.0

    def run(self, batch: Batch) -> None:
        logging.disable()
        from dexkit.traces import sample_path

        places = {
            "scratch": str(batch.scratch),
            # a copy: some of these command lines write to it
            "sample": str(batch.scratch / "sample.mcap"),
            "result": str(batch.scratch / "result.json"),
            "domain": str(batch.domain),
        }
        (batch.scratch / "empty").touch()
        original = sample_path("dex1_hand_dropout")
        shutil.copyfile(original, places["sample"])
        made = Program(batch, ["dexkit", "check", places["sample"], "--result", places["result"]])
        if made.wait() not in (0, 1):
            raise RuntimeError(made.output)
        lines = {path: options for path, options in command_lines().items() if options}
        for _ in range(2 if batch.sample else 10):
            path = batch.random.choice(sorted(lines))
            option = batch.random.choice(lines[path])
            self._try(batch, path, option, places)
            shutil.copyfile(original, places["sample"])
            batch.units += 1

    def _try(self, batch: Batch, path: str, option: click.Option, places: dict[str, str]) -> None:
        rng = batch.random
        odd: list[str] = []
        kind: click.ParamType[Any] = option.type
        begin = ""
        if isinstance(option, SettingsOption):
            setting = rng.choice(option.known)
            kind, begin = setting.type, f"{setting.key}="
        if not option.is_flag:
            pool: tuple[str, ...]
            if isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
                pool = _NUMBERS
            elif isinstance(kind, click.Path):
                pool = _PATHS
            else:
                pool = rng.choice((_NUMBERS, _PATHS, _TEXTS))
            value = rng.choice(pool)
            if value.startswith("{"):
                value = value.format(**places)
            odd = [begin + value]
        words = [w.format(**places) for w in f"{path} {_BASE[path]}".split()]
        limits = []
        if path == "doctor" and rng.random() < 0.5:
            limits = [(resource.RLIMIT_NOFILE, rng.randrange(16, 30))]
        line = ["dexkit", *words, option.opts[0], *odd]
        with Program(batch, line, limits=limits) as program:
            with contextlib.suppress(WaitTimeout):  # some print nothing while they wait
                until(lambda: "ready:" in program.output or not program.running, "a word", 10.0)
            if program.running and "ready:" in program.output:
                program.wait(1.0)
            program.signal(signal.SIGINT)
            code = program.wait(30.0)
        text = f"{code}: {' '.join(line)[:400]}\n{program.output[-2000:]}"
        if program.check_output(batch):
            pass
        elif code is None:
            batch.found("does not end", path, text)
        elif code not in _CODES and code != -signal.SIGINT:
            batch.found("exit code", path, text)


def cases() -> list[Case]:
    """The one case."""
    return [OptionsCase()]
