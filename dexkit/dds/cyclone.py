"""CycloneDDS: its library, the C functions that dexkit calls, and the types of messages."""

from __future__ import annotations

import ctypes
import threading
from functools import cache
from importlib import metadata
from typing import Any

from dexkit.dds_library import loaded_here
from dexkit.errors import DdsUnavailable
from dexkit.messages import layout

__all__ = [
    "INFINITY",
    "OK",
    "CycloneDds",
    "EndpointData",
    "LostStatus",
    "MatchedStatus",
    "ParticipantData",
    "RejectedStatus",
    "SampleInfo",
    "cyclone_type",
    "library",
    "type_hash",
    "types_lock",
]

INFINITY = 0x7FFFFFFFFFFFFFFF
"""Nanoseconds without end."""
OK = 0
types_lock = threading.RLock()
"""CycloneDDS describes a type when its first topic is made, and not for two threads at once."""


class MatchedStatus(ctypes.Structure):
    """``dds_publication_matched_status_t``, and that of a subscription."""

    _fields_ = [
        ("total_count", ctypes.c_uint32),
        ("total_count_change", ctypes.c_int32),
        ("current_count", ctypes.c_uint32),
        ("current_count_change", ctypes.c_int32),
        ("last_handle", ctypes.c_int64),
    ]


class RejectedStatus(ctypes.Structure):
    """``dds_sample_rejected_status_t``."""

    _fields_ = [
        ("total_count", ctypes.c_uint32),
        ("total_count_change", ctypes.c_int32),
        ("last_reason", ctypes.c_int),
        ("last_instance_handle", ctypes.c_uint64),
    ]


class LostStatus(ctypes.Structure):
    """``dds_sample_lost_status_t``."""

    _fields_ = [("total_count", ctypes.c_uint32), ("total_count_change", ctypes.c_int32)]


class SampleInfo(ctypes.Structure):
    """``dds_sample_info_t``."""

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


class ParticipantData(ctypes.Structure):
    """``dds_builtintopic_participant_t``."""

    _fields_ = [("key", ctypes.c_uint8 * 16), ("qos", ctypes.c_void_p)]


class EndpointData(ctypes.Structure):
    """``dds_builtintopic_endpoint_t``."""

    _fields_ = [
        ("key", ctypes.c_uint8 * 16),
        ("participant_key", ctypes.c_uint8 * 16),
        ("participant_instance_handle", ctypes.c_uint64),
        ("topic_name", ctypes.c_char_p),
        ("type_name", ctypes.c_char_p),
        ("qos", ctypes.c_void_p),
    ]


class CycloneDds:
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
        matched = ctypes.POINTER(MatchedStatus)
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
            "dds_get_sample_rejected_status": (entity, ctypes.POINTER(RejectedStatus)),
            "dds_get_sample_lost_status": (entity, ctypes.POINTER(LostStatus)),
            "dds_lookup_participant": (ctypes.c_uint32, ctypes.c_void_p, ctypes.c_size_t),
            "dds_take": (
                entity,
                reference,
                ctypes.POINTER(SampleInfo),
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
        if self.dds_take_status(ref, ctypes.byref(bits), mask) != OK:
            return 0
        return bits.value


@cache
def library() -> CycloneDds:
    """CycloneDDS, loaded on first use.

    :raises DdsUnavailable: CycloneDDS 0.10.x is not installed, or another one is loaded as well.
    """
    return CycloneDds()


@cache
def cyclone_type(name: str) -> Any:
    """CycloneDDS's class (an ``IdlStruct``) for a message type, made from the layout.

    Only topics need it; messages are encoded by :mod:`dexkit.messages`, which is several times
    faster and proven to give the same bytes.

    :param name: DDS name.
    :raises DdsUnavailable: CycloneDDS 0.10.x is not installed.
    """
    cyclone = library()
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
    with types_lock:
        description = cyclone_type(name).__idl__
        description.populate()
        description.fill_type_data()
        value: bytes = description.get_type_id().value
    return value.hex()
