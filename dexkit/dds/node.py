"""A participant with its readers, writers and discovery."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import logging
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from dexkit.dds.announcements import endpoint_of, participant_of, taken, uuid_of
from dexkit.dds.cyclone import (
    INFINITY,
    OK,
    EndpointData,
    LostStatus,
    MatchedStatus,
    ParticipantData,
    RejectedStatus,
    cyclone_type,
    library,
    types_lock,
)
from dexkit.dds.domain import FILES, acquire_domain, domains, domains_lock, release_domain
from dexkit.dds.records import DiscoveryEvent, Endpoint, Participant, Qos, Sample
from dexkit.errors import DdsError, DdsSetupError, EncodeError, UsageError
from dexkit.interface_names import find_interface
from dexkit.messages import MessageType, message_type
from dexkit.open_file_limit import require_open_files
from dexkit.threads import Worker

__all__ = ["DdsNode", "Discovery", "Reader", "Writer"]

_log = logging.getLogger("dexkit.dds")

_TIMEOUT = -10
_LOOK_EVERY_NS = 500_000_000  # whether the interface is still the one that is let in
_TAKE_CHUNK = 64
_EXIT_PATIENCE = 3.0  # seconds for closing at the end of the process; it takes some 20 ms
_BUILTIN = b"org::eclipse::cyclonedds::builtin::"  # types of a node's own discovery readers


class _Handle:
    """Base of readers and writers: the entity, matching, closing."""

    def __init__(self, node: DdsNode, topic: str, kind: MessageType, qos: Qos) -> None:
        self.node = node
        self.topic = topic
        self.type = kind
        self.qos = qos
        self.user_data = b""
        self._entity: Any = None
        self._ref = 0
        self._token = 0

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.topic} {self.type.name}>"

    @property
    def closed(self) -> bool:
        """Whether it has been closed."""
        return self._entity is None

    def _check_open(self) -> None:
        if self._entity is None:
            raise DdsError(f"{self!r} is closed")

    def _matched_status(self) -> Any:
        raise AssertionError  # overridden

    @property
    def matched(self) -> int:
        """Number of matching endpoints on the other side; 0 when closed."""
        if self._entity is None:
            return 0
        status = MatchedStatus()
        if self._matched_status()(self._ref, ctypes.byref(status)) != OK:
            return 0
        return int(status.current_count)

    def wait_matched(self, timeout: float | None = None, count: int = 1) -> bool:
        """Wait until at least ``count`` endpoints match.

        :param timeout: seconds; None waits without limit.
        :returns: False on time-out, or when it is closed or the dispatcher dies meanwhile.
        """
        with self.node._changed:
            self.node._changed.wait_for(
                lambda: self.closed or self.node.failure or self.matched >= count,
                timeout=timeout,
            )
        return self.matched >= count

    def _on_status(self) -> None:
        raise AssertionError  # overridden

    def close(self) -> None:
        """Delete the endpoint; no callback runs after this. May be called twice."""
        self.node._drop(self)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class Writer(_Handle):
    """Writes samples of one type to one topic. Made by :meth:`DdsNode.writer`.

    :ivar timeouts: writes given up after 100 ms because a reliable reader did not keep up.
    """

    def __init__(
        self, node: DdsNode, topic: str, kind: MessageType, qos: Qos, user_data: bytes = b""
    ) -> None:
        super().__init__(node, topic, kind, qos)
        self.user_data = user_data
        self.timeouts = 0
        self._write = library().layer.ddspy_write
        self._write_ts = library().layer.ddspy_write_ts
        self._registered = False

    def _matched_status(self) -> Any:
        return library().dds_get_publication_matched_status

    def _on_status(self) -> None:
        cyclone = library()
        if cyclone.take_status(self._ref, cyclone.publication_matched):
            self.node._notify()

    def write(self, message: Any, source_timestamp_ns: int | None = None) -> bool:
        """Encode and write a message; see :meth:`write_raw`.

        :raises EncodeError: the message does not fit its type.
        """
        return self.write_raw(self.type.encode(message), source_timestamp_ns)

    def write_raw(self, data: bytes, source_timestamp_ns: int | None = None) -> bool:
        """Write ``data`` (encapsulation header included) as it is.

        :param source_timestamp_ns: wall clock, ns since the epoch; None means now.
        :returns: False when it was given up after 100 ms because a reliable reader does not
            keep up (:attr:`timeouts` counts them).
        :raises EncodeError: no space for a header.
        :raises DdsError: the writer is closed, or CycloneDDS refuses.
        """
        if self._entity is None:
            raise DdsError(f"{self!r} is closed")
        if len(data) % 4 or len(data) < 4:
            if len(data) < 4:
                raise EncodeError(f"{len(data)} bytes are too short for a sample")
            data = data + bytes(-len(data) % 4)  # the wire unit is 4 bytes
        if not self._registered:
            # Our types have no key, so a topic has one instance. Unless it is registered,
            # CycloneDDS makes and frees it with each sample that needs no acknowledgement, and
            # at 2000 samples a second its collector takes 5 % of a processor.
            self._registered = True
            library().layer.ddspy_register_instance(self._ref, data)
        if source_timestamp_ns is None:
            code = self._write(self._ref, data)
        else:
            code = self._write_ts(self._ref, data, source_timestamp_ns)
        if code == OK:
            return True
        if code == _TIMEOUT:
            self.timeouts += 1
            return False
        raise DdsError(f"writing to {self.topic} failed: {library().error(code)}")


class Reader(_Handle):
    """Reads samples of one type from one topic. Made by :meth:`DdsNode.reader`.

    :ivar polled: samples wake no thread; they are found by :meth:`take` only.
    """

    def __init__(
        self,
        node: DdsNode,
        topic: str,
        kind: MessageType,
        qos: Qos,
        on_data: Callable[[], object] | None,
        polled: bool,
    ) -> None:
        super().__init__(node, topic, kind, qos)
        self.polled = polled
        self._refused = 0
        self._lost = 0
        self._on_data = on_data
        self._arrived = threading.Event()
        self._take = library().layer.ddspy_take

    def _matched_status(self) -> Any:
        return library().dds_get_subscription_matched_status

    @property
    def refused(self) -> int:
        """Samples that arrived and were dropped because ``most`` were kept already."""
        status = RejectedStatus()
        if self._entity is not None and (
            library().dds_get_sample_rejected_status(self._ref, ctypes.byref(status)) == OK
        ):
            self._refused = int(status.total_count)
        return self._refused

    @property
    def lost(self) -> int:
        """Samples that DDS says were lost on their way: in 0.10 those too old for the reader."""
        status = LostStatus()
        if self._entity is not None and (
            library().dds_get_sample_lost_status(self._ref, ctypes.byref(status)) == OK
        ):
            self._lost = int(status.total_count)
        return self._lost

    def _on_status(self) -> None:
        cyclone = library()
        bits = cyclone.take_status(self._ref, cyclone.data_available | cyclone.subscription_matched)
        if bits & cyclone.data_available:
            self._arrived.set()
            if self._on_data is not None:
                self._on_data()
        if bits & cyclone.subscription_matched:
            self.node._notify()

    def take(self) -> list[Sample]:
        """Everything that has arrived since the last call, oldest first; never blocks.

        Of each writer's samples at most ``qos.depth`` are kept, the newest ones.

        :raises DdsError: the reader is closed.
        """
        self._check_open()
        self._arrived.clear()
        out: list[Sample] = []
        while True:
            got = self._take(self._ref, _TAKE_CHUNK)
            if isinstance(got, int):
                raise DdsError(f"reading {self.topic} failed: {library().error(got)}")
            now = time.time_ns()
            out += [
                Sample(data, info.source_timestamp, now, info.publication_handle, self.type)
                for data, info in got
                if info.valid_data
            ]
            if len(got) < _TAKE_CHUNK:
                return out

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until something has arrived since the last :meth:`take`.

        :param timeout: seconds; None waits without limit.
        :returns: False on time-out, or when the reader is closed meanwhile. After True
            :meth:`take` may, rarely, still return nothing: a writer that goes away wakes, too.
        :raises UsageError: the reader is polled.
        """
        self._check_open()
        if self.polled:
            raise UsageError(f"{self!r} is polled: its samples wake nobody")
        return self._arrived.wait(timeout) and not self.closed


