"""Test options of the command line: those of several commands are written once."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.cli.command_help import Command

COMMANDS = Path(__file__).parent.parent / "dexkit" / "cli"
MOST = 251

ONE_OR_SEVERAL = {"--device", "--interface", "--side"}
"""Options that are declared twice with one meaning: of commands for one, and for several."""
TEXTS_OR_VALUES = {"--set"}
"""Declared twice: settings of a backend, which reads them itself, and of a command."""


def declared(path: Path) -> list[str]:
    """Names of the options that a module declares with ``click.option``."""
    return [
        name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "click.option"
        for text in ast.walk(ast.Tuple(list(node.args)))
        if isinstance(text, ast.Constant) and str(text.value).startswith("-")
        for name in str(text.value).split("/")
    ]


def test_an_option_has_one_meaning_wherever_it_is() -> None:
    """Options of several commands are declared in one place, ``dexkit/cli/options.py``."""
    found = Counter(name for path in COMMANDS.rglob("*.py") for name in declared(path))
    assert len(found) > 100
    twice = {name for name, count in found.items() if count > 1}
    assert twice == ONE_OR_SEVERAL | TEXTS_OR_VALUES
    assert max(found.values()) == 2
    flags: defaultdict[str, set[bool]] = defaultdict(set)
    for _, command in commands():
        for option in command.params:
            if isinstance(option, click.Option):
                flags[option.opts[0]].add(option.is_flag)
    assert not [name for name, kinds in flags.items() if len(kinds) > 1]


def test_options_are_few() -> None:
    """``--help`` is not counted."""
    options = [p for _, c in commands() for p in c.params if isinstance(p, click.Option)]
    assert len(options) <= MOST


def commands(group: click.Group = cli, *words: str) -> Iterator[tuple[str, click.Command]]:
    """Every command, with its name."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        if isinstance(command, click.Group):
            yield from commands(command, *words, name)
        elif command is not None:
            yield " ".join((*words, name)), command


def test_help_shows_every_command_in_its_section() -> None:
    shown = CliRunner().invoke(cli, ["--help"], prog_name="dexkit").output
    for heading, names in cli.sections.items():
        section = shown.split(f"\n{heading}:\n")[1].split("\n\n")[0]
        assert [line.split()[0] for line in section.splitlines() if line[2] != " "] == [*names]


def test_help_of_every_command_ends_with_its_exit_codes() -> None:
    for name, command in commands():
        shown = CliRunner().invoke(cli, [*name.split(), "--help"]).output
        if name in ("sign", "verify"):
            continue
        assert isinstance(command, Command), name
        codes = shown.split("\nExit codes:\n")[1]
        assert [line.split()[0] for line in codes.splitlines() if line[2] != " "] == [
            *map(str, command.exit_codes)
        ], name
        assert {0, 1, 2} <= {*command.exit_codes}, name


COMPLETED = {
    "dexkit re": {"record", "rehearse", "replay", "report"},
    "dexkit emulate dex": {"dex1-motor", "dex3-usb"},
    "dexkit check --ju": {"--junit"},
    "dexkit teleop --side l": {"left"},
}


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is needed")
def test_bash_completes_commands_options_and_values(tmp_path: Path) -> None:
    """As docs/install.md says: the script is sourced, and its function called as by the Tab key."""
    script = 'eval "$(_DEXKIT_COMPLETE=bash_source dexkit)"\n'
    for typed in COMPLETED:
        words = typed.split(" ")
        script += (
            f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; COMPREPLY=()\n"
            '_dexkit_completion dexkit; echo "${COMPREPLY[@]}"\n'
        )
    folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-e"],
        input=script,
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        cwd=tmp_path,
    )
    assert [set(line.split()) for line in done.stdout.splitlines()] == [*COMPLETED.values()]
    assert done.stderr == ""
