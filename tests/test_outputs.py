"""Output that cannot be written gives an error and an exit code; existing files stay whole."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from dexkit.child_processes import command_line
from dexkit.cli import cli, main
from dexkit.errors import UsageError
from tests import hostile

_SAMPLE = "<sample>"
_WRITERS: dict[tuple[str, ...], list[str]] = {
    ("badge",): ["<result>"],
    ("check",): [_SAMPLE, "--require", "DEX1-RATE-03"],
    ("compare",): ["<result>", "<result>"],
    ("diff",): [_SAMPLE, _SAMPLE, "--offset", "0"],
    ("info",): [_SAMPLE],
    ("rehearse",): [_SAMPLE],
    ("report",): ["<result>"],
}
"""Commands that write files by options, with what they need for it."""
_INPUTS = {
    "--pictures",
    "--against",
    "--capabilities",
    "--recording",
    "--config",
    "--answers",
    "--from-source",
    "--wire",
    "--beside-episodes",
}
_ELSEWHERE = {
    ("audit", "--out"),  # a folder: tests/test_audit.py
    ("export", "--out"),  # one, too: tests/test_sessions_export.py
    ("bringup", "--save-answers"),  # at the end of a session: tests/test_bringup_cli.py
    ("selftest", "--result"),  # after the test of a hand, as others write
    ("selftest", "--report"),
    ("demo", "--out"),  # a folder, made before anything starts
    ("install-service", "--directory"),  # tests/test_install_service.py
    ("monitor", "--record"),  # a key begins it: tests/test_monitor_terminal.py
    ("setup-dds", "--wheel"),  # tests/test_setup_dds.py
    ("setup-dds", "--log"),
    ("teleop", "--record"),  # as 'record' writes
}


def _outputs() -> Iterator[tuple[tuple[str, ...], str]]:
    for name, command in hostile.commands():
        for parameter in command.params:
            option = parameter.opts[0]
            if (
                isinstance(parameter, click.Option)
                and isinstance(parameter.type, click.Path)
                and option not in _INPUTS
                and (name[0], option) not in _ELSEWHERE
            ):
                yield name, next(o for o in parameter.opts if o.startswith("--"))


def test_unwritable_output_file_of_any_option_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, whole = hostile.judged_result(tmp_path)
    recording = tmp_path / "short.mcap"
    assert hostile.run_command(["cut", str(whole), str(recording), "--window", ":1"])[0] == 0
    given = {"<result>": str(tmp_path / "good.json"), _SAMPLE: str(recording)}
    (tmp_path / "out").mkdir()
    there = tmp_path / "out" / "there"
    there.write_text("good")

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    seen = 0
    for name, option in _outputs():
        assert name in _WRITERS, f"dexkit {' '.join(name)} {option} is not in the table"
        seen += 1
        fixed = [given.get(a, a) for a in _WRITERS[name]]
        for place, why in (
            ("/dev/full", "No space left on device"),
            (str(there), "No space left on device"),
            (str(tmp_path / "out"), "Is a directory"),
            (str(tmp_path / "none" / "x"), "No such file or directory"),
        )[: 2 if name in (("check",), ("rehearse",)) else 4]:  # which work each time
            with monkeypatch.context() as patch:
                if place == str(there):
                    patch.setattr(os, "replace", full)
                code, _, err = hostile.run_command([*name, *fixed, option, place])
            assert code == 2, f"{name} {option} {place}: {code}\n{err}"
            assert f"cannot write {place}: {why}" in err, err
            assert [p.name for p in (tmp_path / "out").iterdir()] == ["there"]
            assert there.read_text() == "good"
    assert seen >= 9


def test_full_or_closed_standard_output_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, recording = hostile.judged_result(tmp_path)
    result = str(tmp_path / "good.json")
    no_reader, pipe = os.pipe()
    os.close(no_reader)
    full = os.open("/dev/full", os.O_WRONLY)
    for arguments in (
        ["--help"],
        ["backends"],
        ["badge", result, "-o", "-"],
        ["info", str(recording)],
        ["models", "--json"],
        ["models"],
        ["report", result],
        ["report", result, "--markdown", "-"],
        ["compare", result, result],
        ["check", "--list", "--dialect", "dex3"],
        ["teleop"],
    ):
        for place, code in ((full, 2), (pipe, 141)):
            # as the interpreter opens it, with buffer and without
            for buffered in (True, False) if arguments == ["--help"] else (True,):
                stream = os.fdopen(os.dup(place), "w", encoding="utf-8")
                stream.reconfigure(write_through=not buffered)
                err = io.StringIO()
                with monkeypatch.context() as patch:
                    patch.setattr(sys, "stdout", stream)
                    patch.setattr(sys, "stderr", err)
                    with pytest.raises(SystemExit) as ended:
                        main(arguments)
                assert ended.value.code == code, (arguments, err.getvalue())
                printed = "error: cannot write standard output: No space left on device\n"
                assert err.getvalue() == (printed if code == 2 else "")
                stream.close()  # what is left in it raises nothing
    os.close(pipe)
    os.close(full)


def test_a_closed_standard_output_is_an_error_if_something_was_to_be_written(
    tmp_path: Path,
) -> None:
    _, recording = hostile.judged_result(tmp_path)
    result = str(tmp_path / "good.json")
    report = tmp_path / "report.md"
    for arguments, code in (
        (("info", "--json", str(recording)), 2),
        (("--help",), 2),
        (("check", str(tmp_path / "missing.mcap")), 2),
        (("badge", result, "-o", "-"), 2),
        (("report", result, "--markdown", str(report)), 0),
    ):
        done = subprocess.run(
            ["sh", "-c", 'exec "$@" >&-', "sh", *command_line(*arguments)],
            stderr=subprocess.PIPE,
            check=False,
            timeout=60,
            text=True,
        )
        assert done.returncode == code, (arguments, done.stderr)
        unwritten = "error: cannot write standard output: it is closed\n"
        assert (done.stderr == unwritten) == (code == 2 and "missing" not in str(arguments))
    assert report.read_text().startswith("#")


_OPENED_NEXT = """
import os, subprocess, sys
from dexkit.escaping import guarded
with guarded():
    assert os.open(sys.argv[1], os.O_RDWR) > 2
    assert [s.fileno() for s in (sys.stdin, sys.stdout, sys.stderr)] == [0, 1, 2]
    print("", file=sys.stderr)
    check = "import os; [os.fstat(n) for n in range(3)]; assert os.read(0, 1) == b''"
    subprocess.run([sys.executable, "-I", "-c", check], check=True)
