"""A child process that answers JSON lines: for libraries that cannot share a process with dexkit.

The child's side is :func:`answer_requests`: each line of its input is an object whose ``op`` names
a method and whose other members are its arguments; each answer is an object on one line.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

__all__ = ["ChildError", "JsonChild", "answer_requests"]

C = TypeVar("C", bound="JsonChild")


class ChildError(AssertionError):
    """The child says that something went wrong, or has gone."""


class JsonChild:
    """A running child.

    :param module: started with ``python -m``; it calls :func:`answer_requests`.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent.parent,
        )
        self._receive()  # its first line says that it is up

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def _receive(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        watchdog = threading.Timer(90, self._process.kill)  # never hang a test run
        watchdog.start()
        line = self._process.stdout.readline()
        watchdog.cancel()
        if not line:
            raise ChildError(f"the child has gone (exit code {self._process.wait(60)})")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise ChildError(answer["error"])
        return answer

    def call(self, op: str, **arguments: Any) -> dict[str, Any]:
        """Call a method over there; what it returns.

        :raises ChildError: it failed, or the child has gone.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"op": op, **arguments}) + "\n")
        self._process.stdin.flush()
        return self._receive()

    def close(self) -> None:
        """End the process. May be called twice."""
        if self._process.poll() is None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            try:
                self._process.wait(60)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def __enter__(self: C) -> C:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def answer_requests(make: Callable[[], object]) -> None:
    """The child's side: answer until the input ends.

    :param make: makes the object whose methods are called. What anything prints goes to stderr.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def answer(value: dict[str, Any]) -> None:
        answers.write(json.dumps(value) + "\n")
        answers.flush()

    try:
        server = make()
    except Exception as error:
        answer({"error": f"it does not start: {error}"})
        return
    answer({"ready": True})
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer(getattr(server, request.pop("op"))(**request))
        except Exception as error:
            answer({"error": f"{type(error).__name__}: {error}"})
    os._exit(0)  # an SDK's threads and listeners do not end by themselves
