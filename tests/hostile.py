"""Hostile input for whatever reads text, JSON, TOML or options: made from a seed, no assertions.

The tests use a part of it; a longer campaign can draw from it as long as it likes.
"""

from __future__ import annotations

import contextlib
import copy
import io
import random
import re
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import click

NUMBERS = (
    "nan", "-nan", "inf", "-inf", "Infinity", "1e400", "-1e400", "1e-400", "-1", "-0.0", "0",
    "9" * 30, "9" * 5000, "-" + "9" * 30, "1e308", "1e-308", "", " ", "²", "٣", "1_0", "0x10",
    "1,5", "1.5.", "--", "\x00", "\x1b[31m", "a" * 5000, "\udc80",
)  # fmt: skip
"""What a user may write where a number is wanted."""

TEXTS = (
    "", " ", "\x00", "\x07\x08\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\x9b31m", "\u202eevil",
    "a\u200bb", "\udc80", "\ufffe", "x" * 100_000, "two\nlines", "error: fake\nready: fake",
    "::set-output name=x::y", "[bold]markup[/bold]", "[link=http://evil.example]x[/link]", "[/]",
    "<script>alert(1)</script>", "\"'><img src=x onerror=alert(1)>", "| a | b |", "`code`",
    "@everyone", "](javascript:alert(1))", "\\", "%s%n", "{0}", "../../etc/passwd", "²",
    "docs/sources/#b1", "[B.1](#b1)", "]]>", "\u2028", "DEX1-RATE-01", "left", "dex1-1",
)  # fmt: skip
"""What a name, a note or any other text may be."""

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 10**18, 10**25, 1e308, -1e308, 5e-324, [], {}, [[]], {"": {}},
    {"a": [{"b": [None]}]}, "text", *TEXTS,
)  # fmt: skip
"""What may be anywhere in a document."""


