"""Messages of ``unitree_api``: dataclasses and their CDR codec.

Generated from idl/unitree_api.idl by ``python -m tools.generate``; do not edit.
Use the codec through :func:`dexkit.messages.message_type`: it checks the header and the
bounds and turns every failure into a :class:`dexkit.errors.WireError`.
"""

# ruff: noqa: E501, N802
# fmt: off

from __future__ import annotations

from dataclasses import dataclass, field
from struct import Struct

from dexkit.messages.codec import (
    HEADER,
    Buffer,
    check_end,
    pack_bytes,
    pack_text,
    take_bytes,
    take_text,
    truncated,
)

__all__ = [
    "RequestHeader_",
    "RequestIdentity_",
    "RequestLease_",
    "RequestPolicy_",
    "Request_",
    "ResponseHeader_",
    "ResponseStatus_",
    "Response_",
]


@dataclass(slots=True)
class RequestIdentity_:
    """Number of a request and its API function.

    DDS type ``unitree_api::msg::dds_::RequestIdentity_``.
    """

    id: int = 0  # chosen by the client; the response repeats it
    api_id: int = 0


@dataclass(slots=True)
class RequestLease_:
    """Which lease a request is made under.

    DDS type ``unitree_api::msg::dds_::RequestLease_``.
    """

    id: int = 0


@dataclass(slots=True)
class RequestPolicy_:
    """How a request is to be served.

    DDS type ``unitree_api::msg::dds_::RequestPolicy_``.
    """

    priority: int = 0
    noreply: bool = False  # the client waits for no response


@dataclass(slots=True)
class RequestHeader_:
    """Head of a request.

    DDS type ``unitree_api::msg::dds_::RequestHeader_``.
    """

    identity: RequestIdentity_ = field(default_factory=RequestIdentity_)
    lease: RequestLease_ = field(default_factory=RequestLease_)
    policy: RequestPolicy_ = field(default_factory=RequestPolicy_)


@dataclass(slots=True)
class Request_:
    """A request to a service.

    DDS type ``unitree_api::msg::dds_::Request_``.
    """

    header: RequestHeader_ = field(default_factory=RequestHeader_)
    parameter: str = ""  # JSON
    binary: bytes = b""


@dataclass(slots=True)
class ResponseStatus_:
    """How a request went.

    DDS type ``unitree_api::msg::dds_::ResponseStatus_``.
    """

    code: int = 0  # 0, or an error of the service


@dataclass(slots=True)
class ResponseHeader_:
    """Head of a response.

    DDS type ``unitree_api::msg::dds_::ResponseHeader_``.
    """

    identity: RequestIdentity_ = field(default_factory=RequestIdentity_)  # the request's
    status: ResponseStatus_ = field(default_factory=ResponseStatus_)


@dataclass(slots=True)
class Response_:
    """A service's answer to a request.

    DDS type ``unitree_api::msg::dds_::Response_``.
    """

    header: ResponseHeader_ = field(default_factory=ResponseHeader_)
    data: str = ""  # JSON
    binary: bytes = b""


_RequestIdentity_0 = (Struct("<2q"), Struct(">2q"))


def encode_RequestIdentity_(m: RequestIdentity_) -> bytes:
    """Encapsulation header and little-endian data of a RequestIdentity_."""
    return HEADER + _RequestIdentity_0[0].pack(m.id, m.api_id)


def decode_RequestIdentity_(data: Buffer, big: bool) -> RequestIdentity_:
    """The RequestIdentity_ after the encapsulation header of ``data``."""
    if len(data) < 20:
        raise truncated("RequestIdentity_", 20, len(data))
    v = _RequestIdentity_0[big].unpack_from(data, 4)
    at = 20
    if at != len(data):
        check_end("RequestIdentity_", data, at)
    return RequestIdentity_(v[0], v[1])


_RequestLease_0 = (Struct("<q"), Struct(">q"))


def encode_RequestLease_(m: RequestLease_) -> bytes:
    """Encapsulation header and little-endian data of a RequestLease_."""
    return HEADER + _RequestLease_0[0].pack(m.id)


def decode_RequestLease_(data: Buffer, big: bool) -> RequestLease_:
    """The RequestLease_ after the encapsulation header of ``data``."""
    if len(data) < 12:
        raise truncated("RequestLease_", 12, len(data))
    v = _RequestLease_0[big].unpack_from(data, 4)
    at = 12
    if at != len(data):
        check_end("RequestLease_", data, at)
    return RequestLease_(v[0])


_RequestPolicy_0 = (Struct("<i?"), Struct(">i?"))


def encode_RequestPolicy_(m: RequestPolicy_) -> bytes:
    """Encapsulation header and little-endian data of a RequestPolicy_."""
    return HEADER + _RequestPolicy_0[0].pack(m.priority, m.noreply)


def decode_RequestPolicy_(data: Buffer, big: bool) -> RequestPolicy_:
    """The RequestPolicy_ after the encapsulation header of ``data``."""
    if len(data) < 9:
        raise truncated("RequestPolicy_", 9, len(data))
    v = _RequestPolicy_0[big].unpack_from(data, 4)
    at = 9
    if at != len(data):
        check_end("RequestPolicy_", data, at)
    return RequestPolicy_(v[0], v[1])


