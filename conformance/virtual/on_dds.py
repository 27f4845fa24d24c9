"""A service of the virtual clock on real DDS, to test the live suite on known hands."""

from __future__ import annotations

import threading
import time

from dexkit.clock import Rate
from dexkit.conformance.virtual.service import TopicDevice
from dexkit.dds import DdsNode, Qos, Reader, Writer
from dexkit.threads import Worker

__all__ = ["ServiceOnDds"]


class ServiceOnDds:
    """Runs a service in real time, in a thread; a context manager.

    It behaves as on the virtual clock, except for what only the virtual player can do:
    :attr:`~TopicDevice.serves_late_readers`. Each writer of commands counts as a client.
    """

    def __init__(self, service: TopicDevice, domain: int, interface: str = "lo") -> None:
        self.service = service
        self._node = DdsNode(domain=domain, interface=interface)
        self._stop = threading.Event()
        self._clients: dict[int, int] = {}
        self._readers: dict[str, Reader] = {}
        self._writers: dict[tuple[str, str], Writer] = {}
        durability = "volatile" if service.reader_durability == "Volatile" else "transient_local"
        for endpoint in service.endpoints():
            if endpoint.kind == "reader":
                self._readers[endpoint.topic] = self._node.reader(
                    endpoint.topic,
                    endpoint.type_name,
                    qos=Qos(endpoint.reliability, durability),
                    depth=16,
                )
        self._thread = Worker("virtual service", self._run)

    def __enter__(self) -> ServiceOnDds:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()
        self._node.close()

    def _run(self) -> None:
        tick = self.service.tick
        rate = Rate(1.0 / tick)
        last = time.monotonic()
        while not self._stop.is_set():
            for topic, reader in self._readers.items():
                for sample in reader.take():
                    client = self._clients.setdefault(sample.writer, len(self._clients))
                    self.service.receive(topic, sample.data, client)
            # late ticks are caught up, so that a busy machine does not slow the hand
            now = time.monotonic()
            while last + tick <= now:
                last += tick
                for state in self.service.advance(tick):
                    self._writer(state.topic, state.type_name).write_raw(state.payload)
            rate.wait()

    def _writer(self, topic: str, type_name: str) -> Writer:
        key = (topic, type_name)
        if key not in self._writers:
            qos = Qos(self.service.writer_reliability)
            self._writers[key] = self._node.writer(topic, type_name, qos=qos)
        return self._writers[key]
