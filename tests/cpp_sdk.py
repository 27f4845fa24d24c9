"""Unitree's own C++ SDK as a client, in a process of its own.

``far-unitree-sdk`` on the package index is the vendor's C++ SDK with a thin Python binding (module
``unitree_interface``). It brings its own CycloneDDS, which must not meet ours in one process, and
its domain is always 0; its ``dds_config`` takes CycloneDDS's XML, though, and there
``ExternalDomainId`` decides which domain that is on the network. With it the SDK is on a test's
own domain and on loopback, and nothing of the machine's network settings is touched.

In tests::

    with CppSdk("h1", domain) as sdk:
        state = sdk.wait(lambda s: any(s["q"]))      # a LowState, as the SDK passes it on
        sdk.command(q=[...], kp=[...], kd=[...])     # repeated at 500 Hz until the next one
        sdk.remote()["lx"]

What the SDK prints goes to stderr.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from tests.json_child import JsonChild, answer_requests

__all__ = ["CppSdk", "dds_config"]


def dds_config(domain: int, interface: str = "lo") -> str:
    """CycloneDDS's configuration for the SDK: a domain of choice on an interface of choice.

    On loopback it calls others by port, as dexkit does, so that multicast need not be on there.
    """
    return (
        '<CycloneDDS><Domain Id="any"><General><Interfaces>'
        f'<NetworkInterface name="{interface}" priority="default" multicast="default"/>'
        f"</Interfaces></General><Discovery><ExternalDomainId>{domain}</ExternalDomainId>"
        "<ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
        '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
        f"<Tracing><OutputFile>{os.devnull}</OutputFile></Tracing></Domain></CycloneDDS>"
    )


class CppSdk(JsonChild):
    """A process in which the SDK is the client of a robot.

    :param robot: ``"h1"`` or ``"g1"``.
    """

    def __init__(self, robot: str, domain: int) -> None:
        super().__init__("tests.cpp_sdk", robot, str(domain))

    def state(self) -> dict[str, Any]:
        """The newest state that the SDK has accepted; all zero before the first."""
        return self.call("state")

    def remote(self) -> dict[str, Any]:
        """The newest message of the wireless remote."""
        return self.call("remote")

    def wait(
        self,
        condition: Callable[[dict[str, Any]], object],
        read: Callable[[], dict[str, Any]] | None = None,
        timeout: float = 60.0,
    ) -> dict[str, Any]:
        """The first state (or what ``read`` gives) that ``condition`` accepts."""
        read = read or self.state
        deadline = time.monotonic() + timeout
        while True:
            value = read()
            if condition(value):
                return value
            assert time.monotonic() < deadline, f"not within {timeout} s: {value}"
            time.sleep(0.005)  # the SDK has no event for it

    def command(self, **members: Sequence[float]) -> None:
        """Command all motors: ``q``, ``dq``, ``tau``, ``kp``, ``kd``; the SDK repeats it.

        The gains are the SDK's own unless given.
        """
        self.call("command", **members)


class _Server:
    """The process's side."""

    def __init__(self, robot: str, domain: int) -> None:
        import unitree_interface as sdk

        create = getattr(sdk.UnitreeInterface, f"create_{robot}")
        self._robot = create("lo", dds_config=dds_config(domain))

    def state(self) -> dict[str, Any]:
        state = self._robot.read_low_state()
        motor, imu = state.motor, state.imu
        return {
            **{name: list(getattr(motor, name)) for name in ("q", "dq", "tau_est")},
            "temperature": list(motor.temperature),
            "voltage": list(motor.voltage),
            **{name: list(getattr(imu, name)) for name in ("quat", "omega", "accel", "rpy")},
            "mode_machine": state.mode_machine,
        }

    def remote(self) -> dict[str, Any]:
        remote = self._robot.read_wireless_controller()
        # not the members that the wheel's type stub has
        return {name: getattr(remote, name) for name in ("lx", "ly", "rx", "ry", "keys")}

    def command(self, **members: list[float]) -> dict[str, Any]:
        names = {"q": "q_target", "dq": "dq_target", "tau": "tau_ff"}
        command = self._robot.create_zero_command()
        for name, values in members.items():
            setattr(command, names.get(name, name), values)
        self._robot.write_low_command(command)
        return {}


def main() -> None:
    """The client process: JSON lines on stdin and stdout."""
    parser = argparse.ArgumentParser(prog="python -m tests.cpp_sdk")
    parser.add_argument("robot", choices=["h1", "g1"])
    parser.add_argument("domain", type=int)
    options = parser.parse_args()
    answer_requests(lambda: _Server(options.robot, options.domain))


if __name__ == "__main__":
    main()
