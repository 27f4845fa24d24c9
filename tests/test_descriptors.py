"""Waiting for descriptors, by select(2) and by poll(2), which takes those from 1024 on, too."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from dexkit import descriptors
from dexkit.descriptors import wait_readable, wait_writable


@pytest.fixture(params=[1024, 0], ids=["select", "poll"], autouse=True)
def limit(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """From which descriptor on poll(2) is used."""
    monkeypatch.setattr(descriptors, "_SELECT_LIMIT", request.param)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def test_readable_when_there_is_data(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    assert wait_readable([reader], 0.0) == []
    assert wait_readable([reader], 0.0004) == []
    os.write(writer, b"x")
    assert wait_readable([reader], 10.0) == [reader]


def test_readable_at_the_end(pipe: tuple[int, int]) -> None:
    reader, writer = os.pipe()
    os.close(writer)
    assert wait_readable([pipe[0], reader], 10.0) == [reader]
    os.close(reader)


def test_writable_until_the_pipe_is_full(pipe: tuple[int, int]) -> None:
    _, writer = pipe
    os.set_blocking(writer, False)
    assert wait_writable(writer, 10.0)
    while wait_writable(writer, 0.0):
        os.write(writer, bytes(1 << 12))
    with pytest.raises(BlockingIOError):
        os.write(writer, bytes(1 << 16))


def test_closed_descriptor_is_an_error(pipe: tuple[int, int]) -> None:
    closed = os.dup(pipe[0])
    os.close(closed)
    with pytest.raises(OSError, match="Bad file descriptor"):
        wait_readable([closed], 0.0)
    with pytest.raises(OSError, match="Bad file descriptor"):
        wait_writable(closed, 0.0)
