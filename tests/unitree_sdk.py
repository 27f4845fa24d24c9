"""Unitree's own Python SDK as a client, in a process of its own.

``unitree-sdk2`` on the package index is the official code (module ``unitree_sdk2py``), but the
wheel does not import as it is: its ``__init__`` imports a sub-package ``b2`` that the wheel
lacks. :func:`load` puts an empty module in its place. Nothing else of the SDK is replaced; the
only other change is that CycloneDDS's trace goes to ``/dev/null`` instead of the fixed file
``/tmp/cdds.LOG``, which a second user of one machine cannot write. The SDK's CRC library is
missing, too, but hand messages carry no CRC.

In tests::

    with SdkClient(domain) as sdk:                      # interface lo
        sdk.subscribe("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
        sdk.stream("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_",
                   MotorCmds_([MotorCmd_(q=1.0, kp=5.0, kd=0.05)]), hz=200)
        state = sdk.wait("rt/dex1/left/state")[-1]
        state.message.states[0].q, state.data           # our class; the SDK's bytes

The client process speaks JSON lines on stdin and stdout and can be used by hand:
``python -m tests.unitree_sdk --domain 1``, then for example
``{"op": "subscribe", "topic": "rt/x", "type": "unitree_go::msg::dds_::MotorStates_"}``.
Messages travel as the hex of their serialisation; the SDK's own classes do it in the child.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import threading
import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from dexkit.messages import message_type
from tests.inspire_sdk import inspire_class
from tests.json_child import JsonChild, answer_requests

__all__ = ["SdkClient", "SdkSample", "load", "sdk_class"]


def load() -> Any:
    """The SDK's ``core.channel`` module (``ChannelFactoryInitialize``, ``ChannelPublisher``...)."""
    sys.modules.setdefault("unitree_sdk2py.b2", ModuleType("unitree_sdk2py.b2"))
    channel: Any = importlib.import_module("unitree_sdk2py.core.channel")
    channel.ChannelConfigHasInterface = channel.ChannelConfigHasInterface.replace(
        "/tmp/cdds.LOG", os.devnull
    )
    return channel


def sdk_class(type_name: str) -> Any:
    """The SDK's class for a DDS type name, or that of Inspire's package; it starts no DDS."""
    load()
    package, *_, name = type_name.split("::")
    if package == "inspire":
        return inspire_class(name)
    return getattr(importlib.import_module(f"unitree_sdk2py.idl.{package}.msg.dds_"), name)


@dataclass(frozen=True)
class SdkSample:
    """A sample that the SDK received: its bytes as the SDK serialises them again."""

    data: bytes
    message: Any


class SdkClient(JsonChild):
    """A process that runs the SDK on ``domain`` and ``interface``."""

    def __init__(self, domain: int, interface: str = "lo") -> None:
        self._types: dict[str, str] = {}
        super().__init__("tests.unitree_sdk", "--domain", str(domain), "--interface", interface)

    def subscribe(self, topic: str, type_name: str) -> None:
        """Receive a topic with the SDK's ``ChannelSubscriber`` and a handler."""
        self._types[topic] = type_name
        self.call("subscribe", topic=topic, type=type_name)

    def publish(self, topic: str, type_name: str, message: Any) -> None:
        """Write one message with the SDK's ``ChannelPublisher``."""
        data = message_type(type_name).encode(message).hex()
        self.call("publish", topic=topic, type=type_name, data=data)

    def stream(self, topic: str, type_name: str, message: Any, hz: float) -> None:
        """Write a message over and over until :meth:`stop` or the next call for this topic."""
        data = message_type(type_name).encode(message).hex()
        self.call("stream", topic=topic, type=type_name, data=data, hz=hz)

    def stop(self, topic: str) -> int:
        """End a stream; returns how many messages it has written."""
        return int(self.call("stop", topic=topic)["written"])

    def request(self, service: str, api: int, parameter: str) -> tuple[int, str | None]:
        """Ask a service with the SDK's RPC client; returns its error code and data."""
        answer = self.call("request", service=service, api=api, parameter=parameter)
        return answer["code"], answer["data"]

    def wait(self, topic: str, count: int = 1, timeout: float = 60.0) -> list[SdkSample]:
        """Samples received since the last call, at least ``count`` of them.

        :raises ChildError: fewer arrived within ``timeout`` seconds.
        """
        answer = self.call("wait", topic=topic, count=count, timeout=timeout)
        kind = message_type(self._types[topic])
        samples = [bytes.fromhex(text) for text in answer["samples"]]
        return [SdkSample(data, kind.decode(data)) for data in samples]


