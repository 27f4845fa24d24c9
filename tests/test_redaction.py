"""Credentials of a URL reach no file, page, message or log line."""

from __future__ import annotations

import json
import logging
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import click
import pytest

from dexkit.cli import cli, main
from dexkit.conformance.audit import objects
from dexkit.conformance.audit.audit import Audit, Limits, in_this_process
from dexkit.errors import UsageError
from dexkit.redaction import redact, redact_logs
from dexkit.traces import sample_path
from tests.each import each
from tests.test_audit_objects import Server

SECRETS = ("secret", "AKIA", "hunter")


@each(
    "text",
    [
        ("s3://bucket/a@b/c.mcap", "s3://bucket/a@b/c.mcap"),
        ("http://[::1]:80/x", "http://[::1]:80/x"),
        ("archive/a.mcap: no such file?", "archive/a.mcap: no such file?"),
        ("http://user:secret@host/x", "http://***@host/x"),
        ("http://secret@host:80/x", "http://***@host:80/x"),
        ("http://user:se@cret@host/x", "http://***@host/x"),
        ("ftp://user:sec/ret@host/x", "ftp://***@host/x"),  # as typed; not escaped
        ("http://user:sec?ret@host/x", "http://***"),
        ("http://user:sec#ret@host/x", "http://***"),
        ("http:/user:secret@host/x", "http:/***@host/x"),  # as a path shows it
        ("HTTPS://h/x?X-Amz-Signature=secret", "HTTPS://h/x?***"),
        ("https://h/x?a='secret'&b=secret", "https://h/x?***"),
        ("https://h/x#token=secret", "https://h/x#***"),
        ("https://h/x?sig=secret#f", "https://h/x?***"),
        ("https://h/x?to=http://secret/y&sig=secret", "https://h/x?***"),
        ("zip://a.mcap::http://user:secret@h/x.zip", "zip://a.mcap::http://***@h/x.zip"),
        ("403, url='http://h/x?sig=secret', no", "403, url='http://h/x?***', no"),
        ('403, url="http://u:secret@h/x" no', '403, url="http://***@h/x" no'),
        ("see <http://h/?secret> and <http://i>", "see <http://h/?***> and <http://i>"),
    ],
)
def test_userinfo_query_and_fragment_are_left_out(text: tuple[str, str]) -> None:
    assert redact(text[0]) == text[1]
    assert redact(text[1]) == text[1]


def test_parts_of_a_known_url_are_left_out_alone() -> None:
    url = "http://us:my secret@host/a?token=secret more#hunter2"
    said = f"no {url}: GET /a?token=secret more refused for us:my secret (hunter2)"
    shown = redact(said, url)
    assert shown == "no http://***@host/a?***: GET /a?*** refused for *** (***)"


class Queried(Server):
    """Takes any query."""

    def parse_request(self) -> bool:
        parsed = super().parse_request()
        if parsed:
            self.path = self.path.partition("?")[0]
        return parsed


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a web server."""
    kind = type("Kind", (Queried,), {"asked": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(kind, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def written(folder: Path) -> str:
    """All that an audit has written, files and their names."""
    files = [p for p in folder.rglob("*") if p.is_file()]
    assert {p.suffix for p in files} >= {".jsonl", ".html"}
    return "".join(f"{p}\n" + p.read_bytes().decode("utf-8", "replace") for p in files)


def check(text: str) -> None:
    assert not [s for s in SECRETS if s in text], text


def test_an_audit_writes_no_credentials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("aiohttp", reason="install it: .tools/bin/uv pip install aiohttp")
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(objects, "_PAUSE", 0.0)
    archive = tmp_path / "archive"
    archive.mkdir()
    sample = sample_path("dex1_legacy_v1_1").read_bytes()
    (archive / "cut.mcap").write_bytes(sample[: len(sample) // 2])
    shutil.copyfile(sample_path("dex1_legacy_v1_1"), archive / "refused.mcap")
    shutil.copyfile(sample_path("dex1_legacy_v1_1"), archive / "good.mcap")
    (archive / "none.mcap").write_bytes(b"no recording")
    with served(archive) as host:
        user = f"http://user:secret@{host}"
        locations = [
            f"{user}/",
            *(f"http://{host}/{name}.mcap?X-Amz-Signature=secret{i}&AWSAccessKeyId=AKIA#hunter"
              for i, name in enumerate(("good", "good", "cut", "refused", "gone", "none"))),
        ]  # fmt: skip
        for form, most in (("jsonl", 2**30), ("parquet", 1000)):
            limits = Limits(max_size=most)
            audit = Audit(locations, tmp_path / form, limits=limits, parquet=form == "parquet")
            outcome = audit.run(in_this_process)
            assert (outcome.done, outcome.total) == (10, 10)
            check(written(tmp_path / form))
        again = Audit(locations, tmp_path / "jsonl", parquet=False).run(in_this_process)
        assert (again.done, again.reused) == (10, 7)
        rows = [json.loads(line) for line in (tmp_path / "jsonl/episodes.jsonl").open()]
        assert len({row["episode"] for row in rows}) == 10
        assert f"http://***@{host}/good.mcap [" in "".join(row["episode"] for row in rows)
        states = {row["state"] for row in rows}
        assert states == {"judged", "gone", "no permission", "unreadable"}
    check("".join(capsys.readouterr()))


@each(
    "location",
    ["nosuch://user:secret@host/x?token=secret", "http://user:sec[ret@127.0.0.1:1/x#AKIA"],
)
def test_a_url_that_cannot_be_opened_is_an_error_without_credentials(
    location: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["audit", location, "--out", str(tmp_path / "out")])
    said = "".join(capsys.readouterr())
    assert ended.value.code == 2
    assert "Traceback" not in said
    if "error: " not in said:  # it is a row
        said += written(tmp_path / "out")
    check(said)
    assert "ret@" not in said


def commands(group: click.Group, *names: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, *names, name)
        else:
            yield (*names, name), command


URL = "https://user:secret@host/a.mcap?token=secret#AKIA"


def test_no_path_of_any_command_is_a_url(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor is one shown whole, or a folder 'https:' made."""
    monkeypatch.chdir(tmp_path)
    tried = 0
    for names, command in commands(cli):
        for parameter in command.params:
            if not isinstance(parameter.type, click.Path):
                continue
            with pytest.raises(UsageError) as refused:
                parameter.type.convert(URL, parameter, click.Context(command))
            assert "https://***@host/a.mcap?*** is a URL" in str(refused.value), names
            tried += 1
        first = next((p for p in command.params if isinstance(p, click.Argument)), None)
        if first is not None and isinstance(first.type, click.Path):
            with pytest.raises(SystemExit) as ended:
                main([*names, URL, *[URL] * (first.nargs == -1), "x"])
            said = "".join(capsys.readouterr())
            assert ended.value.code == 2, said
            assert "is a URL" in said, said
            check(said)
    assert tried > 40
    assert not list(tmp_path.iterdir())


