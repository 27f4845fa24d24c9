"""Tests run in a fixed environment and list what this machine lacks."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.optional import OPTIONAL, Optional

HERE = Path(__file__).parent

CHILD = """
import json, locale, os, signal, subprocess, sys
from tests.surroundings import settle
clean = settle()
child = subprocess.run([sys.executable, "-c", '''
import json, os, signal
names = "HUP INT QUIT TERM USR1 CHLD".split()
print(json.dumps({
    "ignored": [n for n in names if signal.getsignal(getattr(signal, "SIG" + n)) is signal.SIG_IGN],
    "blocked": len(signal.pthread_sigmask(signal.SIG_BLOCK, ())),
    "environment": {n: os.environ.get(n) for n in ("TZ", "LC_ALL", "TERM", "COLUMNS", "NO_COLOR",
                    "FORCE_COLOR", "DEXKIT_DDS_LOG", "CYCLONEDDS_URI", "PYTEST_ADDOPTS")},
    "umask": os.umask(0), "home": os.access(os.environ["HOME"], os.W_OK),
    "stdin": os.fstat(0).st_rdev == os.stat(os.devnull).st_rdev,
}))
'''], stdout=subprocess.PIPE, check=True).stdout
with open(os.environ["HOME"] + "/text", "w") as file:  # as a test would write, without an encoding
    file.write("\\u011f")
encoded = open(os.environ["HOME"] + "/text", "rb").read()
os.kill(os.getpid(), signal.SIGHUP)  # the terminal goes; the run under nohup does not
home = os.environ["HOME"]
clean()
sys.stdout.write(json.dumps([json.loads(child), encoded.hex(), os.path.exists(home)]))
"""
SETTINGS = {
    "TZ": "Pacific/Kiritimati",
    "LC_ALL": "tr_TR.ISO-8859-9",
    "TERM": "dumb",
    "COLUMNS": "20",
    "NO_COLOR": "1",
    "FORCE_COLOR": "1",
    "DEXKIT_DDS_LOG": "/nonexistent/log",
    "CYCLONEDDS_URI": "nonsense",
    "PYTEST_ADDOPTS": "--collect-only",
    "HOME": "/nonexistent",
}


def test_inherited_environment_does_not_reach_a_test() -> None:
    python = f"exec {shlex.quote(sys.executable)} -c {shlex.quote(CHILD)} <&-"
    script = f"trap '' HUP INT QUIT TERM USR1 CHLD; umask 077; {python}"
    path = {"PATH": os.environ["PATH"], "PYTHONPATH": str(HERE.parent)}
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
    try:
        done = subprocess.run(
            ["sh", "-c", script], env=path | SETTINGS, capture_output=True, text=True, check=False
        )
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGUSR2])
    assert done.returncode == 0, done.stderr
    found, encoded, home_is_left = json.loads(done.stdout)
    nothing = dict.fromkeys(SETTINGS)
    del nothing["HOME"]
    assert found == {
        "ignored": [],
        "blocked": 0,
        "environment": nothing | {"TZ": "UTC", "LC_ALL": "C.UTF-8", "TERM": "xterm"},
        "umask": 0o022,
        "home": True,
        "stdin": True,
    }
    assert encoded == "ğ".encode().hex()
    assert not home_is_left


def test_every_file_that_may_skip_a_test_is_in_the_list() -> None:
    listed = {name for optional in OPTIONAL for name in optional.tests}
    skips = re.compile(r"pytest\.skip\(|mark\.skipif\(|pytest\.importorskip\(")
    for path in sorted(HERE.glob("test_*.py")):
        if path == Path(__file__) or not skips.search(path.read_text(encoding="utf-8")):
            continue
        name = path.stem.removeprefix("test_")
        if name != "teleop":  # its benchmark comes with every checkout
            assert name in listed, f"{path.name} skips tests: name it in tests/optional.py"


@pytest.mark.parametrize("optional", OPTIONAL, ids=lambda o: o.name)
def test_the_files_in_the_list_exist(optional: Optional) -> None:
    for name in optional.tests:
        assert " " in name or (HERE / f"test_{name}.py").is_file(), name
