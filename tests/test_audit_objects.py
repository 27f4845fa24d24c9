"""Objects behind a URL are read by ranges, with a few blocks in memory."""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from dexkit.conformance.audit import objects
from dexkit.conformance.audit.examine import Task, examine
from dexkit.conformance.audit.objects import Object, RangeFile
from dexkit.conformance.audit.records import EpisodeRecord, State
from dexkit.conformance.audit.units import Unit, find
from dexkit.traces import sample_path

SAMPLE = "dex1_legacy_v1_1"


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "BLOCK", 1 << 14)
    monkeypatch.setattr(objects, "_PAUSE", 0.0)


@pytest.fixture
def memory() -> Iterator[MemoryFileSystem]:
    files = MemoryFileSystem()
    yield files
    files.rm("/ranges", recursive=True)


@pytest.mark.usefixtures("small_blocks")
def test_range_file_reads_the_contents_of_the_object(memory: MemoryFileSystem) -> None:
    data = random.Random(1).randbytes(50_000)
    memory.pipe("/ranges/a", data)
    source = Object("memory://ranges/a")
    raw, expected = RangeFile(source), io.BytesIO(data)
    numbers = random.Random(2)
    with io.BufferedReader(raw, 512) as file:
        for _ in range(300):
            at, count = numbers.randrange(52_000), numbers.choice((1, 9, 512, 4096, 30_000))
            assert file.seek(at) == expected.seek(at)
            assert file.read(count) == expected.read(count)
            assert len(raw._blocks) <= 4
        assert file.seek(-8, os.SEEK_END) == len(data) - 8
        assert file.read() == data[-8:]
    assert b"".join(source.pieces()) == data


@pytest.mark.usefixtures("small_blocks")
def test_an_object_that_is_not_copied_gets_the_same_record(memory: MemoryFileSystem) -> None:
    data = sample_path(SAMPLE).read_bytes()
    memory.pipe("/ranges/a.mcap", data)
    memory.pipe("/ranges/cut.mcap", data[: len(data) // 2])
    for session in find("memory://ranges"):
        assert isinstance(session, Unit)
        copied, in_place = examine(Task((session,)))[0], examine(Task((session,), max_size=100))[0]
        for record in (copied, in_place):
            assert record.state is State.JUDGED
            del record.facts["cpu_s"]
        assert in_place == copied


class Server(SimpleHTTPRequestHandler):
    """Gives files, in ranges if it is asked to; some not at all."""

    asked: ClassVar[list[tuple[str, str]]] = []
    ranges = True

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def do_GET(self) -> None:
        name = Path(self.path).name
        path = Path(self.translate_path(self.path))
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        type(self).asked.append((name, self.headers.get("Range", "")))
        if name == "refused.mcap":
            self.send_error(403)
        elif match and self.ranges and path.is_file():
            data = path.read_bytes()
            begin, end = int(match[1]), int(match[2]) + 1
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {begin}-{end - 1}/{len(data)}")
            self.send_header("Content-Length", str(len(data[begin:end])))
            self.end_headers()
            self.wfile.write(data[begin:end])
            if name == "gone.mcap":
                path.unlink()
        else:
            with contextlib.suppress(ConnectionError):  # a client that has read enough
                super().do_GET()

    def do_HEAD(self) -> None:
        if Path(self.path).name == "refused.mcap":
            self.send_error(403)
        else:
            super().do_HEAD()

    def end_headers(self) -> None:
        if self.ranges:
            self.send_header("Accept-Ranges", "bytes")
        super().end_headers()


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("ranges", [True, False])
def test_audit_reads_objects_of_a_web_server(tmp_path: Path, ranges: bool) -> None:
    pytest.importorskip("aiohttp", reason="install it: .tools/bin/uv pip install aiohttp")
    for name in ("good", "gone", "refused"):
        shutil.copyfile(sample_path(SAMPLE), tmp_path / f"{name}.mcap")
    (tmp_path / "notes.txt").write_text("no session")
    kind = type("Kind", (Server,), {"asked": [], "ranges": ranges})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(kind, directory=str(tmp_path))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            found = list(find(f"http://127.0.0.1:{server.server_port}/"))
            for most in (2**30, 1000):
                records = {
                    Path(s.name).stem: s
                    if isinstance(s, EpisodeRecord)
                    else examine(Task((s,), max_size=most))[0]
                    for s in found
                }
                states = {name: str(r.state) for name, r in records.items()}
                expected = {"good": "judged", "gone": "gone", "refused": "no permission"}
                if not ranges:
                    expected["gone"] = expected["good"]
                    if most == 1000:
                        expected |= {"good": "too large", "gone": "too large"}
                assert states == expected
        finally:
            server.shutdown()
            thread.join()
    asked = [where for name, where in kind.asked if name == "good.mcap"]
    assert all(asked) is ranges, asked
    assert len(asked) > 30 or not ranges


@pytest.mark.soak
def test_audit_reads_objects_of_an_s3_bucket(monkeypatch: pytest.MonkeyPatch) -> None:
    """S3, as moto emulates it on the loopback interface."""
    enable = "install it: .tools/bin/uv pip install s3fs 'moto[s3,server]'"
    pytest.importorskip("s3fs", reason=enable)
    pytest.importorskip("moto", reason=enable)
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    try:
        _, port = server.get_host_and_port()
        url = f"http://127.0.0.1:{port}"
        for name, value in {
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": url,
            "FSSPEC_S3_ENDPOINT_URL": url,
        }.items():
            monkeypatch.setenv(name, value)
        files = s3fs.S3FileSystem(endpoint_url=url)
        files.mkdir("archive")
        data = sample_path(SAMPLE).read_bytes()
        for name in ("a", "b"):
            files.pipe_file(f"archive/day/{name}.mcap", data)
        found = list(find("s3://archive"))
        assert [s.name for s in found] == [f"s3://archive/day/{n}.mcap" for n in "ab"]
        a, b = (s for s in found if isinstance(s, Unit))
        assert a.tag == b.tag != ""
        files.rm_file("archive/day/b.mcap")
        records = [
            examine(Task((a,)))[0],
            examine(Task((a,), max_size=1000))[0],
            examine(Task((b,)))[0],
        ]
        assert [str(r.state) for r in records] == ["judged", "judged", "gone"]
        assert records[0].findings == records[1].findings
        (nothing,) = find("s3://nobodys")
        assert isinstance(nothing, EpisodeRecord)
        assert nothing.state is State.GONE
        monkeypatch.setattr(s3fs.S3FileSystem, "find", _denied)
        (denied,) = find("s3://archive")
        assert isinstance(denied, EpisodeRecord)
        assert denied.state is State.REFUSED
    finally:
        server.stop()


def _denied(*arguments: Any, **more: Any) -> None:
    from s3fs.errors import translate_boto_error

    class Denied(Exception):
        response: ClassVar[dict[str, Any]] = {"Error": {"Code": "AccessDenied", "Message": "no"}}

    raise translate_boto_error(Denied())