class Discovery:
    """The endpoints and participants of a domain. Belongs to a node: :attr:`DdsNode.discovery`.

    :ivar unreadable: announcements left out because they could not be read.
    """

    def __init__(self, node: DdsNode) -> None:
        self.unreadable = 0
        self._node = node
        self._lock = threading.Lock()
        self._endpoints: dict[str, Endpoint] = {}
        self._participants: dict[str, Participant] = {}
        self._callbacks: list[Callable[[DiscoveryEvent], object]] = []

    def endpoints(self) -> list[Endpoint]:
        """Every endpoint known now, this node's own included, sorted by topic and kind."""
        with self._lock:
            found = list(self._endpoints.values())
        return sorted(found, key=lambda e: (e.topic, e.kind, e.type_name, e.key))

    def participants(self) -> list[Participant]:
        """Every participant known now."""
        with self._lock:
            return list(self._participants.values())

    def wait(
        self, predicate: Callable[[list[Endpoint]], object], timeout: float | None = None
    ) -> bool:
        """Wait until ``predicate`` of all endpoints is true; it is tried at every change.

        :param timeout: seconds; None waits without limit.
        :returns: whether it became true.
        """
        node = self._node
        with node._changed:
            return bool(
                node._changed.wait_for(
                    lambda: node.closed or node.failure or predicate(self.endpoints()),
                    timeout=timeout,
                )
                and not node.closed
                and not node.failure
            )

    def subscribe(self, callback: Callable[[DiscoveryEvent], object]) -> Callable[[], None]:
        """Call ``callback`` for every endpoint known now and every later change.

        It runs in the dispatcher thread and must only note the event.

        :returns: a function that ends the subscription.
        """
        with self._node._dispatching:
            for endpoint in self.endpoints():
                callback(DiscoveryEvent(True, endpoint))
            self._callbacks.append(callback)

        def unsubscribe() -> None:
            with self._node._dispatching, contextlib.suppress(ValueError):
                self._callbacks.remove(callback)

        return unsubscribe

    def _put_participant(self, participant: Participant) -> None:
        with self._lock:
            self._participants[participant.key] = participant

    def _remove_participant(self, key: str) -> None:
        with self._lock:
            self._participants.pop(key, None)

    def _participant(self, key: str) -> Participant | None:
        with self._lock:
            return self._participants.get(key)

    def _put(self, endpoint: Endpoint) -> None:
        with self._lock:
            known = endpoint.key in self._endpoints
            self._endpoints[endpoint.key] = endpoint
        if not known:
            self._notify_listeners(DiscoveryEvent(True, endpoint))

    def _remove(self, key: str) -> None:
        with self._lock:
            endpoint = self._endpoints.pop(key, None)
        if endpoint is not None:
            self._notify_listeners(DiscoveryEvent(False, endpoint))

    def _notify_listeners(self, event: DiscoveryEvent) -> None:
        for callback in list(self._callbacks):
            try:
                callback(event)
            except Exception:
                _log.exception("a discovery callback failed")


