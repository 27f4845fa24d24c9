"""Loopback with and without the MULTICAST flag, each in a network namespace of its own.

Unitree's SDK behaves differently in the two (docs/sources/unitree-dex.md#a6): with the flag its
process listens to multicast only. A dexkit node must meet it in both, whatever this machine's
``lo`` is like, and nothing of this machine is changed.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import tests.dds_helpers  # noqa: F401  (skips this module where CycloneDDS is missing)
from tests.optional import UNSHARE, namespaces

if find_spec("unitree_sdk2py") is None:
    pytest.skip("needs the unitree-sdk2 package", allow_module_level=True)


_SCRIPT = """
import fcntl, socket, struct
from dexkit.dds import DdsNode
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_, MotorState_, MotorStates_
from tests.unitree_sdk import SdkClient

with socket.socket() as s:
    ifr = fcntl.ioctl(s, 0x8913, struct.pack("16sh14x", b"lo", 0))  # SIOCGIFFLAGS
print("multicast", bool(struct.unpack_from("H", ifr, 16)[0] & 0x1000))
CMDS, STATES = ("unitree_go::msg::dds_::" + name for name in ("MotorCmds_", "MotorStates_"))
with SdkClient(1) as sdk, DdsNode(1, "lo") as node:
    reader, writer = node.reader("rt/cmd", CMDS), node.writer("rt/state", STATES)
    sdk.subscribe("rt/state", STATES)
    sdk.stream("rt/cmd", CMDS, MotorCmds_([MotorCmd_(q=1.5)]), hz=100)
    print("matched", reader.wait_matched(60), writer.wait_matched(60))
    reader.wait(10)
    print("command", reader.take()[-1].message.cmds[0].q)
    writer.write(MotorStates_([MotorState_(q=2.5)]))
    print("state", sdk.wait("rt/state")[-1].message.states[0].q)
"""


@pytest.mark.skipif(not namespaces(), reason="needs unshare, ip and user namespaces")
@pytest.mark.parametrize("flag", ["on", "off"])
def test_node_and_unitree_sdk_discover_each_other_on_loopback(flag: str) -> None:
    setup = f'ip link set lo up && ip link set lo multicast {flag} && exec "$0" -c "$1"'
    done = subprocess.run(
        [*UNSHARE, "sh", "-c", setup, sys.executable, _SCRIPT],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parent.parent,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n") == [
        f"multicast {flag == 'on'}",
        "matched True True",
        "command 1.5",
        "state 2.5",
        "",
    ]
