"""dexkit's codec against CycloneDDS's own serialisation, byte for byte.

Two references: the classes that dexkit makes for CycloneDDS from its layouts, and those of
Unitree's SDK, which is independent code.
"""

from __future__ import annotations

import sys
import threading
from importlib.util import find_spec
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dexkit.dds import DdsNode, cyclone_type, type_hash
from dexkit.messages import message_type
from dexkit.messages.layout import ALL, Struct
from tests.dds_helpers import free_domain  # skips this module where CycloneDDS is missing
from tests.messages_helpers import NAMES, SERVICE_NAMES, messages
from tests.unitree_sdk import sdk_class

REFERENCES = ["dexkit", *(["sdk"] if find_spec("unitree_sdk2py") else [])]


def _class(reference: str, name: str) -> Any:
    return cyclone_type(name) if reference == "dexkit" else sdk_class(name)


def _cyclone(reference: str, struct: Struct, message: Any) -> Any:
    """The same message as an object of CycloneDDS's class."""
    fields = {}
    for member in struct.fields:
        value = getattr(message, member.name)
        if isinstance(member.type, Struct):
            inner = member.type
            value = (
                [_cyclone(reference, inner, v) for v in value]
                if member.sequence or member.is_structs
                else _cyclone(reference, inner, value)
            )
        elif member.is_bytes and not member.is_text:
            value = list(value)
        elif member.array is not None:
            # CycloneDDS reads bytes where the IDL has uint8, and takes lists, too
            value = bytes(value) if member.type.code == "B" else list(value)
        fields[member.name] = value
    return _class(reference, struct.dds_name)(**fields)


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("name", [*NAMES, *SERVICE_NAMES])
@settings(max_examples=10, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(data=st.data())
def test_same_bytes_as_cyclonedds(reference: str, name: str, data: st.DataObject) -> None:
    mt = message_type(name)
    message = data.draw(messages(name, 4))
    theirs = _cyclone(reference, ALL[name], message)
    serialised = theirs.serialize()
    assert mt.encode(message) == serialised
    assert mt.decode(serialised) == message
    # and CycloneDDS reads ours
    assert _class(reference, name).deserialize(mt.encode(message)) == theirs


@pytest.mark.parametrize("name", [*NAMES, *SERVICE_NAMES])
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_cyclonedds_big_endian_is_understood(name: str, data: st.DataObject) -> None:
    from cyclonedds.idl._support import Endianness

    message = data.draw(messages(name, 4))
    theirs = _cyclone("dexkit", ALL[name], message)
    serialised = theirs.__idl__.serialize(theirs, endianness=Endianness.Big)
    assert serialised[:2] == b"\x00\x00"
    assert message_type(name).decode(serialised) == message


def test_two_threads_may_be_the_first_to_use_a_type() -> None:
    """CycloneDDS itself describes a type with the first topic of it, and not in two threads."""
    names = [name for name in NAMES if "Low" in name]
    failed: list[BaseException] = []
    cyclone_type.cache_clear()

    def use(first: int) -> None:
        try:
            with DdsNode(domain=domain) as node:
                for name in (*names[first:], *names[:first]):
                    node.reader(f"rt/{name.replace(':', '')}", name)
        except Exception as error:
            failed.append(error)

    domain, interval = free_domain(), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=use, args=(i,)) for i in range(len(names))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert not failed


@pytest.mark.skipif("sdk" not in REFERENCES, reason="needs the unitree-sdk2 package")
@pytest.mark.parametrize("name", [*NAMES, *SERVICE_NAMES])
def test_unitree_sdk_announces_the_same_type(name: str) -> None:
    description = sdk_class(name).__idl__
    description.populate()
    description.fill_type_data()
    assert description.get_type_id().value.hex() == type_hash(name)