@each(
    "arguments",
    [
        ("view", "--rerun", "rerun+http://user:secret@h:1/proxy?token=secret"),
        ("serve", "sim-dex1", "--set", "usb=usbip://user:secret@host:1/x?secret"),
        ("check", f"--require={URL}", URL),
        ("audit", ".", "--set", f"format={URL}"),
        ("audit", ".", "--ray", "ray://user:secret@127.0.0.1:1"),
        (URL,),
        ("info", f"--{URL}"),
    ],
)
def test_no_error_of_a_command_shows_credentials(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*arguments])
    assert ended.value.code == 2
    check("".join(capsys.readouterr()))


def test_log_lines_of_a_storage_s_library_are_redacted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging, "lastResort", logging.lastResort)
    redact_logs()
    redact_logs()
    last = logging.lastResort
    assert last is not None
    record = logging.LogRecord("aiohttp", 30, "x", 1, "retry %s", (URL,), None)
    assert last.format(record) == "retry https://***@host/a.mcap?***"
    try:
        raise ValueError(URL)
    except ValueError as error:
        trace = (type(error), error, error.__traceback__)
    record = logging.LogRecord("asyncio", 40, "x", 1, "never retrieved", (), trace)
    assert "ValueError: https://***@host" in last.format(record)
    check(last.format(record))


def test_command_lines_of_other_programs_are_redacted(monkeypatch: pytest.MonkeyPatch) -> None:
    from dexkit.doctor import proc_files

    class Proc(type(Path())):  # type: ignore[misc]
        def read_bytes(self) -> bytes:
            return f"/usr/bin/python3\0train.py\0--to={URL}\0".encode()

    monkeypatch.setattr(proc_files, "_PROC", Proc("/proc"))
    assert proc_files.command_line(1) == "train.py --to=https://***@host/a.mcap?***"


def test_the_device_of_a_result_is_redacted() -> None:
    from dexkit.conformance.kit.backend_processes import RigOptions

    about: Callable[..., dict[str, str]] = RigOptions.subject.fget  # type: ignore[attr-defined]
    stand_in = type("Options", (), {"backend": "x", "devices": {"left": URL}, "objects": {}})
    assert about(stand_in) == {"backend": "x", "device": "left https://***@host/a.mcap?***"}


@each(
    "uri",
    [
        ("<Domain><Security><IdentityCertificate>data:,secret</IdentityCertificate></Security>"
         "<Password>hunter2</Password><Peer address='secret'/></Domain>",
         "<Domain <Security <IdentityCertificate <Password <Peer"),
        ("file:///etc/cyclonedds.xml", "file:///etc/cyclonedds.xml"),
        ("http://user:secret@host/x", "http://***@host/x"),
        ("", ""),
    ],
)  # fmt: skip
def test_the_doctor_keeps_no_contents_of_a_dds_configuration(
    uri: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from dexkit.doctor import environment as module

    monkeypatch.setattr(module, "_import_problem", lambda name: "")
    monkeypatch.setenv("CYCLONEDDS_URI", uri[0])
    assert module.environment().uri == uri[1]
