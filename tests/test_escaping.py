"""Names and texts from outside reach neither a terminal nor a page unescaped."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import sys
import unicodedata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import click
import pytest
from mcap.writer import Writer
from rich.table import Table
from rich.text import Text

from dexkit.cli.status_line import log_to_stderr
from dexkit.conformance.kit.result_file import write_json
from dexkit.console import Console, markup
from dexkit.errors import DdsUnavailable, OutputError, UsageError
from dexkit.escaping import Guard, guarded, html, one_line, visible
from tests import hostile
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, T0, cmd, state

ROOT = Path(__file__).parent.parent
NASTY = (
    "\x1b[31mred\x1b]0;title\x07\x9b5m\u202eback\u200b[bold]b[/bold][link=http://e.example]l[/link]"
    "<script>x</script>|`a`\nready: fake\r\x1b[K\x00\x7f"
)
LONG = f"rt/{'x' * 50_000}"


def clean(text: str) -> None:
    assert not hostile.raw(text), f"{hostile.raw(text)} in {text[:400]!r}"
    for line in text.splitlines():
        assert not line.startswith(("ready: fake", "error: fake")), text[:400]


def test_every_control_and_format_character_is_shown() -> None:
    kinds = ("Cc", "Cf", "Cs", "Zl", "Zp")
    for code in range(sys.maxunicode + 1):
        character = chr(code)
        if unicodedata.category(character) in kinds and character not in "\t\n":
            assert visible(character) != character, hex(code)
    assert visible("a\tb\nc é 手 ⚠️") == "a\tb\nc é 手 ⚠️"
    assert visible("\x1b\x9b\u202e\U000e0001\udc80") == "\\x1b\\x9b\\u202e\\U000e0001\\udc80"
    assert one_line("a\tb\nc") == "a\\tb\\nc"
    assert len(one_line("x" * 10**6)) == 300
    assert html("<\x1b>") == "&lt;\\x1b&gt;"
    xml = f"<a>{html(''.join(map(chr, range(0x300))) + chr(0xFFFE) + chr(0xD800))}</a>"
    ElementTree.fromstring(xml)


def test_a_guarded_stream_shows_escapes_and_lets_a_status_line_go_back() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream, begin in ((Terminal(), "\r\x1b[K"), (io.StringIO(), "\\r\\x1b[K")):
        guard = Guard(stream, "it")  # type: ignore[arg-type]
        guard.write("\r\x1b[Kstatus \r\x1b[K\x1b[31m")
        assert stream.getvalue() == f"{begin}status \\r\\x1b[K\\x1b[31m"


def test_unencodable_characters_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    with guarded():
        print("手 \x1b[31m\udc80")
        click.echo("手")
        Console(width=80).print("手")
    assert raw.getvalue() == b"\\u624b \\x1b[31m\\udc80\n\\u624b\n\\u624b\n"


def test_console_prints_no_colours_of_its_input(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    with guarded():
        console = Console(force_terminal=True, width=500, color_system="standard")
        table = Table()
        table.add_column(markup(NASTY))
        table.add_row(markup(NASTY), style="red")
        table.add_row(Text(one_line(NASTY)))
        console.print(table)
        console.print(f"[bold]{markup(NASTY)}[/]")
        console.print(Text(NASTY))
    text = out.getvalue()
    assert "\x1b[31m" in text  # ours
    assert "\x1b[31mred" not in text
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert not hostile.raw(plain)
    assert "[bold]b[/bold]" in plain


def test_a_log_message_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    before = logging.getLogger().handlers[:], logging.getLogger().level
    try:
        with guarded():
            log_to_stderr(quiet=False, status=False, always="dexkit.test")
            logging.getLogger("dexkit.test").warning("topic %s", NASTY)
    finally:
        logging.basicConfig(level=before[1], handlers=before[0], force=True)
    err = capsys.readouterr().err
    clean(err)
    assert err.count("\n") == 1


def test_error_text_is_escaped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from dexkit import cli

    def fails(**settings: Any) -> None:
        raise UsageError(f"no topic {NASTY}", hint=f"is it\n{NASTY}\nerror: fake")

    monkeypatch.setattr(cli.cli, "main", fails)
    with pytest.raises(SystemExit):
        cli.main(["x"])
    err = capsys.readouterr().err
    clean(err)
    assert [line[:2] for line in err.splitlines()[1:]] == ["  "] * (err.count("\n") - 1)


def nasty_recording(path: Path) -> Path:
    """A recording in which every text is hostile."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=NASTY, library=NASTY)
        schemas = [
            writer.register_schema(name=name, encoding=encoding, data=data)
            for name, encoding, data in (
                (CMD_TYPE.replace("::", "/").replace("/dds_", ""), "ros2msg", b"uint8 a"),
                (NASTY, NASTY, NASTY.encode()),
                (LONG, "ros2msg", b"# " + NASTY.encode() * 20),
            )
        ]
        topics = (CMD, STATE, f"rt/dex1/left/{NASTY}", f"/{NASTY}/cmd", LONG)
        for i, topic in enumerate(topics):
            for schema in schemas[i % 2 : i % 2 + 2]:
                channel = writer.register_channel(
                    topic, "cdr", schema, metadata={NASTY: NASTY, "offered_qos_profiles": NASTY}
                )
                for n in range(3):
                    time = T0 + n * 10**7
                    writer.add_message(channel, time, cmd(n) if i % 2 else state(n), time)
        writer.add_metadata(NASTY, {NASTY: NASTY, "b": LONG})
        writer.add_metadata("dds_endpoints", {"endpoints": json.dumps([{"topic": NASTY}])})
        writer.finish()
    return path


