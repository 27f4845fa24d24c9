"""A genuine client: commands a gripper until it is where it was told to go, and prints q.

python -m tests.lan_client --domain 104 --interface lo --q 2.0
"""

from __future__ import annotations

import argparse
import sys
import time

from dexkit.dds import DdsNode
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--interface", default="lo")
    parser.add_argument("--q", type=float, required=True)
    parser.add_argument("--seconds", type=float, default=20.0, help="patience")
    options = parser.parse_args()
    command = MotorCmds_([MotorCmd_(mode=1, q=options.q, kp=5.0, kd=0.05)])
    with DdsNode(options.domain, options.interface) as node:
        states = node.reader("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
        commands = node.writer("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
        end = time.monotonic() + options.seconds
        q = float("nan")
        while time.monotonic() < end:
            commands.write(command)
            states.wait(0.02)
            for sample in states.take():
                q = sample.message.states[0].q
            if abs(q - options.q) < 0.05:
                print(f"there: {q:.2f}", flush=True)
                return
    sys.exit(f"not there: q = {q:.2f}")


if __name__ == "__main__":
    main()