_nodes: weakref.WeakSet[DdsNode] = weakref.WeakSet()


class DdsNode:
    """A participant on one domain and interface, with its readers, writers and discovery.

    :param domain: 0 is the robot, 1 what xr_teleoperate's simulation mode uses.
    :param interface: network interface by name, address or prefix
        (:mod:`dexkit.interface_names`); loopback keeps traffic on this machine.
    :raises DdsUnavailable: CycloneDDS 0.10.x is not installed for this interpreter.
    :raises DdsSetupError: no such interface, or the domain cannot be set up.

    Several nodes may share a domain (and then an interface) in one process. Use it as a context
    manager or call :meth:`close`. If other code of this process has configured the domain (an
    SDK that was initialised first), its configuration is used and that is logged.
    """

    def __init__(self, domain: int = 1, interface: str = "lo") -> None:
        if not 0 <= domain <= 230:
            raise UsageError(f"a DDS domain is 0 to 230, not {domain}")
        require_open_files(FILES, "DDS")
        cyclone = library()
        self.domain = domain
        self.interface = interface = find_interface(interface)
        self.discovery = Discovery(self)
        self._closed = False
        # Held while callbacks run and while endpoints come and go, so that closing waits for
        # callbacks; re-entrant, so that a callback may close its own reader.
        self._dispatching = threading.RLock()
        self._changed = threading.Condition()
        self._handles: dict[int, _Handle] = {}
        self._topics: dict[tuple[str, str], Any] = {}
        self._next_token = 1
        with domains_lock:
            acquire_domain(domain, interface)
            self._sockets = domains[domain].sockets
            try:
                self._participant = cyclone.domain.DomainParticipant(domain)
                self._waitset = cyclone.dds_create_waitset(self._participant._ref)
            except cyclone.error as error:
                release_domain(domain)
                raise DdsSetupError(f"no participant on domain {domain}: {error}") from error
        self._key = str(self._participant.guid)
        self._builtin = [
            cyclone.builtin.BuiltinDataReader(self._participant, topic)
            for topic in (
                cyclone.builtin.BuiltinTopicDcpsParticipant,
                cyclone.builtin.BuiltinTopicDcpsPublication,
                cyclone.builtin.BuiltinTopicDcpsSubscription,
            )
        ]
        for reader in self._builtin:
            cyclone.dds_set_status_mask(reader._ref, cyclone.data_available)
            cyclone.dds_waitset_attach(self._waitset, reader._ref, 0)
        # its own trigger wakes a waitset only if it is attached to itself
        cyclone.dds_waitset_attach(self._waitset, self._waitset, 0)
        self._thread = Worker("DDS dispatcher", self._dispatch, failed=lambda error: self._notify())
        self._thread.start()
        _exit_thread()
        _nodes.add(self)

    def __repr__(self) -> str:
        return f"<DdsNode domain {self.domain} on {self.interface}>"

    def __enter__(self) -> DdsNode:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` has been called."""
        return self._closed

    @property
    def failure(self) -> Exception | None:
        """The error that ended the dispatcher thread, which discovers and receives; or None."""
        return self._thread.failure

    def writer(
        self,
        topic: str,
        type_name: str | MessageType,
        *,
        qos: Qos | None = None,
        user_data: bytes = b"",
    ) -> Writer:
        """A writer on ``topic``.

        :param topic: DDS name, ``rt/`` included.
        :param type_name: a name that :func:`dexkit.messages.message_type` takes, or its result.
        :param qos: default :meth:`Qos.writer_default`.
        :param user_data: is announced to other participants (:attr:`Endpoint.user_data`).
        :raises DdsSetupError: the endpoint cannot be made.
        """
        kind = type_name if isinstance(type_name, MessageType) else message_type(type_name)
        writer = Writer(self, topic, kind, qos or Qos.writer_default(), user_data)
        self._add(writer, library().pub.DataWriter, library().publication_matched)
        return writer

    def reader(
        self,
        topic: str,
        type_name: str | MessageType,
        *,
        qos: Qos | None = None,
        depth: int | None = None,
        most: int | None = None,
        on_data: Callable[[], object] | None = None,
        polled: bool = False,
    ) -> Reader:
        """A reader on ``topic``.

        :param qos: default :meth:`Qos.reader_default`.
        :param depth: overrides the depth of ``qos``.
        :param most: keep every sample until it is taken, up to so many; later ones are dropped
            and counted (:attr:`Reader.refused`). Without it the oldest is dropped, and
            is not counted.
        :param on_data: called without arguments, in the dispatcher thread, when something has
            arrived. It must return at once: set an event, put into a queue.
        :param polled: samples wake no thread, so that thousands a second cost only what their
            taking does. Neither ``on_data`` nor :meth:`Reader.wait` can be used.
        :raises UsageError: ``on_data`` for a polled reader.
        :raises DdsSetupError: the endpoint cannot be made.
        """
        kind = type_name if isinstance(type_name, MessageType) else message_type(type_name)
        chosen = qos or Qos.reader_default()
        if depth is not None or most is not None:
            chosen = Qos(chosen.reliability, chosen.durability, depth if most is None else None)
        if polled and on_data is not None:
            raise UsageError(f"a polled reader of {topic} calls nothing when data arrives")
        cyclone = library()
        reader = Reader(self, topic, kind, chosen, on_data, polled)
        mask = cyclone.subscription_matched | (0 if polled else cyclone.data_available)
        self._add(reader, cyclone.sub.DataReader, mask, most)
        return reader

    def endpoints(self) -> list[Endpoint]:
        """Every endpoint on the domain that is known now; see :class:`Discovery`."""
        return self.discovery.endpoints()

    def close(self) -> None:
        """Delete everything of this node. No callback runs after this. May be called twice."""
        with self._dispatching:
            if self._closed:
                return
            self._closed = True
            handles = list(self._handles.values())
            self._handles.clear()
        cyclone = library()
        cyclone.dds_waitset_set_trigger(self._waitset, True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        children = [h._entity for h in handles]
        for handle in handles:
            self._mark_closed(handle)
        for reader in self._builtin:
            children += [reader, reader._next_condition]
        children += self._topics.values()
        for entity in children:
            cyclone.forget(entity)  # they go with the participant
        with domains_lock:
            cyclone.delete(self._participant)
            release_domain(self.domain)
        self._topics.clear()
        _nodes.discard(self)
        self._notify()

    def _topic(self, name: str, kind: MessageType) -> Any:
        key = (name, kind.name)
        if key not in self._topics:
            with types_lock:
                self._topics[key] = library().topic.Topic(
                    self._participant, name, cyclone_type(kind.name)
                )
        return self._topics[key]

    def _add(self, handle: _Handle, factory: Any, mask: int, most: int | None = None) -> None:
        cyclone = library()
        with self._dispatching:
            if self._closed:
                raise DdsError(f"{self!r} is closed")
            try:
                topic = self._topic(handle.topic, handle.type)
                handle._entity = factory(
                    self._participant, topic, qos=_policies(handle.qos, handle.user_data, most)
                )
            except (cyclone.error, UnicodeError) as error:
                raise DdsSetupError(
                    f"cannot make a {type(handle).__name__.lower()} on {handle.topic!r}: {error}"
                ) from error
            handle._ref = handle._entity._ref
            handle._token = self._next_token
            self._next_token += 1
            self._handles[handle._token] = handle
            cyclone.dds_set_status_mask(handle._ref, mask)
            cyclone.dds_waitset_attach(self._waitset, handle._ref, handle._token)

    def _drop(self, handle: _Handle) -> None:
        with self._dispatching:  # waits for a callback that runs now
            if self._closed or handle.closed:
                return
            cyclone = library()
            del self._handles[handle._token]
            cyclone.dds_waitset_detach(self._waitset, handle._ref)
            entity = handle._entity
            self._mark_closed(handle)
            cyclone.delete(entity)
        self._notify()

    @staticmethod
    def _mark_closed(handle: _Handle) -> None:
        handle._entity = None
        if isinstance(handle, Reader):
            handle._arrived.set()  # frees a thread in wait()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _alive(self) -> bool:
        return not self._closed

    def _dispatch(self) -> None:
        cyclone = library()
        most = 64
        tokens = (ctypes.c_ssize_t * most)()
        sockets = self._sockets if self._sockets and not self._sockets.fixed else None
        patience = _LOOK_EVERY_NS if sockets else INFINITY
        look_at = time.monotonic()
        while True:
            count = cyclone.dds_waitset_wait(self._waitset, tokens, most, patience)
            if not self._alive():
                return
            if count < 0:
                raise DdsError(f"waiting for samples failed: {cyclone.error(count)}")
            if sockets and time.monotonic() >= look_at:
                look_at = time.monotonic() + _LOOK_EVERY_NS * 1e-9
                sockets.follow()
            # more than `most` triggered entities trigger again at once
            for token in sorted(set(tokens[: min(count, most)])):
                with self._dispatching:
                    if not self._alive():
                        return  # a callback has closed the node
                    try:
                        if token == 0:
                            self._read_builtin()
                        elif token in self._handles:
                            self._handles[token]._on_status()
                    except Exception:
                        _log.exception("a DDS callback failed")

    def _read_builtin(self) -> None:
        """Bring discovery up to date from CycloneDDS's built-in topics."""
        cyclone = library()
        participants, *endpoints = self._builtin
        changed = False
        for reader in self._builtin:
            cyclone.take_status(reader._ref, cyclone.data_available)
        # participants first, so that endpoints know their process
        for data, alive in taken(participants._ref, ParticipantData):
            changed = True
            with self._whatever_it_says():
                self._read_participant(data, alive)
        for kind, reader in zip(("writer", "reader"), endpoints, strict=True):
            for data, alive in taken(reader._ref, EndpointData):
                changed = True
                with self._whatever_it_says():
                    self._read_endpoint(data, alive, kind)
        if changed:
            self._notify()

    def _read_participant(self, data: Any, alive: bool) -> None:
        key = uuid_of(data.key)
        if not alive:
            self.discovery._remove_participant(key)
        elif data.qos:
            self.discovery._put_participant(participant_of(data, own=key == self._key))

    def _read_endpoint(self, data: Any, alive: bool, kind: str) -> None:
        key = uuid_of(data.key)
        if not alive:
            self.discovery._remove(key)
        elif data.qos and not (data.type_name or b"").startswith(_BUILTIN):
            owner = self.discovery._participant(uuid_of(data.participant_key))
            self.discovery._put(endpoint_of(data, kind, owner, self._key))

    @contextlib.contextmanager
    def _whatever_it_says(self) -> Iterator[None]:
        """Skip an announcement that cannot be decoded, and keep those received with it."""
        try:
            yield
        except Exception:
            self.discovery.unreadable += 1
            if self.discovery.unreadable == 1:
                _log.exception("an announcement of a peer cannot be read (logged once)")


def _policies(qos: Qos, user_data: bytes = b"", most: int | None = None) -> Any:
    policy = library().qos.Policy
    reliability = (
        # 100 ms (docs/sources/unitree-dex.md#a5)
        policy.Reliability.Reliable(max_blocking_time=100_000_000)
        if qos.reliability == "reliable"
        else policy.Reliability.BestEffort
    )
    durability = {
        "volatile": policy.Durability.Volatile,
        "transient_local": policy.Durability.TransientLocal,
        "transient": policy.Durability.Transient,
        "persistent": policy.Durability.Persistent,
    }[qos.durability]
    history = policy.History.KeepAll if qos.depth is None else policy.History.KeepLast(qos.depth)
    more = [policy.Userdata(data=user_data)] if user_data else []
    if most is not None:
        more.append(policy.ResourceLimits(max_samples=most))
    return library().qos.Qos(reliability, durability, history, *more)


class _ExitThread(threading.Thread):
    """Closes all nodes at the end of the process.

    A thread, so that a callback that never returns cannot keep the process from ending; one that
    waits from the first node on, because Python 3.12 and later start none at their end.
    """

    def __init__(self) -> None:
        super().__init__(name="dds-exit", daemon=True)
        self.asked = threading.Event()
        self.start()

    def run(self) -> None:
        self.asked.wait()
        for node in list(_nodes):
            with contextlib.suppress(Exception):
                node.close()


@cache
def _exit_thread() -> _ExitThread:
    return _ExitThread()


@atexit.register
def _close_all() -> None:
    # a dispatcher that is inside CycloneDDS while the interpreter goes away may crash it
    if not _nodes:
        return
    closer = _exit_thread()
    closer.asked.set()
    closer.join(_EXIT_PATIENCE)
    if closer.is_alive():
        _log.warning("DDS was not closed within %g s; leaving it behind", _EXIT_PATIENCE)
        library().core.Entity._entities.clear()  # nor may finalisers wait for it