sys.stdout.flush()
"""


@pytest.mark.parametrize("closed", ["<&-", "<&- >&-", "<&- 2>&-", "<&- >&- 2>&-"])
def test_no_file_gets_the_number_of_a_standard_stream(tmp_path: Path, closed: str) -> None:
    there = tmp_path / "device"
    there.write_bytes(b"answer")
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", _OPENED_NEXT, str(there)],
        check=False,
        timeout=60,
    )
    assert done.returncode == 0
    assert there.read_bytes() == b"answer"


@pytest.mark.parametrize("gripper", [("ezgripper",), ("dex1-serial", "--side", "left")])
def test_question_without_standard_input_is_an_error(
    tmp_path: Path, gripper: tuple[str, ...]
) -> None:
    command = command_line("calibrate", *gripper, "--device", str(tmp_path))
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" <&-', "sh", *command],
        capture_output=True,
        check=False,
        timeout=60,
        text=True,
    )
    assert done.returncode == 2
    assert "cannot ask whether" in done.stderr
    assert "--yes" in done.stderr


def test_no_command_overwrites_its_input_or_writes_a_file_twice(tmp_path: Path) -> None:
    _, recording = hostile.judged_result(tmp_path)
    session = tmp_path / "session.mcap"
    session.write_bytes(recording.read_bytes())
    result = tmp_path / "good.json"
    link = tmp_path / "link.json"
    link.symlink_to(result)
    hard_link = tmp_path / "hard.json"
    hard_link.hardlink_to(result)
    before = result.read_bytes()
    new = tmp_path / "new"
    for arguments in (
        ("report", result, "--html", result),
        ("report", result, "--junit", link),
        ("report", result, "--markdown", hard_link),
        ("report", result, "--recording", recording, "--html", recording),
        ("report", result, "--html", new, "--junit", new),
        ("badge", result, "-o", result),
        ("compare", result, "--html", result),
        ("check", session, "--junit", new, "--html", tmp_path / "." / "new"),
        ("check", session, "--result", session),
        ("check", session, "--result", new, "--html", new),
    ):
        found = CliRunner().invoke(cli, list(map(str, arguments)))
        assert isinstance(found.exception, UsageError), (arguments, found.output)
        assert "is also an" in found.exception.message
    assert result.read_bytes() == before
    assert session.read_bytes() == recording.read_bytes()
    assert not new.exists()