def test_recording_with_escape_sequences_prints_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class NoNode:
        def __init__(self, *args: object, **settings: object) -> None:
            raise DdsUnavailable("no DDS here")

    monkeypatch.setattr("dexkit.dds.DdsNode", NoNode)
    path = str(nasty_recording(tmp_path / "nasty.mcap"))
    printed = 0
    for arguments in (
        ["info", path],
        ["info", path, "--json"],
        ["replay", path],
        ["publish", path],
        ["publish", path, "--topic", f"/{NASTY[:40]}"],
        ["check", path, "-v", "--dialect", "unitree_go", "--side", "both"],
        ["check", path, "-v", "--dialect", "g1"],
        ["teleop", path],
    ):
        code, out, err = hostile.run_command(arguments)
        assert code in (0, 1, 2), arguments
        clean(out + err)
        printed += len(out + err)
        assert all(len(line) < 15_000 for line in (out + err).splitlines()) or "--json" in arguments
    assert printed > 1000
    assert STATE_TYPE


def test_result_with_escape_sequences_shows_none(tmp_path: Path) -> None:
    from tests.report_helpers import result_of_every_kind

    result = result_of_every_kind(NASTY)
    result.subject["hand"] = result.subject["firmware"] = NASTY
    write_json(result, tmp_path / "r.json")
    hostile.render_all(tmp_path / "r.json", tmp_path)
    file = str(tmp_path / "r.json")
    page = str(tmp_path / "out.html")
    for arguments in (
        ["report", file, "-v"],
        ["report", file, "--markdown", "-"],
        ["report", file, "--html", page, "--junit", str(tmp_path / "j.xml")],
        ["badge", file, "-o", "-"],
        ["compare", file, file],
        ["compare", file, file, "--html", page],
    ):
        code, out, err = hostile.run_command(arguments)
        assert code in (0, 1), err
        clean(out + err)
    ElementTree.parse(tmp_path / "j.xml")


def test_doctor_escapes_names_of_peers() -> None:
    from dexkit.doctor import Observations, Scope, diagnose, readiness, verdict
    from dexkit.doctor.observations import DomainView, Endpoint, Participant
    from dexkit.doctor.report import print_report

    peers = tuple(
        Participant(str(i), process=NASTY, host=NASTY, version=NASTY, pid=i, command=command)
        for i, command in enumerate(("", NASTY, LONG))
    )
    ends = tuple(
        Endpoint(topic, kind, role, f"{topic}{kind}{role}", "0")
        for topic in (STATE, CMD, f"rt/dex1/left/{NASTY}", LONG, "rt/dex1/letf/state")
        for kind in (STATE_TYPE, NASTY)
        for role in ("reader", "writer")
    )
    views = (DomainView(1, peers, ends), DomainView(2, peers))
    seen = Observations(domains=views, examined=("lo",), seconds=1.0)
    scope = Scope()
    findings = diagnose(seen, scope)
    assert findings
    out = io.StringIO()
    console = Console(file=out, width=120)
    print_report(console, seen, findings, verdict(seen, findings, scope), readiness(seen, scope))
    clean(out.getvalue())
    assert all(len(line) < 3000 for line in out.getvalue().splitlines())


def test_a_stream_that_cannot_be_written_is_a_typed_error_each_time() -> None:
    descriptor = os.open("/dev/full", os.O_WRONLY)
    stream = os.fdopen(descriptor, "w")
    guard = Guard(stream, "it")
    guard.write("text")
    for _ in range(2):
        with pytest.raises(OutputError, match="cannot write it: No space left"):
            guard.flush()
    stream.close()  # what is left goes nowhere, and raises nothing


_ALONE = {
    r"\brich\.console\b": {"dexkit/console.py"},
    r"^from html import|^import html": {
        "dexkit/escaping.py",
    },
    r"sys\.std(out|err)\.buffer|sys\.__std": set(),
}


def test_only_listed_modules_write_to_the_terminal() -> None:
    for pattern, allowed in _ALONE.items():
        for folder in ("dexkit", "conformance", "drivers", "emulators", "traces"):
            for path in (ROOT / folder).rglob("*.py"):
                name = path.relative_to(ROOT).as_posix()
                if name not in allowed and not any(p.is_symlink() for p in path.parents):
                    found = re.search(pattern, path.read_text(encoding="utf-8"), re.M)
                    assert not found, f"{name} has {found and found.group()}"