class _Server:
    """The client process's side."""

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self._publishers: dict[str, Any] = {}
        self._received: dict[str, list[Any]] = {}
        self._arrived = threading.Condition()
        self._clients: dict[str, Any] = {}
        self._streams: dict[str, tuple[threading.Event, threading.Thread, list[int]]] = {}

    def subscribe(self, topic: str, type: str) -> dict[str, Any]:
        def handle(sample: Any) -> None:
            with self._arrived:
                self._received[topic].append(sample)
                self._arrived.notify_all()

        self._received[topic] = []
        subscriber = self._channel.ChannelSubscriber(topic, sdk_class(type))
        subscriber.Init(handle, 10)
        self._publishers[f"subscriber {topic}"] = subscriber  # keeps it alive
        return {}

    def _publisher(self, topic: str, type: str) -> Any:
        if topic not in self._publishers:
            publisher = self._channel.ChannelPublisher(topic, sdk_class(type))
            publisher.Init()
            self._publishers[topic] = publisher
        return self._publishers[topic]

    def publish(self, topic: str, type: str, data: str) -> dict[str, Any]:
        message = sdk_class(type).deserialize(bytes.fromhex(data))
        # a timeout makes the SDK wait until somebody listens
        if not self._publisher(topic, type).Write(message, 10.0):
            return {"error": f"nobody listens to {topic}"}
        return {}

    def stream(self, topic: str, type: str, data: str, hz: float) -> dict[str, Any]:
        self.stop(topic)
        message = sdk_class(type).deserialize(bytes.fromhex(data))
        publisher = self._publisher(topic, type)
        stop, written = threading.Event(), [0]

        def run() -> None:
            due = time.monotonic()
            while not stop.wait(max(0.0, due - time.monotonic())):
                publisher.Write(message)
                written[0] += 1
                due += 1.0 / hz

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self._streams[topic] = (stop, thread, written)
        return {}

    def stop(self, topic: str) -> dict[str, Any]:
        if topic not in self._streams:
            return {"written": 0}
        stop, thread, written = self._streams.pop(topic)
        stop.set()
        thread.join()
        return {"written": written[0]}

    def request(self, service: str, api: int, parameter: str) -> dict[str, Any]:
        from unitree_sdk2py.rpc.client import Client

        if service not in self._clients:
            self._clients[service] = Client(service)
            self._clients[service].SetTimeout(60.0)
        client = self._clients[service]
        client._RegistApi(api, 0)  # as the clients of the services do
        code, data = client._Call(api, parameter)
        return {"code": code, "data": data}

    def wait(self, topic: str, count: int, timeout: float) -> dict[str, Any]:
        with self._arrived:
            self._arrived.wait_for(lambda: len(self._received[topic]) >= count, timeout)
            samples, self._received[topic] = self._received[topic], []
        if len(samples) < count:
            return {"error": f"{len(samples)} samples on {topic} within {timeout} s"}
        return {"samples": [s.serialize().hex() for s in samples]}


def main() -> None:
    """The client process: JSON lines on stdin and stdout."""
    parser = argparse.ArgumentParser(prog="python -m tests.unitree_sdk")
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--interface", default="lo")
    options = parser.parse_args()

    def make() -> _Server:
        channel = load()
        channel.ChannelFactoryInitialize(options.domain, options.interface)
        return _Server(channel)

    answer_requests(make)


if __name__ == "__main__":
    main()
