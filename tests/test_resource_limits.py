"""Too little memory and too few threads are told in one line by every command."""

from __future__ import annotations

import errno

import pytest

from dexkit.cli import info, main
from dexkit.errors import ResourceError
from dexkit.traces import sample_path


def no_memory() -> None:
    bytearray(2**60)


def no_memory_for_a_library() -> None:
    raise ImportError("libarrow.so.2500: failed to map segment from shared object")


def no_thread() -> None:
    raise RuntimeError("can't start new thread")


def no_process() -> None:
    raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")


def no_memory_for_a_process() -> None:
    raise OSError(errno.ENOMEM, "Cannot allocate memory")


@pytest.mark.parametrize(
    ("fail", "told"),
    [
        (no_memory, "not enough memory"),
        (no_memory_for_a_library, "not enough memory"),
        (no_thread, "no thread can be started"),
        (no_process, "ulimit -u"),
        (no_memory_for_a_process, "ulimit -v"),
    ],
)
def test_lack_of_memory_or_threads_is_told(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fail: object,
    told: str,
) -> None:
    monkeypatch.setattr(info, "summary", lambda trace: fail())  # type: ignore[operator]
    with pytest.raises(SystemExit) as end:
        main(["info", str(sample_path("dex3_pinch"))])
    err = capsys.readouterr().err
    assert end.value.code == ResourceError.exit_code == 2
    assert err.startswith("error: ")
    assert told in err


@pytest.mark.parametrize("error", [RuntimeError("a bug"), ImportError("No module named 'x'")])
def test_other_errors_stay_what_they_are(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(info, "summary", fail)
    with pytest.raises(type(error)):
        main(["info", str(sample_path("dex3_pinch"))])
