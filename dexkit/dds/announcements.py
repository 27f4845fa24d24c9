"""What peers announce of themselves, read as bytes from CycloneDDS's built-in topics."""

from __future__ import annotations

import ctypes
import os
import uuid
from collections.abc import Iterator
from typing import Any

from dexkit.child_processes import process_id
from dexkit.dds.cyclone import SampleInfo, library, type_hash
from dexkit.dds.records import DURABILITIES, Endpoint, Participant, Qos
from dexkit.errors import DdsError
from dexkit.messages import layout

__all__ = ["endpoint_of", "participant_of", "taken", "uuid_of"]

_ALIVE = 16  # DDS_ALIVE_INSTANCE_STATE
_COMPLETE = 1  # DDSI_TYPEID_KIND_COMPLETE
_EK_COMPLETE = 0xF2  # first byte of the identifier of a struct (XTypes 7.3.4.2)
_CHUNK = 64  # samples taken at once


def taken(reader: int, kind: type[Any]) -> Iterator[tuple[Any, bool]]:
    """Take the samples of a built-in reader, each valid for one turn; and whether it is alive."""
    cyclone = library()
    while True:
        samples = (ctypes.c_void_p * _CHUNK)()
        infos = (SampleInfo * _CHUNK)()
        count = cyclone.dds_take(reader, samples, infos, _CHUNK, _CHUNK)
        if count < 0:
            raise DdsError(f"discovery failed: {cyclone.error(count)}")
        if count == 0:
            return
        try:
            for i in range(count):
                yield kind.from_address(samples[i]), infos[i].instance_state == _ALIVE
        finally:
            cyclone.dds_return_loan(reader, samples, count)


def uuid_of(key: Any) -> str:
    """A key of 16 bytes as text."""
    return str(uuid.UUID(bytes=bytes(key)))


def _text(data: bytes | None) -> str:
    """Text that a peer announced; bytes that are not UTF-8 become U+FFFD."""
    return (data or b"").decode("utf-8", "replace")


def _shown(text: str) -> str:
    """Text for people, without control characters."""
    return "".join(c if c.isprintable() else "\ufffd" for c in text)


def _property(qos: int, name: bytes) -> str:
    cyclone = library()
    value = ctypes.c_void_p()
    if not cyclone.dds_qget_prop(qos, name, ctypes.byref(value)) or not value:
        return ""
    try:
        return _text(ctypes.string_at(value.value))  # type: ignore[arg-type]
    finally:
        cyclone.dds_free(value)


def participant_of(data: Any, *, own: bool) -> Participant:
    """A participant as it announces itself.

    :param own: it is this node's.
    """
    name = _shown(_property(data.qos, b"__ProcessName"))
    pid = process_id(_property(data.qos, b"__Pid"))
    return Participant(
        key=uuid_of(data.key),
        process=f"{name} (pid {pid})" if name and pid else name,
        pid=pid,
        host=_shown(_property(data.qos, b"__Hostname")),
        own=own,
    )


def endpoint_of(data: Any, kind: str, owner: Participant | None, own_key: str) -> Endpoint:
    """An endpoint as its participant announces it.

    :param owner: that participant, if it is known.
    :param own_key: of this node's participant.
    """
    key = uuid_of(data.participant_key)
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
        key=uuid_of(data.key),
        participant=key,
        process=owner.process if owner else "",
        type_hash=hashed,
        user_data=_user_data(data.qos),
    )


def _user_data(qos: int) -> bytes:
    """The USER_DATA of a discovered endpoint."""
    cyclone = library()
    value, size = ctypes.c_void_p(), ctypes.c_size_t()
    if not cyclone.dds_qget_userdata(qos, ctypes.byref(value), ctypes.byref(size)) or not value:
        return b""
    try:
        return ctypes.string_at(value.value, size.value)  # type: ignore[arg-type]
    finally:
        cyclone.dds_free(value)


def _announced_hash(data: Any) -> str:
    """Hash of the complete type that an endpoint announces; empty: none, or it is no struct."""
    cyclone = library()
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


def _qos_of(qos: int, kind: str) -> Qos:
    """The policies of a discovered endpoint; one that it does not announce has DDS's default."""
    cyclone = library()
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
    return Qos("reliable" if reliable else "best_effort", DURABILITIES[durability], kept)
