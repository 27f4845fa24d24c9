"""Every command that the documents show is accepted by the command line."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import click
import pytest

from dexkit.cli import cli
from dexkit.cli.lazy_group import LazyGroup
from dexkit.errors import DdsSetupError
from tests.docs_commands import ROOT, shown_commands

_OWN = {"myhand", "myhand-1"}
"""The model that docs/other-hands.md shows how to add."""


def _parse(words: tuple[str, ...]) -> None:
    """Parse as ``dexkit WORDS`` would be; nothing runs.

    :raises click.ClickException: it is refused.
    """
    command: click.Command = cli
    context: click.Context | None = None
    rest, name = list(words), "dexkit"
    while True:
        context = command.make_context(name, rest, parent=context)
        if not isinstance(command, click.Group):
            return
        rest = [*context._protected_args, *context.args]
        found, next_command, rest = command.resolve_command(context, rest)
        assert found is not None
        assert next_command is not None
        name, command = found, next_command


def test_every_dexkit_command_in_the_documents_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("key").touch()
    Path("cyclonedds").mkdir()
    wrong = []
    shown = [s for s in shown_commands() if s.program == "dexkit" and not _OWN & {*s.words}]
    for command in shown:
        for name in command.words:
            if Path(name).suffix in (".mcap", ".json", ".toml", ".zip", ".pub", ".html"):
                Path(name).parent.mkdir(parents=True, exist_ok=True)
                Path(name).touch()  # what a reader has
        try:
            _parse(command.words)
        except DdsSetupError:  # there is no such interface here
            if "--interface" not in command.words:
                raise
        except click.ClickException as error:
            wrong.append(f"{command}\n    {error.format_message()}")
    assert len(shown) > 80
    assert not wrong, "\n".join(wrong)


def test_the_command_page_has_the_sections_of_the_help_and_every_command() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    headings = re.findall(r"(?m)^## (.*)$", page)
    assert isinstance(cli, LazyGroup)
    assert headings[: len(cli.sections)] == list(cli.sections)
    missing = [
        name
        for name in cli.list_commands(click.Context(cli))
        if not re.search(rf"`(sudo )?(dexkit )?{name}\b", page)
    ]
    assert not missing


def test_every_make_target_and_module_in_the_documents_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for command in shown_commands():
        if command.program == "make":
            assert f"\n{command.words[0]}: " in makefile, command
        if command.program == "python" and command.words[0] == "-m":
            module = ROOT / command.words[1].replace(".", "/")
            assert module.is_dir() or module.with_suffix(".py").is_file(), command


def test_what_the_examples_import_from_dexkit_exists() -> None:
    seen, missing = 0, []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for block in re.finditer(r"(?ms)^```python\n(.*?)^```$", text):
            for node in ast.walk(ast.parse(block[1])):
                if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith(
                    "dexkit"
                ):
                    continue
                module = importlib.import_module(node.module or "")
                for name in node.names:
                    seen += 1
                    if not hasattr(module, name.name):
                        missing.append(f"{path.name}: from {node.module} import {name.name}")
    assert seen > 20
    assert not missing, "\n".join(missing)


def test_every_option_in_the_text_of_the_documents_exists() -> None:
    wrong = []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for shown in re.finditer(r"`(?:sudo )?dexkit ([a-z][^`]*)`", path.read_text("utf-8")):
            command: click.Command | None = cli
            words = shown[1].replace("|", " ").split()
            while words and isinstance(command, click.Group):
                command = command.get_command(click.Context(command), words.pop(0).rstrip(","))
            if command is None:
                wrong.append(f"{path.name}: {shown[0]}")
                continue
            known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
            given = {re.split("[=,]", word)[0] for word in words if word.startswith("--")}
            wrong += [f"{path.name}: {shown[0]}: {option}" for option in given - known]
    assert not wrong, "\n".join(wrong)