def nodes(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every node of a document, its root first."""
    yield path
    if isinstance(document, dict):
        for key, value in document.items():
            yield from nodes(value, (*path, key))
    elif isinstance(document, list):
        for index, value in enumerate(document):
            yield from nodes(value, (*path, index))


MISSING = object()


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with ``value`` at ``path``, or nothing there if it is :data:`MISSING`."""
    if not path:
        return None if value is MISSING else value
    copied = copy.copy(document)
    if len(path) > 1:
        copied[path[0]] = replaced(document[path[0]], path[1:], value)
    elif value is MISSING:
        del copied[path[0]]
    else:
        copied[path[0]] = value
    return copied


def mutated(document: Any, rng: random.Random) -> Any:
    """A copy with up to three nodes changed, removed, renamed or exchanged."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        every = list(nodes(document))
        path = rng.choice(every)
        kind = rng.random()
        if kind < 0.15:
            document = replaced(document, path, MISSING)
        elif kind < 0.3:
            other = rng.choice(every)
            document = replaced(document, path, _at(document, other))
        else:
            document = replaced(document, path, rng.choice(VALUES))
        if not isinstance(document, dict | list):
            break
    return document


def _at(document: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        document = document[step]
    return document


def broken_files() -> Iterator[tuple[str, bytes]]:
    """Files that are no JSON and no TOML, or not what they should be: (what it is, content)."""
    yield "empty", b""
    yield "not UTF-8", b"\xff\xfe\x00"
    yield "only a byte order mark", b"\xef\xbb\xbf"
    yield "zeros", bytes(1000)
    for depth in (100, 5000, 200_000):
        yield f"lists nested {depth} times", b"[" * depth
        yield f"lists nested {depth} times, closed", b"[" * depth + b"]" * depth
        yield f"objects nested {depth} times", b'{"a":' * depth
        yield f"objects nested {depth} times, closed", b'{"a":' * depth + b"1" + b"}" * depth
        yield f"TOML lists nested {depth} times", b"a = " + b"[" * depth + b"]" * depth
        yield f"TOML tables nested {depth} times", b"a = " + b"{a = " * depth + b"1" + b"}" * depth
        yield f"TOML keys nested {depth} times", b".".join([b"a"] * depth) + b" = 1"
        yield f"TOML headings nested {depth} times", b"[" + b".".join([b"a"] * depth) + b"]"
    for number in (b"NaN", b"-Infinity", b"1e400", b"9" * 30, b"9" * 5000, b"nan", b"-inf"):
        yield f"number {number[:9]!r}", b'{"a": ' + number + b"}"
        yield f"TOML number {number[:9]!r}", b"a = " + number
    yield "a key twice", b'{"a": 1, "a": 2}'
    yield "a TOML key twice", b"a = 1\na = 2"
    yield "a list", b"[]"
    yield "a number", b"1"
    yield "a lone surrogate", b'{"a": "\\ud800"}'
    yield "null", b"null"
    yield "text behind it", b"{} {}"


class Crash(AssertionError):
    """A command ended in a traceback, or by an exit code that it must not have."""


def run_command(arguments: list[str]) -> tuple[int, str, str]:
    """``dexkit ARGUMENTS`` in this process: exit code, standard output, standard error.

    :raises Crash: it raised anything else than SystemExit.
    """
    from dexkit.cli import main

    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        return code, out.getvalue(), err.getvalue()
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        printed = "".join(traceback.format_exception(error)[-4:])
        shown = [a if len(a) < 80 else f"{a[:40]}... ({len(a)})" for a in arguments]
        raise Crash(f"dexkit {shown!r}\n{printed}") from error
    raise Crash("main() came back")


def commands() -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Every command of the command line with its name, those of ``emulate`` too."""
    from dexkit.cli import cli

    def below(command: click.Command, name: tuple[str, ...]) -> Iterator[Any]:
        if isinstance(command, click.Group):
            context = click.Context(command)
            for each in command.list_commands(context):
                found = command.get_command(context, each)
                assert found is not None
                yield from below(found, (*name, each))
        else:
            yield name, command

    yield from below(cli, ())


def raw(text: str) -> set[str]:
    """Characters of an output that must not be there: control characters, C1, bidi, ..."""
    from dexkit.escaping import visible

    return {c for c in set(text) if visible(c) != c}


def judged_result(folder: Path) -> tuple[dict[str, Any], Path]:
    """The document of a result with a dozen requirements, and the recording that was judged."""
    import json

    from dexkit.conformance.kit.judge import judge
    from dexkit.conformance.kit.recording import Recording
    from dexkit.conformance.kit.requirements import catalogue, select
    from dexkit.traces import open_trace, sample_path

    path = sample_path("dex1_hand_dropout")
    recording = Recording.decode(open_trace(path))
    few = select(catalogue(recording.model.name), prefixes=("DEX1-RATE", "DEX1-TRACK"))
    found = judge(recording, requirements=few, subject={"recording": path.name})
    from dexkit.conformance.kit.result_file import write_json

    write_json(found, folder / "good.json")
    return json.loads((folder / "good.json").read_text()), path


def render_all(path: Path, folder: Path, view: Any = None) -> None:
    """Read a result file and make every report of it.

    :raises DexkitError: it is refused.
    """
    from dexkit.conformance.kit.result_file import read_json
    from dexkit.conformance.report.badge import badge_text, render_badge
    from dexkit.conformance.report.compare import (
        Comparison,
        render_comparison,
        render_comparison_markdown,
    )
    from dexkit.conformance.report.html import render
    from dexkit.conformance.report.junit import write_junit
    from dexkit.conformance.report.markdown import render_markdown
    from dexkit.conformance.report.terminal import print_result
    from dexkit.console import Console

    found = read_json(path)
    both = Comparison([found, found], ["a", "b"])
    pages = [render(found, view), render_badge(found), render_comparison(both)]
    written = [render_markdown(found), render_comparison_markdown(both)]
    out = io.StringIO()
    print_result(found, Console(file=out, width=100), verbose=True)
    write_junit(found, folder / "junit.xml")
    xml = (folder / "junit.xml").read_text(encoding="utf-8")
    ElementTree.fromstring(xml)
    for text in (*pages, *written, *badge_text(found), out.getvalue(), xml):
        text.encode()
        assert not raw(text), raw(text)
    # what stands between grave accents is shown as it is
    for text in (*pages, *(re.sub(r"`[^`\n]*`", "", text.replace("\\`", "")) for text in written)):
        for tag in ("<script", "<img"):
            assert tag not in text, text[max(0, text.find(tag) - 100) :][:300]
