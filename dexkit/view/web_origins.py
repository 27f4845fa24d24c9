"""Which requests of browsers a local web server answers: by Host and Origin; sans IO.

A browser lets every web page connect to the servers of its machine, and leaves it to them to look
at what it says of the page: ``Origin`` is where the page is from, and ``Host`` is the address that
the page believes to talk to. A page of an attacker's name that is made to point to this machine
(DNS rebinding) has the origin of the server that it talks to; its Host gives it away.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.escaping import REMARK, one_line

__all__ = ["Allowed", "Refused", "Request", "parse_origin", "read_request"]

_LINE = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t\x20-\x7e\x80-\xff]*)")
_FIRST = re.compile(rb"([A-Z]+) ([\x21-\x7e\x80-\xff]+) HTTP/1\.[01]")
_AUTHORITY = r"(?:\[([0-9A-Fa-f:.]+)\]|([0-9A-Za-z._-]+))(?::([0-9]{1,5}))?"
_HOST = re.compile(_AUTHORITY)
_ORIGIN = re.compile(rf"([a-z][a-z0-9+.-]*)://(?:{_AUTHORITY})?", re.IGNORECASE)
_OWN_NAMES = ("localhost", "127.0.0.1", "::1")


class Refused(Exception):
    """A request is not answered.

    :param reason: a sentence, with what to do if the request was wished.
    """


@dataclass(frozen=True)
class Request:
    """The head of a request.

    :ivar upgrade: to a WebSocket; what follows is no HTTP.
    """

    method: str
    target: str
    hosts: tuple[str, ...]
    origins: tuple[str, ...]
    upgrade: bool


def read_request(head: bytes) -> Request:
    """Read the head of a request, up to and with its empty line.

    :raises Refused: it is none, or written so that another reader may take it for something else.
    """
    first, *lines = head.removesuffix(b"\r\n\r\n").split(b"\r\n")
    begin = _FIRST.fullmatch(first)
    fields = [_LINE.fullmatch(line) for line in lines]
    if begin is None or not all(fields):
        raise Refused("this is no request of HTTP/1.1")

    def values(name: bytes) -> tuple[str, ...]:
        return tuple(
            field[2].strip(b" \t").decode("latin-1")
            for field in fields
            if field is not None and field[1].lower() == name
        )

    return Request(
        method=begin[1].decode(),
        target=begin[2].decode("latin-1"),
        hosts=values(b"host"),
        origins=values(b"origin"),
        upgrade="websocket" in (value.lower() for value in values(b"upgrade")),
    )


def parse_origin(text: str) -> str:
    """An origin as browsers write it: ``SCHEME://HOST[:PORT]`` in small letters.

    :raises UsageError: it is none; ``null`` and ``*`` would be any page.
    """
    origin = text.lower()
    match = _ORIGIN.fullmatch(origin)
    if match is None or (match[1] in ("http", "https", "ws", "wss") and not (match[2] or match[3])):
        raise UsageError(
            f"{one_line(text, 80)!r} is no origin of web pages",
            hint="for example --allow-origin https://viewer.example:8443, without a path",
        )
    return origin


class Allowed:
    """What may read a server.

    :param host: address that the user asked to be served, which requests may name.
    :param origins: of other pages that may read; their hosts may be named as well.
    """

    def __init__(self, host: str, origins: Sequence[str] = ()) -> None:
        self._origins = frozenset(parse_origin(origin) for origin in origins)
        named = [_ORIGIN.fullmatch(origin) for origin in self._origins]
        # whoever owns the name of an allowed page can have it point here: it gains nothing by it
        self._hosts = {
            *(_name(host) for host in (*_OWN_NAMES, host)),
            *(_name(m[2] or m[3]) for m in named if m is not None and (m[2] or m[3])),
        }
        self._any_address = host in ("", "0.0.0.0", "::")

    def check(self, request: Request) -> None:
        """Check the address that a request names, and the page that it comes from.

        :raises Refused: one of them is not allowed.
        """
        if request.method not in ("GET", "HEAD") or not request.target.startswith("/"):
            raise Refused("only GET of a path is answered")
        if len(request.hosts) != 1 or len(request.origins) > 1:
            raise Refused("a request names one Host, and at most one Origin")
        (host,) = request.hosts
        if not self._serves(host):
            shown = one_line(host, REMARK)
            raise Refused(
                f"{shown} is not the address of this server. If it is a name of this machine: "
                f"dexkit view --allow-origin http://{shown}"
            )
        for origin in request.origins:
            if origin.lower() not in (f"http://{host.lower()}", *self._origins):
                shown = one_line(origin, REMARK)
                more = (
                    "" if origin == "null" else f" To let them: dexkit view --allow-origin {shown}"
                )
                raise Refused(f"web pages of {shown} may not read this.{more}")

    def _serves(self, host: str) -> bool:
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = _name(match[1] or match[2])
        if name in self._hosts:
            return True
        # a name can be made to point here by its owner, an address cannot
        return self._any_address and _is_address(name)


def _name(host: str) -> str:
    """A host as it is compared."""
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host.lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
