"""DDS: one participant on a chosen domain and interface, raw readers and writers, discovery.

The only module that touches CycloneDDS; it is imported when the first :class:`DdsNode` is made.

    with DdsNode(domain=1) as node:
        states = node.writer("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
        commands = node.reader("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
        states.write(MotorStates_([MotorState_(q=2.7)]))
        if commands.wait(timeout=1.0):
            for sample in commands.take():
                print(sample.source_timestamp_ns, sample.message)

Samples are bytes, encapsulation header included; :mod:`dexkit.messages` gives them meaning.

Threads: each node has one dispatcher thread that sleeps in a CycloneDDS waitset. CycloneDDS
never calls into Python (listeners that do can deadlock on the interpreter lock), so ``on_data``
and discovery callbacks run in the dispatcher. They must only note that something happened.

What peers announce is not believed: the built-in topics are read through ctypes, as bytes,
because CycloneDDS's Python raises at text that is not UTF-8, and then loses what other peers
announced together with it.

On loopback a node finds every other process of the machine, whether or not ``lo`` carries the
MULTICAST flag, without changing the system (docs/sources/unitree-dex.md#a6).

A node sees only what comes in by its interface or from this machine
(:mod:`dexkit.interface_filter`). CycloneDDS by itself would listen to every interface of the
machine. Where the system has no filter for that, a node is refused, unless
``DEXKIT_ALL_INTERFACES=1`` allows it.

``DEXKIT_PEERS=HOST,...`` names other machines that are called by unicast, for networks
without multicast. Samples then go by unicast only.

``DEXKIT_DDS_LOG=PATH`` appends CycloneDDS's own log to a file; otherwise its warnings only become
part of a :class:`~dexkit.errors.DdsSetupError`.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import logging
import os
import socket
import tempfile
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from dexkit import interface_filter
from dexkit.child_processes import process_id
from dexkit.dds_library import loaded_here
from dexkit.dds_socket_filter import DomainSockets, open_sockets
from dexkit.errors import DdsError, DdsSetupError, DdsUnavailable, EncodeError, UsageError
from dexkit.escaping import html
from dexkit.interface_names import find_interface, named_peers
from dexkit.messages import MessageType, layout, message_type
from dexkit.open_file_limit import require_open_files
from dexkit.threads import Worker

__all__ = [
    "DdsNode",
    "Discovery",
    "DiscoveryEvent",
    "Endpoint",
    "Participant",
    "Qos",
    "Reader",
    "Sample",
    "Writer",
    "cyclone_type",
    "interfaces",
    "type_hash",
]

_log = logging.getLogger(__name__)

_INFINITY = 0x7FFFFFFFFFFFFFFF
_OK = 0
_TIMEOUT = -10
_PRECONDITION_NOT_MET = -4
_ALIVE = 16  # DDS_ALIVE_INSTANCE_STATE
_LOOK_EVERY_NS = 500_000_000  # whether the interface is still the one that is let in
_MAX_PARTICIPANT_INDEX = 60  # processes on one machine and domain; each is probed at start-up
_TAKE_CHUNK = 64
_EXIT_PATIENCE = 3.0  # seconds for closing at the end of the process; it takes some 20 ms
_DURABILITIES = ("volatile", "transient_local", "transient", "persistent")  # as CycloneDDS counts
_COMPLETE = 1  # DDSI_TYPEID_KIND_COMPLETE
_EK_COMPLETE = 0xF2  # first byte of the identifier of a struct (XTypes 7.3.4.2)
_BUILTIN = b"org::eclipse::cyclonedds::builtin::"  # types of a node's own discovery readers


@dataclass(frozen=True)
class Qos:
    """The QoS policies of an endpoint: reliability, durability and history.

    :param reliability: ``"reliable"`` or ``"best_effort"``.
    :param durability: ``"volatile"``, ``"transient_local"``, ``"transient"``, ``"persistent"``.
    :param depth: samples kept of the history; None keeps all.

    Unitree's SDKs write reliable and read best-effort, volatile, keep-last 1
    (docs/sources/unitree-dex.md#a5).
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    depth: int | None = 1

    def __post_init__(self) -> None:
        if self.reliability not in ("reliable", "best_effort"):
            raise UsageError(f"reliability {self.reliability!r}")
        if self.durability not in _DURABILITIES:
            raise UsageError(f"durability {self.durability!r}")
        if self.depth is not None and self.depth < 1:
            raise UsageError(f"a history keeps at least 1 sample, not {self.depth}")

    @classmethod
    def writer_default(cls) -> Qos:
        """The QoS that Unitree's writers offer."""
        return cls("reliable")

    @classmethod
    def reader_default(cls) -> Qos:
        """The QoS that Unitree's readers request."""
        return cls("best_effort")

    def __str__(self) -> str:
        keep = "keep_all" if self.depth is None else f"keep_last({self.depth})"
        return f"{self.reliability}, {self.durability}, {keep}"


@dataclass(slots=True)
class Sample:
    """One received sample.

    :ivar data: as on the wire, encapsulation header included.
    :ivar source_timestamp_ns: when the writer wrote it, wall clock, ns.
    :ivar reception_ns: when it was taken from the reader, wall clock, ns.
    :ivar writer: handle of the writer, the same for all samples of one writer.
    """

    data: bytes
    source_timestamp_ns: int
    reception_ns: int
    writer: int
    type: MessageType = field(repr=False)
    _message: Any = field(default=None, repr=False, compare=False)

    @property
    def message(self) -> Any:
        """The decoded message (decoded once).

        :raises WireError: the bytes are not that message.
        """
        if self._message is None:
            self._message = self.type.decode(self.data)
        return self._message


@dataclass(frozen=True)
class Participant:
    """A process's presence on the domain.

    :param process: name and pid if the participant announces them (CycloneDDS does), or empty.
    :param pid: process id, or 0 if it is not announced.
    """

    key: str
    process: str
    pid: int
    host: str
    own: bool


@dataclass(frozen=True)
class Endpoint:
    """A reader or writer somewhere on the domain.

    :param kind: ``"reader"`` or ``"writer"``.
    :param own: it belongs to this node.
    :param key: unique id of the endpoint; ``participant`` that of its participant.
    :param process: name and pid of the process that it lives in, if known.
    :param user_data: its USER_DATA, or empty.
    :param type_hash: hash of the complete type if the other side announces one, or empty; two
        endpoints whose ``type_name`` is the same but whose hash differs disagree on the layout.
    """

    topic: str
    type_name: str
    kind: str
    qos: Qos
    own: bool
    key: str
    participant: str
    process: str = ""
    type_hash: str = ""
    user_data: bytes = b""


@dataclass(frozen=True)
class DiscoveryEvent:
    """An endpoint that appeared or vanished."""

    appeared: bool
    endpoint: Endpoint


class _MatchedStatus(ctypes.Structure):
    _fields_ = [
        ("total_count", ctypes.c_uint32),
        ("total_count_change", ctypes.c_int32),
        ("current_count", ctypes.c_uint32),
        ("current_count_change", ctypes.c_int32),
        ("last_handle", ctypes.c_int64),
    ]


class _RejectedStatus(ctypes.Structure):
    _fields_ = [
        ("total_count", ctypes.c_uint32),
        ("total_count_change", ctypes.c_int32),
        ("last_reason", ctypes.c_int),
        ("last_instance_handle", ctypes.c_uint64),
    ]


class _LostStatus(ctypes.Structure):
    _fields_ = [("total_count", ctypes.c_uint32), ("total_count_change", ctypes.c_int32)]


class _SampleInfo(ctypes.Structure):
    _fields_ = [
        ("sample_state", ctypes.c_int),
        ("view_state", ctypes.c_int),
        ("instance_state", ctypes.c_int),
        ("valid_data", ctypes.c_bool),
        ("source_timestamp", ctypes.c_int64),
        ("instance_handle", ctypes.c_uint64),
        ("publication_handle", ctypes.c_uint64),
        ("disposed_generation_count", ctypes.c_uint32),
        ("no_writers_generation_count", ctypes.c_uint32),
        ("sample_rank", ctypes.c_uint32),
        ("generation_rank", ctypes.c_uint32),
        ("absolute_generation_rank", ctypes.c_uint32),
    ]


class _ParticipantData(ctypes.Structure):
    _fields_ = [("key", ctypes.c_uint8 * 16), ("qos", ctypes.c_void_p)]


class _EndpointData(ctypes.Structure):
    _fields_ = [
        ("key", ctypes.c_uint8 * 16),
        ("participant_key", ctypes.c_uint8 * 16),
        ("participant_instance_handle", ctypes.c_uint64),
        ("topic_name", ctypes.c_char_p),
        ("type_name", ctypes.c_char_p),
        ("qos", ctypes.c_void_p),
    ]


class _Cyclone:
    """CycloneDDS, loaded on first use: the Python classes and the C functions needed here."""

    def __init__(self) -> None:
        try:
            version = metadata.version("cyclonedds")
            from cyclonedds import _clayer, builtin, core, domain, idl, internal, pub, qos, sub
            from cyclonedds import topic as topic_module
            from cyclonedds.idl import annotations, types
        except Exception as error:  # its loader raises its own classes, too
            missing = isinstance(error, metadata.PackageNotFoundError)
            raise DdsUnavailable(
                "CycloneDDS is not installed"
                if missing
                else f"CycloneDDS cannot be loaded: {error}",
                hint="type: dexkit setup-dds (it finds or builds CycloneDDS 0.10 for this Python). "
                "Recordings, emulated devices and offline checks work without it.",
            ) from error
        if not version.startswith("0.10."):
            raise DdsUnavailable(
                f"CycloneDDS {version} is installed, dexkit needs 0.10.x",
                hint="an 11.x participant with Unitree's types crashes every 0.10.x peer, the "
                "robot included: dexkit setup-dds --replace",
            )
        if len(loaded := loaded_here()) > 1:
            raise DdsUnavailable(
                f"this process has loaded two CycloneDDS libraries: {' and '.join(loaded)}",
                hint="a program that uses both crashes or hangs. Unset LD_LIBRARY_PATH and "
                "LD_PRELOAD, and run ROS 2 (rclpy) as another process; 'dexkit setup-dds' examines "
                "what is installed",
            )
        self.version = version
        self.layer: Any = _clayer
        self.builtin: Any = builtin
        self.core: Any = core
        self.domain: Any = domain
        self.idl: Any = idl
        self.types: Any = types
        self.annotations: Any = annotations
        self.qos: Any = qos
        self.pub: Any = pub
        self.sub: Any = sub
        self.topic: Any = topic_module
        self.error: Any = core.DDSException
        self.lib: Any = internal.DDS._dll_handle
        entity, ssize = ctypes.c_int32, ctypes.c_ssize_t
        status = ctypes.POINTER(ctypes.c_uint32)
        matched = ctypes.POINTER(_MatchedStatus)
        pointer, number = ctypes.c_void_p, ctypes.POINTER(ctypes.c_int32)
        reference = ctypes.POINTER(pointer)
        for name, arguments in {
            "dds_domain_set_deafmute": (entity, ctypes.c_bool, ctypes.c_bool, ctypes.c_int64),
            "dds_delete": (entity,),
            "dds_create_waitset": (entity,),
            "dds_waitset_attach": (entity, entity, ssize),
            "dds_waitset_detach": (entity, entity),
            "dds_waitset_wait": (entity, ctypes.POINTER(ssize), ctypes.c_size_t, ctypes.c_int64),
            "dds_waitset_set_trigger": (entity, ctypes.c_bool),
            "dds_set_status_mask": (entity, ctypes.c_uint32),
            "dds_take_status": (entity, status, ctypes.c_uint32),
            "dds_get_publication_matched_status": (entity, matched),
            "dds_get_subscription_matched_status": (entity, matched),
            "dds_get_sample_rejected_status": (entity, ctypes.POINTER(_RejectedStatus)),
            "dds_get_sample_lost_status": (entity, ctypes.POINTER(_LostStatus)),
            "dds_lookup_participant": (ctypes.c_uint32, ctypes.c_void_p, ctypes.c_size_t),
            "dds_take": (
                entity,
                reference,
                ctypes.POINTER(_SampleInfo),
                ctypes.c_size_t,
                ctypes.c_uint32,
            ),
            "dds_return_loan": (entity, reference, ctypes.c_int32),
            "dds_builtintopic_get_endpoint_type_info": (pointer, reference),
        }.items():
            # a prototype of our own: the wheel's classes set argtypes on the shared objects
            prototype = ctypes.CFUNCTYPE(ctypes.c_int32, *arguments)
            setattr(self, name, prototype((name, self.lib)))
        for name, getter in {
            "dds_qget_reliability": (pointer, number, ctypes.POINTER(ctypes.c_int64)),
            "dds_qget_durability": (pointer, number),
            "dds_qget_history": (pointer, number, number),
            "dds_qget_prop": (pointer, ctypes.c_char_p, reference),
            "dds_qget_userdata": (pointer, reference, ctypes.POINTER(ctypes.c_size_t)),
        }.items():
            setattr(self, name, ctypes.CFUNCTYPE(ctypes.c_bool, *getter)((name, self.lib)))
        self.dds_free: Any = ctypes.CFUNCTYPE(None, pointer)(("dds_free", self.lib))
        self.ddsi_typeinfo_typeid: Any = ctypes.CFUNCTYPE(pointer, pointer, ctypes.c_int)(
            ("ddsi_typeinfo_typeid", self.lib)
        )
        self.ddsi_typeid_ser: Any = ctypes.CFUNCTYPE(
            None, pointer, reference, ctypes.POINTER(ctypes.c_uint32)
        )(("ddsi_typeid_ser", self.lib))
        self.ddsi_typeid_fini: Any = ctypes.CFUNCTYPE(None, pointer)(("ddsi_typeid_fini", self.lib))
        # Nothing on stderr; _setup_error_text gets the text when it is needed. The sink has to be a
        # C function, since it is called by threads that hold CycloneDDS's locks, and one
        # without effect: abs() of the unused first argument.
        self.lib.dds_set_log_sink(ctypes.CDLL(None).abs, None)
        self.data_available = int(core.DDSStatus.DataAvailable)
        self.publication_matched = int(core.DDSStatus.PublicationMatched)
        self.subscription_matched = int(core.DDSStatus.SubscriptionMatched)

    def __getattr__(self, name: str) -> Any:  # the C functions set above
        raise AttributeError(name)

    def forget(self, entity: Any) -> None:
        """Keep Python's finaliser from deleting an entity that is deleted explicitly."""
        self.core.Entity._entities.pop(entity._ref, None)

    def delete(self, entity: Any) -> None:
        """Delete an entity now, not when Python collects it."""
        self.forget(entity)
        self.dds_delete(entity._ref)

    def take_status(self, ref: int, mask: int) -> int:
        """Read and reset status bits, so that the waitset fires on changes only."""
        bits = ctypes.c_uint32()
        if self.dds_take_status(ref, ctypes.byref(bits), mask) != _OK:
            return 0
        return bits.value


@cache
def _cyclone() -> _Cyclone:
    return _Cyclone()


@cache
def cyclone_type(name: str) -> Any:
    """CycloneDDS's class (an ``IdlStruct``) for a message type, made from the layout.

    Only topics need it; messages are encoded by :mod:`dexkit.messages`, which is several times
    faster and proven to give the same bytes.

    :param name: DDS name.
    :raises DdsUnavailable: CycloneDDS 0.10.x is not installed.
    """
    cyclone = _cyclone()
    struct = layout.ALL[name]
    numbers = {
        "int8": cyclone.types.int8,
        "uint8": cyclone.types.uint8,
        "int16": cyclone.types.int16,
        "uint16": cyclone.types.uint16,
        "int32": cyclone.types.int32,
        "uint32": cyclone.types.uint32,
        "float": cyclone.types.float32,
        "int64": cyclone.types.int64,
        "boolean": bool,
        "string": str,
    }
    fields = {}
    for member in struct.fields:
        kind = (
            numbers[member.type.idl]
            if isinstance(member.type, layout.Primitive)
            else cyclone_type(member.type.dds_name)
        )
        if member.sequence and not member.is_text:
            bounded = kind if member.bound is None else (kind, member.bound)
            kind = cyclone.types.sequence[bounded]
        elif member.array is not None:
            kind = cyclone.types.array[kind, member.array]
        fields[member.name] = kind
    cls = cyclone.idl.make_idl_struct(struct.name, name.replace("::", "."), fields)
    # as the SDK's classes: the hash of the type depends on both
    cyclone.annotations.final(cls)
    cyclone.annotations.autoid("sequential")(cls)
    return cls


@cache
def type_hash(name: str) -> str:
    """Hash of the layout that dexkit knows under a DDS name, as in :attr:`Endpoint.type_hash`.

    Peers whose hash differs have another version of the message (docs/sources/unitree-dex.md#a3)
    and do not match.
    """
    with _types_lock:
        description = cyclone_type(name).__idl__
        description.populate()
        description.fill_type_data()
        value: bytes = description.get_type_id().value
    return value.hex()


def interfaces() -> list[str]:
    """Names of this machine's network interfaces."""
    return [name for _, name in socket.if_nameindex()]


def _trace(verbosity: str, path: str) -> str:
    return (
        f"<Tracing><Verbosity>{verbosity}</Verbosity><AppendToFile>true</AppendToFile>"
        f"<OutputFile>{html(path)}</OutputFile></Tracing>"
    )


# until the filter is there; dds_domain_set_deafmute() ends it
_DEAF = "<Internal><ControlTopic><Deaf>true</Deaf></ControlTopic></Internal>"


def _config(interface: str, more: str = "", peers: Sequence[str] = ()) -> str:
    """CycloneDDS configuration of a domain (docs/sources/unitree-dex.md#a6).

    On loopback peers are called on 127.0.0.1 by port, since multicast may be off there;
    ``multicast="default"`` keeps listening to it where it is on, because an SDK process then
    listens to nothing else. With named peers only discovery uses multicast: what does not carry
    multicast would lose the samples of two readers.

    On a network participants are announced twice a second instead of every 8 s: after a link was
    down for more than the lease (10 s), both sides have forgotten each other, and the first
    announcement ends that.
    """
    loopback = interface_filter.is_loopback(interface)
    called = ("127.0.0.1",) if loopback else tuple(peers)
    listed = "".join(f'<Peer address="{peer}"/>' for peer in called)
    announce = "" if loopback else "<SPDPInterval>500ms</SPDPInterval>"
    unicast = "<AllowMulticast>spdp</AllowMulticast>" if peers and not loopback else ""
    return (
        "<CycloneDDS><Domain>"
        "<General><Interfaces>"
        f'<NetworkInterface name="{html(interface)}" priority="default" multicast="default"/>'
        f"</Interfaces>{unicast}</General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_MAX_PARTICIPANT_INDEX}</MaxAutoParticipantIndex>"
        + (f"<Peers>{listed}</Peers>" if listed else "")
        + f"{announce}</Discovery>{more}"
        "</Domain></CycloneDDS>"
    )


@dataclass
class _Domain:
    """A domain of this process; its configuration is that of the first node."""

    interface: str
    entity: Any  # None when other code in this process configured the domain
    nodes: int = 0
    sockets: DomainSockets | None = None  # None when nothing is kept out


_domains: dict[int, _Domain] = {}
_FILES = 16  # descriptors of a participant; short of them, CycloneDDS dies
_domains_lock = threading.Lock()
# CycloneDDS describes a type when its first topic is made, and not for two threads at once
_types_lock = threading.RLock()


def _acquire_domain(number: int, interface: str) -> None:
    """Configure the domain, or use it if it is configured already. Needs ``_domains_lock``."""
    cyclone = _cyclone()
    known = _domains.get(number)
    if known is not None:
        if known.interface != interface and known.entity is not None:
            raise DdsSetupError(
                f"domain {number} of this process is on {known.interface}, not {interface}",
                hint="a process has one interface per domain: use another domain or process",
            )
        known.nodes += 1
        return
    peers = named_peers()
    path = os.environ.get("DEXKIT_DDS_LOG")
    tracing = _trace("config", path) if path else ""
    before = open_sockets()
    sockets = None
    try:
        entity = cyclone.domain.Domain(number, _config(interface, _DEAF + tracing, peers))
    except cyclone.error as error:
        if error.code != _PRECONDITION_NOT_MET:
            raise DdsSetupError(
                f"domain {number} cannot be set up on {interface}: "
                f"{_setup_error_text(number, interface) or error}",
                hint=f"this machine has: {', '.join(interfaces())}; at most "
                f"{_MAX_PARTICIPANT_INDEX} processes share a domain",
            ) from error
        _log.warning(
            "domain %d was configured by other code in this process; its interface is used, not "
            "%s, and any machine on any network of this one can take part",
            number,
            interface,
        )
        entity = None
    else:
        try:
            sockets = _filter_interfaces(number, interface, before)
            code = cyclone.dds_domain_set_deafmute(entity._ref, False, False, _INFINITY)
            if code != _OK:
                raise DdsSetupError(f"domain {number} cannot receive (CycloneDDS error {code})")
        except BaseException:
            cyclone.delete(entity)
            raise
    _domains[number] = _Domain(interface, entity, 1, sockets)


def _filter_interfaces(number: int, interface: str, before: dict[int, int]) -> DomainSockets | None:
    """Accept only packets that arrive on ``interface``; call it while the domain receives nothing.

    :returns: None when the user allows all interfaces.
    :raises DdsSetupError: the system has no such filter.
    """
    try:
        return DomainSockets(number, interface, before)
    except OSError as error:
        if interface_filter.all_interfaces_allowed():
            _log.warning(
                "domain %d is open to every network of this machine, not only to %s (%s=1)",
                number,
                interface,
                interface_filter.ALL_INTERFACES,
            )
            return None
        raise DdsSetupError(
            f"packets of networks other than {interface} cannot be kept out of domain {number}: "
            f"{error.strerror or error}",
            hint=interface_filter.HINT,
        ) from error


def _setup_error_text(number: int, interface: str) -> str:
    """Try once more, with CycloneDDS's warnings going to a file, and return them."""
    cyclone = _cyclone()
    with tempfile.TemporaryDirectory(prefix="dexkit-") as folder:
        path = Path(folder) / "dds.log"
        try:
            config = _config(interface, _DEAF + _trace("warning", str(path)))
            cyclone.delete(cyclone.domain.Domain(number, config))
        except cyclone.error:
            pass
        text = path.read_text(errors="replace") if path.exists() else ""
    # "1795254363.143174 [151]     python: message"
    return "; ".join(line.split(": ", 1)[-1] for line in text.splitlines() if line.strip())


def _release_domain(number: int) -> None:
    """Drop one use; delete the domain after the last. Needs ``_domains_lock``."""
    domain = _domains[number]
    domain.nodes -= 1
    if domain.nodes:
        return
    cyclone = _cyclone()
    if domain.entity is not None and cyclone.dds_lookup_participant(number, None, 0) > 0:
        return  # other code made participants on it: they would vanish with the domain
    del _domains[number]
    if domain.entity is not None:
        with domain.sockets.ending() if domain.sockets else contextlib.nullcontext():
            cyclone.delete(domain.entity)


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
        status = _MatchedStatus()
        if self._matched_status()(self._ref, ctypes.byref(status)) != _OK:
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
        self._write = _cyclone().layer.ddspy_write
        self._write_ts = _cyclone().layer.ddspy_write_ts
        self._registered = False

    def _matched_status(self) -> Any:
        return _cyclone().dds_get_publication_matched_status

    def _on_status(self) -> None:
        cyclone = _cyclone()
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
            _cyclone().layer.ddspy_register_instance(self._ref, data)
        if source_timestamp_ns is None:
            code = self._write(self._ref, data)
        else:
            code = self._write_ts(self._ref, data, source_timestamp_ns)
        if code == _OK:
            return True
        if code == _TIMEOUT:
            self.timeouts += 1
            return False
        raise DdsError(f"writing to {self.topic} failed: {_cyclone().error(code)}")


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
        self._take = _cyclone().layer.ddspy_take

    def _matched_status(self) -> Any:
        return _cyclone().dds_get_subscription_matched_status

    @property
    def refused(self) -> int:
        """Samples that arrived and were dropped because ``most`` were kept already."""
        status = _RejectedStatus()
        if self._entity is not None and (
            _cyclone().dds_get_sample_rejected_status(self._ref, ctypes.byref(status)) == _OK
        ):
            self._refused = int(status.total_count)
        return self._refused

    @property
    def lost(self) -> int:
        """Samples that DDS says were lost on their way: in 0.10 those too old for the reader."""
        status = _LostStatus()
        if self._entity is not None and (
            _cyclone().dds_get_sample_lost_status(self._ref, ctypes.byref(status)) == _OK
        ):
            self._lost = int(status.total_count)
        return self._lost

    def _on_status(self) -> None:
        cyclone = _cyclone()
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
                raise DdsError(f"reading {self.topic} failed: {_cyclone().error(got)}")
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
        require_open_files(_FILES, "DDS")
        cyclone = _cyclone()
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
        with _domains_lock:
            _acquire_domain(domain, interface)
            self._sockets = _domains[domain].sockets
            try:
                self._participant = cyclone.domain.DomainParticipant(domain)
                self._waitset = cyclone.dds_create_waitset(self._participant._ref)
            except cyclone.error as error:
                _release_domain(domain)
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
        self._add(writer, _cyclone().pub.DataWriter, _cyclone().publication_matched)
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
        cyclone = _cyclone()
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
        cyclone = _cyclone()
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
        with _domains_lock:
            cyclone.delete(self._participant)
            _release_domain(self.domain)
        self._topics.clear()
        _nodes.discard(self)
        self._notify()

    def _topic(self, name: str, kind: MessageType) -> Any:
        key = (name, kind.name)
        if key not in self._topics:
            with _types_lock:
                self._topics[key] = _cyclone().topic.Topic(
                    self._participant, name, cyclone_type(kind.name)
                )
        return self._topics[key]

    def _add(self, handle: _Handle, factory: Any, mask: int, most: int | None = None) -> None:
        cyclone = _cyclone()
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
            cyclone = _cyclone()
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
        cyclone = _cyclone()
        most = 64
        tokens = (ctypes.c_ssize_t * most)()
        sockets = self._sockets if self._sockets and not self._sockets.fixed else None
        patience = _LOOK_EVERY_NS if sockets else _INFINITY
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
        cyclone = _cyclone()
        participants, *endpoints = self._builtin
        changed = False
        for reader in self._builtin:
            cyclone.take_status(reader._ref, cyclone.data_available)
        # participants first, so that endpoints know their process
        for data, alive in _taken(participants._ref, _ParticipantData):
            changed = True
            with self._whatever_it_says():
                self._read_participant(data, alive)
        for kind, reader in zip(("writer", "reader"), endpoints, strict=True):
            for data, alive in _taken(reader._ref, _EndpointData):
                changed = True
                with self._whatever_it_says():
                    self._read_endpoint(data, alive, kind)
        if changed:
            self._notify()

    def _read_participant(self, data: Any, alive: bool) -> None:
        key = _uuid(data.key)
        if not alive:
            self.discovery._remove_participant(key)
        elif data.qos:
            self.discovery._put_participant(_participant(data, own=key == self._key))

    def _read_endpoint(self, data: Any, alive: bool, kind: str) -> None:
        key = _uuid(data.key)
        if not alive:
            self.discovery._remove(key)
        elif data.qos and not (data.type_name or b"").startswith(_BUILTIN):
            owner = self.discovery._participant(_uuid(data.participant_key))
            self.discovery._put(_endpoint(data, kind, owner, self._key))

    @contextlib.contextmanager
    def _whatever_it_says(self) -> Iterator[None]:
        """Skip an announcement that cannot be decoded, and keep those received with it."""
        try:
            yield
        except Exception:
            self.discovery.unreadable += 1
            if self.discovery.unreadable == 1:
                _log.exception("an announcement of a peer cannot be read (logged once)")


def _taken(reader: int, kind: type[Any]) -> Iterator[tuple[Any, bool]]:
    """Take the samples of a built-in reader, each valid for one turn; and whether it is alive."""
    cyclone = _cyclone()
    while True:
        samples = (ctypes.c_void_p * _TAKE_CHUNK)()
        infos = (_SampleInfo * _TAKE_CHUNK)()
        count = cyclone.dds_take(reader, samples, infos, _TAKE_CHUNK, _TAKE_CHUNK)
        if count < 0:
            raise DdsError(f"discovery failed: {cyclone.error(count)}")
        if count == 0:
            return
        try:
            for i in range(count):
                yield kind.from_address(samples[i]), infos[i].instance_state == _ALIVE
        finally:
            cyclone.dds_return_loan(reader, samples, count)


def _uuid(key: Any) -> str:
    return str(uuid.UUID(bytes=bytes(key)))


def _text(data: bytes | None) -> str:
    """Text that a peer announced; bytes that are not UTF-8 become U+FFFD."""
    return (data or b"").decode("utf-8", "replace")


def _shown(text: str) -> str:
    """Text for people, without control characters."""
    return "".join(c if c.isprintable() else "\ufffd" for c in text)


def _property(qos: int, name: bytes) -> str:
    cyclone = _cyclone()
    value = ctypes.c_void_p()
    if not cyclone.dds_qget_prop(qos, name, ctypes.byref(value)) or not value:
        return ""
    try:
        return _text(ctypes.string_at(value.value))  # type: ignore[arg-type]
    finally:
        cyclone.dds_free(value)


def _participant(data: Any, *, own: bool) -> Participant:
    name = _shown(_property(data.qos, b"__ProcessName"))
    pid = process_id(_property(data.qos, b"__Pid"))
    return Participant(
        key=_uuid(data.key),
        process=f"{name} (pid {pid})" if name and pid else name,
        pid=pid,
        host=_shown(_property(data.qos, b"__Hostname")),
        own=own,
    )


def _endpoint(data: Any, kind: str, owner: Participant | None, own_key: str) -> Endpoint:
    key = _uuid(data.participant_key)
    type_name = _text(data.type_name)
    hashed = _announced_hash(data)
    if not hashed and owner is not None and owner.pid == os.getpid():
        # CycloneDDS does not describe the types of its own process
        hashed = type_hash(type_name) if type_name in layout.ALL else ""
    return Endpoint(
        topic=_text(data.topic_name),
        type_name=type_name,
        kind=kind,
        qos=_qos_of(data.qos, kind),
        own=key == own_key,
        key=_uuid(data.key),
        participant=key,
        process=owner.process if owner else "",
        type_hash=hashed,
        user_data=_user_data(data.qos),
    )


def _user_data(qos: int) -> bytes:
    """The USER_DATA of a discovered endpoint."""
    cyclone = _cyclone()
    value, size = ctypes.c_void_p(), ctypes.c_size_t()
    if not cyclone.dds_qget_userdata(qos, ctypes.byref(value), ctypes.byref(size)) or not value:
        return b""
    try:
        return ctypes.string_at(value.value, size.value)  # type: ignore[arg-type]
    finally:
        cyclone.dds_free(value)


def _announced_hash(data: Any) -> str:
    """Hash of the complete type that an endpoint announces; empty: none, or it is no struct."""
    cyclone = _cyclone()
    info = ctypes.c_void_p()
    if (
        cyclone.dds_builtintopic_get_endpoint_type_info(ctypes.addressof(data), ctypes.byref(info))
        or not info
    ):
        return ""
    identifier = cyclone.ddsi_typeinfo_typeid(info, _COMPLETE)
    if not identifier:
        return ""
    try:
        packed, size = ctypes.c_void_p(), ctypes.c_uint32()
        cyclone.ddsi_typeid_ser(identifier, ctypes.byref(packed), ctypes.byref(size))
        if not packed:
            return ""
        try:
            octets = ctypes.string_at(packed.value, size.value)  # type: ignore[arg-type]
        finally:
            cyclone.dds_free(packed)
    finally:
        cyclone.ddsi_typeid_fini(identifier)
        cyclone.dds_free(identifier)
    return octets[1:15].hex() if len(octets) >= 15 and octets[0] == _EK_COMPLETE else ""


def _policies(qos: Qos, user_data: bytes = b"", most: int | None = None) -> Any:
    policy = _cyclone().qos.Policy
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
    return _cyclone().qos.Qos(reliability, durability, history, *more)


def _qos_of(qos: int, kind: str) -> Qos:
    """The policies of a discovered endpoint; one that it does not announce has DDS's default."""
    cyclone = _cyclone()
    value, depth, duration = ctypes.c_int32(), ctypes.c_int32(), ctypes.c_int64()
    reliable = kind == "writer"
    if cyclone.dds_qget_reliability(qos, ctypes.byref(value), ctypes.byref(duration)):
        reliable = value.value == 1
    durability = 0
    if cyclone.dds_qget_durability(qos, ctypes.byref(value)) and 0 <= value.value < 4:
        durability = value.value
    kept: int | None = 1
    if cyclone.dds_qget_history(qos, ctypes.byref(value), ctypes.byref(depth)):
        kept = None if value.value == 1 else max(depth.value, 1)
    return Qos("reliable" if reliable else "best_effort", _DURABILITIES[durability], kept)


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
        _cyclone().core.Entity._entities.clear()  # nor may finalisers wait for it