_RequestHeader_0 = (Struct("<3qi?"), Struct(">3qi?"))


def encode_RequestHeader_(m: RequestHeader_) -> bytes:
    """Encapsulation header and little-endian data of a RequestHeader_."""
    return HEADER + _RequestHeader_0[0].pack(m.identity.id, m.identity.api_id, m.lease.id, m.policy.priority, m.policy.noreply)


def decode_RequestHeader_(data: Buffer, big: bool) -> RequestHeader_:
    """The RequestHeader_ after the encapsulation header of ``data``."""
    if len(data) < 33:
        raise truncated("RequestHeader_", 33, len(data))
    v = _RequestHeader_0[big].unpack_from(data, 4)
    at = 33
    if at != len(data):
        check_end("RequestHeader_", data, at)
    return RequestHeader_(RequestIdentity_(v[0], v[1]), RequestLease_(v[2]), RequestPolicy_(v[3], v[4]))


_Request_0 = (Struct("<3qi?"), Struct(">3qi?"))


def encode_Request_(m: Request_) -> bytes:
    """Encapsulation header and little-endian data of a Request_."""
    out = bytearray(HEADER + _Request_0[0].pack(m.header.identity.id, m.header.identity.api_id, m.header.lease.id, m.header.policy.priority, m.header.policy.noreply))
    x_parameter = pack_text(m.parameter)
    out += bytes(-len(out) % 4)
    out += len(x_parameter).to_bytes(4, "little") + x_parameter
    x_binary = pack_bytes(m.binary)
    out += bytes(-len(out) % 4)
    out += len(x_binary).to_bytes(4, "little") + x_binary
    return bytes(out)


def decode_Request_(data: Buffer, big: bool) -> Request_:
    """The Request_ after the encapsulation header of ``data``."""
    if len(data) < 33:
        raise truncated("Request_", 33, len(data))
    v = _Request_0[big].unpack_from(data, 4)
    at = 33
    x_parameter, at = take_text("Request_.parameter", data, at, big)
    x_binary, at = take_bytes("Request_.binary", data, at, big)
    if at != len(data):
        check_end("Request_", data, at)
    return Request_(RequestHeader_(RequestIdentity_(v[0], v[1]), RequestLease_(v[2]), RequestPolicy_(v[3], v[4])), x_parameter, x_binary)


_ResponseStatus_0 = (Struct("<i"), Struct(">i"))


def encode_ResponseStatus_(m: ResponseStatus_) -> bytes:
    """Encapsulation header and little-endian data of a ResponseStatus_."""
    return HEADER + _ResponseStatus_0[0].pack(m.code)


def decode_ResponseStatus_(data: Buffer, big: bool) -> ResponseStatus_:
    """The ResponseStatus_ after the encapsulation header of ``data``."""
    if len(data) < 8:
        raise truncated("ResponseStatus_", 8, len(data))
    v = _ResponseStatus_0[big].unpack_from(data, 4)
    at = 8
    if at != len(data):
        check_end("ResponseStatus_", data, at)
    return ResponseStatus_(v[0])


_ResponseHeader_0 = (Struct("<2qi"), Struct(">2qi"))


def encode_ResponseHeader_(m: ResponseHeader_) -> bytes:
    """Encapsulation header and little-endian data of a ResponseHeader_."""
    return HEADER + _ResponseHeader_0[0].pack(m.identity.id, m.identity.api_id, m.status.code)


def decode_ResponseHeader_(data: Buffer, big: bool) -> ResponseHeader_:
    """The ResponseHeader_ after the encapsulation header of ``data``."""
    if len(data) < 24:
        raise truncated("ResponseHeader_", 24, len(data))
    v = _ResponseHeader_0[big].unpack_from(data, 4)
    at = 24
    if at != len(data):
        check_end("ResponseHeader_", data, at)
    return ResponseHeader_(RequestIdentity_(v[0], v[1]), ResponseStatus_(v[2]))


_Response_0 = (Struct("<2qi"), Struct(">2qi"))


def encode_Response_(m: Response_) -> bytes:
    """Encapsulation header and little-endian data of a Response_."""
    out = bytearray(HEADER + _Response_0[0].pack(m.header.identity.id, m.header.identity.api_id, m.header.status.code))
    x_data = pack_text(m.data)
    out += bytes(-len(out) % 4)
    out += len(x_data).to_bytes(4, "little") + x_data
    x_binary = pack_bytes(m.binary)
    out += bytes(-len(out) % 4)
    out += len(x_binary).to_bytes(4, "little") + x_binary
    return bytes(out)


def decode_Response_(data: Buffer, big: bool) -> Response_:
    """The Response_ after the encapsulation header of ``data``."""
    if len(data) < 24:
        raise truncated("Response_", 24, len(data))
    v = _Response_0[big].unpack_from(data, 4)
    at = 24
    x_data, at = take_text("Response_.data", data, at, big)
    x_binary, at = take_bytes("Response_.binary", data, at, big)
    if at != len(data):
        check_end("Response_", data, at)
    return Response_(ResponseHeader_(RequestIdentity_(v[0], v[1]), ResponseStatus_(v[2])), x_data, x_binary)
