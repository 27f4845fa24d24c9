"""The examples that move hands with Unitree's Python SDK, against the emulated hands."""

from __future__ import annotations

import subprocess
import sys
import threading
from importlib.util import find_spec
from pathlib import Path

import pytest

from dexkit.child_processes import Tool
from tests.dds_helpers import free_domain
from tests.patience import PATIENCE

if find_spec("unitree_sdk2py") is None:  # importing the bare package fails: tests.unitree_sdk
    pytest.skip("needs the unitree-sdk2 package", allow_module_level=True)

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples" / "unitree-sdk"
RUN = """
import runpy, sys
from tests.unitree_sdk import load
load()
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "backend", "goal"),
    [
        # the other test of the SDK with a Dex3-1 is in tests/test_service_dex3.py
        pytest.param("move_dex3.py", "sim-dex3", [-0.8] * 4, marks=pytest.mark.soak),
        ("move_dex1.py", "sim-dex1", [1.8]),
    ],
)
def test_example_of_the_sdk_moves_the_hand(example: str, backend: str, goal: list[float]) -> None:
    domain = str(free_domain())
    serve = Tool("serve", backend, "--side", "left", "--domain", domain)
    try:
        serve.wait_ready(threading.Event())
        done = subprocess.run(
            [sys.executable, "-c", RUN, str(EXAMPLES / example), "left", domain, "lo"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=4 * PATIENCE,  # a second interpreter, its imports, four seconds of motion
            check=False,
        )
    finally:
        serve.stop()
    assert done.returncode == 0, done.stderr
    found = [float(word) for word in done.stdout.split()]
    assert found[-len(goal) :] == pytest.approx(goal, abs=0.1)
