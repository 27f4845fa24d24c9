"""Waiting for descriptors, below and above the 1024 that select(2) takes."""

from __future__ import annotations

import fcntl
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dexkit.descriptors import wait_readable, wait_writable
from tests.each import each

ABOVE = 1500


@contextmanager
def pipe(lowest: int) -> Iterator[tuple[int, int]]:
    """A pipe whose descriptors are at least so high."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < lowest + 10:
        if hard != resource.RLIM_INFINITY and hard < lowest + 10:
            pytest.skip(f"this machine allows {hard} open files")
        resource.setrlimit(resource.RLIMIT_NOFILE, (lowest + 10, hard))
    low = os.pipe()
    high = tuple(fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, lowest) for fd in low)
    for fd in low:
        os.close(fd)
    try:
        yield high[0], high[1]
    finally:
        for fd in high:
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@each("lowest", [3, ABOVE])
def test_readable_when_there_is_data_or_the_end(lowest: int) -> None:
    with pipe(lowest) as (reader, writer):
        assert wait_readable([reader], 0.0) == []
        assert wait_readable([reader], 0.0004) == []
        os.write(writer, b"x")
        assert wait_readable([reader], 10.0) == [reader]
        os.read(reader, 1)
        with pipe(lowest) as (other, end):
            os.write(end, b"x")
            assert wait_readable([reader, other], 10.0) == [other]


@each("lowest", [3, ABOVE])
def test_writable_until_the_pipe_is_full(lowest: int) -> None:
    with pipe(lowest) as (_, writer):
        assert wait_writable(writer, 10.0)
        os.set_blocking(writer, False)
        while wait_writable(writer, 0.0):
            os.write(writer, bytes(1 << 12))
        with pytest.raises(BlockingIOError):
            os.write(writer, bytes(1 << 16))


@each("descriptor", [1023, ABOVE])
def test_closed_descriptor_is_an_error(descriptor: int) -> None:
    with pytest.raises(OSError, match="Bad file descriptor"):
        wait_readable([descriptor], 0.0)
    with pytest.raises(OSError, match="Bad file descriptor"):
        wait_writable(descriptor, 0.0)
