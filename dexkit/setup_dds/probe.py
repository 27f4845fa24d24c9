"""The child process that tries an installed or unpacked cyclonedds: it may crash, dexkit may not.

It prints one line of JSON, an :class:`~dexkit.setup_dds.facts.Installed`. The message is sent by
one process and answered by another, with the DDS configuration that dexkit always uses.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import select
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

from dexkit.child_processes import code_line
from dexkit.dds_library import loaded_here
from dexkit.setup_dds.facts import Installed

__all__ = ["command", "result_of"]

_ROOT = str(Path(__file__).resolve().parents[2])
_TYPE = "unitree_go::msg::dds_::MotorCmds_"
_TOPICS = ("rt/dexkit/setup/there", "rt/dexkit/setup/back")
_AGAIN = 0.2  # seconds until the message is sent again
_PATIENCE = 90.0  # seconds for each of discovery and answer: some 0.3 s, in an emulator 20 s


def command(python: str, folder: str = "", *, send: bool) -> list[str]:
    """The command line of the child.

    :param python: interpreter.
    :param folder: of an unpacked wheel, in front of what is installed.
    :param send: whether it also sends a message.
    """
    return _start(python, folder, f"main({send!r})")


def _start(python: str, folder: str, call: str) -> list[str]:
    code = f"from dexkit.setup_dds import probe; probe.{call}"
    front = [folder] if folder else []
    return code_line(code, python=python, front=front, back=[_ROOT])


def result_of(code: int, output: str) -> Installed:
    """Parse the child's result.

    :param code: its exit code; negative: of which signal it died.
    """
    for line in reversed(output.splitlines()):
        if line.startswith('{"version":'):
            found = json.loads(line)
            return Installed(**{**found, "libraries": tuple(found["libraries"])})
    if code < 0:
        return Installed("?", f"a process that imports it dies of signal {-code}")
    last = (output.strip().splitlines() or ["it printed nothing"])[-1]
    return Installed("?", f"the process that tries it ends with code {code}: {last}")


def main(send: bool) -> None:
    """Find out, and print it."""
    print(json.dumps(dataclasses.asdict(_probe(send))))


def _probe(send: bool) -> Installed:
    try:
        version = metadata.version("cyclonedds")
    except metadata.PackageNotFoundError:
        return Installed()
    if not version.startswith("0.10."):
        return Installed(version)  # not loaded: it might meet others
    try:
        importlib.import_module("cyclonedds.core")
    except Exception as error:  # the loader of the binding has classes of its own
        return Installed(version, " ".join(str(error).split()) or type(error).__name__)
    libraries = loaded_here()
    if len(libraries) > 1 or not send:
        return Installed(version, "", libraries)
    try:
        _send_and_receive()
    except Exception as error:
        return Installed(version, "", libraries, " ".join(str(error).split()))
    return Installed(version, "", loaded_here())


def _send_and_receive() -> None:
    from dexkit.dds import DdsNode
    from dexkit.domains import reserve_free_domain
    from dexkit.messages import message_type

    kind = message_type(_TYPE)
    data = kind.encode(kind.cls())
    with reserve_free_domain() as reserved:
        folder = next((p for p in sys.path[:1] if p and Path(p, "cyclonedds").is_dir()), "")
        answering = subprocess.Popen(
            _start(sys.executable, folder, f"answer({reserved.domain})"),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            with DdsNode(reserved.domain) as node:
                back = node.reader(_TOPICS[1], _TYPE)
                there = node.writer(_TOPICS[0], _TYPE)
                if not (there.wait_matched(_PATIENCE) and back.wait_matched(_PATIENCE)):
                    raise RuntimeError("another process on this machine is not discovered")
                end = time.monotonic() + _PATIENCE
                while not back.wait(_AGAIN):  # the answering writer may not know this reader yet
                    if time.monotonic() > end:
                        raise RuntimeError("a message does not come back from another process")
                    there.write_raw(data)
                if any(sample.data != data for sample in back.take()):
                    raise RuntimeError("a message comes back changed")
        except RuntimeError as error:
            answering.terminate()
            said = (answering.communicate()[1] or b"").decode(errors="replace").strip()
            raise RuntimeError(f"{error} {said.splitlines()[-1] if said else ''}") from error
        finally:
            answering.kill()
            answering.communicate()


def answer(domain: int) -> None:
    """The other process: send back what comes, until standard input ends."""
    from dexkit.dds import DdsNode

    with DdsNode(domain) as node:
        back = node.writer(_TOPICS[1], _TYPE)
        reader = node.reader(_TOPICS[0], _TYPE)
        while not select.select([sys.stdin], [], [], 0)[0]:
            reader.wait(_AGAIN)
            for sample in reader.take():
                back.write_raw(sample.data)
